"""Light levels of a measurement: reading and simulating their frames, statistics, and hot
pixels.
"""

from __future__ import annotations

import math
from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from itertools import accumulate
from pathlib import Path
from typing import Annotated, Any, Literal, NamedTuple

import numpy as np
import torch
from pydantic import Field
from torch import Generator, Tensor

from neusee.nodes import Check, ParameterError, node
from neusee.nodes.calibrate._frame_files import (
    LARGEST_NUMBER,
    frame_problem,
    read_frames,
    reader_of,
)
from neusee.nodes.sensor._digitization import Bits, Rounding, digitize
from neusee.nodes.sensor._digitization import full_well as end_at_full_well
from neusee.nodes.sensor._noise import Distribution, Spread, dark_current, photon_noise, read_noise
from neusee.nodes.sensor._saturation import Well, refuse_without_room, refuse_without_steps
from neusee.nodes.units import (
    Count,
    DataFiles,
    Efficiency,
    Electrons,
    Exposure,
    Fraction,
    Gain,
    Shape,
)
from neusee.nodes.values import Levels

# --- frame statistics -----------------------------------------------------------------------------

# Statistics of flat-field frames: mean, variance, and a histogram where these two do not suffice.


Photons = Annotated[float, Field(ge=0, le=1e15)]  #: per pixel and exposure
Temporal = Literal["temporal", "steady"]
Scatter = Literal["all", "temporal", "steady"]
_BLOCK_NUMBERS = 1 << 20  #: pixel values per block: work in blocks needs no second copy of a stack
#: DN; below this standard deviation whole numbers are too coarse to be described by mean and
#: variance
COARSE_DEVIATION = 0.8
_PILE_COUNT = 8  #: least count of the two outermost values for a pile
#: least excess of a pile over the expected count, in standard deviations of the count
_PILE_SIGMA = 5.0
_PILE_RATIO = 5.0  #: least ratio of a pile to the expected count, where pixels are unequal


@node(rtol=1e-12)
def reduce(
    frames: Tensor,
    mask: Tensor | None = None,
    *,
    photons: Photons,
    exposure: Exposure,
    scatter: Scatter = "all",
) -> Levels:
    """Reduce the frames of one flat illumination to mean and variance, and a histogram if these do
    not suffice.

    ``scatter`` selects the variance. `all`: the variance over all pixels and frames, for pixels
    that are alike, as in a simulation. `temporal`: the variance of a pixel from frame to frame, for
    two frames half the mean squared difference. `steady`: the temporal variance minus the part that
    all pixels share, as from a drifting lamp, for two frames half the squared difference of the
    means; `camera` needs this variance. The histogram is kept where numbers pile up at an end or
    have a standard deviation below 0.8 DN. Pixels of the ``mask`` are left out.

    Shapes: frames (frame, y, x), mask (y, x) True for a pixel that is left out -> one level.
    Units:  frames DN, whole; photons per pixel and exposure; exposure s; mean DN; variance DN2.
    Error:  counted in whole numbers: 1e-15. Numbers pile up at an end where their count exceeds the
            count of a Gaussian with the mean and variance of all pixels: for `all` by 5 sigma; for
            `temporal` and `steady`, 5-fold, and by 5 sigma that of the numbers beside them, since
            pixels of unequal noise have long tails.
    Raises: ValueError for numbers that are fractional, negative or not finite, for a stack that is
            not (frame, y, x), for a mask of another size, for a single number, for `temporal` and
            `steady` of one frame, and for `steady` of one pixel.
    Source: EMVA Standard 1288, release 4.0 Linear, sections 6.5 and 6.6.
    """
    if frames.ndim != 3 or not frames.numel():
        raise ValueError(
            f"frames {tuple(frames.shape)} are not (frame, y, x): give a stack, or (1, y, x) for"
            " one frame"
        )
    if mask is not None:
        frames = _unmasked_pixels(frames, mask)
    _refuse_single(frames, scatter)
    numbers, counts = histogram(frames)
    total = float(counts.sum())
    mean = float((numbers * counts).sum()) / total
    sum_of_squares = float(((numbers.double() - mean).square() * counts).sum())
    if scatter == "all":
        degrees_of_freedom, variance = total - 1, sum_of_squares / (total - 1)
    else:
        # each pixel's mean takes one degree of freedom; with `steady` each frame's mean but one as
        # well
        degrees_of_freedom = total - total / len(frames) - (scatter == "steady") * (len(frames) - 1)
        variance = _squares_within_pixels(frames, scatter == "steady") / degrees_of_freedom
    keeps_histogram = _needs_histogram(
        numbers.double(), counts.double(), mean, math.sqrt(sum_of_squares / total), scatter == "all"
    )
    moments = (
        torch.tensor([x], dtype=torch.float64)
        for x in (photons, exposure, total, mean, variance, degrees_of_freedom)
    )
    numbers, counts = (numbers, counts) if keeps_histogram else (numbers[:0], counts[:0])
    return Levels._make(
        [*moments, torch.zeros(len(numbers), dtype=torch.int64), numbers.double(), counts.double()]
    )


def _refuse_single(frames: Tensor, scatter: Scatter) -> None:
    """Raise ValueError if there are too few frames or pixels for the variance that ``scatter``
    selects.
    """
    if scatter != "all" and len(frames) < 2:
        raise ValueError(
            "one frame has no temporal variance: give two frames or more, or set scatter: all"
        )
    if frames.numel() < 2 or (scatter == "steady" and frames[0].numel() < 2):
        raise ValueError("one pixel value has no variance: give more pixels or frames")


def _unmasked_pixels(frames: Tensor, mask: Tensor) -> Tensor:
    """Return the unmasked pixels as a stack (frame, 1, pixel)."""
    if mask.shape != frames.shape[1:]:
        raise ValueError(
            f"the mask {tuple(mask.shape)} is not of the size of the frames"
            f" {tuple(frames.shape[1:])}"
        )
    return frames[:, ~mask.bool()][:, None]


@reduce.check
def _(result: Levels, *inputs: Tensor, **params: Any) -> list[Check]:
    text = f"mean {float(result.mean):.5g} DN, variance {float(result.variance):.4g} DN2"
    return [
        Check(
            text
            + (f", histogram of {len(result.cell_value)} numbers" if len(result.cell_value) else "")
        )
    ]


@node(rtol=0.0)
def levels(parts: list[Levels]) -> Levels:
    """Join the statistics of several light levels into one measurement, in the given order.

    Shapes: each (level,) and (cell,) -> the same, concatenated.
    Units:  as in `Levels`.
    Error:  exact.
    Raises: ValueError without a level.
    Source: EMVA Standard 1288, release 4.0 Linear, section 6.5 (a measurement is a series of
            levels).
    """
    if not parts:
        raise ValueError(
            "there are no light levels to join: connect at least one step that returns a light"
            " level"
        )
    columns_of_all = [torch.cat(columns) for columns in zip(*parts, strict=True)]
    starts = accumulate((len(level.mean) for level in parts), initial=0)
    cell_levels = [level.cell_level + start for level, start in zip(parts, starts, strict=False)]
    return Levels(*columns_of_all)._replace(cell_level=torch.cat(cell_levels))


@levels.check
def _(result: Levels, *inputs: object) -> list[Check]:
    dark, counted = int((result.photons == 0).sum()), len(set(result.cell_level.tolist()))
    return [Check(f"{len(result.mean)} light levels, {dark} dark, {counted} with a histogram")]


def histogram(frames: Tensor) -> tuple[Tensor, Tensor]:
    """Return the digital numbers that occur in frames, in rising order, and the count of each."""
    counts = torch.zeros(0, dtype=torch.int64, device=frames.device)
    for piece in _column_blocks(frames.reshape(1, -1)):
        piece_counts = torch.bincount(_digital_numbers(piece).reshape(-1), minlength=len(counts))
        piece_counts[: len(counts)] += counts
        counts = piece_counts
    numbers = counts.nonzero().squeeze(1)
    return numbers.cpu(), counts[numbers].cpu()


def _column_blocks(rows: Tensor) -> Iterator[Tensor]:
    """Split a two-dimensional array by columns into blocks of about `_BLOCK_NUMBERS` elements."""
    return iter(torch.split(rows, max(1, _BLOCK_NUMBERS // len(rows)), 1))


def _digital_numbers(piece: Tensor) -> Tensor:
    """Return pixel values as int64; raise ValueError for a value that is not a digital number."""
    numbers = piece.to(torch.int64)
    low, high = (int(end) for end in torch.aminmax(numbers))
    # only frames of floating-point numbers may hold fractions
    if (
        low < 0
        or high >= LARGEST_NUMBER
        or (piece.is_floating_point() and not bool((numbers == piece).all()))
    ):
        not_digital = (numbers < 0) | (numbers >= LARGEST_NUMBER) | (numbers != piece)
        raise ValueError(
            f"frames hold {float(piece[not_digital][0]):g}, not a digital number: give whole"
            f" numbers from 0 to {LARGEST_NUMBER - 1}, as the camera gives them, neither corrected"
            " nor scaled"
        )
    return numbers


def _squares_within_pixels(frames: Tensor, steady: bool) -> float:
    """Return the sum of squared deviations of all frames from each pixel's mean over the frames;
    ``steady`` also subtracts the contribution of the frame means.

    The pixels are processed in blocks, which needs little memory.
    """
    piece_sums, frame_sums = [], torch.zeros(len(frames), dtype=torch.float64)
    for piece in _column_blocks(frames.reshape(len(frames), -1)):
        numbers = piece.double()
        deviations = numbers - numbers.mean(0)
        piece_sums.append(float(deviations.square().sum()))
        frame_sums += deviations.sum(1).cpu()
    sum_by_frame_means = float(frame_sums.square().sum()) / frames[0].numel() if steady else 0.0
    return max(0.0, math.fsum(piece_sums) - sum_by_frame_means)


def _needs_histogram(value: Tensor, count: Tensor, mean: float, sigma: float, alike: bool) -> bool:
    """Return True if mean and variance do not describe a level, so that its histogram is kept:
    coarse numbers, or a pile at an end.

    ``sigma`` is the standard deviation in DN. With ``alike`` all pixels follow one Gaussian
    distribution.
    """
    if sigma < COARSE_DEVIATION:
        return True
    # the two outermost values at each end cover 2 DN, from half a DN below the lower of them
    both_ends = (
        _End(value - value[0], count, float(value[0]) - 0.5),
        _End(value[-1] - value, count, float(value[-1]) - 1.5),
    )
    total = float(count.sum())
    if alike:
        return any(
            _exceeds_gaussian(end.held, total, end.low - mean, sigma, True) for end in both_ends
        )
    return any(
        _exceeds_gaussian(end.held, total, end.low - mean, sigma, False) and end.rises
        for end in both_ends
    )


@dataclass(frozen=True)
class _End:
    """One end of the histogram of a level: its two outermost values, and the values beside them."""

    away: Tensor  #: distance of each number from the end
    count: Tensor
    low: float  #: DN, lower edge of the interval of the two outermost values

    @property
    def held(self) -> float:
        """Return the count of the two outermost values."""
        return float(self.count[self.away <= 1].sum())

    @property
    def rises(self) -> bool:
        """Return True if the counts rise towards the end; without clipping they fall."""
        outermost, next_one, *two_beside = (
            float(self.count[self.away == i].sum()) for i in range(4)
        )
        # the outermost value against the next one, the two outermost against the two beside them
        pairs = ((outermost, next_one), (outermost + next_one, sum(two_beside)))
        return any(
            at_end - beside > _PILE_SIGMA * math.sqrt(at_end + beside) for at_end, beside in pairs
        )


def _exceeds_gaussian(held: float, total: float, low: float, sigma: float, alike: bool) -> bool:
    """Return True if the count ``held`` of two neighbouring values clearly exceeds that of a
    Gaussian; their interval begins at ``low`` DN from the mean.

    If pixels are not ``alike``, tails are long, and the count must be several times the expected
    one.
    """
    expected = (
        # total x probability of an interval of 2 DN
        total
        * 0.5
        * abs(math.erf((low + 2.0) / sigma / math.sqrt(2)) - math.erf(low / sigma / math.sqrt(2)))
    )
    margin = _PILE_SIGMA * math.sqrt(expected) if alike else (_PILE_RATIO - 1) * expected
    return held >= _PILE_COUNT and held - expected > margin


# --- saturation signal ----------------------------------------------------------------------------

# The signal of full pixels, from light levels beyond saturation.


#: a level brighter than that of the greatest variance is full below this share of it
_FULL_SHARE = 0.5


class SaturationSignal(NamedTuple):
    """The mean signal of full pixels above the dark level, and its standard uncertainty."""

    signal: float  #: DN
    uncertainty: float  #: DN


def saturation_signal(levels: Levels) -> SaturationSignal | None:
    """Return the mean signal of full pixels above the dark level, or None where no level is full.

    As the light rises, pixels become full and the variance falls. EMVA 1288 takes saturation at the
    level of the greatest variance, which lies below the signal of full pixels: pixels and light are
    unequal, and the variance falls as soon as the first pixels are full. The brightest level is
    nearest to full pixels. The signal that it may still lack is taken as the difference of the last
    two full levels; with one full level, as its difference from the level of the greatest variance.

    Shapes: levels (level,) -> two scalars, or None.
    Units:  DN above the dark level of the nearest exposure.
    Error:  the standard uncertainty is that of a rectangular distribution from 0 to the missing
            signal.
    Source: EMVA Standard 1288, release 4.0 Linear, section 6.6; JCGM 100:2008 (GUM), section 4.3.7.
    """
    is_dark = levels.photons == 0
    if not bool(is_dark.any()) or not bool((~is_dark).any()):
        return None
    nearest = (levels.exposure[~is_dark, None] - levels.exposure[is_dark]).abs().argmin(1)
    order = levels.photons[~is_dark].argsort()
    signal = (levels.mean[~is_dark] - levels.mean[is_dark][nearest])[order]
    variance = levels.variance[~is_dark][order]
    index_of_peak = int(variance.argmax())
    full_levels = [
        i
        for i in range(index_of_peak + 1, len(signal))
        if float(variance[i]) < _FULL_SHARE * float(variance[index_of_peak])
    ]
    if not full_levels:
        return None
    level_before = full_levels[-2] if len(full_levels) > 1 else index_of_peak
    missing_signal = abs(float(signal[full_levels[-1]] - signal[level_before]))
    # root mean square of a rectangular distribution from 0 to the missing signal a: a / sqrt(3)
    return SaturationSignal(float(signal[full_levels[-1]]), missing_signal / math.sqrt(3))


# --- level frames ---------------------------------------------------------------------------------

# The node that reads the frames of one light level from image files.


Divisor = Annotated[int, Field(ge=1, le=1 << 16)]


@node(rtol=0.0)
def frames(*, files: DataFiles, divisor: Divisor = 1) -> Tensor:
    """Read the frames of one flat illumination: PNG, TIFF, EXR, NumPy or FITS files of raw numbers.

    Numbers of a converter that are shifted to the left in the file, such as 12 bits by 4 in 16, are
    divided by ``divisor``.

    Shapes: -> (frame, y, x) int32, the frames of all files in order.
    Units:  DN.
    Error:  exact.
    Raises: ParameterError before the run for an unknown kind of file, for a damaged file, for
            colour, and for numbers that are negative or not whole; ValueError for frames that
            differ in size, and for a number that is no multiple of the divisor.
    Source: EMVA Standard 1288, release 4.0 Linear, section 6.5 (raw frames, without corrections).
    """
    numbers = stack(files)
    if divisor == 1:
        return torch.from_numpy(numbers)
    remainders = numbers % divisor
    if remainders.any():
        raise ValueError(
            f"{files[0]} and the files of its level hold {numbers[remainders > 0][0]}, no multiple"
            f" of {divisor}: leave the divisor out"
        )
    return torch.from_numpy(numbers // divisor)


@frames.preflight
def _(*, files: Sequence[Path], **params: Any) -> list[str]:
    return refuse_unreadable("files", files)


@frames.check
def _(result: Tensor, **params: Any) -> list[Check]:
    low, high = (int(x) for x in torch.aminmax(result))
    return [
        Check(f"{len(result)} frames of {result.shape[1]} x {result.shape[2]}, {low} to {high} DN")
    ]


def refuse_unreadable(parameter: str, files: Sequence[Path]) -> list[str]:
    """Raise ParameterError for a file of frames that is damaged or of an unknown suffix; return
    no warnings.
    """
    try:
        for file in files:
            reader_of(file)
            if problem := frame_problem(file):
                raise ParameterError(parameter, problem)
    except ParameterError:
        raise
    except ValueError as error:
        raise ParameterError(parameter, str(error)) from None
    return []


def stack(files: Sequence[Path]) -> np.ndarray[Any, np.dtype[np.int32]]:
    """Read the frames of all files into one array; raise ValueError if the frames differ in
    size.
    """
    stacks = [read_frames(file) for file in files]
    for file, frames in zip(files, stacks, strict=True):
        if frames.shape[1:] != stacks[0].shape[1:]:
            raise ValueError(
                f"{file} is {frames.shape[1:]}, but {files[0]} is {stacks[0].shape[1:]}: give equal"
                " sizes"
            )
    return np.concatenate(stacks)


# --- simulated frames -----------------------------------------------------------------------------

# The node that simulates flat-field frames with the sensor steps that also simulate a picture.


add_dark_current, add_read_noise = dark_current, read_noise  # parameters below have the same names


@node()
def expose(
    *,
    photons: Photons,
    exposure: Exposure,
    shape: Shape,
    frames: Count = 2,
    quantum_efficiency: Efficiency,
    dark_current: Electrons,
    dark_exposure: Exposure,
    offset: Electrons,
    read_noise: Electrons,
    full_well: Well,
    gain: Gain,
    rounding: Rounding = "nearest",
    bits: Bits = 16,
    distribution: Distribution = "gaussian",
    mean_shift: Fraction = 0.0,
    spread: Spread = 1.0,
    rng: Generator,
) -> Tensor:
    """Simulate frames of a flat field by the same sensor steps that simulate a picture.

    Shapes: -> (frame, y, x).
    Units:  result DN; photons per pixel and exposure; dark_current e- of one dark_exposure, in
            proportion to the exposure; offset, read_noise, full_well e-; gain K, DN/e-.
    Error:  the errors of the sensor steps. All pixels are alike: neither non-uniformity nor drift
            of the lamp.
    Source: NeuSee, section Sensor Image; EMVA Standard 1288, release 4.0 Linear (mathematical
            model).
    """
    flat_field = torch.full((frames, *shape), photons, device=rng.device)
    electrons = photon_noise(
        flat_field,
        quantum_efficiency=quantum_efficiency,
        distribution=distribution,
        mean_shift=mean_shift,
        spread=spread,
        rng=rng,
    )
    electrons = add_dark_current(electrons, mean=dark_current * exposure / dark_exposure, rng=rng)
    electrons = end_at_full_well(
        add_read_noise(electrons, offset=offset, read_noise=read_noise, rng=rng), capacity=full_well
    )
    numbers: Tensor = digitize(electrons, gain=gain, rounding=rounding, bits=bits, rng=rng)
    return numbers


@expose.preflight
def _(
    *,
    exposure: float,
    dark_current: float,
    dark_exposure: float,
    offset: float,
    read_noise: float,
    full_well: float,
    gain: float,
    bits: int = 16,
    **params: object,
) -> list[str]:
    dark = dark_current * exposure / dark_exposure
    refuse_without_room(full_well, offset=offset, read_noise=read_noise, dark=dark)
    refuse_without_steps(full_well, gain=gain, bits=bits)
    return []


@expose.check
def _(result: Tensor, **params: Any) -> list[Check]:
    mean = float(result.sum(-1).sum(dtype=torch.float64)) / result.numel()
    return [
        Check(
            f"mean {mean:.5g} DN, pixels of {float(result.min()):g} to {float(result.max()):g} DN"
        )
    ]


# --- hot pixels -----------------------------------------------------------------------------------

# Hot pixels of a sensor, whose dark current is far larger than that of the others.


#: a pixel is hot if it exceeds the median by more than this number of robust standard deviations
_HOT_SIGMA = 10.0
#: ratio of standard deviation to median absolute deviation of a normal distribution
_SIGMA_OVER_MAD = 1.4826
_HOT_SHARE = 0.05  #: if more pixels than this share are above the limit, none is called hot


@node(rtol=0.0)
def hot_pixels(*, files: DataFiles, divisor: Divisor = 1) -> Tensor:
    """Find the hot pixels in dark frames of one exposure, the longest there is; `reduce` leaves
    them out.

    A hot pixel lies in each frame above the median of all pixels by more than 10 robust standard
    deviations of their means over the frames; a pixel that is merely noisy does so in some frames
    alone. Where more than 5 % of the pixels are hot, they are no exceptions, and none is hot.

    Shapes: -> (y, x) True for a hot pixel.
    Units:  none.
    Error:  no pixel is hot by chance; of pixels whose noise differs by 40 %, fewer than one in
            10,000.
    Raises: ParameterError before the run for files that hold no raw frames; ValueError for frames
            that differ in size.
    Source: EMVA Standard 1288, release 4.0 Linear, section 8 (defect pixels); Hampel, J. Am. Stat.
            Assoc. 69, 383.
    """
    numbers = torch.from_numpy(stack(files)).double().div(divisor)
    pixel_means = numbers.mean(0)
    median_of_means = pixel_means.median()
    # the mean of n whole numbers is a multiple of 1 / n DN: add the standard deviation of that
    # rounding
    step = 1 / (12**0.5 * len(numbers))
    width = _SIGMA_OVER_MAD * float((pixel_means - median_of_means).abs().median()) + step
    # hot in every frame: even its smallest value is far above the median
    is_hot: Tensor = numbers.amin(0) - median_of_means > _HOT_SIGMA * width
    return is_hot if float(is_hot.double().mean()) <= _HOT_SHARE else torch.zeros_like(is_hot)


@hot_pixels.preflight
def _(*, files: Any, **params: Any) -> list[str]:
    return refuse_unreadable("files", files)


@hot_pixels.check
def _(result: Tensor, **params: Any) -> list[Check]:
    count = int(result.sum())
    return [
        Check(
            f"{count} of {result.numel()} pixels are hot ({count / result.numel():.2%}), and"
            " left out"
        )
    ]
