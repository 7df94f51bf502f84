"""Stray light of a lens: light scattered by its surfaces adds a veil around every source, in every
PSF.

Surfaces scatter by the three-parameter model of Harvey and Shack.
"""

from __future__ import annotations

import math
from collections.abc import Iterator, Mapping
from functools import cache
from typing import Annotated, Any, Literal, NamedTuple, NotRequired

import torch
from pydantic import ConfigDict, Field
from torch import Tensor
from typing_extensions import TypedDict

from neusee.nodes import Check, ParameterError, TensorStats, node
from neusee.nodes.optics._lens import refuse_impossible_f_number
from neusee.nodes.precision import refuse_not_finite, single
from neusee.nodes.units import Angle, BeamRadius, Diameter, FocalLength, PixelPitch, Wavelength
from neusee.nodes.values import Psf, Pupil

# --- Harvey-Shack model ---------------------------------------------------------------------------

# Scattered light of a surface on the pixels of a sensor; lengths are in pixels.
#
# With the direction cosine beta of a scattered ray relative to the unscattered ray, the surface
# scatters the share BSDF(beta) d2beta of the light into d2beta, with BSDF = b0 (1 + (beta /
# l)**2)**(s / 2). For a beam of radius a on the surface and the numerical aperture NA at the image,
# the optical invariant gives r NA = a beta: a pixel at the distance r receives (NA / a)**2 BSDF(NA
# r / a) per area, up to r = a / NA, where beta is 1.


#: within this number of pixels of the source along each axis, the light is integrated exactly
NEAR_PIXELS = 16
_GAUSS_NODES = 96  #: Gauss-Legendre nodes per edge: accurate to 1e-13 for any width of the scatter
#: pixels; a smaller distance between the edge of a pixel and the source is replaced by this one
_LEAST_DISTANCE = 1e-6
#: argument below which a series replaces (exp(z) - 1) / z, whose derivatives suffer cancellation
_SERIES_LIMIT = 1e-3


class Lobe(NamedTuple):
    """The scattered light of a surface on the sensor, peak (1 + (r / width)**2)**(s / 2) up to r =
    ``end``; scalars.
    """

    peak: Tensor  #: share of the light per pixel
    width: Tensor  #: pixels
    slope: Tensor  #: s
    end: Tensor  #: pixels, radius at which the direction cosine is 1


def lobe(b0: Tensor, l: Tensor, s: Tensor, scale: Tensor) -> Lobe:  # noqa: E741 (the symbol of the literature)
    """Return the scattered light of a surface on the sensor; ``scale`` is the direction cosine that
    one pixel spans, NA p / a.
    """
    return Lobe(b0 * scale.square(), l / scale, s, 1 / scale)


def scattered_share(b0: Tensor, l: Tensor, s: Tensor) -> Tensor:  # noqa: E741
    """Return the total integrated scatter (TIS) of a surface.

    TIS = 2 pi b0 ((l**2 + 1)**((s + 2) / 2) - l**(s + 2)) / (l**s (s + 2)), and its limit pi b0
    l**2 ln(1 + l**-2) for s = -2; it is computed without cancellation near s = -2.
    """
    return 2 * torch.pi * b0 * _enclosed_light(l, s, torch.ones_like(l))


def surface_of(share: float, l: float = 0.01, s: float = -1.5) -> dict[str, float]:  # noqa: E741
    """Return b0, l and s of a surface with a given total integrated scatter ``share``, which is
    proportional to b0.
    """
    unit = scattered_share(*(torch.tensor(x, dtype=torch.float64) for x in (1.0, l, s)))
    return {"b0": share / float(unit), "l": l, "s": s}


def light_within(light: Lobe, radius: Tensor) -> Tensor:
    """Return the share of the light that a surface scatters into the circle of ``radius`` pixels
    around the source.
    """
    inside = torch.minimum(radius, light.end)
    return 2 * torch.pi * light.peak * _enclosed_light(light.width, light.slope, inside)


def on_pixels(light: Lobe, centre: tuple[float, float], shape: tuple[int, int]) -> Tensor:
    """Return the share of the light that a surface scatters into each pixel (y, x), float64.

    ``centre`` is the position (y, x) of the source, counted from the middle of the first pixel.
    Within 16 pixels of the source the integral over each pixel is exact: by the divergence theorem
    it is an integral over the edges, so that no light of a peak far narrower than a pixel is lost.
    Farther away the value in the middle of the pixel and its second derivatives give the integral,
    to 3e-6 of the pixel.
    """
    y, x = (torch.arange(n, dtype=torch.float64) - c for n, c in zip(shape, centre, strict=True))
    window = _light_of_far_pixels(light, y[:, None], x[None])
    rows, columns = (_near_pixels(c, n) for c, n in zip(centre, shape, strict=True))
    if rows.stop > rows.start and columns.stop > columns.start:
        window = window.clone()
        window[rows, columns] = _light_of_near_pixels(
            light, _edges(rows, centre[0]), _edges(columns, centre[1])
        )
    return window


def _near_pixels(centre: float, size: int) -> slice:
    """Return the pixels along one axis within `NEAR_PIXELS` of the source that lie inside the
    window.
    """
    middle = round(centre)
    return slice(
        min(max(middle - NEAR_PIXELS, 0), size), max(min(middle + NEAR_PIXELS + 1, size), 0)
    )


def _edges(pixels: slice, centre: float) -> Tensor:
    """Return the positions of the edges of pixels along one axis, relative to the source."""
    return torch.arange(pixels.start, pixels.stop + 1, dtype=torch.float64) - 0.5 - centre


def on_far_pixels(light: Lobe, square: Tensor) -> Tensor:
    """Return the light of pixels at squared distances ``square`` from the source: value in the
    middle plus Laplacian / 24.

    The error is below 3e-6 of a pixel's light at 16 pixels from the source. The end of the lobe is
    not taken into account.
    """
    q = square / light.width.square()
    laplacian = (
        light.slope / (light.width.square() * (1 + q)) * (2 + (light.slope - 2) * q / (1 + q))
    )
    return light.peak * torch.exp(light.slope / 2 * torch.log1p(q)) * (1 + laplacian / 24)


def _light_of_far_pixels(light: Lobe, y: Tensor, x: Tensor) -> Tensor:
    """Return the light of pixels at the distances ``y`` and ``x`` from the source along both axes;
    0 beyond the end of the lobe.
    """
    squared_distance = y.square() + x.square()
    light_of_pixels = on_far_pixels(light, squared_distance)
    if float(light.end.detach()) > float(squared_distance.max().sqrt()) + 1:
        return light_of_pixels
    # a pixel that straddles the end receives a part
    return light_of_pixels * (light.end - squared_distance.sqrt() + 0.5).clamp(0, 1)


def _light_of_near_pixels(light: Lobe, y: Tensor, x: Tensor) -> Tensor:
    """Return the light of each pixel between the edges ``y`` and ``x``: mixed second differences of
    the light in the rectangles between the source and the corners.
    """
    distance_y, distance_x = (edge.abs().clamp_min(_LEAST_DISTANCE) for edge in (y, x))
    corner_y, corner_x = torch.meshgrid(distance_y, distance_x, indexing="ij")
    # two right triangles, one on each side of the diagonal
    rectangle = _light_in_triangle(light, corner_y, corner_x) + _light_in_triangle(
        light, corner_x, corner_y
    )
    signed_rectangle = torch.sign(y)[:, None] * torch.sign(x)[None] * rectangle
    return signed_rectangle.diff(dim=0).diff(dim=1)


def _light_in_triangle(light: Lobe, near: Tensor, across: Tensor) -> Tensor:
    """Return the light in a right triangle with a corner at the source; ``near`` is the leg from
    the source to the right angle, ``across`` the other leg.

    The light up to the far leg in the direction phi is integrated over phi. With tan(phi) = sinh(u)
    the integrand is smooth on a scale of 1, however narrow the scatter is.
    """
    nodes, weights = _gauss_nodes()
    largest_u = torch.asinh(across / near)[..., None]
    stretch = torch.cosh(largest_u * nodes)
    # light per angle up to the far leg, at the distance near / cos(phi) = near cosh(u)
    enclosed = light.peak * _enclosed_light(light.width, light.slope, near[..., None] * stretch)
    # dphi = du / cosh(u)
    return (weights * largest_u * enclosed / stretch).sum(-1)


@cache
def _gauss_nodes() -> tuple[Tensor, Tensor]:
    """Return Gauss-Legendre nodes and weights on [0, 1]."""
    import numpy as np

    nodes, weights = np.polynomial.legendre.leggauss(_GAUSS_NODES)
    return torch.from_numpy((nodes + 1) / 2), torch.from_numpy(weights / 2)


def _enclosed_light(width: Tensor, slope: Tensor, radius: Tensor) -> Tensor:
    """Return the integral of r (1 + (r / width)**2)**(slope / 2) over r from 0 to ``radius``."""
    # with z = ln(1 + (r / width)^2), it is width^2 / 2 times the integral of exp((slope + 2) / 2 z)
    # over z
    log_term = torch.log1p((radius / width).square())
    return width.square() / 2 * log_term * _growth((slope + 2) / 2 * log_term)


def _growth(z: Tensor) -> Tensor:
    """Return (exp(z) - 1) / z, which is 1 at z = 0, with accurate derivatives there."""
    is_small = z.abs() < _SERIES_LIMIT
    safe_z = torch.where(is_small, 1.0, z)
    series = 1 + z / 2 * (1 + z / 3 * (1 + z / 4 * (1 + z / 5)))
    return torch.where(is_small, series, torch.expm1(safe_z) / safe_z)


# --- surfaces of a lens ---------------------------------------------------------------------------

Brightness = Annotated[float, Field(ge=0, le=1e18)]  #: multiple of saturation
Scaling = Literal["none", "roughness"]


class Surface(TypedDict):
    """A scattering surface: b0 (1/sr), l and s of Harvey and Shack, and the radius of the beam on
    the surface.
    """

    __pydantic_config__ = ConfigDict(extra="forbid")  # type: ignore[misc]
    b0: Annotated[float, Field(ge=0, le=1e9)]
    l: Annotated[float, Field(gt=0, le=10)]  # noqa: E741
    s: Annotated[float, Field(ge=-10, le=0)]
    radius: NotRequired[BeamRadius | None]


_DIAMETER_ROUNDING = 1e-3  #: relative difference of two diameters that counts as rounding
Surfaces = Annotated[dict[str, Surface], Field(min_length=1)]


class StrayShares(NamedTuple):
    """The energy balance of a point source behind a scattering lens, in shares of the light through
    the clear pupil.
    """

    core: Tensor  #: (band,) float64, not scattered, inside and outside the window
    inside: Tensor  #: (band,) float64, scattered into the window
    outside: Tensor  #: (band,) float64, scattered outside the window


class _ScatteredLight(NamedTuple):
    """The light that one surface of a lens scatters."""

    arriving: Tensor  #: share of the light that reaches the surface unscattered
    lobe: Lobe
    share: Tensor  #: TIS of the surface


class _Lens(NamedTuple):
    """The lens and sensor for which scatter is computed, and the wavelength scaling of the
    scatter.
    """

    surfaces: Mapping[str, Mapping[str, Any]]
    focal_length: float
    pixel_pitch: float
    diameter: float
    wavelength: float
    scaling: Scaling


@node(bands={"psf": 0, "pupil": 0, "return": 0})
def stray_light(
    psf: Psf,
    pupil: Pupil,
    direction: Tensor | None = None,
    *,
    surfaces: Surfaces,
    focal_length: FocalLength,
    pixel_pitch: PixelPitch,
    diameter: Diameter,
    angle: tuple[Angle, Angle] = (0.0, 0.0),
    wavelength: Wavelength = 550e-9,
    scaling: Scaling = "none",
    strength: Brightness | None = None,
) -> Psf:
    """Add the light that the surfaces of the lens scatter to a PSF, and take it from the light that
    is not scattered.

    ``surfaces`` stand in the order in which the light meets them. Each has b0 (1/sr), l and s of
    Harvey and Shack, BSDF = b0 (1 + (beta / l)**2)**(s / 2), at ``wavelength``, and the ``radius``
    a of the beam on it, by default that of the entrance pupil, ``diameter`` / 2. The surface
    scatters the share TIS of the light that reaches it, and (NA / a)**2 BSDF(NA r / a) of this
    light arrives at the distance r from the source, with NA = diameter / (2 f). ``scaling``:
    `none`, the same at every wavelength; `roughness`, a smooth polished surface, whose b0 goes as
    wavelength**-4 and whose l as wavelength; TIS then goes as wavelength**-2 where s is below -2
    and l small. ``strength``: the brightest source that this PSF shows, in multiples of saturation;
    a tolerance may then omit the step. Without a value the step is always computed.

    Heights and paths of the pupil have no effect, not even where they are NaN.

    Shapes: psf.intensity (band, y, x), pupil (v, u), direction (2,) rad -> as psf.
    Units:  as psf, share of the clear pupil's light per pixel; b0 1/sr, radius m.
    Error:  energy in the window 1e-8 of the captured light, before the precision of the PSF; each
            pixel is integrated, also where the PSF samples points. Light that scatters twice is
            where its first scatter sends it. The veil has its centre at the source and is not
            blurred by mask or aberrations: exact at distances from the source that exceed the width
            of the core, and too sharp nearer, where l f is below that width. Scatter is taken as
            shift invariant, incidence as normal.
    Raises: ParameterError before the run for surfaces that scatter all light, and for a beam that
            is only some pixels wide on the sensor; ValueError for these at any other wavelength,
            for a PSF of other bands, and for an aperture that is not finite.
    Source: Peterson, Proc. SPIE 5178 (2004), 184 (in-field scatter of each surface by its beam);
            Harvey, thesis, Univ. of Arizona (1976); roughness: Stover, Optical Scattering, 3rd ed.,
            ch. 4.
    """
    _same_bands(psf, pupil)
    lens = _Lens(surfaces, focal_length, pixel_pitch, diameter, wavelength, scaling)
    offset_y, offset_x = (0.0, 0.0) if direction is None else direction
    tilt_y, tilt_x = angle
    angle_y, angle_x = tilt_y + float(offset_y), tilt_x + float(offset_x)
    height, width = psf.intensity.shape[-2:]
    window_shape = (height, width)
    centre = (
        # position of the source in pixels: f x angle / pitch from the axis
        height // 2 + focal_length * angle_y / pixel_pitch,
        width // 2 + focal_length * angle_x / pixel_pitch,
    )
    transmitted, intensity, axis_peaks, veil = _transmitted(pupil), [], [], None
    for band, colour in enumerate(pupil.wavelengths.tolist()):
        # without a scaling the veil is the same in every band
        if veil is None or scaling != "none":
            lobes = _lobes(lens, colour)
            veil, axis_light, scattered = (
                _veil(lobes, centre, window_shape),
                _veil(lobes, (0.0, 0.0), (1, 1)),
                _total_scatter(lobes),
            )
        unscattered = single(psf.intensity[band])
        intensity.append(
            unscattered * (1 - scattered).to(unscattered) + (transmitted * veil).to(unscattered)
        )
        axis_peaks.append(psf.clear_peak[band] * (1 - scattered) + axis_light[0, 0])
    return psf._replace(intensity=torch.stack(intensity), clear_peak=torch.stack(axis_peaks))


@node()
def stray_shares(
    psf: Psf,
    core: Psf,
    pupil: Pupil,
    *,
    surfaces: Surfaces,
    focal_length: FocalLength,
    pixel_pitch: PixelPitch,
    diameter: Diameter,
    wavelength: Wavelength = 550e-9,
    scaling: Scaling = "none",
) -> StrayShares:
    """Account for the light of a point source: not scattered, scattered into the window, and
    scattered elsewhere.

    ``psf`` has stray light and ``core`` is the same PSF without; the parameters are those of
    `stray_light`. Heights and paths of the pupil have no effect, not even where they are NaN.

    Shapes: psf, core (band, y, x), pupil (v, u) -> three of (band,).
    Units:  shares of the light through the clear pupil; their sum is the share that the pupil
            transmits.
    Error:  2e-7 of the captured light, from float32 PSFs.
    Raises: ValueError for a PSF of other bands, for surfaces that scatter all light, and for an
            aperture that is not finite.
    Source: energy conservation; total integrated scatter as in `stray_light`.
    """
    _same_bands(psf, pupil)
    lens = _Lens(surfaces, focal_length, pixel_pitch, diameter, wavelength, scaling)
    scattered = torch.stack(
        [_total_scatter(_lobes(lens, colour)) for colour in pupil.wavelengths.tolist()]
    )
    transmitted = _transmitted(pupil)
    light_with_veil, light_without_veil = (x.intensity.double().sum((-2, -1)) for x in (psf, core))
    inside = light_with_veil - (1 - scattered) * light_without_veil
    return StrayShares(transmitted * (1 - scattered), inside, transmitted * scattered - inside)


@stray_light.preflight
def _(
    *,
    surfaces: Mapping[str, Mapping[str, Any]],
    focal_length: float,
    pixel_pitch: float,
    diameter: float,
    wavelength: float,
    scaling: Scaling,
    pupil: Pupil | None = None,
    **_: Any,
) -> list[str]:
    refuse_impossible_f_number(focal_length, diameter, "diameter")
    lens = _Lens(surfaces, focal_length, pixel_pitch, diameter, wavelength, scaling)
    try:
        scattered = float(_total_scatter(_lobes(lens, wavelength)))
    except ValueError as error:
        raise ParameterError("surfaces", str(error)) from None
    notes = (
        [f"the lens scatters {scattered:.2%} of the light at {wavelength * 1e9:.4g} nm"]
        if scattered > 0.1
        else []
    )
    return [*notes, *_note_of_wider_lens(pupil, diameter)]


def _note_of_wider_lens(pupil: Pupil | None, diameter: float) -> list[str]:
    """Return a note if ``diameter`` is larger than the pupil, which `reading.aperture` has
    narrowed.
    """
    if pupil is None or pupil.pitch.is_meta:
        return []
    pupil_diameter = float(pupil.pitch) * pupil.aperture.shape[-1]
    if diameter <= pupil_diameter * (1 + _DIAMETER_ROUNDING):
        return []
    text = (
        f"the lens scatters as one of {diameter * 1e3:.4g} mm, and its pupil has"
        f" {pupil_diameter * 1e3:.4g} mm"
    )
    return [f"{text}: see reading.aperture"]


@stray_light.skip_bound
def _(
    psf: TensorStats,
    *_: Any,
    surfaces: Mapping[str, Mapping[str, Any]],
    strength: float | None = None,
    **params: Any,
) -> float:
    """Return an estimate of the error of a picture without this step, relative to its brightest or
    saturated pixel.

    It is no bound, since the veils of many sources add up. Without the step, the core is too bright
    by the share TIS, a scene of uniform brightness lacks a veil of TIS times its mean, and a source
    of ``strength`` times saturation, whose image is clipped, lacks a veil of ``strength`` times the
    scattered light of the pixel on the axis.
    """
    if not any(surface["b0"] for surface in surfaces.values()):
        return 0.0
    if strength is None or params.get("scaling", "none") != "none" or not psf.max > 0:
        return math.inf
    sizes = {name: params[name] for name in ("focal_length", "pixel_pitch", "diameter")}
    lobes = _lobes(_Lens(surfaces, **sizes, wavelength=1.0, scaling="none"), 1.0)
    scattered, axis_light = float(_total_scatter(lobes)), float(_veil(lobes, (0.0, 0.0), (1, 1)))
    # light of a band in the window; 1 if not known
    light_in_window = psf.sum / psf.shape[0] if psf.shape else 1.0
    return (
        scattered / (1 - scattered) * (1 + 1 / light_in_window)
        + max(strength, 1.0) * axis_light / psf.max
    )


stray_light.hooks.skip_estimated = True


@stray_light.check
def _(
    result: Psf, psf: Psf, pupil: Pupil, *others: Any, surfaces: Mapping[str, Any], **params: Any
) -> list[Check]:
    names = ("focal_length", "pixel_pitch", "diameter", "wavelength", "scaling")
    light_shares = stray_shares(
        result, psf, pupil, surfaces=surfaces, **{n: params[n] for n in names if n in params}
    )
    core, inside, outside = (float(x.detach().mean()) for x in light_shares)
    text = (
        f"light not scattered {core:.2%}, stray light inside the window {inside:.3%} and outside"
        f" {outside:.3%}"
    )
    return [Check(text, inside >= -1e-6 and outside >= -1e-6)]


def _lobes(lens: _Lens, colour: float) -> list[_ScatteredLight]:
    """Return the scattered light of each surface at the wavelength ``colour`` in m, in the order of
    the surfaces.
    """
    scatterers, remaining = [], torch.ones((), dtype=torch.float64)
    for name, (b0, l, s, radius) in _surfaces_at(lens, colour):  # noqa: E741
        cosine_per_pixel = lens.diameter / (2 * lens.focal_length) * lens.pixel_pitch / radius
        surface_lobe, scattered = lobe(b0, l, s, cosine_per_pixel), scattered_share(b0, l, s)
        _refuse_surface(
            name, colour, float(scattered.detach()), float(surface_lobe.end.detach()), lens
        )
        scatterers.append(_ScatteredLight(remaining, surface_lobe, scattered))
        remaining = remaining * (1 - scattered)
    return scatterers


def _surfaces_at(lens: _Lens, colour: float) -> Iterator[tuple[str, tuple[Tensor, ...]]]:
    """Yield the name of each surface with its b0, l, s and beam radius at the wavelength ``colour``
    in m, as float64 scalars.
    """
    # smooth surface: b0 is proportional to wavelength^-4, l to wavelength
    ratio = lens.wavelength / colour if lens.scaling == "roughness" else 1.0
    for name, surface in lens.surfaces.items():
        beam_radius = lens.diameter / 2 if surface.get("radius") is None else surface["radius"]
        values = (surface["b0"], surface["l"], surface["s"], beam_radius)
        b0, l, s, radius = (torch.as_tensor(x, dtype=torch.float64) for x in values)  # noqa: E741
        yield name, (b0 * ratio**4, l / ratio, s, radius)


def _refuse_surface(name: str, colour: float, share: float, end: float, lens: _Lens) -> None:
    """Raise ValueError for a surface that scatters all light at the wavelength ``colour`` in m, and
    for one whose lobe ends too near to the source, at ``end`` pixels.
    """
    if not share < 1:
        raise ValueError(
            f"surface {name} scatters {share:.3g} of the light at {colour * 1e9:.4g} nm, and the"
            " limit is below 1: choose a smaller b0, or a steeper s"
        )
    if not end > 2 * NEAR_PIXELS:
        size = end * lens.pixel_pitch
        raise ValueError(
            f"the light that surface {name} scatters ends {size * 1e6:.3g} um from the source,"
            f" within {2 * NEAR_PIXELS} pixels: this surface lies on the sensor; choose a larger"
            " radius"
        )


def _total_scatter(lobes: list[_ScatteredLight]) -> Tensor:
    """Return the share of the light that all surfaces scatter, 1 - prod(1 - TIS)."""
    last = lobes[-1]
    return 1 - last.arriving * (1 - last.share)


def _veil(
    lobes: list[_ScatteredLight], centre: tuple[float, float], size: tuple[int, int]
) -> Tensor:
    """Return the scattered light of all surfaces in each pixel of a window of ``size`` (y, x), for
    a source at ``centre`` (y, x).
    """
    return torch.stack(
        [light.arriving * on_pixels(light.lobe, centre, size) for light in lobes]
    ).sum(0)


def _transmitted(pupil: Pupil) -> Tensor:
    """Return the share of the clear pupil's light that mask and dirt transmit, float64."""
    transmitted_light, clear_light = (
        x.double().square().sum() for x in (pupil.amplitude, pupil.aperture)
    )
    refuse_not_finite("no share of its light can be taken", aperture=clear_light)
    transmitted_share: Tensor = transmitted_light / clear_light
    return transmitted_share


def _same_bands(psf: Psf, pupil: Pupil) -> None:
    """Raise ValueError unless PSF and pupil have the same number of bands."""
    if psf.intensity.ndim != 3 or len(psf.intensity) != len(pupil.wavelengths):
        raise ValueError(
            f"PSF {tuple(psf.intensity.shape)} and pupil of {len(pupil.wavelengths)} bands must"
            " have the same bands: give the pupil from which the PSF was computed"
        )


def veil_at(
    radius: Tensor,
    *,
    surfaces: Mapping[str, Mapping[str, Any]],
    focal_length: float,
    pixel_pitch: float,
    diameter: float,
) -> tuple[Tensor, Tensor]:
    """Return the light that the surfaces of a lens scatter into a pixel at ``radius`` pixels from
    the source, and the total share of scattered light.

    ``surfaces`` are those of `stray_light`. The source lies in the middle of a pixel.

    Shapes: radius (any) pixels -> veil of the same shape, share of the light that passes the lens
            per pixel, and ().
    Units:  pixels; lengths m.
    Error:  3e-6 of a pixel from 16 pixels on; nearer, the mean over the directions in which pixels
            lie.
    Raises: ValueError for surfaces that scatter all light, and for a beam that is only some pixels
            wide on the sensor.
    Source: as `stray_light`.
    """
    lobes = _lobes(_Lens(surfaces, focal_length, pixel_pitch, diameter, 1.0, "none"), 1.0)
    near_window = _veil(
        lobes, (float(NEAR_PIXELS), float(NEAR_PIXELS)), (2 * NEAR_PIXELS + 1, 2 * NEAR_PIXELS + 1)
    ).flatten()
    pixel_offsets = torch.arange(-NEAR_PIXELS, NEAR_PIXELS + 1, dtype=torch.float64)
    squared_distances = (pixel_offsets[:, None].square() + pixel_offsets.square()).flatten()
    squared_radius = radius.double().square()
    # near the source: mean over pixels of equal distance, interpolated linearly in the squared
    # distance
    ring_distances, ring_of_pixel = torch.unique(squared_distances, return_inverse=True)
    ring_mean = torch.zeros_like(ring_distances).scatter_reduce_(
        0, ring_of_pixel, near_window, "mean", include_self=False
    )
    upper_index = torch.searchsorted(ring_distances, squared_radius.flatten().contiguous()).clamp(
        1, len(ring_distances) - 1
    )
    lower_distance, upper_distance = ring_distances[upper_index - 1], ring_distances[upper_index]
    fraction = (
        (squared_radius.flatten() - lower_distance) / (upper_distance - lower_distance)
    ).clamp(0, 1)
    near_light = (
        ring_mean[upper_index - 1] * (1 - fraction) + ring_mean[upper_index] * fraction
    ).reshape(squared_radius.shape)
    far_light = torch.stack(
        [light.arriving * _light_up_to_end(light.lobe, squared_radius) for light in lobes]
    ).sum(0)
    veil = torch.where(squared_radius <= NEAR_PIXELS**2, near_light, far_light)
    return veil, _total_scatter(lobes)


def _light_up_to_end(light: Lobe, square: Tensor) -> Tensor:
    """Return the light of a lobe at squared distances; it ends where the direction cosine is 1."""
    return on_far_pixels(light, square) * (light.end - square.sqrt() + 0.5).clamp(0, 1)
