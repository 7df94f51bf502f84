"""Figures whose content is measured or drawn at random can be read for all values, also for
unlucky ones.
"""

from __future__ import annotations

from types import SimpleNamespace

import numpy as np
import pytest
import torch
from matplotlib.colors import to_hex

from neusee.nodes.values import Bands
from neusee.workflows.evaluation import evaluation_page as evaluation_figures
from neusee.workflows.evaluation.confidence_intervals import MetricTable
from neusee.workflows.placement.heft_schedule import Schedule, Slot
from neusee.workflows.report.figures import camera_pictures as scene_spectra
from neusee.workflows.report.figures import graph_and_timeline as gantt
from neusee.workflows.report.figures import graph_and_timeline as recipe_graph
from neusee.workflows.report.figures import optics
from neusee.workflows.report.figures import verification as numerics
from neusee.workflows.report.figures import verification as photon_transfer
from neusee.workflows.report.figures.style import canvas
from neusee.workflows.studies import accuracy_page as accuracy_figures
from neusee.workflows.studies import leave_out_study
from neusee.workflows.studies import uncertainty_page as uncertainty_figures
from neusee.workflows.studies.case_result import Cell
from neusee.workflows.studies.leave_out_study import SceneCost
from neusee.workflows.studies.stability_study import grid_picture
from neusee.workflows.training import design_run

# a function that is called as it is writes the picture: the check of all figures then reads it


def costs(*seconds):
    names = (
        *(f"scene {i}" for i in range(len(seconds) - 1)),
        "one wavelength, no laser, clean window",
    )
    return [SceneCost(name, s, 0.8 * s, 3, ()) for name, s in zip(names, seconds, strict=True)]


@pytest.mark.parametrize("share", [0.7, 0.72])
def test_no_run_time_reaches_the_legend(share):
    leave_out_study._bars(costs(*5 * [0.249], share * 0.249, share * 0.249))


def test_run_times_of_zero_have_an_axis():
    assert leave_out_study._bars.__wrapped__(costs(0.0)).axes[0].get_xlim() == (0.0, 1.0)


def test_a_planned_device_that_computed_nothing_has_a_row():
    schedule = Schedule((Slot("a", "cpu", 0.0, 1.0), Slot("b", "cuda:0", 0.0, 1.0)), 1.0, {}, 0.0)
    lanes = gantt.timeline.__wrapped__(schedule=schedule, rows=[("a", "cpu", 0.0, 1.0)]).axes[0]
    assert [label.get_text() for label in lanes.get_yticklabels()] == ["cpu", "cuda:0"]


def test_a_legend_hides_no_measured_point():
    rows = [("as used", "", 1e-7, 1e-3), ("precision", "double", 0.0, 1e-3)]
    figure = numerics.error_time.__wrapped__(rows=rows)
    assert figure.axes[0].get_legend() is None
    assert [text.get_text() for text in figure.legends[0].get_texts()] == ["as used", "precision"]


def test_a_sensor_without_noise_has_no_line_of_dark_noise():
    measured = torch.tensor([[0.0, 0.0, 0.0], [10.0, 11.0, 10.0], [100.0, 98.0, 100.0]])
    labels = (
        photon_transfer.transfer.__wrapped__(measured=measured)
        .axes[0]
        .get_legend_handles_labels()[1]
    )
    assert not [label for label in labels if label.startswith("dark noise")]


def test_points_and_lasers_that_coincide_are_told_apart():
    scene, two = torch.full((3, 8, 8), 0.5), torch.tensor([450e-9, 650e-9])
    bands = Bands(two, two, two.new_ones(2))
    scene_spectra.spectra(
        scene=scene,
        radiance=torch.rand(2, 8, 8),
        bands=bands,
        illuminant=torch.ones(2),
        responses=torch.ones(3, 2),
        lines={"red": bands, "green": bands},
    )


NAMES = (
    "sensor.analogue_to_digital_conversion",
    "the photograph of a friend",
    "optics.psf",
    "a",
    "x" * 40,
)


def test_the_name_of_a_step_stays_in_its_box():
    sources = (
        {name: ["first"] for name in NAMES}
        | {f"a[{i}]": ["first"] for i in range(120)}
        | {"first": []}
    )
    recipe_graph.graph(sources=sources, states=dict.fromkeys(sources, "run"))


@pytest.mark.parametrize(
    ("name", "copies", "shown"),
    [
        ("psf", " ×3", "psf ×3"),
        ("laser_photons_of_the_mask", "", "laser_photons_\nof_the_mask"),
        ("interference_of_parallel_plates", "", "interference_\nof_para…plates"),
        ("laser_photons_of_the_mask", " ×12", "laser_photons_\nof_th…mask ×12"),
        ("x" * 16, "", "x" * 14 + "\nxx"),
    ],
)
def test_a_long_name_is_broken_and_shortened(name, copies, shown):
    assert recipe_graph.broken(name, 14, copies) == shown
    assert max(map(len, shown.splitlines())) <= 14


def test_an_evaluation_without_a_value_has_axes():
    table = MetricTable(
        (0.0, 10.0), {name: np.array([[np.nan, 0.2]]) for name in ("l1", "l1 small")}, np.zeros(1)
    )
    axes = evaluation_figures.strengths.__wrapped__({"a": table}, 64).axes
    assert axes[0].get_ylim() == pytest.approx((0.0, 0.21))


def looks(lines):
    return {(to_hex(line.get_color()), line.get_linestyle(), line.get_marker()) for line in lines}


def test_twelve_masks_and_twelve_starts_look_different():
    one = np.full(3, 0.5)
    mask = SimpleNamespace(lsr=one, median=one, rms=one, floor=0.1 * one, unsuppressed=one)
    plane = evaluation_figures.plane.__wrapped__({f"mask {i}": mask for i in range(12)}).axes[0]
    assert len(looks(line for line in plane.lines if line.get_label().startswith("mask"))) == 12
    rows = [{"start": i, "iteration": 0, "loss": 1.0} for i in range(12)]
    assert len(looks(design_run.history_figure.__wrapped__(rows).axes[0].lines)) == 12


def test_numbers_of_panels_above_each_other_are_apart():
    wide = np.array([[1e-6, 1.0], [1.1e-6, 1.3]])
    uncertainty_figures.bands({"LSR": (np.array([400.0, 700.0]), {"R": wide})}, "wavelength (nm)")


def test_numbers_that_differ_in_the_last_digits_are_short():
    swings = [
        ("the photograph of a friend with a long name", -3.154901583e-4, -3.154901354e-4),
        ("well", -3.154902072e-4, -3.154901666e-4),
    ]
    middles = {"a": -3.154901258e-4, "b": 0.01237144}
    figure = uncertainty_figures.tornado.__wrapped__(
        {"a": swings, "b": [("gain", 0.0124, 0.0125)]}, middles
    )
    figure.draw_without_rendering()
    for ax, offset in zip(figure.axes, (True, False), strict=True):
        assert bool(ax.xaxis.get_offset_text().get_text()) == offset
        assert max(len(label.get_text()) for label in ax.get_xticklabels()) <= 8


def test_the_legend_of_one_step_is_no_wider_than_its_diagram():
    names = ("precision", "method", "window", "samples of the pupil")
    lines = [
        accuracy_figures.Line(name, [accuracy_figures.Dot(1e-3, 1e-6, "fft")]) for name in names
    ]
    accuracy_figures.steps([("optics.psf", lines, 1e-2)])


def test_radii_of_a_small_window_are_plain_numbers():
    figure, axes = canvas(3.0, 2.8)
    psf, bands = (
        SimpleNamespace(intensity=torch.rand(1, 17, 17)),
        SimpleNamespace(centres=torch.tensor([550e-9])),
    )
    optics._encircled(axes[0, 0], psf, bands, 3.2e-6, "plain lens")
    figure.draw_without_rendering()
    shown = [
        label.get_text() for label in axes[0, 0].get_xticklabels(which="both") if label.get_text()
    ]
    assert {float(text) for text in shown} <= {1, 2, 3, 5, 10, 20, 30, 50, 100}


def test_a_grid_of_few_nodes_with_long_names_has_rows_of_full_height():
    cells = [Cell("warn", "", 10.0**-e, 1.0, 1e-3, 1e-3) for e in (3, 120, 7, 300)]
    entries = [
        ("group", f"case {i % 2}", f"optics.{'long_' * (4 + i)}name", cell)
        for i, cell in enumerate(cells)
    ]
    grid_picture(entries)
