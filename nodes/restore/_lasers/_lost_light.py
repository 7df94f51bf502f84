"""The light of a laser at the aperture, from the light that follows its pattern: dirt scatters and absorbs the rest.

No lens is as its recipe says. Dust, scratches, grease, dents and defocus take light out of the pattern, and what they
scatter makes the frame differ from the pattern. A fit then finds less light in the pattern, and even less where bright
pixels are clipped, because the pixels that are seen are those that happen to be dark. The same difference makes the
electrons of a fit scatter more between parts of the frame than noise and scene do, and so tells of the light that is
lost.

The law: every second lens is as its recipe says. In the others the logarithm of light at the aperture over light that
follows the pattern is lognormal, about a power of that scatter and an exponential of the clipped share. Power,
exponential and width were learnt from fits in frames of lenses with the dirt of `recipes/flare/dirty_windshield.yaml`
(dust, scratches, grease and dents, each 3 to 100 % of it) and the defocus of `recipes/mismatch/usual.yaml`. An even
attenuation, as by smudges, changes no pattern and is not part of it.
"""

from __future__ import annotations

import math

import torch
from torch import Tensor

_PLAIN = 1.05  #: growth of a standard deviation by the scatter of a residual, up to which a clean lens explains it
#: pixels a side of the frame for which a scatter counts, and of the largest frame of which all pixels tell of it
_SIDE, _MOST = 64, 128
_USUAL, _FACTOR = 0.004, 2.0  #: relative scatter of electrons behind a dirty lens: median, factor of one deviation
#: of the median logarithm that is lost: its value at scatter 1, the power of scatter, and its growth with clipping
_LOST, _POWER, _CLIPPED = 2.10, 0.74, 2.15
_WIDTHS = (0.7, 1.2)  #: standard deviations of the logarithm of it, where the frame tells the scatter, and where not
_ALL = 10.0  #: logarithm, beyond which nothing of a laser follows its pattern
_NODES = 256  #: quantiles that stand for a law
_ENDS = (0.5, 0.05, 0.95)  #: probabilities of an estimate and of the ends of a 90 % interval
_HALVINGS = 60


def at_the_aperture(straight: Tensor, spread: Tensor, ideal: Tensor, seen: Tensor) -> tuple[Tensor, Tensor]:
    """Return the electrons that a laser would leave behind a clean lens, and the ends of a 90 % interval.

    ``straight`` are those that follow the pattern, with the standard deviation ``spread``; that of a lens which is as
    its recipe says would be ``ideal``.

    Shapes: each (channel,), seen (channel, y, x), 0 for clipped pixels -> (channel,), (channel, 2).
    Units:  e-.
    """
    side = min(seen[0].numel() ** 0.5, _MOST)  # the scatter is a mean over the frame, so that it falls as 1 / side
    clipped = 1.0 - seen.mean((-2, -1)).to(straight)
    size = torch.maximum(straight, spread).clamp_min(1e-30) * (_SIDE / side)
    scatter = (spread.square() - ideal.square()).clamp_min(0.0).sqrt() / size
    faint = math.sqrt(_PLAIN**2 - 1.0) * ideal / size
    told = scatter > faint
    hidden = torch.special.ndtr((faint / _USUAL).log() / math.log(_FACTOR))
    dirty = torch.ones_like(size) if bool(told.any()) else hidden / (1.0 + hidden)
    scatter = torch.where(told, scatter, faint.clamp_max(_USUAL))
    width = torch.where(told, _WIDTHS[0], _WIDTHS[1])
    middle = math.log(_LOST) + _POWER * scatter.log() + _CLIPPED * clipped
    lost = torch.exp(middle[:, None] + width[:, None] * _normal_quantiles().to(size)).clamp_max(_ALL)
    return _quantiles(straight, spread, lost, dirty)


def _normal_quantiles() -> Tensor:
    quantiles: Tensor = torch.special.ndtri((torch.arange(_NODES, dtype=torch.float64) + 0.5) / _NODES)
    return quantiles


def _quantiles(straight: Tensor, spread: Tensor, lost: Tensor, dirty: Tensor) -> tuple[Tensor, Tensor]:
    """Return the median and a 90 % interval of straight light with its error, times the exponential of what is lost.

    ``lost`` (channel, node) are equally likely values for a dirty lens, ``dirty`` (channel,) is its probability.
    """
    whole = straight[:, None] * torch.cat([torch.ones_like(lost[:, :1]), lost.exp()], 1)
    weight = torch.cat([1.0 - dirty[:, None], (dirty / lost.shape[1])[:, None].expand_as(lost)], 1)
    wanted = torch.tensor(_ENDS).to(whole).expand(len(whole), -1)
    low = (whole.amin(1) - 8.0 * spread)[:, None].expand_as(wanted)
    high = (whole.amax(1) + 8.0 * spread)[:, None].expand_as(wanted)
    for _ in range(_HALVINGS):
        middle = 0.5 * (low + high)
        below = torch.special.ndtr((middle[..., None] - whole[:, None]) / spread.clamp_min(1e-30)[:, None, None])
        short = (weight[:, None] * below).sum(-1) < wanted
        low, high = torch.where(short, middle, low), torch.where(short, high, middle)
    return high[:, 0], high[:, 1:]
