"""Frames of one light level, from files or simulated, and the hot pixels in them."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path
from typing import Annotated, Any

import numpy as np
import torch
from pydantic import Field
from torch import Generator, Tensor

from neusee.nodes import Check, ParameterError, node
from neusee.nodes.calibrate._frame_files import frame_problem, read, readable
from neusee.nodes.calibrate._frame_statistics import Photons
from neusee.nodes.sensor._digitization import Bits, Rounding, digitize
from neusee.nodes.sensor._digitization import full_well as well_of
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

# --- level frames ---------------------------------------------------------------------------------

# A node that reads the frames of one light level from image files.


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
            readable(file)
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
    stacks = [read(file) for file in files]
    for file, frames in zip(files, stacks, strict=True):
        if frames.shape[1:] != stacks[0].shape[1:]:
            raise ValueError(
                f"{file} is {frames.shape[1:]}, but {files[0]} is {stacks[0].shape[1:]}: give equal"
                " sizes"
            )
    return np.concatenate(stacks)


# --- simulated frames -----------------------------------------------------------------------------

# A node that simulates frames of a flat field by the same sensor steps as a picture.


dark_of, read_of = dark_current, read_noise  # parameters below have the same names


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
    electrons = dark_of(electrons, mean=dark_current * exposure / dark_exposure, rng=rng)
    electrons = well_of(
        read_of(electrons, offset=offset, read_noise=read_noise, rng=rng), capacity=full_well
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

# Hot pixels of a sensor, which collect far more dark current than the others.


#: robust standard deviations of the pixels above their median from which a pixel is hot
_FAR = 10.0
_NORMAL = 1.4826  #: standard deviation of a normal distribution over its median absolute deviation
_MOST = 0.05  #: share of the pixels above which they are no exceptions


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
    # the mean of a few whole numbers is a multiple of a step, which hides a smaller deviation
    step = 1 / (12**0.5 * len(numbers))
    width = _NORMAL * float((pixel_means - median_of_means).abs().median()) + step
    # in each frame: its smallest number is far above the median
    is_hot: Tensor = numbers.amin(0) - median_of_means > _FAR * width
    return is_hot if float(is_hot.double().mean()) <= _MOST else torch.zeros_like(is_hot)


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
