"""`neusee safety` prints limits and distances, writes a page, and refuses what it cannot
estimate with exit code 2.
"""

import json

import pytest

from neusee.workflows import load
from neusee.workflows.cli import app
from neusee.workflows.safety.safety_estimate import estimate

LONG_PULSE = """\
# A pulse of a microsecond, 20 m away.
defaults: [camera: lens_only, optics: lens_only, doe: flat]
lasers:
  long: {wavelength: 532 nm, pulse_energy: 1 mJ, pulse_duration: 1 us, repetition_rate: 10 Hz, divergence: 1 mrad,
         distance: 20 m}
safety:
  lens: {focal_length: 50 mm, diameter: 12 mm, transmittance: 0.9, focus: laser}
  sensor: {pixel_pitch: 3.45 um, shape: [1536, 2048], quantum_efficiency: 0.65, full_well: 10500 e-, exposure: 10 ms}
outputs: [laser_lsr]
"""
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


@pytest.mark.slow
def test_the_terminal_has_limits_distances_eye_and_sources(neusee, tmp_path):
    code, out, err = neusee("safety", "safety_pointer", *QUICK)
    assert (code, err) == (0, "")
    lines = out.splitlines()
    assert (
        lines[1] == "An estimate, not a certificate: neusee decides nothing about eyes or sensors."
    )
    for words in (
        "MPE",
        "NOHD",
        "Schwarz et al.",
        "no veil is computed",
        "IEC 60825-1:2014",
        "may blind people",
    ):
        assert words in " ".join(out.split()), words
    page = tmp_path / "runs" / lines[-1].rpartition("runs/")[2]
    text = page.read_text(encoding="utf-8")
    assert text.count("An estimate, not a certificate") >= 5
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
    assert found["certificate"].startswith("An estimate, not a certificate")
    assert {each["effect"] for each in found["limits"]} == {"damage"}
    assert all(each["source"] for each in found["limits"])
    assert found["not_said"] == [
        (
            "Damage is not judged for the mean and the accumulation: no law of damage at 1550 nm:"
            " published laws are used from 400 to 1100 nm. Name a table of your own:"
            " safety.damage.file."
        ),
        (
            "No statement about dazzle: the recipe does not set quantum efficiency, full well, exposure"
            " of the sensor at this wavelength."
        ),
    ]
    assert found["damage"][0]["verdict"] == "not judged"
    assert (
        found["eye"]["distance"]["low"]
        < found["eye"]["distance"]["value"]
        < found["eye"]["distance"]["high"]
    )


def test_without_thresholds_the_estimate_says_that_damage_is_not_known():
    found = estimate(
        load("safety_car_lidar_1550", [*QUICK, "safety.damage={device: MICROBOLOMETER}"])
    )
    assert found.findings == ()
    assert (
        "no law of damage for the device MICROBOLOMETER: there are published laws for CCD, CMOS"
        in found.unsaid[0]
    )
    assert {row.state for verdict in found.damage for row in verdict.rows} == {"not judged"}


@pytest.mark.slow
def test_a_pulse_of_a_microsecond_reads_as_far_beyond_and_not_as_nowhere(
    neusee, tmp_path, monkeypatch
):
    """1 mJ in 1 us at 10 Hz, 20 m: the mean is 2.3 times its threshold, the pulse 3.4e4 times;
    once "nowhere, 14 %".
    """
    (tmp_path / "long.yaml").write_text(LONG_PULSE)
    monkeypatch.chdir(tmp_path)
    code, out, _ = neusee("safety", "long.yaml")
    text = " ".join(out.split())
    assert code == 0
    assert (
        "Damage is expected at 20 m behind the plain lens: one pulse of 7.3 kJ/cm² on the sensor is"
        " 33900" in text
    )
    assert "It exceeds the threshold from below 1 m to 4.39 km" in text
    assert "nowhere" not in text.replace("probability of nowhere", "")
    code, out, _ = neusee("safety", "long.yaml", "lasers.long.pulse_duration=100 fs", "--json")
    rows = json.loads(out)["damage"][0]["rows"]
    assert [row["part"] for row in rows] == ["pulse", "mean", "accumulation", "incubation"]


def test_damage_need_not_be_asked_for(neusee, tmp_path, monkeypatch):
    (tmp_path / "long.yaml").write_text(LONG_PULSE)
    monkeypatch.chdir(tmp_path)
    for none in ("none", "null"):
        code, out, _ = neusee("safety", "long.yaml", f"safety.damage={none}", "--json")
        found = json.loads(out)
        assert (code, found["damage"], found["limits"]) == (0, [], [])
        assert (
            "No statement about damage: the recipe does not request it (safety.damage)."
            in found["not_said"]
        )


def test_a_mistake_ends_with_2_and_its_place(neusee):
    code, out, err = neusee("safety", "safety_pointer", "~lasers.pointer.distance")
    assert (code, out) == (2, "")
    assert err.startswith(
        "safety_pointer.yaml:9:3   lasers.pointer   needs distance\n1 problem, nothing was run"
    )
    code, _, err = neusee("safety", "train_small")
    assert code == 2
    assert "add the block safety" in err
