"""The pupil function, stored as factors, and whether its samples resolve the phase."""

from collections.abc import Mapping
from typing import Any

import torch
from torch import Tensor

from neusee.nodes import Check, node
from neusee.nodes.optics._pupil_grid import (
    PupilGrid,
    axes,
    clear_diameter,
    grid_of,
    opening,
    refuse_other_grid,
    stripes,
)
from neusee.nodes.optics._zernike import combine
from neusee.nodes.precision import refuse_half
from neusee.nodes.units import Count, Height, Waves
from neusee.nodes.values import Bands, Dirt, Pupil, Shade, Stop, Wavefront

# --- phase steps ----------------------------------------------------------------------------------

# Phase differences between neighbouring pupil samples, which show whether the samples resolve the
# phase.


LARGE_STEPS = 0.1  #: share of steps above half a turn, from which the pupil counts as aliased
_ROWS = 256  #: the least number of pupil rows in which phase steps are measured


def phase_steps(pupil: Pupil) -> tuple[float, float]:
    """Return the median phase step between neighbouring samples, in turns, and the share of steps
    above half a turn.

    Both numbers are from the band with the largest phase steps, inside the stop. In a large pupil
    only every k-th row is measured, 256 rows or more. A wrapped or split mask has steps at its
    edges by design, so a few large steps mean nothing. Many large steps mean that the samples
    cannot follow the phase.
    """
    steepest_band = int((pupil.index / pupil.wavelengths).argmax())
    row_step = max(1, len(pupil.height) // _ROWS)
    # height, path and whether the stop is open, each row and the next one
    sampled_rows, rows_below = (
        [x[k::row_step] for x in (pupil.height, pupil.path, pupil.aperture > 0)] for k in (0, 1)
    )
    pairs = len(rows_below[0])
    steps = torch.cat(
        [
            _steps(pupil, steepest_band, [x[:pairs] for x in sampled_rows], rows_below),
            _steps(
                pupil,
                steepest_band,
                [x[:, :-1] for x in sampled_rows],
                [x[:, 1:] for x in sampled_rows],
            ),
        ]
    )
    return (
        (float(steps.median()), float((steps > 0.5).double().mean()))
        if steps.numel()
        else (0.0, 0.0)
    )


def pupil_has_large_steps(pupil: Pupil) -> bool:
    """Return True if so many phase steps exceed half a turn that the samples cannot follow the
    phase.
    """
    return phase_steps(pupil)[1] > LARGE_STEPS


def _steps(pupil: Pupil, band: int, first: list[Tensor], second: list[Tensor]) -> Tensor:
    """Return the absolute phase difference in turns, between neighbours that are both inside the
    stop.

    Differences are taken before the phase: in float32, a phase of thousands of turns has no digits
    left for its steps.
    """
    inside = first[2] & second[2]
    height, path = ((b - a)[inside] for a, b in zip(first[:2], second[:2], strict=True))
    steps: Tensor = (float(pupil.index[band]) * height + path).abs() / float(
        pupil.wavelengths[band]
    )
    return steps


def mask_turns(pupil: Pupil, band: int, step: int = 1) -> Tensor:
    """Return the phase of the mask in one band, in turns, float64, at every ``step``-th pupil
    sample.
    """
    turns: Tensor = (
        pupil.index[band] * pupil.height[::step, ::step].double() / pupil.wavelengths[band]
    )
    return turns


# --- pupil ----------------------------------------------------------------------------------------

# The pupil function, stored as factors: stop, mask, aberrations, dirt and shade.


DEFOCUS_WAVELENGTH = 550e-9  #: m; the wavelength in which waves of defocus are counted
_PUPIL_ROWS = 512  #: least number of pupil rows in which phase steps are measured


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
    aberrations: dict[Count, Height] = {},  # noqa: B006 (read only)
) -> Pupil:
    """Build the pupil function from stop, mask, defocus, aberrations, dirt and shade, all in one
    plane.

    Field of band b: amplitude * exp(2 pi i (index[b] * height + path) / wavelength[b]). Defocus
    adds the path W * 550 nm * r**2 with r = 1 at the rim, so W is the peak-to-valley defocus in
    waves at 550 nm. A `wavefront` adds the taper and the curvature of a laser beam; the lens
    without defocus is focused at infinity. The stop passes a sample if the centre of the sample
    lies inside the stop. A shade is a grey filter, a smaller stop or a notch filter. The aperture
    stays that of the lens, so that the PSF and the laser suppression ratio count the light that is
    lost.

    Shapes: height (v, u), index (band,), bands, stop, dirt (v, u), shade (v, u) -> Pupil.
    Units:  height m; defocus waves at 550 nm; aberrations m of path, root mean square, by Noll
            index.
    Error:  path 1e-7 relative (float32); area of the staircase rim 2 / samples.
    Raises: ValueError where the shapes do not belong together, and for a height in half precision.
    Source: Goodman, Introduction to Fourier Optics, 3rd ed., section 6.4; Noll, J. Opt. Soc. Am.
            66, 207 (1976).
    """
    grid = grid_of(stop)
    _shapes(height, index, bands, grid, dirt, shade)
    device = height.device
    clear = opening(grid, height.dtype, device)
    sag = defocus * DEFOCUS_WAVELENGTH + _beam_sag(grid, wavefront, device)
    notches = torch.zeros(0, 3, dtype=torch.float64) if shade is None else shade.notches
    return Pupil(
        aperture=clear,
        amplitude=_amplitude(grid, clear, dirt, wavefront, shade),
        height=height,
        path=_path(_lens_path(grid, sag, aberrations, height), dirt, height),
        index=index,
        wavelengths=bands.centres,
        pitch=stop.pitch.to(device),
        notches=notches.to(device),
        diameter=clear_diameter(stop).to(device),
    )


def _beam_sag(grid: PupilGrid, wavefront: Wavefront | None, device: torch.device) -> float | Tensor:
    """Return the path (m) by which the curvature of a beam differs from a plane wave at the rim
    of the stop.
    """
    if wavefront is None or not bool(wavefront.curvature):
        return 0.0
    return wavefront.curvature.to(device) * grid.diameter**2 / 8


def _path(lens: Tensor | None, dirt: Dirt | None, like: Tensor) -> Tensor:
    """Return the path of lens and dirt together; None is a lens without a path of its own."""
    if dirt is None:
        return torch.zeros_like(like) if lens is None else lens
    return dirt.path if lens is None else lens + dirt.path


def _amplitude(
    grid: PupilGrid,
    clear: Tensor,
    dirt: Dirt | None,
    wavefront: Wavefront | None,
    shade: Shade | None,
) -> Tensor:
    """Return the amplitude behind dirt, the taper of the beam and shade; ``clear`` itself where
    none is there.
    """
    amplitude = clear
    if dirt is not None:
        amplitude = amplitude * dirt.amplitude
    if wavefront is not None and bool(wavefront.taper):
        amplitude = amplitude * _taper(grid, wavefront.taper, clear)
    if shade is not None:
        amplitude = amplitude * shade.amplitude
    return amplitude


def _taper(grid: PupilGrid, taper: Tensor, like: Tensor) -> Tensor:
    """Return the amplitude (v, u) of a Gaussian beam with the ``taper`` (1/m2) of a `Wavefront`."""
    # at the rim of the stop, where v^2 + u^2 = 1
    exponent = taper.to(like.device) * grid.diameter**2 / 4
    along_v, along_u = (torch.exp(-exponent * line.square()) for line in axes(grid, like.device))
    amplitude = torch.empty_like(like)
    for rows in stripes(grid):
        amplitude[rows] = along_v[rows] * along_u
    return amplitude


def _lens_path(
    grid: PupilGrid, defocus: float | Tensor, aberrations: Mapping[int, float], like: Tensor
) -> Tensor | None:
    """Return the optical path of defocus and aberrations, or None for a lens without both;
    ``defocus`` is in m.
    """
    has_aberrations = any(aberrations.values())
    if not bool(defocus) and not has_aberrations:
        return None
    path = torch.empty_like(like)
    v, u = axes(grid, like.device)
    for rows in stripes(grid):
        squared_radius = v[rows].square() + u.square()
        # defocus is a paraboloid, of this path at the rim
        surface = defocus * squared_radius
        if has_aberrations:
            surface = surface + combine(aberrations, v[rows], u)
        path[rows] = surface.masked_fill_(squared_radius > 1, 0.0)
    return path


def _shapes(
    height: Tensor,
    index: Tensor,
    bands: Bands,
    grid: PupilGrid,
    dirt: Dirt | None,
    shade: Shade | None,
) -> None:
    """Raise ValueError unless height, index, dirt and shade have the pupil grid and the bands."""
    refuse_half(height=height)
    refuse_other_grid(height, grid)
    if index.shape != bands.centres.shape:
        raise ValueError(
            f"index {tuple(index.shape)} and bands {tuple(bands.centres.shape)}: "
            "compute both from one `bands` or `line` step"
        )
    for name, screen in (("dirt", dirt), ("shade", shade)):
        if screen is not None and screen.amplitude.shape != height.shape:
            shape, height_shape = tuple(screen.amplitude.shape), tuple(height.shape)
            raise ValueError(
                f"{name} is {shape} and height is {height_shape}: compute both from one `stop` step"
            )


@pupil.check
def _(
    result: Pupil, height: Tensor, index: Tensor, bands: Bands, stop: Stop, *_: Any, **__: Any
) -> list[Check]:
    samples, pitch, diameter = grid_of(stop)
    throughput = _light(result.amplitude) / _light(result.aperture)
    median, share = phase_steps(result)
    text = f"phase step {median:.3f} turn between samples (median), {share:.1%} above half a turn"
    return [
        Check(
            f"throughput {throughput:.4f} of the clear pupil"
            f" {min(samples * pitch, diameter) * 1e3:#.3g} mm",
            throughput > 0,
        ),
        Check(
            text if share <= LARGE_STEPS else f"{text}: aliased, use a finer pupil pitch",
            share <= LARGE_STEPS,
        ),
    ]


def _light(amplitude: Tensor) -> float:
    """Return the sum of the squared amplitude, by rows, so that float32 sums stay short."""
    return float(torch.bmm(amplitude[:, None, :], amplitude[:, :, None]).sum(dtype=torch.float64))
