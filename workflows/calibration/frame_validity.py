"""Tests of the frames of a calibration before any likelihood, and what follows from these tests for the posterior."""

from __future__ import annotations

import math
from collections.abc import Container, Iterable, Iterator, Sequence
from dataclasses import asdict, replace
from typing import TYPE_CHECKING, Any

import torch

from neusee.nodes.calibrate import (
    CLEAN_PAIRS,
    FrameTest,
    Hidden,
    Stack,
    coarse,
    descriptor_frames,
    inspect_frames,
    open_errors,
)
from neusee.nodes.values import Levels
from neusee.workflows.calibration.log_posterior import SensorPosterior, only_step
from neusee.workflows.calibration.model_spread import IntervalEstimate, ModelSpread
from neusee.workflows.calibration.posterior_checks import Check
from neusee.workflows.engine.runner import run
from neusee.workflows.graph.recipe_graph import Recipe, Step
from neusee.workflows.recipe.distributions.joint import Z_90
from neusee.workflows.report.study_page import Mark, Section
from neusee.workflows.store.result_store import Store

if TYPE_CHECKING:
    from neusee.workflows.calibration.emcee_sampler import Chains

_MARKS: dict[str, Mark] = {"passed": "pass", "modelled": "pass", "widened": "warn", "refused": "fail"}
_NOISES = ("read_noise", "temporal_dark_noise")
_IN_ELECTRONS = (*_NOISES, "offset", "dark_current", "full_well", "quantum_efficiency")  #: inversely to the gain
_SMALL = 1e-5  #: relative error below which no interval is widened
_LIKELIHOODS = ("calibrate.density", "calibrate.camera", "calibrate.stray_light")


def inspect_recipe(recipe: Recipe, store: Store) -> list[FrameTest]:
    """Return the tests of the frames that the likelihood of a recipe describes; none for a picture of a point source.

    Of a table of moments only the dark noise is tested.
    """
    weighing = only_step(recipe, *_LIKELIHOODS)
    if weighing.node.path == "calibrate.stray_light":
        return []
    steps = list(_upstream(recipe, weighing))
    exact = weighing.node.path == "calibrate.density"
    if any(step.node.path in ("calibrate.reduce", "calibrate.descriptor") for step in steps):
        return inspect_frames(_stacks(recipe, store, steps), exact, _share(weighing, steps))
    source = str(weighing.wires[weighing.node.inputs[0]])
    levels = run(recipe, store, (source,)).values[source]
    dark = levels.variance[levels.photons == 0] if isinstance(levels, Levels) else torch.zeros(0)
    return [coarse(float(dark.min()), exact)] if len(dark) else []


def _share(weighing: Step, steps: Sequence[Step]) -> float | None:
    """Return the share of saturation above which the likelihood leaves levels out, or None if it uses all levels."""
    reduced = next((step for step in steps if step.node.path == "calibrate.sufficient"), weighing)
    share = reduced.params.get("share")
    return None if share is None else float(share)


def _upstream(recipe: Recipe, step: Step) -> Iterator[Step]:
    """Yield all steps on which a step depends, in the order of the recipe."""
    names, new = set[str](), [step.name]
    while new:
        sources = recipe.steps[new.pop()].sources
        new += [name for name in sources if name not in names]
        names.update(sources)
    return (each for name, each in recipe.steps.items() if name in names)


def _stacks(recipe: Recipe, store: Store, steps: Sequence[Step]) -> Iterator[Stack]:
    for step in steps:
        scatter: Any = step.params.get("scatter")
        if step.node.path == "calibrate.reduce":
            light = step.params["photons"], step.params["exposure"]
            yield Stack(step.name, *light, scatter, *frames_and_mask(recipe, store, step))
        elif step.node.path == "calibrate.descriptor":
            for name, photons, exposure, frames in descriptor_frames(step.params["file"]):
                yield Stack(name, photons, exposure, scatter, frames)


def frames_and_mask(recipe: Recipe, store: Store, step: Step) -> tuple[torch.Tensor, torch.Tensor | None]:
    """Return the frames that a step of `calibrate.reduce` receives, and the mask of its hot pixels if it has one."""
    source, mask = str(step.wires["frames"]), step.wires.get("mask")
    values = run(recipe, store, (source, str(mask)) if mask else (source,)).values
    return values[source], values[str(mask)] if mask else None


def lines(tests: Sequence[FrameTest]) -> Iterator[str]:
    """Yield a line for each test of frames that has something to say, and one for all that passed."""
    passed = [test for test in tests if test.verdict == "passed"]
    for test in tests:
        if test.verdict != "passed":
            yield f"frames, {test.verdict}: {test.name}: {test.sentence}"
    if tests:
        yield f"frames: {len(passed)} of {len(tests)} tests passed"


def frame_checks(tests: Sequence[FrameTest], given: bool = True) -> list[Check]:
    """Return each test of frames as a check of the posterior, which fails if the frames are refused."""
    found = [Check(t.name, f"{t.verdict}: {t.sentence}", _bar(t), _MARKS[t.verdict]) for t in tests]
    if len(tests) < 2 and given:
        text = "only moments are given: noise, patterns and numbers of the frames are not tested"
        found.append(Check("the frames are tested", text, "frames in the recipe", "warn"))
    return found


def hidden_checks(tests: Sequence[FrameTest], may_hide: Container[str]) -> list[Check]:
    """Return what faults that the frames have or may hide leave open, as a check that cannot fail."""
    hidden = hidden_faults(tests, may_hide)
    if not hidden:
        return []
    words = [f"{name} by {100 * size:.2g} %" for name, size in open_errors(hidden).items() if size]
    faults = " and ".join(sorted({fault.fault for fault in hidden}))
    bar = "more pixels hide less; a fault that the camera cannot have is `none` in the step of the priors"
    text = f"{' and '.join(words)}, which the frames show or may hide; nothing is corrected"
    return [Check(f"intervals include {faults}", text, bar, "pass")]


def data_check(pairs: float) -> Check:
    """Return if the frames have the least data of a clean statement, as a check that warns.

    ``pairs`` is the number of pairs of pixels in the lit levels that the fit uses.
    """
    side = 10 * math.ceil(math.sqrt(CLEAN_PAIRS / 10) / 10)
    text = f"{pairs:.3g} pairs of pixels in the lit levels of the fit"
    enough = pairs >= CLEAN_PAIRS
    if not enough:
        text += ": intervals are wider than by statistics alone, because so few may hide mixing and lag"
    bar = f"at least {CLEAN_PAIRS:.2g}, such as 10 levels of 2 frames of {side} x {side} pixels"
    return Check("the frames are numerous enough", text, bar, "pass" if enough else "warn")


def _bar(test: FrameTest) -> str:
    return f"{abs(test.number):.3g}, {'at least' if test.limit < 0 else 'at most'} {abs(test.limit):.3g}"


def frame_section(tests: Sequence[FrameTest]) -> Section:
    """Return the section of a calibration's page with the tests of its frames."""
    text = """Each test asks if the frames are such as the likelihood describes. Modelled: the likelihood describes it.
        Widened: the intervals include the error that may follow, and no value is corrected. Refused: the error may
        exceed 2 %, or is unknown. Only levels that the fit uses are tested.
        Numbers and limits of noise and patterns are in standard deviations of chance; all tests together fail for
        frames without fault in less than 2 % of all measurements."""
    if len(tests) < 2:
        text = "Only moments are given, so that noise, patterns and numbers of the frames are not tested."
    rows = [(t.name, abs(t.number), abs(t.limit), t.verdict, t.sentence) for t in tests]
    marks: dict[tuple[int, int], Mark] = {(i, 3): _MARKS[t.verdict] for i, t in enumerate(tests)}
    return Section("The frames", text, ("test", "number", "limit", "verdict", "what it says"), rows, marks=marks)


def as_rows(tests: Iterable[FrameTest]) -> list[dict[str, Any]]:
    """Return the tests of frames as mappings for a JSON file."""
    return [asdict(test) for test in tests]


def hidden_faults(tests: Iterable[FrameTest], may_hide: Container[str]) -> list[Hidden]:
    """Return the faults that change gain and noise: those that a test found, and those that ``may_hide`` from it."""
    return [h for test in tests for h in test.hidden if test.verdict != "passed" or h.fault in may_hide]


def relative_shifts(tests: Iterable[FrameTest]) -> dict[str, float]:
    """Return the relative standard deviations of gain and of dark noise in DN that the tests of frames leave open."""
    tests = list(tests)
    return {name: math.hypot(*(t.shifts.get(name, 0.0) for t in tests), 0.0) for name in ("gain", "noise")}


def widened(problem: SensorPosterior, chains: Chains, tests: Sequence[FrameTest], seed: int) -> Chains:
    """Return the draws of a posterior with the errors that frames leave open, as independent normal draws.

    An error of the gain changes all values in electrons inversely. No mean is changed.
    """
    errors = open_by_tests(tests, problem.coordinates.prior.may_hide)
    if max(errors.values()) < _SMALL:
        return chains
    generator = torch.Generator().manual_seed(seed)
    normal = torch.randn(2, chains.log.size, generator=generator, dtype=torch.float64)
    gain, noise = (errors[n] * x.view(chains.log.shape) for n, x in zip(("gain", "noise"), normal, strict=True))
    values = problem.parameters(chains.draws)
    if "gain" in values:
        values["gain"] = values["gain"] * gain.exp()
        values |= {name: values[name] * (-gain).exp() for name in _IN_ELECTRONS if name in values}
    values |= {name: values[name] * noise.exp() for name in _NOISES if name in values}
    return replace(chains, draws=problem.theta(values))


def widened_models(
    models: Iterable[ModelSpread], tests: Sequence[FrameTest], may_hide: Container[str]
) -> list[ModelSpread]:
    """Return the intervals to report with the errors that the frames leave open."""
    errors = errors_of_parameters(tests, may_hide)
    return [replace(m, stated=wider(m.stated, errors[m.name])) if m.name in errors else m for m in models]


def open_by_tests(tests: Iterable[FrameTest], may_hide: Container[str]) -> dict[str, float]:
    """Return the relative standard deviations of gain and of dark noise in DN that tests and hidden faults leave."""
    tests = list(tests)
    hidden, shifts = open_errors(hidden_faults(tests, may_hide)), relative_shifts(tests)
    return {name: math.hypot(hidden[name], shifts[name]) for name in ("gain", "noise")}


def errors_of_parameters(tests: Iterable[FrameTest], may_hide: Container[str]) -> dict[str, float]:
    """Return the relative standard deviation that the frames leave open, by the parameter."""
    errors = open_by_tests(tests, may_hide)
    gain, noise = errors["gain"], math.hypot(errors["gain"], errors["noise"])
    return {"gain": gain, **dict.fromkeys(_IN_ELECTRONS, gain), **dict.fromkeys(_NOISES, noise)}


def wider(interval: IntervalEstimate, shift: float) -> IntervalEstimate:
    """Return an interval of a positive value with a further relative standard deviation."""
    if shift < _SMALL:
        return interval
    factors = [
        math.exp(math.hypot(math.log(interval.value / end), Z_90 * shift)) for end in (interval.low, interval.high)
    ]
    return IntervalEstimate(interval.value, interval.value / factors[0], interval.value * factors[1])
