"""The pupil function, stored as factors; Zernike polynomials, phase screens, and a test whether the
samples resolve the phase.
"""

import math
from collections.abc import Mapping
from typing import Any

import torch
from torch import Tensor

from neusee.nodes import Check, node
from neusee.nodes.optics._pupil_grid import (
    PupilGrid,
    clear_diameter,
    grid_of,
    inside_stop,
    pupil_axes,
    refuse_other_grid,
    row_stripes,
    stop_transmission,
)
from neusee.nodes.precision import refuse_half
from neusee.nodes.units import Count, Height, Waves
from neusee.nodes.values import Bands, Dirt, Pupil, Shade, Stop, Wavefront

# --- zernike --------------------------------------------------------------------------------------

# Zernike polynomials over the stop with unit root mean square, in Noll's numbering.


_ALL = slice(None)


def noll(index: int) -> tuple[int, int]:
    """Return the radial order n and the signed azimuthal order m (positive: cosine) of a Noll
    number.
    """
    if index < 1:
        raise ValueError(f"Zernike index {index}: Noll numbers begin at 1 (piston)")
    # n (n + 1) / 2 Noll numbers belong to radial orders below n
    n = (math.isqrt(8 * index - 7) - 1) // 2
    position = index - n * (n + 1) // 2 - 1
    m = 2 * ((position + (n + 1) % 2) // 2) + n % 2
    return n, (m if index % 2 == 0 else -m)


def _radial_coefficients(n: int, m: int) -> list[float]:
    """Return the coefficients of R(n, m)(r) / r**m in rising powers of r**2, where R is the
    orthonormal radial polynomial.
    """
    lower, upper, factorial = (n - m) // 2, (n + m) // 2, math.factorial
    norm = math.sqrt((n + 1) * (1 if m == 0 else 2))
    terms = reversed(range(lower + 1))
    return [
        norm
        * (-1) ** k
        * factorial(n - k)
        / (factorial(k) * factorial(upper - k) * factorial(lower - k))
        for k in terms
    ]


def _radial_by_azimuth(coefficients: Mapping[int, float]) -> dict[int, list[float]]:
    """Return for each signed azimuthal order the sum of its radial polynomials, weighted with their
    rms coefficients.
    """
    sums: dict[int, list[float]] = {}
    for index, rms in coefficients.items():
        n, m = noll(index)
        new_terms, earlier_terms = _radial_coefficients(n, abs(m)), sums.get(m, [])
        term_count = max(len(new_terms), len(earlier_terms))
        padded = [row + [0.0] * (term_count - len(row)) for row in (new_terms, earlier_terms)]
        sums[m] = [rms * a + b for a, b in zip(*padded, strict=True)]
    return sums


def _polynomial(coefficients: list[float], x: Tensor) -> Tensor:
    """Return the polynomial with coefficients in rising powers at x, by Horner's rule."""
    value = torch.full_like(x, coefficients[-1])
    for coefficient in coefficients[-2::-1]:
        value.mul_(x).add_(coefficient)
    return value


def zernike_sum(coefficients: Mapping[int, float], v: Tensor, u: Tensor) -> Tensor:
    """Return the weighted sum of Zernike polynomials at (v, u), which are in units of the radius;
    the keys of the weights are Noll numbers.

    The sum is written in powers of u + iv, so that neither the centre nor the jump of the azimuth
    at 180 degrees needs special treatment.
    Source: Noll, J. Opt. Soc. Am. 66, 207 (1976), Eqs. 1 and 2.
    """
    sums = _radial_by_azimuth(coefficients)
    square = v.square() + u.square()
    total, cosine, sine = (
        torch.zeros_like(square),
        torch.ones_like(square),
        torch.zeros_like(square),
    )
    for order in range(max(map(abs, sums), default=-1) + 1):
        for m, wave in ((order, cosine), (-order, sine)):
            if m in sums and (order or wave is cosine):
                total.addcmul_(_polynomial(sums[m], square), wave)
        # (u + i v)^m = r^m exp(i m phi): multiply by u + i v for the next order
        cosine, sine = cosine * u - sine * v, cosine * v + sine * u
    return total


def zernike_surface(
    coefficients: Mapping[int, float],
    grid: PupilGrid,
    device: torch.device | None = None,
    rows: slice = _ALL,
) -> Tensor:
    """Return a weighted sum of Zernike polynomials on the pupil grid (v, u), float64, 0 outside
    the stop.
    """
    v, u = pupil_axes(grid, device)
    return torch.where(inside_stop(grid, device, rows), zernike_sum(coefficients, v[rows], u), 0.0)


# --- phase screen ---------------------------------------------------------------------------------

# Smooth random phase screens over the pupil, independent of the sampling of the pupil.


def phase_screen(
    grid: PupilGrid, scale: float, rng: torch.Generator, device: torch.device | None = None
) -> Tensor:
    """Return a random phase screen (v, u), float64: Gaussian noise with variance 1 and correlation
    exp(-(d / scale)**2).
    """
    rows, columns = phase_screen_factors(grid, scale, rng, device)
    return rows @ columns


def phase_screen_factors(
    grid: PupilGrid, scale: float, rng: torch.Generator, device: torch.device | None = None
) -> tuple[Tensor, Tensor]:
    """Return matrices (v, n) and (n, u) whose product is a random phase screen, so that single rows
    can be computed.

    ``scale`` is in units of the diameter. Gaussians of width scale / 2 smooth white noise on a
    lattice. The lattice does not depend on the sampling of the pupil, so the screen does not depend
    on the sampling either.
    """
    # white noise smoothed by exp(-x^2 / (2 w^2)) has the correlation exp(-d^2 / (4 w^2)):
    # w = scale / 2
    spot_width = scale / 2
    half_width = max(0.5, grid.samples * grid.pitch / (2 * grid.diameter)) + 4 * spot_width
    count = 2 * math.ceil(half_width / spot_width) + 1
    white_noise = torch.randn(count, count, generator=rng, device=rng.device, dtype=torch.float64)
    positions = pupil_axes(grid, device)[0] / 2
    centres = (
        torch.arange(count, dtype=torch.float64, device=positions.device) - count // 2
    ) * spot_width
    spot_weights = torch.exp(-((positions - centres) ** 2) / (2 * spot_width**2))
    # normalized to variance 1 at each sample
    spot_weights = spot_weights / spot_weights.square().sum(1, keepdim=True).sqrt()
    return spot_weights @ white_noise.to(positions.device), spot_weights.T


# --- phase steps ----------------------------------------------------------------------------------

# Phase differences between neighbouring pupil samples, which show whether the samples resolve the
# phase.


LARGE_STEPS = 0.1  #: a pupil is aliased if a larger share of the steps exceeds half a turn
THINNED_SAMPLES = 256  #: smallest number of samples across a thinned pupil
SCREENS = ("aperture", "amplitude", "height", "path")  #: fields of `Pupil` with a value per sample
_MEASURED_ROWS = 256  #: smallest number of rows of a large pupil in which phase steps are measured


def phase_steps(pupil: Pupil) -> tuple[float, float]:
    """Return the median phase step between neighbouring samples, in turns, and the share of steps
    above half a turn.

    Both are for the band with the largest phase steps, inside the stop. In a large pupil only every
    k-th row is measured, at least 256 rows. A wrapped or split mask has steps at its edges by
    design, so a few large steps are no sign of an error. Many large steps mean that the sampling is
    too coarse for the phase.
    """
    steepest_band = int((pupil.index / pupil.wavelengths).argmax())
    row_step = max(1, len(pupil.height) // _MEASURED_ROWS)
    # height, path and mask of the open stop: for each sampled row, and for the row after it
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
    """Return True if so many phase steps exceed half a turn that the pupil is aliased."""
    return phase_steps(pupil)[1] > LARGE_STEPS


def _steps(pupil: Pupil, band: int, first: list[Tensor], second: list[Tensor]) -> Tensor:
    """Return the absolute phase difference, in turns, between neighbouring samples that are both
    inside the stop.

    Height and path are subtracted before the conversion to phase: in float32, a phase of thousands
    of turns is too coarse for its steps.
    """
    inside = first[2] & second[2]
    height, path = ((b - a)[inside] for a, b in zip(first[:2], second[:2], strict=True))
    steps: Tensor = (float(pupil.index[band]) * height + path).abs() / float(
        pupil.wavelengths[band]
    )
    return steps


def thinned_pupil(pupil: Pupil) -> Pupil:
    """Return every k-th sample of a large pupil, with the largest k for which the phase is not
    aliased.
    """
    step = max(1, len(pupil.height) // THINNED_SAMPLES)
    while step > 1 and pupil_has_large_steps(_every_sample(pupil, step)):
        step //= 2
    return _every_sample(pupil, step)


def _every_sample(pupil: Pupil, step: int) -> Pupil:
    """Return every ``step``-th sample of a pupil along both axes."""
    return pupil._replace(
        **{name: getattr(pupil, name)[::step, ::step] for name in SCREENS},
        pitch=pupil.pitch * step,
    )


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
    _refuse_unlike_shapes(height, index, bands, grid, dirt, shade)
    device = height.device
    clear = stop_transmission(grid, height.dtype, device)
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
    """Return the optical path difference (m) between a curved beam and a plane wave at the rim of
    the stop.
    """
    if wavefront is None or not bool(wavefront.curvature):
        return 0.0
    return wavefront.curvature.to(device) * grid.diameter**2 / 8


def _path(lens: Tensor | None, dirt: Dirt | None, like: Tensor) -> Tensor:
    """Return the sum of the optical paths of lens and dirt; ``lens`` is None for a lens without
    defocus and aberrations.
    """
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
    """Return the product of the amplitudes of stop, dirt, beam taper and shade; ``clear`` itself if
    there are no others.
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
    along_v, along_u = (
        torch.exp(-exponent * line.square()) for line in pupil_axes(grid, like.device)
    )
    amplitude = torch.empty_like(like)
    for rows in row_stripes(grid):
        amplitude[rows] = along_v[rows] * along_u
    return amplitude


def _lens_path(
    grid: PupilGrid, defocus: float | Tensor, aberrations: Mapping[int, float], like: Tensor
) -> Tensor | None:
    """Return the optical path (m) of defocus and aberrations, or None if both are 0; ``defocus`` is
    the path at the rim in m.
    """
    has_aberrations = any(aberrations.values())
    if not bool(defocus) and not has_aberrations:
        return None
    path = torch.empty_like(like)
    v, u = pupil_axes(grid, like.device)
    for rows in row_stripes(grid):
        squared_radius = v[rows].square() + u.square()
        # defocus is a paraboloid with the path `defocus` at the rim
        surface = defocus * squared_radius
        if has_aberrations:
            surface = surface + zernike_sum(aberrations, v[rows], u)
        path[rows] = surface.masked_fill_(squared_radius > 1, 0.0)
    return path


def _refuse_unlike_shapes(
    height: Tensor,
    index: Tensor,
    bands: Bands,
    grid: PupilGrid,
    dirt: Dirt | None,
    shade: Shade | None,
) -> None:
    """Raise ValueError unless height, dirt and shade have the size of the pupil grid, and index has
    the bands.
    """
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
    throughput = _squared_sum(result.amplitude) / _squared_sum(result.aperture)
    median, share = phase_steps(result)
    text = f"phase step {median:.3f} turn between samples (median), {share:.1%} above half a turn"
    if not share <= LARGE_STEPS:
        text = f"{text}: aliased, use a finer pupil pitch"
    return [
        Check(
            f"throughput {throughput:.4f} of the clear pupil"
            f" {min(samples * pitch, diameter) * 1e3:#.3g} mm",
            throughput > 0,
        ),
        Check(text, share <= LARGE_STEPS),
    ]


def _squared_sum(amplitude: Tensor) -> float:
    """Return the sum of the squared amplitude; rows are summed first, so that float32 sums stay
    short.
    """
    return float(torch.bmm(amplitude[:, None, :], amplitude[:, :, None]).sum(dtype=torch.float64))
