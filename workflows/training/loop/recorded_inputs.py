"""What decides a training: content of files, code and settings, as a folder of results keeps them.

No name of a file, no path and no time counts, so that a training with files that were renamed or moved is the same, and
one with other content is another. The names are kept beside the digests, for the words that say what changed.
"""

from __future__ import annotations

import hashlib
import json
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import asdict, dataclass, field, fields, is_dataclass
from functools import cached_property
from pathlib import Path
from typing import Any

import numpy as np

from neusee.workflows.graph.recipe_graph import Recipe, Step, needed
from neusee.workflows.keys.cache_key import code_of, digest, plain
from neusee.workflows.keys.code_digest import Code
from neusee.workflows.keys.input_file_digest import file_digest
from neusee.workflows.keys.regular_file import text_of
from neusee.workflows.keys.written_params import written
from neusee.workflows.training.loop.checkpoint import write_whole

FILE = "inputs.json"  #: in the folder of a training
_FORMAT = 1  #: of this file; a file of another format counts as absent
_ANY_DEVICE = "any device"  #: a training goes on on another device
_WORDS_ONLY = frozenset({"text", "mark"})  #: fields of a law that say how and where it is written


@dataclass(frozen=True)
class RecordedFile:
    """The digest of the content of a file, and the name that the file had."""

    name: str
    content: str

    @classmethod
    def of(cls, path: Path) -> RecordedFile:
        """Read a file and return its digest."""
        return cls(path.name, file_digest(path))


@dataclass(frozen=True)
class RecordedInputs:
    """Everything that decides a training, as JSON values and digests."""

    kind: str  #: training, lift or mask
    recipe: str  #: its name, which decides nothing
    settings: Mapping[str, Any] = field(default_factory=dict)  #: by path
    steps: Mapping[str, Mapping[str, Any]] = field(default_factory=dict)  #: node, code, parameters and inputs by step
    laws: Mapping[str, Any] = field(default_factory=dict)  #: by path: how it is written, and what decides its draws
    code: Mapping[str, str] = field(default_factory=dict)  #: digests by what the code is
    files: Mapping[str, RecordedFile] = field(default_factory=dict)  #: by the setting that names the file
    photographs: Sequence[RecordedFile] = ()  #: that are trained on
    held_out: Sequence[RecordedFile] = ()

    @cached_property
    def digest(self) -> str:
        """Return the digest of all that counts."""
        return digest(
            _FORMAT,
            self.kind,
            dict(self.settings),
            {name: dict(step) for name, step in self.steps.items()},
            [[path, law["draws"]] for path, law in self.laws.items()],  # in order, because each takes its own column
            dict(self.code),
            {setting: file.content for setting, file in self.files.items()},
            sorted(photograph.content for photograph in self.photographs),
            sorted(photograph.content for photograph in self.held_out),
        )

    @property
    def key(self) -> str:
        """Return the part of the digest that stands in the name of a folder."""
        return self.digest[:8]

    def write(self, folder: Path) -> None:
        """Write the inputs into the folder of a training, unless they stand there already."""
        text = json.dumps({"format": _FORMAT, "digest": self.digest, **asdict(self)}, indent=1, ensure_ascii=False)
        if self.read(folder) != self:
            write_whole(folder / FILE, text.encode())

    @classmethod
    def read(cls, folder: Path) -> RecordedInputs | None:
        """Return the inputs that the folder of a training keeps, or None for a folder without them."""
        try:
            written = json.loads(text_of(folder / FILE))
            if written.pop("format") != _FORMAT:
                return None
            stated = written.pop("digest")
            for name in ("photographs", "held_out"):
                written[name] = tuple(RecordedFile(**each) for each in written[name])
            written["files"] = {setting: RecordedFile(**each) for setting, each in written["files"].items()}
            record = cls(**written)
        except (OSError, ValueError, KeyError, TypeError, AttributeError):
            return None
        return record if record.digest == stated else None


def folder_of(runs: Path, stem: str, inputs: RecordedInputs) -> Path:
    """Return the folder of a training: one with equal inputs, whatever its recipe was called, or a new one."""
    own = runs / f"{stem}_{inputs.key}"
    if own.exists():
        return own
    equal = (file.parent for file in sorted(runs.glob(f"*_{inputs.key}/{FILE}")))
    return next((folder for folder in equal if _digest_in(folder) == inputs.digest), own)


def _digest_in(folder: Path) -> str:
    record = RecordedInputs.read(folder)
    return record.digest if record else ""


@dataclass(frozen=True)
class CameraInputs:
    """What a recipe contributes to the inputs of a training: values, steps and laws."""

    settings: Mapping[str, Any]
    steps: Mapping[str, Mapping[str, Any]]
    laws: Mapping[str, Any]

    @classmethod
    def of(cls, recipe: Recipe, outputs: Iterable[str], code: Code, given: Sequence[str] = ()) -> CameraInputs:
        """Return what decides the ``outputs`` of a recipe; the caller computes the steps ``given``, which do not count.

        Raises ValueError with place and fix for code of the user that reads what cannot be followed.
        """
        order = [name for name in needed(recipe, outputs) if name not in given]
        steps = {name: _origin(recipe.steps[name], recipe.seed, code) for name in order}
        values = {"seed": recipe.seed, "tolerance": recipe.tolerance, "exact": recipe.exact}
        return cls(values, steps, _laws(recipe))

    def named(self, prefix: str) -> CameraInputs:
        """Return the same with a prefix before each name, such as that of another camera."""
        return CameraInputs(*({f"{prefix}{name}": x for name, x in vars(self)[f.name].items()} for f in fields(self)))

    def joined(self, other: CameraInputs) -> CameraInputs:
        """Return the inputs of two cameras, whose names differ."""
        return CameraInputs(*({**vars(self)[f.name], **vars(other)[f.name]} for f in fields(self)))


def _origin(step: Step, seed: int, code: Code) -> dict[str, Any]:
    """Return what decides a step but for the results that it reads, as `keys.cache_key.key_of` does."""
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
    if said := written(step):
        origin["written"] = said
    return {**origin, "stream": [seed, step.name, _ANY_DEVICE]} if step.node.random else origin


def _laws(recipe: Recipe) -> dict[str, Any]:
    """Return the laws of a recipe: how each is written, and what decides its draws."""
    uncertain = recipe.uncertain
    if uncertain is None:
        return {}
    laws = {path: {"text": law.text, "draws": identity(law)} for path, law in uncertain.laws.items()}
    if uncertain.joint is not None:
        laws["posterior"] = {"text": f"posterior {uncertain.source}", "draws": identity(uncertain.joint)}
    for path, difference in uncertain.mismatch.items():
        laws[f"train.mismatch.{path}"] = {"text": difference.law.text, "draws": identity(difference)}
    return laws


def identity(value: Any) -> Any:
    """Return JSON values that are equal for equal values: an array is its digest, a file that of its content."""
    if isinstance(value, np.ndarray):
        content = np.ascontiguousarray(value)
        return [str(content.dtype), list(content.shape), hashlib.sha256(content.tobytes()).hexdigest()]
    if is_dataclass(value) and not isinstance(value, type):
        return {f.name: identity(getattr(value, f.name)) for f in fields(value) if f.name not in _WORDS_ONLY}
    if isinstance(value, tuple | list):
        return [identity(part) for part in value]
    return plain(value)
