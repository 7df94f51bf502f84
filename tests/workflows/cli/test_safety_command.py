"""`neusee safety` prints limits and distances, writes a page, and refuses what it cannot estimate with exit code 2."""

import json

import pytest

from neusee.workflows import load
from neusee.workflows.cli import app
from neusee.workflows.safety.safety_estimate import estimate

QUICK = ("safety.protection={filter: 1e-2}", "safety.draws=100")


@pytest.fixture(scope="module")
def cache(tmp_path_factory):
    return tmp_path_factory.mktemp("cache")


@pytest.fixture
def neusee(capfd, tmp_path, monkeypatch, cache):
    monkeypatch.setenv("NEUSEE_CACHE", str(cache))

    def call(*words):
        with pytest.raises(SystemExit) as end:
            app.main([*words, "--out", str(tmp_path / "runs")])
        return (end.value.code or 0, *capfd.readouterr())

    return call


def test_the_terminal_has_limits_distances_eye_and_sources(neusee, tmp_path):
    code, out, err = neusee("safety", "safety_pointer", *QUICK)
    assert (code, err) == (0, "")
    lines = out.splitlines()
    assert lines[1] == "An estimate, no certificate: neusee decides nothing about eyes or sensors."
    for words in ("MPE", "NOHD", "Schwarz et al.", "no veil is stated", "IEC 60825-1:2014", "may blind people"):
        assert words in " ".join(out.split()), words
    page = tmp_path / "runs" / lines[-1].rpartition("runs/")[2]
    text = page.read_text(encoding="utf-8")
    assert text.count("An estimate, no certificate") >= 5
    assert (page.parent / "limits.csv").read_text().startswith("protection,limit,effect")
    assert {path.name for path in (page.parent / "figures").iterdir()} == {
        "irradiance.png",
        "distances.png",
        "dazzle.png",
    }


def test_json_is_one_object_and_says_why_there_is_no_dazzle_at_1550_nm(neusee):
    code, out, _ = neusee("safety", "safety_car_lidar_1550", *QUICK, "--json")
    found = json.loads(out)
    assert code == 0
    assert found["certificate"].startswith("An estimate, no certificate")
    assert {each["effect"] for each in found["limits"]} == {"damage"}
    assert all(each["source"] for each in found["limits"])
    assert found["not_said"] == [
        "Nothing is said of dazzle: the recipe gives no quantum efficiency, full well, exposure of the sensor at this "
        "wavelength."
    ]
    assert found["eye"]["distance"]["low"] < found["eye"]["distance"]["value"] < found["eye"]["distance"]["high"]


def test_without_thresholds_the_estimate_says_that_damage_is_not_known():
    found = estimate(load("safety_car_lidar_1550", [*QUICK, "safety.damage={device: MICROBOLOMETER}"]))
    assert found.findings == ()
    assert "no threshold is known for MICROBOLOMETER at 1550 nm" in found.unsaid[0]


def test_a_mistake_ends_with_2_and_its_place(neusee):
    code, out, err = neusee("safety", "safety_pointer", "~lasers.pointer.distance")
    assert (code, out) == (2, "")
    assert err.startswith("safety_pointer.yaml:9:3   lasers.pointer   needs distance\n1 problem, nothing was run")
    code, _, err = neusee("safety", "train_small")
    assert code == 2
    assert "add the block safety" in err
