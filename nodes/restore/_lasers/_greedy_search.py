"""The search: one more laser or lamp at a time, as long as it explains much more of the frame."""

from __future__ import annotations

from dataclasses import replace
from typing import NamedTuple

import torch
from torch import Tensor

from neusee.nodes.restore._lasers._candidates import Candidate, Templates, candidates, clipped_candidates
from neusee.nodes.restore._lasers._censored import censored
from neusee.nodes.restore._lasers._components import NANOMETRE, Camera, Lamp, Laser
from neusee.nodes.restore._lasers._joint_fit import Data, Fit, Parts, fitted, misfit_of
from neusee.nodes.restore._lasers._lamp_light import LampLight
from neusee.nodes.restore._lasers._nearest import FAR, nearest, nearest_of_many
from neusee.nodes.restore._lasers._whitening import Filter, Weights, filter_of, noise_of, weights_of

_AHEAD = 10.0  #: log likelihood by which a laser is ahead of a lamp at least
_SAME = (2.0, 25.0)  #: pixels and nm, within which two lasers are one
_FEW = 4  #: clipped pixels, fewer of which need no explanation
_TRIED = 2  #: candidates that are fitted before one of them is chosen
_LEFT = 0.25  #: share of the clipped pixels that no part explains, from which on one more is sought farther away
_ODD = 6.25  #: sum of squares of the errors of three responses, which one laser in ten exceeds by chance
_CLIPPED = 4  #: candidates for clipped pixels, whose surroundings are searched before any is fitted
_BEHIND = 0.25  #: share of a gain, candidates below which are not fitted
_WIDER = 1.5  #: times the first width, up to which a fitted width is not compared with others
_FIRST, _LAST = 5, 12  #: steps of a fit of one part, and of all parts


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
    """A part that explains some of a frame, the log likelihood that it gains, and how far it is ahead of others."""

    part: Laser | Lamp
    gain: float
    margin: float  #: beyond what the other kind of light gains
    rival: float  #: beyond what a laser at another place or wavelength gains


class Found(NamedTuple):
    """What the search found, with the filter and weights of the last fit."""

    fit: Fit
    choices: tuple[Choice, ...]  #: each part as it was when it was found
    data: Data


def search(known: Known, most: int, lamps: int, least: float, margin: float) -> Found:
    """Return the lasers and lamps of a frame: each gains at least ``least``, a laser ``margin`` of it beyond a lamp."""
    parts: Parts = ()
    chosen: list[Choice] = []
    while True:
        data = _data(known, parts)
        fit = fitted(data, parts, _LAST) if parts else _empty(data)
        parts = fit.parts
        best = _best(known, fit, data, least, margin)
        if best is None or best.gain < least or _full(best.part, parts, most, lamps):
            break
        parts, chosen = (*parts, best.part), [*chosen, best]
    return _pruned(Found(fit, tuple(chosen), data), least)


def _pruned(found: Found, least: float) -> Found:
    """Return what was found without parts that later parts made needless, each with its gain beside the rest."""
    parts, chosen = found.fit.parts, found.choices
    data = found.data._replace(clipped=None)
    while len(parts) > 1:
        now = misfit_of(data, parts, 1)[1]
        others = [parts[:n] + parts[n + 1 :] for n in range(len(parts))]
        costs = [misfit_of(data, rest, _FIRST)[1] - now for rest in others]
        chosen = tuple(choice._replace(gain=cost) for choice, cost in zip(chosen, costs, strict=True))
        least_needed = min(range(len(parts)), key=lambda n: costs[n])
        if costs[least_needed] >= least:
            break
        parts, chosen = others[least_needed], chosen[:least_needed] + chosen[least_needed + 1 :]
    fit = fitted(found.data, parts, _LAST) if len(parts) < len(found.fit.parts) else found.fit
    return found._replace(fit=fit, choices=chosen)


def _full(part: Laser | Lamp, parts: Parts, most: int, lamps: int) -> bool:
    """Return True if there are as many lasers, or lamps, as there may be."""
    alike = sum(isinstance(part, Laser) == isinstance(other, Laser) for other in parts)
    return alike >= (most if isinstance(part, Laser) else lamps)


def _light(known: Known, parts: Parts) -> Tensor:
    return sum((part.electrons() for part in parts), torch.zeros_like(known.electrons))


def _data(known: Known, parts: Parts) -> Data:
    """Return the frame with the filter and the weights that the frame without the parts asks for."""
    noise = noise_of(known.electrons, known.seen, known.read_noise)
    scene = known.electrons - _light(known, parts)
    use = filter_of(scene, noise, known.seen)
    weights = weights_of(use(scene), use, noise, scene)
    return Data(known.electrons, use, weights, censored(known.electrons, known.seen, scene, known.read_noise))


def _empty(data: Data) -> Fit:
    rest = data.weights(data.use(data.electrons)).flatten()
    none = rest.new_zeros(0, 0)
    return Fit((), 0.5 * float(rest.square().sum()), none, none, rest)


class _Left(NamedTuple):
    """What the parts found so far leave, in float32, which is enough to choose between candidates."""

    known: Known
    data: Data
    before: float  #: misfit


def _rough(known: Known, fit: Fit, data: Data) -> _Left:
    left = (known.electrons - _light(known, fit.parts)).float()
    weights = Weights(*(x.float() for x in data.weights))
    camera = known.camera._replace(responses=known.camera.responses.float())
    light, seen = known.lamp, known.seen.float()
    lamp = light._replace(
        spectra=light.spectra.to(torch.complex64), colour=light.colour.float(), patterns=light.patterns.float()
    )
    less = known._replace(electrons=known.electrons.float(), seen=seen, camera=camera, lamp=lamp)
    rough = Data(left, Filter(seen, data.use.kernel.float()), weights)
    return _Left(less, rough, misfit_of(rough, (), 0)[1])


def _best(known: Known, fit: Fit, data: Data, least: float, margin: float) -> Choice | None:
    """Return the laser or lamp that explains most of what is left; None if nothing does."""
    left = _rough(known, fit, data)
    residual = left.data.use(left.data.electrons)
    choose = (residual, left.data.use, left.data.weights)
    lamp = Templates(torch.zeros(1).double(), left.known.lamp.patterns[None], left.known.lamp.colour[None])
    starts = [*candidates(*choose, known.lines, _TRIED), *candidates(*choose, lamp, 1)]
    all_clipped = _clipped_starts(known, fit.parts, data.use)
    clipped = [one for one in all_clipped if one.gain >= _BEHIND * all_clipped[0].gain]
    rough = (left.known.camera, left.data)
    near = [nearest(*rough, residual, one) for one in clipped]
    starts += sorted(near, reverse=True)[:_TRIED]
    grown = _all_grown(left, sorted(starts, reverse=True))
    if clipped and _leaves_dark(known, fit.parts, grown):
        grown = _with_more(left, grown, [nearest_of_many(*rough, residual, one) for one in clipped[:_TRIED]])
    for _ in range(_TRIED):
        odd = [each.part for each in grown if isinstance(each.part, Laser)][:1]
        if not odd or float(odd[0].values[5:].square().sum()) < _ODD:
            break
        grown = _with_more(left, grown, [nearest(*rough, residual, _start(odd[0]), near=FAR)])
    found = [each for each in grown if not _known_already(each.part, fit.parts)]
    lasers = [each for each in found if isinstance(each.part, Laser)]
    best = _ahead(left, found, lasers, least, margin) if lasers else (found[0] if found else None)
    return best and best._replace(part=_precise(best.part, known))


def _ahead(left: _Left, found: list[Choice], lasers: list[Choice], least: float, margin: float) -> Choice | None:
    """Return the best laser, or the best lamp where the laser is not ahead of it enough; None for too little gain."""
    if found[0].gain < least:
        return None
    best = _widened(left, lasers[0])
    y, x = (round(float(at)) for at in best.part.values[:2])
    lamps = [each for each in found if isinstance(each.part, Lamp)]
    lamps += _all_grown(left, [Candidate(0.0, (y, x), 0.0, float(best.part.values[3]))])
    lamps.sort(key=lambda each: -each.gain)
    ahead = best.gain - (lamps[0].gain if lamps else 0.0)
    if lamps and ahead < max(margin * best.gain, _AHEAD):
        return lamps[0]._replace(margin=-ahead)
    rival = max((each.gain for each in lasers[1:] if _elsewhere(best.part, each.part)), default=0.0)
    return best._replace(margin=ahead, rival=best.gain - rival)


def _precise(part: Laser | Lamp, known: Known) -> Laser | Lamp:
    """Return a part in the precision of the frame."""
    values = part.values.to(known.electrons)
    if isinstance(part, Lamp):
        return replace(part, light=known.lamp, values=values)
    return replace(part, camera=known.camera._replace(fwhm=part.camera.fwhm), values=values)


def _all_grown(left: _Left, starts: list[Candidate]) -> list[Choice]:
    """Return what grows from candidates that are not far behind what others have grown to, the largest gain first."""
    found: list[Choice] = []
    for start in starts:
        if start.gain >= _BEHIND * max((each.gain for each in found), default=0.0):
            found += filter(None, [_grown(left, start)])
    return sorted(found, key=lambda each: -each.gain)


def _with_more(left: _Left, grown: list[Choice], starts: list[Candidate]) -> list[Choice]:
    """Return what was grown with what grows from more candidates, the largest gain first."""
    return sorted([*grown, *_all_grown(left, sorted(starts, reverse=True))], key=lambda each: -each.gain)


def _start(part: Laser) -> Candidate:
    """Return a laser as a candidate."""
    y, x, nm, strength = part.values[:4].tolist()
    return Candidate(0.0, (y, x), nm * NANOMETRE, strength)


def _widened(left: _Left, one: Choice) -> Choice:
    """Return a laser with the width of its line that explains most; one of a narrow line stays as it is."""
    best, widths = one, left.known.widths
    assert isinstance(one.part, Laser)
    if float(one.part.fwhm) < _WIDER * widths[0]:
        return one
    for width in widths[1:]:
        camera = left.known.camera._replace(fwhm=left.known.camera.fwhm.new_tensor(width))
        assert isinstance(best.part, Laser)
        parts, misfit = misfit_of(left.data, (replace(best.part, camera=camera),), _FIRST)
        if left.before - misfit > best.gain:
            best = best._replace(part=parts[0], gain=left.before - misfit)
    return best


def _known_already(part: Laser | Lamp, parts: Parts) -> bool:
    """Return True for a laser that is told from one of the parts only by the width of a line."""
    for other in parts:
        if isinstance(part, Laser) and isinstance(other, Laser):
            away = (part.values[:3] - other.values[:3]).abs().tolist()
            if max(away[:2]) < _SAME[0] and away[2] < _SAME[1]:
                return True
    return False


def _full_well(known: Known) -> Tensor:
    """Return the value of the clipped pixels of each channel, 0 in a channel without any: (channel, 1, 1)."""
    return known.electrons.where(known.seen == 0, 0.0).amax((-2, -1), keepdim=True)


def _dark(known: Known, light: Tensor) -> int:
    """Return the number of clipped pixels for which the light of the parts is too weak."""
    return int(((known.seen == 0) & (light < 0.5 * _full_well(known))).any(0).sum())


def _leaves_dark(known: Known, parts: Parts, grown: list[Choice]) -> bool:
    """Return True if many of the clipped pixels are too bright for the parts and for the one that gains most."""
    more = [_precise(each.part, known).electrons() for each in grown[:1]]
    return _dark(known, sum(more, _light(known, parts))) > _LEFT * int((known.seen == 0).any(0).sum())


def _clipped_starts(known: Known, parts: Parts, use: Filter) -> list[Candidate]:
    """Return candidates whose clipped pixels are those that no part explains; none where all are explained."""
    full, light = _full_well(known), _light(known, parts)
    if _dark(known, light) < _FEW:
        return []
    picture = known.electrons - torch.minimum(light, full.where(full > 0, torch.inf))
    every = Filter(torch.ones_like(known.seen), use.kernel)
    noise = noise_of(known.electrons, every.seen, known.read_noise)
    weights = weights_of(every(picture), every, noise, picture)
    return clipped_candidates(picture, float(full.max()), every, weights, known.lines, _CLIPPED)


def _laser(known: Known, start: Candidate, like: Tensor) -> Laser:
    rest = torch.zeros(3 + len(like)).to(like)
    rest[0], rest[1] = start.wavelength / NANOMETRE, max(start.strength, 1.0)
    return Laser(known.camera, torch.cat([torch.tensor(start.spot).to(like), rest]))


def _elsewhere(one: Laser | Lamp, other: Laser | Lamp) -> bool:
    """Return True if two fits ended at different places or wavelengths."""
    away = (one.values[:3] - other.values[:3]).abs().tolist()
    return bool(max(away[:2]) > 0.5 or away[2] > 5.0)


def _grown(left: _Left, start: Candidate) -> Choice | None:
    """Return the part that grows from a candidate, and its gain; None for no gain."""
    electrons, known = left.data.electrons, left.known
    spot = torch.tensor(start.spot).to(electrons)
    part: Laser | Lamp
    if start.wavelength:
        part = _laser(known, start, electrons)
    else:
        amounts = torch.zeros_like(known.lamp.spectra[:, :, 0, 0].real)
        amounts[0] = max(start.strength, 1.0) * known.lamp.colour
        part = Lamp(known.lamp, known.camera.lens.shape, torch.cat([spot, amounts.flatten()]))
    parts, misfit = misfit_of(left.data, (part,), _FIRST)
    gain = left.before - misfit
    return Choice(parts[0], gain, 0.0, 0.0) if gain > 0 else None
