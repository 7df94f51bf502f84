"""The results of a sweep as an `xarray.Dataset`, whose named dimensions are the axes of the sweep."""

from __future__ import annotations

import importlib.util
from collections.abc import Collection, Mapping, Sequence
from typing import TYPE_CHECKING, Any

from neusee.workflows.graph.diagnostics import Diagnostic, Location, RecipeError
from neusee.workflows.sweeps.sweep_table import AxisColumn

if TYPE_CHECKING:
    from neusee.workflows.sweeps.sweep_points import PointOutcome

_PACKAGES = ("xarray", "h5netcdf", "h5py")


def require_xarray(asked_by: str) -> None:
    """Raise `RecipeError` unless xarray, h5netcdf and h5py are installed."""
    missing = [name for name in _PACKAGES if importlib.util.find_spec(name) is None]
    if missing:
        text = f'needs {" and ".join(missing)}: pip install "neusee[xarray]"'
        raise RecipeError([Diagnostic(Location(asked_by), "", text)])


def dataset(
    outcomes: Sequence[PointOutcome], columns: Sequence[AxisColumn], paired: bool, about: Mapping[str, str]
) -> Any:
    """Return the results of a sweep as an `xarray.Dataset` whose dimensions are the axes, with coordinates in SI units.

    Paired axes give the one dimension ``point``. A result of several numbers has the further dimension
    ``<result> index``. A point that failed or did not run is NaN; ``ran`` is true at points that have numbers.
    """
    import numpy
    import xarray

    shape = (len(columns[0].si),) if paired else tuple(len(c.si) for c in columns)
    dims = ("point",) if paired else tuple(c.name for c in columns)
    coords = {c.name: ("point" if paired else c.name, list(c.si), {"units": c.unit} if c.unit else {}) for c in columns}
    ran, seconds = numpy.zeros(shape, bool), numpy.full(shape, numpy.nan)
    arrays: dict[str, Any] = {}
    taken = {"ran", "seconds", *coords}
    long = _lengths(outcomes, taken)
    for outcome in outcomes:
        place = outcome.point.place[:1] if paired else outcome.point.place
        seconds[place], ran[place] = outcome.seconds, outcome.state != "failed"
        for step, part, index, value in outcome.numbers:
            name = _variable(step, part, taken)
            more = (long[name],) if name in long else ()
            if name not in arrays:
                arrays[name] = numpy.full((*shape, *more), numpy.nan)
            arrays[name][(*place, index or 0) if more else place] = value
    results = {name: ((*dims, f"{name} index") if name in long else dims, array) for name, array in arrays.items()}
    own = {"ran": (dims, ran), "seconds": (dims, seconds, {"units": "s"})}
    return xarray.Dataset({**results, **own}, coords, dict(about))


def _lengths(outcomes: Sequence[PointOutcome], taken: Collection[str]) -> dict[str, int]:
    """Return the largest length of each result that is an array, over all points of the sweep."""
    long: dict[str, int] = {}
    for outcome in outcomes:
        for step, part, index, _ in outcome.numbers:
            if index != "":
                name = _variable(step, part, taken)
                long[name] = max(long.get(name, 0), int(index) + 1)
    return long


def _variable(step: str, part: str, taken: Collection[str]) -> str:
    """Return the name of a result in the `xarray.Dataset`, different from the names of all coordinates."""
    name = f"{step}.{part}".rstrip(".").replace("/", "_")
    return f"{name} (result)" if name in taken else name
