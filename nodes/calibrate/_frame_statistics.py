"""Statistics of the frames of a light level, and the signal at which pixels are full."""

from __future__ import annotations

import math
from collections.abc import Iterator
from dataclasses import dataclass
from itertools import accumulate
from typing import Annotated, Any, Literal, NamedTuple

import torch
from pydantic import Field
from torch import Tensor

from neusee.nodes import Check, node
from neusee.nodes.units import Exposure
from neusee.nodes.values import Levels

# --- frame statistics -----------------------------------------------------------------------------

# Statistics of frames of a flat illumination: mean, variance, and a histogram if these two do not
# suffice.


Photons = Annotated[float, Field(ge=0, le=1e15)]  #: per pixel and exposure
Temporal = Literal["temporal", "steady"]
Scatter = Literal["all", "temporal", "steady"]
_PIECE = 1 << 20  #: numbers of one block, so that no second copy of a stack is needed
_TOP = 1 << 24  #: DN; above any converter, and the limit of exact whole numbers in float32
#: DN, standard deviation below which whole numbers are too coarse for a mean and a variance
_COARSE = 0.8
#: least count at an end; least excess in sigma; least excess as a ratio
_FEW, _SURE, _RATIO = 8, 5.0, 5.0


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
        frames = _unmasked(frames, mask)
    _refuse_single(frames, scatter)
    numbers, counts = histogram(frames)
    total = float(counts.sum())
    mean = float((numbers * counts).sum()) / total
    sum_of_squares = float(((numbers.double() - mean).square() * counts).sum())
    if scatter == "all":
        degrees_of_freedom, variance = total - 1, sum_of_squares / (total - 1)
    else:
        # each pixel's mean is fitted, and with `steady` each frame's mean but one
        degrees_of_freedom = total - total / len(frames) - (scatter == "steady") * (len(frames) - 1)
        variance = _within(frames, scatter == "steady") / degrees_of_freedom
    keeps_histogram = _kept(
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
    """Raise ValueError for frames without the variance that ``scatter`` selects."""
    if scatter != "all" and len(frames) < 2:
        raise ValueError(
            "one frame has no temporal variance: give two frames or more, or set scatter: all"
        )
    if frames.numel() < 2 or (scatter == "steady" and frames[0].numel() < 2):
        raise ValueError("one pixel value has no variance: give more pixels or frames")


def _unmasked(frames: Tensor, mask: Tensor) -> Tensor:
    """Return the pixels (frame, 1, pixel) that a mask does not leave out."""
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
    """Return the digital numbers that occur in frames, in rising order, and the count of each
    number.
    """
    counts = torch.zeros(0, dtype=torch.int64, device=frames.device)
    for piece in _pieces(frames.reshape(1, -1)):
        piece_counts = torch.bincount(_whole(piece).reshape(-1), minlength=len(counts))
        piece_counts[: len(counts)] += counts
        counts = piece_counts
    numbers = counts.nonzero().squeeze(1)
    return numbers.cpu(), counts[numbers].cpu()


def _pieces(rows: Tensor) -> Iterator[Tensor]:
    """Split a two-dimensional array by columns into blocks of about `_PIECE` elements."""
    return iter(torch.split(rows, max(1, _PIECE // len(rows)), 1))


def _whole(piece: Tensor) -> Tensor:
    """Return pixel values as int64; raise ValueError for a value that no analogue-to-digital
    converter can give.
    """
    numbers = piece.to(torch.int64)
    low, high = (int(end) for end in torch.aminmax(numbers))
    # only frames of floating-point numbers may hold fractions
    if (
        low < 0
        or high >= _TOP
        or (piece.is_floating_point() and not bool((numbers == piece).all()))
    ):
        not_digital = (numbers < 0) | (numbers >= _TOP) | (numbers != piece)
        raise ValueError(
            f"frames hold {float(piece[not_digital][0]):g}, not a digital number: give whole"
            f" numbers from 0 to {_TOP - 1}, as the camera gives them, neither corrected nor scaled"
        )
    return numbers


def _within(frames: Tensor, steady: bool) -> float:
    """Return the sum of squared deviations of all frames from each pixel's mean over the frames;
    ``steady`` also subtracts what each frame's mean contributes.

    The frames are taken in pieces of pixels, which need little memory.
    """
    piece_sums, frame_sums = [], torch.zeros(len(frames), dtype=torch.float64)
    for piece in _pieces(frames.reshape(len(frames), -1)):
        numbers = piece.double()
        deviations = numbers - numbers.mean(0)
        piece_sums.append(float(deviations.square().sum()))
        frame_sums += deviations.sum(1).cpu()
    sum_by_frame_means = float(frame_sums.square().sum()) / frames[0].numel() if steady else 0.0
    return max(0.0, math.fsum(piece_sums) - sum_by_frame_means)


def _kept(value: Tensor, count: Tensor, mean: float, sigma: float, alike: bool) -> bool:
    """Return True if the histogram of a level holds information that mean and variance lack:
    coarse numbers, or a pile at an end.

    ``sigma`` is the standard deviation in DN; ``alike`` says that pixels are equal, so that they
    follow one Gaussian distribution.
    """
    if sigma < _COARSE:
        return True
    # each end holds two numbers, which begin half a number below the lower of them
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
    """One end of the numbers of a level: the two numbers there, and those beside them."""

    away: Tensor  #: distance of each number from the end
    count: Tensor
    low: float  #: where the two numbers at the end begin

    @property
    def held(self) -> float:
        """Return the count of the two numbers at the end."""
        return float(self.count[self.away <= 1].sum())

    @property
    def rises(self) -> bool:
        """Return True if the numbers at the end are more than those beside them: towards a free
        end, counts fall.
        """
        outermost, next_one, *two_beside = (
            float(self.count[self.away == i].sum()) for i in range(4)
        )
        # the outermost number against the next one, the two outermost against the two beside them
        pairs = ((outermost, next_one), (outermost + next_one, sum(two_beside)))
        return any(at_end - beside > _SURE * math.sqrt(at_end + beside) for at_end, beside in pairs)


def _exceeds_gaussian(held: float, total: float, low: float, sigma: float, alike: bool) -> bool:
    """Return True if the count ``held`` of two neighbouring numbers, which begin at ``low`` DN
    from the mean, clearly exceeds that of a Gaussian.

    Without pixels that are ``alike`` the excess must be several times the expected count, since
    tails are long then.
    """
    expected = (
        # total x probability of an interval of 2 DN
        total
        * 0.5
        * abs(math.erf((low + 2.0) / sigma / math.sqrt(2)) - math.erf(low / sigma / math.sqrt(2)))
    )
    margin = _SURE * math.sqrt(expected) if alike else (_RATIO - 1) * expected
    return held >= _FEW and held - expected > margin


# --- saturation signal ----------------------------------------------------------------------------

# The signal at which the pixels of a camera are full, from levels beyond saturation.


_FLAT = 0.5  #: share of the greatest variance below which a brighter level is full


class SaturationSignal(NamedTuple):
    """The mean signal of full pixels above the dark, and its standard uncertainty."""

    signal: float  #: DN
    uncertainty: float  #: DN


def saturation_signal(levels: Levels) -> SaturationSignal | None:
    """Return the signal of full pixels, or None where no level is full.

    The mean of a level rises with its light until its pixels are full, and its variance falls. The
    level of the greatest variance, where EMVA 1288 takes saturation, lies below by up to a step of
    the levels: pixels, and the light of a frame, are unequal, and the fullest ones end the rise of
    the variance. The brightest level is the fullest. It may still lack what the last two full
    levels differ by, or with one full level what it exceeds the greatest variance's by.

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
        if float(variance[i]) < _FLAT * float(variance[index_of_peak])
    ]
    if not full_levels:
        return None
    level_before = full_levels[-2] if len(full_levels) > 1 else index_of_peak
    missing_signal = abs(float(signal[full_levels[-1]] - signal[level_before]))
    # root mean square of a rectangular distribution from 0 to the missing signal a: a / sqrt(3)
    return SaturationSignal(float(signal[full_levels[-1]]), missing_signal / math.sqrt(3))
