"""Greedy search: it adds one laser or lamp at a time, as long as each gains enough likelihood."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace
from typing import NamedTuple

import torch
from torch import Tensor

from neusee.nodes.restore.inverse._glare import speckle, visible
from neusee.nodes.restore.inverse._wiener_prior import picture_noise
from neusee.nodes.restore.lasers._candidates import (
    FAR,
    Candidate,
    Templates,
    candidates,
    clipped_candidates,
    nearest,
    nearest_of_many,
)
from neusee.nodes.restore.lasers._components import NANOMETRE, Camera, Lamp, LampLight, Laser
from neusee.nodes.restore.lasers._frame_likelihood import (
    Data,
    Filter,
    Fit,
    Parts,
    Weights,
    censored,
    filter_of,
    fitted,
    misfit_of,
    noise_of,
    weights_of,
)

# --- greedy search --------------------------------------------------------------------------------

# The greedy search: it adds one laser or lamp ("part") at a time, as long as each gains enough log
# likelihood.


_LASER_LEAD = 10.0  #: smallest lead in log likelihood of a laser over a lamp
_SAME_LASER = (2.0, 25.0)  #: pixels and nm: two lasers closer than both count as one
_FEW_CLIPPED = 4  #: fewer unexplained clipped pixels than this are ignored
_CANDIDATES_TRIED = 2  #: number of candidates that are fitted before one of them is chosen
#: fraction of unexplained clipped pixels above which the search extends farther from the candidates
_UNEXPLAINED_SHARE = 0.25
#: sum of squares of the errors of three responses: the 90 % quantile of chi2 with 3 degrees of
#: freedom
_ODD_RESPONSES = 6.25
#: number of candidates for clipped pixels whose surroundings are searched before any is fitted
_CLIPPED_CANDIDATES = 4
_LEAST_GAIN_SHARE = 0.25  #: a candidate with less than this fraction of the best gain is not fitted
#: ratio to the first width: lines that are fitted narrower are not compared with the other widths
_WIDEST_RATIO = 1.5
_STEPS_OF_ONE, _STEPS_OF_ALL = 5, 12  #: steps of a fit of one part, and of all parts


class Known(NamedTuple):
    """A frame, its camera and the settings: everything that stays constant during the search."""

    electrons: Tensor
    seen: Tensor
    camera: Camera
    lamp: LampLight
    lines: Templates
    read_noise: float
    widths: tuple[float, ...]  #: widths of a line (full width at half maximum) that are tried, m


class Choice(NamedTuple):
    """A fitted laser or lamp, its gain in log likelihood, and its lead over the alternatives."""

    part: Laser | Lamp
    gain: float
    margin: float  #: gain minus the gain of the other kind of light
    rival: float  #: gain minus the gain of a laser at another place or wavelength


class Found(NamedTuple):
    """The result of the search, with the filter and weights of the last fit."""

    fit: Fit
    choices: tuple[Choice, ...]  #: each part as first fitted, before the joint fit
    data: Data


def search(
    frame: Known, largest_number: int, lamps: int, smallest_gain: float, margin: float
) -> Found:
    """Return the lasers and lamps of a frame.

    Each gains at least ``smallest_gain`` of log likelihood. A laser exceeds the gain of a lamp by
    at least the fraction ``margin`` of its own gain.
    """
    parts: Parts = ()
    choices: list[Choice] = []
    while True:
        # filter and weights are estimated from the scene: the frame minus the parts
        data = data_of(frame, parts)
        fit = fitted(data, parts, _STEPS_OF_ALL) if parts else _empty(data)
        parts = fit.parts
        best = _best(frame, fit, data, smallest_gain, margin)
        if (
            best is None
            or best.gain < smallest_gain
            or _full(best.part, parts, largest_number, lamps)
        ):
            break
        parts, choices = (*parts, best.part), [*choices, best]
    return _pruned(Found(fit, tuple(choices), data), smallest_gain)


def _pruned(search_result: Found, smallest_gain: float) -> Found:
    """Return the result without parts that later parts made superfluous; each gain becomes the gain
    over a fit without this part.
    """
    parts, choices = search_result.fit.parts, search_result.choices
    data = search_result.data._replace(clipped=None)
    while len(parts) > 1:
        misfit = misfit_of(data, parts, 1)[1]
        parts_without_one = [parts[:n] + parts[n + 1 :] for n in range(len(parts))]
        # gain of a part: how much the misfit rises without it
        costs = [
            misfit_of(data, remaining, _STEPS_OF_ONE)[1] - misfit for remaining in parts_without_one
        ]
        choices = tuple(
            choice._replace(gain=cost) for choice, cost in zip(choices, costs, strict=True)
        )
        least_needed = min(range(len(parts)), key=lambda n: costs[n])
        if costs[least_needed] >= smallest_gain:
            break
        parts, choices = (
            parts_without_one[least_needed],
            choices[:least_needed] + choices[least_needed + 1 :],
        )
    fit = (
        fitted(search_result.data, parts, _STEPS_OF_ALL)
        if len(parts) < len(search_result.fit.parts)
        else search_result.fit
    )
    return search_result._replace(fit=fit, choices=choices)


def _full(candidate: Laser | Lamp, parts: Parts, largest_number: int, lamps: int) -> bool:
    """Return True if the number of parts of the candidate's kind has reached its limit."""
    alike = sum(isinstance(candidate, Laser) == isinstance(other, Laser) for other in parts)
    return alike >= (largest_number if isinstance(candidate, Laser) else lamps)


def _light(frame: Known, parts: Parts) -> Tensor:
    """Return the electrons (channel, y, x) of all parts."""
    return sum((component.electrons() for component in parts), torch.zeros_like(frame.electrons))


def data_of(frame: Known, parts: Parts) -> Data:
    """Return the frame with a filter and weights that are estimated from the frame minus the
    parts.
    """
    noise = noise_of(frame.electrons, frame.seen, frame.read_noise)
    scene = frame.electrons - _light(frame, parts)
    use = filter_of(scene, noise, frame.seen)
    weights = weights_of(use(scene), use, noise, scene)
    return Data(
        frame.electrons,
        use,
        weights,
        censored(frame.electrons, frame.seen, scene, frame.read_noise),
    )


def _empty(data: Data) -> Fit:
    """Return the fit without any laser or lamp."""
    white_residual = data.weights(data.use(data.electrons)).flatten()
    no_slopes = white_residual.new_zeros(0, 0)
    return Fit((), 0.5 * float(white_residual.square().sum()), no_slopes, no_slopes, white_residual)


class _Left(NamedTuple):
    """The frame minus the parts found so far, in float32, which is precise enough to choose between
    candidates.
    """

    known: Known
    data: Data
    before: float  #: misfit without a further part


def _rough(frame: Known, fit: Fit, data: Data) -> _Left:
    """Return a frame minus the light of the fitted parts, with its filter, weights and camera, in
    float32.
    """
    remainder = (frame.electrons - _light(frame, fit.parts)).float()
    weights = Weights(*(x.float() for x in data.weights))
    camera = frame.camera._replace(responses=frame.camera.responses.float())
    lamp_light, unclipped = frame.lamp, frame.seen.float()
    single_lamp = lamp_light._replace(
        spectra=lamp_light.spectra.to(torch.complex64),
        colour=lamp_light.colour.float(),
        patterns=lamp_light.patterns.float(),
    )
    single_frame = frame._replace(
        electrons=frame.electrons.float(), seen=unclipped, camera=camera, lamp=single_lamp
    )
    single_data = Data(remainder, Filter(unclipped, data.use.kernel.float()), weights)
    return _Left(single_frame, single_data, misfit_of(single_data, (), 0)[1])


def _best(frame: Known, fit: Fit, data: Data, smallest_gain: float, margin: float) -> Choice | None:
    """Return the laser or lamp that explains most of the rest of the frame; None if there is
    none.
    """
    remainder = _rough(frame, fit, data)
    residual = remainder.data.use(remainder.data.electrons)
    starts = _unclipped_starts(remainder, residual, frame.lines)
    clipped = _clipped_starts(frame, fit.parts, data.use)
    nearest_starts = [
        nearest(remainder.known.camera, remainder.data, residual, start) for start in clipped
    ]
    # only the best are kept, because each fit takes long
    starts += sorted(nearest_starts, reverse=True)[:_CANDIDATES_TRIED]
    grown_choices = _all_grown(remainder, sorted(starts, reverse=True))
    if clipped and _leaves_dark(frame, fit.parts, grown_choices):
        nearest_of_tiles = [
            nearest_of_many(remainder.known.camera, remainder.data, residual, start)
            for start in clipped[:_CANDIDATES_TRIED]
        ]
        grown_choices = _with_more(remainder, grown_choices, nearest_of_tiles)
    # improbable responses indicate a wrong wavelength
    grown_choices = _with_far_wavelengths(remainder, grown_choices, residual)
    new_choices = [choice for choice in grown_choices if not _known_already(choice.part, fit.parts)]
    best = _first_or_ahead(remainder, new_choices, smallest_gain, margin)
    return best and best._replace(part=_precise(best.part, frame))


def _unclipped_starts(left: _Left, residual: Tensor, lines: Templates) -> list[Candidate]:
    """Return the most likely lasers and the most likely lamp in a filtered residual, from the
    unclipped pixels.
    """
    use, weights, lamp = left.data.use, left.data.weights, left.known.lamp
    spot = Templates(torch.zeros(1).double(), lamp.patterns[None], lamp.colour[None])
    return [
        *candidates(residual, use, weights, lines, _CANDIDATES_TRIED),
        *candidates(residual, use, weights, spot, 1),
    ]


def _with_far_wavelengths(left: _Left, grown: list[Choice], residual: Tensor) -> list[Choice]:
    """Return the fitted parts, with further ones at wavelengths farther away while the best laser
    has improbable responses.
    """
    for _ in range(_CANDIDATES_TRIED):
        best_laser = next((choice.part for choice in grown if isinstance(choice.part, Laser)), None)
        # `values[5:]`: errors of the responses, in standard deviations
        if best_laser is None or float(best_laser.values[5:].square().sum()) < _ODD_RESPONSES:
            break
        start = nearest(left.known.camera, left.data, residual, _start(best_laser), near=FAR)
        grown = _with_more(left, grown, [start])
    return grown


def _first_or_ahead(
    left: _Left, new_choices: list[Choice], smallest_gain: float, margin: float
) -> Choice | None:
    """Return the lamp with the largest gain or, if there are lasers, the result of `_ahead`; None
    without any choice.
    """
    lasers = [choice for choice in new_choices if isinstance(choice.part, Laser)]
    if lasers:
        return _ahead(left, new_choices, lasers, smallest_gain, margin)
    return new_choices[0] if new_choices else None


def _ahead(
    left: _Left,
    new_choices: list[Choice],
    lasers: list[Choice],
    smallest_gain: float,
    margin: float,
) -> Choice | None:
    """Return the best laser, or the best lamp if the lead of the laser is too small; None if the
    gain is too small.
    """
    if new_choices[0].gain < smallest_gain:
        return None
    best_laser = _widened(left, lasers[0])
    y, x = (round(float(coordinate)) for coordinate in best_laser.part.values[:2])
    lamps = [choice for choice in new_choices if isinstance(choice.part, Lamp)]
    # a lamp is also tried at the place and with the strength of the laser
    lamps += _all_grown(left, [Candidate(0.0, (y, x), 0.0, float(best_laser.part.values[3]))])
    lamps.sort(key=lambda choice: -choice.gain)
    gain_ahead = best_laser.gain - (lamps[0].gain if lamps else 0.0)
    if lamps and gain_ahead < max(margin * best_laser.gain, _LASER_LEAD):
        return lamps[0]._replace(margin=-gain_ahead)
    rival_gain = max(
        (laser.gain for laser in lasers[1:] if _elsewhere(best_laser.part, laser.part)), default=0.0
    )
    return best_laser._replace(margin=gain_ahead, rival=best_laser.gain - rival_gain)


def _precise(component: Laser | Lamp, frame: Known) -> Laser | Lamp:
    """Return a part, converted to the floating-point precision of the frame."""
    values = component.values.to(frame.electrons)
    if isinstance(component, Lamp):
        return replace(component, light=frame.lamp, values=values)
    return replace(
        component, camera=frame.camera._replace(fwhm=component.camera.fwhm), values=values
    )


def _all_grown(left: _Left, starts: list[Candidate]) -> list[Choice]:
    """Return the parts that are fitted from the candidates, the largest gain first; a candidate
    whose gain is far below the best fit is skipped.
    """
    grown: list[Choice] = []
    for start in starts:
        if start.gain >= _LEAST_GAIN_SHARE * max((choice.gain for choice in grown), default=0.0):
            grown += filter(None, [_grown(left, start)])
    return sorted(grown, key=lambda choice: -choice.gain)


def _with_more(left: _Left, grown: list[Choice], starts: list[Candidate]) -> list[Choice]:
    """Return the fitted parts together with those of further candidates, the largest gain first."""
    return sorted(
        [*grown, *_all_grown(left, sorted(starts, reverse=True))], key=lambda choice: -choice.gain
    )


def _start(laser: Laser) -> Candidate:
    """Return a candidate with the place, wavelength and strength of a laser."""
    y, x, nm, strength = laser.values[:4].tolist()
    return Candidate(0.0, (y, x), nm * NANOMETRE, strength)


def _widened(left: _Left, laser: Choice) -> Choice:
    """Return a laser with the line width of the largest gain; a laser with a narrow line is
    returned unchanged.
    """
    best, widths = laser, left.known.widths
    assert isinstance(laser.part, Laser)
    if float(laser.part.fwhm) < _WIDEST_RATIO * widths[0]:
        return laser
    for width in widths[1:]:
        camera = left.known.camera._replace(fwhm=left.known.camera.fwhm.new_tensor(width))
        assert isinstance(best.part, Laser)
        parts, misfit = misfit_of(left.data, (replace(best.part, camera=camera),), _STEPS_OF_ONE)
        if left.before - misfit > best.gain:
            best = best._replace(part=parts[0], gain=left.before - misfit)
    return best


def _known_already(component: Laser | Lamp, parts: Parts) -> bool:
    """Return True for a laser that has almost the place and wavelength of one of the parts."""
    for other in parts:
        if isinstance(component, Laser) and isinstance(other, Laser):
            distances = (component.values[:3] - other.values[:3]).abs().tolist()
            # distances in y and x (pixels), then in wavelength (nm)
            if max(distances[:2]) < _SAME_LASER[0] and distances[2] < _SAME_LASER[1]:
                return True
    return False


def _full_well(frame: Known) -> Tensor:
    """Return the value (channel, 1, 1) of the clipped pixels of each channel in e-; 0 for a channel
    without clipped pixels.
    """
    return frame.electrons.where(frame.seen == 0, 0.0).amax((-2, -1), keepdim=True)


def _dark(frame: Known, light: Tensor) -> int:
    """Return the number of unexplained clipped pixels: those in which the light of the parts is
    below half the full well.
    """
    return int(((frame.seen == 0) & (light < 0.5 * _full_well(frame))).any(0).sum())


def _leaves_dark(frame: Known, parts: Parts, grown: list[Choice]) -> bool:
    """Return True if the parts and the best new part together leave many clipped pixels
    unexplained.
    """
    strongest = [_precise(choice.part, frame).electrons() for choice in grown[:1]]
    return _dark(frame, sum(strongest, _light(frame, parts))) > _UNEXPLAINED_SHARE * int(
        (frame.seen == 0).any(0).sum()
    )


def _clipped_starts(frame: Known, parts: Parts, use: Filter) -> list[Candidate]:
    """Return candidates for the clipped pixels that no part explains; none if (almost) all are
    explained.
    """
    full_light, light = _full_well(frame), _light(frame, parts)
    if _dark(frame, light) < _FEW_CLIPPED:
        return []
    # a sensor shows at most the full well; 0: no pixel of this channel clips, so no limit is known
    picture = frame.electrons - torch.minimum(light, full_light.where(full_light > 0, torch.inf))
    # clipped pixels are compared too: the patterns are clipped at the same level
    all_pixels = Filter(torch.ones_like(frame.seen), use.kernel)
    noise = noise_of(frame.electrons, all_pixels.seen, frame.read_noise)
    weights = weights_of(all_pixels(picture), all_pixels, noise, picture)
    starts = clipped_candidates(
        picture, float(full_light.max()), all_pixels, weights, frame.lines, _CLIPPED_CANDIDATES
    )
    return [start for start in starts if start.gain >= _LEAST_GAIN_SHARE * starts[0].gain]


def _laser(frame: Known, start: Candidate, like: Tensor) -> Laser:
    """Return a laser with the spot, wavelength and strength of a candidate and the line width of
    the camera, in the precision of ``like``.
    """
    values_after_spot = torch.zeros(3 + len(like)).to(like)
    values_after_spot[0], values_after_spot[1] = (
        start.wavelength / NANOMETRE,
        max(start.strength, 1.0),
    )
    return Laser(frame.camera, torch.cat([torch.tensor(start.spot).to(like), values_after_spot]))


def _elsewhere(first: Laser | Lamp, other: Laser | Lamp) -> bool:
    """Return True if two fits ended more than 0.5 pixels or 5 nm apart."""
    distances = (first.values[:3] - other.values[:3]).abs().tolist()
    return bool(max(distances[:2]) > 0.5 or distances[2] > 5.0)


def _grown(left: _Left, start: Candidate) -> Choice | None:
    """Return the part that is fitted from a candidate, and its gain; None if it gains nothing."""
    electrons, frame = left.data.electrons, left.known
    spot = torch.tensor(start.spot).to(electrons)
    component: Laser | Lamp
    # a candidate of wavelength 0 is a lamp, see `Templates`
    if start.wavelength:
        component = _laser(frame, start, electrons)
    else:
        light_by_kind = torch.zeros_like(frame.lamp.spectra[:, :, 0, 0].real)
        light_by_kind[0] = max(start.strength, 1.0) * frame.lamp.colour
        component = Lamp(
            frame.lamp, frame.camera.lens.shape, torch.cat([spot, light_by_kind.flatten()])
        )
    parts, misfit = misfit_of(left.data, (component,), _STEPS_OF_ONE)
    gain = left.before - misfit
    return Choice(parts[0], gain, 0.0, 0.0) if gain > 0 else None


# --- beyond scatter -------------------------------------------------------------------------------

# Test whether a weak laser is real, or only light that dirt, edges and defocus scatter out of the
# pattern of a stronger laser.


_FEW_SPECKLES, _STEPS = 5, 12  #: steps of a fit without one laser, and of the last fit


def without_scattered(search_result: Found, frame: Known, smallest_gain: float) -> Found:
    """Return the result without lasers whose gain is below ``smallest_gain`` if scattered light
    counts as noise.

    A lens that deviates from its recipe gives speckle around a strong laser, and each grain looks
    like a weak laser of the same colour. The strength of the speckle is estimated from the frame,
    and its variance is added to the variance of the noise. The lasers are tested from the weakest
    up, each against the speckle of all stronger ones.
    """
    all_parts, choices = search_result.fit.parts, search_result.choices
    lasers = [n for n, component in enumerate(all_parts) if isinstance(component, Laser)]
    remaining = set(range(len(all_parts)))
    # the weakest first; the strongest is always a laser
    for n in sorted(lasers, key=lambda n: choices[n].gain)[:-1]:
        stronger = [m for m in lasers if choices[m].gain > choices[n].gain]
        data = _with_speckle(search_result.data, frame, all_parts, _numbered(all_parts, stronger))
        parts_with_laser = _numbered(all_parts, sorted(remaining))
        parts_without_laser = _numbered(all_parts, sorted(remaining - {n}))
        if (
            misfit_of(data, parts_without_laser, _FEW_SPECKLES)[1]
            - misfit_of(data, parts_with_laser, 1)[1]
            < smallest_gain
        ):
            remaining.remove(n)
    if len(remaining) == len(all_parts):
        return search_result
    fit = fitted(search_result.data, _numbered(all_parts, sorted(remaining)), _STEPS)
    return search_result._replace(fit=fit, choices=tuple(choices[n] for n in sorted(remaining)))


def _numbered(parts: Parts, numbers: Sequence[int]) -> Parts:
    return tuple(parts[n] for n in numbers)


def _with_speckle(data: Data, frame: Known, parts: Parts, lasers: Parts) -> Data:
    """Return the frame with weights that count the most likely speckle of ``lasers`` as noise;
    clipped pixels are left out.
    """
    dark_frame = torch.zeros_like(frame.electrons)
    light_of_parts, light_of_lasers = (
        sum((component.electrons() for component in components), dark_frame)
        for components in (parts, lasers)
    )
    remainder = frame.electrons - light_of_parts

    def noise(mean: Tensor) -> Tensor:
        return picture_noise(remainder + light_of_lasers, mean, frame.read_noise)

    glare = visible([laser.electrons() for laser in lasers], [None] * len(lasers), frame.seen)
    variance = noise_of(frame.electrons, frame.seen, frame.read_noise) + speckle(
        remainder + light_of_lasers, frame.seen, glare, noise
    )
    weights = weights_of(data.use(remainder), data.use, variance, remainder)
    return data._replace(weights=weights, clipped=None)
