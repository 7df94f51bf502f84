"""A twentieth of the benchmark of random cameras: distances of neusee against formulas that share no
line with it.
"""

from dataclasses import replace

import numpy as np
import pytest

from tests.benchmarks import bench_random_cameras as bench


@pytest.fixture(scope="module")
def lines(tmp_path_factory):
    folder = tmp_path_factory.mktemp("cameras")
    return [bench.line_of(number, folder) for number in range(0, 200, 20)]


@pytest.mark.slow
def test_no_random_camera_is_false_safe(lines):
    rows = [(line["number"], row) for line in lines for row in line["rows"]]
    assert not [line["refused"] for line in lines if "refused" in line]
    assert not [(number, row) for number, row in rows if row["false_safe"]]
    assert not [
        (number, row)
        for number, row in rows
        for end in row.get("ends", {}).values()
        if end["false_safe"]
    ]
    assert not [line["number"] for line in lines if line["unjudged_reads_safe"]]


@pytest.mark.parametrize(
    "number",
    [
        pytest.param(70, marks=pytest.mark.slow),
        pytest.param(180, marks=pytest.mark.slow),
        pytest.param(183, marks=pytest.mark.long),  # as the other two, with more waves
    ],
)
def test_the_brightest_pixel_out_of_focus_is_never_too_dark(number, tmp_path):
    """At 600 distances: up to 2 waves it follows the light of the reference, and beyond it is an
    upper bound.
    """
    camera = replace(bench.camera(number), laws={})
    found, own, waves = bench.light_along(camera, tmp_path)
    ratio = found / own
    assert ratio.min() > 0.94
    assert np.median(ratio) < 1.5
    assert ratio[waves > 2].max(initial=1.0) < 2.5
    assert (ratio < 0.97).mean() < 0.1


@pytest.mark.slow
def test_distances_agree_and_are_never_nearer_out_of_focus(lines):
    """Out of focus neusee takes upper bounds of the peak and the brightest pixel, so that
    distances reach farther.
    """
    rows = [(line["number"], row) for line in lines for row in line["rows"]]
    compared = [row["limit"] for _, row in rows if row["state"] == "alike"]
    assert (
        min(compared.count("saturated"), compared.count("eye"), compared.count("damage: mean")) >= 1
    )
    for number, row in rows:
        if row["limit"] != "eye" and row["state"].startswith("off"):
            assert row["limit"] != "damage: mean", (number, row)
            assert row["ours"]["waves"] > (1.0 if row["limit"].startswith("damage") else 2.0), (
                number,
                row,
            )
        else:
            assert row["state"] in ("alike", "nowhere", "undecided", "beyond the range"), (
                number,
                row,
            )
