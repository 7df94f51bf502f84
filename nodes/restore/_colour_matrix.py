"""The colour matrix, which converts electrons of the channels to the colour of the scene in daylight."""

import math
from typing import Any

import torch
from torch import Tensor

from neusee.nodes import Check, ErrorBound, TensorStats, node
from neusee.nodes.scene._grey import luminance
from neusee.nodes.sensor._exposure import channel_weights
from neusee.nodes.sensor._saturation import Efficiency
from neusee.nodes.spectra._spectral_tables import paints, to_srgb
from neusee.nodes.units import Exposure, PixelPitch
from neusee.nodes.values import Bands


@node(rtol=1e-9)
def colour_matrix(
    bands: Bands,
    illuminant: Tensor,
    responses: Tensor,
    level: Tensor,
    *,
    pixel_pitch: PixelPitch,
    exposure: Exposure,
    quantum_efficiency: Efficiency,
) -> Tensor:
    """Compute the matrix from electrons to linear sRGB with the least mean square error over measured paints.

    Linear least mean square over the reflectances s of colour charts, C = E[s s^T]: M = T C A^T (A C A^T)^-1, where
    A s are the electrons under this illuminant and T s is the linear sRGB under D65. The matrix includes white balance.
    A sensor with a single channel sees no colour: T s is the luminance then, equal in red, green and blue.

    Shapes: bands, illuminant, level (band,), responses (channel, band) -> (3, channel) float64.
    Units:  linear sRGB per electron.
    Error:  metamerism: rms 0.01 to 0.05 on the charts, depending on the channels; larger for saturated lights. The
            light of the scene is assumed to be reflected once.
    Raises: ValueError where the bands of the inputs differ.
    Source: Wiener estimation as in Pratt and Mancill, Appl. Opt. 15, 73 (1976); charts of colour-science.
    """
    spectra = _paints(bands.centres)
    second = spectra.T @ spectra / len(spectra)
    pixel = {"pixel_pitch": pixel_pitch, "exposure": exposure}
    counts = _counts(bands, illuminant, responses, level, quantum_efficiency, **pixel)
    rgb = _target(bands.centres, len(counts))
    seen = counts @ second @ counts.T
    ridge = (1e-12 * seen.diagonal().mean()).clamp_min(1e-200) * torch.eye(len(seen), dtype=torch.float64)
    matrix: Tensor = torch.linalg.solve(seen + ridge, counts @ second @ rgb.T).T
    return matrix


@colour_matrix.check
def _(result: Tensor, *inputs: Any, **params: float) -> list[Check]:
    bands, illuminant, responses, level = inputs
    spectra = _paints(bands.centres)
    counts = _counts(bands, illuminant, responses, level, **params)
    off = (spectra @ counts.T @ result.T - spectra @ _target(bands.centres, len(result[0])).T).square().mean().sqrt()
    what = "colour" if len(result[0]) > 1 else "luminance"
    return [Check(f"rms {what} error {float(off):.3f} on colour charts", float(off) < 0.1)]


@colour_matrix.propagate_error
def _(bands: ErrorBound, illuminant: ErrorBound, responses: ErrorBound, level: ErrorBound, **params: Any) -> float:
    """Return an error bound of the matrix, which is inversely proportional to the factor `level`.

    An error of the level that differs from band to band changes the matrix in other ways, so that it has no bound.
    """
    result: TensorStats = params["result"]
    if any(given.rms for given in (bands, illuminant, responses)) or level.share >= 1.0:
        return math.inf
    if level.rms and (level.stats is None or level.stats.min < level.stats.max):
        return math.inf
    return level.share / (1.0 - level.share) * result.largest_rms


@colour_matrix.expected_range
def _(*inputs: Any, **params: Any) -> tuple[float, float]:
    """Return a range whose size does not matter: the colours are relative to the largest element of the matrix."""
    return 0.0, 1.0


def _target(centres: Tensor, channels: int) -> Tensor:
    """Return the matrix (3, band) from reflectance to linear sRGB, or to grey for a sensor with a single channel."""
    rgb = to_srgb(centres)
    return rgb if channels > 1 else luminance(rgb, 0).expand(3, -1)


def _counts(
    bands: Bands, illuminant: Tensor, responses: Tensor, level: Tensor, quantum_efficiency: float, **pixel: float
) -> Tensor:
    """Return the electrons in each channel for one unit of reflectance in each band, on the CPU."""
    lit = level.cpu().double() * illuminant.cpu().double()
    weights = channel_weights(bands, responses.cpu(), lit, **pixel)
    return weights * quantum_efficiency


def _paints(centres: Tensor) -> Tensor:
    """Return the reflectances of the colour charts at the wavelengths ``centres``: (paint, band) float64."""
    return torch.cat([paint.at(centres) for paint in paints()])
