"""The loop of every training: a stopped one goes on from its last state to the same bits."""

from __future__ import annotations

import time
from abc import ABC, abstractmethod
from collections.abc import Callable, Mapping, Sequence
from pathlib import Path
from typing import Any, Protocol

from torch import nn
from torch.optim.swa_utils import AveragedModel, get_ema_multi_avg_fn

from neusee.workflows.engine.node_call import versions
from neusee.workflows.training.loop.checkpoint import Rows, StateFile, write_json, write_whole

Losses = dict[str, float]
Progress = Callable[[str], None]  #: takes one line about what a training does
DOCUMENT = "training.json"  #: the file that a training writes last
STEEPEST = 10.0  #: the norm above which a gradient is shortened


class NotFinite(ArithmeticError):
    """A loss or a gradient that is NaN or infinite."""


class Pace(Protocol):
    """Settings that every training has."""

    @property
    def keep(self) -> int:
        """Iterations from one state on disk to the next."""

    @property
    def show(self) -> int:
        """Iterations from one picture to the next."""


class ResumableLoop(ABC):
    """A training in a folder: its state, a row for each iteration, pictures on the way, and a document at the end.

    Only the loop with ``writes`` writes files: of several processes, one.
    """

    def __init__(
        self, folder: Path, pace: Pace, columns: Sequence[str], progress: Progress, device: str, writes: bool = True
    ) -> None:
        self.folder, self.pace, self.progress, self.device, self.writes = folder, pace, progress, device, writes
        self.rows = Rows(folder / "losses.csv", columns)
        self.state = StateFile(folder / "state.pt")
        self.stage, self.iteration = 0, 0  # a training without stages stays in stage 0

    # --- what each training does in its own way -----------------------------------------------------------------------

    @abstractmethod
    def parts(self) -> Mapping[str, Any]:
        """Return everything on which a later iteration depends."""

    @abstractmethod
    def batch(self) -> int:
        """Return the number of pictures in an iteration of the present stage."""

    @abstractmethod
    def iterate(self) -> Losses:
        """Compute one iteration and return its losses; raise `NotFinite` before a bad step."""

    @abstractmethod
    def show(self) -> None:
        """Write a picture of the present state of learning."""

    @abstractmethod
    def report(self, losses: Losses) -> None:
        """Pass on the losses of the iteration that has just ended."""

    @abstractmethod
    def begin_stage(self) -> None:
        """Prepare the parts for the present stage, before a state is put back into them."""

    # --- what all trainings do in the same way ------------------------------------------------------------------------

    def resume(self) -> None:
        """Begin at the first iteration, or go on from the state that an earlier process left."""
        found = self.state.read(self.device)
        self.stage, self.iteration = found.get("stage", self.stage), found.get("iteration", 0)
        self.begin_stage()
        if found:
            for name, part in self.parts().items():
                part.load_state_dict(found["parts"][name])
            self.rows.cut(self.stage, self.iteration, self.writes)
            self.progress(f"goes on {f'in stage {self.stage} ' if self.stage else ''}after {self.iteration} iterations")

    def run(self, iterations: int) -> None:
        """Iterate to the end of the present stage; the caller keeps the state that follows the last iteration."""
        while self.iteration < iterations:
            losses = self._timed()
            self.rows.add(self.stage, self.iteration, losses)
            self.iteration += 1
            ended = self.iteration == iterations
            if self.writes and (ended or self.iteration % self.pace.show == 0):
                self.show()
            self.report(losses)
            if not ended and self.iteration % self.pace.keep == 0:
                self.keep()

    def keep(self) -> None:
        """Write the rows and then the state: surplus rows are cut off later, lacking rows would be lost."""
        if self.writes:
            self.rows.keep()
            self.state.write(self._packed())

    def write_picture(self, name: str, picture: bytes) -> None:
        """Write a PNG into the folder of pictures."""
        (self.folder / "pictures").mkdir(exist_ok=True)
        write_whole(self.folder / "pictures" / f"{name}.png", picture)

    def close(self, curves: bytes, recipe: str, command: Sequence[str], **facts: Any) -> None:
        """Write the curves of the losses, and at last the document that says what was learnt, from what and how."""
        write_whole(self.folder / "curves.png", curves)
        seconds = sum(float(row["seconds"]) for row in self.rows.rows)
        about = {"command": list(command), "recipe": recipe, **facts, "seconds": seconds, "versions": versions()}
        write_json(self.folder / DOCUMENT, about)

    def _timed(self) -> Losses:
        began = time.perf_counter()
        try:
            losses = self.iterate()
        except NotFinite as error:
            raise self._dumped(error) from error
        return losses | {"seconds": time.perf_counter() - began}

    def _packed(self, **about: Any) -> dict[str, Any]:
        parts = {name: part.state_dict() for name, part in self.parts().items()}
        return {"stage": self.stage, "iteration": self.iteration, **about, "parts": parts}

    def _dumped(self, error: NotFinite) -> ArithmeticError:
        """Return the error to raise, after the weights and the numbers of the pictures that led to it are written."""
        place = [self.stage, self.iteration] if self.stage else [self.iteration]
        dump = StateFile(self.folder / f"not_finite_{'_'.join(map(str, place))}.pt")
        first, count = self.iteration * self.batch(), self.batch()
        if self.writes:
            dump.write(self._packed(pictures=list(range(first, first + count))))
            self.rows.keep()
        stage = f"stage {self.stage}, " if self.stage else ""
        pictures = f"pictures {first} to {first + count - 1}" if count > 1 else f"picture {first}"
        text = f"{stage}iteration {self.iteration}, {pictures}: {error}; weights of that moment: {dump.path}"
        return ArithmeticError(text)


def require_finite(numbers: Mapping[str, float]) -> None:
    """Raise `NotFinite` with the names of the numbers that are NaN or infinite."""
    wrong = [name for name, x in numbers.items() if not abs(x) < float("inf")]
    if wrong:
        raise NotFinite(f"not finite: {', '.join(wrong)}")


def averaged(net: nn.Module, decay: float) -> AveragedModel | None:
    """Return an exponential moving average of the weights of a network, or None for a decay of 0."""
    if not decay:
        return None
    mean = get_ema_multi_avg_fn(decay)  # type: ignore[no-untyped-call]
    return AveragedModel(net, multi_avg_fn=mean)
