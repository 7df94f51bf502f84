"""The pictures of the EMVA 1288 sheet, and its PDF."""

from __future__ import annotations

import io
import itertools
import textwrap
from collections.abc import Callable, Mapping, Sequence
from typing import Any

import numpy as np

from neusee.nodes.calibrate import COVERAGE, Budget, EmvaSheet, general_model
from neusee.workflows.calibration import emva_sheet
from neusee.workflows.calibration.uncertainty_budget import BUDGETED, budget_figure, two_digits
from neusee.workflows.report.figures.style import (
    BLACK,
    BLUE,
    GREEN,
    ORANGE,
    VERMILION,
    canvas,
    drawn,
    styled,
)

# --- emva figures ---------------------------------------------------------------------------------

# The pictures of the EMVA 1288 sheet, in the order of the standard.


Draw = Callable[[EmvaSheet], Any]
_DOTS = {"linestyle": "", "marker": "o", "color": BLACK, "markersize": 3.5}
_WIDTH, _HEIGHT = 9.0, 4.2  #: inches
_BINS = 200  #: points of a curve


def photon_transfer(sheet: EmvaSheet) -> Any:
    """Draw the variance over the signal, both above the dark, with the line of the system gain
    and saturation.
    """
    figure, axes = canvas(_WIDTH, _HEIGHT)
    ax, transfer, k = axes[0, 0], sheet.transfer, sheet["K"].value
    ax.plot(transfer.signal, transfer.excess, label="measured", **_DOTS)
    limit = 0.7 * float(transfer.signal[transfer.saturation])
    if k is not None:
        ax.plot([0, limit], [0, k * limit], color=BLUE, label=f"0 to 70 %: K = {k:.4g} DN/e-")
        ax.plot([limit, limit / 0.7], [k * limit, k * limit / 0.7], color=BLUE, linestyle=":")
    _saturation(ax, sheet, float(transfer.signal[transfer.saturation]))
    ax.set(xlabel="μ_y - μ_y.dark (DN)", ylabel="σ²_y - σ²_y.dark (DN²)", title="Photon transfer")
    ax.set_ylim(bottom=min(0.0, 1.1 * float(transfer.excess.min())))
    ax.legend(loc="upper left")
    return figure


def sensitivity(sheet: EmvaSheet) -> Any:
    """Draw the signal above the dark over the photons, with the line of the responsivity."""
    figure, axes = canvas(_WIDTH, _HEIGHT)
    ax, transfer, slope = axes[0, 0], sheet.transfer, sheet["R"].value
    ax.plot(transfer.photons, transfer.signal, label="measured", **_DOTS)
    if slope is not None:
        end = 0.7 * float(transfer.signal[transfer.saturation]) / slope
        ax.plot(
            [0, end], [0, slope * end], color=BLUE, label=f"0 to 70 %: R = {slope:.4g} DN/photon"
        )
    _saturation(ax, sheet, float(transfer.photons[transfer.saturation]))
    ax.set(xlabel=_light(sheet), ylabel="μ_y - μ_y.dark (DN)", title="Sensitivity")
    ax.legend(loc="upper left")
    return figure


def signal_to_noise(sheet: EmvaSheet) -> Any:
    """Draw the signal-to-noise ratio over the light: measured, of the model, with DSNU and PRNU,
    and ideal.
    """
    figure, axes = canvas(_WIDTH, _HEIGHT)
    ax, transfer = axes[0, 0], sheet.transfer
    shown = (
        (transfer.signal > 0)
        & (transfer.variance > 0)
        & (np.arange(len(transfer.signal)) <= transfer.saturation)
    )
    ax.plot(
        transfer.photons[shown],
        transfer.signal[shown] / np.sqrt(transfer.variance[shown]),
        label="measured",
        **_DOTS,
    )
    _modelled_ratio(ax, sheet)
    _saturation(ax, sheet, float(transfer.photons[transfer.saturation]))
    ax.set(
        xscale="log",
        yscale="log",
        xlabel=_light(sheet),
        ylabel="SNR",
        title="Signal-to-noise ratio",
    )
    ax.set_ylim(bottom=min(1.0, *ax.get_ylim()))
    ax.legend(loc="upper left")
    return figure


def _modelled_ratio(ax: Any, sheet: EmvaSheet) -> None:
    """Draw the ratio of the linear model from threshold to saturation, if the frames tell both."""
    eta, k, threshold, saturation = (
        sheet[key].value for key in ("eta", "K", "mu_p_min", "mu_p_sat")
    )
    if eta is None or k is None or threshold is None or saturation is None:
        return
    light = np.geomspace(threshold, saturation, _BINS)
    electrons = eta / 100 * light
    noise = (sheet["sigma_y_dark"].value or 0.0) ** 2 / k**2 + electrons
    ax.plot(light, electrons / np.sqrt(noise), color=BLUE, label="linear model")
    ax.plot(light, np.sqrt(light), color=GREEN, linestyle="-.", label="ideal sensor")
    dsnu, prnu = sheet["DSNU1288"].value, sheet["PRNU1288"].value
    if dsnu is not None and prnu is not None:
        total = noise + dsnu**2 + (prnu / 100 * electrons) ** 2
        ax.plot(
            light,
            electrons / np.sqrt(total),
            color=ORANGE,
            linestyle="--",
            label="total SNR, with DSNU and PRNU",
        )
    ax.axvline(
        threshold, color=VERMILION, linestyle=":", label=f"μ_p.min: {sheet['mu_p_min'].text}"
    )


def general(sheet: EmvaSheet) -> Any:
    """Draw the local slope of the response and the signal-to-noise ratio of the light; None with
    too few levels.
    """
    model = general_model(sheet.transfer)
    if model is None:
        return None
    figure, axes = canvas(_WIDTH, _HEIGHT, 1, 2)
    left, right = axes[0]
    left.errorbar(
        model.photons, model.slope[1:], model.slope[1:] * model.error[1:], ecolor="#777777", **_DOTS
    )
    left.set(xlabel=_light(sheet), ylabel="slope (DN per photon)", title="Slope of the response")
    left.set_ylim(0, 1.15 * float((model.slope * (1 + model.error)).max()))
    left.locator_params(axis="x", nbins=5)
    right.plot(model.photons, model.ratio, **_DOTS)
    right.set(
        xscale="log",
        yscale="log",
        xlabel=_light(sheet),
        ylabel="SNR of the light",
        title="SNR, no linear model",
    )
    right.xaxis.set_minor_formatter("")
    return figure


def linearity(sheet: EmvaSheet) -> Any:
    """Draw the response with its line, and the relative deviation from the line, from 5 to 95 %
    of saturation.
    """
    figure, axes = canvas(_WIDTH, 6.0, 2, 1, sharex=True, height_ratios=(1.4, 1.0))
    above, below, transfer, linear = axes[0, 0], axes[1, 0], sheet.transfer, sheet.transfer.linear
    above.plot(transfer.photons, transfer.signal, label="measured", **_DOTS)
    above.set(ylabel="μ_y - μ_y.dark (DN)", title="Linearity")
    if sheet.linearity is not None:
        ends = np.array([transfer.photons[linear].min(), transfer.photons[linear].max()])
        fitted = sheet.linearity.start + sheet.linearity.slope * ends
        above.plot(ends, fitted, color=BLUE, label="line of least relative deviation, 5 to 95 %")
        below.plot(transfer.photons[linear], sheet.linearity.deviation, **_DOTS)
        for key in ("LE_min", "LE_max"):
            below.axhline(sheet[key].value, color=VERMILION, linestyle=":")
            text = f"{sheet[key].symbol} = {sheet[key].text}"
            side, up = ("top", -4) if key == "LE_min" else ("bottom", 4)
            placement: Any = {
                "xy": (1, sheet[key].value),
                "xycoords": ("axes fraction", "data"),
                "xytext": (0, up),
            }
            below.annotate(
                text, **placement, textcoords="offset points", ha="right", va=side, fontsize=9
            )
        below.margins(y=0.35)
    else:
        below.text(0.5, 0.5, sheet["LE_min"].reason, transform=below.transAxes, ha="center")
    below.axhline(0, color=BLUE, linewidth=1)
    below.set(xlabel=_light(sheet), ylabel="deviation (%)")
    above.legend(loc="upper left")
    return figure


def dark_current(sheet: EmvaSheet) -> Any:
    """Draw mean and variance of the dark over the exposure; None where all darks have one
    exposure.
    """
    transfer = sheet.transfer
    if len(np.unique(transfer.dark_exposure)) < 2:
        return None
    figure, axes = canvas(_WIDTH, _HEIGHT, 1, 2)
    for ax, values, key, label in (
        (axes[0, 0], transfer.dark_mean, "mu_I_mean", "μ_y.dark (DN)"),
        (axes[0, 1], transfer.dark_variance, "mu_I_var", "σ²_y.dark (DN²)"),
    ):
        ax.plot(1e3 * transfer.dark_exposure, values, **_DOTS)
        ax.plot(1e3 * transfer.dark_exposure, _straight(transfer.dark_exposure, values), color=BLUE)
        ax.set(
            xlabel="exposure (ms)", ylabel=label, title=f"{sheet[key].symbol}: {sheet[key].text}"
        )
        ax.ticklabel_format(axis="y", useOffset=False)
    return figure


def spectrograms(sheet: EmvaSheet) -> Any:
    """Draw the spectrograms of DSNU and PRNU along rows and columns; None without a series."""
    images = emva_sheet.spectrograms(sheet)
    if not images:
        return None
    figure, axes = canvas(_WIDTH, 3.4 * len(images), len(images), 2)
    for row, ((name, unit), directions) in zip(axes, images.items(), strict=True):
        quantity = sheet[f"{name}1288_DN" if name == "DSNU" else f"{name}1288"]
        single, average = emva_sheet.noise_in_time(sheet, name)
        for ax, (direction, spectrogram) in zip(row, directions.items(), strict=True):
            ax.plot(
                spectrogram.frequency[1:],
                spectrogram.amplitude[1:].clip(1e-12),
                color=BLACK,
                linewidth=0.8,
            )
            if quantity.value is not None:
                ax.axhline(
                    quantity.value,
                    color=VERMILION,
                    linestyle="--",
                    label=f"{quantity.symbol}: {quantity.text}",
                )
            ax.axhline(single, color=GREEN, linestyle="-.", label="noise in time of one frame")
            ax.axhline(average, color=BLUE, linestyle=":", label="noise in time of the average")
            ax.set(
                yscale="log",
                xlabel="cycles per pixel",
                ylabel=f"amplitude ({unit})",
                title=f"{name}, {direction}",
            )
            ax.set_ylim(top=12 * ax.get_ylim()[1])
            ax.legend(loc="upper right")
    return figure


def line_profiles(sheet: EmvaSheet) -> Any:
    """Draw the horizontal and vertical profiles of the averaged dark and lit frames; None
    without a series.
    """
    images = emva_sheet.line_profiles(sheet)
    if not images:
        return None
    figure, axes = canvas(_WIDTH, 3.4 * len(images), len(images), 2)
    for row, (name, directions) in zip(axes, images.items(), strict=True):
        for ax, (direction, profile) in zip(row, directions.items(), strict=True):
            for values, label, colour in zip(
                profile, profile._fields, (GREEN, BLACK, BLUE, ORANGE), strict=True
            ):
                ax.plot(values, color=colour, linewidth=0.8, label=label)
            pixel = "row" if direction == "vertical" else "column"
            ax.set(xlabel=pixel, ylabel="DN", title=f"{direction} profile, {name}")
    figure.legend(*axes[0, 0].get_legend_handles_labels(), loc="outside lower center", ncols=4)
    return figure


def defect_pixels(sheet: EmvaSheet) -> Any:
    """Draw the logarithmic and the accumulated histograms of DSNU and PRNU; None without a
    series.
    """
    histograms = emva_sheet.defect_histograms(sheet)
    if not histograms:
        return None
    figure, axes = canvas(_WIDTH, 3.4 * len(histograms), len(histograms), 2)
    for (left, right), ((name, unit), histogram) in zip(axes, histograms.items(), strict=True):
        left.step(
            histogram.deviation,
            histogram.pixels,
            where="post",
            color=BLACK,
            linewidth=0.9,
            label="pixels",
        )
        left.plot(
            histogram.deviation,
            histogram.normal,
            color=VERMILION,
            linestyle="--",
            label="normal distribution",
        )
        left.set(
            yscale="log", xlabel=f"deviation from the mean ({unit})", ylabel="pixels of a class"
        )
        left.set(title=f"{name}: logarithmic histogram")
        left.set_ylim(0.5, 8 * float(histogram.pixels.max()))
        left.legend(loc="upper right")
        right.plot(histogram.distance, histogram.beyond, color=BLACK)
        right.set(
            yscale="log",
            xlabel=f"deviation from the mean, amount ({unit})",
            ylabel="pixels beyond (%)",
        )
        right.set(title=f"{name}: accumulated histogram")
    return figure


#: from the name of each picture to the function that draws it, in the order of the standard
PICTURES: Mapping[str, Draw] = {
    "photon_transfer": photon_transfer,
    "sensitivity": sensitivity,
    "snr": signal_to_noise,
    "general_model": general,
    "linearity": linearity,
    "dark_current": dark_current,
    "spectrograms": spectrograms,
    "profiles": line_profiles,
    "defect_pixels": defect_pixels,
}


def pictures(sheet: EmvaSheet) -> dict[str, bytes]:
    """Return the PNG bytes of each picture that the frames allow, by name."""

    images = {name: _picture(draw, sheet) for name, draw in PICTURES.items()}
    return {name: png for name, png in images.items() if png is not None}


def _picture(draw: Draw, sheet: EmvaSheet) -> bytes | None:
    """Return the PNG bytes of a picture; None where the frames do not allow it."""
    with styled():
        figure = draw(sheet)
    return None if figure is None else drawn(lambda: figure)()


def _saturation(ax: Any, sheet: EmvaSheet, level: float) -> None:
    label = "saturation" if sheet.transfer.saturated else "brightest level: saturation not reached"
    ax.axvline(level, color=VERMILION, linestyle="--", label=label)


def _light(sheet: EmvaSheet) -> str:
    return "light (relative)" if sheet["eta"].value is None else "μ_p (photons per pixel)"


def _straight(x: Any, y: Any) -> Any:
    return np.polyval(np.polyfit(x, y, 1), x)


# --- emva pdf -------------------------------------------------------------------------------------

# The PDF of the EMVA 1288 sheet: a page with all quantities, and a page for each picture.


_LINE = 105  #: characters of a line of the summary
_COLUMNS = ("symbol", "quantity", "value", f"U ({COVERAGE:.0%})")
_A4 = (8.27, 11.69)  #: inches


def pdf(sheet: EmvaSheet, title: str, lines: list[str], budgets: Sequence[Budget] = ()) -> bytes:
    """Return a PDF: the summary of the sheet on its first page, and the pictures on the pages after
    it.

    ``budgets`` have the expanded uncertainty of each quantity with a value.
    """
    from matplotlib.backends.backend_pdf import PdfPages

    out = io.BytesIO()
    # equal frames give equal bytes
    about = {"Title": title, "Creator": "neusee", "CreationDate": None}
    with styled(), PdfPages(out, metadata=about) as pages:
        pages.savefig(_summary(sheet, title, lines, {b.key: b for b in budgets}))
        for draw in PICTURES.values():
            if (figure := draw(sheet)) is not None:
                pages.savefig(figure, bbox_inches="tight", pad_inches=0.3)
        if named := [budget for budget in budgets if budget.key in BUDGETED]:
            pages.savefig(budget_figure(named), bbox_inches="tight", pad_inches=0.3)
    return out.getvalue()


def _summary(sheet: EmvaSheet, title: str, lines: list[str], budgets: Mapping[str, Budget]) -> Any:
    """Return a page of A4 with title, what is told of the camera, and the table of all
    quantities.
    """
    figure, axes = canvas(*_A4, 2, 1, height_ratios=(0.25, 1.0))
    figure.get_layout_engine().set(rect=(0.07, 0.04, 0.86, 0.92))
    for ax in axes[:, 0]:
        ax.set_axis_off()
    axes[0, 0].text(
        0, 1, title, fontsize=14, fontweight="bold", va="top", transform=axes[0, 0].transAxes
    )
    shown = "\n".join(itertools.chain(*(textwrap.wrap(text, _LINE) for text in lines)))
    axes[0, 0].text(
        0, 0.86, shown, fontsize=9, va="top", linespacing=1.4, transform=axes[0, 0].transAxes
    )
    rows = [(q.symbol, q.name, q.text, _expanded(budgets.get(q.key))) for q in sheet.quantities]
    table = axes[1, 0].table(
        rows,
        colLabels=_COLUMNS,
        colWidths=(0.22, 0.46, 0.2, 0.12),
        cellLoc="left",
        loc="upper center",
    )
    table.auto_set_font_size(False)
    table.set_fontsize(9)
    for cell in table.get_celld().values():
        cell.set_linewidth(0.3)
        cell.PAD = 0.03
    return figure


def _expanded(budget: Budget | None) -> str:
    """Return the expanded uncertainty in the unit of the value as text; + says that a source is
    not stated.
    """
    if budget is None:
        return "–"
    return two_digits(budget.expanded) + " +" * bool(budget.missing)
