"""Tests of the frames of a calibration before any likelihood, and what follows from these tests for the posterior."""

from __future__ import annotations

import math
from collections.abc import Container, Iterable, Iterator, Sequence
from dataclasses import asdict, replace
from typing import TYPE_CHECKING, Any

import torch

from neusee.nodes.calibrate import (
    Correction,
    FrameTest,
    Hidden,
    Stack,
    coarse,
    corrections,
    descriptor_frames,
    inspect_frames,
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
        return inspect_frames(_stacks(recipe, store, steps), exact)
    source = str(weighing.wires[weighing.node.inputs[0]])
    levels = run(recipe, store, (source,)).values[source]
    dark = levels.variance[levels.photons == 0] if isinstance(levels, Levels) else torch.zeros(0)
    return [coarse(float(dark.min()), exact)] if len(dark) else []


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
            (source,) = step.sources
            frames = run(recipe, store, (source,)).values[source]
            yield Stack(step.name, step.params["photons"], step.params["exposure"], scatter, frames)
        elif step.node.path == "calibrate.descriptor":
            for name, photons, exposure, frames in descriptor_frames(step.params["file"]):
                yield Stack(name, photons, exposure, scatter, frames)


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
    """Return what faults that the frames have or may hide change, as a check that cannot fail; none without frames."""
    found = hidden_faults(tests, may_hide)
    if not found:
        return []
    words = (f"{name} by {100 * x.mean:+.2g} % ± {100 * x.sd:.2g} %" for name, x in corrections(found).items() if x.sd)
    faults = " and ".join(sorted({h.fault for h in found}))
    bar = "more pixels hide less; a fault that the camera cannot have is `none` in the step of the priors"
    return [Check(f"intervals include {faults}", f"{' and '.join(words)}, as the frames show or may hide", bar, "pass")]


def _bar(test: FrameTest) -> str:
    return f"{abs(test.number):.3g}, {'at least' if test.limit < 0 else 'at most'} {abs(test.limit):.3g}"


def frame_section(tests: Sequence[FrameTest]) -> Section:
    """Return the section of a calibration's page with the tests of its frames."""
    text = """Each test asks if the frames are such as the likelihood describes. Modelled: the likelihood describes it,
        or the posterior is corrected by what the frames show, with the uncertainty of this correction.
        Widened: the intervals include the error that may follow. Refused: the error may exceed 2 %, or is unknown.
        Numbers and limits of noise and patterns are in standard deviations of chance; all tests together fail for
        frames without fault in less than 2 % of all measurements (1 of 400)."""
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
    """Return the draws of a posterior, changed by the faults that frames have or may hide, as independent draws.

    A change of the gain changes all values in electrons inversely.
    """
    hidden, shifts = hidden_faults(tests, problem.coordinates.prior.may_hide), relative_shifts(tests)
    if not hidden and max(shifts.values()) < _SMALL:
        return chains
    generator, count = torch.Generator().manual_seed(seed), chains.log.size
    drawn = [each.draw(count, generator) for each in hidden]
    normal = torch.randn(2, count, generator=generator, dtype=torch.float64)
    drawn.append((shifts["gain"] * normal[0], shifts["noise"] * normal[1]))
    gain, noise = (torch.stack(each).sum(0).view(chains.log.shape) for each in zip(*drawn, strict=True))
    values = problem.parameters(chains.draws)
    if "gain" in values:
        values["gain"] = values["gain"] * gain.exp()
        values |= {name: values[name] * (-gain).exp() for name in _IN_ELECTRONS if name in values}
    values |= {name: values[name] * noise.exp() for name in _NOISES if name in values}
    return replace(chains, draws=problem.theta(values))


def widened_models(
    models: Iterable[ModelSpread], tests: Sequence[FrameTest], may_hide: Container[str]
) -> list[ModelSpread]:
    """Return the intervals to report with the changes by faults that frames have or may hide."""
    change = changes_by_faults(tests, may_hide)
    return [replace(m, stated=wider(m.stated, *reversed(change[m.name]))) if m.name in change else m for m in models]


def changes_by_faults(tests: Iterable[FrameTest], may_hide: Container[str]) -> dict[str, Correction]:
    """Return the change of the logarithm that faults of the frames cause or may cause, by the parameter."""
    tests = list(tests)
    found, shifts = corrections(hidden_faults(tests, may_hide)), relative_shifts(tests)
    gain, noise = (Correction(found[n].mean, math.hypot(found[n].sd, shifts[n])) for n in ("gain", "noise"))
    electrons = Correction(-gain.mean, gain.sd)
    both = Correction(noise.mean - gain.mean, math.hypot(gain.sd, noise.sd))
    return {"gain": gain, **dict.fromkeys(_IN_ELECTRONS, electrons), **dict.fromkeys(_NOISES, both)}


def wider(interval: IntervalEstimate, shift: float, moved: float = 0.0) -> IntervalEstimate:
    """Return an interval of a positive value with a further relative standard deviation, its logarithm ``moved``."""
    if shift < _SMALL:
        return interval
    value = interval.value * math.exp(moved)
    factors = [
        math.exp(math.hypot(math.log(interval.value / end), Z_90 * shift)) for end in (interval.low, interval.high)
    ]
    return IntervalEstimate(value, value / factors[0], value * factors[1])
