"""Figures of a calibration: the axes follow the levels that are not clipped."""

from __future__ import annotations

import csv
import importlib.util
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from neusee.workflows.calibration import calibration_figures
from neusee.workflows.calibration import calibration_figures as corner_figure
from neusee.workflows.calibration import calibration_figures as picture_sections
from neusee.workflows.calibration.calibration_page import CalibrationResult
from neusee.workflows.calibration.emcee_sampler import Chains
from neusee.workflows.calibration.identifiability import identify
from neusee.workflows.calibration.log_posterior import SensorPosterior, find_mode, initial_theta
from neusee.workflows.recipe.loading import load
from neusee.workflows.store.result_store import Store

_spec = importlib.util.spec_from_file_location(
    "cameras", Path(__file__).parents[2] / "nodes/calibrate/cameras.py"
)
cameras = importlib.util.module_from_spec(_spec)
_spec.loader.exec_module(cameras)


def drawn(last, whole):
    mean = np.geomspace(1e3, 6e4, 12)
    measured = np.stack([mean, 700 + 2.7 * mean])
    measured[1, -1] *= last
    predicted = np.stack([np.tile(mean, (50, 1)), np.tile(700 + 2.7 * mean, (50, 1))])
    predicted[1] *= np.linspace(0.98, 1.02, 50)[:, None]
    used, label = np.arange(12) < whole, calibration_figures.COUNTED
    return calibration_figures.transfer.__wrapped__(measured, predicted, used, label).axes[0]


@pytest.mark.parametrize("last", [0.0, 1e-6, 0.1])
def test_one_clipped_level_does_not_squeeze_the_curve(last):
    ax = drawn(last, 11)
    low, high = ax.get_ylim()
    assert low > 700
    (clipped,) = (line for line in ax.lines if line.get_label().startswith("clipped"))
    assert low < clipped.get_ydata()[0] < high


def test_without_a_clipped_level_nothing_is_marked_as_clipped():
    assert not [line for line in drawn(1.0, 12).lines if line.get_label().startswith("clipped")]


def test_the_axes_of_chains_are_read_without_adding_an_offset():
    draws = 1054.0 + 1e-2 * np.random.default_rng(0).random((4, 100, 16, 1))
    figure = calibration_figures.traces.__wrapped__(draws, ["offset, DN"])
    figure.canvas.draw()
    assert figure.axes[0].yaxis.get_offset_text().get_text() == ""


def test_numbers_of_many_pairs_can_be_read_at_the_width_of_the_page():
    for count in (2, 9):
        names = [f"parameter {i}\ne-" for i in range(count)]
        draws = np.random.default_rng(0).normal(1.0, 0.1, (400, count))
        figure = corner_figure.corners.__wrapped__(draws, names, [1.0] * count)
        shrunk = min(1.0, 1140 / (100 * figure.get_size_inches()[0]))
        axis = figure.axes[-1].xaxis
        assert (
            min(text.get_fontsize() for text in (axis.label, *axis.get_ticklabels())) * shrunk
            >= 8.9
        )


def test_a_single_draw_does_not_squeeze_a_panel_of_pairs():
    draws = np.random.default_rng(0).normal(1.0, 0.1, (2000, 2))
    draws[0] = 50.0
    figure = corner_figure.corners.__wrapped__(draws, ["gain", "offset"], [1.0, 1.45])
    for ax in (figure.axes[0], figure.axes[-1]):
        low, high = ax.get_xlim()
        assert low < 0.8
        assert 1.2 < high < 2.0
    assert figure.axes[-1].get_xlim()[1] >= 1.45


def test_a_panel_of_a_pair_has_contours_that_hold_their_shares_of_the_draws():
    draws = np.random.default_rng(0).normal(size=(60_000, 2))
    ax = corner_figure.corners.__wrapped__(draws, ["a", "b"], [0.0, 0.0]).axes[1]
    (contours,) = ax.collections
    inside = []
    for height in contours.get_paths():
        corners = np.concatenate([piece for piece in height.to_polygons() if len(piece) > 4])
        inside.append(float(np.hypot(*corners.T).mean()))  # radii in standard deviations
    assert sorted(inside) == pytest.approx([0.5, 1.0, 1.5, 2.0], abs=0.12)


def test_the_curve_compares_the_levels_with_what_the_levels_alone_determine(tmp_path, monkeypatch):
    """A correction for what frames may hide is no residual, and scatter is part of the
    prediction.
    """
    file, rng = (
        cameras.tabled(1, tmp_path / "levels.csv", pixels=200_000, lamp=0.005),
        np.random.default_rng(1),
    )
    rows = list(csv.DictReader(file.read_text().splitlines()))
    lit = [row for row in rows if float(row["photons"]) > 0]
    # this level is brighter than is stated
    lit[3]["photons"] = f"{0.95 * float(lit[3]['photons']):.3f}"
    with file.open("w", newline="") as opened:
        writer = csv.DictWriter(opened, rows[0])
        writer.writeheader()
        writer.writerows(rows)
    fixed = ["camera.scatter=0.02", "steps.prior.with.scatter=null"]
    problem = SensorPosterior.of(
        load("calibrate_camera", [f"table.file={file}", *fixed]), Store(tmp_path / "store")
    )
    mode = find_mode(problem, initial_theta(problem))
    draws = mode.draw(1000, rng).reshape(4, 50, 5, -1)
    walk = Chains(draws, np.zeros(draws.shape[:-1]), 0.5, 1.0, 50, True)
    values = problem.parameters(draws)
    corrected = replace(walk, draws=problem.theta(values | {"gain": values["gain"] * 1.05}))
    result = CalibrationResult(problem, mode, identify(problem, mode), corrected, [], walk=walk)
    shown = {}
    monkeypatch.setattr(
        calibration_figures, "transfer", lambda *given: shown.update(given=given) or b"png"
    )
    section = picture_sections.curve_section(result)
    measured, predicted, used, label, means = shown["given"]
    assert label == "not used: above 70% of saturation, or clipped"
    assert "Levels above 70% of saturation" in section.text
    distance = (measured[1] - predicted[1].mean(0))[used] / predicted[1].std(0)[used]
    assert np.abs(distance).max() < 3.5
    assert predicted[1].std(0)[used] / predicted[1].mean(0)[used] == pytest.approx(0.02, rel=0.3)
    assert used.sum() < len(used)
    photons = problem.levels.photons.numpy()
    bright = np.flatnonzero(photons)[3]
    assert np.nanargmax(means) == bright
    assert means[bright] > 3.5
    assert np.isfinite(means[used]).all()


def test_the_distances_of_the_means_have_a_panel_of_their_own():
    mean = np.geomspace(1e3, 6e4, 12)
    levels = np.stack([mean, 700 + 2.7 * mean])
    predicted = np.tile(levels[:, None], (1, 50, 1)) * np.linspace(0.98, 1.02, 50)[:, None]
    away, used = np.where(np.arange(12) < 9, 0.5, np.nan), np.arange(12) < 9
    away[2] = 6.0
    panel = calibration_figures.transfer.__wrapped__(
        levels, predicted, used, "not used", away
    ).axes[2]
    assert panel.get_ylim()[1] > 6.0
    assert panel.get_ylabel().startswith("mean")
    assert panel.get_xlabel() == "mean (DN)"
