"""First guesses of the parameters of a sensor or camera, from measured light levels."""

from __future__ import annotations

import math
from collections.abc import Mapping
from typing import Any

import torch

from neusee.nodes.calibrate._emva_fit import least_squares, without_histograms
from neusee.nodes.calibrate._likelihood._linear_sensor import ROUNDED
from neusee.nodes.calibrate._likelihood._sufficient_statistics import Sufficient
from neusee.nodes.values import Levels

_ABOVE = 1.3  #: factor on the brightest number, for a full well that no level reaches
_LEAST = 1e-3  #: least dark current or read noise, relative to the believed value


def guess(levels: Sufficient, believed: Mapping[str, float], params: Mapping[str, Any]) -> dict[str, float]:
    """Return a least-squares estimate of each sensor parameter, or the ``believed`` value if there is no estimate.

    ``params`` are the fixed parameters of `density`.

    Shapes: levels (level,); numbers by name, with the names of ``believed``.
    Units:  those of `density`.
    Error:  a start for a search, not an estimate.
    Source: EMVA Standard 1288, release 4.0 Linear, sections 6.6 to 6.8.
    """
    values = dict(believed)
    try:
        fit = least_squares(without_histograms(Levels(*levels), levels.pixels > 0))
    except ValueError:
        return values | {"full_well": _well(levels, values, params)}
    gain = float(fit.gain)
    dark = float(fit.dark_current) * params["dark_exposure"]
    first = levels.exposure[levels.photons == 0].min()
    ahead = float(first) / params["dark_exposure"] * (dark if dark > 0 else 0.0)
    values |= {
        "gain": gain,
        "quantum_efficiency": float(fit.efficiency),
        "offset": (float(fit.dark_signal) - ROUNDED[params["rounding"]][0]) / gain - ahead,
        "read_noise": max(float(fit.temporal_dark_noise), _LEAST * believed["read_noise"]),
        "dark_current": dark if dark > 0 else _LEAST * believed["dark_current"],
    }
    return values | {"full_well": _well(levels, values, params)}


def guess_camera(levels: Levels, believed: Mapping[str, float], params: Mapping[str, Any]) -> dict[str, float]:
    """Return a least-squares estimate of each camera parameter, or the ``believed`` value if there is no estimate.

    ``params`` are the fixed parameters of `camera`.

    Shapes: levels (level,); numbers by name, with the names of ``believed``.
    Units:  those of `camera`.
    Error:  a start for a search, not an estimate.
    Raises: ValueError where `least_squares` raises ValueError.
    Source: EMVA Standard 1288, release 4.0 Linear, sections 6.6 to 6.8.
    """
    fit = least_squares(levels, share=params["share"])
    gain = float(fit.gain)
    values = {
        "gain": gain,
        "quantum_efficiency": float(fit.efficiency),
        "dark_signal": float(fit.dark_signal),
        "temporal_dark_noise": float(fit.temporal_dark_noise),
        "dark_current": float(fit.dark_current) * params["dark_exposure"],
    }
    usable = {name: x for name, x in values.items() if math.isfinite(x) and (x > 0 or name == "dark_signal")}
    return {**believed, **usable}


def _well(levels: Sufficient, values: Mapping[str, float], params: Mapping[str, Any]) -> float:
    """Return the full well at which numbers pile up, or, if none pile up, a full well above every number."""
    top, shift, gain = 2 ** params["bits"] - 1, ROUNDED[params["rounding"]][0], float(values["gain"])
    seen = levels.mean[levels.pixels > 0]
    brightest = max([*seen.tolist(), *levels.cell_value.tolist()], default=0.0)
    at = levels.cell_value >= brightest - 2
    piled = bool(at.any()) and float(levels.cell_count[at].sum()) > 0.5 * float(levels.cell_count.max())
    if piled and brightest < top:
        weight = levels.cell_count[at]
        return float((levels.cell_value[at] * weight).sum() / weight.sum() - shift) / gain
    return max(values["full_well"], _ABOVE * min(brightest + 1, torch.inf) / gain)
