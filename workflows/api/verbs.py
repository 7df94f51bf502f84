"""The verbs of `neusee`: a recipe or its name first, then options by name, the same words in every verb.

``changes`` are those of a recipe that is given by name or file: a mapping as `load` takes it
(``{"doe": "axicon", "sensor": {"read_noise": "20 e-"}}``), or arguments as on the command line
(``["doe=axicon"]``). ``store`` is where results are kept: ``$NEUSEE_CACHE``, or the usual
folder, if None. ``out`` is the folder in which a folder of results is made. ``tell`` is given
one line for each thing that is done, and ``command`` is what the page says to run it again.
"""

from __future__ import annotations

import os
from collections.abc import Callable, Iterable, Mapping, Sequence
from functools import partial
from pathlib import Path
from typing import TYPE_CHECKING, Any, Literal

from neusee.workflows.graph.recipe_graph import Recipe
from neusee.workflows.recipe.loading import load
from neusee.workflows.recipe.text.overrides import Override
from neusee.workflows.recipe.text.python_overrides import overrides_of
from neusee.workflows.store.remote_store import open_store

if TYPE_CHECKING:
    from neusee.workflows.engine.runner import Result
    from neusee.workflows.engine.step_job import Executor
    from neusee.workflows.evaluation.pipelines import Pipeline
    from neusee.workflows.graph.step_record import Event
    from neusee.workflows.store.result_store import Store
    from neusee.workflows.sweeps.sweep_run import Sweep
    from neusee.workflows.training.parallel.process_mesh import Mesh

Named = str | os.PathLike[str]  #: a packaged recipe's name, or a file
Changes = Mapping[str, Any] | Sequence[str]
Tell = Callable[[str], None]
Kind = Literal["accuracy", "stability", "leave-out", "calibration", "uncertainty"]

__all__ = ["calibrate", "evaluate", "run", "study", "sweep", "train"]


def _silent(line: str) -> None:
    """Say nothing."""


def run(
    recipe: Recipe | Named,
    *,
    changes: Changes = (),
    store: Store | None = None,
    device: str = "cpu",
    outputs: str | Iterable[str] | None = None,
    watch: Callable[[Event], None] | None = None,
    executor: Executor | None = None,
    memory: int | None = None,
) -> Result:
    """Run a recipe and return the values of ``outputs``, the recipe's own if None.

    Args: device: one or several, ``cuda:0,cuda:1,cpu``, the preferred one first. watch: is given every `Event`.
    executor: computes instead of this process. memory: bytes of each device that may be planned with.
    Raises: `RecipeError` before anything runs, `RunError` where a step fails, ValueError for an unknown output.
    """
    wanted = (outputs,) if isinstance(outputs, str) else outputs
    return _read(recipe, changes).run(store, wanted, watch, device, executor, memory)


def sweep(
    recipe: Named,
    *,
    axes: Mapping[str, str | Iterable[Any]],
    changes: Changes = (),
    store: Store | None = None,
    device: str = "cpu",
    zip: bool = False,
    on_error: Literal["stop", "continue"] = "stop",
) -> Sweep:
    """Run a recipe over every combination of the values of ``axes`` and return the table of all numbers.

    Args: axes: a list of values by parameter or group, or a text such as ``"linspace(450 nm, 650 nm, 5)"``.
    zip: pair the values of the axes instead of combining them. on_error: ``"continue"`` keeps a failed point as a row.
    Raises: `RecipeError` with every mistake of every point before anything runs, the error of the first failed point.
    """
    from neusee.workflows.sweeps.sweep_run import sweep as run_sweep

    return run_sweep(_name(recipe, "sweep"), axes, _arguments(changes), zip, store, on_error, device)


def train(
    recipe: Recipe | Named,
    *,
    changes: Changes = (),
    store: Store | None = None,
    device: str = "cpu",
    out: Named = "runs",
    tell: Tell = _silent,
    command: Sequence[str] = (),
    stages: Sequence[int] | None = None,
    watch: Callable[[int, int, Mapping[str, float]], None] | None = None,
    mesh: Mesh | None = None,
) -> Path:
    """Learn the mask and the restoration of a recipe, or its lift, and return the folder; go on where one was stopped.

    Args: stages: 1 learns mask and network, 2 the network, 0 designs the mask without pictures; all that the recipe
    names if None. watch: is given the stage, its iterations so far and the losses. mesh: the processes of `torchrun`.
    Raises: ValueError for a recipe that cannot be learnt, `DesignError` or `MeshError` among them; `NotFinite` where a
    loss is NaN or infinite.
    """
    found, place = _read(recipe, changes), Path(out)
    store = store or open_store()
    if found.lifting is not None:
        from neusee.workflows.training.lift.lift_run import train_lift

        return train_lift(found, store, place, command, tell, device, watch and partial(watch, 1))
    from neusee.workflows.training.parallel.process_mesh import ALONE
    from neusee.workflows.training.run_training import train as learn

    numbers = stages if stages is not None else found.training.learnt if found.training else ()
    return learn(found, store, place, command, tell, tuple(numbers), device, watch, mesh or ALONE)


def evaluate(
    recipe: Named,
    *,
    pipelines: str | Sequence[Pipeline],
    changes: Changes = (),
    store: Store | None = None,
    device: str = "cpu",
    out: Named = "runs",
    tell: Tell = _silent,
    command: Sequence[str] = (),
    data: Named | None = None,
    scenes: int = 20,
    strengths: Sequence[float] | None = None,
    small: int = 256,
    reference: str = "",
) -> Path:
    """Judge masks and restorers on the same scenes and laser strengths, and return the folder of the results.

    Args: pipelines: ``"flat+none, five_half_rings+wiener"``. data: a folder of photographs; the recipe's own scene if
    None. scenes: how many. strengths: of the laser, multiples of saturation; those of the paper if None. small: shorter
    side, in pixels, of the pictures that are compared a second time. reference: the pipeline to compare with.
    Raises: `Refused` with every mistake before anything runs, `RunError` where a step fails.
    """
    from neusee.workflows.evaluation import run_evaluation as protocol

    here, name, arguments = Path.cwd(), _name(recipe, "evaluate"), _arguments(changes)
    read = protocol.read_pipelines(pipelines, here) if isinstance(pipelines, str) else pipelines
    return protocol.evaluate(
        name,
        read,
        arguments,
        data=None if data is None else Path(data).expanduser(),
        count=scenes,
        strengths=protocol.STRENGTHS if strengths is None else strengths,
        small=small,
        reference=reference,
        store=store,
        runs=Path(out),
        command=command,
        tell=tell,
        device=device,
        folder=here,
    )


def calibrate(
    recipe: Recipe | Named,
    *,
    changes: Changes = (),
    store: Store | None = None,
    out: Named = "runs",
    tell: Tell = _silent,
    command: Sequence[str] = (),
    walkers: int = 64,
    move: str = "de",
    draws: int = 1000,
) -> Path:
    """Find the posterior of a recipe's sensor from its levels, and return the folder; go on where one was stopped.

    Args: walkers: of each of the four ensembles. move: how walkers move, ``"de"`` or ``"stretch"``. draws: how many
    independent ones there are at least.
    Raises: `Refused` where the levels tell too little, ValueError for a recipe that does not calibrate.
    """
    from neusee.workflows.calibration.run_calibration import calibrate as found

    place = Path(out)
    read = _read(recipe, changes)
    return found(read, store or open_store(), place, command, tell, walkers=walkers, move=move, draws=draws)


def study(
    recipe: Recipe | Named,
    *,
    kind: Kind,
    changes: Changes = (),
    store: Store | None = None,
    out: Named = "runs",
    tell: Tell = _silent,
    command: Sequence[str] = (),
    **options: Any,
) -> Path:
    """Study what the numbers of a recipe are worth, and return the folder of the results; go on where one was stopped.

    Args: kind: ``"accuracy"``, ``"stability"``, ``"leave-out"``, ``"calibration"`` or ``"uncertainty"``. options: of
    that kind, as ``neusee study KIND --help`` lists them.
    Raises: ValueError for an unknown kind or a recipe that the study does not fit, `RunError` where a step fails.
    """
    from neusee.workflows.studies import run_study

    if kind not in run_study.KINDS:
        raise ValueError(f"no study {kind!r}: there are {', '.join(run_study.KINDS)}")
    return run_study.made(kind, _read(recipe, changes), store, Path(out), command, tell, **options)


def _read(recipe: Recipe | Named, changes: Changes) -> Recipe:
    """Return the recipe, read if it is given by name or file."""
    if not isinstance(recipe, Recipe):
        return load(recipe, _arguments(changes))
    if changes:
        raise TypeError(f"{recipe.name} is read already: give its name with changes, or change it in `load`")
    return recipe


def _name(recipe: Named, verb: str) -> str:
    """Return the name or file of a recipe that a verb reads anew with each change."""
    if isinstance(recipe, Recipe):
        raise TypeError(
            f"{verb} reads the recipe anew for each point: give its name or file, and what differs as changes"
        )
    return os.fspath(recipe)


def _arguments(changes: Changes) -> list[str | Override]:
    """Return changes as the reader of a recipe takes them."""
    if isinstance(changes, str):
        raise TypeError(f"changes are a mapping or a list of arguments: write changes=[{changes!r}]")
    return [*overrides_of(changes, Path.cwd())] if isinstance(changes, Mapping) else [*changes]
