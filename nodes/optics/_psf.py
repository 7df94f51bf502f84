"""The point-spread function: lens, mask and pixel sampling in one scaled Fourier transform."""

import math
from typing import Any, Literal

import torch
from torch import Tensor

from neusee.nodes import Check, ParameterError, node
from neusee.nodes._half_precision import refuse_half, refuse_not_finite
from neusee.nodes.optics._f_number import refuse_impossible_f_number
from neusee.nodes.optics._laser_direction import angle_notes
from neusee.nodes.optics._notch import passed_by_notches
from neusee.nodes.optics._pixel_average import (
    GridAxis,
    Optics,
    band_average,
    clear_averages,
    fine_samples,
    spot,
    turns_per_pixel,
    view_of,
)
from neusee.nodes.optics._psf_definition import Geometry, SensorSampling, by_definition
from neusee.nodes.optics._psf_limits import (
    fast_lens_notes,
    refuse_aliases,
    refuse_coarse_points,
    refuse_gained_light,
    spread_points_notes,
)
from neusee.nodes.optics._transform._intensity import KEPT_FIELD_BYTES, Sampling, intensity_of
from neusee.nodes.optics._transform._scaled_transform import Method
from neusee.nodes.torch_func import transformed
from neusee.nodes.units import Angle, FocalLength, PixelPitch, Shape
from neusee.nodes.values import Psf, Pupil

_PART = 1 << 15  #: samples of the pupil that are summed in the type of the pupil


class _Camera(Geometry):
    """The geometry of lens, sensor and source, to which the direction of a laser is added."""

    def towards(self, direction: Tensor | None) -> "_Camera":
        """Return the camera with ``direction``, if it is known, added to the angle of the source."""
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
    """Focus the pupil on the sensor by the scaled Fraunhofer integral, sampled at the sensor's pixel pitch.

    A source at ``angle`` (n_y, n_x) has its spot at (f n_y, f n_x), to a fraction of a pixel. An input ``direction`` is
    added to ``angle``. The window stays centred on the axis for every angle.
    ``pixel="zoh"`` holds the height map constant over each square pupil pixel, which gives a sinc envelope.
    ``sensor="integrated"`` averages over the square of each sensor pixel; ``"point"`` samples its middle, as a fine
    grid of a spot does. Points further apart than wavelength x f-number miss light or count it many times, so that
    they are refused; ``"point_as_printed"`` allows them, for the reading of the paper.
    Amplitude, height and path receive a first derivative; a second derivative raises an error.

    Shapes: pupil (v, u), direction (2,) rad -> intensity (band, y, x), clear_peak, cut_off, averaged (band,).
    Units:  metres -> share of the clear pupil's light per pixel, not normalised to a sum of one.
    Error:  single, 2e-6 of the brightest pixel, or 3e-6 in the speckle of a rough mask, whose brightest pixel is only a
        few times the mean; double, 1e-11. At 1e-8 of the brightest pixel,
        single errs by 1e-4 of the value at the median and 1e-3 at most in a window of up to a tenth of the pupil's
        samples a side, and by 2e-4 and 4e-3 in a wider window, whose last axis is transformed in float32: a rounding by
        2^-24 of the brightest field alone changes such a pixel by 1.2e-3. Where the share s of the clear peak is below
        1e-6, 5e-9 / sqrt(s) of the value at the median and 2e-7 / sqrt(s) at most.
        The average over pixels adds 1e-8 of the clear peak, in double 1e-12. Energy in the window is at most that of
        the pupil, within 1e-5, in double 1e-9. Scalar theory: below f/1.2 polarisation, and at any f-number the
        acceptance of microlenses, are ignored.
    Raises: ParameterError before the run, or ValueError, where the window reaches beyond half the alias-free field,
        lambda f / (2 pitch), from the spot, and where points are further apart than wavelength x f-number;
        ParameterError for an angle of 1 rad or more; ValueError for a closed
        aperture, for heights or paths that are not finite or above 1e9 turns, for a pupil in half precision, and for a
        result with more light in the window than the pupil passes.
    Source: Goodman, Introduction to Fourier Optics, 3rd edition, eq. 5-14 (field in the focal plane of a lens).
    """
    camera = _Camera(focal_length, pixel_pitch, shape, angle, pixel, sensor).towards(direction)
    return _focus(pupil, camera, torch.float64 if precision == "double" else torch.float32, "auto")


@psf.reference
def _(pupil: Pupil, direction: Tensor | None = None, *, precision: str = "single", **camera: Any) -> Psf:
    geometry = _Camera(**camera).towards(direction)
    _agree(pupil)
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
    for parameter, view in (("focal_length", camera), ("direction.angle", camera.towards(direction))):
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
    low, high = float(shares.min()), float(shares.max())
    energy = f"energy in window {low:.1f} %" + (f" to {high:.1f} %" if high - low >= 0.05 else "")
    return [Check(energy, low >= 0.0)]


def _focus(pupil: Pupil, camera: _Camera, dtype: torch.dtype, method: Method) -> Psf:
    _agree(pupil)
    refuse_aliases(pupil, camera)
    refuse_coarse_points(pupil, camera)
    area, total = _area(pupil.aperture)
    refuse_not_finite("the PSF cannot be normalised", aperture=area)
    if not area > 0:
        raise ValueError("the aperture is closed everywhere: there is no light to normalise the PSF by")
    lights = (passed_by_notches(pupil) / area).tolist()
    focused = _averages if camera.sensor == "integrated" else _points
    intensity = focused(pupil, camera, lights, dtype, method)
    if not transformed():
        passed = area if pupil.amplitude is pupil.aperture else _area(pupil.amplitude)[0]
        refuse_gained_light(intensity, [light * passed for light in lights], pupil.wavelengths)
    return Psf(intensity, *(values.to(intensity.device) for values in _clear_lens(pupil, camera, area, total)))


def _clear_lens(pupil: Pupil, camera: _Camera, area: float, total: float) -> tuple[Tensor, Tensor, Tensor]:
    """Return peak and cut-off of the lens without mask, dirt and aberrations, and over what a pixel averages."""
    alphas = [turns_per_pixel(pupil, camera, band) for band in range(pupil.wavelengths.numel())]
    points = torch.tensor(alphas, dtype=torch.float64).square() * (total**2 / area)
    cut_off = (points * (4 / math.pi)).sqrt()
    if camera.sensor != "integrated":
        return points, cut_off, torch.zeros_like(points)
    peaks = torch.tensor(clear_averages(pupil.aperture, alphas, camera.pixel == "zoh"), dtype=torch.float64)
    return peaks / area, cut_off, torch.ones_like(points)


def _points(pupil: Pupil, camera: _Camera, lights: list[float], dtype: torch.dtype, method: Method) -> Tensor:
    """Return the intensity (band, y, x) at the middle of each pixel, times the area of a pixel."""
    middles = [(n - 1) / 2 - at for n, at in zip(camera.shape, spot(camera), strict=True)]
    y, x = (GridAxis(n, 1.0, middle) for n, middle in zip(camera.shape, middles, strict=True))
    views = (view_of(pupil, camera, band, (y, x), light, dtype) for band, light in enumerate(lights))
    return intensity_of(pupil.amplitude, pupil.height, pupil.path, Sampling(tuple(views), dtype, method))


def _averages(pupil: Pupil, camera: _Camera, lights: list[float], dtype: torch.dtype, method: Method) -> Tensor:
    """Return the intensity (band, y, x) averaged over each pixel, times the area of a pixel."""
    kept = 2 * fine_samples(pupil, camera, dtype) * dtype.itemsize
    optics = Optics(dtype, method, kept <= KEPT_FIELD_BYTES)
    factors = (pupil.amplitude, pupil.height, pupil.path)
    if transformed() or (torch.is_grad_enabled() and any(x.requires_grad for x in factors)):
        bands = [torch.cat(band_average(pupil, camera, band, light, optics)) for band, light in enumerate(lights)]
        return torch.stack(bands)
    intensity = torch.empty(len(lights), *camera.shape, dtype=dtype, device=pupil.height.device)
    for band, light in enumerate(lights):
        torch.cat(band_average(pupil, camera, band, light, optics), out=intensity[band])
    return intensity


def _area(amplitude: Tensor) -> tuple[float, float]:
    """Return the sum of the light and the sum of the field over all samples of an amplitude in the pupil."""
    parts = torch.split(amplitude.detach().flatten(), _PART)  # read from memory once for both sums
    light, field = zip(*((torch.dot(x, x), x.sum()) for x in parts), strict=True)
    total_light, total_field = (float(torch.stack(sums).sum(dtype=torch.float64)) for sums in (light, field))
    return total_light, total_field


def _agree(pupil: Pupil) -> None:
    shapes = {name: tuple(getattr(pupil, name).shape) for name in ("aperture", "amplitude", "height", "path")}
    if len(set(shapes.values())) != 1 or pupil.height.dim() != 2:
        raise ValueError(f"the factors of the pupil differ in shape: {shapes}; give all the same (v, u)")
    refuse_half(amplitude=pupil.amplitude, height=pupil.height, path=pupil.path)
    if pupil.index.shape != pupil.wavelengths.shape or pupil.index.dim() != 1:
        raise ValueError(
            f"index {tuple(pupil.index.shape)} and wavelengths {tuple(pupil.wavelengths.shape)} differ: "
            "give one index for each band"
        )

    if pupil.index.requires_grad or pupil.wavelengths.requires_grad:
        raise ValueError(
            "index and wavelengths cannot receive gradients: detach both, or train amplitude, height or path"
        )
