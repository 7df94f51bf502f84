"""Phase differences between neighbouring pupil samples, which show whether the samples resolve the phase."""

import torch
from torch import Tensor

from neusee.nodes.values import Pupil

LARGE_STEPS = 0.1  #: share of steps above half a turn, from which the pupil counts as aliased
_ROWS = 256  #: the least number of pupil rows in which phase steps are measured


def phase_steps(pupil: Pupil) -> tuple[float, float]:
    """Return the median phase step between neighbouring samples, in turns, and the share of steps above half a turn.

    Both numbers are from the band with the largest phase steps, inside the stop. In a large pupil only every k-th row
    is measured, 256 rows or more. A wrapped or split mask has steps at its edges by design, so a few large steps mean
    nothing. Many large steps mean that the samples cannot follow the phase.
    """
    worst = int((pupil.index / pupil.wavelengths).argmax())
    every = max(1, len(pupil.height) // _ROWS)
    here, below = ([x[k::every] for x in (pupil.height, pupil.path, pupil.aperture > 0)] for k in (0, 1))
    pairs = len(below[0])
    steps = torch.cat(
        [
            _steps(pupil, worst, [x[:pairs] for x in here], below),
            _steps(pupil, worst, [x[:, :-1] for x in here], [x[:, 1:] for x in here]),
        ]
    )
    return (float(steps.median()), float((steps > 0.5).double().mean())) if steps.numel() else (0.0, 0.0)


def pupil_has_large_steps(pupil: Pupil) -> bool:
    """Return True if so many phase steps exceed half a turn that the samples cannot follow the phase."""
    return phase_steps(pupil)[1] > LARGE_STEPS


def _steps(pupil: Pupil, band: int, one: list[Tensor], other: list[Tensor]) -> Tensor:
    """Return the absolute phase difference in turns, between neighbours that are both inside the stop.

    Differences are taken before the phase: in float32, a phase of thousands of turns has no digits left for its steps.
    """
    inside = one[2] & other[2]
    height, path = ((b - a)[inside] for a, b in zip(one[:2], other[:2], strict=True))
    steps: Tensor = (float(pupil.index[band]) * height + path).abs() / float(pupil.wavelengths[band])
    return steps


def mask_turns(pupil: Pupil, band: int, step: int = 1) -> Tensor:
    """Return the phase of the mask in one band, in turns, float64, at every ``step``-th pupil sample."""
    turns: Tensor = pupil.index[band] * pupil.height[::step, ::step].double() / pupil.wavelengths[band]
    return turns
