"""The point-spread function of lens, mask and pixel sampling, with checks of its sampling."""

from __future__ import annotations

import math
from typing import Any, Literal

import torch
from torch import Tensor

from neusee.nodes import Check, ParameterError, node
from neusee.nodes.optics._laser_spot import angle_notes
from neusee.nodes.optics._lens import passed_by_notches, refuse_impossible_f_number
from neusee.nodes.optics._pixel_average import (
    GridAxis,
    IntensityOptions,
    band_average,
    clear_averages,
    fine_samples,
    spot_position,
    turns_per_pixel,
    view_on_grid,
)
from neusee.nodes.optics._psf_definition import Geometry, SensorSampling, by_definition
from neusee.nodes.optics.transform._intensity import KEPT_FIELD_BYTES, Sampling, intensity_of
from neusee.nodes.optics.transform._scaled_transform import Method
from neusee.nodes.precision import refuse_half, refuse_not_finite, transformed
from neusee.nodes.units import Angle, FocalLength, PixelPitch, Shape
from neusee.nodes.values import Psf, Pupil

# --- psf limits -----------------------------------------------------------------------------------

# Checks of a PSF: aliases of the sampled pupil, sample points too far apart, and more light than
# the pupil passes.


#: largest relative excess of light over that of the pupil due to rounding, for each type of the PSF
GAINED_LIGHT = {torch.float32: 1e-5, torch.float64: 1e-9}
_FAST_F_NUMBER = 1.2  #: f-number below which the scalar theory of this PSF needs a note


def refuse_aliases(pupil: Pupil, camera: Geometry) -> None:
    """Raise ValueError if the PSF window contains aliases: the PSF of a sampled pupil repeats with
    the period lambda f / pitch.

    With ``pixel="zoh"`` the repeated light is real, because square pillars diffract light there.
    """
    if camera.pixel == "zoh":
        return
    shortest, pitch = float(pupil.wavelengths.min()), float(pupil.pitch)
    limit = shortest * camera.focal_length / (2 * pitch)
    for axis, n, spot_place in zip("yx", camera.shape, spot_position(camera), strict=True):
        reach = max(abs(0 - spot_place), abs(n - 1 - spot_place)) * camera.pixel_pitch
        if reach > limit * (1 + 1e-9):
            raise ValueError(
                f"the window reaches {reach * 1e3:.3g} mm from the spot along {axis}, but at"
                f" {shortest * 1e9:.4g} nm a pupil pitch of {pitch * 1e6:.4g} um carries only"
                f" {limit * 1e3:.3g} mm (lambda f / (2 pitch)) before the PSF repeats: write"
                f" {_finer_grid(pupil, reach / limit)} for the same aperture, or choose a smaller"
                " angle or window, or pixel='zoh'"
            )


def _finer_grid(pupil: Pupil, factor: float) -> str:
    """Return the settings of a pupil grid of the same width with a pitch that is ``factor``
    times finer.
    """
    samples, pitch = pupil.height.shape[0], float(pupil.pitch)
    needed = math.ceil(samples * factor * (1 - 1e-12))
    needed += (needed - samples) % 2  # so that the axis stays on a sample, or between two samples
    return f'optics.samples={needed} optics.pitch="{samples * pitch / needed * 1e6:.10g} um"'


def refuse_coarse_points(pupil: Pupil, camera: Geometry) -> None:
    """Raise ValueError if the pixel pitch exceeds wavelength x f-number for point sampling.

    Up to this pitch, the period of the finest fringe, the sum over equally spaced points is the
    light of the PSF.
    """
    if camera.sensor != "point":
        return
    shortest = float(pupil.wavelengths.min())
    widest = float(pupil.pitch) * max(pupil.height.shape)
    if _are_coarse_points(camera, shortest, widest):
        # tested again with the width of the pupil, which may be narrower than its grid
        diameter = min(_diameter(pupil, widest), widest)
        if _are_coarse_points(camera, shortest, diameter):
            f_number = camera.focal_length / diameter
            raise ValueError(
                f"points {camera.pixel_pitch * 1e6:.3g} um apart miss or repeat the light of a spot"
                f" at {shortest * 1e9:.4g} nm and f/{f_number:.3g}, where wavelength x f-number is"
                f" {shortest * f_number * 1e6:.3g} um: write sensor.sampling=integrated to average"
                " over each pixel, or choose a finer pitch"
            )


def spread_points_notes(pupil: Pupil, camera: Geometry) -> list[str]:
    """Return a note if the sample points are so far apart that they may miss a peak between them.

    The largest error is that of an Airy pattern centred between four points.
    """
    if camera.sensor == "integrated" or pupil.diameter.is_meta or not float(pupil.diameter) > 0:
        return []
    fringe = float(pupil.wavelengths.min()) * camera.focal_length / float(pupil.diameter)
    if camera.pixel_pitch <= fringe / 2 * (1 + 1e-9):
        return []
    # half the diagonal of a pixel, in the Airy pattern (2 J1(x) / x)^2; 1.22 is its first zero
    airy_argument = torch.tensor(
        math.pi * min(camera.pixel_pitch / math.sqrt(2) / fringe, 1.22), dtype=torch.float64
    )
    missed = 1 - float((2 * torch.special.bessel_j1(airy_argument) / airy_argument).square())
    return [
        f"points {camera.pixel_pitch * 1e6:.3g} um apart are further apart than half of wavelength"
        f" x f-number, {fringe / 2 * 1e6:.3g} um: a peak between them shows up to {missed:.0%}"
        " too low"
    ]


def _are_coarse_points(camera: Geometry, wavelength: float, diameter: float) -> bool:
    """Return True if the pixel pitch exceeds wavelength x f-number; lengths are in metres."""
    return camera.pixel_pitch * diameter > wavelength * camera.focal_length * (1 + 1e-9)


def _diameter(pupil: Pupil, widest: float) -> float:
    """Return the diameter of the clear aperture in m, or its larger side if the pupil does not
    state the diameter.
    """
    stated_diameter = pupil.diameter
    if not stated_diameter.is_meta and float(stated_diameter) > 0:
        return float(stated_diameter)
    if pupil.aperture.is_meta:
        return 0.0
    is_open = pupil.aperture.detach() != 0
    sides = [_open_samples(is_open.any(axis)) for axis in (0, 1)]
    return float(pupil.pitch) * max(sides)


def _open_samples(open_: Tensor) -> int:
    """Return the number of samples from the first to the last open sample of a line."""
    open_places = open_.nonzero()
    return int(open_places[-1] - open_places[0]) + 1 if len(open_places) else 0


def fast_lens_notes(pupil: Pupil, camera: Geometry) -> list[str]:
    """Return a note for a lens of f/1.2 or faster, for which scalar theory is inaccurate."""
    diameter = 0.0 if pupil.diameter.is_meta else float(pupil.diameter)
    f_number = camera.focal_length / diameter if diameter else math.inf
    if f_number > _FAST_F_NUMBER * (1 + 1e-9):
        return []
    return [
        f"f/{f_number:.3g}: the PSF is that of scalar theory, and the acceptance of microlenses is"
        " ignored; a real sensor loses part of this oblique light"
    ]


def refuse_gained_light(intensity: Tensor, lights: list[float], wavelengths: Tensor) -> None:
    """Raise ValueError if a window contains more light than the pupil passes, beyond the error of
    the PSF.

    ``lights`` is the light that the pupil passes in each band, as a share of the clear pupil's
    light.
    """
    shares = intensity.detach().sum(-1).sum(-1, dtype=torch.float64).tolist()
    for share, light, wavelength in zip(shares, lights, wavelengths.tolist(), strict=True):
        if share > light * (1 + GAINED_LIGHT[intensity.dtype]):
            raise ValueError(
                f"the window holds {share:.6g} of the light of the clear pupil at"
                f" {wavelength * 1e9:.4g} nm, but the pupil passes only {light:.6g}: the samples of"
                " the PSF are too far apart; average over each pixel (sensor.sampling=integrated)"
            )


# --- psf ------------------------------------------------------------------------------------------

# The point-spread function: lens, mask and pixel sampling in one scaled Fourier transform.


_PART_SAMPLES = 1 << 15  #: number of samples summed in the pupil's type; these sums add in float64


class _Camera(Geometry):
    """The geometry of lens, sensor and source, to which the direction of a laser is added."""

    def towards(self, direction: Tensor | None) -> _Camera:
        """Return the camera with ``direction``, if it is known, added to the angle of the
        source.
        """
        y, x = (0.0, 0.0) if direction is None or direction.is_meta else direction.tolist()
        return self._replace(angle=(self.angle[0] + y, self.angle[1] + x))


@node(rtol=3e-6, bands={"pupil": 0, "return": 0})
def psf(
    pupil: Pupil,
    direction: Tensor | None = None,
    *,
    focal_length: FocalLength,
    pixel_pitch: PixelPitch,
    shape: Shape,
    angle: tuple[Angle, Angle] = (0.0, 0.0),
    pixel: Literal["point", "zoh"] = "point",
    sensor: SensorSampling = "point",
    precision: Literal["single", "double"] = "single",
) -> Psf:
    """Focus the pupil on the sensor by the scaled Fraunhofer integral, sampled at the sensor's
    pixel pitch.

    A source at ``angle`` (n_y, n_x) has its spot at (f n_y, f n_x), to a fraction of a pixel. An
    input ``direction`` is added to ``angle``. The window stays centred on the axis for every angle.
    ``pixel="zoh"`` holds the height map constant over each square pupil pixel, which gives a sinc
    envelope. ``sensor="integrated"`` averages over the square of each sensor pixel; ``"point"``
    samples its middle, as a fine grid of a spot does. Points further apart than wavelength x
    f-number miss light or count it many times, so that they are refused; ``"point_as_printed"``
    allows them, for the reading of the paper. Amplitude, height and path receive a first
    derivative; a second derivative raises an error.

    Shapes: pupil (v, u), direction (2,) rad -> intensity (band, y, x), clear_peak, cut_off,
            averaged (band,).
    Units:  metres -> share of the clear pupil's light per pixel, not normalised to a sum of one.
    Error:  single, 2e-6 of the brightest pixel, or 3e-6 in the speckle of a rough mask, whose
        brightest pixel is only a few times the mean; double, 1e-11. At 1e-8 of the brightest pixel,
        single errs by 1e-4 of the value at the median and 1e-3 at most in a window of up to a tenth
        of the pupil's samples a side, and by 2e-4 and 4e-3 in a wider window, whose last axis is
        transformed in float32: a rounding by 2^-24 of the brightest field alone changes such a
        pixel by 1.2e-3. Where the share s of the clear peak is below 1e-6, 5e-9 / sqrt(s) of the
        value at the median and 2e-7 / sqrt(s) at most. The average over pixels adds 1e-8 of the
        clear peak, in double 1e-12. Energy in the window is at most that of the pupil, within 1e-5,
        in double 1e-9. Scalar theory: below f/1.2 polarisation, and at any f-number the acceptance
        of microlenses, are ignored.
    Raises: ParameterError before the run, or ValueError, where the window reaches beyond half the
        alias-free field, lambda f / (2 pitch), from the spot, and where points are further apart
        than wavelength x f-number; ParameterError for an angle of 1 rad or more; ValueError for a
        closed aperture, for heights or paths that are not finite or above 1e9 turns, for a pupil in
        half precision, and for a result with more light in the window than the pupil passes.
    Source: Goodman, Introduction to Fourier Optics, 3rd edition, eq. 5-14 (field in the focal plane
            of a lens).
    """
    camera = _Camera(focal_length, pixel_pitch, shape, angle, pixel, sensor).towards(direction)
    dtype = torch.float64 if precision == "double" else torch.float32
    return _focus(pupil, camera, dtype, "auto")


@psf.reference
def _(
    pupil: Pupil, direction: Tensor | None = None, *, precision: str = "single", **camera: Any
) -> Psf:
    geometry = _Camera(**camera).towards(direction)
    _refuse_unlike_factors(pupil)
    refuse_aliases(pupil, geometry)
    return by_definition(pupil, geometry)


@psf.preflight
def _(*, pupil: Pupil | None = None, direction: Tensor | None = None, **params: Any) -> list[str]:
    camera = _Camera(**{name: params[name] for name in _Camera._fields})
    notes = angle_notes(camera.angle)
    if pupil is None or pupil.wavelengths.is_meta or pupil.pitch.is_meta:
        return notes
    if not pupil.diameter.is_meta:
        refuse_impossible_f_number(camera.focal_length, float(pupil.diameter), "focal_length")
    for parameter, view in (
        ("focal_length", camera),
        ("direction.angle", camera.towards(direction)),
    ):
        try:
            refuse_aliases(pupil, view)
        except ValueError as error:
            raise ParameterError(parameter, str(error)) from None
    try:
        refuse_coarse_points(pupil, camera)
    except ValueError as error:
        raise ParameterError("sensor", str(error)) from None
    return notes + fast_lens_notes(pupil, camera) + spread_points_notes(pupil, camera)


@psf.check
def _(result: Psf, *inputs: object, **params: object) -> list[Check]:
    rows = result.intensity.detach().sum(-1)  # a float64 copy of the whole stack would take 1 GB
    shares = 100 * rows.sum(-1, dtype=torch.float64)
    lowest, highest = float(shares.min()), float(shares.max())
    energy = f"energy in window {lowest:.1f} %" + (
        f" to {highest:.1f} %" if highest - lowest >= 0.05 else ""
    )
    return [Check(energy, lowest >= 0.0)]


def _focus(pupil: Pupil, camera: _Camera, dtype: torch.dtype, method: Method) -> Psf:
    """Return the PSF of a pupil in the type ``dtype``, by the named method of the transform."""
    _refuse_unlike_factors(pupil)
    refuse_aliases(pupil, camera)
    refuse_coarse_points(pupil, camera)
    clear_light, clear_field = _light_and_field(pupil.aperture)
    refuse_not_finite("the PSF cannot be normalised", aperture=clear_light)
    if not clear_light > 0:
        raise ValueError(
            "the aperture is closed everywhere: there is no light to normalise the PSF by"
        )
    lights = (passed_by_notches(pupil) / clear_light).tolist()
    focused = _intensity_over_pixels if camera.sensor == "integrated" else _intensity_at_points
    intensity = focused(pupil, camera, lights, dtype, method)
    if not transformed():
        passed_light = (
            clear_light
            if pupil.amplitude is pupil.aperture
            else _light_and_field(pupil.amplitude)[0]
        )
        refuse_gained_light(
            intensity, [light * passed_light for light in lights], pupil.wavelengths
        )
    clear_peak, cut_off, averaged = _clear_lens(pupil, camera, clear_light, clear_field)
    device = intensity.device
    return Psf(intensity, clear_peak.to(device), cut_off.to(device), averaged.to(device))


def _clear_lens(
    pupil: Pupil, camera: _Camera, area: float, total: float
) -> tuple[Tensor, Tensor, Tensor]:
    """Return three values for each band of the lens without mask, dirt and aberrations: the peak of
    the PSF, the cut-off in cycles per pixel, and the side in pixels of the square over which a
    pixel averages (0 for point sampling).
    """
    alphas = [turns_per_pixel(pupil, camera, band) for band in range(pupil.wavelengths.numel())]
    # peak of a pupil without phase: |sum of the field|^2 alpha^2 / light
    point_peaks = [alpha * alpha * (total**2 / area) for alpha in alphas]
    cut_offs = [math.sqrt(peak * (4 / math.pi)) for peak in point_peaks]
    cut_off = torch.tensor(cut_offs, dtype=torch.float64)
    if camera.sensor != "integrated":
        return torch.tensor(point_peaks, dtype=torch.float64), cut_off, torch.zeros_like(cut_off)
    averaged_peaks = torch.tensor(
        clear_averages(pupil.aperture, alphas, camera.pixel == "zoh"), dtype=torch.float64
    )
    return averaged_peaks / area, cut_off, torch.ones_like(cut_off)


def _intensity_at_points(
    pupil: Pupil, camera: _Camera, lights: list[float], dtype: torch.dtype, method: Method
) -> Tensor:
    """Return the intensity (band, y, x) at the middle of each pixel, times the area of a pixel."""
    # pixels from the spot to the middle of the window, along both axes
    middles = [
        (n - 1) / 2 - place for n, place in zip(camera.shape, spot_position(camera), strict=True)
    ]
    row_axis, column_axis = (
        GridAxis(n, 1.0, middle) for n, middle in zip(camera.shape, middles, strict=True)
    )
    views = (
        view_on_grid(pupil, camera, band, (row_axis, column_axis), light, dtype)
        for band, light in enumerate(lights)
    )
    return intensity_of(
        pupil.amplitude, pupil.height, pupil.path, Sampling(tuple(views), dtype, method)
    )


def _intensity_over_pixels(
    pupil: Pupil, camera: _Camera, lights: list[float], dtype: torch.dtype, method: Method
) -> Tensor:
    """Return the intensity (band, y, x) averaged over each pixel, times the area of a pixel."""
    field_bytes = 2 * fine_samples(pupil, camera, dtype) * dtype.itemsize
    optics = IntensityOptions(dtype, method, field_bytes <= KEPT_FIELD_BYTES)
    factors = (pupil.amplitude, pupil.height, pupil.path)
    # with gradients each band is a separate tensor; otherwise all are written into one tensor
    if transformed() or (torch.is_grad_enabled() and any(x.requires_grad for x in factors)):
        bands = [
            torch.cat(band_average(pupil, camera, band, light, optics))
            for band, light in enumerate(lights)
        ]
        return torch.stack(bands)
    intensity = torch.empty(len(lights), *camera.shape, dtype=dtype, device=pupil.height.device)
    for band, light in enumerate(lights):
        torch.cat(band_average(pupil, camera, band, light, optics), out=intensity[band])
    return intensity


def _light_and_field(amplitude: Tensor) -> tuple[float, float]:
    """Return the sum of the squares and the sum of all samples of an amplitude in the pupil."""
    samples = amplitude.detach().flatten()
    if samples.numel() <= _PART_SAMPLES:
        return float(torch.dot(samples, samples)), float(samples.sum())
    parts = torch.split(samples, _PART_SAMPLES)  # read from memory once for both sums
    light, field = zip(*((torch.dot(x, x), x.sum()) for x in parts), strict=True)
    total_light, total_field = (
        float(torch.stack(sums).sum(dtype=torch.float64)) for sums in (light, field)
    )
    return total_light, total_field


def _refuse_unlike_factors(pupil: Pupil) -> None:
    """Raise ValueError for factors of a pupil that differ in shape or type, or that cannot have
    gradients.
    """
    shapes = {
        name: tuple(getattr(pupil, name).shape)
        for name in ("aperture", "amplitude", "height", "path")
    }
    if len(set(shapes.values())) != 1 or pupil.height.dim() != 2:
        raise ValueError(
            f"the factors of the pupil differ in shape: {shapes}; give all the same (v, u)"
        )
    refuse_half(amplitude=pupil.amplitude, height=pupil.height, path=pupil.path)
    if pupil.index.shape != pupil.wavelengths.shape or pupil.index.dim() != 1:
        raise ValueError(
            f"index {tuple(pupil.index.shape)} and wavelengths {tuple(pupil.wavelengths.shape)}"
            " differ: give one index for each band"
        )

    if pupil.index.requires_grad or pupil.wavelengths.requires_grad:
        raise ValueError(
            "index and wavelengths cannot receive gradients: detach both, or train amplitude,"
            " height or path"
        )
