"""Where around a rough candidate a pattern gains most, with the clipped pixels left out as in the fit."""

from __future__ import annotations

import torch
from torch import Tensor

from neusee.nodes.restore._lasers._candidates import Candidate
from neusee.nodes.restore._lasers._components import NANOMETRE, Camera
from neusee.nodes.restore._lasers._joint_fit import Data
from neusee.nodes.restore._lasers._line_pattern import grid_patterns, response_at
from neusee.nodes.restore._lasers._whitening import Filter, Weights

_HALVES, _NEAR = (-0.6, -0.3, 0.0, 0.3, 0.6), (-3.0, -1.5, 0.0, 1.5, 3.0)  #: pixels and nm around a candidate
FAR = tuple(1.5 * n for n in range(-10, 11))  #: nm around a laser whose colours do not fit its wavelength
_COARSE, _TILES = (-0.5, 0.0, 0.5), (-3.0, -1.5, 0.0, 1.5, 3.0)  #: pixels around a tile, and of the tiles
_AROUND = 256  #: pixels a side of the window in which these are compared


def nearest_of_many(camera: Camera, data: Data, residual: Tensor, start: Candidate) -> Candidate:
    """Return the best candidate within 3.5 pixels and 3 nm of a rough one; ``residual`` is filtered.

    Clipped pixels tell the place of a wide pattern to a few pixels, and a pattern of fine rings gains nothing where it
    is half a pixel off.
    """
    y, x = start.spot
    tiles = [start._replace(spot=(y + down, x + right)) for down in _TILES for right in _TILES]
    best = max(nearest(camera, data, residual, tile, halves=_COARSE) for tile in tiles)
    return nearest(camera, data, residual, best)


def nearest(
    camera: Camera,
    data: Data,
    residual: Tensor,
    start: Candidate,
    *,
    halves: tuple[float, ...] = _HALVES,
    near: tuple[float, ...] = _NEAR,
) -> Candidate:
    """Return the best of the candidates around one, because the rings far from a clipped spot are narrow.

    Candidates are ``halves`` (pixels) away along y and along x, and ``near`` (nm); ``residual`` is filtered. All
    channels count with the responses of the camera, so that a wrong wavelength gains less than in a fit.
    """
    window, middle = _window(residual, start.spot)
    seen = Filter(data.use.seen[..., *window], data.use.kernel)
    within = Weights(*(x[..., *window] for x in data.weights))
    white, best = within(residual[..., *window]), start._replace(gain=0.0)
    lens = camera.lens._replace(shape=(white.shape[-2], white.shape[-1]))
    down, right = (
        torch.tensor([at + half - m for half in halves], dtype=torch.float64, device=white.device)
        for at, m in zip(start.spot, middle, strict=True)
    )
    for nm in near:
        wavelength = torch.tensor(start.wavelength + nm * NANOMETRE, dtype=torch.float64, device=white.device)
        heard = start.strength * response_at(wavelength, camera.responses, camera.bands).to(white)
        patterns = grid_patterns(camera.pupil, down, right, wavelength, lens).to(white)
        light = within(heard[:, None, None] * seen(patterns.flatten(0, 1)[:, None]))
        product, norm = (light * white).sum((1, 2, 3)), light.square().sum((1, 2, 3)).clamp_min(1e-30)
        gain = 0.5 * product.clamp_min(0.0).square() / norm
        n = int(gain.argmax())
        if float(gain[n]) > best.gain:
            y, x = divmod(n, len(halves))
            spot = (start.spot[0] + halves[y], start.spot[1] + halves[x])
            strength = max(float(product[n] / norm[n]), 0.01) * start.strength
            best = Candidate(float(gain[n]), spot, float(wavelength), strength)
    return best


def _window(frame: Tensor, spot: tuple[float, float]) -> tuple[tuple[slice, slice], tuple[int, int]]:
    """Return the window of a frame around a spot that tells the candidates apart, and where its middle lies."""
    window, middle = [], []
    for n, at in zip(frame.shape[-2:], spot, strict=True):
        side = min(n, _AROUND)
        first = min(max(round(at) + n // 2 - side // 2, 0), n - side)
        window.append(slice(first, first + side))
        middle.append(first + side // 2 - n // 2)
    return (window[0], window[1]), (middle[0], middle[1])
