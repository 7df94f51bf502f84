"""The sources of the scatter of a real camera's levels: statistics of the frames, lamp, dark signal and variances."""

from __future__ import annotations

import math
from collections.abc import Mapping
from typing import Any

import torch
from torch import Tensor

from neusee.nodes.calibrate._emva_fit import without_histograms
from neusee.nodes.calibrate._likelihood._camera_likelihood import CAMERA_PARAMETERS, _Camera, _signal, _used
from neusee.nodes.values import Levels

STATISTICS = "statistics of the frames"
LAMP = "lamp, from level to level"
DRIFT = "dark signal, from level to level"
SCATTER = "variances, beyond sampling"
SOURCES = (STATISTICS, LAMP, DRIFT, SCATTER)


def camera_sources(levels: Levels, params: Mapping[str, Any]) -> dict[str, Tensor]:
    """Return the share of each source in the variance of each row of `Likelihood.scaled` of `camera`.

    ``params`` are the parameters of `camera` at the mode.

    Shapes: levels (level,) -> (row,) by source; the shares of a row add up to 1.
    Units:  none.
    Error:  exact for the model of `camera`.
    Source: the variance of a mean and of a log variance in `camera`, term by term.
    """
    seen, top, _ = _used(levels, params["share"])
    used = without_histograms(levels, seen)
    camera = _Camera(*(torch.as_tensor(params[name], dtype=torch.float64) for name in CAMERA_PARAMETERS))
    signal = _signal(used.mean - camera.signal, top, camera)
    light = camera.lamp * camera.efficiency * used.photons * signal.slope
    chance, drift = used.variance / used.pixels, camera.drift.square() * torch.ones_like(light)
    means = {STATISTICS: chance, LAMP: light.square(), DRIFT: drift}
    variances = {STATISTICS: 2.0 / used.degrees_of_freedom, SCATTER: camera.scatter.square() * torch.ones_like(light)}
    parts = [_shares(each) for each in (variances, means)]
    none = torch.zeros_like(light)
    rows = {source: [part.get(source, none) for part in parts] for source in SOURCES}
    return {source: torch.cat([a, a, b, b]) for source, (a, b) in rows.items()}


def source_freedom(levels: Levels, params: Mapping[str, Any], free: tuple[str, ...]) -> dict[str, float]:
    """Return the degrees of freedom of each source: observations that scatter, less the ``free`` parameters they fit.

    Shapes: scalars by source.
    Units:  none.
    Source: JCGM 100:2008 (GUM), section 4.2.6 and G.3.3.
    """
    seen, _, _ = _used(levels, params["share"])
    lit = int((levels.photons[seen] > 0).sum())
    response = [name in free for name in ("quantum_efficiency", "bend", "twist")]
    dark = [name in free for name in ("dark_signal", "dark_current")]
    noise = [name in free for name in ("gain", "temporal_dark_noise")]
    return {
        STATISTICS: float(levels.degrees_of_freedom[seen].sum()),
        LAMP: float(max(1, lit - sum(response))),
        DRIFT: float(max(1, len(seen) - lit - sum(dark))),
        SCATTER: float(max(1, len(seen) - sum(noise))),
    }


def variance_shares(slopes: Tensor, sources: Mapping[str, Tensor], along: Tensor) -> dict[str, float]:
    """Return the share of each source, and of the prior, in the variance of a function of the parameters.

    The estimate is linear in the scattering rows, so that its covariance is a sum over sources: C J^T F J C for the
    shares F of a source in the rows, and C C for the prior, with C = (J^T J + 1)^-1.

    Shapes: slopes (row, free) derivatives per standard deviation of the prior; sources (row,) shares; along (free,)
            derivative of the function per standard deviation of the prior -> shares that add up to 1.
    Units:  none.
    Source: JCGM 100:2008 (GUM), section 5.1, for a least-squares estimate with a prior.
    """
    free = slopes.shape[1]
    root = torch.linalg.cholesky(slopes.T @ slopes + torch.eye(free, dtype=slopes.dtype))
    gradient = torch.cholesky_solve(along[:, None], root)[:, 0]
    response = slopes @ gradient
    parts = {name: float((share * response.square()).sum()) for name, share in sources.items()}
    parts["prior"] = float(gradient @ gradient)
    total = math.fsum(parts.values())
    return {name: part / total for name, part in parts.items()}


def _shares(parts: Mapping[str, Tensor]) -> dict[str, Tensor]:
    total = torch.stack(list(parts.values())).sum(0)
    return {name: part / total for name, part in parts.items()}
