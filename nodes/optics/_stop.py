"""The stop of the lens and the grid on which the pupil is sampled."""

import math
from typing import Annotated, Any

import torch
from pydantic import Field

from neusee.nodes import Check, node
from neusee.nodes.optics._pupil_grid import Aperture, grid_of, is_wider, millimetres, pupil_grid
from neusee.nodes.units import Diameter, PupilPitch
from neusee.nodes.values import Stop

_ROUNDED = 1e-3  #: relative difference of grid and aperture that is not worth a word: a pitch written with four digits


#: samples of the pupil along an axis; fewer than four are no round aperture
Samples = Annotated[int, Field(ge=4, le=100_000)]


@node(rtol=1e-12, before_run=True)
def stop(*, samples: Samples, pitch: PupilPitch | None = None, diameter: Diameter, aperture: Aperture = "held") -> Stop:
    """Place the round stop of the lens on the square grid of the pupil.

    Without a ``pitch`` the grid is as wide as the aperture. ``aperture`` says what happens where the two differ:

    - `held`: an aperture that is wider than the grid is refused;
    - `stretched`: the pitch is changed so that the grid is as wide as the aperture;
    - `inscribed`: a wider aperture is narrowed to the grid;
    - `clipped`: the square grid cuts a wider aperture.

    Shapes: -> samples, pitch, diameter, each ().
    Units:  pitch and diameter m; samples along each axis.
    Error:  exact.
    Raises: ParameterError before the run where no sample lies inside the aperture, and for `held` where the aperture is
            wider than the grid.
    Source: by definition.
    """
    grid = pupil_grid(samples, pitch, diameter, aperture)
    pitch_and_diameter = (torch.tensor(length, dtype=torch.float64) for length in grid[1:])
    return Stop(torch.tensor(grid.samples), *pitch_and_diameter)


@stop.preflight
def _(*, samples: int, pitch: float | None = None, diameter: float, aperture: Aperture = "held", **_: Any) -> list[str]:
    grid = pupil_grid(samples, pitch, diameter, aperture)
    if pitch is None or math.isclose(samples * pitch, diameter, rel_tol=_ROUNDED):
        return []
    span = samples * pitch
    written = f"{samples} x {pitch * 1e6:.4g} um = {millimetres(span)}"
    if aperture == "stretched":
        fit = f"the pitch becomes {grid.pitch * 1e6:.4g} um, so that {samples} samples span the aperture"
        return [f"aperture {millimetres(diameter)}, pupil grid {written}: {fit}"]
    if is_wider(diameter, span):
        left = f"a disc of {millimetres(span)}" if aperture == "inscribed" else "a disc cut by the square grid"
        return [f"aperture {millimetres(diameter)} > pupil grid {written}: {aperture}, {left}; see reading.aperture"]
    return []


@stop.check
def _(result: Stop, *, diameter: float, aperture: Aperture = "held", **_: Any) -> list[Check]:
    samples, pitch, clear = grid_of(result)
    span = samples * pitch
    narrowed = f", {aperture} instead of the requested {millimetres(diameter)}" if is_wider(diameter, span) else ""
    return [Check(f"clear pupil {millimetres(min(span, clear))}{narrowed}, {samples} samples across")]
