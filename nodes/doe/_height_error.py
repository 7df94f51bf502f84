"""The error of a mask that was made: the whole depth, and a smooth random error of the height."""

import math
from typing import Annotated, Any

import torch
from pydantic import Field
from torch import Tensor

from neusee.nodes import Check, TensorStats, node
from neusee.nodes._half_precision import refuse_half
from neusee.nodes.optics._phase_screen import factors
from neusee.nodes.optics._pupil_grid import grid_of, refuse_other_grid, stripes
from neusee.nodes.units import Length
from neusee.nodes.values import Stop

Rms = Annotated[Length, Field(ge=0, le=1e-3)]
Scale = Annotated[float, Field(ge=0.01, le=1)]  #: share of the pupil's diameter
Excess = Annotated[float, Field(gt=-1, le=1)]  #: share of the height
_VIOLET = 400e-9  #: m, wavelength at which a change of height is converted to a change of phase
_ROUNDING = 1.2e-7  #: of the height, float32
_LARGEST = 31  #: times its standard deviation, no sample of a smooth random field is larger; as for `flare.dirt`


@node()
def height_error(
    height: Tensor, stop: Stop, *, rms: Rms = 0.0, scale: Scale = 0.1, depth: Excess = 0.0, rng: torch.Generator
) -> Tensor:
    """Return the height map as it was made: ``depth`` deeper as a whole, with a smooth random error of the height.

    An etching that takes too long, or a dose that is too high, makes every height greater by the same share ``depth``.
    The random error is a Gaussian field with the root mean square ``rms`` over many masks and the correlation
    exp(-(d / ``scale``)**2) at the distance d, both in diameters of the pupil. Its draw does not depend on the sampling
    of the pupil. It may make a height negative, which moves the surface below the substrate and not the light.

    Shapes: (v, u), stop -> (v, u).
    Units:  rms m; scale in diameters of the pupil; depth as a share of the height; result m.
    Error:  1e-7 of the deepest height (float32); the correlation is exact to 1e-4 on a lattice of half a ``scale``.
    Raises: ValueError for a height in half precision, or of another shape than the pupil grid.
    Source: by definition; a depth error as a share of the depth: Swanson, MIT Lincoln Laboratory Technical Report 854
            (1989), section on fabrication errors.
    """
    refuse_half(height=height)
    grid = grid_of(stop)
    refuse_other_grid(height, grid)
    deeper = height if depth == 0 else height * (1 + depth)
    if rms == 0:
        return deeper
    rows, columns = factors(grid, scale, rng, height.device)
    bumps = torch.cat([(rms * (rows[part] @ columns)).to(height.dtype) for part in stripes(grid)])
    return deeper + bumps


@height_error.skip_bound
def _(height: TensorStats, *_: Any, rms: float, depth: float, **__: Any) -> float:
    """Return an upper bound of the relative change of a height map, which is never below its phase at 400 nm in rad.

    The phase is that of a change of optical path by as much as the height, as for an index of 2.
    """
    if not (height.finite and math.isfinite(rms)):
        return math.inf
    deepest = max(abs(height.min), abs(height.max))
    if not (depth and deepest) and not rms:
        return 0.0
    change = (abs(depth) + _ROUNDING) * deepest + _LARGEST * rms
    return max(2 * math.pi * change / _VIOLET, change / (deepest - change) if deepest > change else math.inf)


@height_error.check
def _(result: Tensor, height: Tensor, *_: Any, **__: Any) -> list[Check]:
    change = (result - height).detach().double()
    text = f"{float(change.square().mean().sqrt()) * 1e9:.3g} nm root mean square from the height of the design"
    return [Check(text, bool(torch.isfinite(change).all()))]
