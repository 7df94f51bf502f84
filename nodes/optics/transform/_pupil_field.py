"""The complex field in the pupil, computed patch by patch from amplitude, height and path, and
never stored whole.
"""

import math
from collections.abc import Sequence
from dataclasses import dataclass
from typing import NamedTuple

import torch
from torch import Tensor

from neusee.nodes.optics.transform._sample_axis import Axis, Source, Workspace, centred
from neusee.nodes.precision import refuse_not_finite

_MOST_TURNS = 1e9  #: largest phase in turns, which float64 represents to 2e-7 turns
#: below this number of turns, a float32 phase is exact to 5e-7 rad, like a float64 phase after a
#: cast
_FLOAT32_TURNS = 2.0


@dataclass(frozen=True, slots=True)
class View:
    """A grid of focal points in one band; the intensity |U|^2 is multiplied by ``weight`` and by
    two envelopes.
    """

    band: int
    rows: Axis
    columns: Axis
    turns_height: float  #: turns of phase per metre of height
    turns_path: float  #: turns of phase per metre of path
    tilt: tuple[float, float]  #: turns per pupil sample (v, u) that shift the window
    weight: float
    envelope: tuple[Tensor, Tensor] | None = None


class Screens(NamedTuple):
    """The amplitude, height and path of the pupil in all bands, with the largest height and path
    in metres.
    """

    amplitude: Tensor
    height: Tensor
    path: Tensor
    highest: float
    longest: float

    @classmethod
    def of(cls, amplitude: Tensor, height: Tensor, path: Tensor) -> "Screens":
        """Return the pupil's factors and largest height and path; raise ValueError if height or
        path is not finite.
        """
        extents = [_largest_magnitude(x.detach()) for x in (height, path)]
        refuse_not_finite("no light has such a phase", height=extents[0], path=extents[1])
        return cls(amplitude, height, path, *extents)


def _largest_magnitude(lengths: Tensor) -> float:
    """Return the largest absolute value, or NaN if there is a NaN."""
    lowest, highest = lengths.aminmax()
    return max(float(highest), -float(lowest))


def refuse_too_many_turns(screens: Screens, views: Sequence[View]) -> None:
    """Raise ValueError if the phase has more turns than float64 can represent to 1e-6 turns."""
    turns = max(
        screens.highest * abs(view.turns_height) + screens.longest * view.turns_path
        for view in views
    )
    if turns > _MOST_TURNS:
        raise ValueError(
            f"height {screens.highest:.3g} m and path {screens.longest:.3g} m are {turns:.2g} turns"
            f" of phase, more than {_MOST_TURNS:.0e}, beyond which float64 loses the phase: give"
            " heights and paths in metres"
        )


class Field:
    """The field in the pupil for one view: amplitude * exp(2 pi i (height + path + tilt)),
    phases in turns.
    """

    def __init__(self, screens: Screens, view: View, dtype: torch.dtype) -> None:
        """Prepare the field of ``screens`` for one view, with values of ``dtype``."""
        self.screens, self.view = screens, view
        tilts = zip(screens.height.shape, view.tilt, strict=True)
        v, u = (centred(n, screens.height.device).mul_(tilt) for n, tilt in tilts)
        turns = screens.highest * abs(view.turns_height) + screens.longest * view.turns_path
        self.few = (
            dtype == torch.float32 and turns + float(v[-1].abs() + u[-1].abs()) < _FLOAT32_TURNS
        )
        phase_type = torch.float32 if self.few else torch.float64
        self.tilt_v, self.tilt_u = v.to(phase_type)[:, None], u.to(phase_type)

    def phasor(self, rows: slice, columns: slice, planes: Tensor, work: Workspace) -> None:
        """Write the cosine and sine of the pupil phase in one patch, in float64 if the phase
        exceeds two turns.
        """
        angle = work.take("angle", *planes.shape[1:])
        turns = angle if self.few else work.take("turns", *planes.shape[1:], dtype=torch.float64)
        turns.copy_(self.screens.height[rows, columns])  # cast before the product
        torch.add(self.tilt_u[columns], turns, alpha=self.view.turns_height, out=turns)
        if self.screens.longest > 0:
            turns.add_(self.screens.path[rows, columns], alpha=self.view.turns_path)
        turns.add_(self.tilt_v[rows])
        if not self.few:
            turns.frac_()
        torch.mul(turns, 2 * math.pi, out=angle)
        torch.cos(angle, out=planes[0])
        torch.sin(angle, out=planes[1])

    def rows(self, work: Workspace) -> Source:
        """Return a function that writes the requested rows of the pupil field to a buffer for
        the transform.
        """
        all_columns = slice(0, self.screens.height.shape[1])

        def fill(start: int, stop: int, planes: Tensor) -> None:
            self.phasor(slice(start, stop), all_columns, planes, work)
            planes.mul_(self.screens.amplitude[start:stop])

        return fill
