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
from neusee.workflows.report.study_report import Section

if TYPE_CHECKING:
    from numpy.typing import NDArray

    from neusee.workflows.calibration.calibration_page import CalibrationResult
    from neusee.workflows.calibration.log_posterior import FloatArray


# --- calibration figures --------------------------------------------------------------------------

# The pictures of a calibration: photon-transfer curve, rings around a source, and traces of the
# chains.


# lower end, median and upper end of the central 90 %
_BAND = (5.0, 50.0, 95.0)  #: percentiles
_POINTS = 1500  #: largest number of drawn points of a chain
_LEAST_DRAWN_VARIANCE = 0.1  #: DN², lowest drawn variance, for levels without scatter
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
    """Draw the photon-transfer curve, and the deviation of each light level from the prediction of
    the posterior.

    ``measured`` (2, level) has mean and variance, and ``predicted`` (2, draw, level) mean and
    variance of a repeated measurement. ``unclipped`` (level,) is False for levels without a
    prediction, which the label ``other`` describes. ``means`` (level,) are the deviations of the
    means from the light in standard deviations, if the light is uncertain.
    """
    rows = 2 if means is None else 3
    figure, axes = canvas(
        9.0, 4.8 + 1.2 * rows, rows, 1, sharex=True, height_ratios=(2.2, *(rows - 1) * (1.0,))
    )
    curve_panel = axes[0, 0]
    unclipped_by_mean = np.flatnonzero(unclipped)[np.argsort(predicted[0].mean(0)[unclipped])]
    mean = predicted[0].mean(0)[unclipped_by_mean]
    # percentiles over the draws, of the levels with a prediction
    variance_low, variance_median, variance_high = np.percentile(predicted[1], _BAND, axis=0)[
        :, unclipped_by_mean
    ]
    curve_panel.fill_between(
        mean,
        variance_low,
        variance_high,
        color=BLUE,
        alpha=0.25,
        linewidth=0,
        label="predicted, 90 %",
    )
    curve_panel.plot(mean, variance_median, color=BLUE, linewidth=1.2, label="predicted, median")
    # the axis is logarithmic: variances of 0 are drawn at its lower end
    lowest_drawn_variance = max(
        _LEAST_DRAWN_VARIANCE,
        0.5
        * float(min([*measured[1, unclipped], *variance_median], default=_LEAST_DRAWN_VARIANCE)),
    )
    for is_drawn, marker_style in (
        (unclipped, {"marker": "o", "color": BLACK, "label": "measured"}),
        (~unclipped, {**_CLIPPED, "label": other}),
    ):
        if is_drawn.any():
            curve_panel.plot(
                measured[0, is_drawn],
                measured[1, is_drawn].clip(lowest_drawn_variance),
                linestyle="",
                markersize=5,
                **marker_style,
            )
    curve_panel.set(
        xscale="log", yscale="log", ylabel="temporal variance (DN²)", title="Photon-transfer curve"
    )
    # a clipped level does not stretch the axis
    curve_panel.set_ylim(bottom=lowest_drawn_variance / 2)
    curve_panel.legend(loc="upper left")
    # (measured - mean of all draws) / standard deviation of the draws
    variance_distance = (measured[1, unclipped] - predicted[1].mean(0)[unclipped]) / predicted[
        1
    ].std(0)[unclipped]
    _distances(axes[1, 0], measured[0, unclipped], variance_distance, "variance: distance\nin sd")
    if means is not None:
        _distances(axes[2, 0], measured[0, unclipped], means[unclipped], "mean: distance\nin sd")
    axes[-1, 0].set_xlabel("mean (DN)")
    return figure


def _distances(ax: Any, places: FloatArray, distance: FloatArray, label: str) -> None:
    """Draw deviations from a prediction in standard deviations, over a band of ±2."""
    ax.axhspan(-2, 2, color=BLUE, alpha=0.12, linewidth=0)
    ax.axhline(0, color=BLUE, linewidth=1.0)
    ax.plot(places, distance, "o", color=BLACK, markersize=5)
    # at least 3.5, so that the band of two standard deviations looks the same in most pictures
    half_height = max(3.5, 1.1 * float(np.abs(distance).max(initial=0.0)))
    ax.set(ylabel=label, ylim=(-half_height, half_height))


@drawn
def rings(
    radius: FloatArray,
    cut: FloatArray,
    measured: FloatArray,
    predicted: FloatArray,
    variance: FloatArray,
) -> Any:
    """Draw the signal of the rings around an overexposed source against the radius, and its
    deviation from the prediction.

    ``measured`` (ring,), ``predicted`` and ``variance`` (draw, ring) are in electrons per pixel,
    the variance in their square; ``cut`` (cut,) are the radii of the clipped rings.
    """
    figure, axes = canvas(9.0, 7.2, 2, 1, sharex=True, height_ratios=(2.2, 1.0))
    signal_panel, distance_panel = axes[0, 0], axes[1, 0]
    signal_low, signal_median, signal_high = np.percentile(predicted, _BAND, axis=0)
    signal_panel.fill_between(
        radius,
        signal_low,
        signal_high,
        color=BLUE,
        alpha=0.25,
        linewidth=0,
        label="predicted, 90 %",
    )
    signal_panel.plot(radius, signal_median, color=BLUE, linewidth=1.2, label="predicted, median")
    positive = measured > 0
    signal_panel.plot(
        radius[positive], measured[positive], "o", color=BLACK, markersize=4, label="measured"
    )
    if len(cut):
        cut_edges = float(cut.min()) - 0.5, float(cut.max()) + 0.5  # a ring is one pixel wide
        signal_panel.axvspan(*cut_edges, color=VERMILION, alpha=0.3, linewidth=0, label="cut off")
    signal_panel.set(
        xscale="log", yscale="log", ylabel="signal (e- of a pixel)", title="Rings about the source"
    )
    signal_panel.legend(loc="lower left")
    # variance of the draws plus noise variance of each ring
    total_sd = np.sqrt(predicted.var(0) + variance.mean(0))
    _distances(
        distance_panel,
        radius,
        (measured - predicted.mean(0)) / total_sd,
        "distance in sd\nof the prediction",
    )
    distance_panel.set_xlabel("distance from the source (pixels)")
    distance_panel.xaxis.set_major_formatter("{x:g}")
    distance_panel.xaxis.set_minor_formatter("{x:g}")
    return figure


@drawn
def traces(draws: FloatArray, labels: Sequence[str]) -> Any:
    """Draw a trace plot of each coordinate: median and central 90 % of the walkers of each
    ensemble.
    """
    count = len(labels)
    figure, axes = canvas(9.0, 1.35 * count + 0.5, count, 1, sharex=True)
    stride = max(1, draws.shape[1] // _POINTS)
    for i, label in enumerate(labels):
        ax = axes[i, 0]
        for ensemble, colour in zip(
            draws[:, ::stride, :, i], (BLUE, ORANGE, "#009E73", VERMILION), strict=False
        ):
            walker_low, walker_median, walker_high = np.percentile(ensemble, _BAND, axis=1)
            steps = np.arange(len(walker_median)) * stride
            ax.fill_between(steps, walker_low, walker_high, color=colour, alpha=0.12, linewidth=0)
            ax.plot(steps, walker_median, color=colour, linewidth=0.8)
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


_PAGE = 11.4  #: inches, width of the page at 100 pixels per inch
_WIDEST = 13  #: largest number of characters in a line of a label
#: quantiles, so that a single draw does not squeeze a panel of the corner plot
_NEARLY_ALL = (0.005, 0.995)
_BINS = 20  #: number of bins along each side of a panel
#: shares of the draws inside the contours: 0.5, 1, 1.5 and 2 sigma of a two-dimensional normal
#: distribution
_LEVELS = 1 - np.exp(-0.5 * np.array([0.5, 1.0, 1.5, 2.0]) ** 2)
#: inches of a panel, of the margin with the labels, and between panels
_SIZE, _LEFT, _GAP = 1.75, 0.9, 0.06


@drawn
def corners(draws: FloatArray, names: Sequence[str], nominal: Sequence[float]) -> Any:
    """Draw a corner plot of all pairs of parameters, with the values of the recipe in orange."""
    from matplotlib.backends.backend_agg import FigureCanvasAgg
    from matplotlib.figure import Figure

    count = len(names)
    figure_inches = _SIZE * count + _LEFT
    # a large picture is shrunk to the width of the page
    font_size = 10 * max(1.0, figure_inches / _PAGE)
    figure = Figure(figsize=(figure_inches, figure_inches), dpi=100)
    FigureCanvasAgg(figure)
    ranges = _ranges(draws, nominal)
    for row in range(count):
        for column in range(row + 1):
            panel_left, panel_bottom = _LEFT + _SIZE * column, _LEFT + _SIZE * (count - 1 - row)
            # matplotlib counts from the bottom, in fractions of the figure
            ax = figure.add_axes(
                (
                    panel_left / figure_inches,
                    panel_bottom / figure_inches,
                    (_SIZE - _GAP) / figure_inches,
                    (_SIZE - _GAP) / figure_inches,
                )
            )
            _panel(
                ax,
                draws[:, [column, row]],
                [ranges[column], ranges[row]],
                (nominal[column], nominal[row]),
            )
            x_label = names[column] if row == count - 1 else ""
            # no label next to the first row: it is a histogram
            y_label = names[row] if column == 0 < row else ""
            _labelled(ax, x_label, y_label, font_size)
    return figure


def _panel(
    ax: Any, pair: FloatArray, ends: Sequence[tuple[float, float]], own: tuple[float, float]
) -> None:
    """Draw the histogram of one parameter, or the two-dimensional histogram of two with contours.

    ``pair`` (draw, 2) are the draws of both parameters, ``ends`` the range of each axis, and
    ``own`` the recipe's value of each. On the diagonal of the corner plot both parameters are the
    same.
    """
    ax.grid(False)
    ax.set_xlim(ends[0])
    ax.axvline(own[0], color=ORANGE, linewidth=1.0)
    # the diagonal: one parameter against itself
    if np.array_equal(pair[:, 0], pair[:, 1]):
        ax.stairs(*np.histogram(pair[:, 0], _BINS, ends[0]), color=BLUE)
        ax.set(yticks=[], ylim=(0, None))
        return
    counts, x, y = np.histogram2d(pair[:, 0], pair[:, 1], _BINS, np.array(ends))
    ax.imshow(
        # `histogram2d` has the first parameter down the rows, a picture has it across
        counts.T,
        origin="lower",
        extent=(*ends[0], *ends[1]),
        aspect="auto",
        cmap="Blues",
        vmin=0,
    )
    contour_levels = _heights(counts)
    if len(contour_levels):
        bin_centres = [0.5 * (edges[1:] + edges[:-1]) for edges in (x, y)]
        ax.contour(*bin_centres, counts.T, levels=contour_levels, colors=BLUE, linewidths=0.8)
    ax.axhline(own[1], color=ORANGE, linewidth=1.0)
    ax.set_ylim(ends[1])


def _heights(counts: FloatArray) -> FloatArray:
    """Return the contour levels of a histogram, in draws per cell, rising and without repetition.

    The cells above a level contain one of the shares `_LEVELS` of all draws.
    """
    falling_counts = np.sort(counts.ravel())[::-1]
    # fill up from the fullest cell until the cells contain each share of all draws
    last_cell = np.searchsorted(np.cumsum(falling_counts), _LEVELS * falling_counts.sum())
    # the count of the last cell that belongs to each share
    contour_levels = np.unique(falling_counts[last_cell.clip(max=len(falling_counts) - 1)])
    visible_levels: FloatArray = contour_levels[
        (contour_levels > 0) & (contour_levels < falling_counts[0])
    ]
    return visible_levels


def _labelled(ax: Any, below: str, left: str, text: float) -> None:
    """Label the axes of a panel.

    An axis without a label has no ticks; ``text`` is the font size.
    """
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
    """Return a label with line breaks between words, so that it is no wider than a panel."""
    return "\n".join(textwrap.fill(line, _WIDEST) for line in label.splitlines())


def _ranges(draws: FloatArray, nominal: Sequence[float]) -> list[tuple[float, float]]:
    """Return the axis range of each parameter in the corner plot: nearly all draws, extended to the
    recipe's value if that lies among the draws.
    """
    quantiles = np.quantile(draws, _NEARLY_ALL, axis=0).T
    margin = 0.1 * (quantiles[:, 1] - quantiles[:, 0])
    padded_range = np.column_stack([quantiles[:, 0] - margin, quantiles[:, 1] + margin]).clip(
        draws.min(0)[:, None], draws.max(0)[:, None]
    )
    recipe_value = np.asarray(nominal)
    is_among_draws = (recipe_value >= draws.min(0)) & (recipe_value <= draws.max(0))
    axis_low = np.where(
        is_among_draws, np.minimum(padded_range[:, 0], recipe_value), padded_range[:, 0]
    )
    axis_high = np.where(
        is_among_draws, np.maximum(padded_range[:, 1], recipe_value), padded_range[:, 1]
    )
    return [
        # a parameter whose draws are all equal still needs an axis of some width
        (float(lowest), float(highest))
        if highest > lowest
        else (float(lowest) - 0.5, float(lowest) + 0.5)
        for lowest, highest in zip(axis_low, axis_high, strict=True)
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
    """Return the section with the photon-transfer curve, or with the rings around a point
    source.
    """
    if isinstance(result.problem.levels, Rings):
        return _rings(result, result.problem.levels)
    levels: Any = result.problem.levels
    mean, variance, mean_distance = _repeated(result)
    unclipped: NDArray[np.bool_] = np.asarray((variance > 0).all(0))
    # a level with counted digital numbers has no moments to predict
    unclipped[levels.cell_level.numpy()] = False
    text, unused_label = _COUNTED, COUNTED
    if is_camera(result.problem):
        share = f"{result.params['share']:.0%} of saturation"
        text, unused_label = (
            _EXCLUDED.format(share=share),
            f"not used: above {share}, or clipped",
        )
    picture = transfer(
        np.stack(_moments(levels)),
        np.stack([mean, variance]),
        unclipped,
        unused_label,
        mean_distance,
    )
    return Section("Photon-transfer curve", text, picture=picture)


def _repeated(result: CalibrationResult) -> tuple[FloatArray, FloatArray, FloatArray | None]:
    """Return mean and variance (draw, level) of a simulated repeated measurement, including the
    fitted scatter of the variances.

    For a real camera the third value has the distances (level,) of the means from the prediction by
    the light, in standard deviations; else None.
    """
    rng = np.random.default_rng(1)
    all_draws = result.walked.flat
    some_draws = all_draws[rng.integers(len(all_draws), size=_PREDICTED)]
    levels: Any = result.problem.levels
    prediction = result.problem.likelihood(some_draws)
    degrees_of_freedom = levels.degrees_of_freedom.numpy().clip(1)
    values = {**result.params, **result.problem.parameters(some_draws)}
    scatter = np.broadcast_to(np.asarray(values.get("scatter", 0.0)), len(some_draws))
    # a sample variance has the relative standard deviation sqrt(2 / degrees of freedom)
    relative_sd = np.sqrt(2 / degrees_of_freedom + scatter[:, None] ** 2)
    # a repeated measurement: the predicted variance with its random error
    variance = prediction.variance.numpy() * (
        1 + relative_sd * rng.standard_normal(relative_sd.shape)
    )
    mean_distance = None
    if is_camera(result.problem):
        mean_distance = np.full(len(degrees_of_freedom), np.nan)
        # residuals are split as in `camera_density._parts`; part 2 are those of the means
        mean_distance[prediction.degrees_of_freedom.numpy() > 0] = np.split(
            prediction.scaled.numpy(), 4, axis=-1
        )[2].mean(0)
    return prediction.mean.numpy(), variance, mean_distance


def _rings(result: CalibrationResult, levels: Rings) -> Section:
    """Return the section on the rings around a point source: signal against radius."""
    rng, all_draws = np.random.default_rng(1), result.walked.flat
    prediction = result.problem.likelihood(all_draws[rng.integers(len(all_draws), size=_PREDICTED)])
    picture = rings(
        *ring_radii(levels),
        levels.mean.numpy(),
        prediction.mean.numpy(),
        prediction.variance.numpy(),
    )
    text = """The mean signal of each ring about the source, and the prediction of the posterior for
        a repeated measurement. Rings whose every pixel is cut off only bound the signal from
        below."""
    return Section("Rings about the source", text, picture=picture)


def ring_radii(rings: Rings) -> tuple[FloatArray, FloatArray]:
    """Return the root mean square radius in pixels of each averaged ring, and of each
    clipped ring.
    """
    ring, count = rings.ring.numpy(), rings.weight.numpy()
    mean_square_radius = np.bincount(ring, count * rings.square.numpy()) / np.bincount(ring, count)
    return np.sqrt(mean_square_radius), np.sqrt(rings.cut_square.numpy())


def _moments(levels: Sufficient | Levels) -> tuple[FloatArray, FloatArray]:
    """Return mean and variance of all digital numbers of each light level, including levels with a
    histogram.
    """
    if isinstance(levels, Levels):
        return levels.mean.numpy(), levels.variance.numpy()
    # of the levels with a histogram: level number, digital number, number of pixels
    level, value, count = (x.numpy() for x in levels[-3:])
    pixels, mean, variance = (x.numpy() for x in (levels.pixels, levels.mean, levels.variance))
    # sums of the powers 0, 1 and 2 of the digital numbers of each histogram
    power_sums = [np.bincount(level, count * value**n, minlength=len(pixels)) for n in range(3)]
    all_pixels = pixels + power_sums[0]
    # combine both kinds of data: plain moments, and counted digital numbers
    all_mean = (pixels * mean + power_sums[1]) / all_pixels
    # mean of squares = variance + mean²
    square_sum = pixels * (variance + mean**2) + power_sums[2]
    return all_mean, square_sum / all_pixels - all_mean**2


def corner_section(result: CalibrationResult) -> Section:
    """Return the section with the distribution of every pair of parameters."""
    stride = max(1, result.chains.flat.shape[0] // _CORNER)
    determined = [r for r in result.rows() if r.kind != "none"]
    shown_draws = np.stack([result.draws[r.name].reshape(-1)[::stride] for r in determined], -1)
    text = """Every pair of parameters of which the frames tell a value or a limit; the recipe's own
        values are orange. Gain, offset, noise and efficiency correlate."""
    picture = corners(
        shown_draws,
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
