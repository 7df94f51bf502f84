"""The protection study: a mask, a grey filter and a smaller stop of equal protection."""

from __future__ import annotations

import math
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import asdict, dataclass
from itertools import pairwise
from typing import Any

import numpy as np

from neusee.workflows.graph.recipe_graph import Recipe
from neusee.workflows.keys.cache_key import digest
from neusee.workflows.protection.equal_rivals import CONTRAST, MEASURES
from neusee.workflows.protection.protection_camera import (
    Condition,
    FrontBench,
    FrontSettings,
    ProtectionCamera,
    UnknownLaws,
    draw_conditions,
)
from neusee.workflows.protection.protection_result import (
    ATTACKED_AT,
    DRAWN,
    LEVELS,
    LIGHTS,
    SHOWN_AT,
    STRENGTHS,
    ProtectionResult,
    measure_protection,
)
from neusee.workflows.report.figures.style import (
    BLACK,
    BLUE,
    GREEN,
    ORANGE,
    VERMILION,
    canvas,
    drawn,
)
from neusee.workflows.report.study_report import SHOWN, Progress, Section, StudyOutcome, StudyReport
from neusee.workflows.store.result_store import Store

# --- protection figures ---------------------------------------------------------------------------

# Pictures of the protection study: where the mask wins, NEQ (noise equivalent quanta) by frequency,
# bounds, and pictures under attack.


_LOOKS: Mapping[str, tuple[str, str]] = {
    "open lens": (BLACK, ":"),
    "grey filter": ("#777777", "-"),
    "stop and filter": (BLUE, "-"),
    "smaller stop": (GREEN, "--"),
    "mask": (VERMILION, "-"),
    "mask and stop": (ORANGE, "-."),
}
_LIGHT = "scene light (e- a pixel)"
_MAP_VALUES = 121  #: number of values along each side of the maps
_COLOUR_LIMIT = 8.0  #: dB, end of the colour scale of the maps


@drawn
def winning_region(result: ProtectionResult) -> Any:
    """Draw how much better the mask is than the best round stop with a grey filter, against scene
    light and protection; hatched where the mask is better.
    """
    figure, axes = canvas(11.6, 4.1, 1, len(DRAWN), sharey=True)
    levels = sorted({result.own, *LEVELS})
    light_axis, level = (
        np.geomspace(min(axis_values), max(axis_values), _MAP_VALUES)
        for axis_values in (LIGHTS, levels)
    )
    for ax, measure in zip(axes[0], DRAWN, strict=True):
        gain = _between(
            levels,
            [
                [result.gain[level][scene_light][measure] for scene_light in LIGHTS]
                for level in levels
            ],
        )
        colour_mesh = ax.pcolormesh(
            light_axis,
            level,
            # limit to the colour scale
            gain.clip(-_COLOUR_LIMIT, _COLOUR_LIMIT),
            cmap="RdBu",
            vmin=-_COLOUR_LIMIT,
            vmax=_COLOUR_LIMIT,
            shading="gouraud",
            rasterized=True,
        )
        # the line on which mask and rival are equal
        if gain.max() > 0 > gain.min():
            ax.contour(light_axis, level, gain, levels=[0.0], colors=BLACK, linewidths=1.4)
        if gain.max() > 0:
            ax.contourf(
                light_axis,
                level,
                gain,
                levels=[0.0, gain.max() + 1],
                colors="none",
                hatches=["//"],
            )
        ax.axhline(result.own, color=BLACK, linewidth=1.0, linestyle="--")
        ax.set(xscale="log", yscale="log", xlabel=_LIGHT, title=MEASURES[measure])
        ax.title.set_fontsize(10)
        ax.grid(False)
    axes[0, 0].set_ylabel("protection: share of the harm\nof the open lens")
    figure.colorbar(
        colour_mesh, ax=list(axes[0]), label="gain of the mask (dB)", pad=0.01, extend="both"
    )
    return figure


def _between(levels: Sequence[float], gain: Sequence[Sequence[float]]) -> Any:
    """Return a gain (level, light) on a finer grid, by linear interpolation in the logarithms of
    level and light.
    """
    log_light, log_level = (
        np.linspace(np.log(min(axis_values)), np.log(max(axis_values)), _MAP_VALUES)
        for axis_values in (LIGHTS, levels)
    )
    # first along the light, then along the level
    at_lights = np.array([np.interp(log_light, np.log(LIGHTS), row) for row in gain])
    return np.array([np.interp(log_level, np.log(levels), column) for column in at_lights.T]).T


@drawn
def gain_with_bounds(result: ProtectionResult) -> Any:
    """Draw the gain of the mask by scene light, with the central 90 % of the draws, and the bound
    of its gain in NEQ.
    """
    figure, axes = canvas(11.0, 4.2, 1, 2)
    gain_axis, bound_axis = axes[0]
    for measure, colour in zip(DRAWN, (BLUE, ORANGE, VERMILION), strict=True):
        low_gain, high_gain = np.quantile(
            [result.drawn[scene_light][measure] for scene_light in LIGHTS], [0.05, 0.95], axis=1
        )
        gain_axis.fill_between(LIGHTS, low_gain, high_gain, color=colour, alpha=0.3, linewidth=0)
        gain_at_own_protection = [
            result.gain[result.own][scene_light][measure] for scene_light in LIGHTS
        ]
        gain_axis.plot(LIGHTS, gain_at_own_protection, color=colour, label=MEASURES[measure])
    gain_axis.axhline(0.0, color=BLACK, linewidth=0.9)
    gain_axis.set(xscale="log", xlabel=_LIGHT, ylabel="gain of the mask (dB)")
    gain_axis.set_title("over the best stop-and-filter, all wavelengths")
    gain_axis.legend()
    # gain and bound, converted to dB
    gain_of_mask, bound = (
        10 * np.log10([result.bound[scene_light][column] for scene_light in LIGHTS])
        for column in (0, 1)
    )
    bound_axis.plot(LIGHTS, gain_of_mask, color=VERMILION, label="this mask")
    bound_axis.plot(
        LIGHTS, bound, color=BLACK, linestyle="--", label="bound of every mask of this peak"
    )
    bound_axis.fill_between(
        LIGHTS,
        bound,
        max(bound) + 3,
        color="#777777",
        alpha=0.2,
        linewidth=0,
        label="no mask can be here",
    )
    bound_axis.axhline(0.0, color=BLACK, linewidth=0.9)
    bound_axis.set(
        xscale="log", xlabel=_LIGHT, ylabel="gain in mean NEQ (dB)", ylim=(None, max(bound) + 3)
    )
    bound_axis.set_title("one wavelength, whole lens band, no glare")
    bound_axis.legend(loc="upper right")
    return figure


@drawn
def neq_by_frequency(result: ProtectionResult) -> Any:
    """Draw the noise equivalent quanta of each rival by spatial frequency, at one scene light."""
    figure, axes = canvas(7.4, 4.8)
    ax = axes[0, 0]
    for name, label in _labels(result).items():
        colour, line_style = _LOOKS[name]
        ax.plot(result.radius, result.curves[name], color=colour, linestyle=line_style, label=label)
    largest_neq = max(map(max, result.curves.values()))
    ax.set(
        yscale="log",
        # eight decades below the largest value
        ylim=(largest_neq * 1e-8, largest_neq * 3),
        xlabel="spatial frequency (cycles a pixel)",
        ylabel="NEQ (e-)",
    )
    ax.set_title(f"quiet frame, {SHOWN_AT:g} e- a pixel: mean over directions")
    figure.legend(*ax.get_legend_handles_labels(), loc="outside lower center", ncols=3)
    return figure


@drawn
def under_attack(result: ProtectionResult) -> Any:
    """Draw information and usable pixels of each rival by laser strength: median and central 90 %
    of the draws.
    """
    figure, axes = canvas(11.0, 4.4, 1, 2)
    for name, label in _labels(result).items():
        colour, line_style = _LOOKS[name]
        _band(axes[0, 0], result.attack[name]["information"], colour, line_style, label)
        _band(
            axes[0, 1],
            [[100 * share for share in row] for row in result.attack[name]["seen"]],
            colour,
            line_style,
            label,
        )
    for ax, axis_label in zip(
        axes[0], ("information (bits a pixel)", "pixels that are not full (%)"), strict=True
    ):
        ax.set(
            xscale="log",
            xlabel="strength of the laser (wells in the brightest pixel, open lens)",
            ylabel=axis_label,
        )
        ax.xaxis.label.set_fontsize(9)
    axes[0, 0].set_yscale("log")
    most_information = max(
        max(map(max, measures["information"])) for measures in result.attack.values()
    )
    axes[0, 0].set_ylim(most_information * 1e-5, most_information * 2)
    figure.legend(*axes[0, 0].get_legend_handles_labels(), loc="outside lower center", ncols=3)
    return figure


def _labels(result: ProtectionResult) -> dict[str, str]:
    """Return the labels of the rivals to draw; if the best stop needs no filter, two rivals share
    one curve.
    """
    labels = {name: name for name in _LOOKS if name in result.rivals}
    stop_and_filter, stop_alone = (
        result.rivals[name].said for name in ("stop and filter", "smaller stop")
    )
    if stop_and_filter == stop_alone:
        del labels["smaller stop"]
        labels["stop and filter"] = "smaller stop, the best stop and filter"
    return labels


def _band(ax: Any, rows: Sequence[Sequence[float]], colour: str, line: str, name: str) -> None:
    """Draw median and central 90 % of the draws (draw, strength) against the strength of
    the laser.
    """
    low_values, median, high_values = np.quantile(
        np.maximum(rows, 1e-12), [0.05, 0.5, 0.95], axis=0
    )
    ax.fill_between(STRENGTHS, low_values, high_values, color=colour, alpha=0.15, linewidth=0)
    ax.plot(STRENGTHS, median, color=colour, linestyle=line, label=name)


# --- protection page ------------------------------------------------------------------------------

# The page of the protection study: a paragraph to quote, the rivals, both questions, and the bound
# of every mask.


def draw_pictures(result: ProtectionResult) -> dict[str, bytes]:
    """Return the pictures of the page by name, as PNG bytes."""
    return {
        "region": winning_region(result),
        "gain": gain_with_bounds(result),
        "neq": neq_by_frequency(result),
        "attack": under_attack(result),
    }


def crossing(gains: Sequence[float]) -> float:
    """Return the scene light at which the gain falls to 0: 0 if it is never positive, infinite if
    it always is.
    """
    if gains[0] <= 0:
        return 0.0
    for (dimmer, gain_before), (brighter, gain_after) in pairwise(zip(LIGHTS, gains, strict=True)):
        if gain_after <= 0:
            # linear in the logarithm of the light
            return float(dimmer * (brighter / dimmer) ** (gain_before / (gain_before - gain_after)))
    return math.inf


def quotable(result: ProtectionResult, camera: str, light: str) -> str:
    """Return one paragraph on where the mask wins and by how much, and where it loses, for both
    questions.
    """
    harm = "peak" if light == "pulse" else "heat"
    parts = [
        f"{camera}: this mask lowers the {harm} of a laser to {result.own:.2g} at the worst"
        f" wavelength. Compared with the best smaller stop and grey filter of the same {harm}, in a"
        " quiet frame:"
    ]
    parts += [f"{_said(result, measure)};" for measure in DRAWN]
    # a full stop in place of the last semicolon
    parts[-1] = parts[-1][:-1] + "."
    shown_rivals = [
        name for name in ("mask", "stop and filter", "grey filter") if name in result.lost
    ]
    halving = ", ".join(
        f"{_interval(result.lost[name], '.1e')} behind the {name}" for name in shown_rivals
    )
    parts.append(
        f"Under attack, at {ATTACKED_AT:g} e- a pixel, half of the information of the quiet frame"
        f" is gone at a strength of {halving}. {_why(result)} Intervals hold 90 % of the draws of"
        " wavelength, direction, defocus, dirt and scattered light."
    )
    return " ".join(parts)


def _said(result: ProtectionResult, measure: str) -> str:
    """Return a phrase on where the mask wins by one measure: medians over the draws, with
    intervals.
    """
    draws = np.array([result.drawn[scene_light][measure] for scene_light in LIGHTS])
    gain = np.median(draws, axis=1)
    # the scene light at which the median gain falls to 0
    light = crossing(gain.tolist())
    if light == 0.0:
        return (
            f"by the {MEASURES[measure]} it loses at every light, by {-gain.max():.1f} dB or more"
        )
    # index of the light with the largest gain
    best = int(gain.argmax())
    by = f"by {gain[best]:.1f} dB ({_ends(draws[best], '.1f')}) at {LIGHTS[best]:g} e- a pixel"
    if math.isinf(light):
        return f"by the {MEASURES[measure]} it wins at every light, {by}"
    # the same light in each draw
    lights = [crossing(row) for row in draws.T.tolist()]
    return (
        f"by the {MEASURES[measure]} it wins below {light:.0f} e- a pixel ({_ends(lights, '.0f')}),"
        f" {by}"
    )


def _why(result: ProtectionResult) -> str:
    """Return a sentence on why a mask gains only in little light, with its bound in much and in
    little light.
    """
    brightest = LIGHTS[-1]
    # element 1 is the bound; in dB
    bound = 10 * math.log10(result.bound[brightest][1])
    dark = 10 * math.log10(result.bound[LIGHTS[0]][1])
    return (
        f"In much light shot noise decides, and no mask of this peak gains more than {bound:.1f} dB"
        f" in mean NEQ over the lens band at {brightest:g} e- a pixel, against {dark:.1f} dB at"
        f" {LIGHTS[0]:g} e-; a mask that spreads a laser over the frame lets a strong one fill"
        " pixels that a filter keeps."
    )


def _interval(values: Sequence[float], form: str) -> str:
    """Return the median of values with the central 90 % as text, in the number format ``form``."""
    return f"{format(float(np.median(values)), form)} ({_ends(values, form)})"


def _ends(values: Any, form: str) -> str:
    """Return the central 90 % of values as text, in the number format ``form``."""
    low_end, high_end = np.quantile(values, [0.05, 0.95], method="nearest")
    return f"{format(float(low_end), form)} to {format(float(high_end), form)}"


def sections(
    result: ProtectionResult, pictures: Mapping[str, bytes], notes: Sequence[str]
) -> list[Section]:
    """Return the sections of the page."""
    return [
        _region(result, pictures["region"]),
        _quiet(result, pictures["gain"]),
        Section(
            "NEQ by frequency",
            "Noise equivalent quanta, (light |OTF|)^2 over the noise, of each rival in a quiet "
            "frame. A value counts as many photons as an ideal sensor would need.",
            picture=pictures["neq"],
        ),
        _attack(result, pictures["attack"]),
        _fields(result),
        _rivals(result),
        Section("What is assumed", "\n\n".join(notes)),
    ]


def _region(result: ProtectionResult, picture: bytes) -> Section:
    """Return the section on where the mask wins."""
    text = f"""Gain in dB of the mask, with the best stop and filter of its own, over the best
        stop-and-filter without a mask, at equal protection. Hatched: the mask wins. The dashed line
        is the protection of the mask alone, {result.own:.3g}. Above this line the mask protects
        more than is asked, and still costs its contrast."""
    return Section("Where the mask wins", text, picture=picture)


def _quiet(result: ProtectionResult, picture: bytes) -> Section:
    """Return the section on the quiet frame: the gain by measure and scene light."""
    text = """Insured: the laser may come, and the frame is quiet. The gain of the mask at its own
        protection. Error: error variance of the Wiener-filtered picture of a natural scene.
        Detection: d' of an ideal observer who knows place and shape. Shaded: the middle 90 % of the
        draws, with a filter that does not know defocus and dirt. On the right, the bound of every
        mask of this peak (Parseval): it holds for one wavelength, for the unweighted mean NEQ over
        the whole lens band and without glare, and not for a part of the band."""
    columns = ("scene light (e-)", *(f"{name} (dB)" for name in MEASURES), "rival by error")
    rows = [
        (
            scene_light,
            *(round(result.gain[result.own][scene_light][measure], 2) for measure in MEASURES),
            result.stops[scene_light].said,
        )
        for scene_light in LIGHTS
    ]
    return Section("Question 1: the everyday picture", text, columns, rows, picture)


def _attack(result: ProtectionResult, picture: bytes) -> Section:
    """Return the section on the information that remains under attack."""
    text = f"""The laser is there, and the scene has {ATTACKED_AT:g} e- a pixel. A strength of 1
        fills one pixel behind the open lens. A pixel that scene and glare fill holds no
        information; in every other pixel glare adds shot noise, fixed-pattern noise and what is
        wrong when glare is subtracted. Lines are medians of the draws, bands the middle 90 %."""
    columns = ("protection", "strength that halves the information", "5 %", "95 %")
    rows = [
        (name, float(np.median(strengths)), *map(float, np.quantile(strengths, [0.05, 0.95])))
        for name, strengths in result.lost.items()
    ]
    return Section("Question 2: under attack", text, columns, rows, picture)


def _fields(result: ProtectionResult) -> Section:
    """Return the section on the share of unsaturated pixels, for fields of several sizes."""
    text = """Share of the pixels in % that are not full, for a laser in the middle of fields of
        several sizes. A wider field is left out where the samples of the recipe's pupil do not
        carry it: `optics=neusee` carries 2048."""
    indices = (4, 8, 11)
    # elements of `STRENGTHS`
    strengths = [10 ** (0.75 * index) for index in indices]
    columns = (
        "protection",
        "field (pixels)",
        *(f"strength {strength:.0e}" for strength in strengths),
    )
    rows = []
    for name, sides in result.fields.items():
        for side, shares in sides.items():
            rows.append((name, side, *(round(100 * shares[index], 2) for index in indices)))
    return Section("Fields", text, columns, rows)


def _rivals(result: ProtectionResult) -> Section:
    """Return the section on the rivals and the errors of their filtered pictures."""
    text = """Each rival of the mask, with the error of the filtered picture (dB below the contrast
        of the scene, more is better). The notch protects at one wavelength only. Tint: the largest
        share of light that a channel receives over the smallest."""
    columns = (
        "rival",
        "made of",
        *(f"error at {scene_light:g} e- (dB)" for scene_light in LIGHTS[::2]),
        "tint",
    )
    rows = [
        (
            name,
            rival.said,
            *(round(result.quiet[name][scene_light]["error"], 2) for scene_light in LIGHTS[::2]),
            result.tint[name],
        )
        for name, rival in result.rivals.items()
    ]
    return Section("Rivals of the same protection", text, columns, rows)


# --- protection study -----------------------------------------------------------------------------

# The protection study: a mask, a grey filter and a smaller stop of equal protection, quiet and
# under attack.


_COLUMNS = ("protection", "scene light", "measure", "gain", "5 %", "95 %")
#: contrast variance of a natural scene; highest frequency (cycles per pixel) in the mean of log NEQ
_VARIANCE, _LOW_FREQUENCIES = 0.1, 0.12
_CONTINUOUS = 0.1  #: s, dwell time of continuous light
_LAWS = UnknownLaws()


@dataclass(frozen=True)
class ProtectionOptions:
    """Number of draws and bands, the kind of laser light, and residual errors of sensor and
    restoration.
    """

    draws: int = 12  #: number of draws of the unknown conditions
    bands: int = 7  #: number of wavelengths of the scene; the laser may have any of the recipe's
    #: ``"pulse"``, harmful by its peak; or ``"continuous"``, harmful by its heat
    light: str = "pulse"
    size: float = 14.0  #: pixels, height of the targets
    prnu: float = 0.01  #: relative spread of the sensitivity of pixels
    residual: float = 0.02  #: relative error of the subtraction of glare


def study(
    recipe: Recipe, store: Store, progress: Progress, options: ProtectionOptions
) -> StudyOutcome:
    """Compare the mask of a recipe with filters and stops of equal protection."""
    light, size = options.light, options.size
    camera = ProtectionCamera.of(recipe, store, options.bands)
    side = min(int(pixels) for pixels in camera.lens["shape"])
    # a text of four letters is nearly four times as wide as high
    if 4 * size > side:
        raise ValueError(
            f"a text {size:g} pixels high is wider than the PSF window of {side}; give a smaller"
            " --size"
        )
    dwell = None if light == "pulse" else _CONTINUOUS
    settings = FrontSettings(_VARIANCE, _LOW_FREQUENCIES, size, (side, 2 * side, 4 * side), dwell)
    bench = FrontBench(camera, store, settings)
    conditions = draw_conditions(options.draws, recipe.seed, _LAWS)
    pixel = camera.pixel(options.prnu, options.residual)
    result = measure_protection(bench, conditions, pixel, progress)
    paragraph = quotable(result, recipe.name, light)
    content = {"light": light, "paragraph": paragraph, **_document(result, conditions)}
    camera_options = {
        "light": light,
        "size": size,
        "prnu": options.prnu,
        "residual": options.residual,
    }
    report = _report(recipe, result, paragraph, _notes(camera, camera_options))
    return StudyOutcome(digest(content["gain"], content["lost"], camera_options), content, report)


def _document(result: ProtectionResult, conditions: Sequence[Condition]) -> dict[str, Any]:
    """Return the numbers of the study as JSON values."""
    return {
        "protection": result.own,
        "draws": [condition.plain for condition in conditions],
        "laws": asdict(_LAWS),
        "rivals": {name: rival.said for name, rival in result.rivals.items()},
        "gain": _texts(result.gain[result.own]),
        "drawn": _texts(result.drawn),
        "quiet": {name: _texts(rows) for name, rows in result.quiet.items()},
        "bound": {
            f"{scene_light:g}": {"gain": gain_and_bound[0], "bound": gain_and_bound[1]}
            for scene_light, gain_and_bound in result.bound.items()
        },
        "largest glare": _texts(result.forbidden),
        "lost": {name: list(rows) for name, rows in result.lost.items()},
        "tint": dict(result.tint),
        "failed": 0,
    }


def _texts(rows: Any) -> dict[str, Any]:
    """Return a mapping with its numeric keys as text, for JSON."""
    return {f"{key:g}": value for key, value in rows.items()}


def _report(
    recipe: Recipe, result: ProtectionResult, said: str, notes: Sequence[str]
) -> StudyReport:
    """Return the page of the study, with its table and the paragraph to quote."""
    pictures = draw_pictures(result)
    return StudyReport(
        f"{recipe.name}: equal protection",
        said,
        sections(result, pictures, notes),
        pictures,
        tables={"table.csv": (_COLUMNS, list(_rows(result)))},
        files={"paragraph.txt": said + "\n"},
        shown=(*SHOWN, "light"),
    )


def _rows(result: ProtectionResult) -> Iterator[Sequence[Any]]:
    """Yield the rows of table.csv: the gain at each protection, scene light and measure."""
    import numpy as np

    for level, lights in result.gain.items():
        for scene_light in LIGHTS:
            for measure in MEASURES:
                interval: Sequence[Any] = ("", "")
                # draws exist only at the mask's own protection
                if level == result.own and measure in DRAWN:
                    interval = np.quantile(
                        result.drawn[scene_light][measure], [0.05, 0.95]
                    ).tolist()
                yield level, scene_light, measure, lights[scene_light][measure], *interval


def _notes(camera: ProtectionCamera, options: dict[str, Any]) -> list[str]:
    """Return the assumptions of the study, one text for each subject."""
    noise = camera.noise
    harm = (
        "peak of the PSF"
        if options["light"] == "pulse"
        else f"heat of the hottest pixel after {_CONTINUOUS:g} s"
    )
    laws_text = ", ".join(f"{name.replace('_', ' ')} {law}" for name, law in asdict(_LAWS).items())
    wavelengths = len(camera.laser_bands.centres)
    return [
        (
            f"Equal protection: the {harm} at the worst of {wavelengths} wavelengths. Sensor: read"
            f" noise {noise['read_noise']:g} e-, well {noise['full_well']:g} e-, PRNU"
            f" {options['prnu']:.1%}, residual glare {options['residual']:.1%} (the share of the"
            " glare that is subtracted wrongly)."
        ),
        (
            "Scene: grey, natural spectrum 1 / frequency^2 with a contrast variance of"
            f" {_VARIANCE:g}. Targets: {options['size']:g} pixels high, contrast {CONTRAST:g}."
            " Every rival is restored by the Wiener filter for its own PSF and its noise."
        ),
        f"Unknown in the draws: {laws_text}. Directions are shares of the field.",
        (
            "Left out: ghosts, blooming, edges of the picture, contrast that scattered light of the"
            " scene takes, a response of the eye, and masks that would be designed for this camera."
        ),
    ]
