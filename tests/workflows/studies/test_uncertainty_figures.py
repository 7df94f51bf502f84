"""Figures of the uncertainty study: each mark is explained, and no title touches the numbers
above it.
"""

from __future__ import annotations

import numpy as np
import torch

from neusee.workflows.studies import uncertainty_page as uncertainty_figures

NAMES = [f"quality[mask].{name}" for name in ("l1", "psnr", "ssim", "peak")]


def test_the_line_of_a_histogram_has_a_legend():
    draws = {name: np.random.default_rng(i).random(50) for i, name in enumerate(NAMES)}
    figure = uncertainty_figures.histograms.__wrapped__(draws, dict.fromkeys(NAMES, 0.5))
    assert [text.get_text() for text in figure.legends[0].get_texts()] == [
        "value with every input at its median"
    ]
    assert_titles_are_apart(figure)


def test_titles_of_a_tornado_are_apart_from_the_numbers_above():
    swings = {
        name: [(f"sensor.value_{i}", 0.1 * i, 1.0 - 0.1 * i) for i in range(5)] for name in NAMES
    }
    assert_titles_are_apart(
        uncertainty_figures.tornado.__wrapped__(swings, dict.fromkeys(NAMES, 0.5))
    )


def test_the_scale_of_a_standard_deviation_has_a_label():
    figure = uncertainty_figures.pictures.__wrapped__(
        {"raw": (torch.rand(3, 8, 8), torch.rand(3, 8, 8))}
    )
    assert figure.axes[-1].get_ylabel() == "in the unit of the picture"


def transfer_draws(clipped):
    rng = np.random.default_rng(0)
    signal = np.concatenate([[0.0], np.geomspace(1, 6.5e4, 30)])
    predicted = 800 + 2.7 * signal
    measured = np.where(signal > clipped, 1e-6, predicted) * rng.uniform(0.95, 1.05, (64, 31))
    return np.stack([np.tile(signal, (64, 1)), measured, np.tile(predicted, (64, 1))], -1)


def test_a_clipped_level_does_not_squeeze_the_photon_transfer_curves():
    ax, below = uncertainty_figures.transfer.__wrapped__(transfer_draws(5e4)).axes
    assert ax.get_ylim()[0] > 10
    assert max(map(abs, below.get_ylim())) < 20
    assert [text.get_text() for text in ax.get_legend().get_texts()][-1] == "clipped flat fields"


def test_draws_that_differ_are_not_taken_for_clipped_ones():
    draws = transfer_draws(1e9)
    draws[..., 1:] *= np.linspace(0.3, 3.0, 64)[:, None, None]
    ax, _ = uncertainty_figures.transfer.__wrapped__(draws).axes
    assert len(ax.get_legend().get_texts()) == 2


def test_numbers_below_a_histogram_or_a_tornado_are_apart_and_upright():
    rng = np.random.default_rng(0)
    draws = {name: 0.04573 + 1e-4 * rng.random(50) for name in NAMES}
    middles = dict.fromkeys(NAMES, 0.04578)
    swings = {name: [("sensor.read_noise", 0.04575, 0.04582)] for name in NAMES}
    for draw, given in (
        (uncertainty_figures.histograms, draws),
        (uncertainty_figures.tornado, swings),
    ):
        draw(given, middles)  # texts that overlap are found wherever a figure is drawn
        for ax in draw.__wrapped__(given, middles).axes:
            assert {label.get_rotation() for label in ax.get_xticklabels()} == {0.0}


def test_without_a_clipped_level_no_area_is_marked():
    ax, _ = uncertainty_figures.transfer.__wrapped__(transfer_draws(1e9)).axes
    assert len(ax.get_legend().get_texts()) == 2


def assert_titles_are_apart(figure):
    figure.canvas.draw()
    shown = [ax for ax in figure.axes if ax.axison]
    numbers = [t.get_window_extent() for ax in shown for t in ax.get_xticklabels() if t.get_text()]
    for ax in shown:
        title = ax.title.get_window_extent()
        assert not any(title.padded(8).overlaps(number) for number in numbers), ax.get_title()
