"""Shapes of the results of the optical nodes, and memory and operations of the slow ones."""

from typing import Any

import torch
from torch import Tensor

from neusee.nodes.optics._band_image import image
from neusee.nodes.optics._channel_image import image_channels
from neusee.nodes.optics._few_bands import few_bands, few_bands_checked, pupil_of_bands
from neusee.nodes.optics._laser_spot import direction, laser_irradiance
from neusee.nodes.optics._lens import white_irradiance
from neusee.nodes.optics._pixel_average import FINE_SAMPLES, fine_axes
from neusee.nodes.optics._psf import psf
from neusee.nodes.optics._pupil import pupil
from neusee.nodes.optics._pupil_grid import clear_diameter
from neusee.nodes.optics.transform._fused import expected_seconds
from neusee.nodes.optics.transform._sample_axis import Axis
from neusee.nodes.shape_rules import at_least_single, blank, double, known, transform_operations
from neusee.nodes.values import Bands, Channels, FewBands, LowRankCube, Psf, Pupil, Stop, Wavefront

_FILTER_SECONDS = 1.2e-9  #: time of one thread to write and filter a sample of the intensity
_SHORT, _FINE = 400e-9, 4e-6  #: m, assumed wavelength and pupil pitch if they are unknown


@pupil.shape
def _(
    height: Tensor | None,
    index: Any,
    bands: Bands,
    stop: Stop,
    dirt: Any = None,
    wavefront: Wavefront | None = None,
    shade: Any = None,
    **params: Any,
) -> Pupil:
    side, dtype = int(stop.samples), torch.float32 if height is None else height.dtype
    aperture, amplitude, relief, path = (blank(side, side, dtype=dtype) for _ in range(4))
    wave = double(len(bands.centres))
    is_even = wavefront is None or (known(wavefront.taper) and not float(wavefront.taper))
    transmission = aperture if dirt is None and shade is None and is_even else amplitude
    notches = double(0, 3) if shade is None else shade.notches
    return Pupil(
        aperture,
        transmission,
        relief,
        path,
        wave,
        bands.centres,
        stop.pitch,
        notches,
        clear_diameter(stop),
    )


@psf.shape
def _(
    pupil: Pupil, *direction: Any, shape: tuple[int, int], precision: str = "single", **params: Any
) -> Psf:
    dtype = torch.float64 if precision == "double" else torch.float32
    bands = len(pupil.wavelengths)
    return Psf(blank(bands, *shape, dtype=dtype), double(bands), double(bands), double(bands))


@psf.work
def _(
    result: Psf,
    pupil: Pupil,
    *direction: Any,
    focal_length: float,
    pixel_pitch: float,
    **params: Any,
) -> Any:
    """Return memory and operations of the C++ code; without a compiler, torch takes about three
    times as long.
    """
    wavelength = float(pupil.wavelengths.min()) if known(pupil.wavelengths) else _SHORT
    pitch = float(pupil.pitch) if known(pupil.pitch) else _FINE
    alpha = pitch * pixel_pitch / (wavelength * focal_length)
    bands, *size = result.intensity.shape
    samples = (pupil.height.shape[0], pupil.height.shape[1])
    points = [Axis(n, k, alpha) for n, k in zip(samples, size, strict=True)]
    if params.get("sensor") != "integrated":
        return _field_bytes(points), bands * 1e9 * expected_seconds(*points)
    fine_grids = fine_axes(samples, (size[0], size[1]), alpha, result.intensity.dtype)
    axes = [
        Axis(n, grid.samples, alpha / grid.per_pixel)
        for n, grid in zip(samples, fine_grids, strict=True)
    ]
    average_seconds = _FILTER_SECONDS * axes[0].n_out * axes[1].n_out
    strip_bytes = 8.0 * min(FINE_SAMPLES, axes[0].n_out * axes[1].n_out)
    return _field_bytes(axes) + strip_bytes, bands * 1e9 * (
        expected_seconds(*axes) + average_seconds
    )


def _field_bytes(axes: list[Axis]) -> float:
    """Return the bytes of the field in the pupil, and of the field after the transform along one
    axis, in single precision.
    """
    return 8.0 * axes[0].n_in * (axes[1].n_in + axes[1].n_out)


@image.shape
def _(radiance: Tensor, psf: Psf, **params: Any) -> Tensor:
    return blank(*radiance.shape, dtype=at_least_single(radiance, psf.intensity))


@image.work
def _(result: Tensor, radiance: Tensor, psf: Psf, *, border: str = "zero", **params: Any) -> Any:
    # bytes of memory during the run, beside inputs and result, and number of operations
    size = _padded(radiance, psf, border)
    border_bytes = (
        result.nbytes if border == "zero" else result[..., 0, 0].numel() * 4.0 * size[0] * size[1]
    )
    return 8.0 * size[0] * size[1] + border_bytes, result[
        ..., 0, 0
    ].numel() * 3 * transform_operations(*size)


@few_bands.shape
def _(pupil: Pupil, *others: Any, **params: Any) -> FewBands:
    """Return the shape of a choice of all bands: the number of chosen bands is unknown before the
    run.
    """
    count = len(pupil.wavelengths)
    return FewBands(double(count, count), blank(count, dtype=torch.int64), double(), double())


@few_bands_checked.shape
def _(few: FewBands, *others: Any, **params: Any) -> FewBands:
    return few


@pupil_of_bands.shape
def _(pupil: Pupil, few: FewBands) -> Pupil:
    """Return the pupil of all bands: the chosen bands are unknown before the run."""
    return pupil


@few_bands.work
@few_bands_checked.work
def _(result: FewBands, *inputs: Any, **params: Any) -> tuple[float, float]:
    """Return memory and operations of the PSFs of all bands in 480 x 480 pixels, the largest
    thumbnail: that of a mask that spreads the light.
    """
    pixels = len(result.share) * 480.0**2
    return 16.0 * pixels, 100.0 * pixels


@image_channels.shape
def _(radiance: LowRankCube, psf: Psf, rows: Tensor, *few: Any, **params: Any) -> Channels:
    dtype = at_least_single(radiance.planes, psf.intensity)
    planes = blank(len(rows), *radiance.planes.shape[1:], dtype=dtype)
    sizes = blank(5, dtype=torch.int64)
    return Channels(planes, double(*rows.shape), double(), sizes, double(), double(2))


@image_channels.work
def _(
    result: Channels,
    radiance: LowRankCube,
    psf: Psf,
    rows: Tensor,
    *few: Any,
    border: str = "zero",
    **params: Any,
) -> tuple[float, float]:
    # bytes of memory during the run, beside inputs and result, and number of operations
    (transform_height, transform_width), (planes_count, y, x), row_count = (
        _padded(radiance.planes, psf, border),
        radiance.planes.shape,
        len(rows),
    )
    # the part of the PSF that reaches the scene
    m, n = (min(a, 2 * b - 1) for a, b in zip(psf.intensity.shape[-2:], (y, x), strict=True))
    scene_height = y if border == "zero" else y + m
    rows_of_spectra = (
        4.0
        * transform_width
        * (planes_count * scene_height + row_count * planes_count * m + row_count * y)
    )
    kernel_bytes = 4.0 * planes_count * m * n + (
        0.0 if border == "zero" else 4.0 * planes_count * scene_height * (x + n)
    )
    # transforms of the planes, of a kernel for each row and plane, and back for each row
    transforms = planes_count + row_count * (planes_count + 1)
    operations = (
        transforms * transform_operations(transform_height, transform_width) + psf.intensity.numel()
    )
    return rows_of_spectra + 4.0 * row_count * y * transform_width + kernel_bytes, operations


@laser_irradiance.shape
def _(psf: Psf, bands: Bands, *others: Any, **params: Any) -> Tensor:
    return blank(*psf.intensity.shape, dtype=at_least_single(psf.intensity))


@white_irradiance.shape
def _(
    bands: Bands, stop: Stop, *, illuminance: Any = None, luminance: Any = None, **params: Any
) -> Tensor:
    """Return the value 0 for a scene without a brightness in lux or cd/m2: it needs no table of an
    illuminant.
    """
    return (
        torch.zeros((), dtype=torch.float64)
        if illuminance is None and luminance is None
        else double()
    )


@direction.shape
def _(*, angle: tuple[float, float] | None = None, **params: Any) -> Tensor:
    return double(2) if angle is None else torch.tensor(angle, dtype=torch.float64)


def _padded(scene: Tensor, psf: Psf, border: str) -> tuple[int, int]:
    """Return the size of the transforms for the convolution of a scene with a PSF; a reflected
    border enlarges the scene.
    """
    sides = zip(scene.shape[-2:], psf.intensity.shape[-2:], strict=True)
    y, x = (n + (2 if border == "reflect" else 1) * min(k, 2 * n - 1) for n, k in sides)
    return y, x
