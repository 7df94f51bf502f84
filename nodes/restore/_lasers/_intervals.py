"""How well a frame tells the values of each laser: from the curvature of the fit and the scatter of its residual."""

from __future__ import annotations

from typing import NamedTuple

import torch
from torch import Tensor
from torch.nn.functional import pad

from neusee.nodes.restore._lasers._components import NANOMETRE, Laser
from neusee.nodes.restore._lasers._joint_fit import Fit, products, solved

NORMAL = 1.6448536269514722  #: standard deviations on each side of a 90 % interval
_BLOCK = 8  #: pixels a side of blocks whose residuals count as independent of one another
_MODEL = (0.0036, 0.0036, 0.08)  #: pixels, pixels and nm, standard deviations of what dirt and defocus change
_GRAINS = (0.23, 0.23, 5.9)  #: the same over the root of the number of pixels seen, whose scattered light is random
_SHAPE = 0.03  #: standard deviation of the wavelength from the unknown shape of a line, over the width of the line
_AMOUNT = 0.0015  #: the same of the electrons of each channel, relative


class Spread(NamedTuple):
    """How well a frame tells the values of one laser."""

    covariance: Tensor  #: (value, value), of y, x (pixels), nm, and the electrons of each channel
    ideal: Tensor  #: (channel,) e-, standard deviation of these electrons behind a lens that is as its recipe says


def spreads(fit: Fit, seen: Tensor) -> list[Spread]:
    """Return for each laser how well its values are told.

    ``seen`` (channel, y, x) is 0 for clipped pixels, which the fit has after all others, if at all. The inverse of the
    second derivatives is enlarged where the slopes of blocks of the frame scatter more than the model says.
    """
    count = len(fit.normal)
    inverse = solved(fit.normal, torch.eye(count).to(fit.normal))
    each = (fit.columns * fit.rest).double()
    pictures = each[:, : seen.numel()].view(count, *seen.shape)
    if each.shape[1] > seen.numel():
        pictures[:, seen == 0] = each[:, seen.numel() :]  # a clipped pixel has no residual
    scores = pictures.sum(1)
    y, x = (-n % _BLOCK for n in seen.shape[-2:])
    blocks = pad(scores, (0, x, 0, y)).unfold(1, _BLOCK, _BLOCK).unfold(2, _BLOCK, _BLOCK).sum((-2, -1)).flatten(1)
    prior = fit.normal - products(fit.columns)
    scattered = inverse @ (blocks @ blocks.T + prior) @ inverse
    growth = (scattered.diagonal() / inverse.diagonal().clamp_min(1e-300)).clamp_min(1.0).sqrt()
    whole = growth[:, None] * inverse * growth
    found, first = [], 0
    for part in fit.parts:
        own = slice(first, first + len(part.values))
        first += len(part.values)
        if isinstance(part, Laser):
            pixels = int(seen.amin(0).sum())
            grown, ideal = (_of_channels(part, each[own, own], pixels) for each in (whole, inverse))
            found.append(Spread(grown, ideal.diagonal()[3:].sqrt()))
    return found


def _of_channels(laser: Laser, own: Tensor, pixels: int) -> Tensor:
    """Return the covariance of place, wavelength and electrons of each channel, with what the model neglects.

    ``pixels`` counts those that no channel clips.
    """
    slopes = laser.channel_slopes().to(own)
    to = torch.zeros(3 + len(slopes), len(own)).to(own)
    to[:3, :3] = torch.eye(3).to(own)
    to[3:] = slopes
    neglected = torch.zeros(len(to)).to(own)
    grains = torch.tensor(_GRAINS).to(own).square() / max(pixels, 1)
    neglected[:3] = torch.tensor(_MODEL).to(own).square() + grains
    neglected[2] += (_SHAPE * laser.fwhm.to(own) / NANOMETRE).square()
    neglected[3:] = (_AMOUNT * laser.channels()).square().to(own)
    return to @ own @ to.T + neglected.diag()
