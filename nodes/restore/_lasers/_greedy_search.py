"""The search: one more laser or lamp at a time, while it explains much more of the frame."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace
from typing import NamedTuple

import torch
from torch import Tensor

from neusee.nodes.restore._inverse._glare import speckle, visible
from neusee.nodes.restore._inverse._wiener_prior import picture_noise
from neusee.nodes.restore._lasers._candidates import (
    FAR,
    Candidate,
    Templates,
    candidates,
    clipped_candidates,
    nearest,
    nearest_of_many,
)
from neusee.nodes.restore._lasers._components import NANOMETRE, Camera, Lamp, LampLight, Laser
from neusee.nodes.restore._lasers._frame_likelihood import (
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

# The search: one more laser or lamp at a time, as long as it explains much more of the frame.


_LASER_LEAD = 10.0  #: log likelihood by which a laser is ahead of a lamp at least
_SAME_LASER = (2.0, 25.0)  #: pixels and nm, within which two lasers are one
_FEW_CLIPPED = 4  #: clipped pixels, fewer of which need no explanation
_CANDIDATES_TRIED = 2  #: candidates that are fitted before one of them is chosen
#: share of the clipped pixels that no part explains, from which on one more is sought farther away
_UNEXPLAINED_SHARE = 0.25
#: sum of squares of the errors of three responses, which one laser in ten exceeds by chance
_ODD_RESPONSES = 6.25
#: candidates for clipped pixels, whose surroundings are searched before any is fitted
_CLIPPED_CANDIDATES = 4
_LEAST_GAIN_SHARE = 0.25  #: share of a gain, candidates below which are not fitted
#: times the first width, up to which a fitted width is not compared with others
_WIDEST_RATIO = 1.5
_STEPS_OF_ONE, _STEPS_OF_ALL = 5, 12  #: steps of a fit of one part, and of all parts


class Known(NamedTuple):
    """A frame, and what does not change during the search."""

    electrons: Tensor
    seen: Tensor
    camera: Camera
    lamp: LampLight
    lines: Templates
    read_noise: float
    widths: tuple[float, ...]  #: m, of a line, that are tried


class Choice(NamedTuple):
    """A part that explains some of a frame, the log likelihood that it gains, and how far it is
    ahead of others.
    """

    part: Laser | Lamp
    gain: float
    margin: float  #: beyond what the other kind of light gains
    rival: float  #: beyond what a laser at another place or wavelength gains


class Found(NamedTuple):
    """What the search found, with the filter and weights of the last fit."""

    fit: Fit
    choices: tuple[Choice, ...]  #: each part as it was when it was found
    data: Data


def search(
    frame: Known, largest_number: int, lamps: int, smallest_gain: float, margin: float
) -> Found:
    """Return the lasers and lamps of a frame: each gains at least ``smallest_gain``, a laser
    ``margin`` of it beyond a lamp.
    """
    parts: Parts = ()
    choices: list[Choice] = []
    while True:
        # filter and weights follow the scene that is left without the parts
        data = _data(frame, parts)
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
    """Return what was found without parts that later parts made needless, each with its gain
    beside the rest.
    """
    parts, choices = search_result.fit.parts, search_result.choices
    data = search_result.data._replace(clipped=None)
    while len(parts) > 1:
        misfit = misfit_of(data, parts, 1)[1]
        parts_without_one = [parts[:n] + parts[n + 1 :] for n in range(len(parts))]
        # the gain of a part beside the rest is the misfit that its absence costs
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
    """Return True if there are as many lasers, or lamps, as there may be."""
    alike = sum(isinstance(candidate, Laser) == isinstance(other, Laser) for other in parts)
    return alike >= (largest_number if isinstance(candidate, Laser) else lamps)


def _light(frame: Known, parts: Parts) -> Tensor:
    """Return the electrons (channel, y, x) of all parts."""
    return sum((component.electrons() for component in parts), torch.zeros_like(frame.electrons))


def _data(frame: Known, parts: Parts) -> Data:
    """Return the frame with the filter and the weights that the frame without the parts asks
    for.
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
    """What the parts found so far leave, in float32, which is enough to choose between
    candidates.
    """

    known: Known
    data: Data
    before: float  #: misfit


def _rough(frame: Known, fit: Fit, data: Data) -> _Left:
    """Return a frame without the light of the fitted parts, and what the candidates need of it, in
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
    """Return the laser or lamp that explains most of what is left; None if nothing does."""
    remainder = _rough(frame, fit, data)
    residual = remainder.data.use(remainder.data.electrons)
    starts = _unclipped_starts(remainder, residual, frame.lines)
    clipped = _clipped_starts(frame, fit.parts, data.use)
    nearest_starts = [
        nearest(remainder.known.camera, remainder.data, residual, start) for start in clipped
    ]
    # the first ones alone: each is fitted, which takes long
    starts += sorted(nearest_starts, reverse=True)[:_CANDIDATES_TRIED]
    grown_choices = _all_grown(remainder, sorted(starts, reverse=True))
    if clipped and _leaves_dark(frame, fit.parts, grown_choices):
        nearest_of_tiles = [
            nearest_of_many(remainder.known.camera, remainder.data, residual, start)
            for start in clipped[:_CANDIDATES_TRIED]
        ]
        grown_choices = _with_more(remainder, grown_choices, nearest_of_tiles)
    # colours that do not fit ask for another wavelength
    grown_choices = _with_far_wavelengths(remainder, grown_choices, residual)
    new_choices = [choice for choice in grown_choices if not _known_already(choice.part, fit.parts)]
    best = _first_or_ahead(remainder, new_choices, smallest_gain, margin)
    return best and best._replace(part=_precise(best.part, frame))


def _unclipped_starts(left: _Left, residual: Tensor, lines: Templates) -> list[Candidate]:
    """Return the most likely lasers and the most likely lamp of a filtered residual."""
    use, weights, lamp = left.data.use, left.data.weights, left.known.lamp
    spot = Templates(torch.zeros(1).double(), lamp.patterns[None], lamp.colour[None])
    return [
        *candidates(residual, use, weights, lines, _CANDIDATES_TRIED),
        *candidates(residual, use, weights, spot, 1),
    ]


def _with_far_wavelengths(left: _Left, grown: list[Choice], residual: Tensor) -> list[Choice]:
    """Return what was grown with what grows farther away, as long as the best laser has unlikely
    responses.
    """
    for _ in range(_CANDIDATES_TRIED):
        best_laser = next((choice.part for choice in grown if isinstance(choice.part, Laser)), None)
        # values[5:] are the errors of the responses, in standard deviations
        if best_laser is None or float(best_laser.values[5:].square().sum()) < _ODD_RESPONSES:
            break
        start = nearest(left.known.camera, left.data, residual, _start(best_laser), near=FAR)
        grown = _with_more(left, grown, [start])
    return grown


def _first_or_ahead(
    left: _Left, new_choices: list[Choice], smallest_gain: float, margin: float
) -> Choice | None:
    """Return the choice of the largest gain, or what `_ahead` says where there is a laser."""
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
    """Return the best laser, or the best lamp where the laser is not ahead of it enough; None
    for too little gain.
    """
    if new_choices[0].gain < smallest_gain:
        return None
    best_laser = _widened(left, lasers[0])
    y, x = (round(float(coordinate)) for coordinate in best_laser.part.values[:2])
    lamps = [choice for choice in new_choices if isinstance(choice.part, Lamp)]
    # also a lamp at the place of the laser, of its strength
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
    """Return a part in the precision of the frame."""
    values = component.values.to(frame.electrons)
    if isinstance(component, Lamp):
        return replace(component, light=frame.lamp, values=values)
    return replace(
        component, camera=frame.camera._replace(fwhm=component.camera.fwhm), values=values
    )


def _all_grown(left: _Left, starts: list[Candidate]) -> list[Choice]:
    """Return what grows from candidates that are not far behind what others have grown to, the
    largest gain first.
    """
    grown: list[Choice] = []
    for start in starts:
        if start.gain >= _LEAST_GAIN_SHARE * max((choice.gain for choice in grown), default=0.0):
            grown += filter(None, [_grown(left, start)])
    return sorted(grown, key=lambda choice: -choice.gain)


def _with_more(left: _Left, grown: list[Choice], starts: list[Candidate]) -> list[Choice]:
    """Return what was grown with what grows from more candidates, the largest gain first."""
    return sorted(
        [*grown, *_all_grown(left, sorted(starts, reverse=True))], key=lambda choice: -choice.gain
    )


def _start(laser: Laser) -> Candidate:
    """Return a laser as a candidate."""
    y, x, nm, strength = laser.values[:4].tolist()
    return Candidate(0.0, (y, x), nm * NANOMETRE, strength)


def _widened(left: _Left, laser: Choice) -> Choice:
    """Return a laser with the width of its line that explains most; one of a narrow line stays
    as it is.
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
    """Return True for a laser that is told from one of the parts only by the width of a line."""
    for other in parts:
        if isinstance(component, Laser) and isinstance(other, Laser):
            distances = (component.values[:3] - other.values[:3]).abs().tolist()
            # y and x in pixels, then nm
            if max(distances[:2]) < _SAME_LASER[0] and distances[2] < _SAME_LASER[1]:
                return True
    return False


def _full_well(frame: Known) -> Tensor:
    """Return the value of the clipped pixels of each channel, 0 in a channel without any:
    (channel, 1, 1).
    """
    return frame.electrons.where(frame.seen == 0, 0.0).amax((-2, -1), keepdim=True)


def _dark(frame: Known, light: Tensor) -> int:
    """Return the number of clipped pixels for which the light of the parts is too weak."""
    return int(((frame.seen == 0) & (light < 0.5 * _full_well(frame))).any(0).sum())


def _leaves_dark(frame: Known, parts: Parts, grown: list[Choice]) -> bool:
    """Return True if many of the clipped pixels are too bright for the parts and for the one
    that gains most.
    """
    strongest = [_precise(choice.part, frame).electrons() for choice in grown[:1]]
    return _dark(frame, sum(strongest, _light(frame, parts))) > _UNEXPLAINED_SHARE * int(
        (frame.seen == 0).any(0).sum()
    )


def _clipped_starts(frame: Known, parts: Parts, use: Filter) -> list[Candidate]:
    """Return candidates whose clipped pixels are those that no part explains; none where all are
    explained.
    """
    full_light, light = _full_well(frame), _light(frame, parts)
    if _dark(frame, light) < _FEW_CLIPPED:
        return []
    picture = frame.electrons - torch.minimum(light, full_light.where(full_light > 0, torch.inf))
    all_pixels = Filter(torch.ones_like(frame.seen), use.kernel)
    noise = noise_of(frame.electrons, all_pixels.seen, frame.read_noise)
    weights = weights_of(all_pixels(picture), all_pixels, noise, picture)
    starts = clipped_candidates(
        picture, float(full_light.max()), all_pixels, weights, frame.lines, _CLIPPED_CANDIDATES
    )
    return [start for start in starts if start.gain >= _LEAST_GAIN_SHARE * starts[0].gain]


def _laser(frame: Known, start: Candidate, like: Tensor) -> Laser:
    """Return a laser at a candidate's spot, wavelength and strength, with a line of the camera's
    width, in the precision of ``like``.
    """
    values_after_spot = torch.zeros(3 + len(like)).to(like)
    values_after_spot[0], values_after_spot[1] = (
        start.wavelength / NANOMETRE,
        max(start.strength, 1.0),
    )
    return Laser(frame.camera, torch.cat([torch.tensor(start.spot).to(like), values_after_spot]))


def _elsewhere(first: Laser | Lamp, other: Laser | Lamp) -> bool:
    """Return True if two fits ended at different places or wavelengths."""
    distances = (first.values[:3] - other.values[:3]).abs().tolist()
    return bool(max(distances[:2]) > 0.5 or distances[2] > 5.0)


def _grown(left: _Left, start: Candidate) -> Choice | None:
    """Return the part that grows from a candidate, and its gain; None for no gain."""
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

# Lasers that are more than light which dirt, edges and defocus scatter out of the pattern of a
# stronger laser.


_FEW_SPECKLES, _STEPS = 5, 12  #: steps of a fit without one laser, and of the last fit


def without_scattered(search_result: Found, frame: Known, smallest_gain: float) -> Found:
    """Return what was found without lasers that gain less than ``smallest_gain`` where scattered
    light counts as noise.

    A lens that is not as its recipe says leaves grains of speckle around a strong laser, and each
    looks like a weak laser of the same colour. The frame tells how strong this speckle is likely to
    be; its variance is added to that of the noise, beginning with the weakest laser, whose stronger
    ones may have scattered it.
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
    """Return the frame with weights for which the likeliest speckle of some lasers is noise,
    without clipped pixels.
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
