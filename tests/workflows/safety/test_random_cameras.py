"""A tenth of the benchmark of random cameras: distances of neusee against formulas that share no line with it."""

import pytest

from tests.benchmarks import bench_random_cameras as bench


@pytest.fixture(scope="module")
def lines(tmp_path_factory):
    folder = tmp_path_factory.mktemp("cameras")
    return [bench.line_of(number, folder) for number in range(0, 200, 10)]


@pytest.mark.slow
def test_no_random_camera_is_false_safe(lines):
    rows = [(line["number"], row) for line in lines for row in line["rows"]]
    assert not [line["refused"] for line in lines if "refused" in line]
    assert not [(number, row) for number, row in rows if row["false_safe"]]
    assert not [(number, row) for number, row in rows for end in row.get("ends", {}).values() if end["false_safe"]]
    assert not [line["number"] for line in lines if line["unjudged_reads_safe"]]


@pytest.mark.slow
def test_distances_of_saturation_and_of_the_eye_agree_and_those_of_damage_are_never_nearer(lines):
    """Out of focus the damage of neusee is that of an upper bound of peak and heat, so that it reaches farther."""
    rows = [(line["number"], row) for line in lines for row in line["rows"]]
    compared = [row["limit"] for _, row in rows if row["state"] == "alike"]
    assert min(compared.count("saturated"), compared.count("eye"), compared.count("damage: mean")) >= 3
    for number, row in rows:
        if row["limit"].startswith("damage") and row["state"].startswith("off"):
            assert row["ours"]["waves"] > 0.5, (number, row)
        else:
            assert row["state"] in ("alike", "nowhere", "undecided", "beyond the range"), (number, row)
