"""The search: one more laser or lamp at a time, as long as it explains much more of the frame."""

from __future__ import annotations

import itertools
from dataclasses import replace
from typing import NamedTuple

import torch
from torch import Tensor

from neusee.nodes.restore._lasers._candidates import Candidate, Templates, candidates, clipped_candidates
from neusee.nodes.restore._lasers._components import NANOMETRE, Camera, Lamp, LampLight, Laser
from neusee.nodes.restore._lasers._joint_fit import Fit, Parts, fitted
from neusee.nodes.restore._lasers._whitening import Filter, Weights, filter_of, noise_of, weights_of

_AHEAD = 10.0  #: log likelihood by which a laser is ahead of a lamp at least
_SAME = (2.0, 25.0)  #: pixels and nm, within which two lasers are one
_HALVES, _NEAR = (-0.6, -0.3, 0.0, 0.3, 0.6), (-3.0, -1.5, 0.0, 1.5, 3.0)  #: pixels and nm around a candidate
_AROUND = 256  #: pixels a side of the window in which these are compared
_FEW = 4  #: clipped pixels, fewer of which need no explanation
_TRIED = 2  #: candidates that are fitted before one of them is chosen
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
    use: Filter
    weights: Weights


def search(known: Known, most: int, lamps: int, least: float, margin: float) -> Found:
    """Return the lasers and lamps of a frame: each gains at least ``least``, a laser ``margin`` of it beyond a lamp."""
    parts: Parts = ()
    chosen: list[Choice] = []
    while True:
        use, weights = _filters(known, parts)
        fit = fitted(known.electrons, parts, use, weights, _LAST) if parts else _empty(known, use, weights)
        parts = fit.parts
        best = _best(known, fit, use, weights, least, margin)
        if best is None or best.gain < least or _full(best.part, parts, most, lamps):
            break
        parts, chosen = (*parts, best.part), [*chosen, best]
    return _pruned(known.electrons, Found(fit, tuple(chosen), use, weights), least)


def _pruned(electrons: Tensor, found: Found, least: float) -> Found:
    """Return what was found without parts that later parts made needless, each with its gain beside the rest."""
    parts, chosen = found.fit.parts, found.choices
    while len(parts) > 1:
        now = fitted(electrons, parts, found.use, found.weights, 1).misfit
        others = [parts[:n] + parts[n + 1 :] for n in range(len(parts))]
        costs = [fitted(electrons, rest, found.use, found.weights, _FIRST).misfit - now for rest in others]
        chosen = tuple(choice._replace(gain=cost) for choice, cost in zip(chosen, costs, strict=True))
        least_needed = min(range(len(parts)), key=lambda n: costs[n])
        if costs[least_needed] >= least:
            break
        parts, chosen = others[least_needed], chosen[:least_needed] + chosen[least_needed + 1 :]
    fit = fitted(electrons, parts, found.use, found.weights, _LAST) if len(parts) < len(found.fit.parts) else found.fit
    return found._replace(fit=fit, choices=chosen)


def _full(part: Laser | Lamp, parts: Parts, most: int, lamps: int) -> bool:
    """Return True if there are as many lasers, or lamps, as there may be."""
    alike = sum(isinstance(part, Laser) == isinstance(other, Laser) for other in parts)
    return alike >= (most if isinstance(part, Laser) else lamps)


def _light(known: Known, parts: Parts) -> Tensor:
    return sum((part.electrons() for part in parts), torch.zeros_like(known.electrons))


def _filters(known: Known, parts: Parts) -> tuple[Filter, Weights]:
    """Return the filter and the weights that the frame without the parts asks for."""
    noise = noise_of(known.electrons, known.seen, known.read_noise)
    scene = known.electrons - _light(known, parts)
    use = filter_of(scene, noise, known.seen)
    return use, weights_of(use(scene), use, noise, scene)


def _empty(known: Known, use: Filter, weights: Weights) -> Fit:
    rest = weights(use(known.electrons)).flatten()
    none = rest.new_zeros(0, 0)
    return Fit((), 0.5 * float(rest.square().sum()), none, none, rest)


def _best(known: Known, fit: Fit, use: Filter, weights: Weights, least: float, margin: float) -> Choice | None:
    """Return the laser or lamp that explains most of what is left; None if nothing does."""
    left = known.electrons - _light(known, fit.parts)
    residual = use(left)
    lamp = Templates(torch.zeros(1).double(), known.lamp.patterns[None], known.lamp.colour[None])
    starts = [*candidates(residual, use, weights, known.lines, _TRIED), *candidates(residual, use, weights, lamp, 1)]
    starts += [_nearest(known, residual, one, use, weights) for one in _clipped_starts(known, fit.parts, use)]
    before = 0.5 * float(weights(residual).square().sum())

    def grown(these: list[Candidate]) -> list[Choice]:
        found = [_grown(known, left, start, use, weights, before) for start in these]
        return sorted((each for each in found if each is not None), key=lambda each: -each.gain)

    found = [each for each in grown(starts) if not _known_already(each.part, fit.parts)]
    lasers = [each for each in found if isinstance(each.part, Laser)]
    if not lasers:
        return found[0] if found else None
    if found[0].gain < least:
        return None
    lasers[0] = _widened(known, left, lasers[0], use, weights, before)
    best, (y, x) = lasers[0], (round(float(at)) for at in lasers[0].part.values[:2])
    others = [each for each in found if isinstance(each.part, Lamp)]
    others = sorted(
        [*others, *grown([Candidate(0.0, (y, x), 0.0, float(best.part.values[3]))])], key=lambda each: -each.gain
    )
    ahead = best.gain - (others[0].gain if others else 0.0)
    if others and ahead < max(margin * best.gain, _AHEAD):
        return others[0]._replace(margin=-ahead)
    rival = max((each.gain for each in lasers[1:] if _elsewhere(best.part, each.part)), default=0.0)
    return best._replace(margin=ahead, rival=best.gain - rival)


def _widened(known: Known, left: Tensor, one: Choice, use: Filter, weights: Weights, before: float) -> Choice:
    """Return a laser with the width of its line that explains most."""
    best = one
    for width in known.widths[1:]:
        camera = known.camera._replace(fwhm=known.camera.fwhm.new_tensor(width))
        assert isinstance(best.part, Laser)
        alone = fitted(left, (replace(best.part, camera=camera),), use, weights, _FIRST)
        if before - alone.misfit > best.gain:
            best = best._replace(part=alone.parts[0], gain=before - alone.misfit)
    return best


def _known_already(part: Laser | Lamp, parts: Parts) -> bool:
    """Return True for a laser that is told from one of the parts only by the width of a line."""
    for other in parts:
        if isinstance(part, Laser) and isinstance(other, Laser):
            away = (part.values[:3] - other.values[:3]).abs().tolist()
            if max(away[:2]) < _SAME[0] and away[2] < _SAME[1]:
                return True
    return False


def _clipped_starts(known: Known, parts: Parts, use: Filter) -> list[Candidate]:
    """Return candidates whose clipped pixels are those that no part explains; none where all are explained."""
    full = known.electrons.where(known.seen == 0, 0.0).amax((-2, -1), keepdim=True)
    light = _light(known, parts)
    dark = ((known.seen == 0) & (light < 0.5 * full)).any(0)
    if int(dark.sum()) < _FEW:
        return []
    picture = known.electrons - torch.minimum(light, full.where(full > 0, torch.inf))
    every = Filter(torch.ones_like(known.seen), use.kernel)
    noise = noise_of(known.electrons, every.seen, known.read_noise)
    weights = weights_of(every(picture), every, noise, picture)
    return clipped_candidates(picture, float(full.max()), every, weights, known.lines, _TRIED)


def _nearest(known: Known, residual: Tensor, start: Candidate, use: Filter, weights: Weights) -> Candidate:
    """Return the best of the candidates around one, because the rings far from a clipped spot are narrow."""
    window, middle = _window(residual, start.spot)
    seen = Filter(use.seen[..., *window], use.kernel)
    within = Weights(*(x[..., *window] for x in weights))
    white, best = within(residual[..., *window]), (0.0, start)
    near = known._replace(camera=_of_shape(known.camera, (white.shape[-2], white.shape[-1])))
    for y, x, nm in itertools.product(_HALVES, _HALVES, _NEAR):
        spot = (start.spot[0] + y, start.spot[1] + x)
        moved = start._replace(spot=spot, wavelength=start.wavelength + nm * NANOMETRE)
        here = moved._replace(spot=(spot[0] - middle[0], spot[1] - middle[1]))
        light = within(seen(_laser(near, here, white).electrons()))
        product, norm = float((light * white).sum()), float(light.square().sum())
        gain = product**2 / norm if product > 0 else 0.0
        if gain > best[0]:
            best = (gain, moved._replace(strength=max(product / norm, 0.01) * start.strength))
    return best[1]


def _window(frame: Tensor, spot: tuple[float, float]) -> tuple[tuple[slice, slice], tuple[int, int]]:
    """Return the window of a frame around a spot that tells the candidates apart, and where its middle lies."""
    window, middle = [], []
    for n, at in zip(frame.shape[-2:], spot, strict=True):
        side = min(n, _AROUND)
        first = min(max(round(at) + n // 2 - side // 2, 0), n - side)
        window.append(slice(first, first + side))
        middle.append(first + side // 2 - n // 2)
    return (window[0], window[1]), (middle[0], middle[1])


def _of_shape(camera: Camera, shape: tuple[int, int]) -> Camera:
    return camera._replace(lens=camera.lens._replace(shape=shape))


def _laser(known: Known, start: Candidate, like: Tensor) -> Laser:
    rest = torch.zeros(2 + len(like)).to(like)
    rest[0], rest[1] = start.wavelength / NANOMETRE, max(start.strength, 1.0)
    return Laser(known.camera, torch.cat([torch.tensor(start.spot).to(like), rest]))


def _elsewhere(one: Laser | Lamp, other: Laser | Lamp) -> bool:
    """Return True if two fits ended at different places or wavelengths."""
    away = (one.values[:3] - other.values[:3]).abs().tolist()
    return bool(max(away[:2]) > 0.5 or away[2] > 5.0)


def _grown(known: Known, left: Tensor, start: Candidate, use: Filter, weights: Weights, before: float) -> Choice | None:
    """Return the part that grows from a candidate, and its gain; None for no gain."""
    spot = torch.tensor(start.spot).to(left)
    part: Laser | Lamp
    if start.wavelength:
        part = _laser(known, start, left)
    else:
        amounts = torch.zeros_like(known.lamp.spectra[:, :, 0, 0].real)
        amounts[0] = max(start.strength, 1.0) * known.lamp.colour
        part = Lamp(known.lamp, known.camera.lens.shape, torch.cat([spot, amounts.flatten()]))
    alone = fitted(left, (part,), use, weights, _FIRST)
    gain = before - alone.misfit
    return Choice(alone.parts[0], gain, 0.0, 0.0) if gain > 0 else None
