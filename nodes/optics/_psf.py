"""The point-spread function: lens, mask and pixel sampling in one scaled Fourier transform."""

import math
from dataclasses import replace
from typing import Any, Literal

import torch
from torch import Tensor

from neusee.nodes import Check, ParameterError, node
from neusee.nodes._half_precision import refuse_half, refuse_not_finite
from neusee.nodes.optics._laser_direction import angle_notes
from neusee.nodes.optics._notch import passed_by_notches
from neusee.nodes.optics._psf_definition import Geometry, by_definition
from neusee.nodes.optics._transform._intensity import Sampling, intensity_of
from neusee.nodes.optics._transform._pupil_field import View
from neusee.nodes.optics._transform._sample_axis import Axis, centred
from neusee.nodes.optics._transform._scaled_transform import Method
from neusee.nodes.units import Angle, PositiveLength, Shape
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
    focal_length: PositiveLength,
    pixel_pitch: PositiveLength,
    shape: Shape,
    angle: tuple[Angle, Angle] = (0.0, 0.0),
    pixel: Literal["point", "zoh"] = "point",
    sensor: Literal["point", "integrated"] = "point",
    precision: Literal["single", "double"] = "single",
) -> Psf:
    """Focus the pupil on the sensor by the scaled Fraunhofer integral, sampled at the sensor's pixel pitch.

    A source at ``angle`` (n_y, n_x) has its spot at (f n_y, f n_x), to a fraction of a pixel. An input ``direction`` is
    added to ``angle``. The window stays centred on the axis for every angle.
    ``pixel="zoh"`` holds the height map constant over each square pupil pixel, which gives a sinc envelope.
    ``sensor="integrated"`` averages over the square of each sensor pixel; ``"point"`` samples its middle.
    Amplitude, height and path receive a first derivative; a second derivative raises an error.

    Shapes: pupil (v, u), direction (2,) rad -> intensity (band, y, x), clear_peak (band,).
    Units: metres -> share of the clear pupil's light per pixel, not normalised to a sum of one.
    Error: single, 2e-6 of the brightest pixel, or 3e-6 in the speckle of a rough mask, whose brightest pixel is only a
        few times the mean; double, 1e-11; integrated, a further 1e-5 of the clear peak. At 1e-8 of the brightest pixel,
        single errs by 1e-4 of the value at the median and 1e-3 at most in a window of up to a tenth of the pupil's
        samples a side, and by 2e-4 and 4e-3 in a wider window, whose last axis is transformed in float32: a rounding by
        2^-24 of the brightest field alone changes such a pixel by 1.2e-3. Where the share s of the clear peak is below
        1e-6, 5e-9 / sqrt(s) of the value at the median and 2e-7 / sqrt(s) at most.
    Raises: ParameterError before the run, or ValueError, where the window reaches beyond half the alias-free field,
        lambda f / (2 pitch), from the spot; ParameterError for an angle of 1 rad or more; ValueError for a closed
        aperture, for heights or paths that are not finite or above 1e9 turns, and for a pupil in half precision.
    Source: Goodman, Introduction to Fourier Optics, 3rd edition, eq. 5-14 (field in the focal plane of a lens).
    """
    camera = _Camera(focal_length, pixel_pitch, shape, angle, pixel, sensor).towards(direction)
    return _focus(pupil, camera, torch.float64 if precision == "double" else torch.float32, "auto")


@psf.reference
def _(pupil: Pupil, direction: Tensor | None = None, *, precision: str = "single", **camera: Any) -> Psf:
    given = _Camera(**camera).towards(direction)
    _agree(pupil)
    _refuse_aliases(pupil, given)
    return by_definition(pupil, given)


@psf.preflight
def _(*, pupil: Pupil | None = None, direction: Tensor | None = None, **params: Any) -> list[str]:
    camera = _Camera(**{name: params[name] for name in _Camera._fields})
    notes = angle_notes(camera.angle)
    for parameter, view in (("focal_length", camera), ("direction.angle", camera.towards(direction))):
        try:
            if pupil is not None and not (pupil.wavelengths.is_meta or pupil.pitch.is_meta):
                _refuse_aliases(pupil, view)
        except ValueError as error:
            raise ParameterError(parameter, str(error)) from None
    return notes


@psf.check
def _(result: Psf, *inputs: object, **params: object) -> list[Check]:
    rows = result.intensity.detach().sum(-1)  # a float64 copy of the whole stack would take 1 GB
    shares = 100 * rows.sum(-1, dtype=torch.float64)
    low, high = float(shares.min()), float(shares.max())
    energy = f"energy in window {low:.1f} %" + (f" to {high:.1f} %" if high - low >= 0.05 else "")
    return [Check(energy, low >= 0.0 and high < 100.1)]


def _focus(pupil: Pupil, camera: _Camera, dtype: torch.dtype, method: Method) -> Psf:
    _agree(pupil)
    _refuse_aliases(pupil, camera)
    views: list[View] = []
    area, total = _area(pupil)
    refuse_not_finite("the PSF cannot be normalised", aperture=area)
    if not area > 0:
        raise ValueError("the aperture is closed everywhere: there is no light to normalise the PSF by")
    peaks: list[float] = []
    passed = passed_by_notches(pupil).tolist()
    for band in range(pupil.wavelengths.numel()):
        views += _views(pupil, camera, band, passed[band] / area, dtype)
        peaks.append(_clear_peak(pupil, camera, band, area, total))
    sampling = Sampling(tuple(views), dtype, method)
    intensity = intensity_of(pupil.amplitude, pupil.height, pupil.path, sampling)
    return Psf(intensity, torch.tensor(peaks, dtype=torch.float64, device=intensity.device))


def _area(pupil: Pupil) -> tuple[float, float]:
    """Return the sum of the light and the sum of the field over all samples of the pupil without mask and dirt."""
    parts = torch.split(pupil.aperture.detach().flatten(), _PART)  # read from memory once for both sums
    light, field = zip(*((torch.dot(x, x), x.sum()) for x in parts), strict=True)
    total_light, total_field = (float(torch.stack(sums).sum(dtype=torch.float64)) for sums in (light, field))
    return total_light, total_field


def _alpha(pupil: Pupil, camera: _Camera, band: int) -> float:
    return float(pupil.pitch) * camera.pixel_pitch / (float(pupil.wavelengths[band]) * camera.focal_length)


def _views(pupil: Pupil, camera: _Camera, band: int, scale: float, dtype: torch.dtype) -> list[View]:
    """Return the grids of focal points for one band of the PSF, one grid for each quadrature node within a pixel."""
    alpha, wavelength = _alpha(pupil, camera, band), float(pupil.wavelengths[band])
    nodes, weights = _nodes(max(pupil.height.shape) * alpha) if camera.sensor == "integrated" else ([0.0], [1.0])
    axes = [Axis(n, k, alpha) for n, k in zip(pupil.height.shape, camera.shape, strict=True)]
    views = []
    for y, wy in zip(nodes, weights, strict=True):
        for x, wx in zip(nodes, weights, strict=True):
            middle = [(n - 1) / 2 - c + s for n, c, s in zip(camera.shape, _spot(camera), (y, x), strict=True)]
            tilt = (-alpha * middle[0], -alpha * middle[1])
            envelope = _envelopes(camera, alpha, middle, dtype, pupil.height.device) if camera.pixel == "zoh" else None
            turns_height, turns_path = float(pupil.index[band]) / wavelength, 1 / wavelength
            weight = wy * wx * scale * alpha**2
            views.append(View(band, axes[0], axes[1], turns_height, turns_path, tilt, weight, envelope))
    return views


def _spot(camera: _Camera) -> list[float]:
    """Return the position (y, x) of the spot on the sensor, in pixels."""
    return [
        n // 2 + camera.focal_length * a / camera.pixel_pitch for n, a in zip(camera.shape, camera.angle, strict=True)
    ]


def _envelopes(
    camera: _Camera, alpha: float, middle: list[float], dtype: torch.dtype, device: torch.device
) -> tuple[Tensor, Tensor]:
    pair = [
        torch.sinc((centred(n, device) + m) * alpha).square().to(dtype)
        for n, m in zip(camera.shape, middle, strict=True)
    ]
    return pair[0], pair[1]


def _nodes(bandwidth: float) -> tuple[list[float], list[float]]:
    """Return the fewest Gauss-Legendre nodes that integrate the fastest fringe over a pixel to 5e-6, and their weights.

    ``bandwidth`` is the number of fringes per pixel from opposite rims of the pupil. The clear pupil's
    optical transfer function bounds every other transfer function, so the error is below 1e-5 of the clear peak.
    """
    import numpy as np

    fringes = np.linspace(0, bandwidth, 65)
    for count in range(2, 65):
        x, w = np.polynomial.legendre.leggauss(count)
        if np.abs(np.cos(math.pi * np.outer(fringes, x)) @ w / 2 - np.sinc(fringes)).max() < 5e-6:
            break
    return (x / 2).tolist(), (w / 2).tolist()


def _clear_peak(pupil: Pupil, camera: _Camera, band: int, area: float, total: float) -> float:
    """Return the on-axis value of the PSF of the lens without mask, dirt and aberrations, sampled like the PSF."""
    alpha = _alpha(pupil, camera, band)
    if camera.sensor == "point":
        return total**2 * alpha**2 / area
    centre = camera._replace(shape=(1, 1), angle=(0.0, 0.0))
    nothing = torch.zeros_like(pupil.height)
    views = _views(pupil, centre, band, 1 / area, torch.float64)
    sampling = Sampling(tuple(replace(view, band=0) for view in views), torch.float64)
    return float(intensity_of(pupil.aperture, nothing, nothing, sampling))


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


def _refuse_aliases(pupil: Pupil, camera: _Camera) -> None:
    """Raise ValueError if the PSF window includes aliases, which a sampled pupil repeats every lambda f / pitch.

    With ``pixel="zoh"`` the repeated light is real, because square pillars do send light there.
    """
    if camera.pixel == "zoh":
        return
    shortest = float(pupil.wavelengths.min())
    limit = shortest * camera.focal_length / (2 * float(pupil.pitch))
    for axis, n, spot in zip("yx", camera.shape, _spot(camera), strict=True):
        reach = max(abs(0 - spot), abs(n - 1 - spot)) * camera.pixel_pitch
        if reach > limit * (1 + 1e-9):
            raise ValueError(
                f"the window reaches {reach * 1e3:.3g} mm from the spot along {axis}, but at {shortest * 1e9:.4g} nm "
                f"a pupil pitch of {float(pupil.pitch) * 1e6:.4g} um carries only {limit * 1e3:.3g} mm "
                "(lambda f / (2 pitch)) before the PSF repeats: choose a smaller angle, a smaller shape, "
                "a finer pupil pitch, or pixel='zoh'"
            )
