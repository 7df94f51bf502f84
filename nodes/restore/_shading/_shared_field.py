"""The field that frames share, from the logarithms of their cells, with its posterior distribution."""

from __future__ import annotations

import math
from collections.abc import Sequence
from typing import NamedTuple

import torch
from torch import Tensor

from neusee.nodes.restore._shading._frame_cells import Cells
from neusee.nodes.restore._shading._scene_spectra import Likelihood, habits, likelihoods, shared_detail

DEVIATIONS = (0.05, 0.1, 0.15, 0.2, 0.3, 0.4, 0.5)  #: of the logarithm of the field, if there is dirt
LENGTHS = (0.12, 0.2, 0.35)  #: correlation lengths of the field, relative to the longer side of the frame
CLEAN = 0.5  #: prior probability that there is no field
_ROUNDS = 6
_LEAST = 1e-8  #: variance of a mode of the prior relative to the largest, below which the mode is left out


class Field(NamedTuple):
    """The posterior distribution of the logarithm of the field, whose mean over the cells is 0."""

    mean: Tensor  #: (cell,) float64
    covariance: Tensor  #: (cell, cell) float64
    clean: float  #: probability that there is no field
    alike: float  #: correlation of the details of two scenes
    scenes: float  #: number of different scenes that tell as much as the frames


def shared_field(frames: Sequence[Cells], grid: tuple[int, int]) -> Field:
    """Return the posterior of the field that all frames share, given that their scenes are drawn independently.

    Each log-frame is a constant, the field, and a scene whose spectrum is a power law with strength, exponent and
    stretch of its own. These are fitted to each frame together with the field, by variational Bayes.
    """
    laws = {bytes(frame.seen.tolist()): frame for frame in frames}
    known = {seen: likelihoods(frame, grid) for seen, frame in laws.items()}
    found = [known[bytes(frame.seen.tolist())] for frame in frames]
    alike = shared_detail([frame.log for frame in frames], [frame.seen for frame in frames], grid)
    single = 1.0 + (len(frames) - 1) * alike  # frames that tell as much as one frame
    modes = [_modes(grid, length) for length in LENGTHS]
    size = grid[0] * grid[1]
    field = Field(torch.zeros(size).double(), torch.zeros(size, size).double(), CLEAN, alike, len(frames) / single)
    for _ in range(_ROUNDS):
        precision, pull = torch.zeros(size, size).double(), torch.zeros(size).double()
        for frame, each in zip(frames, found, strict=True):
            own = _expected(each, frame, field)
            precision += own / single
            pull += own @ frame.log / single
        common = torch.eye(size).double() + precision @ habits(precision, len(frames) / single, grid)
        field = _posterior(torch.linalg.solve(common, precision), torch.linalg.solve(common, pull), modes, field)
    return field


def _expected(found: Likelihood, frame: Cells, field: Field) -> Tensor:
    """Return the expected precision (cell, cell) of one frame, given the field that is assumed at present."""
    left = torch.where(frame.seen, frame.log - field.mean, 0.0)
    misfit = torch.einsum("a,kab,b->k", left, found.precision, left)
    misfit = misfit + torch.einsum("kab,ab->k", found.precision, field.covariance)
    freedom = max(int(frame.seen.sum()) - 1, 1)
    weight = torch.softmax(found.log_root - 0.5 * freedom * misfit.clamp_min(1e-300).log(), 0)
    precision: Tensor = torch.einsum("k,kab->ab", weight * freedom / misfit.clamp_min(1e-300), found.precision)
    return precision


def _modes(grid: tuple[int, int], length: float) -> Tensor:
    """Return factors (cell, mode) of the prior covariance of a field of deviation 1 whose mean is 0."""
    y, x = torch.meshgrid(*(torch.arange(n, dtype=torch.float64) for n in grid), indexing="ij")
    places = torch.stack([y.flatten(), x.flatten()], 1)
    covariance = torch.exp(-0.5 * (torch.cdist(places, places) / (length * max(grid))).square())
    covariance = covariance - covariance.mean(0) - covariance.mean(1, keepdim=True) + covariance.mean()
    values, vectors = torch.linalg.eigh(covariance / covariance.diagonal().mean())
    kept = values > _LEAST * values[-1]
    factor: Tensor = vectors[:, kept] * values[kept].sqrt()
    return factor


def _posterior(precision: Tensor, pull: Tensor, modes: Sequence[Tensor], last: Field) -> Field:
    """Return the mixture of the posteriors over all deviations and lengths of the field, and over no field."""
    deviations = torch.tensor(DEVIATIONS).double()[:, None]
    gains, parts = [], []
    for factor in modes:
        inner = factor.mT @ precision @ factor
        known, turned = torch.linalg.eigh((inner + inner.mT) / 2)
        known, seen = known.clamp_min(0.0), turned.mT @ (factor.mT @ pull)
        left = 1.0 / (deviations**-2 + known)
        gains.append(0.5 * (left * seen.square() - torch.log1p(deviations**2 * known)).sum(1))
        parts.append((factor @ turned, left, left * seen))
    gain = torch.stack(gains) - math.log(len(gains) * len(DEVIATIONS))
    share = torch.softmax(gain.flatten(), 0).view_as(gain)
    middles = torch.cat([moved @ shapes.mT for shapes, _, moved in parts])
    mean = share.flatten() @ middles
    about = middles - mean
    covariance = (share.flatten() * about.mT) @ about
    for weight, (shapes, left, _) in zip(share, parts, strict=True):
        covariance = covariance + (shapes * (weight @ left)) @ shapes.mT
    odds = math.exp(min(float(torch.logsumexp(gain.flatten(), 0)), 700.0)) * (1.0 - CLEAN) / CLEAN
    return last._replace(mean=mean, covariance=covariance, clean=1.0 / (1.0 + odds))
