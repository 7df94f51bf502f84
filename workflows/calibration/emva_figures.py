"""The pictures of the EMVA 1288 sheet, in the order of the standard."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from typing import Any

import numpy as np

from neusee.nodes.calibrate import EmvaSheet, general_model
from neusee.workflows.calibration import emva_patterns
from neusee.workflows.report.figures.style import BLACK, BLUE, GREEN, ORANGE, VERMILION, canvas, drawn, styled

Draw = Callable[[EmvaSheet], Any]
_DOTS = {"linestyle": "", "marker": "o", "color": BLACK, "markersize": 3.5}
_WIDTH, _HEIGHT = 9.0, 4.2  #: inches
_BINS = 200  #: points of a curve


def photon_transfer(sheet: EmvaSheet) -> Any:
    """Draw the variance over the signal, both above the dark, with the line of the system gain and saturation."""
    figure, axes = canvas(_WIDTH, _HEIGHT)
    ax, found, k = axes[0, 0], sheet.transfer, sheet["K"].value
    ax.plot(found.signal, found.excess, label="measured", **_DOTS)
    limit = 0.7 * float(found.signal[found.saturation])
    if k is not None:
        ax.plot([0, limit], [0, k * limit], color=BLUE, label=f"0 to 70 %: K = {k:.4g} DN/e-")
        ax.plot([limit, limit / 0.7], [k * limit, k * limit / 0.7], color=BLUE, linestyle=":")
    _saturation(ax, sheet, float(found.signal[found.saturation]))
    ax.set(xlabel="μ_y - μ_y.dark (DN)", ylabel="σ²_y - σ²_y.dark (DN²)", title="Photon transfer")
    ax.set_ylim(bottom=min(0.0, 1.1 * float(found.excess.min())))
    ax.legend(loc="upper left")
    return figure


def sensitivity(sheet: EmvaSheet) -> Any:
    """Draw the signal above the dark over the photons, with the line of the responsivity."""
    figure, axes = canvas(_WIDTH, _HEIGHT)
    ax, found, slope = axes[0, 0], sheet.transfer, sheet["R"].value
    ax.plot(found.photons, found.signal, label="measured", **_DOTS)
    if slope is not None:
        end = 0.7 * float(found.signal[found.saturation]) / slope
        ax.plot([0, end], [0, slope * end], color=BLUE, label=f"0 to 70 %: R = {slope:.4g} DN/photon")
    _saturation(ax, sheet, float(found.photons[found.saturation]))
    ax.set(xlabel=_light(sheet), ylabel="μ_y - μ_y.dark (DN)", title="Sensitivity")
    ax.legend(loc="upper left")
    return figure


def signal_to_noise(sheet: EmvaSheet) -> Any:
    """Draw the signal-to-noise ratio over the light: measured, of the model, with DSNU and PRNU, and ideal."""
    figure, axes = canvas(_WIDTH, _HEIGHT)
    ax, found = axes[0, 0], sheet.transfer
    seen = (found.signal > 0) & (found.variance > 0) & (np.arange(len(found.signal)) <= found.saturation)
    ax.plot(found.photons[seen], found.signal[seen] / np.sqrt(found.variance[seen]), label="measured", **_DOTS)
    eta, k, least, most = (sheet[key].value for key in ("eta", "K", "mu_p_min", "mu_p_sat"))
    if eta is not None and k is not None and least is not None and most is not None:
        light = np.geomspace(least, most, _BINS)
        electrons = eta / 100 * light
        noise = (sheet["sigma_y_dark"].value or 0.0) ** 2 / k**2 + electrons
        ax.plot(light, electrons / np.sqrt(noise), color=BLUE, label="linear model")
        ax.plot(light, np.sqrt(light), color=GREEN, linestyle="-.", label="ideal sensor")
        dsnu, prnu = sheet["DSNU1288"].value, sheet["PRNU1288"].value
        if dsnu is not None and prnu is not None:
            whole = noise + dsnu**2 + (prnu / 100 * electrons) ** 2
            ax.plot(
                light, electrons / np.sqrt(whole), color=ORANGE, linestyle="--", label="total SNR, with DSNU and PRNU"
            )
        ax.axvline(least, color=VERMILION, linestyle=":", label=f"μ_p.min: {sheet['mu_p_min'].text}")
    _saturation(ax, sheet, float(found.photons[found.saturation]))
    ax.set(xscale="log", yscale="log", xlabel=_light(sheet), ylabel="SNR", title="Signal-to-noise ratio")
    ax.set_ylim(bottom=min(1.0, *ax.get_ylim()))
    ax.legend(loc="upper left")
    return figure


def general(sheet: EmvaSheet) -> Any:
    """Draw the local slope of the response and the signal-to-noise ratio of the light; None with too few levels."""
    found = general_model(sheet.transfer)
    if found is None:
        return None
    figure, axes = canvas(_WIDTH, _HEIGHT, 1, 2)
    left, right = axes[0]
    left.errorbar(found.photons, found.slope[1:], found.slope[1:] * found.error[1:], ecolor="#777777", **_DOTS)
    left.set(xlabel=_light(sheet), ylabel="slope (DN per photon)", title="Slope of the response")
    left.set_ylim(0, 1.15 * float((found.slope * (1 + found.error)).max()))
    left.locator_params(axis="x", nbins=5)
    right.plot(found.photons, found.ratio, **_DOTS)
    right.set(xscale="log", yscale="log", xlabel=_light(sheet), ylabel="SNR of the light", title="SNR, no linear model")
    right.xaxis.set_minor_formatter("")
    return figure


def linearity(sheet: EmvaSheet) -> Any:
    """Draw the response with its line, and the relative deviation from the line, from 5 to 95 % of saturation."""
    figure, axes = canvas(_WIDTH, 6.0, 2, 1, sharex=True, height_ratios=(1.4, 1.0))
    above, below, found, used = axes[0, 0], axes[1, 0], sheet.transfer, sheet.transfer.linear
    above.plot(found.photons, found.signal, label="measured", **_DOTS)
    above.set(ylabel="μ_y - μ_y.dark (DN)", title="Linearity")
    if sheet.linearity is not None:
        ends = np.array([found.photons[used].min(), found.photons[used].max()])
        fitted = sheet.linearity.start + sheet.linearity.slope * ends
        above.plot(ends, fitted, color=BLUE, label="line of least relative deviation, 5 to 95 %")
        below.plot(found.photons[used], sheet.linearity.deviation, **_DOTS)
        for key in ("LE_min", "LE_max"):
            below.axhline(sheet[key].value, color=VERMILION, linestyle=":")
            text = f"{sheet[key].symbol} = {sheet[key].text}"
            side, up = ("top", -4) if key == "LE_min" else ("bottom", 4)
            at: Any = {"xy": (1, sheet[key].value), "xycoords": ("axes fraction", "data"), "xytext": (0, up)}
            below.annotate(text, **at, textcoords="offset points", ha="right", va=side, fontsize=9)
        below.margins(y=0.35)
    else:
        below.text(0.5, 0.5, sheet["LE_min"].reason, transform=below.transAxes, ha="center")
    below.axhline(0, color=BLUE, linewidth=1)
    below.set(xlabel=_light(sheet), ylabel="deviation (%)")
    above.legend(loc="upper left")
    return figure


def dark_current(sheet: EmvaSheet) -> Any:
    """Draw mean and variance of the dark over the exposure; None where all darks have one exposure."""
    found = sheet.transfer
    if len(np.unique(found.dark_exposure)) < 2:
        return None
    figure, axes = canvas(_WIDTH, _HEIGHT, 1, 2)
    for ax, values, key, label in (
        (axes[0, 0], found.dark_mean, "mu_I_mean", "μ_y.dark (DN)"),
        (axes[0, 1], found.dark_variance, "mu_I_var", "σ²_y.dark (DN²)"),
    ):
        ax.plot(1e3 * found.dark_exposure, values, **_DOTS)
        ax.plot(1e3 * found.dark_exposure, _straight(found.dark_exposure, values), color=BLUE)
        ax.set(xlabel="exposure (ms)", ylabel=label, title=f"{sheet[key].symbol}: {sheet[key].text}")
        ax.ticklabel_format(axis="y", useOffset=False)
    return figure


def spectrograms(sheet: EmvaSheet) -> Any:
    """Draw the spectrograms of DSNU and PRNU along rows and columns; None without a series."""
    images = emva_patterns.spectrograms(sheet)
    if not images:
        return None
    figure, axes = canvas(_WIDTH, 3.4 * len(images), len(images), 2)
    for row, ((name, unit), directions) in zip(axes, images.items(), strict=True):
        quantity = sheet[f"{name}1288_DN" if name == "DSNU" else f"{name}1288"]
        one, average = emva_patterns.noise_in_time(sheet, name)
        for ax, (direction, found) in zip(row, directions.items(), strict=True):
            ax.plot(found.frequency[1:], found.amplitude[1:].clip(1e-12), color=BLACK, linewidth=0.8)
            if quantity.value is not None:
                ax.axhline(quantity.value, color=VERMILION, linestyle="--", label=f"{quantity.symbol}: {quantity.text}")
            ax.axhline(one, color=GREEN, linestyle="-.", label="noise in time of one frame")
            ax.axhline(average, color=BLUE, linestyle=":", label="noise in time of the average")
            ax.set(yscale="log", xlabel="cycles per pixel", ylabel=f"amplitude ({unit})", title=f"{name}, {direction}")
            ax.set_ylim(top=12 * ax.get_ylim()[1])
            ax.legend(loc="upper right")
    return figure


def line_profiles(sheet: EmvaSheet) -> Any:
    """Draw the horizontal and vertical profiles of the averaged dark and lit frames; None without a series."""
    images = emva_patterns.line_profiles(sheet)
    if not images:
        return None
    figure, axes = canvas(_WIDTH, 3.4 * len(images), len(images), 2)
    for row, (name, directions) in zip(axes, images.items(), strict=True):
        for ax, (direction, found) in zip(row, directions.items(), strict=True):
            for values, label, colour in zip(found, found._fields, (GREEN, BLACK, BLUE, ORANGE), strict=True):
                ax.plot(values, color=colour, linewidth=0.8, label=label)
            pixel = "row" if direction == "vertical" else "column"
            ax.set(xlabel=pixel, ylabel="DN", title=f"{direction} profile, {name}")
    figure.legend(*axes[0, 0].get_legend_handles_labels(), loc="outside lower center", ncols=4)
    return figure


def defect_pixels(sheet: EmvaSheet) -> Any:
    """Draw the logarithmic and the accumulated histograms of DSNU and PRNU; None without a series."""
    found = emva_patterns.defect_histograms(sheet)
    if not found:
        return None
    figure, axes = canvas(_WIDTH, 3.4 * len(found), len(found), 2)
    for (left, right), ((name, unit), each) in zip(axes, found.items(), strict=True):
        left.step(each.deviation, each.pixels, where="post", color=BLACK, linewidth=0.9, label="pixels")
        left.plot(each.deviation, each.normal, color=VERMILION, linestyle="--", label="normal distribution")
        left.set(yscale="log", xlabel=f"deviation from the mean ({unit})", ylabel="pixels of a class")
        left.set(title=f"{name}: logarithmic histogram")
        left.set_ylim(0.5, 8 * float(each.pixels.max()))
        left.legend(loc="upper right")
        right.plot(each.distance, each.beyond, color=BLACK)
        right.set(yscale="log", xlabel=f"deviation from the mean, amount ({unit})", ylabel="pixels beyond (%)")
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

    def kept(draw: Draw) -> bytes | None:
        with styled():
            figure = draw(sheet)
        return None if figure is None else drawn(lambda: figure)()

    return {name: png for name, draw in PICTURES.items() if (png := kept(draw)) is not None}


def _saturation(ax: Any, sheet: EmvaSheet, at: float) -> None:
    label = "saturation" if sheet.transfer.saturated else "brightest level: saturation not reached"
    ax.axvline(at, color=VERMILION, linestyle="--", label=label)


def _light(sheet: EmvaSheet) -> str:
    return "light (relative)" if sheet["eta"].value is None else "μ_p (photons per pixel)"


def _straight(x: Any, y: Any) -> Any:
    return np.polyval(np.polyfit(x, y, 1), x)
