"""The loop of every training; a stopped training continues from its checkpoint with bit-identical
results.
"""

from __future__ import annotations

import csv
import io
import json
import os
import time
from abc import ABC, abstractmethod
from collections.abc import Callable, Mapping, Sequence
from contextlib import suppress
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Generic, Protocol, TypeVar

import torch
from torch import nn
from torch.optim.swa_utils import AveragedModel, get_ema_multi_avg_fn

from neusee.nodes.file_headers import archive_needs
from neusee.nodes.input_files import lines_of
from neusee.workflows.engine.provenance import timestamp, versions
from neusee.workflows.recipe.blocks.train_block import LiftTraining, Training
from neusee.workflows.report.run_crate import remove_crate, write_crate
from neusee.workflows.store.result_store import Store
from neusee.workflows.training.process_mesh import ALONE, Mesh

# --- checkpoint -----------------------------------------------------------------------------------

# The files of a training: its checkpoint, its table of losses, and its trained weights.


_FORMAT = 1  #: format of a checkpoint; one in another format is refused
_BYTES_OF_TABLE = 24.0  #: bytes in memory per byte of a loss table
#: names in a checkpoint of version 0.1, and their present names
_PRESENT_NAMES = {"relief": "mask"}


def write_whole(path: Path, data: bytes) -> None:
    """Replace a file atomically: an interrupted write leaves the old file unchanged."""
    partial = path.with_name(f".{path.name}.{os.getpid()}.part")
    try:
        with partial.open("wb") as file:
            file.write(data)
            file.flush()
            os.fsync(file.fileno())
        partial.replace(path)
    except BaseException:
        partial.unlink(missing_ok=True)
        raise


@dataclass(frozen=True)
class StateFile:
    """The checkpoint file of a training; it is replaced atomically, so that it is always
    complete.
    """

    path: Path

    def write(self, state: Mapping[str, Any]) -> None:
        """Replace the checkpoint file by a new training state."""
        self.path.parent.mkdir(parents=True, exist_ok=True)
        memory = io.BytesIO()
        torch.save({"edition": _FORMAT, **state}, memory)
        write_whole(self.path, memory.getvalue())

    def read(self, device: str = "cpu", strict: bool = True) -> dict[str, Any]:
        """Return the training state from the checkpoint file; empty if there is no file.

        Raises ValueError for a file that cannot be read, or that needs more memory than is left; if
        not ``strict``, an unreadable file counts as absent.
        """
        if not self.path.exists():
            return {}
        archive_needs(self.path, 1.0)  # too little memory raises an error: the state is not absent
        try:
            state: dict[str, Any] = torch.load(self.path, map_location=device, weights_only=True)
            if state.get("edition", _FORMAT) != _FORMAT:
                raise ValueError(f"the training state has format {state['edition']}, not {_FORMAT}")
            if "parts" in state:
                state["parts"] = {
                    _PRESENT_NAMES.get(name, name): member
                    for name, member in state["parts"].items()
                }
        except (
            RuntimeError,
            KeyError,
            EOFError,
            OSError,
            ValueError,
            TypeError,
            AttributeError,
        ) as error:
            if not strict:
                return {}
            raise ValueError(
                f"{self.path} cannot be read ({error}): remove its folder to start again"
            ) from error
        return state


class Rows:
    """The table ``losses.csv`` of a training, with one row for each iteration."""

    def __init__(self, path: Path, columns: Sequence[str]) -> None:
        self._path, self._columns = path, columns
        self.rows: list[dict[str, str]] = []
        self._kept = 0

    def cut(self, stage: int, iteration: int, write: bool = True) -> None:
        """Read the loss table from its file, and discard the rows from the given iteration on."""
        if self._path.exists():
            lines = csv.DictReader(lines_of(self._path, _BYTES_OF_TABLE))
            self.rows = [row for row in lines if _place(row) < (stage, iteration)]
        self._kept = 0
        if write:
            self.keep()

    def add(self, stage: int, iteration: int, losses: Mapping[str, float]) -> None:
        """Append the losses of an iteration to the loss table in memory; `keep` writes it
        to disk.
        """
        row = {
            "stage": stage,
            "iteration": iteration,
            **{name: f"{x:.6g}" for name, x in losses.items()},
        }
        self.rows.append({name: str(row.get(name, "")) for name in self._columns})

    def keep(self) -> None:
        """Append the new rows to the file of the loss table; the first call writes the
        whole file.
        """
        text = io.StringIO(newline="")
        writer = csv.DictWriter(text, self._columns)
        if self._kept == 0:
            writer.writeheader()
        writer.writerows(self.rows[self._kept :])
        if self._kept == 0:
            write_whole(self._path, text.getvalue().encode())
        else:
            with self._path.open("ab") as file:
                file.write(text.getvalue().encode())
        self._kept = len(self.rows)


def _place(row: Mapping[str, str | None]) -> tuple[int, int]:
    """Return (stage, iteration) of a row of the loss table as a sort key; incomplete rows come
    last.
    """
    with suppress(ValueError, TypeError, KeyError):
        if None not in row.values():
            return int(row.get("stage") or 0), int(row["iteration"] or 0)
    return 1 << 62, 0


def export(
    folder: Path,
    name: str,
    tensors: Mapping[str, torch.Tensor],
    about: dict[str, str] | None = None,
) -> None:
    """Write tensors and metadata to the file ``<name>.safetensors`` in a folder."""
    from safetensors.torch import save

    copies = {key: x.detach().cpu().contiguous().clone() for key, x in tensors.items()}
    write_whole(folder / f"{name}.safetensors", save(copies, about or None))


# --- checkpoints by time --------------------------------------------------------------------------

# A training that is killed loses the work since its last checkpoint. A number of iterations does
# not bound this work, because an iteration takes from a tenth of a second to minutes.


_LOST_SECONDS = 120.0  #: the most work that a killed training loses, if an iteration is no longer
#: time that is kept free for the next iteration, if the one before it took less
_ITERATION_SECONDS = 60.0


class CheckpointClock:
    """The time since the last checkpoint of a training.

    A checkpoint is due if the next iteration could end later than two minutes after the last one.
    The next iteration counts as long as the one before it, and as a minute at least.
    """

    def __init__(self) -> None:
        self.restart()

    def restart(self) -> None:
        """Count from now on: a checkpoint was written, or there is nothing yet that can be lost."""
        self._kept = self._ended = time.monotonic()
        self._last_seconds = 0.0

    def end_iteration(self) -> None:
        """Note that an iteration ends now."""
        now = time.monotonic()
        self._last_seconds, self._ended = now - self._ended, now

    @property
    def is_due(self) -> bool:
        """Return True if a checkpoint must be written before the next iteration."""
        next_seconds = max(self._last_seconds, _ITERATION_SECONDS)
        return self._ended - self._kept + next_seconds > _LOST_SECONDS


# --- resumable loop -------------------------------------------------------------------------------

# The loop of every training; a stopped training continues from its last checkpoint with
# bit-identical results.


Losses = dict[str, float]
Progress = Callable[[str], None]  #: function of one line of text on the progress
#: function of the stage, its iterations so far, and the losses
Watch = Callable[[int, int, Mapping[str, float]], None]
DOCUMENT = "training.json"  #: the file that a training writes last


@dataclass(frozen=True)
class TrainingSession:
    """One call of a training: where it computes and writes, and how it reports progress.

    It does not change the trained network except by rounding.
    """

    store: Store
    runs: Path  #: folder in which each training has a folder of its own
    progress: Progress
    command: Sequence[str] = ()  #: command line, for the document of the training
    device: str = "cpu"
    watch: Watch | None = None
    mesh: Mesh = ALONE

    @property
    def writes(self) -> bool:
        """Return True in the only process that writes files and reports progress."""
        return self.mesh.first


class NotFinite(ArithmeticError):
    """Error for a loss or a gradient that is NaN or infinite."""


class Learns(Protocol):
    """Interface of the objects that a training changes: networks, parameters and optimisers."""

    def parts(self) -> dict[str, Any]:
        """Return by name the objects whose state a checkpoint must contain."""


L = TypeVar("L", bound=Learns)


class ResumableLoop(ABC, Generic[L]):
    """A training loop that writes a checkpoint, a loss table, pictures and a final document into a
    folder.

    Among several processes, only the first writes files. A training without stages is in stage 0.
    """

    def __init__(
        self,
        folder: Path,
        settings: Training | LiftTraining,
        learner: L,
        columns: Sequence[str],
        session: TrainingSession,
        inputs: str = "",
    ) -> None:
        self.folder, self.learner, self.session = folder, learner, session
        self.progress, self.device, self.writes = session.progress, session.device, session.writes
        self.keep_every, self.show_every = settings.keep, settings.show
        self.rows, self.state = Rows(folder / "losses.csv", columns), StateFile(folder / "state.pt")
        self.stage, self.iteration, self.batch, self.began = 0, 0, 1, timestamp()
        self.inputs = inputs  #: digest of all inputs of the training
        self.clock = CheckpointClock()

    @abstractmethod
    def iterate(self) -> Losses:
        """Compute one training iteration and return the losses; raise `NotFinite` if a loss is NaN
        or infinite.

        `NotFinite` is raised for a gradient too, and always before the optimiser changes the
        weights.
        """

    @abstractmethod
    def show(self) -> None:
        """Write a picture that shows the output of the networks at the present iteration."""

    def validate(self, iterations: int) -> Losses:
        """Return further numbers for the loss table after a number of iterations of the stage;
        empty by default.
        """
        return {}

    @property
    def validates_next(self) -> bool:
        """Return True if the next iteration has a validation, which may take minutes."""
        return False

    @property
    def stops_early(self) -> bool:
        """Return True if the present stage ends before its last iteration."""
        return False

    def facts(self) -> dict[str, Any]:
        """Return further entries for the checkpoint; empty by default."""
        return {}

    def recall(self, facts: Mapping[str, Any]) -> None:
        """Restore the entries of `facts` from a checkpoint."""

    def begin_stage(self) -> None:
        """Prepare networks and optimisers for the present stage of the training."""

    def resume(self) -> None:
        """Continue from the checkpoint file, or start at the first iteration if there is none."""
        state = self.state.read(self.device)
        if state and state.get("inputs", self.inputs) != self.inputs:
            text = (
                "was written for other inputs than those of this training, although its folder has"
                " their name"
            )
            raise ValueError(f"{self.state.path} {text}: remove the folder to start again")
        self.stage, self.iteration = state.get("stage", self.stage), state.get("iteration", 0)
        # first create the optimisers that the checkpoint fills
        self.begin_stage()
        if state:
            self.recall(state)
            for name, member in self.learner.parts().items():
                member.load_state_dict(state["parts"][name])
            self.rows.cut(self.stage, self.iteration, self.writes)
            self.progress(
                f"continues {f'in stage {self.stage} ' if self.stage else ''}after {self.iteration}"
                " iterations"
            )

    def run(self, iterations: int, batch: int) -> None:
        """Compute the remaining iterations of the present stage; the caller saves the state at the
        end.
        """
        self.batch = batch
        if self.writes and self.iteration < iterations:
            remove_crate(self.folder)
        self.clock.restart()
        while self.iteration < iterations and not self.stops_early:
            losses = self._next_row()
            has_ended = self.iteration == iterations or self.stops_early
            self._show_at_intervals(has_ended)
            self.note(losses)
            self.clock.end_iteration()
            if not has_ended and self._must_keep():
                self.keep()
                self.clock.restart()

    def _must_keep(self) -> bool:
        """Return True if a checkpoint must be written between two iterations."""
        is_at_interval = self.iteration % self.keep_every == 0
        return is_at_interval or self.clock.is_due or self.validates_next

    def _show_at_intervals(self, ended: bool) -> None:
        if self.writes and (ended or self.iteration % self.show_every == 0):
            self.show()

    def _next_row(self) -> Losses:
        """Compute one iteration, and add its losses and run time to the loss table."""
        began = time.perf_counter()
        try:
            losses = self.iterate()
        except NotFinite as error:
            raise self._dumped(error) from error
        losses |= self.validate(self.iteration + 1)
        losses["seconds"] = time.perf_counter() - began
        self.rows.add(self.stage, self.iteration, losses)
        self.iteration += 1
        return losses

    def note(self, losses: Losses) -> None:
        """Pass the losses of the last iteration to the callback ``watch``."""
        if self.session.watch is not None:
            self.session.watch(self.stage, self.iteration, losses)

    def keep(self) -> None:
        """Write the loss table and then the checkpoint to disk.

        In this order a killed process can leave surplus rows, which `resume` removes, but never
        missing ones.
        """
        if self.writes:
            self.rows.keep()
            self.state.write(self._packed())

    def write_picture(self, name: str, picture: bytes) -> None:
        """Write a PNG file into the folder ``pictures`` of a training."""
        (self.folder / "pictures").mkdir(exist_ok=True)
        write_whole(self.folder / "pictures" / f"{name}.png", picture)

    def close(self, curves: bytes, recipe: str, **facts: Any) -> None:
        """Write the loss curves, and then the document with settings and results."""
        remove_crate(self.folder)
        write_whole(self.folder / "curves.png", curves)
        seconds = sum(float(row["seconds"]) for row in self.rows.rows)
        document = {
            "command": list(self.session.command),
            "recipe": recipe,
            **facts,
            "seconds": seconds,
            "versions": versions(),
        }
        text = json.dumps(document, indent=1, ensure_ascii=False) + "\n"
        write_whole(self.folder / DOCUMENT, text.encode())
        write_crate(self.folder, self.folder.name, document | {"began": self.began})

    def _packed(self, **about: Any) -> dict[str, Any]:
        """Return the content of a checkpoint, with the further entries ``about``.

        It contains stage, iteration, inputs, facts, and by name the state of each part of the
        learner.
        """
        member_states = {name: member.state_dict() for name, member in self.learner.parts().items()}
        return {
            "stage": self.stage,
            "iteration": self.iteration,
            "inputs": self.inputs,
            **self.facts(),
            **about,
            "parts": member_states,
        }

    def _dumped(self, error: NotFinite) -> ArithmeticError:
        """Write the weights and the picture numbers that led to a NaN or infinite loss, and return
        the error to raise.
        """
        stage_and_iteration = [self.stage, self.iteration] if self.stage else [self.iteration]
        dump = StateFile(self.folder / f"not_finite_{'_'.join(map(str, stage_and_iteration))}.pt")
        first_picture, count = self.iteration * self.batch, self.batch
        if self.writes:
            dump.write(self._packed(pictures=list(range(first_picture, first_picture + count))))
            self.rows.keep()
        stage = f"stage {self.stage}, " if self.stage else ""
        pictures = (
            f"pictures {first_picture} to {first_picture + count - 1}"
            if count > 1
            else f"picture {first_picture}"
        )
        text = (
            f"{stage}iteration {self.iteration}, {pictures}: {error}; the weights are in"
            f" {dump.path}"
        )
        return ArithmeticError(text)


def require_finite(numbers: Mapping[str, float]) -> None:
    """Raise `NotFinite` with the names of all numbers that are NaN or infinite."""
    wrong_names = [name for name, x in numbers.items() if not abs(x) < float("inf")]
    if wrong_names:
        raise NotFinite(f"these numbers are NaN or infinite: {', '.join(wrong_names)}")


def averaged(net: nn.Module, decay: float) -> AveragedModel | None:
    """Return an exponential moving average of a network's weights, or None if ``decay`` is 0."""
    average_function = get_ema_multi_avg_fn(decay)  # type: ignore[no-untyped-call]
    return AveragedModel(net, multi_avg_fn=average_function) if decay else None
