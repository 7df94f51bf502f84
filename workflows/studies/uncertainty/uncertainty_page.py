"""The study of uncertainty on paper."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import TYPE_CHECKING, Any

import numpy as np

from neusee.workflows.engine.runner import run
from neusee.workflows.report.contents import BANDS
from neusee.workflows.report.study_page import Mark, Section
from neusee.workflows.studies.uncertainty import uncertainty_figures as figures
from neusee.workflows.studies.uncertainty.sobol_indices import EXPLAINED

if TYPE_CHECKING:
    from numpy.typing import NDArray

    from neusee.workflows.studies.uncertainty.uncertainty_result import Found

    Places = NDArray[np.float64]

_MOST = 12  #: numbers that are drawn
_LITTLE = 0.01  #: share of a variance that is not worth a row
_TRANSFER = "sensor.photon_transfer"
_NOT_TOLD = {"upper": "only an upper limit", "lower": "only a lower limit", "none": "nothing"}


def drawn(found: Found) -> dict[str, bytes]:
    """The pictures, by name."""
    shown = {}
    numbers = found.numbers[:_MOST]
    if numbers:
        middle = {name: found.middle[name][0] for name in numbers}
        shown["tornado"] = figures.tornado({name: found.swings[name] for name in numbers}, middle)
        shown["numbers"] = figures.histograms({name: found.values[name][:, 0] for name in numbers}, middle)
    if curves := _curves(found):
        shown["bands"] = figures.bands(*curves)
    for name, values in found.values.items():
        if _node(found, name) == _TRANSFER and np.isfinite(values).all():
            shown["transfer"] = figures.transfer(values.reshape(len(values), -1, 3))
    if found.pictures:
        shown["pictures"] = figures.pictures(found.pictures)
    return shown


def _curves(found: Found) -> tuple[dict[str, tuple[Places, dict[str, Places]]], str] | None:
    """Families of curves, such as that of both arms, by the name of their step."""
    wavelengths = _wavelengths(found)
    curves: dict[str, tuple[Places, dict[str, Places]]] = {}
    spectral = True
    for name, values in found.values.items():
        count = values.shape[1]
        if (
            count < 3
            or found.scatter[name].is_constant
            or _node(found, name) == _TRANSFER
            or not np.isfinite(values).all()
        ):
            continue
        here = wavelengths is not None and len(wavelengths) == count
        spectral &= here
        x = wavelengths if here and wavelengths is not None else np.arange(count, dtype=np.float64)
        family, _, arm = name.partition("[")
        curves.setdefault(family, (x, {}))[1][arm.rstrip("]") or family] = values
    return (curves, "wavelength (nm)" if spectral else "element") if curves else None


def _wavelengths(found: Found) -> Places | None:
    recipe = found.inputs.recipe
    if BANDS not in recipe.steps:
        return None
    centres: Places = run(recipe, None, [BANDS])[BANDS].centres.double().numpy()
    return centres * 1e9


def _node(found: Found, quantity: str) -> str:
    steps = found.inputs.recipe.steps
    name = quantity if quantity in steps else quantity.rpartition(".")[0]
    return steps[name].node.path if name in steps else ""


def lead(found: Found) -> str:
    """What came out."""
    count, kind = len(found.points.z), "points of Sobol" if found.sequences else "independent draws"
    held = f"every standard deviation is known to {found.error:.1%}"
    if found.error > found.wanted:
        held = (
            f"the standard deviation of {found.worst} is known to {found.error:.1%} only, {found.wanted:.1%} was asked"
        )
    values = [f"{name} {_beside(found, name)}" for name in found.numbers[:_MOST]]
    strange = f" Not finite in some draw: {', '.join(found.strange)}." if found.strange else ""
    return f"{count} {kind} of {', '.join(found.inputs.names)}: {held}.{strange}\n\n{'; '.join(values)}."


def _beside(found: Found, name: str) -> str:
    s = found.scatter[name]
    return f"{float(s.mean[0]):.5g} ± {float(s.sd[0]):.2g}"


def sections(found: Found, shown: Mapping[str, bytes]) -> list[Section]:
    """Inputs, numbers, what moves them, curves, pictures, and what does not hang on any."""
    parts = [_inputs(found), *_posterior(found), _numbers(found, shown.get("numbers"))]
    parts += _moves(found, shown.get("tornado"))
    if "bands" in shown:
        text = "The middle 90 % of the draws, element by element."
        parts.append(Section("Curves", text, picture=shown["bands"]))
    if "transfer" in shown:
        text = """What a laboratory would measure of the sensors that were drawn, by the steps that make the picture.
            The prediction has no chance of its own; flat fields have that of their pixels, for each draw has its own
            light."""
        parts.append(Section("Photon-transfer curve", text, picture=shown["transfer"]))
    if "pictures" in shown:
        text = """Mean and standard deviation of each pixel over the first 32 draws, the deviation known to 13 %. The
            noise is the same in all draws: what is seen is what the inputs leave open; pictures.npz has the numbers."""
        parts.append(Section("Pictures", text, picture=shown["pictures"]))
    return [*parts, *_rest(found)]


def _inputs(found: Found) -> Section:
    text = """What was drawn, in SI. Of values that are known together the first moves with all that goes with it, and
        each further one by what is left of it: these are independent, and so are all others. The same noise is drawn
        every time, so that only the inputs make a difference."""
    rows = []
    for name, label, x in zip(found.inputs.names, found.inputs.labels, found.points.values.T, strict=True):
        law = found.inputs.uncertain.said(name)
        rows.append((name, label, law, f"{x.mean():.6g}", float(x.std(ddof=1))))
    return Section("Inputs", text, ("value", "drawn as", "law", "mean", "sd"), rows)


def _posterior(found: Found) -> list[Section]:
    standings = [s for s in found.inputs.uncertain.standings if s.path in found.inputs.names]
    if not standings:
        return []
    text = """Where the recipe's own value lies. What its frames tell only as a limit, or not at all, is drawn from what
        is mostly the prior of the calibration."""
    rows, marks = [], dict[tuple[int, int], Mark]()
    for i, s in enumerate(standings):
        rows.append((s.path, s.own, f"{s.mean:.6g}", s.sd, s.below, _NOT_TOLD.get(s.kind, "estimate")))
        if s.kind == "estimate":
            marks[i, 4] = "warn" if s.far else "pass"
        else:
            marks[i, 5] = "warn"
    columns = ("value", "recipe", "posterior mean", "sd", "posterior below it", "told")
    return [Section("The recipe beside its posterior", text, columns, rows, marks=marks)]


def _numbers(found: Found, picture: bytes | None) -> Section:
    text = f"""Error: of the standard deviation, relative, {_how(found)}. Of a curve: its element that scatters most."""
    columns = ("quantity", "at the medians", "mean", "sd", "error", "5 %", "95 %")
    rows, marks = list[Sequence[Any]](), dict[tuple[int, int], Mark]()
    for name, s in found.scatter.items():
        i = int(s.sd.argmax())
        label = name if len(s.sd) == 1 else f"{name}, element {i}"
        numbers = (f"{found.middle[name][i]:.6g}", f"{s.mean[i]:.6g}", float(s.sd[i]))
        marks[len(rows), 4] = "pass" if s.error <= found.wanted and name not in found.strange else "fail"
        rows.append((label, *numbers, f"{s.error:.1%}", f"{s.low[i]:.6g}", f"{s.high[i]:.6g}"))
    return Section("Numbers", text, columns, rows, picture, marks)


def _how(found: Found) -> str:
    if found.sequences:
        return f"by how {found.sequences} scrambled sequences differ"
    return "by the jackknife"


def _moves(found: Found, picture: bytes | None) -> list[Section]:
    if picture is None:
        return []
    text = f"""Each input by itself at its 5 and its 95 %, all others at their median. The table: shares of the variance
        (SALib). First: what the input does alone, from the draws (RBD-FAST). Total: with what it does together with
        others, from a polynomial of second order; explained is what that polynomial tells of draws that it has not
        seen, and below {EXPLAINED:.0%} its total shares are not shown. Inputs of less than {_LITTLE:.0%}, or of no more
        than half an error, have no row; sensitivity in provenance.json has all."""
    columns = ("quantity", "input", "first", "±", "total", "±", "explained")
    rows: list[Sequence[Any]] = []
    marks: dict[tuple[int, int], Mark] = {}
    for name, shares in found.shares.items():
        before = len(rows)
        each = zip(found.inputs.labels, shares.first, shares.first_error, shares.total, shares.total_error, strict=True)
        for label, first, about, total, beside in each:
            share, error = (total, beside) if shares.told else (first, about)
            if share > max(_LITTLE, error / 2):
                both = (total, beside) if shares.told else (None, None)
                rows.append((name, label, first, about, *both, shares.explained))
        if len(rows) > before and not shares.told:
            marks[before, 6] = "warn"
    return [Section("What moves them", text, columns, rows, picture, marks)]


def _rest(found: Found) -> list[Section]:
    said = [f"No input reaches {', '.join(found.is_constant)}: these are as in a run."] if found.is_constant else []
    said += [f"{', '.join(found.inputs.idle)} reach no output, and were not drawn."] if found.inputs.idle else []
    return [Section("What does not vary", "\n\n".join(said))] if said else []
