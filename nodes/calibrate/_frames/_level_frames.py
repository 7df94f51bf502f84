"""A node that reads the frames of one light level from image files."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path
from typing import Annotated, Any

import numpy as np
import torch
from pydantic import Field
from torch import Tensor

from neusee.nodes import Check, ParameterError, node
from neusee.nodes.calibrate._frames._damaged_frames import frame_problem
from neusee.nodes.calibrate._frames._image_files import read, readable
from neusee.nodes.units import DataFiles

Divisor = Annotated[int, Field(ge=1, le=1 << 16)]


@node(rtol=0.0)
def frames(*, files: DataFiles, divisor: Divisor = 1) -> Tensor:
    """Read the frames of one flat illumination: PNG, TIFF, EXR, NumPy or FITS files of raw numbers.

    Numbers of a converter that are shifted to the left in the file, such as 12 bits by 4 in 16, are divided by
    ``divisor``.

    Shapes: -> (frame, y, x) int32, the frames of all files in order.
    Units:  DN.
    Error:  exact.
    Raises: ParameterError before the run for an unknown kind of file, for a damaged file, for colour, and for numbers
            that are negative or not whole; ValueError for frames that differ in size, and for a number that is no
            multiple of the divisor.
    Source: EMVA Standard 1288, release 4.0 Linear, section 6.5 (raw frames, without corrections).
    """
    numbers = stack(files)
    if divisor == 1:
        return torch.from_numpy(numbers)
    left = numbers % divisor
    if left.any():
        raise ValueError(f"{files[0]} and the files of its level hold {numbers[left > 0][0]}, no multiple of {divisor}:"
                         " leave the divisor out")  # fmt: skip
    return torch.from_numpy(numbers // divisor)


@frames.preflight
def _(*, files: Sequence[Path], **params: Any) -> list[str]:
    return refuse_unreadable("files", files)


@frames.check
def _(result: Tensor, **params: Any) -> list[Check]:
    low, high = (int(x) for x in torch.aminmax(result))
    return [Check(f"{len(result)} frames of {result.shape[1]} x {result.shape[2]}, {low} to {high} DN")]


def refuse_unreadable(parameter: str, files: Sequence[Path]) -> list[str]:
    """Raise ParameterError for a file of frames that is damaged or of an unknown suffix; return no warnings."""
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
    """Read the frames of all files into one array; raise ValueError if the frames differ in size."""
    stacks = [read(file) for file in files]
    for file, each in zip(files, stacks, strict=True):
        if each.shape[1:] != stacks[0].shape[1:]:
            raise ValueError(f"{file} is {each.shape[1:]}, but {files[0]} is {stacks[0].shape[1:]}: give equal sizes")
    return np.concatenate(stacks)
