"""Conversion of electrons to digital numbers: full well, analogue-to-digital converter, and
sensor window.
"""

import math
from fractions import Fraction
from typing import Annotated, Any, Literal

import torch
from pydantic import Field
from torch import Generator, Tensor

from neusee.nodes import Check, ErrorBound, ParameterError, TensorStats, node
from neusee.nodes.precision import single, transformed
from neusee.nodes.sensor._noise import rare_events
from neusee.nodes.sensor._saturation import Well, refuse_below_one_electron
from neusee.nodes.units import Gain, Shape

Rounding = Literal["nearest", "dithered_floor", "truncation"]
#: number of pixels that are converted at a time, so that their float64 numbers fit in the cache
_BLOCK_PIXELS = 2**18
Bits = Annotated[int, Field(ge=1, le=16)]


def clipping_number(full_well: float, gain: float, bits: int) -> int:
    """Return the smallest digital number that counts as clipped: that of the full well, or the
    largest of the converter if this is smaller.
    """
    return max(1, min((1 << bits) - 1, int(full_well * gain - 0.5)))


def is_clipped(raw: Tensor, *, full_well: float, gain: float, bits: int) -> Tensor:
    """Return True for raw values in DN at the full well or at the largest output of the
    converter, and for NaN.
    """
    clipped: Tensor = ~(raw < clipping_number(full_well, gain, bits))  # NaN counts as clipped
    return clipped


def electrons_to_clip(full_well: float, gain: float, bits: int, offset: float = 0.0) -> float:
    """Return the electrons of light that fill a pixel: its digital number, rounded to the nearest,
    counts as clipped.

    The converter may end below the full well, and an ``offset`` that is added before uses a part of
    it.

    Shapes: scalars.
    Units:  full_well, offset and result e-; gain DN/e-.
    Error:  exact without noise and dark current; 0 or less where the offset alone fills a pixel.
    Source: NeuSee, Eq. (SensorImage).
    """
    return (clipping_number(full_well, gain, bits) - 0.5) / gain - offset


@node(rtol=0.0)
def full_well(electrons: Tensor, *, capacity: Well) -> Tensor:
    """Limit the electrons in each pixel to the full well.

    Shapes: electrons (..., y, x) -> (..., y, x).
    Units:  e-.
    Error:  a hard edge: neither blooming into neighbours nor a soft knee. An offset that is added
            before uses a part of the well, as the paper prints.
    Source: NeuSee, Eq. (SensorImage).
    """
    return single(electrons).clamp_max(capacity)


@full_well.skip_bound
def _(electrons: TensorStats, *, capacity: float) -> float:
    """Return the relative change of the brightest pixel if the step `sensor.full_well` is omitted.

    The change is relative to the largest result. The well is rounded to the dtype, and so differs
    from ``capacity`` by up to half a step of the dtype.
    """
    dtype = torch.promote_types(getattr(torch, electrons.dtype), torch.float32)
    well = float(torch.tensor(capacity, dtype=dtype))
    if electrons.max <= well:
        return 0.0
    largest = max(well, -electrons.min)
    return (electrons.max - well) / largest if largest > 0 else math.inf


@full_well.propagate_error
def _(electrons: ErrorBound, **params: Any) -> float:
    return electrons.rms


@full_well.check
def _(result: Tensor, electrons: Tensor, *, capacity: float) -> list[Check]:
    return [
        Check(
            f"{int(torch.count_nonzero(result >= capacity))} of {result.numel()} pixels reach the"
            " full well"
        )
    ]


@node(rtol=0.0)
def digitize(
    electrons: Tensor,
    *,
    gain: Gain,
    rounding: Rounding = "nearest",
    bits: Bits = 16,
    rng: Generator | None = None,
) -> Tensor:
    """Convert electrons to whole digital numbers, clipped to the range of the analogue-to-digital
    converter.

    Shapes: electrons (..., y, x) -> (..., y, x), whole numbers in the dtype of the input (float32
            for half precision).
    Units:  electrons e-; gain K of EMVA 1288, DN/e-, which a recipe may also write as e-/DN; result
            DN in [0, 2**bits - 1].
    Error:  `nearest` rounds the float64 product of electrons and gain half to even: every number is
            exact unless the product is within 1e-11 DN of the middle of two numbers. Variance 1/12
            DN2. `truncation`, floor(x), as many converters cut, is 1/2 DN too low with the same
            variance. `dithered_floor`, floor(x + U(-1/2, 1/2)) as printed, is 1/2 DN too low with
            up to 1/6 DN2 more variance. Integral nonlinearity is left out. The gradient is that of
            the numbers before rounding, and 0 where the converter clips.
    Raises: ValueError for `dithered_floor` without rng.
    Source: NeuSee, Eq. (SensorImage); EMVA Standard 1288, release 4.0 (quantization variance 1/12
            DN2).
    """
    if rounding == "dithered_floor" and rng is None:
        raise ValueError("rounding dithered_floor needs random numbers: give rng=torch.Generator()")
    electrons = single(electrons)
    # the numbers have no gradient: it is that of the value before rounding
    numbers = _whole_numbers(electrons.detach(), gain, 2**bits - 1, rounding, rng)
    if not (electrons.requires_grad or transformed()):
        return numbers
    ideal = (electrons * gain).clamp(0, 2**bits - 1)
    # the sum is exact: the difference is a multiple of the last bit of `ideal`
    return ideal + (numbers - ideal).detach()


def _whole_numbers(
    electrons: Tensor, gain: float, top: int, rounding: Rounding, rng: Generator | None
) -> Tensor:
    """Return the digital numbers from 0 to ``top``, rounded half to even, cut, or cut with a dither
    from ``rng``.

    The product is float64: in float32, one number in a thousand would be off by one.
    """
    result = torch.empty_like(electrons, memory_format=torch.contiguous_format)
    flat_electrons, flat_result, dither = electrons.reshape(-1), result.view(-1), None
    if rounding == "dithered_floor" and rng is not None:
        dither = (
            torch.rand(electrons.shape, generator=rng, device=rng.device, dtype=torch.float32) - 0.5
        )
        dither = dither.to(electrons.device).reshape(-1)
    # in blocks that fit in the cache of the processor
    for start in range(0, flat_electrons.numel(), _BLOCK_PIXELS):
        block = slice(start, start + _BLOCK_PIXELS)
        values = flat_electrons[block].double() * gain
        values = values if dither is None else values.add_(dither[block])
        values = values.round_() if rounding == "nearest" else values.floor_()
        flat_result[block] = values.clamp_(0, top)
    return result


@digitize.reference
def _(
    electrons: Tensor,
    *,
    gain: float,
    rounding: Rounding = "nearest",
    bits: int = 16,
    rng: Generator | None = None,
) -> Tensor:
    largest, electrons = 2**bits - 1, single(electrons)
    # exact products, since fractions do not round
    values = [float(Fraction(x) * Fraction(gain)) for x in electrons.flatten().tolist()]
    if rounding == "nearest":
        numbers = [round(min(max(x, 0.0), float(largest))) for x in values]
    elif rounding == "truncation":
        numbers = [min(max(math.floor(x), 0), largest) for x in values]
    else:
        dither = torch.rand(electrons.shape, generator=rng, dtype=torch.float32).flatten().tolist()
        numbers = [
            min(max(math.floor(x + (d - 0.5)), 0), largest)
            for x, d in zip(values, dither, strict=True)
        ]
    return torch.tensor(numbers, dtype=electrons.dtype).reshape(electrons.shape)


@digitize.propagate_error
def _(electrons: ErrorBound, *, result: TensorStats, gain: float, **params: Any) -> float:
    """Return an error bound of the digital numbers before rounding, whose effect
    `rounding_error` estimates.
    """
    return electrons.rms * gain


@digitize.rounding_error
def _(rms: float, *, result: TensorStats, **params: Any) -> float:
    """Return an estimate of the rms error in DN after rounding.

    With the probability e, a small error e (DN) moves a value across the border between two
    numbers, and changes its number by 1. The mean square grows by e - e^2, at most by 1/4. The
    assumed number of such pixels is exceeded in one of 10 000 pictures. This holds if noise spreads
    the values over at least one number. A uniform area without noise may change as a whole, by one
    number more.
    """
    pixels = max(1, math.prod(result.shape))
    change_of_square = rms * (1.0 - rms) if rms < 0.5 else 0.25
    return math.sqrt(rms**2 + rare_events(change_of_square * pixels) / pixels)


@digitize.preflight
def _(*, gain: float, bits: int = 16, **params: object) -> list[str]:
    refuse_below_one_electron(gain=gain, bits=bits)
    top = 2**bits - 1
    return [f"the largest digital number is {top} DN = {top / gain:.0f} e-"]


@digitize.check
def _(result: Tensor, *inputs: Tensor, bits: int = 16, **params: Any) -> list[Check]:
    high, low = (
        int(torch.count_nonzero(result == end)) / max(1, result.numel()) for end in (2**bits - 1, 0)
    )
    return [
        Check(
            f"{high:.2%} of pixels are at the largest digital number, {low:.2%} at 0 DN", high < 0.5
        )
    ]


@node(rtol=0.0)
def crop(image: Tensor, *, shape: Shape) -> Tensor:
    """Crop an image to the window of the sensor, with the optical axis at sample N // 2.

    Where image and window are not both odd or both even, kornia's `center_crop` interpolates
    between pixels.

    Shapes: image (..., y, x) -> (..., *shape).
    Units:  any.
    Error:  exact.
    Raises: ParameterError before the run, or ValueError, for a window larger than the image.
    Source: NeuSee, Eq. (SensorImage).
    """
    if message := _small_image_message(image, shape):
        raise ValueError(message)
    # sample m // 2 of the image is the optical axis, and sample n // 2 of the window
    top, left = (m // 2 - n // 2 for n, m in zip(shape, image.shape[-2:], strict=True))
    return image[..., top : top + shape[0], left : left + shape[1]].contiguous()


def _small_image_message(image: Tensor, shape: Shape) -> str:
    """Return a message if an image is smaller than a window of the given shape, else an empty
    text.
    """
    if all(n <= m for n, m in zip(shape, image.shape[-2:], strict=True)):
        return ""
    window_text, image_text = (f"{y} x {x}" for y, x in (shape, image.shape[-2:]))
    return (
        f"the sensor window of {window_text} pixels is larger than the image of {image_text}: "
        f"enlarge the scene (scene.shape) to at least {list(shape)}, or choose a smaller window"
    )


@crop.preflight
def _(*, shape: tuple[int, int], image: Tensor | None = None) -> list[str]:
    if image is not None and (problem := _small_image_message(image, shape)):
        raise ParameterError("shape", problem)
    return []


@crop.propagate_error
def _(image: ErrorBound, *, result: TensorStats, **params: Any) -> float:
    """Return an error bound of the cropped image for the worst case, in which all the error is
    inside the window.
    """
    pixels_before = math.prod(image.stats.shape) if image.stats else math.inf
    return image.rms * math.sqrt(pixels_before / max(1, math.prod(result.shape)))


@crop.skip_bound
def _(image: TensorStats, *, shape: tuple[int, int]) -> float:
    return 0.0 if image.shape[-2:] == tuple(shape) else math.inf
