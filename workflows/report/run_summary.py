"""The summary of a run: its numbers in tables, and sentences on the benefit and cost of the mask
and on a restored frame.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Container, Mapping
from typing import Any

import torch
from torch import Tensor

from neusee.nodes.spectra import mean_wavelength
from neusee.workflows.engine.result_values import metrics_of, numbers_of, tensor_fields
from neusee.workflows.engine.wanted_steps import BANDS, LINES, RIVAL, TABLE, compared, shade_of
from neusee.workflows.graph.recipe_graph import Recipe
from neusee.workflows.report.figures.camera_pictures import BRIGHT, half_width, unexplained
from neusee.workflows.report.figures.style import nearest

# --- numbers of a run -----------------------------------------------------------------------------

# The expected numbers of the recipe, the result table, and the rows of ``metrics.csv``.

Value = Callable[[str], Any]  #: a function from the name of a step to the value of the step
#: Columns of the result table: the result in `TABLE`, its field, the number of this field and a
#: band, and the format
_COLUMNS: Mapping[str, tuple[str, str, Callable[[Tensor, int], Any], str]] = {
    "peak/I_sat": ("peak/I_sat", "", lambda x, band: x.max(), "{:.4g}"),
    "LSR": ("LSR", "", lambda x, band: x.flatten()[min(band, x.numel() - 1)], "{:.3g}"),
    "BSR": ("BSR", "", lambda x, band: x.double().mean(), "{:.3f}"),
    "outside": ("outside", "", lambda x, band: x.double().mean(), "{:.2%}"),
    "PSNR (dB)": ("quality", "psnr", lambda x, band: x, "{:.2f}"),
    "SSIM": ("quality", "ssim", lambda x, band: x, "{:.3f}"),
    "saturated px": ("saturated", "", lambda x, band: x.double().sum(), "{:,.0f}"),
}
_LEGEND = {
    "LSR": "LSR at {band}",
    "BSR": "BSR, the mean over the bands: the share of the scene's light that stays in the field",
    "outside": (
        "outside, the mean over the bands: the share of a point's light that falls outside the PSF"
        " window"
    ),
}
_DESIGN_WAVELENGTH = 550e-9  #: m, for the LSR in the result table of a recipe without a laser


def expected(recipe: Recipe, value: Value) -> list[dict[str, Any]]:
    """Compare the numbers that a recipe expects with the numbers from the run, and return one
    row for each.
    """
    rows = []
    for expected_number in compared(recipe)[0]:
        result: Any = value(expected_number.step)
        # a text is a field, or a key of a dictionary; a number is an index
        for key in expected_number.at:
            result = (
                getattr(result, key)
                if isinstance(key, str) and not isinstance(result, dict)
                else result[key]
            )
        number = float(result)
        is_within = abs(number - expected_number.value) <= expected_number.rtol * abs(
            expected_number.value
        )
        rows.append(
            {
                "name": expected_number.name,
                "step": expected_number.step,
                "wanted": expected_number.value,
                "found": number,
                "rtol": expected_number.rtol,
                "ok": is_within,
            }
        )
    return rows


def table(recipe: Recipe, keys: Mapping[str, str], value: Value) -> dict[str, Any]:
    """Return the table for plain lens, mask and restored picture, with the rows and columns that
    have numbers.
    """
    _, band_name = _band(recipe, keys, value)
    numbers_by_arm = arms(recipe, keys, value)
    columns = [
        column for column in _COLUMNS if any(column in cells for cells in numbers_by_arm.values())
    ]
    rows = [
        {"name": name, "cells": [_text(cells, c) for c in columns]}
        for name, cells in numbers_by_arm.items()
        if cells
    ]
    legend = [text.format(band=band_name) for column, text in _LEGEND.items() if column in columns]
    return {"columns": columns, "rows": rows, "legend": legend}


def arms(recipe: Recipe, keys: Mapping[str, str], value: Value) -> dict[str, dict[str, float]]:
    """Return the numbers of the plain lens, of the mask and of the restored picture, by column
    of the result table.
    """
    band, _ = _band(recipe, keys, value)
    numbers: dict[str, dict[str, float]] = {}
    for name, cells in TABLE.items():
        results = {column: value(step) for column, step in cells.items() if step in keys}
        numbers[name] = {}
        # (result in `TABLE`, field, function that gives the number, format)
        for column, (source, field, number, _) in _COLUMNS.items():
            result = _field(results.get(source), field)
            if result is not None:
                numbers[name][column] = float(number(result, band))
    return numbers


def lines_of(recipe: Recipe, keys: Container[str]) -> list[str]:
    """Return the steps among ``keys`` that give the spectral line of a laser whose strength is
    not 0.
    """
    strengths = {
        # line[green] has the strength of the laser green
        name: recipe.config.values.get(f"lasers.{name[5:-1]}.strength")
        for name in _lines(recipe, keys)
    }
    return [name for name, strength in strengths.items() if strength != 0]


def suppressed(recipe: Recipe, keys: Mapping[str, str], value: Value) -> dict[str, float]:
    """Return the LSR of the mask at the wavelength of each laser that shines, by wavelength in
    nm as text.
    """
    step = TABLE["with mask"]["LSR"]
    if step not in keys or BANDS not in keys:
        return {}
    lsr, centres = value(step).flatten(), value(BANDS).centres
    bands_of_lasers = (
        nearest(centres, mean_wavelength(value(line))) for line in lines_of(recipe, keys)
    )
    # an LSR of one band is that of every laser
    return {name: float(lsr[min(band, lsr.numel() - 1)]) for band, name in bands_of_lasers}


def _field(result: Any, field: str) -> Tensor | None:
    """Return the field ``field`` of a result, or its first field for an empty name, or None if
    the field is missing.
    """
    fields = {} if result is None else dict(tensor_fields(result))
    return fields.get(field) if field else next(iter(fields.values()), None)


def _text(cells: Mapping[str, float], column: str) -> str:
    """Return a number of the result table as text, or an empty text if the table has no number
    there.
    """
    # the format is the last entry
    return _COLUMNS[column][3].format(cells[column]) if column in cells else ""


def _band(recipe: Recipe, keys: Mapping[str, str], value: Value) -> tuple[int, str]:
    """Return index and name of the spectral band nearest to the first laser, or to 550 nm if
    there is no laser.
    """
    if BANDS not in keys:
        return 0, "the first band"
    lines = _lines(recipe, keys)
    wavelength = mean_wavelength(value(lines[0])) if lines else _DESIGN_WAVELENGTH
    bands = value(BANDS)
    band, name = nearest(bands.centres, wavelength)
    if abs(float(bands.centres[band]) - wavelength) > float(bands.widths[band]):
        name += f", the band nearest to the laser at {wavelength * 1e9:.0f} nm"
    return band, name


def _lines(recipe: Recipe, keys: Container[str]) -> list[str]:
    """Return the steps among ``keys`` that give the spectral line of a laser."""
    prefix = LINES.removesuffix("*]")
    return [name for name in recipe.steps if name.startswith(prefix) and name in keys]


def metrics(recipe: Recipe, keys: Mapping[str, str], value: Value) -> list[list[Any]]:
    """Return the rows (step, field, index, value) of ``metrics.csv``, one for each number that a
    metric gave.
    """
    rows: list[list[Any]] = []
    for name in metrics_of(recipe, keys):
        rows += numbers_of(name, value(name))
    return rows


# --- mask story -----------------------------------------------------------------------------------

# Benefit and cost of a mask, filter or stop in a run, in sentences with the numbers of the run, and
# its rival: a grey filter with the same laser suppression.


SENTENCES = ("buys", "irradiance", "costs", "rival", "frame")
PLAIN, MASK, RESTORED = "plain lens", "with mask", "restored"
_PEAK, _QUALITY, _LOST = "peak/I_sat", "PSNR (dB)", "saturated px"
_EQUAL = 0.01  #: relative difference of two peaks below which the mask changes nothing
_UNSUPPRESSED_LSR = 0.9  #: LSR above which no grey filter is suggested in place of the mask
_TIMES = 2.0  #: ratio of two peaks below which their difference is stated in percent

Arm = Mapping[str, float]
_WHERE = {PLAIN: "behind the plain lens", MASK: "behind the mask"}  #: words of the two arms
_PREFIXES = {-9: "n", -6: "u", -3: "m", 0: "", 3: "k", 6: "M", 9: "G"}


def story(recipe: Recipe, keys: Mapping[str, str], value: Value) -> dict[str, Any]:
    """Return the sentences on the benefit and cost of the mask of a run, and their numbers; nothing
    unless the run has both plain lens and mask.
    """
    numbers = {name: _known(cells) for name, cells in arms(recipe, keys, value).items()}
    lsr = suppressed(recipe, keys, value)
    texts = sentences(numbers, lsr, bool(lines_of(recipe, keys)), element(recipe))
    has_damage = any(name.partition("[")[0] == "damage" for name in recipe.steps)
    # without a sentence on the mask no other one is said
    texts |= irradiance(_laser_peaks(keys, value), has_damage) if texts else {}
    # a filter or a stop is itself such a rival
    texts |= {} if shade_of(recipe) or not texts else rival(lsr, numbers)
    return {
        **texts,
        "numbers": {name: numbers[name] for name in numbers if texts},
        "lsr": lsr if texts else {},
    }


def element(recipe: Recipe) -> str:
    """Return the name of the element that the run compares with the plain lens: a mask, a stop, a
    filter, several of these, or a flat plate.
    """
    height_step, shade_step = recipe.steps.get("height"), recipe.steps.get(shade_of(recipe) or "")
    elements = [] if height_step and height_step.node.path == "doe.flat" else ["mask"]
    if shade_step:
        parameter_of_kind = {"smaller stop": "diameter", "grey filter": "transmittance"}
        elements += [
            kind for kind, name in parameter_of_kind.items() if shade_step.params.get(name, 1.0) < 1
        ]
        elements += ["notch filter"] * bool(shade_step.params.get("notches"))
    return " and ".join(elements) or "flat plate"


def sentences(
    numbers: Mapping[str, Arm], lsr: Mapping[str, float], laser: bool, element: str = "mask"
) -> dict[str, str]:
    """Return the sentences ``buys`` and ``costs`` from the numbers of plain lens, mask and restored
    picture.

    ``lsr`` has the laser suppression ratio of the mask by wavelength of each laser. ``laser`` is
    False if no laser shines. ``element`` is what stands in place of the mask, such as ``grey
    filter``. A sentence whose numbers a run does not have for both the plain lens and the mask is
    left out.
    """
    plain, mask = numbers.get(PLAIN, {}), numbers.get(MASK, {})
    if not plain or not mask:
        return {}
    restored = numbers.get(RESTORED, {})
    texts = _buys(plain, mask, lsr, laser, element), _costs(plain, mask, restored, laser, element)
    return {name: text for name, text in zip(("buys", "costs"), texts, strict=True) if text}


def irradiance(peaks: Mapping[str, float], judged: bool) -> dict[str, str]:
    """Return the sentence ``irradiance``: the irradiance of the lasers in the brightest pixel in
    W/cm2, which a multiple of saturation does not replace.

    ``peaks`` are in W/m2, by plain lens and mask. ``judged`` is True for a recipe that compares
    them with thresholds.
    """
    densities = [
        f"{_density(peaks[name])} {words}"
        for name, words in _WHERE.items()
        if peaks.get(name, 0.0) > 0
    ]
    if not densities:
        return {}
    damage = (
        "the step `damage` compares them"
        if judged
        else "`damage: published` and `neusee safety` compare them"
    )
    text = (
        f"The lasers have {' and '.join(densities)} there: {damage} with the thresholds that are"
        " known"
    )
    return {"irradiance": f"{text}, and a multiple of saturation is not a measure of damage."}


def _laser_peaks(keys: Mapping[str, str], value: Value) -> dict[str, float]:
    """Return the irradiance (W/m2) of all lasers in the brightest pixel, behind the plain lens and
    behind the mask.
    """
    steps = {name: TABLE[name][_PEAK] for name in (PLAIN, MASK)}
    peaks = {name: value(step) for name, step in steps.items() if step in keys}
    return {name: float(peak.laser) for name, peak in peaks.items() if hasattr(peak, "laser")}


def _density(value: float) -> str:
    """Return an irradiance in W/m2 as text in W/cm2 with an SI prefix."""
    # the largest multiple of 3 below the logarithm of the W/cm2
    exponent = min(max(3 * math.floor(math.log10(value * 1e-4) / 3), -9), 9)
    return f"{value * 1e-4 / 10.0**exponent:.3g} {_PREFIXES[exponent]}W/cm2"


def rival(lsr: Mapping[str, float], numbers: Mapping[str, Arm]) -> dict[str, str]:
    """Return the sentence ``rival`` on the grey filter that weakens each laser at least as much as
    the mask; nothing if the mask hardly weakens one of them.

    It states the picture quality behind this filter if the run computed it, or else the command
    that computes it.
    """
    largest_lsr = max(lsr.values(), default=1.0)
    if largest_lsr >= _UNSUPPRESSED_LSR:
        return {}
    text = f"A grey filter that passes {largest_lsr:.3g} of the light weakens the laser as much: "
    command = f"doe=grey_filter doe.transmittance={largest_lsr:.3g}"
    grey_filter, restored = numbers.get(RIVAL, {}), numbers.get(RESTORED, {})
    if _QUALITY not in grey_filter:
        return {"rival": f"{text}for its picture, restored alike, run this recipe with {command}."}
    comparison = (
        f" against {restored[_QUALITY]:.1f} dB behind the mask" if _QUALITY in restored else ""
    )
    picture = (
        "its picture, restored by a Wiener filter, has a PSNR of"
        f" {grey_filter[_QUALITY]:.1f} dB{comparison}"
    )
    count = (
        "no pixel saturates"
        if not grey_filter.get(_LOST)
        else f"{grey_filter[_LOST]:,.0f} pixels saturate"
    )
    return {"rival": f"{text}{picture}{f'; {count}' if _LOST in grey_filter else ''} ({command})."}


def _known(cells: Arm) -> dict[str, float]:
    """Return the numbers of plain lens, mask or restored picture without NaN, which stands for an
    unknown number.
    """
    return {name: number for name, number in cells.items() if not math.isnan(number)}


def _buys(plain: Arm, mask: Arm, lsr: Mapping[str, float], laser: bool, element: str) -> str:
    """Return a sentence with the irradiance of the brightest pixel without and with the mask,
    and the LSR.
    """
    if not (plain.get(_PEAK, 0.0) > 0 and mask.get(_PEAK, 0.0) > 0):
        return _suppression(lsr, element)
    peak_ratio = plain[_PEAK] / mask[_PEAK]
    ends = f"{_number(mask[_PEAK])} in place of {_number(plain[_PEAK])} times saturation"
    if abs(peak_ratio - 1) < _EQUAL:
        change = f"the brightest pixel receives as much light as behind the plain lens ({ends}"
    else:
        word, ratio = ("less", peak_ratio) if peak_ratio > 1 else ("more", 1 / peak_ratio)
        amount = (
            f"{_number(ratio)} times"
            if ratio >= _TIMES
            else f"{100 * abs(1 / peak_ratio - 1):.0f} %"
        )
        change = (
            f"the brightest pixel receives {amount} {word} light than behind the plain lens ({ends}"
        )
    if not laser:
        return f"No laser shines here, whose peak the {element} could lower: {change})."
    return f"{_lowered(peak_ratio, element)}: {change}{'; ' * bool(lsr)}{_ratios(lsr)})."


def _lowered(less: float, element: str) -> str:
    """Return a clause on whether a mask lowers the peak on the sensor; ``less`` is the peak behind
    the plain lens over that behind the mask.
    """
    is_plural = _several(element)
    if abs(less - 1) < _EQUAL:
        return f"The {element} {'do' if is_plural else 'does'} not change the peak on the sensor"
    if less < 1:
        return f"The {element} {'raise' if is_plural else 'raises'} the peak on the sensor"
    weakly = "" if less >= _TIMES else " a little"
    return f"The {element} {'lower' if is_plural else 'lowers'} the peak on the sensor{weakly}"


def _suppression(lsr: Mapping[str, float], element: str) -> str:
    """Return a sentence with the LSR of the mask alone, for a run that does not compute the
    irradiance.
    """
    if not lsr:
        return ""
    gain_text = "a weaker laser" if max(lsr.values()) < 1 - _EQUAL else "no weaker laser here"
    verb = "buy" if _several(element) else "buys"
    return f"The {element} {verb} {gain_text}: {_ratios(lsr)} of the peak behind the clear lens."


def _ratios(lsr: Mapping[str, float]) -> str:
    """Return the laser suppression ratio of a laser, or the least and the largest of several
    lasers, as text.
    """
    if not lsr:
        return ""
    wavelengths = sorted(lsr, key=lsr.__getitem__)
    least_text, most_text = (
        f"{lsr[name]:.3g} at {name}" for name in (wavelengths[0], wavelengths[-1])
    )
    return f"LSR {least_text}" if len(lsr) == 1 else f"LSR from {least_text} to {most_text}"


def _costs(plain: Arm, mask: Arm, restored: Arm, laser: bool, element: str) -> str:
    """Return a sentence with the picture quality and the saturated pixels without and with the
    mask.
    """
    texts = _picture(plain, mask, restored, element), _saturation(plain, mask, laser, element)
    sentences_with_numbers = [sentence for sentence in texts if sentence]
    return f"{'; '.join(sentences_with_numbers)}." if sentences_with_numbers else ""


def _picture(plain: Arm, mask: Arm, restored: Arm, element: str) -> str:
    """Return the PSNR of plain lens, mask and restored picture, and whether the mask costs quality;
    empty if a number is unknown.
    """
    if _QUALITY not in plain or _QUALITY not in mask:
        return ""
    # PSNR behind the plain lens, behind the mask, and after restoration
    plain_psnr, mask_psnr, restored_psnr = (
        arm.get(_QUALITY, -math.inf) for arm in (plain, mask, restored)
    )
    end = f", and {restored_psnr:.1f} dB after restoration" if _QUALITY in restored else ""
    text = (
        f"PSNR {plain_psnr:.1f} dB with the plain lens{',' if end else ' and'}"
        f" {mask_psnr:.1f} dB with the {element}{end}"
    )
    verb = "cost" if _several(element) else "costs"
    if mask_psnr >= plain_psnr:
        return f"The {element} {verb} no picture quality here: {text}"
    return (
        f"The {element} {verb} picture"
        f" quality{', which restoration wins back' if restored_psnr >= plain_psnr else ''}: {text}"
    )


def _saturation(plain: Arm, mask: Arm, laser: bool, element: str) -> str:
    """Return how many pixels saturate with the mask and with the plain lens, and whether a laser
    dazzles a larger area with the mask.
    """
    if _LOST not in plain or _LOST not in mask:
        return ""
    with_mask, without_mask = (f"{arm[_LOST]:,.0f}" for arm in (mask, plain))
    if with_mask == without_mask == "0":
        return "no pixel saturates"
    same_text = f"{with_mask} pixels saturate with and without the {element}"
    text = (
        same_text
        if with_mask == without_mask
        else f"{with_mask} pixels saturate with the {element}, {without_mask} without"
    )
    enlargement = mask[_LOST] / plain[_LOST] if laser and plain[_LOST] > 0 else 0.0
    verb = "enlarge" if _several(element) else "enlarges"
    return (
        f"{text}: the {element} {verb} the dazzled area {_number(enlargement)} times"
        if enlargement > 1 + _EQUAL
        else text
    )


def _several(element: str) -> bool:
    """Return True for a mask with a filter or stop, which takes a verb in the plural."""
    return " and " in element


def _number(value: float) -> str:
    """Return a positive number as text with three digits or, from 1000 on, as a whole number
    with commas.
    """
    return f"{value:.3g}" if value < 999.5 else f"{value:,.0f}"


# --- frame story ----------------------------------------------------------------------------------

# Uncertainty of a restored frame, in sentences with the numbers of the run: invented pixels, and
# the interval.


_NEEDS = ("restored", "restored_spread", "raw[mask]", "clipped[mask]")
_FRAME = "sensor.frame"
_WIENER = ("restore.wiener", "restore.wiener_by_field")  #: filters that the interval describes
_MEASURED = "restore.spread_by_field"


def said_of_frame(recipe: Recipe, keys: Mapping[str, str], value: Value) -> dict[str, str]:
    """Return the paragraph ``frame`` on the uncertainty of a restored frame; nothing for a run
    without a frame.
    """
    if not keys.keys() >= set(_NEEDS) or recipe.steps["raw[mask]"].node.path != _FRAME:
        return {}
    restored, spread, _, clipped = (value(step) for step in _NEEDS)
    if restored.shape != spread.shape:
        return {}
    invented = clipped.any(0)
    half_widths = half_width(spread, recipe.steps["restored_spread"].params["draws"])
    name = recipe.steps["raw[mask]"].params["file"].name
    paragraph = [
        _invented(name, invented),
        _interval(half_widths, invented),
        _doubtful(restored, half_widths, invented),
    ]
    paragraph.append(_limits(recipe))
    return {"frame": " ".join(sentence for sentence in paragraph if sentence)}


def _invented(name: str, invented: Tensor) -> str:
    """Return a sentence on the number of saturated pixels of a frame, which are invented."""
    count, share = int(invented.sum()), float(invented.double().mean())
    if not count:
        return (
            f"No pixel of {name} is saturated, so that nothing in the restored picture is invented."
        )
    are = "pixel is" if count == 1 else "pixels are"
    return (
        f"In {name} {count:,} {are} saturated in at least one channel, {share:.2%} of the picture:"
        " what stands there is invented from the surroundings and the prior of the filter (orange"
        " in the figure, white in data/invented.png)."
    )


def _interval(half: Tensor, invented: Tensor) -> str:
    """Return a sentence on the half width of the interval in the other pixels; empty if there are
    none.
    """
    if bool(invented.all()):
        return ""
    mean_widths = half.mean(0)[~invented].flatten()
    # at most about a million pixels, which `quantile` can sort
    mean_widths = mean_widths[:: max(1, len(mean_widths) // 1_000_000)].double()
    median, upper_width = (float(torch.quantile(mean_widths, quantile)) for quantile in (0.5, 0.95))
    return (
        f"Elsewhere a restored pixel is known to ±{median:.2g} of white in half of the pixels and"
        f" to ±{upper_width:.2g} in 95 % of them, with a probability of 90 % under the model of the"
        " interval."
    )


def _doubtful(restored: Tensor, half: Tensor, invented: Tensor) -> str:
    """Return a sentence on the pixels that no scene can explain, if there are more than chance
    makes.
    """
    unexplained_pixels = unexplained(restored, half, invented)
    count = int(unexplained_pixels.sum())
    # chance makes a few
    if float(unexplained_pixels.double().mean()) < 1e-3 and count < 20:
        return ""
    return (
        f"{count:,} other pixels are restored darker than black or brighter than {BRIGHT:g} times"
        " white, by more than this interval (red in the figure): no scene explains them, and the"
        " model does not hold there. Either light of a laser or a lamp was taken for scene, or"
        " white is set too low (frame.white). Do not trust them or their surroundings;"
        " restore=search finds lasers and removes them."
    )


def _limits(recipe: Recipe) -> str:
    """Return what the interval of a restored frame includes and excludes."""
    restoring_step = recipe.steps.get("deconvolved")
    is_own_filter = (
        restoring_step is not None
        and restoring_step.node.path in _WIENER
        and "deconvolved" in recipe.steps["restored"].sources
    )
    whose = (
        ""
        if is_own_filter
        else (
            "The interval is that of a Wiener filter, not of the method that restored this"
            " picture. "
        )
    )
    has_measured_psf = recipe.steps["restored_spread"].node.path == _MEASURED
    blur = "blur, the error of the measured PSF" if has_measured_psf else "blur"
    return (
        f"{whose}The interval includes noise, {blur} and saturation. It does not include lasers"
        " that the filter is not told of, errors of the camera's description, and colours that no"
        " three channels tell apart."
    )
