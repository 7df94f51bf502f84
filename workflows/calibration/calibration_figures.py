"""The pictures of a calibration: transfer curve, rings, corner plot and chains."""

from __future__ import annotations

import textwrap
from collections.abc import Sequence
from typing import TYPE_CHECKING, Any

import numpy as np

from neusee.nodes.calibrate import Rings, Sufficient
from neusee.nodes.values import Levels
from neusee.workflows.calibration.identifiability import words_of
from neusee.workflows.calibration.posterior_checks import is_camera
from neusee.workflows.report.figures.style import BLACK, BLUE, ORANGE, VERMILION, canvas, drawn
from neusee.workflows.report.study_page import Section

if TYPE_CHECKING:
    from numpy.typing import NDArray

    from neusee.workflows.calibration.calibration_page import CalibrationResult
    from neusee.workflows.calibration.log_posterior import FloatArray


# --- calibration figures --------------------------------------------------------------------------

# The pictures of a calibration: photon-transfer curve, rings about a source, and traces of the
# chains.


_BAND = (5.0, 50.0, 95.0)  #: percentiles
_POINTS = 1500  #: most points of a chain in the picture
_LEAST = 0.1  #: DN², the variance at which a level without scatter is drawn
_CLIPPED = {"marker": "v", "color": VERMILION, "markerfacecolor": "none"}
COUNTED = "clipped or coarse: numbers counted one by one; variance at most as drawn"


@drawn
def transfer(
    measured: FloatArray,
    predicted: FloatArray,
    unclipped: NDArray[np.bool_],
    other: str,
    means: FloatArray | None = None,
) -> Any:
    """Draw the photon-transfer curve, and the deviation of each light level from the posterior's
    prediction.

    ``measured`` (2, level) has mean and variance, and ``predicted`` (2, draw, level) mean and
    variance of a repeated measurement. ``unclipped`` (level,) is False for levels without a
    prediction, which the label ``other`` describes. ``means`` (level,) are the deviations of the
    means from the light in standard deviations, if the light is uncertain.
    """
    rows = 2 if means is None else 3
    figure, axes = canvas(
        9.0, 4.8 + 1.2 * rows, rows, 1, sharex=True, height_ratios=(2.2, *(rows - 1) * (1.0,))
    )
    above = axes[0, 0]
    order = np.flatnonzero(unclipped)[np.argsort(predicted[0].mean(0)[unclipped])]
    mean = predicted[0].mean(0)[order]
    low, middle, high = np.percentile(predicted[1], _BAND, axis=0)[:, order]
    above.fill_between(
        mean, low, high, color=BLUE, alpha=0.25, linewidth=0, label="predicted, 90 %"
    )
    above.plot(mean, middle, color=BLUE, linewidth=1.2, label="predicted, median")
    lowest = max(_LEAST, 0.5 * float(min([*measured[1, unclipped], *middle], default=_LEAST)))
    for shown, style in (
        (unclipped, {"marker": "o", "color": BLACK, "label": "measured"}),
        (~unclipped, {**_CLIPPED, "label": other}),
    ):
        if shown.any():
            above.plot(
                measured[0, shown],
                measured[1, shown].clip(lowest),
                linestyle="",
                markersize=5,
                **style,
            )
    above.set(
        xscale="log", yscale="log", ylabel="temporal variance (DN²)", title="Photon-transfer curve"
    )
    above.set_ylim(bottom=lowest / 2)  # a clipped level does not stretch the axis
    above.legend(loc="upper left")
    distance = (measured[1, unclipped] - predicted[1].mean(0)[unclipped]) / predicted[1].std(0)[
        unclipped
    ]
    _distances(axes[1, 0], measured[0, unclipped], distance, "variance: distance\nin sd")
    if means is not None:
        _distances(axes[2, 0], measured[0, unclipped], means[unclipped], "mean: distance\nin sd")
    axes[-1, 0].set_xlabel("mean (DN)")
    return figure


def _distances(ax: Any, places: FloatArray, distance: FloatArray, label: str) -> None:
    """Draw distances from a prediction in standard deviations, over a band of two standard
    deviations.
    """
    ax.axhspan(-2, 2, color=BLUE, alpha=0.12, linewidth=0)
    ax.axhline(0, color=BLUE, linewidth=1.0)
    ax.plot(places, distance, "o", color=BLACK, markersize=5)
    reach = max(3.5, 1.1 * float(np.abs(distance).max(initial=0.0)))
    ax.set(ylabel=label, ylim=(-reach, reach))


@drawn
def rings(
    radius: FloatArray,
    cut: FloatArray,
    measured: FloatArray,
    predicted: FloatArray,
    variance: FloatArray,
) -> Any:
    """Draw the signal of the rings about an overexposed source over the radius, and its deviation
    from the prediction.

    ``measured`` (ring,) and ``predicted`` and ``variance`` (draw, ring) are electrons of a pixel
    and their squares; ``cut`` (cut,) are the radii of the rings that are cut off.
    """
    figure, axes = canvas(9.0, 7.2, 2, 1, sharex=True, height_ratios=(2.2, 1.0))
    above, below = axes[0, 0], axes[1, 0]
    low, middle, high = np.percentile(predicted, _BAND, axis=0)
    above.fill_between(
        radius, low, high, color=BLUE, alpha=0.25, linewidth=0, label="predicted, 90 %"
    )
    above.plot(radius, middle, color=BLUE, linewidth=1.2, label="predicted, median")
    positive = measured > 0
    above.plot(
        radius[positive], measured[positive], "o", color=BLACK, markersize=4, label="measured"
    )
    if len(cut):
        ends = float(cut.min()) - 0.5, float(cut.max()) + 0.5  # a ring is one pixel wide
        above.axvspan(*ends, color=VERMILION, alpha=0.3, linewidth=0, label="cut off")
    above.set(
        xscale="log", yscale="log", ylabel="signal (e- of a pixel)", title="Rings about the source"
    )
    above.legend(loc="lower left")
    width = np.sqrt(predicted.var(0) + variance.mean(0))
    _distances(
        below, radius, (measured - predicted.mean(0)) / width, "distance in sd\nof the prediction"
    )
    below.set_xlabel("distance from the source (pixels)")
    below.xaxis.set_major_formatter("{x:g}")
    below.xaxis.set_minor_formatter("{x:g}")
    return figure


@drawn
def traces(draws: FloatArray, labels: Sequence[str]) -> Any:
    """Draw a trace plot of each coordinate: the median and the middle 90 % of the walkers of
    each ensemble.
    """
    count = len(labels)
    figure, axes = canvas(9.0, 1.35 * count + 0.5, count, 1, sharex=True)
    every = max(1, draws.shape[1] // _POINTS)
    for i, label in enumerate(labels):
        ax = axes[i, 0]
        for ensemble, colour in zip(
            draws[:, ::every, :, i], (BLUE, ORANGE, "#009E73", VERMILION), strict=False
        ):
            low, middle, high = np.percentile(ensemble, _BAND, axis=1)
            steps = np.arange(len(middle)) * every
            ax.fill_between(steps, low, high, color=colour, alpha=0.12, linewidth=0)
            ax.plot(steps, middle, color=colour, linewidth=0.8)
        ax.set_ylabel(label, fontsize=9, rotation=0, ha="right", va="center", labelpad=8)
        ax.ticklabel_format(axis="y", useOffset=False)
    axes[-1, 0].set_xlabel("step after the discarded steps")
    return figure


# --- corner figure --------------------------------------------------------------------------------

# A corner plot: the draws of each parameter, and of every pair of parameters, in a triangle of
# panels.
#
# The package `corner` draws the same picture; it makes all panels of the square and hides half,
# which takes three times as long for ten parameters.


_PAGE = 11.4  #: inches, the width of the page at 100 pixels an inch
_WIDEST = 13  #: characters of a line of a label
#: quantiles, so that a single draw does not squeeze a panel of the corner plot
_NEARLY_ALL = (0.005, 0.995)
_BINS = 20  #: of each side of a panel
#: shares of the draws inside the contours
_LEVELS = 1 - np.exp(-0.5 * np.array([0.5, 1.0, 1.5, 2.0]) ** 2)
#: inches of a panel, of the margin with the labels, and between panels
_SIZE, _LEFT, _GAP = 1.75, 0.9, 0.06


@drawn
def corners(draws: FloatArray, names: Sequence[str], nominal: Sequence[float]) -> Any:
    """Draw a corner plot of all pairs of parameters, with the recipe's own values in orange."""
    from matplotlib.backends.backend_agg import FigureCanvasAgg
    from matplotlib.figure import Figure

    count = len(names)
    size = _SIZE * count + _LEFT
    text = 10 * max(1.0, size / _PAGE)  # a large picture is shrunk to the width of the page
    figure = Figure(figsize=(size, size), dpi=100)
    FigureCanvasAgg(figure)
    ranges = _ranges(draws, nominal)
    for row in range(count):
        for column in range(row + 1):
            left, low = _LEFT + _SIZE * column, _LEFT + _SIZE * (count - 1 - row)
            ax = figure.add_axes(
                (left / size, low / size, (_SIZE - _GAP) / size, (_SIZE - _GAP) / size)
            )
            _panel(
                ax,
                draws[:, [column, row]],
                [ranges[column], ranges[row]],
                (nominal[column], nominal[row]),
            )
            below = names[column] if row == count - 1 else ""
            beside = names[row] if column == 0 < row else ""
            _labelled(ax, below, beside, text)
    return figure


def _panel(
    ax: Any, pair: FloatArray, ends: Sequence[tuple[float, float]], own: tuple[float, float]
) -> None:
    """Draw the histogram of one parameter, or the histogram of two with its contours, and the
    recipe's own values.
    """
    ax.grid(False)
    ax.set_xlim(ends[0])
    ax.axvline(own[0], color=ORANGE, linewidth=1.0)
    if np.array_equal(pair[:, 0], pair[:, 1]):
        ax.stairs(*np.histogram(pair[:, 0], _BINS, ends[0]), color=BLUE)
        ax.set(yticks=[], ylim=(0, None))
        return
    counts, x, y = np.histogram2d(pair[:, 0], pair[:, 1], _BINS, np.array(ends))
    ax.imshow(
        counts.T, origin="lower", extent=(*ends[0], *ends[1]), aspect="auto", cmap="Blues", vmin=0
    )
    heights = _heights(counts)
    if len(heights):
        middle = [0.5 * (edges[1:] + edges[:-1]) for edges in (x, y)]
        ax.contour(*middle, counts.T, levels=heights, colors=BLUE, linewidths=0.8)
    ax.axhline(own[1], color=ORANGE, linewidth=1.0)
    ax.set_ylim(ends[1])


def _heights(counts: FloatArray) -> FloatArray:
    """Return the counts of a cell above which the shares `_LEVELS` of all draws lie, rising and
    different.
    """
    rising = np.sort(counts.ravel())[::-1]
    index = np.searchsorted(np.cumsum(rising), _LEVELS * rising.sum())
    heights = np.unique(rising[index.clip(max=len(rising) - 1)])
    inside: FloatArray = heights[(heights > 0) & (heights < rising[0])]
    return inside


def _labelled(ax: Any, below: str, left: str, text: float) -> None:
    from matplotlib.ticker import MaxNLocator, ScalarFormatter

    for axis, label in ((ax.xaxis, below), (ax.yaxis, left)):
        if not label:
            axis.set_ticks([])
            continue
        axis.set_major_locator(MaxNLocator(3, prune="lower"))
        axis.set_major_formatter(ScalarFormatter(useOffset=False))
        axis.set_tick_params(labelsize=0.9 * text, labelrotation=45)
        axis.set_label_text(_wrapped(label), fontsize=text)


def _wrapped(label: str) -> str:
    """Return a label with its lines broken between words, so that it is no wider than a panel."""
    return "\n".join(textwrap.fill(line, _WIDEST) for line in label.splitlines())


def _ranges(draws: FloatArray, nominal: Sequence[float]) -> list[tuple[float, float]]:
    """Return the range of each parameter in the corner plot: nearly all draws, and the recipe's
    value if among them.
    """
    ends = np.quantile(draws, _NEARLY_ALL, axis=0).T
    rim = 0.1 * (ends[:, 1] - ends[:, 0])
    shown = np.column_stack([ends[:, 0] - rim, ends[:, 1] + rim]).clip(
        draws.min(0)[:, None], draws.max(0)[:, None]
    )
    own = np.asarray(nominal)
    inside = (own >= draws.min(0)) & (own <= draws.max(0))
    low = np.where(inside, np.minimum(shown[:, 0], own), shown[:, 0])
    high = np.where(inside, np.maximum(shown[:, 1], own), shown[:, 1])
    return [
        (float(a), float(b)) if b > a else (float(a) - 0.5, float(a) + 0.5)
        for a, b in zip(low, high, strict=True)
    ]


# --- picture sections -----------------------------------------------------------------------------

# The sections of a calibration's page with its pictures: curve or rings, parameters in pairs, and
# chains.


_PREDICTED = 400  #: draws for the band of the predicted variance
_COUNTED = """The measured variance of each level against its mean, and the prediction of the
    posterior for a repeated measurement, before corrections for what the frames show or may hide.
    If a level is clipped by the well or the converter, or too coarse for a mean and a variance,
    each of its digital numbers enters the likelihood, and the level has no prediction here."""
_EXCLUDED = """The measured variance of each level against its mean, and the prediction of the
    posterior for a repeated measurement, before corrections for what the frames show or may hide.
    Below it, how far each variance, and each mean from what the stated light gives, lies from the
    prediction. Levels above {share}, and levels that are clipped, are not used and have no
    prediction."""
_CORNER = 20_000  #: draws for the picture of pairs


def curve_section(result: CalibrationResult) -> Section:
    """Return the section with the photon-transfer curve, or with the rings about a point source."""
    if isinstance(result.problem.levels, Rings):
        return _rings(result, result.problem.levels)
    levels: Any = result.problem.levels
    mean, variance, away = _repeated(result)
    unclipped: NDArray[np.bool_] = np.asarray((variance > 0).all(0))
    unclipped[levels.cell_level.numpy()] = False
    text, label = _COUNTED, COUNTED
    if is_camera(result.problem):
        share = f"{result.params['share']:.0%} of saturation"
        text, label = _EXCLUDED.format(share=share), f"not used: above {share}, or clipped"
    picture = transfer(
        np.stack(_moments(levels)), np.stack([mean, variance]), unclipped, label, away
    )
    return Section("Photon-transfer curve", text, picture=picture)


def _repeated(result: CalibrationResult) -> tuple[FloatArray, FloatArray, FloatArray | None]:
    """Return mean and variance (draw, level) of a repeated measurement, with what scatters beyond
    chance.

    For a real camera also the distances (level,) of the means from those that the light gives, in
    standard deviations.
    """
    rng = np.random.default_rng(1)
    flat = result.walked.flat
    drawn = flat[rng.integers(len(flat), size=_PREDICTED)]
    levels: Any = result.problem.levels
    look = result.problem.likelihood(drawn)
    freedom = levels.degrees_of_freedom.numpy().clip(1)
    values = {**result.params, **result.problem.parameters(drawn)}
    scatter = np.broadcast_to(np.asarray(values.get("scatter", 0.0)), len(drawn))
    width = np.sqrt(2 / freedom + scatter[:, None] ** 2)
    variance = look.variance.numpy() * (1 + width * rng.standard_normal(width.shape))
    away = None
    if is_camera(result.problem):
        away = np.full(len(freedom), np.nan)
        away[look.degrees_of_freedom.numpy() > 0] = np.split(look.scaled.numpy(), 4, axis=-1)[
            2
        ].mean(0)
    return look.mean.numpy(), variance, away


def _rings(result: CalibrationResult, levels: Rings) -> Section:
    rng, flat = np.random.default_rng(1), result.walked.flat
    look = result.problem.likelihood(flat[rng.integers(len(flat), size=_PREDICTED)])
    picture = rings(
        *ring_radii(levels), levels.mean.numpy(), look.mean.numpy(), look.variance.numpy()
    )
    text = """The mean signal of each ring about the source, and the prediction of the posterior for
        a repeated measurement. Rings whose every pixel is cut off only bound the signal from
        below."""
    return Section("Rings about the source", text, picture=picture)


def ring_radii(rings: Rings) -> tuple[FloatArray, FloatArray]:
    """Return the root mean square radius of each averaged ring, and of each ring that is cut
    off, in pixels.
    """
    ring, count = rings.ring.numpy(), rings.weight.numpy()
    square = np.bincount(ring, count * rings.square.numpy()) / np.bincount(ring, count)
    return np.sqrt(square), np.sqrt(rings.cut_square.numpy())


def _moments(levels: Sufficient | Levels) -> tuple[FloatArray, FloatArray]:
    """Return the mean and the variance of all digital numbers of each light level, including
    histograms.
    """
    if isinstance(levels, Levels):
        return levels.mean.numpy(), levels.variance.numpy()
    level, value, count = (x.numpy() for x in levels[-3:])
    total, mean, variance = (x.numpy() for x in (levels.pixels, levels.mean, levels.variance))
    sums = [np.bincount(level, count * value**n, minlength=len(total)) for n in range(3)]
    every = total + sums[0]
    middle = (total * mean + sums[1]) / every
    square = total * (variance + mean**2) + sums[2]
    return middle, square / every - middle**2


def corner_section(result: CalibrationResult) -> Section:
    """Return the section with the distribution of every pair of parameters."""
    every = max(1, result.chains.flat.shape[0] // _CORNER)
    determined = [r for r in result.rows() if r.kind != "none"]
    shown = np.stack([result.draws[r.name].reshape(-1)[::every] for r in determined], -1)
    text = """Every pair of parameters of which the frames tell a value or a limit; the recipe's own
        values are orange. Gain, offset, noise and efficiency correlate."""
    picture = corners(
        shown,
        [f"{words_of(r.name)}\n{r.unit}" for r in determined],
        [r.nominal for r in determined],
    )
    return Section("Parameters in pairs", text, picture=picture)


def chains_section(result: CalibrationResult) -> Section:
    """Return the section with the traces of the walkers."""
    text = """Four independent ensembles of walkers, in the coordinates of the posterior, before
        corrections for what the frames show or may hide."""
    picture = traces(result.walked.draws, result.problem.coordinates.labels)
    return Section("Chains", text, picture=picture)
