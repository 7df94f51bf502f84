"""The uncertainty budget as sections of a page, as a table, as JSON and as a picture."""

from __future__ import annotations

import math
from collections.abc import Iterator, Sequence
from dataclasses import asdict
from typing import Any

from neusee.nodes.calibrate import COVERAGE, NOT_INVOLVED, Budget, Contribution, Traceability
from neusee.workflows.report.figures.style import BLACK, BLUE, GREEN, ORANGE, VERMILION, canvas, drawn
from neusee.workflows.report.study_page import Mark, Section, with_uncertainty

COLUMNS = ("quantity", "symbol", "unit", "value", "source", "type", "distribution", "u(x)", "unit of x", "c", "nu",
           "u(y)", "reason")  # fmt: skip
_COLOURS = (BLUE, ORANGE, GREEN, VERMILION, "#CC79A7", "#56B4E9", "#F0E442", BLACK, "#999999", "#882255", "#44AA99")
#: keys of the quantities of a sheet whose budget the page shows
BUDGETED = ("eta", "K", "sigma_d", "mu_p_min", "mu_p_sat", "mu_e_sat", "SNR_max", "DR", "DSNU1288", "PRNU1288")
_LEAST = 1e-4  #: share of a variance below which a source is not drawn
_TEXT = f"""By the Guide to the expression of uncertainty in measurement (JCGM 100). The combined standard uncertainty
    u_c has all sources that are stated. The expanded uncertainty U is k u_c and holds the value with {COVERAGE:.0%};
    the coverage factor k is that of Student's t distribution with ν_eff degrees of freedom (Welch and Satterthwaite).
    A source that is not stated is missing in u_c: it is not 0."""
_LINES = """Each source with its type (A: from a series of observations; B: by other means), its distribution, the
    standard uncertainty u(x) of the input, the sensitivity c = dy/dx, the degrees of freedom ν, the contribution
    u(y) = c u(x), and its share in the variance of the quantity. Sources that do not enter a quantity have no line."""


def budget_sections(
    budgets: Sequence[Budget], told: Traceability, picture: bytes | None, more: str = ""
) -> list[Section]:
    """Return the sections of a page with the budgets, their sources, and what the laboratory states.

    ``more`` is a sentence on where other budgets are.
    """
    if not budgets:
        return [Section("Uncertainty budget", "No quantity has a value, so that none has a budget."), *_traced(told)]
    columns = ("quantity", "value", "unit", "u_c", "u_c / value", "ν_eff", "k", f"U ({COVERAGE:.0%})", "not stated")
    rows = [_row(budget) for budget in budgets]
    marks: dict[tuple[int, int], Mark] = {(i, 8): "warn" for i, budget in enumerate(budgets) if budget.missing}
    return [
        Section("Uncertainty budget", _TEXT + more, columns, rows, picture, marks),
        Section("Sources of uncertainty", _LINES, _LINE_COLUMNS, [line for b in budgets for line in _lines(b)]),
        *_traced(told),
    ]


_LINE_COLUMNS = ("quantity", "source", "type", "distribution", "u(x)", "unit of x", "c", "ν", "u(y)", "share")


def _row(budget: Budget) -> tuple[Any, ...]:
    value, _, error = with_uncertainty(budget.value, budget.combined).partition(" ± ")
    relative = f"{budget.combined / abs(budget.value):.2%}" if budget.value else "–"
    return (_named(budget), value, budget.unit, error, relative, _freedom(budget.freedom), f"{budget.factor:.2f}",
            budget.expanded, ", ".join(budget.missing) or "–")  # fmt: skip


def _lines(budget: Budget) -> Iterator[tuple[Any, ...]]:
    name = budget.symbol or budget.name
    for c in budget.contributions:
        if c.reason == NOT_INVOLVED:
            continue
        if c.share is None:
            yield name, c.source, c.kind, c.reason, None, "", None, "", None, ""
        else:
            part = (c.share / budget.combined) ** 2 if budget.combined else 0.0
            yield (name, c.source, c.kind, c.distribution, c.uncertainty, c.unit, c.sensitivity, _freedom(c.freedom),
                   c.share, f"{part:.1%}")  # fmt: skip


def _named(budget: Budget) -> str:
    return f"{budget.symbol}, {budget.name}" if budget.symbol else budget.name


def _freedom(freedom: float) -> str:
    return f"{freedom:.3g}" if freedom < 1e4 else "∞" if math.isinf(freedom) else f"{freedom:.0e}"


def _traced(told: Traceability) -> list[Section]:
    text = """What the block `traceability` of the recipe states of the light and of the temperature, so that a value
        can be traced to a standard."""
    rows = [(name, "not stated" if value is None else value) for name, value in statements(told)]
    marks: dict[tuple[int, int], Mark] = {(i, 1): "warn" for i, (_, value) in enumerate(rows) if value == "not stated"}
    return [Section("Traceability", text, ("statement", "value"), rows, marks=marks)]


def statements(told: Traceability) -> list[tuple[str, str | None]]:
    """Return each statement of a laboratory by its name, with None for what is not stated."""
    photons, lamp, temperature = told.photons, told.lamp, told.temperature
    relative = photons.relative_uncertainty
    coefficients = "; ".join(f"{name} {x:g} /K" for name, x in temperature.coefficients.items())
    return [
        ("photons", "known up to a factor only" if photons.known == "relative" else "absolute"),
        ("relative standard uncertainty of the photons", None if relative is None else f"{relative:.3%}"),
        ("certificate of the photometric calibration", photons.certificate),
        ("date of the calibration", photons.date),
        ("laboratory", photons.laboratory),
        ("instrument", photons.instrument),
        ("spectrum of the lamp", lamp.spectrum),
        ("centroid wavelength", _nm(lamp.centroid, lamp.centroid_uncertainty)),
        ("width of the spectrum (FWHM)", _nm(lamp.fwhm)),
        ("drift of the lamp since its calibration", None if lamp.drift is None else f"{lamp.drift:.3%}"),
        ("temperature of the sensor", _kelvin(temperature.text, temperature.uncertainty)),
        ("temperature coefficients", coefficients or None),
    ]


def of_traceability(told: Traceability) -> dict[str, str | None]:
    """Return what a laboratory states of the operating point of a sheet, by the keys of its statements."""
    photons, lamp, temperature = told.photons, told.lamp, told.temperature
    return {
        "wavelength": _nm(lamp.centroid, lamp.centroid_uncertainty),
        "bandwidth": _nm(lamp.fwhm),
        "spectrum": lamp.spectrum,
        "photometer": ", ".join(filter(None, (photons.instrument, photons.certificate))) or None,
        "temperature": _kelvin(temperature.text, temperature.uncertainty),
        "laboratory": ", ".join(filter(None, (photons.laboratory, photons.date))) or None,
    }


def _nm(length: float | None, width: float | None = None) -> str | None:
    return None if length is None else f"{1e9 * length:g}" + f" ± {1e9 * (width or 0):g}" * bool(width) + " nm"


def _kelvin(text: str | None, width: float | None) -> str | None:
    return None if text is None else text + f" ± {width or 0:g} K" * bool(width)


def budget_rows(budgets: Sequence[Budget]) -> Iterator[tuple[Any, ...]]:
    """Yield the rows of ``budget.csv``: one for each source of each quantity."""
    for b in budgets:
        for c in b.contributions:
            numbers = [c.uncertainty, c.unit, c.sensitivity, c.freedom, c.share]
            if c.share is None:
                numbers = [""] * 5
            yield b.key, b.symbol, b.unit, b.value, c.source, c.kind, c.distribution, *numbers, c.reason


def budget_document(budgets: Sequence[Budget], told: Traceability) -> dict[str, Any]:
    """Return the content of ``budget.json``; infinite degrees of freedom are the text ``infinite``."""
    return {
        "guide": "JCGM 100:2008 (GUM)",
        "coverage probability": COVERAGE,
        "traceability": {name: "not stated" if value is None else value for name, value in statements(told)},
        "quantities": {b.key: _budget(b) for b in budgets},
    }


def _budget(b: Budget) -> dict[str, Any]:
    return {
        "name": b.name,
        "symbol": b.symbol,
        "unit": b.unit,
        "value": b.value,
        "combined standard uncertainty": b.combined,
        "effective degrees of freedom": _finite(b.freedom),
        "coverage factor": b.factor,
        "expanded uncertainty": b.expanded,
        "not stated": list(b.missing),
        "sources": [_contribution(c) for c in b.contributions],
    }


def _contribution(c: Contribution) -> dict[str, Any]:
    if c.share is None:
        return {"source": c.source, "kind": c.kind, "reason": c.reason}
    kept = {name: value for name, value in asdict(c).items() if name != "reason"}
    return {**kept, "freedom": _finite(c.freedom), "contribution": c.share}


def _finite(freedom: float) -> float | str:
    return freedom if math.isfinite(freedom) else "infinite"


def two_digits(uncertainty: float) -> str:
    """Return an uncertainty as text of two significant digits, of large numbers without an exponent: 1000, 710."""
    return f"{float(f'{uncertainty:.2g}'):.6g}"


def budget_figure(budgets: Sequence[Budget]) -> Any:
    """Draw the share of each source in the variance of each quantity, as bars that add up to 100 %."""
    sources = list(dict.fromkeys(c.source for b in budgets for c in b.contributions if c.share))
    colours = {source: _COLOURS[i % len(_COLOURS)] for i, source in enumerate(sources)}
    figure, axes = canvas(9.0, 1.5 + 0.36 * len(budgets) + 0.24 * len(sources))
    ax, shown = axes[0, 0], set[str]()
    for i, b in enumerate(budgets):
        left = 0.0
        for c in b.contributions:
            part = 100 * ((c.share or 0.0) / b.combined) ** 2 if b.combined else 0.0
            if part > 100 * _LEAST:
                label = None if c.source in shown else c.source
                shown.add(c.source)
                ax.barh(i, part, left=left, color=colours[c.source], label=label, height=0.7)
                left += part
        ax.text(101, i, f"U = {two_digits(b.expanded)} {b.unit}".rstrip(), va="center", fontsize=9)
    ax.set_yticks(range(len(budgets)), [b.symbol or b.name for b in budgets])
    ax.set(xlim=(0, 100), xlabel="share of the variance (%)", title="Sources of uncertainty")
    ax.invert_yaxis()
    ax.grid(axis="y", visible=False)
    figure.legend(*ax.get_legend_handles_labels(), loc="outside lower center", ncols=2)
    return figure


#: from budgets to the PNG bytes of the picture
budget_picture = drawn(budget_figure)
