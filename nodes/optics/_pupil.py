"""The pupil function, stored as factors: stop, mask, aberrations, dirt and shade."""

from collections.abc import Mapping
from typing import Any

import torch
from torch import Tensor

from neusee.nodes import Check, node
from neusee.nodes._half_precision import refuse_half
from neusee.nodes.optics._phase_steps import LARGE_STEPS, phase_steps
from neusee.nodes.optics._pupil_grid import PupilGrid, axes, grid_of, inside, opening, refuse_other_grid, stripes
from neusee.nodes.optics._zernike import surface
from neusee.nodes.units import Count, Length, Waves
from neusee.nodes.values import Bands, Dirt, Pupil, Shade, Stop, Wavefront

DEFOCUS_WAVELENGTH = 550e-9  #: m; the wavelength in which waves of defocus are counted
_ROWS = 512  #: least number of pupil rows in which phase steps are measured


@node(additive_inputs=[("dirt",)])
def pupil(
    height: Tensor,
    index: Tensor,
    bands: Bands,
    stop: Stop,
    dirt: Dirt | None = None,
    wavefront: Wavefront | None = None,
    shade: Shade | None = None,
    *,
    defocus: Waves = 0.0,
    aberrations: dict[Count, Length] = {},  # noqa: B006 (read only)
) -> Pupil:
    """Build the pupil function from stop, mask, defocus, aberrations, dirt and shade, all in one plane.

    Field of band b: amplitude * exp(2 pi i (index[b] * height + path) / wavelength[b]). Defocus adds the path
    W * 550 nm * r**2 with r = 1 at the rim, so W is the peak-to-valley defocus in waves at 550 nm. A `wavefront` adds
    the taper and the curvature of a laser beam; the lens without defocus is focused at infinity. The stop passes a
    sample if the centre of the sample lies inside the stop. A shade is a grey filter, a smaller stop or a notch filter.
    The aperture stays that of the lens, so that the PSF and the laser suppression ratio count the light that is lost.

    Shapes: height (v, u), index (band,), bands, stop, dirt (v, u), shade (v, u) -> Pupil.
    Units:  height m; defocus waves at 550 nm; aberrations m of path, root mean square, by Noll index.
    Error:  path 1e-7 relative (float32); area of the staircase rim 2 / samples.
    Raises: ValueError where the shapes do not belong together, and for a height in half precision.
    Source: Goodman, Introduction to Fourier Optics, 3rd ed., section 6.4; Noll, J. Opt. Soc. Am. 66, 207 (1976).
    """
    grid = grid_of(stop)
    _shapes(height, index, bands, grid, dirt, shade)
    clear = opening(grid, height.dtype, height.device)
    sag: float | Tensor = defocus * DEFOCUS_WAVELENGTH
    if wavefront is not None and bool(wavefront.curvature):
        sag = sag + wavefront.curvature.to(height.device) * grid.diameter**2 / 8
    path = _lens_path(grid, sag, aberrations, height)
    if dirt is not None:
        path = dirt.path if path is None else path + dirt.path
    if path is None:
        path = torch.zeros_like(height)
    amplitude = clear if dirt is None else clear * dirt.amplitude
    if wavefront is not None and bool(wavefront.taper):
        amplitude = amplitude * _taper(grid, wavefront.taper.to(height.device) * grid.diameter**2 / 4, height)
    if shade is not None:
        amplitude = amplitude * shade.amplitude
    notches = torch.zeros(0, 3, dtype=torch.float64) if shade is None else shade.notches
    there = (each.to(height.device) for each in (stop.pitch, notches))
    return Pupil(clear, amplitude, height, path, index, bands.centres, *there)


def _taper(grid: PupilGrid, exponent: Tensor, like: Tensor) -> Tensor:
    """Return the amplitude exp(-exponent r^2) of a Gaussian beam, with r = 1 at the rim of the stop."""
    amplitude = torch.empty_like(like)
    v, u = axes(grid, like.device)
    for rows in stripes(grid):
        amplitude[rows] = torch.exp(-exponent * (v[rows].square() + u.square()))
    return amplitude


def _lens_path(
    grid: PupilGrid, defocus: float | Tensor, aberrations: Mapping[int, float], like: Tensor
) -> Tensor | None:
    """Return the optical path of defocus and aberrations, or None for a lens without both; ``defocus`` is in m."""
    if not bool(defocus) and not any(aberrations.values()):
        return None
    path, device = torch.empty_like(like), like.device
    v, u = axes(grid, device)
    for rows in stripes(grid):
        bowl = torch.where(inside(grid, device, rows), v[rows].square() + u.square(), 0.0)
        path[rows] = defocus * bowl + surface(aberrations, grid, device, rows)
    return path


def _shapes(
    height: Tensor, index: Tensor, bands: Bands, grid: PupilGrid, dirt: Dirt | None, shade: Shade | None
) -> None:
    refuse_half(height=height)
    refuse_other_grid(height, grid)
    if index.shape != bands.centres.shape:
        raise ValueError(
            f"index {tuple(index.shape)} and bands {tuple(bands.centres.shape)}: "
            "compute both from one `bands` or `line` step"
        )
    for name, screen in (("dirt", dirt), ("shade", shade)):
        if screen is not None and screen.amplitude.shape != height.shape:
            found, wanted = tuple(screen.amplitude.shape), tuple(height.shape)
            raise ValueError(f"{name} is {found} and height is {wanted}: compute both from one `stop` step")


@pupil.check
def _(result: Pupil, height: Tensor, index: Tensor, bands: Bands, stop: Stop, *_: Any, **__: Any) -> list[Check]:
    samples, pitch, diameter = grid_of(stop)
    passed = _light(result.amplitude) / _light(result.aperture)
    median, share = phase_steps(result)
    text = f"phase step {median:.3f} turn between samples (median), {share:.1%} above half a turn"
    return [
        Check(f"throughput {passed:.4f} of the clear pupil {min(samples * pitch, diameter) * 1e3:#.3g} mm", passed > 0),
        Check(text if share <= LARGE_STEPS else f"{text}: aliased, use a finer pupil pitch", share <= LARGE_STEPS),
    ]


def _light(amplitude: Tensor) -> float:
    return float(torch.bmm(amplitude[:, None, :], amplitude[:, :, None]).sum(dtype=torch.float64))
