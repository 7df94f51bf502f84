"""The command ``neusee train``: train the mask and the networks of a recipe."""

from __future__ import annotations

import json
import shlex
from collections.abc import Callable, Iterable, Iterator, Mapping
from contextlib import contextmanager
from enum import StrEnum
from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import typer

from neusee.workflows.cli import lazy_imports as lazy
from neusee.workflows.cli.command_frame import (
    AsJson,
    Debug,
    Out,
    ProgressLines,
    Quiet,
    Words,
    check_device,
    fail,
    failing,
    kept_training,
    load,
    progress_lines,
    refusing,
    resumable,
    say,
    say_json,
    the_store,
)
from neusee.workflows.cli.commands_and_exit_codes import FAILED
from neusee.workflows.keys.sealed_files import text_of

if TYPE_CHECKING:
    from neusee.workflows.graph.recipe_graph import Recipe


class Stages(StrEnum):
    """The choices of ``--stage``: which stages of the training run."""

    FIRST = "1"
    SECOND = "2"
    BOTH = "both"
    MASK = "mask"


_STAGES = (
    "1: mask and network; 2: network alone; both: 1, then 2; mask: mask alone, without images."
)
_LINES = 10  #: lines of progress for a stage, outside a terminal
#: the `stages` that `verbs.train` takes
_NUMBERS = {Stages.FIRST: (1,), Stages.SECOND: (2,), Stages.MASK: (0,)}


def train(
    words: Words = None,
    stage: Annotated[Stages, typer.Option("--stage", help=_STAGES)] = Stages.BOTH,
    device: Annotated[str, typer.Option("--device", help="Where to train: cpu or cuda.")] = "cpu",
    as_json: AsJson = False,
    quiet: Quiet = False,
    debug: Debug = False,
    out: Out = Path("runs"),
) -> None:
    """Train the mask of a recipe and its restoring network.

    Pictures come from the folder `train.photographs`; the paper trains in two stages. With --stage
    mask the mask is designed without images, as `train.mask` says; --stage 2 then trains the
    network behind that mask. The recipe `train_lift` trains a network from RGB to spectra instead.
    Without a name the recipe is train_small. Run the same command again to continue a training that
    was stopped.

    Several processes share one training: torchrun --nproc-per-node 8 --no-python neusee train
    RECIPE --device cuda.
    """
    recipe, command = load(words or ["train_small"], "train")
    if recipe.lifting is not None:
        _refuse_stage(recipe, stage)
        check_device(device)
        return _lift(recipe, command, out, device, quiet, as_json)

    device, (rank, process_count) = (
        lazy.process_mesh.device_here(device),
        lazy.process_mesh.processes(),
    )
    check_device(device)
    silent = quiet or as_json or rank > 0
    prefix = f"process {rank}: " if process_count > 1 else ""
    learnt = recipe.training.learnt if recipe.training else ()
    stages = _NUMBERS.get(stage, learnt)
    command += ["--stage", stage.value]
    lengths = _lengths(recipe, stages)
    with (
        resumable(lambda: kept_training(out, recipe.name)),
        failing(lazy.errors.RunError, ValueError, ArithmeticError, code=FAILED, before=prefix),
        failing(lazy.process_mesh.MeshError, before=prefix),
        refusing(),
        lazy.process_mesh.joined(device) as processes_here,
        _loss_bar(silent, lengths) as watch,
    ):
        folder = lazy.verbs.train(
            recipe,
            store=the_store(),
            device=device,
            out=out,
            progress=progress_lines(silent),
            command=command,
            stages=stages,
            watch=watch,
            mesh=processes_here,
        )
    if rank == 0:
        lines = [] if silent else _next(folder, stage)
        _say_results(folder, as_json, lines)
    return None


def _refuse_stage(recipe: Recipe, stage: Stages) -> None:
    """End the command for ``--stage`` with the training of a lift, which has no stages."""
    if stage is not Stages.BOTH:
        fail(f"{recipe.name} learns a lift, which has no stages: leave --stage out")


def _lengths(recipe: Recipe, stages: Iterable[int]) -> dict[int, int]:
    """Return the number of iterations of each stage, except the design of a mask."""
    if not recipe.training:
        return {}
    return {stage: recipe.training.stages[stage].iterations for stage in stages if stage}


def _say_results(folder: Path, as_json: bool, lines: list[str]) -> None:
    """Print ``lines`` and the folder of a training, or the document of the training as JSON."""
    if not as_json:
        return say([*lines, str(folder)])
    document_files = (folder / name for name in ("mask.json", "training.json"))
    documents = {path.stem: json.loads(text_of(path)) for path in document_files if path.is_file()}
    say_json({"folder": str(folder), **documents})
    return None


def _lift(
    recipe: Recipe, command: list[str], out: Path, device: str, quiet: bool, as_json: bool
) -> None:
    """Train the network of a recipe that reconstructs spectra from RGB."""
    assert recipe.lifting is not None
    lengths, silent = {0: recipe.lifting.iterations}, quiet or as_json
    with (
        resumable(lambda: kept_training(out, recipe.name)),
        failing(lazy.errors.RunError, ValueError, ArithmeticError, code=FAILED),
        refusing(),
        _loss_bar(silent, lengths) as watch,
    ):
        folder = lazy.verbs.train(
            recipe,
            store=the_store(),
            device=device,
            out=out,
            progress=progress_lines(silent),
            command=command,
            watch=watch,
        )
    weights = folder / "mst_plus_plus.safetensors"
    next_command = ["neusee", "run", "first_light", "lift=mst_plus_plus", f"lift.weights={weights}"]
    lines = [
        f"weights: {weights}",
        f"curves:  {folder / 'curves.png'}",
        f"judged:  {folder / 'training.json'}",
        f"next:    {shlex.join(next_command)}",
    ]
    if silent:
        lines = []
    _say_results(folder, as_json, lines)


def _next(folder: Path, stage: Stages) -> list[str]:
    """Return lines on the files that a training wrote, and on its page."""
    if stage is Stages.MASK:
        return [f"mask:    {folder / 'mask.safetensors'}", f"report:  {folder / 'report.html'}"]
    lines: list[str] = []
    mask, best = folder / "mask.safetensors", folder / "best.safetensors"
    if mask.is_file():
        lines.append(f"mask:    {mask}")
    if best.is_file():
        lines.append(f"best:    {best}")
    network, page = folder / "network.safetensors", folder / "training.html"
    return [*lines, f"network: {network}", f"report:  {page}"]


@contextmanager
def _loss_bar(
    quiet: bool, lengths: Mapping[int, int]
) -> Iterator[Callable[[int, int, Mapping[str, float]], None]]:
    """Show a progress bar on a terminal, and a line for each tenth of a stage elsewhere; yield a
    function for both.

    The function shows the losses of an iteration.
    """
    from rich.console import Console
    from rich.progress import (
        BarColumn,
        MofNCompleteColumn,
        Progress,
        TextColumn,
        TimeRemainingColumn,
    )

    columns = (
        TextColumn("{task.description}"),
        BarColumn(),
        MofNCompleteColumn(),
        TimeRemainingColumn(),
    )
    console = Console(stderr=True)
    is_hidden = quiet or not console.is_terminal
    bar = Progress(
        *columns, TextColumn("{task.fields[losses]}"), console=console, disable=is_hidden
    )
    lines = ProgressLines(quiet)
    titles = {stage: f"stage {stage}" if stage else "lift" for stage in lengths}
    tasks = {
        stage: bar.add_task(titles[stage], total=iterations, losses="")
        for stage, iterations in lengths.items()
    }

    def watch(stage: int, done: int, losses: Mapping[str, float]) -> None:
        names = [name for name in ("LSR", "L1", "critics", "MRAE", "RMSE") if name in losses]
        text = " ".join(f"{name} {losses[name]:.3g}" for name in names)
        bar.update(tasks[stage], completed=done, losses=text)
        if bar.disable and not quiet and done % max(1, lengths[stage] // _LINES) == 0:
            stage_text = f"stage {stage}, " if stage else ""
            lines(f"{stage_text}iteration {done} of {lengths[stage]}: {text}")

    with bar:
        yield watch
