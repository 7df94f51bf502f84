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
    """Draw the temporal variance against the signal, both above the dark, with the line of the
    system gain and the saturation.
    """
    figure, axes = canvas(_WIDTH, _HEIGHT)
    ax, transfer, gain = axes[0, 0], sheet.transfer, sheet["K"].value
    ax.plot(transfer.signal, transfer.excess, label="measured", **_DOTS)
    linear_limit = 0.7 * float(transfer.signal[transfer.saturation])
    if gain is not None:
        ax.plot(
            [0, linear_limit],
            [0, gain * linear_limit],
            color=BLUE,
            label=f"0 to 70 %: K = {gain:.4g} DN/e-",
        )
        ax.plot(
            # dotted where the line was not fitted
            [linear_limit, linear_limit / 0.7],
            [gain * linear_limit, gain * linear_limit / 0.7],
            color=BLUE,
            linestyle=":",
        )
    _saturation(ax, sheet, float(transfer.signal[transfer.saturation]))
    ax.set(xlabel="μ_y - μ_y.dark (DN)", ylabel="σ²_y - σ²_y.dark (DN²)", title="Photon transfer")
    ax.set_ylim(bottom=min(0.0, 1.1 * float(transfer.excess.min())))
    ax.legend(loc="upper left")
    return figure


def sensitivity(sheet: EmvaSheet) -> Any:
    """Draw the signal above the dark against the photons, with the line of the responsivity."""
    figure, axes = canvas(_WIDTH, _HEIGHT)
    ax, transfer, responsivity = axes[0, 0], sheet.transfer, sheet["R"].value
    ax.plot(transfer.photons, transfer.signal, label="measured", **_DOTS)
    if responsivity is not None:
        last_photons = 0.7 * float(transfer.signal[transfer.saturation]) / responsivity
        ax.plot(
            [0, last_photons],
            [0, responsivity * last_photons],
            color=BLUE,
            label=f"0 to 70 %: R = {responsivity:.4g} DN/photon",
        )
    _saturation(ax, sheet, float(transfer.photons[transfer.saturation]))
    ax.set(xlabel=_light(sheet), ylabel="μ_y - μ_y.dark (DN)", title="Sensitivity")
    ax.legend(loc="upper left")
    return figure


def signal_to_noise(sheet: EmvaSheet) -> Any:
    """Draw the signal-to-noise ratio against the light: measured, linear model, with DSNU and PRNU,
    and ideal.
    """
    figure, axes = canvas(_WIDTH, _HEIGHT)
    ax, transfer = axes[0, 0], sheet.transfer
    is_drawn = (
        (transfer.signal > 0)
        & (transfer.variance > 0)
        & (np.arange(len(transfer.signal)) <= transfer.saturation)
    )
    ax.plot(
        transfer.photons[is_drawn],
        transfer.signal[is_drawn] / np.sqrt(transfer.variance[is_drawn]),
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
    """Draw the ratio of the linear model from threshold to saturation, if both are known."""
    efficiency, gain, threshold, saturation = (
        sheet[key].value for key in ("eta", "K", "mu_p_min", "mu_p_sat")
    )
    if efficiency is None or gain is None or threshold is None or saturation is None:
        return
    photons = np.geomspace(threshold, saturation, _BINS)
    # the efficiency is in percent
    electrons = efficiency / 100 * photons
    # variance in electrons squared: dark noise converted from DN by the gain, plus shot noise
    noise_variance = (sheet["sigma_y_dark"].value or 0.0) ** 2 / gain**2 + electrons
    ax.plot(photons, electrons / np.sqrt(noise_variance), color=BLUE, label="linear model")
    ax.plot(photons, np.sqrt(photons), color=GREEN, linestyle="-.", label="ideal sensor")
    dsnu, prnu = sheet["DSNU1288"].value, sheet["PRNU1288"].value
    if dsnu is not None and prnu is not None:
        total_variance = noise_variance + dsnu**2 + (prnu / 100 * electrons) ** 2
        ax.plot(
            photons,
            electrons / np.sqrt(total_variance),
            color=ORANGE,
            linestyle="--",
            label="total SNR, with DSNU and PRNU",
        )
    ax.axvline(
        threshold, color=VERMILION, linestyle=":", label=f"μ_p.min: {sheet['mu_p_min'].text}"
    )


def general(sheet: EmvaSheet) -> Any:
    """Draw the local slope of the response and the input-referred signal-to-noise ratio; return
    None with too few levels.
    """
    model = general_model(sheet.transfer)
    if model is None:
        return None
    figure, axes = canvas(_WIDTH, _HEIGHT, 1, 2)
    slope_panel, ratio_panel = axes[0]
    # the first slope is that of the dark level, which has no light to be drawn over
    slope_panel.errorbar(
        model.photons, model.slope[1:], model.slope[1:] * model.error[1:], ecolor="#777777", **_DOTS
    )
    slope_panel.set(
        xlabel=_light(sheet), ylabel="slope (DN per photon)", title="Slope of the response"
    )
    slope_panel.set_ylim(0, 1.15 * float((model.slope * (1 + model.error)).max()))
    slope_panel.locator_params(axis="x", nbins=5)
    ratio_panel.plot(model.photons, model.ratio, **_DOTS)
    ratio_panel.set(
        xscale="log",
        yscale="log",
        xlabel=_light(sheet),
        ylabel="SNR of the light",
        title="SNR, no linear model",
    )
    ratio_panel.xaxis.set_minor_formatter("")
    return figure


def linearity(sheet: EmvaSheet) -> Any:
    """Draw the response with its line, and the relative deviation from this line, between 5 and 95
    % of saturation.
    """
    figure, axes = canvas(_WIDTH, 6.0, 2, 1, sharex=True, height_ratios=(1.4, 1.0))
    response_panel, deviation_panel, transfer, in_fit = (
        axes[0, 0],
        axes[1, 0],
        sheet.transfer,
        sheet.transfer.linear,
    )
    response_panel.plot(transfer.photons, transfer.signal, label="measured", **_DOTS)
    response_panel.set(ylabel="μ_y - μ_y.dark (DN)", title="Linearity")
    if sheet.linearity is not None:
        first_and_last = np.array([transfer.photons[in_fit].min(), transfer.photons[in_fit].max()])
        line_signal = sheet.linearity.start + sheet.linearity.slope * first_and_last
        response_panel.plot(
            first_and_last,
            line_signal,
            color=BLUE,
            label="line of least relative deviation, 5 to 95 %",
        )
        deviation_panel.plot(transfer.photons[in_fit], sheet.linearity.deviation, **_DOTS)
        for key in ("LE_min", "LE_max"):
            deviation_panel.axhline(sheet[key].value, color=VERMILION, linestyle=":")
            text = f"{sheet[key].symbol} = {sheet[key].text}"
            # the text of the lower limit hangs below its line, that of the upper one stands on it
            text_side, text_offset = ("top", -4) if key == "LE_min" else ("bottom", 4)
            placement: Any = {
                "xy": (1, sheet[key].value),
                "xycoords": ("axes fraction", "data"),
                "xytext": (0, text_offset),
            }
            deviation_panel.annotate(
                text, **placement, textcoords="offset points", ha="right", va=text_side, fontsize=9
            )
        deviation_panel.margins(y=0.35)
    else:
        deviation_panel.text(
            0.5, 0.5, sheet["LE_min"].reason, transform=deviation_panel.transAxes, ha="center"
        )
    deviation_panel.axhline(0, color=BLUE, linewidth=1)
    deviation_panel.set(xlabel=_light(sheet), ylabel="deviation (%)")
    response_panel.legend(loc="upper left")
    return figure


def dark_current(sheet: EmvaSheet) -> Any:
    """Draw mean and variance of the dark frames against the exposure; return None if all darks have
    one exposure.
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
    """Draw the spectrograms of DSNU and PRNU along rows and columns; return None without
    a series.
    """
    images = emva_sheet.spectrograms(sheet)
    if not images:
        return None
    figure, axes = canvas(_WIDTH, 3.4 * len(images), len(images), 2)
    for row, ((name, unit), directions) in zip(axes, images.items(), strict=True):
        quantity = sheet[f"{name}1288_DN" if name == "DSNU" else f"{name}1288"]
        frame_noise, average_noise = emva_sheet.noise_in_time(sheet, name)
        for ax, (direction, spectrogram) in zip(row, directions.items(), strict=True):
            ax.plot(
                # the frequency 0 is the mean
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
            ax.axhline(frame_noise, color=GREEN, linestyle="-.", label="noise in time of one frame")
            ax.axhline(
                average_noise, color=BLUE, linestyle=":", label="noise in time of the average"
            )
            ax.set(
                yscale="log",
                xlabel="cycles per pixel",
                ylabel=f"amplitude ({unit})",
                title=f"{name}, {direction}",
            )
            # room for the legend above the curves
            ax.set_ylim(top=12 * ax.get_ylim()[1])
            ax.legend(loc="upper right")
    return figure


def line_profiles(sheet: EmvaSheet) -> Any:
    """Draw the horizontal and vertical profiles of the averaged dark and lit frames; return None
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
    """Draw the logarithmic and accumulated histograms of DSNU and PRNU; return None without a
    series.
    """
    histograms = emva_sheet.defect_histograms(sheet)
    if not histograms:
        return None
    figure, axes = canvas(_WIDTH, 3.4 * len(histograms), len(histograms), 2)
    for (logarithmic_panel, accumulated_panel), ((name, unit), histogram) in zip(
        axes, histograms.items(), strict=True
    ):
        logarithmic_panel.step(
            histogram.deviation,
            histogram.pixels,
            where="post",
            color=BLACK,
            linewidth=0.9,
            label="pixels",
        )
        logarithmic_panel.plot(
            histogram.deviation,
            histogram.normal,
            color=VERMILION,
            linestyle="--",
            label="normal distribution",
        )
        logarithmic_panel.set(
            yscale="log", xlabel=f"deviation from the mean ({unit})", ylabel="pixels of a class"
        )
        logarithmic_panel.set(title=f"{name}: logarithmic histogram")
        logarithmic_panel.set_ylim(0.5, 8 * float(histogram.pixels.max()))
        logarithmic_panel.legend(loc="upper right")
        accumulated_panel.plot(histogram.distance, histogram.beyond, color=BLACK)
        accumulated_panel.set(
            yscale="log",
            xlabel=f"deviation from the mean, amount ({unit})",
            ylabel="pixels beyond (%)",
        )
        accumulated_panel.set(title=f"{name}: accumulated histogram")
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
    """Draw a vertical line at the saturation, or at the brightest level if saturation is not
    reached.

    ``level`` is its position on the horizontal axis of ``ax``.
    """
    label = "saturation" if sheet.transfer.saturated else "brightest level: saturation not reached"
    ax.axvline(level, color=VERMILION, linestyle="--", label=label)


def _light(sheet: EmvaSheet) -> str:
    """Return the label of the light axis; without a quantum efficiency the light is only
    relative.
    """
    return "light (relative)" if sheet["eta"].value is None else "μ_p (photons per pixel)"


def _straight(x: Any, y: Any) -> Any:
    """Return the values at ``x`` of the least-squares line through the points (x, y)."""
    return np.polyval(np.polyfit(x, y, 1), x)


# --- emva pdf -------------------------------------------------------------------------------------

# The PDF of the EMVA 1288 sheet: a page with all quantities, and a page for each picture.


_LINE = 105  #: largest number of characters in a line of the summary
_COLUMNS = ("symbol", "quantity", "value", f"U ({COVERAGE:.0%})")
_A4 = (8.27, 11.69)  #: inches


def pdf(sheet: EmvaSheet, title: str, lines: list[str], budgets: Sequence[Budget] = ()) -> bytes:
    """Return a PDF with a summary of the sheet on its first page, followed by the pictures.

    ``budgets`` have the expanded uncertainty of each quantity with a value.
    """
    from matplotlib.backends.backend_pdf import PdfPages

    pdf_file = io.BytesIO()
    # no creation date, so that equal frames give equal bytes
    metadata = {"Title": title, "Creator": "neusee", "CreationDate": None}
    with styled(), PdfPages(pdf_file, metadata=metadata) as pages:
        pages.savefig(_summary(sheet, title, lines, {b.key: b for b in budgets}))
        for draw_picture in PICTURES.values():
            if (figure := draw_picture(sheet)) is not None:
                pages.savefig(figure, bbox_inches="tight", pad_inches=0.3)
        if shown_budgets := [budget for budget in budgets if budget.key in BUDGETED]:
            pages.savefig(budget_figure(shown_budgets), bbox_inches="tight", pad_inches=0.3)
    return pdf_file.getvalue()


def _summary(sheet: EmvaSheet, title: str, lines: list[str], budgets: Mapping[str, Budget]) -> Any:
    """Return an A4 page with the title, the statements on the camera, and a table of all
    quantities.
    """
    figure, axes = canvas(*_A4, 2, 1, height_ratios=(0.25, 1.0))
    figure.get_layout_engine().set(rect=(0.07, 0.04, 0.86, 0.92))
    for ax in axes[:, 0]:
        ax.set_axis_off()
    axes[0, 0].text(
        0, 1, title, fontsize=14, fontweight="bold", va="top", transform=axes[0, 0].transAxes
    )
    wrapped_text = "\n".join(itertools.chain(*(textwrap.wrap(text, _LINE) for text in lines)))
    axes[0, 0].text(
        0, 0.86, wrapped_text, fontsize=9, va="top", linespacing=1.4, transform=axes[0, 0].transAxes
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
    """Return the expanded uncertainty as text; a + marks that one of its sources is not stated."""
    if budget is None:
        return "–"
    return two_digits(budget.expanded) + " +" * bool(budget.missing)
