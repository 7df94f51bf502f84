"""The image of the scene in each band, and the light that stays in the field of view."""

import math
from typing import Any, Literal

import torch
from torch import Tensor
from torch.nn.functional import conv2d, pad

from neusee.nodes import Check, node
from neusee.nodes.optics.transform._fft_transforms import fft_length
from neusee.nodes.precision import one_by_one
from neusee.nodes.values import Psf

# --- band image -----------------------------------------------------------------------------------

# The image of the scene: each band convolved with its point-spread function.


Border = Literal["zero", "reflect"]
Corner = tuple[int, int]
#: ratio of a scene's root mean square to its typical value, above which float32 is not precise
#: enough
_FLOAT32_CONTRAST = 100.0


@node(rtol=1e-5, bands={"radiance": -3, "psf": 0, "return": -3})
def image(radiance: Tensor, psf: Psf, *, border: Border = "zero") -> Tensor:
    """Convolve each band with its PSF linearly, so that light that leaves one edge does not return
    at the other edge.

    Shapes: radiance (..., band, y, x), psf.intensity (band, any, any) -> (..., band, y, x).
    Units:  those of the radiance, times the share of the pupil's light that reaches each pixel.
    Error:  float32 FFT: rms 2e-7 of the scene's root mean square or less. A band whose root mean
            square exceeds 100 times its typical value (lamps at night) is transformed in float64,
            in twice the time, so that round-off of the lamps does not hide the dark parts. Lasers
            are added as spots and are not convolved. A PSF wider than twice the scene is cropped to
            the part that reaches the scene. `reflect` needs up to four times the memory of `zero`.
    Raises: ValueError where scene and PSF have different bands.
    Source: Goodman, Introduction to Fourier Optics, 4th ed., ch. 7 (incoherent imaging).
    """
    scene, kernel, corner = _fitted(radiance, psf.intensity, border)
    size = (radiance.shape[-2], radiance.shape[-1])
    scenes = scene.reshape(-1, *scene.shape[-3:])
    images = [_convolved_bands(scene_of_batch, kernel, corner, size) for scene_of_batch in scenes]
    return (
        images[0].reshape(radiance.shape)
        if len(images) == 1
        else torch.stack(images).reshape(radiance.shape)
    )


@image.reference
def _(radiance: Tensor, psf: Psf, *, border: Border = "zero") -> Tensor:
    scene, kernel, _ = _fitted(radiance.double(), psf.intensity.double(), border)
    m, n = kernel.shape[-2:]
    if border == "zero":
        scene = pad(scene, (n - 1 - n // 2, n // 2, m - 1 - m // 2, m // 2))
    scenes = scene.reshape(-1, *scene.shape[-3:])
    return conv2d(scenes, kernel.flip(-1, -2)[:, None], groups=len(kernel)).reshape(radiance.shape)


@image.check
def _(result: Tensor, radiance: Tensor, psf: Psf, **params: Any) -> list[Check]:
    scene_light, image_light = (
        float(x.sum(-1).sum(dtype=torch.float64)) for x in (radiance, result)
    )
    if scene_light <= 0:
        return [Check("the scene holds no light")]
    largest_sum = float(psf.intensity.sum(-1).sum(-1, dtype=torch.float64).amax())
    return [
        Check(
            f"flux kept in the image {image_light / scene_light:.2%}",
            ok=params.get("border") == "reflect"
            or image_light <= scene_light * largest_sum * 1.001,
        )
    ]


def _fitted(radiance: Tensor, intensity: Tensor, border: Border) -> tuple[Tensor, Tensor, Corner]:
    """Return the scene, the cropped PSF, and the place (y, x) of the first image pixel in their
    full convolution.

    The scene gets a mirrored border unless ``border`` is "zero".
    """
    if radiance.ndim < 3 or radiance.shape[-3] != intensity.shape[0]:
        raise ValueError(
            f"radiance {tuple(radiance.shape)} and PSF {tuple(intensity.shape)} must have the same"
            " bands: compute both from the same `bands` step"
        )
    dtype = torch.promote_types(torch.promote_types(radiance.dtype, intensity.dtype), torch.float32)
    kernel = within_reach(
        within_reach(intensity, -2, radiance.shape[-2]), -1, radiance.shape[-1]
    ).to(dtype)
    m, n = kernel.shape[-2:]
    if border == "zero":
        # pixel (0, 0) of the image is half a PSF from the edge of the full convolution
        return radiance.to(dtype), kernel, (m // 2, n // 2)
    # left, right, top, bottom: the reach of a PSF of odd or even side
    padding = (n - 1 - n // 2, n // 2, m - 1 - m // 2, m // 2)
    # `pad` needs a batch of pictures
    padded_scenes = pad(
        radiance.to(dtype).reshape(-1, *radiance.shape[-3:]), padding, mode="reflect"
    )
    return (
        padded_scenes.reshape(*radiance.shape[:-2], *padded_scenes.shape[-2:]),
        kernel,
        # half a PSF as above, plus the padding
        (m - 1, n - 1),
    )


def within_reach(kernel: Tensor, dim: int, size: int) -> Tensor:
    """Return a PSF, cropped along one axis to the samples whose distance from its centre is less
    than ``size``, the side of the scene.
    """
    centre = kernel.shape[dim] // 2
    low, high = max(0, centre - size + 1), min(kernel.shape[dim], centre + size)
    return kernel.narrow(dim, low, high - low)


def _convolved_bands(scene: Tensor, kernel: Tensor, corner: Corner, size: Corner) -> Tensor:
    """Convolve each band of the scene with its PSF, in float64 if the contrast of the band is
    too high for float32.
    """
    needs_float64 = _bands_in_float64(scene) if scene.dtype == torch.float32 else []
    if not any(needs_float64):
        return _convolve(scene, kernel, corner, size)
    if all(needs_float64):
        return _convolve(scene.double(), kernel.double(), corner, size).to(scene.dtype)
    band_types = (torch.float64 if d else scene.dtype for d in needs_float64)
    images = [
        _convolve(s[None].to(d), k[None].to(d), corner, size)
        for s, k, d in zip(scene, kernel, band_types, strict=True)
    ]
    return torch.cat([band.to(scene.dtype) for band in images])


def _bands_in_float64(scene: Tensor) -> list[bool]:
    """Return, for each band of the scene, True if the float32 round-off of bright pixels would hide
    the other pixels.
    """
    flat = scene.detach().flatten(1)
    sampled = flat[:, :: max(1, flat.shape[1] >> 16)]
    # squared mean of square roots: a typical value that bright pixels hardly change
    typical = sampled.abs().sqrt().mean(1).square()
    root_mean_square = torch.linalg.vector_norm(flat, dim=1) / math.sqrt(flat.shape[1])
    needs_float64: list[bool] = (root_mean_square > _FLOAT32_CONTRAST * typical).tolist()
    return needs_float64


def _convolve(scene: Tensor, kernel: Tensor, corner: Corner, size: Corner) -> Tensor:
    """Return a window of the convolution of scene and PSF, by the shortest FFT without
    wrap-around in the window.
    """
    length = [
        # the largest of: scene, end of the window, length without wrap-around into the window
        fft_length(max(s, a + w, s + k - 1 - a))
        for s, k, a, w in zip(scene.shape[1:], kernel.shape[1:], corner, size, strict=True)
    ]
    result: Tensor = _Product.apply(
        scene, kernel, (0, 0), (0, 0), corner, size, False, tuple(length)
    )  # type: ignore[no-untyped-call]
    return result


class _Product(torch.autograd.Function):
    """The convolution or correlation of two pictures, band by band, as a product of their FFTs,
    cropped to a window.

    ``a`` and ``b`` are padded with zeros around their corners. Both gradients are products of the
    same kind, so only the inputs are stored and derivatives of every order exist.
    """

    @staticmethod
    def forward(a: Tensor, b: Tensor, *settings: Any) -> Tensor:
        scene_corner, kernel_corner, corner, size, conjugate, length = settings
        plane, result = _Plane(length, a), a.new_empty(len(a), *size)
        for picture, kernel, band_result in zip(a, b, result, strict=True):
            band_result.copy_(
                plane.window(
                    plane.product(picture, scene_corner, kernel, kernel_corner, conjugate),
                    corner,
                    size,
                )
            )
        return result

    @staticmethod
    def setup_context(ctx: Any, inputs: tuple[Any, ...], output: Tensor) -> None:
        """Save the inputs for the backward pass outside of `forward`, as `torch.func` requires."""
        ctx.save_for_backward(*inputs[:2])
        ctx.save_for_forward(*inputs[:2])
        ctx.settings = inputs[2:]

    @staticmethod
    def backward(ctx: Any, *grads: Tensor) -> Any:
        (a, b), (scene_corner, kernel_corner, corner, _, conjugate, length), grad = (
            ctx.saved_tensors,
            ctx.settings,
            grads[0],
        )
        scene_gradient = kernel_gradient = None
        # gradient of a: correlation of grad and b, cropped to the place of a
        if ctx.needs_input_grad[0]:
            scene_gradient = _Product.apply(
                grad,
                b,
                corner,
                kernel_corner,
                scene_corner,
                tuple(a.shape[1:]),
                not conjugate,
                length,
            )  # type: ignore[no-untyped-call]
        if ctx.needs_input_grad[1]:
            first, second, first_corner, second_corner = (
                (a, grad, scene_corner, corner) if conjugate else (grad, a, corner, scene_corner)
            )
            kernel_gradient = _Product.apply(
                first,
                second,
                first_corner,
                second_corner,
                kernel_corner,
                tuple(b.shape[1:]),
                True,
                length,
            )  # type: ignore[no-untyped-call]
        return scene_gradient, kernel_gradient, *(None for _ in ctx.settings)

    @staticmethod
    def jvp(ctx: Any, a: Tensor | None, b: Tensor | None, *_: None) -> Any:
        """Return the tangent by the product rule: the change of the first factor, then of the
        second.
        """
        first, second = ctx.saved_tensors
        changes = []
        if a is not None:
            changes.append(_Product.apply(a, second, *ctx.settings))  # type: ignore[no-untyped-call]
        if b is not None:
            changes.append(_Product.apply(first, b, *ctx.settings))  # type: ignore[no-untyped-call]
        return sum(changes[1:], changes[0])

    @staticmethod
    def vmap(info: Any, in_dims: tuple[int | None, ...], *inputs: Any) -> Any:
        return one_by_one(
            _Product.apply, info.batch_size, (*in_dims[:2], *(None for _ in inputs[2:])), inputs
        )


class _Plane:
    """Memory for the FFT of one zero-padded band of a picture, reused for the next band.

    The transform of the columns does not use ``out=``, which makes a copy: 21 ms instead of 12 ms
    at 3072 x 1537.
    """

    def __init__(self, length: Corner, like: Tensor) -> None:
        dtype = torch.complex128 if like.dtype == torch.float64 else torch.complex64
        self.length = length
        self.real = like.new_empty(length)
        self.rows = like.new_empty((length[0], length[1] // 2 + 1), dtype=dtype)

    def product(
        self, a: Tensor, scene_corner: Corner, b: Tensor, kernel_corner: Corner, conjugate: bool
    ) -> Tensor:
        first, second = self._spectrum(a, scene_corner), self._spectrum(b, kernel_corner)
        if conjugate:
            second = second.conj_physical_()
        product: Tensor = first.mul_(second)
        return product

    def _spectrum(self, x: Tensor, corner: Corner) -> Tensor:
        """Return the FFT of a zero-padded picture: first along its nonzero rows, then along all
        columns.
        """
        (y, left), (height, width) = corner, x.shape
        for edge in (
            self.rows[:y],
            self.rows[y + height :],
            self.real[:height, :left],
            self.real[:height, left + width :],
        ):
            edge.zero_()
        self.real[:height, left : left + width] = x
        torch.fft.rfft(self.real[:height], out=self.rows[y : y + height])
        spectrum: Tensor = torch.fft.fft(self.rows, dim=0)
        return spectrum

    def window(self, spectrum: Tensor, corner: Corner, size: Corner) -> Tensor:
        (top, left), (h, w) = corner, size
        columns = torch.fft.ifft(spectrum, dim=0)
        torch.fft.irfft(columns[top : top + h], n=self.length[1], out=self.real[:h])
        return self.real[:h, left : left + w]


# --- light in field -------------------------------------------------------------------------------

# The light of a scene that stays in the field of view, computed without an image.
#
# Each PSF sample shifts the scene; the part of the scene that stays in the field is a rectangle.


_FLOAT64_ROWS = 32  #: number of scene rows that are summed in float64 at a time


def light_in_field(intensity: Tensor, radiance: Tensor) -> tuple[Tensor, Tensor]:
    """Return the light of the image of a scene (..., band, y, x) that lies in the field, and the
    total light of the scene.

    Both are sums over pixels, (..., band) float64. No light enters from outside the field. Raises
    ValueError if scene and PSF (band, any, any) have different bands.
    """
    shape = tuple(radiance.shape)
    if len(shape) < 3 or shape[-3] != len(intensity):
        raise ValueError(
            f"radiance {shape} and PSF {tuple(intensity.shape)} must have the same bands: "
            "compute both from the same `bands` step"
        )
    kernel, size = (
        within_reach(within_reach(intensity, -2, shape[-2]), -1, shape[-1]),
        (shape[-2], shape[-1]),
    )
    scene, kernel = _in_one_type(radiance, kernel)
    in_field = []
    for planes in scene.reshape(-1, *shape[-3:]):
        for plane, band in zip(planes, kernel, strict=True):
            light = _box_sums(plane, band.shape, size) * band
            in_field.append(light.sum(-1).sum(-1, dtype=torch.float64))
    return torch.stack(in_field).reshape(shape[:-2]), scene.sum(-1).sum(-1, dtype=torch.float64)


def _in_one_type(scene: Tensor, kernel: Tensor) -> tuple[Tensor, Tensor]:
    """Return scene and PSF in the more precise of their types, at least float32."""
    dtype = torch.promote_types(torch.promote_types(scene.dtype, kernel.dtype), torch.float32)
    return scene.to(dtype), kernel.to(dtype)


def _box_sums(plane: Tensor, kernel: torch.Size, size: tuple[int, int]) -> Tensor:
    """Return, for each PSF sample, the sum (m, n) of a plane over the rectangle that the sample
    shifts to pixels in the field of view.

    The plane is rotated by 180 degrees, so that the rectangles have the order of the samples. The
    sums are in float64, a few rows at a time, because the allocation of whole float64 planes takes
    longer than the sums.
    """
    # the product with a lower triangular matrix of ones is a cumulative sum over rows
    lower_triangle = torch.ones(
        _FLOAT64_ROWS, _FLOAT64_ROWS, dtype=torch.float64, device=plane.device
    ).tril()
    sum_above, blocks = plane.new_zeros(kernel[1], dtype=torch.float64), []
    for end in range(len(plane), 0, -_FLOAT64_ROWS):
        rows = plane[max(0, end - _FLOAT64_ROWS) : end].flip(0, 1).cumsum(1, dtype=torch.float64)
        sums = (
            lower_triangle[: len(rows), : len(rows)] @ _sums_along_axis(rows, 1, kernel[1], size[1])
            + sum_above
        )
        sum_above = sums[-1]
        blocks.append(sums.to(plane.dtype))
    return _sums_along_axis(torch.cat(blocks), 0, kernel[0], size[0])


def _sums_along_axis(sums: Tensor, dim: int, kernel: int, size: int) -> Tensor:
    """Return sums over intervals along the axis ``dim``, from cumulative sums; each interval starts
    or ends at an edge of the scene.
    """
    # first the intervals that start at the first edge and grow, then those that end at the last
    # edge and shrink
    half_kernel = kernel // 2
    first = sums.narrow(dim, size - half_kernel - 1, half_kernel + 1)
    return torch.cat(
        [first, sums.narrow(dim, -1, 1) - sums.narrow(dim, 0, kernel - half_kernel - 1)], dim
    )
