"""The PDF of the EMVA 1288 sheet: a page with all quantities, and a page for each picture."""

from __future__ import annotations

import io
import textwrap
from collections.abc import Mapping, Sequence
from typing import Any

from neusee.nodes.calibrate import COVERAGE, Budget, EmvaSheet
from neusee.workflows.calibration import emva_figures
from neusee.workflows.calibration.budget_page import BUDGETED, budget_figure, two_digits
from neusee.workflows.report.figures.style import canvas, styled

_LINE = 105  #: characters of a line of the summary
_COLUMNS = ("symbol", "quantity", "value", f"U ({COVERAGE:.0%})")
_A4 = (8.27, 11.69)  #: inches


def pdf(sheet: EmvaSheet, title: str, lines: list[str], budgets: Sequence[Budget] = ()) -> bytes:
    """Return a PDF: the summary of the sheet on its first page, and the pictures on the pages after it.

    ``budgets`` have the expanded uncertainty of each quantity with a value.
    """
    from matplotlib.backends.backend_pdf import PdfPages

    out = io.BytesIO()
    about = {"Title": title, "Creator": "neusee", "CreationDate": None}  # equal frames give equal bytes
    with styled(), PdfPages(out, metadata=about) as pages:
        pages.savefig(_summary(sheet, title, lines, {b.key: b for b in budgets}))
        for draw in emva_figures.PICTURES.values():
            if (figure := draw(sheet)) is not None:
                pages.savefig(figure, bbox_inches="tight", pad_inches=0.3)
        if named := [budget for budget in budgets if budget.key in BUDGETED]:
            pages.savefig(budget_figure(named), bbox_inches="tight", pad_inches=0.3)
    return out.getvalue()


def _summary(sheet: EmvaSheet, title: str, lines: list[str], budgets: Mapping[str, Budget]) -> Any:
    """Return a page of A4 with title, what is told of the camera, and the table of all quantities."""
    figure, axes = canvas(*_A4, 2, 1, height_ratios=(0.25, 1.0))
    figure.get_layout_engine().set(rect=(0.07, 0.04, 0.86, 0.92))
    for ax in axes[:, 0]:
        ax.set_axis_off()
    axes[0, 0].text(0, 1, title, fontsize=14, fontweight="bold", va="top", transform=axes[0, 0].transAxes)
    shown = "\n".join(part for text in lines for part in textwrap.wrap(text, _LINE))
    axes[0, 0].text(0, 0.86, shown, fontsize=9, va="top", linespacing=1.4, transform=axes[0, 0].transAxes)
    rows = [(q.symbol, q.name, q.text, _expanded(budgets.get(q.key))) for q in sheet.quantities]
    table = axes[1, 0].table(
        rows, colLabels=_COLUMNS, colWidths=(0.22, 0.46, 0.2, 0.12), cellLoc="left", loc="upper center"
    )
    table.auto_set_font_size(False)
    table.set_fontsize(9)
    for cell in table.get_celld().values():
        cell.set_linewidth(0.3)
        cell.PAD = 0.03
    return figure


def _expanded(budget: Budget | None) -> str:
    """Return the expanded uncertainty in the unit of the value as text; + says that a source is not stated."""
    if budget is None:
        return "–"
    return two_digits(budget.expanded) + " +" * bool(budget.missing)
