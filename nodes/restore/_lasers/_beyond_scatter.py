"""Lasers that are more than light which dirt, edges and defocus scatter out of the pattern of a stronger laser."""

from __future__ import annotations

import torch
from torch import Tensor

from neusee.nodes.restore._inverse._glare import visible
from neusee.nodes.restore._inverse._picture_scale import picture_noise
from neusee.nodes.restore._inverse._scattered_glare import speckle
from neusee.nodes.restore._lasers._components import Laser
from neusee.nodes.restore._lasers._greedy_search import Found, Known
from neusee.nodes.restore._lasers._joint_fit import Data, Parts, fitted, misfit_of
from neusee.nodes.restore._lasers._whitening import noise_of, weights_of

_FEW, _STEPS = 5, 12  #: steps of a fit without one laser, and of the last fit


def without_scattered(found: Found, known: Known, least: float) -> Found:
    """Return what was found without lasers that gain less than ``least`` where scattered light counts as noise.

    A lens that is not as its recipe says leaves grains of speckle around a strong laser, and each looks like a weak
    laser of the same colour. The frame tells how strong this speckle is likely to be; its variance is added to that of
    the noise, beginning with the weakest laser, whose stronger ones may have scattered it.
    """
    lasers = [n for n, part in enumerate(found.fit.parts) if isinstance(part, Laser)]
    kept = set(range(len(found.fit.parts)))
    for n in sorted(lasers, key=lambda n: found.choices[n].gain)[:-1]:
        stronger = [found.fit.parts[m] for m in lasers if found.choices[m].gain > found.choices[n].gain]
        data = _with_speckle(found.data, known, found.fit.parts, tuple(stronger))
        parts = tuple(found.fit.parts[m] for m in sorted(kept))
        others = tuple(found.fit.parts[m] for m in sorted(kept - {n}))
        if misfit_of(data, others, _FEW)[1] - misfit_of(data, parts, 1)[1] < least:
            kept.remove(n)
    if len(kept) == len(found.fit.parts):
        return found
    fit = fitted(found.data, tuple(found.fit.parts[n] for n in sorted(kept)), _STEPS)
    return found._replace(fit=fit, choices=tuple(found.choices[n] for n in sorted(kept)))


def _with_speckle(data: Data, known: Known, parts: Parts, lasers: Parts) -> Data:
    """Return the frame with weights for which the likeliest speckle of some lasers is noise, without clipped pixels."""
    dark = torch.zeros_like(known.electrons)
    every, own = (sum((part.electrons() for part in some), dark) for some in (parts, lasers))
    left = known.electrons - every

    def noise(mean: Tensor) -> Tensor:
        return picture_noise(left + own, mean, known.read_noise)

    glare = visible([part.electrons() for part in lasers], [None] * len(lasers), known.seen)
    variance = noise_of(known.electrons, known.seen, known.read_noise) + speckle(left + own, known.seen, glare, noise)
    weights = weights_of(data.use(left), data.use, variance, left)
    return data._replace(weights=weights, clipped=None)
