"""Functions for use from Python: `neusee.run`, `sweep`, `train`, `evaluate`, `calibrate` and
`study`.

All functions have these options. ``changes`` change a recipe that is given by name or file: a
mapping like the values of `load` (``{"doe": "axicon", "sensor": {"read_noise": "20 e-"}}``), or
command-line arguments (``["doe=axicon"]``). ``store`` keeps results; None means ``$NEUSEE_CACHE``
or the default folder. The folder of results is made in ``out``. ``progress`` is called with a line
for each finished part. The report shows ``command``, which repeats the call.
"""

from __future__ import annotations

import os
from collections.abc import Callable, Iterable, Mapping, Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Any, Literal

from neusee.workflows.api import lazy_imports as lazy
from neusee.workflows.engine.runner import Result
from neusee.workflows.engine.runner import run as run_recipe
from neusee.workflows.graph.recipe_graph import Recipe
from neusee.workflows.recipe.loading import load
from neusee.workflows.recipe.text.overrides import Override, overrides_of
from neusee.workflows.report.run_folder import writable_folder
from neusee.workflows.report.study_report import Progress, silent
from neusee.workflows.store.remote_store import open_store
from neusee.workflows.studies import run_study
from neusee.workflows.sweeps.sweep_run import Sweep, SweepOptions
from neusee.workflows.sweeps.sweep_run import sweep as run_sweep

if TYPE_CHECKING:
    from neusee.workflows.engine.step_job import Executor
    from neusee.workflows.evaluation.pipelines import Pipeline
    from neusee.workflows.graph.recipe_graph import Event
    from neusee.workflows.store.result_store import Store
    from neusee.workflows.training.process_mesh import Mesh

Named = str | os.PathLike[str]  #: the name of a packaged recipe, or the path of a file
Changes = Mapping[str, Any] | Sequence[str]
Kind = Literal["accuracy", "stability", "leave-out", "calibration", "uncertainty", "protection"]

__all__ = ["calibrate", "evaluate", "run", "study", "sweep", "train"]


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
    """Run a recipe and return the results of the steps ``outputs``; None means the outputs that the
    recipe names.

    ``device`` names one or several devices, such as ``cuda:0,cuda:1,cpu``, the preferred one first.
    ``watch`` receives every `Event`. ``executor`` computes the steps in place of this process.
    ``memory`` is the largest number of bytes to use on each device.
    Raises: `RecipeError` before anything runs, `RunError` if a step fails, ValueError for an
    unknown output.
    """
    names = (outputs,) if isinstance(outputs, str) else outputs
    return run_recipe(
        _read(recipe, changes), store, names, watch, device=device, executor=executor, memory=memory
    )


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
    """Run a recipe at every combination of the parameter values in ``axes``, and return the results
    of all runs.

    ``axes`` maps a parameter or a group to a list of values, or to a text such as
    ``"linspace(450 nm, 650 nm, 5)"``. ``zip`` pairs the values of the axes instead of combining
    them. With ``on_error="continue"`` a failed point becomes a row.
    Raises: `RecipeError` with all mistakes of all points before anything runs, or the error of the
    first failed point.
    """
    return run_sweep(
        _name(recipe, "sweep"),
        axes,
        _arguments(changes),
        store,
        SweepOptions(paired=zip, on_error=on_error, device=device),
    )


def train(
    recipe: Recipe | Named,
    *,
    changes: Changes = (),
    store: Store | None = None,
    device: str = "cpu",
    out: Named = "runs",
    progress: Progress = silent,
    command: Sequence[str] = (),
    stages: Sequence[int] | None = None,
    watch: Callable[[int, int, Mapping[str, float]], None] | None = None,
    mesh: Mesh | None = None,
) -> Path:
    """Train the mask and the networks of a recipe, or continue a stopped training, and return the
    folder of results.

    In ``stages``, 1 trains mask and network, 2 the network alone, and 0 designs the mask without
    pictures; None means all stages of the recipe. ``watch`` is called with the stage (0 for a
    lift), its finished iterations and the losses. ``mesh`` has the processes of `torchrun`.
    Raises: ValueError, or its subclass `DesignError` or `MeshError`, for a recipe that cannot be
    trained; `NotFinite` if a loss is NaN or infinite.
    """
    recipe, folder, store = _read(recipe, changes), writable_folder(out), store or open_store()
    session = lazy.resumable_loop.TrainingSession(
        store, folder, progress, command, device, watch, mesh or lazy.process_mesh.ALONE
    )
    if recipe.lifting is not None:
        return lazy.lift_training.train_lift(recipe, session)
    if stages is None:
        stages = recipe.training.learnt if recipe.training else ()
    return lazy.run_training.train(recipe, session, tuple(stages))


def evaluate(
    recipe: Named,
    *,
    pipelines: str | Sequence[Pipeline] | None = None,
    changes: Changes = (),
    store: Store | None = None,
    device: str = "cpu",
    out: Named = "runs",
    progress: Progress = silent,
    command: Sequence[str] = (),
    data: Named | None = None,
    scenes: int | None = None,
    strengths: Sequence[float] | None = None,
    small: int = 256,
    reference: str = "",
    equal_protection: float | None = None,
    by: str | None = None,
) -> Path:
    """Compare masks and restorers on the same scenes and laser strengths, and return the folder of
    results.

    An argument that is None has the value of the recipe's block ``evaluate``, such as all
    photographs in ``paper_protocol``.

    ``pipelines`` names a mask and a restorer each, such as ``"flat+none, five_half_rings+wiener"``.
    ``data`` is a folder of photographs; None means the recipe's own scene. ``scenes`` is the number
    of scenes, else 20. ``strengths`` are those of the laser in multiples of saturation; None means
    the strengths in the paper. ``small`` is the shorter side in pixels of reduced pictures, which
    are compared too. ``reference`` is the pipeline with which all others are compared.
    ``equal_protection`` is the peak of a laser relative to that of the plain lens, to which filters
    and stops bring every pipeline; ``by`` is ``best``, ``filter`` or ``stop``.
    Raises: `EvaluationRefused` with every mistake before anything runs, `RunError` if a step fails.
    """
    run_evaluation = lazy.run_evaluation
    named = run_evaluation.NamedRecipe(_name(recipe, "evaluate"), _arguments(changes), Path.cwd())
    asked = run_evaluation.AskedCamera.of(named, store or open_store(), progress)
    question = run_evaluation.EvaluationQuestion(
        **run_evaluation.options_of(asked, pipelines, scenes, reference, equal_protection, by),
        data=None if data is None else Path(data).expanduser(),
        strengths=run_evaluation.STRENGTHS if strengths is None else tuple(strengths),
        small=small,
    )
    return run_evaluation.evaluate(
        asked, question, runs=writable_folder(out), command=command, device=device
    )


def calibrate(
    recipe: Recipe | Named,
    *,
    changes: Changes = (),
    store: Store | None = None,
    out: Named = "runs",
    progress: Progress = silent,
    command: Sequence[str] = (),
    walkers: int = 64,
    move: str = "de",
    draws: int = 1000,
) -> Path:
    """Estimate the posterior of a recipe's sensor, or continue a stopped calibration, and return
    the folder of results.

    ``walkers`` is the number of walkers in each of the four ensembles, ``move`` the move of the
    walkers, ``"de"`` or ``"stretch"``, and ``draws`` the least number of independent draws.
    Raises: `CalibrationRefused` if the levels constrain the sensor too little, ValueError for a
    recipe without a likelihood.
    """
    recipe, store = _read(recipe, changes), store or open_store()
    options = lazy.run_calibration.CalibrationOptions(walkers, move, draws)
    return lazy.run_calibration.calibrate(
        recipe, store, writable_folder(out), command, progress, options
    )


def study(
    recipe: Recipe | Named,
    *,
    kind: Kind,
    changes: Changes = (),
    store: Store | None = None,
    out: Named = "runs",
    progress: Progress = silent,
    command: Sequence[str] = (),
    **options: Any,
) -> Path:
    """Study how accurate the numbers of a recipe are, or continue a stopped study, and return the
    folder of results.

    ``kind`` is ``"accuracy"``, ``"stability"``, ``"leave-out"``, ``"calibration"``,
    ``"uncertainty"`` or ``"protection"``. ``options`` are the options of this kind, as ``neusee
    study KIND --help`` lists them.
    Raises: ValueError for an unknown kind or an unsuitable recipe, `RunError` if a step fails.
    """
    if kind not in run_study.KINDS:
        raise ValueError(f"there is no study {kind!r}: write one of {', '.join(run_study.KINDS)}")
    return run_study.study_recipe(
        kind, _read(recipe, changes), store, writable_folder(out), command, progress, **options
    )


def _read(recipe: Recipe | Named, changes: Changes) -> Recipe:
    """Return a loaded recipe unchanged, or load the recipe that a name or file gives with
    ``changes``.
    """
    if not isinstance(recipe, Recipe):
        return load(recipe, _arguments(changes))
    if changes:
        raise TypeError(
            f"{recipe.name} is loaded already: pass the name of the recipe, or pass the changes to"
            " `load`"
        )
    return recipe


def _name(recipe: Named, verb: str) -> str:
    """Return the name or file of a recipe for the function ``verb``; raise TypeError for a
    loaded recipe.
    """
    if isinstance(recipe, Recipe):
        raise TypeError(
            f"{verb} loads the recipe several times: pass the name or file of the recipe, and"
            " changes"
        )
    return os.fspath(recipe)


def _arguments(changes: Changes) -> list[str | Override]:
    """Return ``changes`` of a recipe as overrides for `load`; raise TypeError if ``changes`` is
    a string.
    """
    if isinstance(changes, str):
        raise TypeError(
            f"changes must be a mapping or a list of arguments: write changes=[{changes!r}]"
        )
    return [*overrides_of(changes, Path.cwd())] if isinstance(changes, Mapping) else [*changes]
