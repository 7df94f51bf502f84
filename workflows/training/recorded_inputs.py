"""The inputs that determine a training, as recorded in its folder, and their changes since an
earlier training.
"""

from __future__ import annotations

import hashlib
import json
from collections import Counter
from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from dataclasses import asdict, dataclass, field, fields, is_dataclass
from functools import cached_property
from pathlib import Path
from typing import Any

import numpy as np

from neusee.workflows.explain.change_causes import Comparison, edits
from neusee.workflows.graph.recipe_graph import Recipe, Step, needed
from neusee.workflows.keys.cache_key import code_of, digest, file_digest, plain, written
from neusee.workflows.keys.code_digest import Code
from neusee.workflows.keys.sealed_files import text_of
from neusee.workflows.store.result_store import Store
from neusee.workflows.training.resumable_loop import write_whole

# --- recorded inputs ------------------------------------------------------------------------------

# The inputs that determine a training: content of files, code and settings, as recorded in a result
# folder.
#
# Names, paths and times of files are ignored: a training with renamed or moved files is the same,
# and one with other file contents is another. The names are recorded next to the digests, for
# messages on what changed.


FILE = "inputs.json"  #: file in the folder of a training
_FORMAT = 1  #: format of this file; a file in another format counts as absent
_ANY_DEVICE = "any device"  #: a training may continue on another device
#: fields of a law for its text and its place in the recipe
_WORDS_ONLY = frozenset({"text", "mark"})


@dataclass(frozen=True)
class RecordedFile:
    """The digest of a file's content, and the name that the file had."""

    name: str
    content: str

    @classmethod
    def of(cls, path: Path) -> RecordedFile:
        """Read a file and return its digest."""
        return cls(path.name, file_digest(path))


@dataclass(frozen=True)
class RecordedInputs:
    """Everything that determines a training, as JSON values and digests."""

    kind: str  #: training, lift or mask
    recipe: str  #: name of the recipe; it does not enter the digest
    settings: Mapping[str, Any] = field(default_factory=dict)  #: by path
    #: node, code, parameters and inputs by step
    steps: Mapping[str, Mapping[str, Any]] = field(default_factory=dict)
    #: by path: its text, and the values that determine its draws
    laws: Mapping[str, Any] = field(default_factory=dict)
    code: Mapping[str, str] = field(default_factory=dict)  #: digests by a description of the code
    #: by the setting that refers to the file
    files: Mapping[str, RecordedFile] = field(default_factory=dict)
    photographs: Sequence[RecordedFile] = ()  #: photographs used for training
    held_out: Sequence[RecordedFile] = ()

    @cached_property
    def digest(self) -> str:
        """Return the digest of all inputs that count."""
        return digest(
            _FORMAT,
            self.kind,
            dict(self.settings),
            {name: dict(step) for name, step in self.steps.items()},
            # in order, because each law uses its own column of random numbers
            [[path, law["draws"]] for path, law in self.laws.items()],
            dict(self.code),
            {setting: file.content for setting, file in self.files.items()},
            sorted(photograph.content for photograph in self.photographs),
            sorted(photograph.content for photograph in self.held_out),
        )

    @property
    def key(self) -> str:
        """Return the part of the digest used in folder names."""
        return self.digest[:8]

    def write(self, folder: Path) -> None:
        """Write the inputs into the folder of a training, unless they are there already."""
        text = json.dumps(
            {"format": _FORMAT, "digest": self.digest, **asdict(self)}, indent=1, ensure_ascii=False
        )
        if self.read(folder) != self:
            write_whole(folder / FILE, text.encode())

    @classmethod
    def read(cls, folder: Path) -> RecordedInputs | None:
        """Return the inputs recorded in the folder of a training, or None without a valid
        record.
        """
        try:
            content = json.loads(text_of(folder / FILE))
            if content.pop("format") != _FORMAT:
                return None
            stated_digest = content.pop("digest")
            for name in ("photographs", "held_out"):
                content[name] = tuple(RecordedFile(**recorded) for recorded in content[name])
            content["files"] = {
                setting: RecordedFile(**recorded) for setting, recorded in content["files"].items()
            }
            record = cls(**content)
        except (OSError, ValueError, KeyError, TypeError, AttributeError):
            return None
        return record if record.digest == stated_digest else None


def folder_of(runs: Path, stem: str, inputs: RecordedInputs) -> Path:
    """Return the folder of a training: an existing one with equal inputs, under any recipe name, or
    a new one.
    """
    own_folder = runs / f"{stem}_{inputs.key}"
    if own_folder.exists():
        return own_folder
    equal_folders = (file.parent for file in sorted(runs.glob(f"*_{inputs.key}/{FILE}")))
    return next(
        (folder for folder in equal_folders if _digest_in(folder) == inputs.digest), own_folder
    )


def _digest_in(folder: Path) -> str:
    record = RecordedInputs.read(folder)
    return record.digest if record else ""


@dataclass(frozen=True)
class CameraInputs:
    """The part of a training's inputs that comes from one recipe: values, steps and laws."""

    settings: Mapping[str, Any]
    steps: Mapping[str, Mapping[str, Any]]
    laws: Mapping[str, Any]

    @classmethod
    def of(
        cls, recipe: Recipe, outputs: Iterable[str], code: Code, computed: Sequence[str] = ()
    ) -> CameraInputs:
        """Return the inputs that determine the ``outputs`` of a recipe, except the steps
        ``computed`` by the caller.

        Raises ValueError with place and fix for user code with dependencies that cannot be tracked.
        """
        order = [name for name in needed(recipe, outputs) if name not in computed]
        steps = {name: _origin(recipe.steps[name], recipe.seed, code) for name in order}
        values = {"seed": recipe.seed, "tolerance": recipe.tolerance, "exact": recipe.exact}
        return cls(values, steps, _laws(recipe))

    def named(self, prefix: str) -> CameraInputs:
        """Return the same inputs with a prefix before each name, such as the number of another
        camera.
        """
        return CameraInputs(
            *(
                {f"{prefix}{name}": x for name, x in vars(self)[f.name].items()}
                for f in fields(self)
            )
        )

    def joined(self, other: CameraInputs) -> CameraInputs:
        """Return the inputs of two cameras together; their names must differ."""
        return CameraInputs(*({**vars(self)[f.name], **vars(other)[f.name]} for f in fields(self)))


def _origin(step: Step, seed: int, code: Code) -> dict[str, Any]:
    """Return the values that determine a step's result apart from its input results, as in
    `keys.cache_key.key_of`.
    """
    try:
        code_digest = code_of(step, code)
    except LookupError as error:
        raise ValueError(f"step {step.name}: {error.args[0]}") from error
    origin = {
        "node": step.node.path,
        "code": code_digest,
        "params": {name: plain(value) for name, value in step.params.items()},
        "inputs": [plain(step.wires.get(name)) for name in step.node.inputs],
    }
    if written_result := written(step):
        origin["written"] = written_result
    return {**origin, "stream": [seed, step.name, _ANY_DEVICE]} if step.node.random else origin


def _laws(recipe: Recipe) -> dict[str, Any]:
    """Return the laws of a recipe: the text of each, and the values that determine its draws."""
    uncertain = recipe.uncertain
    if uncertain is None:
        return {}
    laws = {
        path: {"text": law.text, "draws": identity(law)} for path, law in uncertain.laws.items()
    }
    if uncertain.joint is not None:
        laws["posterior"] = {
            "text": f"posterior {uncertain.source}",
            "draws": identity(uncertain.joint),
        }
    for path, difference in uncertain.mismatch.items():
        laws[f"train.mismatch.{path}"] = {
            "text": difference.law.text,
            "draws": identity(difference),
        }
    return laws


def identity(value: Any) -> Any:
    """Return JSON values that are equal for equal values; an array becomes a digest, a file the
    digest of its content.
    """
    if isinstance(value, np.ndarray):
        content = np.ascontiguousarray(value)
        return [
            str(content.dtype),
            list(content.shape),
            hashlib.sha256(content.tobytes()).hexdigest(),
        ]
    if is_dataclass(value) and not isinstance(value, type):
        return {
            f.name: identity(getattr(value, f.name))
            for f in fields(value)
            if f.name not in _WORDS_ONLY
        }
    if isinstance(value, tuple | list):
        return [identity(item) for item in value]
    return plain(value)


# --- changed inputs -------------------------------------------------------------------------------

# The changes since an earlier training of a recipe, as text: the reason why a training starts anew.


_SHOWN = 12  #: largest number of listed changes
#: largest number of changes for which a training under another recipe name counts as an earlier
#: version
_FAR = 40
_CHECKPOINTS = ("state.pt", "mask.state", "mask.json")  #: files that mark a training that has begun
CAMERA = "camera "  #: prefix of the names of inputs from a further camera


@dataclass(frozen=True)
class EarlierTraining:
    """The folder of an earlier training, and its input differences as text."""

    folder: Path
    changes: Sequence[str]

    def __str__(self) -> str:
        change_lines = [f"  {change}" for change in self.changes[:_SHOWN]]
        hidden_count = len(self.changes) - _SHOWN
        last_line = [f"  and {hidden_count} more"] if hidden_count > 0 else []
        first_line = (
            f"begins anew, because its inputs are not those of {self.folder.name}, which stays as"
            " it is:"
        )
        return "\n".join([first_line, *change_lines, *last_line])


def prepare_folder(
    folder: Path,
    inputs: RecordedInputs,
    recipe: Recipe,
    store: Store,
    progress: Callable[[str], None],
) -> None:
    """Create the folder of a training with its inputs; report why the training starts anew although
    earlier ones exist.
    """
    if any((folder / name).is_file() for name in _CHECKPOINTS):
        record = RecordedInputs.read(folder)
        if record is not None and record.digest == inputs.digest:
            inputs.write(folder)  # updates the names of the files
        return
    reason = why_anew(folder, inputs, recipe, store)
    if reason is not None:
        progress(str(reason))
    folder.mkdir(parents=True, exist_ok=True)
    inputs.write(folder)


def why_anew(
    folder: Path, inputs: RecordedInputs, recipe: Recipe, store: Store
) -> EarlierTraining | str | None:
    """Return the earlier training with the fewest input differences, or None if there is none.

    An earlier training without recorded inputs, as written by earlier versions, gives a line of
    text.
    """
    runs, stem = folder.parent, folder.name.rpartition("_")[0]
    trainings = list(_earlier(runs, stem, inputs, recipe, store))
    if trainings:
        # fewest changes, then the most recent
        return min(
            trainings, key=lambda training: (len(training.changes), -_began(training.folder))
        )
    without_inputs = next((path.parent for path in sorted(runs.glob(f"{stem}_*/state.pt"))), None)
    if without_inputs is None:
        return None
    text = (
        "an earlier version of neusee wrote it without its inputs, so that nobody can say whether"
        " they are these"
    )
    return f"begins anew, and does not go on with {without_inputs.name}: {text}"


def _earlier(
    runs: Path, stem: str, inputs: RecordedInputs, recipe: Recipe, store: Store
) -> Iterator[EarlierTraining]:
    """Yield the earlier trainings of the same kind with different inputs.

    A training under another name is yielded only if few inputs differ.
    """
    for file in sorted(runs.glob(f"*/{FILE}")):
        has_begun = any((file.parent / name).is_file() for name in _CHECKPOINTS)
        record = RecordedInputs.read(file.parent) if has_begun else None
        if record is None or record.kind != inputs.kind or record.digest == inputs.digest:
            continue
        changes = changes_since(record, inputs, recipe, store)
        if file.parent.name.startswith(f"{stem}_") or len(changes) <= _FAR:
            yield EarlierTraining(file.parent, changes)


def _began(folder: Path) -> float:
    return (folder / FILE).stat().st_mtime


def changes_since(
    old: RecordedInputs, new: RecordedInputs, recipe: Recipe, store: Store
) -> list[str]:
    """Return a phrase for each input that differs between two trainings."""
    clauses = [
        *_values(old.settings, new.settings),
        *_changed_laws(old.laws, new.laws),
        *_files(old.files, new.files),
        *_photographs(old, new),
        *_steps(old.steps, new.steps, recipe, store),
        *_code(old.code, new.code, store),
    ]
    return list(dict.fromkeys(clauses))


def _differing(old: Mapping[str, Any], new: Mapping[str, Any]) -> Iterator[str]:
    """Yield the keys at which two mappings differ; those of ``new`` come first."""
    return (name for name in dict.fromkeys([*new, *old]) if old.get(name) != new.get(name))


def _values(old: Mapping[str, Any], new: Mapping[str, Any]) -> Iterator[str]:
    """Yield a phrase for each setting that was added, removed or changed."""
    for name in _differing(old, new):
        if name not in old or name not in new:
            yield f"{name} is {'set now' if name in new else 'no longer set'}"
        else:
            yield f"{name} {_shown(old[name])} -> {_shown(new[name])}"


def _shown(value: Any) -> str:
    if value is None:
        return "null"
    return f"{value:g}" if isinstance(value, float) else str(value)


def _changed_laws(old: Mapping[str, Any], new: Mapping[str, Any]) -> Iterator[str]:
    """Yield a phrase for each law with other draws, and one if the order of the laws changed.

    The order matters, because each law uses its own column of random numbers.
    """
    if old.keys() == new.keys() and list(old) != list(new):
        yield f"the laws stand in another order: {', '.join(new)}"
    for path in _differing(_draws(old), _draws(new)):
        text_before, text_after = (
            laws[path]["text"] if path in laws else "no law" for laws in (old, new)
        )
        yield (
            f"{path}: other draws of {text_after}"
            if text_before == text_after
            else f"{path} {text_before} -> {text_after}"
        )


def _draws(laws: Mapping[str, Any]) -> dict[str, Any]:
    return {path: law["draws"] for path, law in laws.items()}


def _files(old: Mapping[str, RecordedFile], new: Mapping[str, RecordedFile]) -> Iterator[str]:
    """Yield a phrase for each file that was added, removed or changed."""
    for setting in _differing(_contents(old), _contents(new)):
        if setting not in old or setting not in new:
            yield f"{setting} is {'given now' if setting in new else 'no longer given'}"
        else:
            yield f"file {new[setting].name}: other content ({setting})"


def _contents(files: Mapping[str, RecordedFile]) -> dict[str, str]:
    return {setting: file.content for setting, file in files.items()}


def _photographs(old: RecordedInputs, new: RecordedInputs) -> Iterator[str]:
    """Yield a phrase for each photograph that was added, removed or changed; renaming an equal file
    is no change.
    """
    files_before, files_after = [*old.photographs, *old.held_out], [*new.photographs, *new.held_out]
    new_names = [photograph.name for photograph in _unmatched(files_after, files_before)]
    gone_names = [photograph.name for photograph in _unmatched(files_before, files_after)]
    yield from _came_and_went(new_names, gone_names)
    same_files = not new_names and not gone_names
    if same_files and _unmatched(new.held_out, old.held_out):
        yield "other photographs are held out"


def _came_and_went(came: Sequence[str], went: Sequence[str]) -> Iterator[str]:
    """Yield a phrase for each name; a name both added and removed belongs to a changed file."""
    changed = set(came) & set(went)
    yield from (f"photograph {name}: other content" for name in sorted(changed))
    yield from (f"photograph {name} is new" for name in came if name not in changed)
    yield from (f"photograph {name} is gone" for name in went if name not in changed)


def _unmatched(files: Sequence[RecordedFile], others: Sequence[RecordedFile]) -> list[RecordedFile]:
    """Return the files whose content is missing from ``others``, with multiplicity."""
    counts = Counter(file.content for file in others)
    unmatched_files = []
    for file in files:
        counts[file.content] -= 1
        if counts[file.content] < 0:
            unmatched_files.append(file)
    return unmatched_files


def _steps(
    old: Mapping[str, Mapping[str, Any]],
    new: Mapping[str, Mapping[str, Any]],
    recipe: Recipe,
    store: Store,
) -> Iterator[str]:
    """Yield phrases for each step that was added, removed or changed.

    Steps of further cameras have the camera as a prefix.
    """
    for label in _differing(old, new):
        camera, step = _camera_of(label)
        prefix = f"{camera}: " if camera else ""
        if label not in old or label not in new:
            yield f"{prefix}step {step} is {'new' if label in new else 'gone'}"
            continue
        comparison = Comparison(store, _recipe_of(camera, recipe))
        clauses = comparison.own(step, old[label], new[label])
        # the step itself is unchanged, so its inputs must differ
        if not clauses:
            clauses = [f"step {step} reads {_read(new[label])}, not {_read(old[label])}"]
        yield from (f"{prefix}{clause}" for clause in clauses)


def _camera_of(label: str) -> tuple[str, str]:
    """Split a name such as ``camera 2: psf[mask]`` into camera and step; the camera is empty for
    the first one.
    """
    camera, colon, step = label.partition(": ")
    return (camera, step) if colon else ("", label)


def _recipe_of(camera: str, recipe: Recipe) -> Recipe:
    """Return the recipe of a camera such as ``camera 2``; any other name gives the recipe of the
    first camera.

    Any other name belongs to the recipe itself.
    """
    number = camera.removeprefix(CAMERA)
    if camera.startswith(CAMERA) and number.isdigit() and int(number) - 2 < len(recipe.cameras):
        # further cameras are numbered from 2
        return recipe.cameras[int(number) - 2]
    return recipe


def _read(origin: Mapping[str, Any]) -> str:
    """Return the names of the results that a step reads, as text."""
    names: list[str] = []
    for source in origin["inputs"]:
        names += [source] if isinstance(source, str) else source or []
    return ", ".join(names) or "nothing"


def _code(old: Mapping[str, str], new: Mapping[str, str], store: Store) -> Iterator[str]:
    """Yield a phrase for each change of a module's code.

    A module whose old code is not stored gets a single phrase.
    """
    for module in _differing(old, new):
        changes = edits(store.root, old.get(module, ""), new.get(module, ""))
        yield from changes or [f"the code of {module} changed"]
