"""The stop of the lens and the grid on which the pupil is sampled."""

import math
from typing import Any

import torch

from neusee.nodes import Check, node
from neusee.nodes.optics._pupil_grid import Aperture, grid_of, pupil_grid
from neusee.nodes.units import Count, PositiveLength
from neusee.nodes.values import Stop


@node(rtol=1e-12, before_run=True)
def stop(*, samples: Count, pitch: PositiveLength, diameter: PositiveLength, aperture: Aperture = "inscribed") -> Stop:
    """Place the round stop of the lens on the square grid of the pupil.

    ``aperture`` says what becomes of a stop that is wider than the grid: `inscribed` narrows the disc to the grid,
    `clipped` lets the square grid cut the disc, `stretched` sets the pitch so that the grid is as wide as the disc.

    Shapes: -> samples, pitch, diameter, each ().
    Units:  pitch and diameter m; samples along each axis.
    Error:  exact.
    Raises: ParameterError before the run where no sample lies inside the aperture.
    Source: by definition.
    """
    grid = pupil_grid(samples, pitch, diameter, aperture)
    pitch_and_diameter = (torch.tensor(length, dtype=torch.float64) for length in grid[1:])
    return Stop(torch.tensor(grid.samples), *pitch_and_diameter)


@stop.preflight
def _(*, samples: int, pitch: float, diameter: float, aperture: Aperture) -> list[str]:
    grid = pupil_grid(samples, pitch, diameter, aperture)
    wanted, span = f"{diameter * 1e3:#.3g} mm", f"{samples * pitch * 1e3:#.3g} mm"
    if aperture != "stretched" and diameter > samples * pitch * (1 + 1e-9):
        open_ = f"a disc of {span}" if aperture == "inscribed" else "a disc cut square"
        return [f"aperture {wanted} > pupil grid {span}: {aperture}, {open_}; see reading.aperture"]
    if not math.isclose(grid.pitch, pitch):
        change = f"{pitch * 1e6:#.3g} -> {grid.pitch * 1e6:#.3g} um"
        return [f"aperture {wanted} over pupil grid {span}: pitch stretched {change}, see reading.aperture"]
    return []


@stop.check
def _(result: Stop, *, diameter: float, aperture: Aperture, **_: Any) -> list[Check]:
    samples, pitch, clear = grid_of(result)
    span = samples * pitch
    held = f", {aperture} instead of the requested {diameter * 1e3:#.3g} mm" if span < diameter * (1 - 1e-9) else ""
    return [Check(f"clear pupil {min(span, clear) * 1e3:#.3g} mm{held}, {samples} samples across")]
