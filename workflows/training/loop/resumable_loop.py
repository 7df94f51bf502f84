"""The loop of every training; a stopped training continues from its last checkpoint with bit-identical results."""

from __future__ import annotations

import json
import time
from abc import ABC, abstractmethod
from collections.abc import Callable, Mapping, Sequence
from pathlib import Path
from typing import Any, Generic, Protocol, TypeVar

from torch import nn
from torch.optim.swa_utils import AveragedModel, get_ema_multi_avg_fn

from neusee.workflows.engine.provenance import timestamp, versions
from neusee.workflows.recipe.blocks.train_block import Training
from neusee.workflows.recipe.blocks.train_lift_block import LiftTraining
from neusee.workflows.report.run_crate import remove_crate, write_crate
from neusee.workflows.training.loop.checkpoint import Rows, StateFile, write_whole

Losses = dict[str, float]
Progress = Callable[[str], None]  #: takes one line of text about the progress of a training
Watch = Callable[[int, int, Mapping[str, float]], None]  #: takes the stage, its iterations so far, and the losses
DOCUMENT = "training.json"  #: the file that a training writes last


class NotFinite(ArithmeticError):
    """Error for a loss or a gradient that is NaN or infinite."""


class Learns(Protocol):
    """Interface of the objects that a training changes: networks, parameters and optimisers."""

    def parts(self) -> dict[str, Any]:
        """Return by name the objects whose state a checkpoint must contain."""


L = TypeVar("L", bound=Learns)


class ResumableLoop(ABC, Generic[L]):
    """A training loop that writes a checkpoint, a table of losses, pictures and a final document into a folder.

    Among several processes, only the process with ``writes`` writes files. A training without stages is in stage 0.
    """

    def __init__(
        self, folder: Path, settings: Training | LiftTraining, learner: L, columns: Sequence[str],
        progress: Progress, device: str, watch: Watch | None, writes: bool = True, inputs: str = "",
    ) -> None:  # fmt: skip
        self.folder, self.learner, self.progress, self.device = folder, learner, progress, device
        self.keep_every, self.show_every, self.watch, self.writes = settings.keep, settings.show, watch, writes
        self.rows, self.state = Rows(folder / "losses.csv", columns), StateFile(folder / "state.pt")
        self.stage, self.iteration, self.batch, self.began = 0, 0, 1, timestamp()
        self.inputs = inputs  #: digest of all that decides the training

    @abstractmethod
    def iterate(self) -> Losses:
        """Compute one training iteration and return the losses; raise `NotFinite` if a loss is NaN or infinite.

        `NotFinite` is raised for a gradient too, and always before the optimiser changes the weights.
        """

    @abstractmethod
    def show(self) -> None:
        """Write a picture that shows the output of the networks at the present iteration of the training."""

    def validate(self, iterations: int) -> Losses:
        """Return further numbers for the loss table after a number of iterations of the stage; most have none."""
        return {}

    @property
    def stops_early(self) -> bool:
        """Return True if the present stage ends before its last iteration."""
        return False

    def facts(self) -> dict[str, Any]:
        """Return what a checkpoint keeps beside stage, iteration, inputs and the learner; most trainings have none."""
        return {}

    def recall(self, facts: Mapping[str, Any]) -> None:
        """Take from a checkpoint what `facts` gave."""

    def begin_stage(self) -> None:
        """Prepare networks and optimisers for the present stage of the training."""

    def resume(self) -> None:
        """Continue a training from its checkpoint file, or begin at the first iteration if there is no checkpoint."""
        state = self.state.read(self.device)
        if state and state.get("inputs", self.inputs) != self.inputs:
            text = "was written for other inputs than those of this training, although its folder has their name"
            raise ValueError(f"{self.state.path} {text}: remove the folder to start again")
        self.stage, self.iteration = state.get("stage", self.stage), state.get("iteration", 0)
        self.begin_stage()
        if state:
            self.recall(state)
            for name, part in self.learner.parts().items():
                part.load_state_dict(state["parts"][name])
            self.rows.cut(self.stage, self.iteration, self.writes)
            self.progress(
                f"continues {f'in stage {self.stage} ' if self.stage else ''}after {self.iteration} iterations"
            )

    def run(self, iterations: int, batch: int) -> None:
        """Compute the remaining iterations of the present training stage; the caller saves the state at the end."""
        self.batch = batch
        if self.writes and self.iteration < iterations:
            remove_crate(self.folder)
        while self.iteration < iterations and not self.stops_early:
            began = time.perf_counter()
            try:
                losses = self.iterate()
            except NotFinite as error:
                raise self._dumped(error) from error
            losses |= self.validate(self.iteration + 1)
            losses["seconds"] = time.perf_counter() - began
            self.rows.add(self.stage, self.iteration, losses)
            self.iteration += 1
            ended = self.iteration == iterations or self.stops_early
            if self.writes and (ended or self.iteration % self.show_every == 0):
                self.show()
            self.note(losses)
            if not ended and self.iteration % self.keep_every == 0:
                self.keep()

    def note(self, losses: Losses) -> None:
        """Pass the losses of the last training iteration to the callback function ``watch``."""
        if self.watch is not None:
            self.watch(self.stage, self.iteration, losses)

    def keep(self) -> None:
        """Write the loss table of a training to disk, and then the checkpoint.

        In this order a killed process can leave surplus rows, which `resume` removes, but no missing rows.
        """
        if self.writes:
            self.rows.keep()
            self.state.write(self._packed())

    def write_picture(self, name: str, picture: bytes) -> None:
        """Write a PNG file into the folder ``pictures`` of a training."""
        (self.folder / "pictures").mkdir(exist_ok=True)
        write_whole(self.folder / "pictures" / f"{name}.png", picture)

    def close(self, curves: bytes, recipe: str, command: Sequence[str], **facts: Any) -> None:
        """Write the loss curves, and then the document with the settings and the results of the training."""
        remove_crate(self.folder)
        write_whole(self.folder / "curves.png", curves)
        seconds = sum(float(row["seconds"]) for row in self.rows.rows)
        about = {"command": list(command), "recipe": recipe, **facts, "seconds": seconds, "versions": versions()}
        text = json.dumps(about, indent=1, ensure_ascii=False) + "\n"
        write_whole(self.folder / DOCUMENT, text.encode())
        write_crate(self.folder, self.folder.name, about | {"began": self.began})

    def _packed(self, **about: Any) -> dict[str, Any]:
        parts = {name: part.state_dict() for name, part in self.learner.parts().items()}
        return {"stage": self.stage, "iteration": self.iteration, "inputs": self.inputs, **self.facts(), **about,
                "parts": parts}  # fmt: skip

    def _dumped(self, error: NotFinite) -> ArithmeticError:
        """Write the weights and the picture numbers that led to a NaN or infinite loss, and return the error."""
        place = [self.stage, self.iteration] if self.stage else [self.iteration]
        dump = StateFile(self.folder / f"not_finite_{'_'.join(map(str, place))}.pt")
        first, count = self.iteration * self.batch, self.batch
        if self.writes:
            dump.write(self._packed(pictures=list(range(first, first + count))))
            self.rows.keep()
        stage = f"stage {self.stage}, " if self.stage else ""
        pictures = f"pictures {first} to {first + count - 1}" if count > 1 else f"picture {first}"
        text = f"{stage}iteration {self.iteration}, {pictures}: {error}; the weights are in {dump.path}"
        return ArithmeticError(text)


def require_finite(numbers: Mapping[str, float]) -> None:
    """Raise `NotFinite` if a loss or another named number is NaN or infinite; the message gives its name."""
    wrong = [name for name, x in numbers.items() if not abs(x) < float("inf")]
    if wrong:
        raise NotFinite(f"these numbers are NaN or infinite: {', '.join(wrong)}")


def averaged(net: nn.Module, decay: float) -> AveragedModel | None:
    """Return an exponential moving average of the weights of a network, or None if ``decay`` is 0."""
    mean = get_ema_multi_avg_fn(decay)  # type: ignore[no-untyped-call]
    return AveragedModel(net, multi_avg_fn=mean) if decay else None
