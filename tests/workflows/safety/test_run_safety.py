"""The folder of an estimate: computed once, taken from the store again, and complete."""

import json

import pytest

from neusee.workflows import Store, load
from neusee.workflows.safety import run_safety
from neusee.workflows.safety.exposures import Spread
from neusee.workflows.safety.safety_text import metres, scaled, share, with_ends

QUICK = [
    "safety.draws=100",
    "optics.samples=256",
    "optics.window=[96, 96]",
    "safety.protection.filter=null",
    "wide.window=[303, 303]",
    "safety.dazzle.share=0.001",
]


@pytest.fixture(scope="module")
def store(tmp_path_factory):
    return Store(tmp_path_factory.mktemp("store"))


@pytest.mark.slow
def test_an_estimate_is_computed_once_and_has_its_pictures_and_table(store, tmp_path, monkeypatch):
    first, found = run_safety.assess(
        load("safety_laboratory", QUICK), store, tmp_path / "runs", ["neusee", "safety"]
    )
    monkeypatch.setattr(
        run_safety, "complete", lambda *_: pytest.fail("the estimate was in the store")
    )
    second, again = run_safety.assess(
        load("safety_laboratory", QUICK), store, tmp_path / "runs", ["neusee", "safety"]
    )
    assert (again.document, again.paragraphs) == (found.document, found.paragraphs)
    for name in (
        "limits.csv",
        "recipe.yaml",
        "figures/pattern.png",
        "figures/distances.png",
        "figures/irradiance.png",
    ):
        assert (first / name).read_bytes() == (second / name).read_bytes(), name
    text = (second / "report.html").read_text(encoding="utf-8")
    assert "<h2" in text
    assert "Pattern of damage" in text
    assert (
        json.loads((second / "provenance.json").read_text())["limits"]
        == json.loads(json.dumps(found.document))["limits"]
    )


@pytest.mark.slow
def test_the_key_changes_with_the_table_of_thresholds_and_with_the_distance(store, tmp_path):
    table, few = tmp_path / "mine.csv", ["safety.draws=100", "safety.protection={}"]
    spans = "wavelength from (nm),wavelength to (nm),duration from (ns),duration to (ns)"
    keys = set()
    for joules, metres_ in ((1, 2), (2, 2), (2, 3), (2, 3)):
        table.write_text(
            f"device,damage,{spans},threshold"
            f" (J/cm2),source\nCMOS,point,500,600,1,100,{joules},bench\n"
        )
        changes = [*few, f"safety.damage.file={table}", f"lasers.reflection.distance={metres_} m"]
        recipe = load("safety_laboratory", changes)
        keys.add(run_safety.key_of(recipe, run_safety.prepare(recipe, store), store))
    assert len(keys) == 3


@pytest.mark.parametrize(
    ("value", "unit", "text"),
    [
        (2.04e7, "W/m²", "20.4 MW/m²"),
        (999.9, "J", "1 kJ"),
        (0.0, "W", "0 W"),
        (3e-20, "J", "3e-20 J"),
        (1e20, "W", "1e+20 W"),
    ],
)
def test_a_quantity_has_three_digits_and_a_prefix(value, unit, text):
    assert scaled(value, unit) == text


def test_an_interval_shares_the_unit_of_its_middle():
    assert with_ends(Spread(2e9, 4e8, 1e10), "W/cm²", 1e-4) == "200 (40 to 1000) kW/cm²"
    assert with_ends(Spread(2.0, 2.0, 2.0), "W") == "2 W"


def test_shares_are_no_more_exact_than_they_are_known():
    assert [share(x) for x in (0.0, 1e-6, 0.05, 0.5, 0.999, 1.0)] == [
        "0 %",
        "< 0.01 %",
        "5 %",
        "50 %",
        "99.90 %",
        "100 %",
    ]
    assert [metres(x) for x in (0.5, 99.96, 1234.0)] == ["0.5 m", "100 m", "1.23 km"]
