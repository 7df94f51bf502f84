"""Pattern of damage on the sensor: the spot over the limit, and the dead pixels."""

from __future__ import annotations

import math
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass, replace
from typing import TYPE_CHECKING, Any

import numpy as np
import torch

from neusee.nodes.laser import KINDS, SpotDamage, damaged_pixels, heated_spot
from neusee.workflows.engine.runner import run
from neusee.workflows.graph.errors import Diagnostic, RecipeError
from neusee.workflows.graph.recipe_graph import Recipe, unknown_step
from neusee.workflows.recipe.blocks.safety_block import Safety
from neusee.workflows.recipe.distributions.shapes import FloatArray
from neusee.workflows.safety.exposures import Exposures, Option
from neusee.workflows.store.result_store import Store

if TYPE_CHECKING:
    from neusee.workflows.safety.safety_estimate import Finding


# --- damage pattern -------------------------------------------------------------------------------

# Exposure in the spot of a laser, behind lens and mask, divided by the damage limit of the sensor.


#: name of each protection, by the key of its spot in the settings
OPTIONS = {"plain": "plain lens", "mask": "mask"}
#: fractions of the peak: a picture is cut where the spot is fainter than this on all sides; the
#: fraction used lies between the two and depends on the ratio of exposure to limit
_FAINT, _DIM = 1e-4, 0.03
_LEAST_HALF_SAMPLES = 12  #: samples from the peak to each edge of a picture, at least


@dataclass(frozen=True)
class Spot:
    """The spot (PSF) of a laser behind one protection, normalised to a brightest sample of 1."""

    option: str
    light: FloatArray  #: (y, x)
    pitch: float  #: m
    heated: float  #: m, 1/e2 diameter of a Gaussian spot of equal peak that heats at least as much


@dataclass(frozen=True)
class DamagePattern:
    """The exposure in the spot of a laser, divided by the limit of one kind of damage."""

    option: str
    limit: str
    ratio: FloatArray  #: (y, x) exposure over limit, cropped to the bright part of the spot
    width: float  #: m, of the cropped picture
    peak: float
    #: um2, area where the limit is exceeded, in the whole window and not only the cropped part
    area: float


def spots_of(recipe: Recipe, safety: Safety, store: Store | None) -> tuple[Spot, ...]:
    """Return the spots of the steps named in the settings; raise `RecipeError` for a step that does
    not exist.
    """
    named_steps = {
        name: step for name, step in safety.settings.protection.spots if step is not None
    }
    steps = {
        name: step_of(recipe, safety, f"protection.spots.{name}", step, name)
        for name, step in named_steps.items()
    }
    results: Any = run(recipe, store, list(steps.values())) if steps else {}
    return tuple(
        _spot(OPTIONS[name], results[step].intensity, recipe.steps[step].params)
        for name, step in steps.items()
    )


def step_of(recipe: Recipe, safety: Safety, setting: str, step: str, arm: str) -> str:
    """Return the full name of a step, which may end in the protection and the laser, as in
    ``psf[mask,pointer]``.

    Raises `RecipeError` at the setting for a step that does not exist.
    """
    full_name = next(
        (name for name in (step, f"{step}[{arm},{safety.name}]") if name in recipe.steps), None
    )
    if full_name is None:
        value = safety.values[setting]
        raise RecipeError([Diagnostic(value.mark, value.name, unknown_step(step, recipe.steps))])
    return full_name


def _spot(option: str, intensity: FloatArray, params: Mapping[str, float]) -> Spot:
    """Return the spot of a PSF (band, y, x), summed over its bands; ``params["pixel_pitch"]`` is
    the pitch of its samples in m.
    """
    light, pitch = np.asarray(intensity, np.float64).sum(0), params["pixel_pitch"]
    # light outside the window heats the sensor too
    heated = heated_spot(torch.from_numpy(light), pitch, lost=max(0.0, 1 - float(light.sum())))
    return Spot(option, light / light.max(), pitch, heated or 0.0)


def with_heated_spots(options: Sequence[Option], spots: Sequence[Spot]) -> tuple[Option, ...]:
    """Return the options; each option with a mask also gets the width of its heated spot relative
    to that of the clear lens.
    """
    heated = {spot.option: spot.heated for spot in spots}
    plain_width, mask_width = heated.get(OPTIONS["plain"]), heated.get(OPTIONS["mask"])
    if not plain_width or not mask_width:
        return tuple(options)
    return tuple(
        replace(option, heated=mask_width / plain_width) if option.masked else option
        for option in options
    )


def damage_patterns(spots: Sequence[Spot], findings: Sequence[Finding]) -> Iterator[DamagePattern]:
    """Yield, for each protection whose spot is known, the pattern of the kind of damage with the
    largest ratio of exposure to limit.
    """
    for spot in spots:
        damage_findings = [
            finding
            for finding in findings
            if finding.option == spot.option and finding.limit.effect == "damage"
        ]
        if not damage_findings:
            continue
        worst_finding = max(damage_findings, key=lambda finding: finding.ratio)
        ratio = spot.light * worst_finding.ratio
        area = float((ratio >= 1).sum()) * (spot.pitch * 1e6) ** 2
        # crop where the exposure is a tenth of the limit, within `_FAINT` and `_DIM` of the peak
        bright_part = _cut(spot.light, max(_FAINT, min(_DIM, 0.1 / worst_finding.ratio)))
        width = bright_part.shape[0] * spot.pitch
        yield DamagePattern(
            spot.option,
            worst_finding.limit.name,
            bright_part * worst_finding.ratio,
            width,
            worst_finding.ratio,
            area,
        )


def _cut(light: FloatArray, faint: float) -> FloatArray:
    """Return the smallest square around the centre of the window that contains every sample
    brighter than ``faint``.
    """
    middle = np.array(light.shape) // 2
    bright = np.argwhere(light >= faint)
    half_side = int(np.clip(np.abs(bright - middle).max(), _LEAST_HALF_SAMPLES, min(middle) - 1))
    row, column = middle
    return light[row - half_side : row + half_side + 1, column - half_side : column + half_side + 1]


# --- dead pixels ----------------------------------------------------------------------------------

# An example of the dead pixels in a raw frame of the median device: points, lines, crosses and lost
# frames.


_LEAST_HALF_PIXELS, _MOST_HALF_PIXELS = (
    24,
    200,
)  #: least and greatest number of pixels from the spot to each edge of a picture
_WHITE, _GREY = 1000, 400  #: DN of a white pixel and of the evenly grey scene in the drawn frame


@dataclass(frozen=True)
class DeadPixels:
    """The part of a raw frame around the spot, after the laser has damaged the median device."""

    option: str
    distance: float  #: m
    kinds: tuple[str, ...]  #: kinds of damage that occur
    #: pixels that the light itself damages, without the lines and frames lost with them
    pixels: int
    #: (y, x) from 0 to 1; for a lost frame: the other damage, or all black if there is none
    frame: FloatArray


def damaged_frames(
    safety: Safety, spots: Sequence[Spot], findings: Sequence[Finding], exposures: Exposures
) -> Iterator[DeadPixels]:
    """Yield an example of a damaged frame behind each protection whose spot is known, all at one
    distance; nothing if no damage occurs.

    The distance is that of the recipe if the laser damages the median device there behind the plain
    lens, else the largest at which it does.
    """
    damage = [finding for finding in findings if finding.limit.effect == "damage"]
    reached = _reached(damage, exposures)
    if safety.settings.damage is None or not reached:
        return
    index_here = exposures.at(safety.laser.distance)
    index = index_here if index_here in reached else max(reached)
    pitch = safety.settings.sensor.pixel_pitch
    for spot in spots:
        if spot.pitch > pitch:  # samples coarser than the pixels would skip some of them
            continue
        damage_places = _hit(spot, pitch, damage, exposures, index)
        yield _frame(
            spot.option,
            float(exposures.distances[index]),
            damage_places,
            _half_width(damage_places),
            safety.settings.damage.device,
        )


def _hit(
    spot: Spot, pitch: float, damage: Sequence[Finding], exposures: Exposures, index: int
) -> list[tuple[str, FloatArray]]:
    """Return the kinds of damage that occur behind one protection at a distance, and the damaged
    pixels of each kind.
    """
    findings_behind = [finding for finding in damage if finding.option == spot.option]
    pixels_of_findings = [
        _above(spot, pitch, float(_ratio(finding, exposures)[index])) for finding in findings_behind
    ]
    kinds = [finding.limit.kind for finding in findings_behind]
    return [
        (kind, pixels)
        for kind, pixels in zip(kinds, pixels_of_findings, strict=True)
        if len(pixels)
    ]


def _half_width(hit: Sequence[tuple[str, FloatArray]]) -> int:
    """Return the number of pixels from the spot to each edge of a picture that contains all damaged
    pixels.
    """
    farthest = max((np.abs(places).max() for _, places in hit), default=0)
    # half as far again, within the limits of a picture
    return int(np.clip(farthest * 3 // 2, _LEAST_HALF_PIXELS, _MOST_HALF_PIXELS))


def _reached(damage: Sequence[Finding], exposures: Exposures) -> set[int]:
    """Return the indices of the distances at which a limit of damage is exceeded behind the
    plain lens.
    """
    plain_findings = [finding for finding in damage if finding.option == "plain lens"]
    indices = [np.flatnonzero(_ratio(finding, exposures) >= 1) for finding in plain_findings]
    return set(np.concatenate(indices).tolist()) if indices else set()


def _ratio(finding: Finding, exposures: Exposures) -> FloatArray:
    """Return the nominal exposure divided by the limit of the median device, at each distance
    (distance,).
    """
    emitted = exposures.emitted(finding.limit.quantity)[0]
    # `curve[0]` is the nominal limit at the lens
    ratio: FloatArray = emitted * exposures.lens[0] / finding.curve[0]
    return ratio


def _above(spot: Spot, pitch: float, ratio: float) -> FloatArray:
    """Return the pixels, as offsets (pixel, (y, x)) from the spot, in which at least one sample
    exceeds the limit.
    """
    middle = np.array(spot.light.shape) // 2
    samples = np.argwhere(spot.light * ratio >= 1) - middle
    return np.unique(np.round(samples * spot.pitch / pitch).astype(int), axis=0)


def _frame(
    option: str, distance: float, hit: Sequence[tuple[str, FloatArray]], half: int, device: str
) -> DeadPixels:
    """Return an example of a damaged raw frame of a grey scene.

    ``distance`` is in m, ``hit`` has each kind of damage with the places (pixel, (y, x)) from the
    spot, and ``half`` is the number of pixels from the spot to each edge.
    """
    pattern = torch.zeros(2 * half + 1, 2 * half + 1, dtype=torch.uint8)
    has_other_damage = any(kind != "frame" for kind, _ in hit)
    for kind, places in hit:
        if kind == "frame" and has_other_damage:  # a black picture would hide what else is damaged
            continue
        for y, x in places[(np.abs(places) <= half).all(1)] + half:
            # one bit for each kind
            pattern[y, x] |= 1 << KINDS.index(kind)
    unused = torch.zeros(0, dtype=torch.float64)
    raw = torch.full((1, *pattern.shape), float(_GREY))
    # only the pattern is drawn: its eight exposures and thresholds stay empty
    damage = SpotDamage._make([*[unused] * 8, pattern])
    damaged = damaged_pixels(
        raw, [damage], full_well=float(_WHITE), gain=1.0, bits=10, device=device
    )
    kinds = tuple(kind for kind in KINDS if kind in {kind for kind, _ in hit})
    return DeadPixels(
        option, distance, kinds, int((pattern > 0).sum()), damaged[0].double().numpy() / _WHITE
    )


# --- lens of recipe -------------------------------------------------------------------------------

# Compare the lens of an estimate with the lens in the steps of the recipe, for which masks and
# spots are computed.


_SAME = 1e-6  #: relative difference of two lengths that counts as rounding


def refuse_other_lens(recipe: Recipe, safety: Safety, store: Store | None) -> None:
    """Raise `RecipeError` where the recipe's steps and the estimate have different lenses, or where
    the stop of the protection is wider than the lens.

    The stop is the step that the settings name, and each stop on which a named step depends.
    """
    lens = safety.settings.lens
    problems = [*_other_focal_length(recipe, safety)]
    for name in dict.fromkeys(
        [*_named_stop(recipe, safety), *_upstream(recipe, safety, "optics.stop")]
    ):
        stop = run(recipe, store, [name])[name]
        grid_width = float(stop.samples * stop.pitch)
        width = f"{min(float(stop.diameter), grid_width) * 1e3:.4g} mm"
        if float(stop.diameter) > grid_width * (1 + _SAME):
            problem_text = (
                f"the step {name} clips its disc to a square of {width}, but an estimate assumes"
                " a round lens"
            )
            problems.append(
                _problem(
                    safety, "lens.diameter", f"{problem_text}: choose reading.aperture=stretched"
                )
            )
        elif not math.isclose(float(stop.diameter), lens.diameter, rel_tol=_SAME):
            problem_text = (
                f"the stop of the recipe ({name}) has {width}, but the lens of the estimate"
            )
            fix = (
                "write the same diameter in both; reading.aperture=stretched keeps the diameter"
                " of the recipe"
            )
            problems.append(
                _problem(
                    safety, "lens.diameter", f"{problem_text} {lens.diameter * 1e3:.4g} mm: {fix}"
                )
            )
    stop_of_protection = safety.settings.protection.stop
    if stop_of_protection is not None and stop_of_protection > lens.diameter * (1 + _SAME):
        problem = (
            f"a stop of {stop_of_protection * 1e3:.4g} mm is wider than the lens of"
            f" {lens.diameter * 1e3:.4g} mm"
        )
        problems.append(
            _problem(
                safety, "protection.stop", f"{problem}, so it blocks nothing: write a smaller stop"
            )
        )
    if problems:
        raise RecipeError(problems)


def _named_stop(recipe: Recipe, safety: Safety) -> Iterator[str]:
    """Yield the name of the stop's step, if the settings name one."""
    if safety.settings.lens.stop is not None:
        yield step_of(recipe, safety, "lens.stop", safety.settings.lens.stop, "")


def _other_focal_length(recipe: Recipe, safety: Safety) -> Iterator[Diagnostic]:
    """Yield an error for the first step whose PSF has another focal length than the lens of the
    estimate.
    """
    focal_length = safety.settings.lens.focal_length
    for name in _upstream(recipe, safety, "optics.psf"):
        step_length = recipe.steps[name].params["focal_length"]
        if not math.isclose(step_length, focal_length, rel_tol=_SAME):
            text = (
                f"the step {name} has a focal length of {step_length * 1e3:.4g} mm, but the lens"
                f" of the estimate has {focal_length * 1e3:.4g} mm"
            )
            yield _problem(
                safety, "lens.focal_length", f"{text}: write the same focal length in both"
            )
            return


def _upstream(recipe: Recipe, safety: Safety, node: str) -> list[str]:
    """Return the names of the steps of a node that lie upstream of the steps named in the settings
    of the protection.
    """
    waiting, visited = list(_named_steps(recipe, safety)), set[str]()
    while waiting:
        name = waiting.pop()
        if name not in visited:
            visited.add(name)
            waiting += recipe.steps[name].sources
    return sorted(name for name in visited if recipe.steps[name].node.path == node)


def _named_steps(recipe: Recipe, safety: Safety) -> Iterator[str]:
    """Yield the name of each step that the settings of the protection refer to."""
    protection = safety.settings.protection
    if protection.mask is not None:
        yield step_of(recipe, safety, "protection.mask", protection.mask, "mask")
    for block, spots in (("spots", protection.spots), ("pixels", protection.pixels)):
        for arm, step in spots:
            if step is not None and (arm, protection.mask) != ("mask", None):
                yield step_of(recipe, safety, f"protection.{block}.{arm}", step, arm)


def _problem(safety: Safety, setting: str, text: str) -> Diagnostic:
    """Return an error located where the recipe states the setting."""
    value = safety.values[setting]
    return Diagnostic(value.mark, value.name, text)
