"""Phase differences between neighbouring pupil samples, which show whether the samples resolve the phase."""

import torch
from torch import Tensor

from neusee.nodes.values import Pupil

_ROWS = 512  #: the least number of pupil rows in which phase steps are measured


def phase_steps(pupil: Pupil) -> tuple[float, float]:
    """Return the median phase step between neighbouring samples, in turns, and the share of steps above half a turn.

    Both numbers are from the band with the largest phase steps, inside the stop. In a large pupil only every k-th row
    is measured, 512 rows or more. A wrapped or split mask has steps at its edges by design, so a few large steps mean
    nothing. Many large steps mean that the samples cannot follow the phase.
    """
    worst = int((pupil.index / pupil.wavelengths).argmax())
    every = max(1, len(pupil.height) // _ROWS)
    turns, lit = [], []
    for first in (0, 1):
        height, path, aperture = (x[first::every] for x in (pupil.height, pupil.path, pupil.aperture))
        turns.append((pupil.index[worst] * height + path) / pupil.wavelengths[worst])
        lit.append(aperture > 0)
    pairs = min(map(len, turns))
    down = (turns[1][:pairs] - turns[0][:pairs])[lit[1][:pairs] & lit[0][:pairs]]
    along = turns[0].diff(dim=1)[lit[0][:, 1:] & lit[0][:, :-1]]
    steps = torch.cat([down, along]).abs()
    return (float(steps.median()), float((steps > 0.5).double().mean())) if steps.numel() else (0.0, 0.0)


def mask_turns(pupil: Pupil, band: int, step: int = 1) -> Tensor:
    """Return the phase of the mask in one band, in turns, float64, at every ``step``-th pupil sample."""
    turns: Tensor = pupil.index[band] * pupil.height[::step, ::step].double() / pupil.wavelengths[band]
    return turns
