"""What changed since an earlier training of a recipe, in words: the reason why a training begins anew."""

from __future__ import annotations

from collections import Counter
from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from neusee.workflows.explain.change_causes import Comparison
from neusee.workflows.explain.code_changes import edits
from neusee.workflows.graph.recipe_graph import Recipe
from neusee.workflows.store.result_store import Store
from neusee.workflows.training.loop.recorded_inputs import FILE, RecordedFile, RecordedInputs

_SHOWN = 12  #: changes that are listed
_FAR = 40  #: changes above which a training of a recipe with another name is no earlier version of this one
_CHECKPOINTS = ("state.pt", "mask.state", "mask.json")  #: files of a training that has begun
CAMERA = "camera "  #: first letters of the names of what a further camera contributes


@dataclass(frozen=True)
class EarlierTraining:
    """The folder of an earlier training, and the differences of its inputs in words."""

    folder: Path
    changes: Sequence[str]

    def __str__(self) -> str:
        listed = [f"  {change}" for change in self.changes[:_SHOWN]]
        hidden = len(self.changes) - _SHOWN
        more = [f"  and {hidden} more"] if hidden > 0 else []
        head = f"begins anew, because its inputs are not those of {self.folder.name}, which stays as it is:"
        return "\n".join([head, *listed, *more])


def prepare_folder(
    folder: Path, inputs: RecordedInputs, recipe: Recipe, store: Store, progress: Callable[[str], None]
) -> None:
    """Make the folder of a training with its inputs; say why a training begins anew although there are earlier ones."""
    if any((folder / name).is_file() for name in _CHECKPOINTS):
        record = RecordedInputs.read(folder)
        if record is not None and record.digest == inputs.digest:
            inputs.write(folder)  # with the names that the files have now
        return
    reason = why_anew(folder, inputs, recipe, store)
    if reason is not None:
        progress(str(reason))
    folder.mkdir(parents=True, exist_ok=True)
    inputs.write(folder)


def why_anew(folder: Path, inputs: RecordedInputs, recipe: Recipe, store: Store) -> EarlierTraining | str | None:
    """Return the earlier training whose inputs differ least, or None if there is no earlier one.

    An earlier training without inputs, as earlier versions wrote it, gives a line of text.
    """
    runs, stem = folder.parent, folder.name.rpartition("_")[0]
    earlier = list(_earlier(runs, stem, inputs, recipe, store))
    if earlier:
        return min(earlier, key=lambda each: (len(each.changes), -_began(each.folder)))
    silent = next((path.parent for path in sorted(runs.glob(f"{stem}_*/state.pt"))), None)
    if silent is None:
        return None
    text = "an earlier version of neusee wrote it without its inputs, so that nobody can say whether they are these"
    return f"begins anew, and does not go on with {silent.name}: {text}"


def _earlier(runs: Path, stem: str, inputs: RecordedInputs, recipe: Recipe, store: Store) -> Iterator[EarlierTraining]:
    for file in sorted(runs.glob(f"*/{FILE}")):
        begun = any((file.parent / name).is_file() for name in _CHECKPOINTS)
        record = RecordedInputs.read(file.parent) if begun else None
        if record is None or record.kind != inputs.kind or record.digest == inputs.digest:
            continue
        changes = changes_since(record, inputs, recipe, store)
        if file.parent.name.startswith(f"{stem}_") or len(changes) <= _FAR:
            yield EarlierTraining(file.parent, changes)


def _began(folder: Path) -> float:
    return (folder / FILE).stat().st_mtime


def changes_since(old: RecordedInputs, new: RecordedInputs, recipe: Recipe, store: Store) -> list[str]:
    """Return a clause for each input that differs between two trainings."""
    words = [
        *_values(old.settings, new.settings),
        *_laws(old.laws, new.laws),
        *_files(old.files, new.files),
        *_photographs(old, new),
        *_steps(old.steps, new.steps, recipe, store),
        *_code(old.code, new.code, store),
    ]
    return list(dict.fromkeys(words))


def _differing(old: Mapping[str, Any], new: Mapping[str, Any]) -> Iterator[str]:
    return (name for name in dict.fromkeys([*new, *old]) if old.get(name) != new.get(name))


def _values(old: Mapping[str, Any], new: Mapping[str, Any]) -> Iterator[str]:
    for name in _differing(old, new):
        if name not in old or name not in new:
            yield f"{name} is {'set now' if name in new else 'no longer set'}"
        else:
            yield f"{name} {_shown(old[name])} -> {_shown(new[name])}"


def _shown(value: Any) -> str:
    if value is None:
        return "null"
    return f"{value:g}" if isinstance(value, float) else str(value)


def _laws(old: Mapping[str, Any], new: Mapping[str, Any]) -> Iterator[str]:
    if old.keys() == new.keys() and list(old) != list(new):
        yield f"the laws stand in another order: {', '.join(new)}"
    for path in _differing(_draws(old), _draws(new)):
        before, after = (laws[path]["text"] if path in laws else "no law" for laws in (old, new))
        yield f"{path}: other draws of {after}" if before == after else f"{path} {before} -> {after}"


def _draws(laws: Mapping[str, Any]) -> dict[str, Any]:
    return {path: law["draws"] for path, law in laws.items()}


def _files(old: Mapping[str, RecordedFile], new: Mapping[str, RecordedFile]) -> Iterator[str]:
    for setting in _differing(_contents(old), _contents(new)):
        if setting not in old or setting not in new:
            yield f"{setting} is {'given now' if setting in new else 'no longer given'}"
        else:
            yield f"file {new[setting].name}: other content ({setting})"


def _contents(files: Mapping[str, RecordedFile]) -> dict[str, str]:
    return {setting: file.content for setting, file in files.items()}


def _photographs(old: RecordedInputs, new: RecordedInputs) -> Iterator[str]:
    """Yield a clause for each photograph that came, went or changed; a new name of an equal file is no change."""
    before, after = [*old.photographs, *old.held_out], [*new.photographs, *new.held_out]
    came = [photograph.name for photograph in _beyond(after, before)]
    went = [photograph.name for photograph in _beyond(before, after)]
    yield from _came_and_went(came, went)
    same_files = not came and not went
    if same_files and _beyond(new.held_out, old.held_out):
        yield "other photographs are held out"


def _came_and_went(came: Sequence[str], went: Sequence[str]) -> Iterator[str]:
    """Yield a clause for each name of a photograph; one that came and went has another content."""
    changed = set(came) & set(went)
    yield from (f"photograph {name}: other content" for name in sorted(changed))
    yield from (f"photograph {name} is new" for name in came if name not in changed)
    yield from (f"photograph {name} is gone" for name in went if name not in changed)


def _beyond(files: Sequence[RecordedFile], others: Sequence[RecordedFile]) -> list[RecordedFile]:
    """Return the files whose content the others do not have, each as often as it is missing there."""
    unmatched = Counter(file.content for file in others)
    beyond = []
    for file in files:
        unmatched[file.content] -= 1
        if unmatched[file.content] < 0:
            beyond.append(file)
    return beyond


def _steps(
    old: Mapping[str, Mapping[str, Any]], new: Mapping[str, Mapping[str, Any]], recipe: Recipe, store: Store
) -> Iterator[str]:
    for label in _differing(old, new):
        camera, step = _camera_of(label)
        before = f"{camera}: " if camera else ""
        if label not in old or label not in new:
            yield f"{before}step {step} is {'new' if label in new else 'gone'}"
            continue
        comparison = Comparison(store, _recipe_of(camera, recipe))
        clauses = comparison.own(step, old[label], new[label])
        if not clauses:
            clauses = [f"step {step} reads {_read(new[label])}, not {_read(old[label])}"]
        yield from (f"{before}{clause}" for clause in clauses)


def _camera_of(label: str) -> tuple[str, str]:
    """Return the camera and the step in a name such as ``camera 2: psf[mask]``; the first camera has no name."""
    camera, colon, step = label.partition(": ")
    return (camera, step) if colon else ("", label)


def _recipe_of(camera: str, recipe: Recipe) -> Recipe:
    number = camera.removeprefix(CAMERA)
    if camera.startswith(CAMERA) and number.isdigit() and int(number) - 2 < len(recipe.cameras):
        return recipe.cameras[int(number) - 2]
    return recipe


def _read(origin: Mapping[str, Any]) -> str:
    names = [name for source in origin["inputs"] for name in ([source] if isinstance(source, str) else source or [])]
    return ", ".join(names) or "nothing"


def _code(old: Mapping[str, str], new: Mapping[str, str], store: Store) -> Iterator[str]:
    for what in _differing(old, new):
        found = edits(store.root, old.get(what, ""), new.get(what, ""))
        yield from found or [f"the code of {what} changed"]
