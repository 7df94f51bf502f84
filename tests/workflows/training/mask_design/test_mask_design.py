"""Designing a mask without images: every kind learns, an interrupted one goes on bit for bit,
the file is the mask.
"""

import csv
import json
import math

import pytest
import torch
from pydantic import ValidationError
from safetensors.torch import load_file

import neusee
from neusee.nodes.doe import half_rings
from neusee.workflows import load
from neusee.workflows.report.figures import optics
from neusee.workflows.store.result_store import Store
from neusee.workflows.training import design_run
from neusee.workflows.training import mask_optimisers as gradient_descent
from neusee.workflows.training.design_run import (
    DesignError,
    MaskTraining,
    design,
    mask_figures,
)
from neusee.workflows.training.design_terms import Terms
from neusee.workflows.training.resumable_loop import StateFile

SMALL = [
    "optics.samples=64",
    "optics.pitch=126 um",
    "optics.window=[80, 80]",
    "optics.bands=5",
    "scene.shape=[80, 80]",
    "sensor.shape=[64, 64]",
    "lasers.green.angle=[0 mrad, 0 mrad]",
]
QUICK = {"bands": 3, "grid": 32, "width": 4, "modes": 20, "rings": 10, "waves": 1.0, "noise": 0.3, "scale": 0.2,
         "max_height": "4 um", "polish": 10, "weights": {"lsr": 1.0, "bsr": 2.0, "contrast": 0.5}}  # fmt: skip


def quiet(_):
    pass


def how(**values):
    return MaskTraining.model_validate({**QUICK, **values})


@pytest.fixture(scope="module")
def store(tmp_path_factory):
    return Store(tmp_path_factory.mktemp("cache"))


@pytest.fixture(scope="module")
def recipe():
    return load("first_light", SMALL)


@pytest.fixture(autouse=True)
def without_pictures(request, monkeypatch):
    """Pictures take longer than what is tested; one test looks at them."""
    if "file_is_the_mask" not in request.node.name:
        monkeypatch.setattr(design_run, "design_pictures", lambda *_: {})


def loss_of(terms, height):
    with torch.no_grad():
        return float(terms.total(terms.parts(height)))


def read(folder):
    return json.loads((folder / "mask.json").read_text())


@pytest.mark.slow
@pytest.mark.parametrize("kind", ["pixelwise", "zernike", "rings", "unet"])
def test_every_kind_lowers_its_loss_on_all_bands(kind, recipe, store, tmp_path):
    given = how(kind=kind, iterations=15)
    terms = Terms(recipe, given, store)
    before = loss_of(terms, gradient_descent.shape_of(terms, 0)(terms.stop))
    folder = design(recipe, given, store, tmp_path, quiet)
    found = read(folder)
    assert found["loss"] < before - 0.1
    height = load_file(folder / "mask.safetensors")["height"]
    assert loss_of(terms, height) == pytest.approx(found["loss"], rel=1e-5)
    rows = list(csv.DictReader((folder / "history.csv").read_text().splitlines()))
    assert [int(row["iteration"]) for row in rows] == list(range(15))
    assert {"loss", "lsr", "bsr", "contrast"} <= set(rows[0])


@pytest.mark.slow
def test_the_file_is_the_mask_and_the_bounds_hold_on_it(recipe, store, tmp_path, monkeypatch):
    given, draw = {}, optics.suppression
    monkeypatch.setattr(
        optics, "suppression", lambda **values: given.update(values) or draw(**values)
    )
    folder = design(recipe, how(iterations=10), store, tmp_path, quiet)
    found = read(folder)
    again = load(
        "first_light", [*SMALL, "doe=pixelwise", f"doe.file={folder / 'mask.safetensors'}"]
    )
    lsr = neusee.run(again, store=store, outputs=["lsr[mask]"])["lsr[mask]"]
    assert lsr.tolist() == pytest.approx(found["bands"]["lsr"], rel=1e-5)
    bands = {name: torch.tensor(values) for name, values in found["bands"].items()}
    assert bool((bands["lsr"] >= bands["energy_floor"]).all())
    assert bool((bands["rms_all"] <= bands["rms_all_bound"]).all())
    assert bool((bands["rms_mtf"] <= bands["rms_mtf_bound"]).all())
    assert bool((bands["median_mtf"] <= bands["median_mtf_bound"]).all())
    assert not list(tmp_path.glob(".*state*"))
    assert (tmp_path / "latest").exists()
    assert {path.name for path in (folder / "figures").iterdir()} == {
        "height.png",
        "psf.png",
        "suppression.png",
        "history.png",
    }
    text = (folder / "report.html").read_text()
    assert "median MTF" in text
    assert "even light" in text
    assert given["bsr"].tolist() == found["bands"]["bsr"]  # the panel of the BSR is not empty


def test_the_losses_of_several_starts_have_a_legend():
    rows = [
        {"start": i, "iteration": n, "loss": 1.0 + i, "lsr": -n} for i in range(3) for n in range(4)
    ]
    figure = design_run.history_figure.__wrapped__(rows)
    assert [text.get_text() for text in figure.legends[0].get_texts()] == ["0", "1", "2"]
    assert design_run.history_figure.__wrapped__(rows[:4]).legends == []


@pytest.mark.slow
@pytest.mark.parametrize(("kind", "values"), [("pixelwise", {}), ("unet", {"starts": 2}),
                                              ("five_half_rings", {"population": 8})])  # fmt: skip
def test_an_interrupted_design_goes_on_bit_for_bit(kind, values, recipe, store, tmp_path):
    given = how(kind=kind, iterations=6, save_every=1 if kind == "five_half_rings" else 2, **values)
    whole = design(recipe, given, store, tmp_path / "whole", quiet)
    calls, heard = [0], []

    def stopped(terms, *rest):
        calls[0] += 1
        if calls[0] == 9 * given.starts + 20 * (kind == "five_half_rings"):
            raise KeyboardInterrupt
        return asked(terms, *rest)

    with pytest.MonkeyPatch.context() as patch:
        asked = Terms.parts
        patch.setattr(Terms, "parts", stopped)
        calls[0] = 4 * (kind != "five_half_rings")
        with pytest.raises(KeyboardInterrupt):
            design(recipe, given, store, tmp_path / "parts", quiet)
    assert not (tmp_path / "parts" / "latest").exists()
    calls[0] = -1000
    resumed = design(recipe, given, store, tmp_path / "parts", heard.append)
    assert any("continues" in line for line in heard)
    one, two = (load_file(folder / "mask.safetensors")["height"] for folder in (whole, resumed))
    assert torch.equal(one, two)
    assert (whole / "history.csv").read_text() == (resumed / "history.csv").read_text()


def test_a_damaged_state_begins_again(recipe, store, tmp_path):
    kept = StateFile(tmp_path / "state")
    assert kept.read(strict=False) == {}
    kept.write({"a": torch.ones(3)})
    assert torch.equal(kept.read(strict=False)["a"], torch.ones(3))
    kept.path.write_bytes(kept.path.read_bytes()[:40])
    assert kept.read(strict=False) == {}


def test_evolved_half_rings_beat_those_that_nobody_optimised(recipe, store, tmp_path):
    given = how(kind="five_half_rings", iterations=4, population=10, slopes=(1.0, 40.0))
    terms = Terms(recipe, given, store)
    usual = half_rings(terms.stop, waves=(12, 18, 24, 30, 36))
    found = read(design(recipe, given, store, tmp_path, quiet))
    assert found["loss"] < loss_of(terms, usual) - 0.05
    assert len(found["numbers"]["waves"]) == 5
    assert all(1.0 <= slope <= 40.0 for slope in found["numbers"]["waves"])


def test_what_is_learnt_on_few_samples_is_made_on_all(recipe, store, tmp_path):
    at = {"optics.samples": 48, "optics.pitch": "168 um", "optics.window": [60, 60]}
    folder = design(recipe, how(kind="zernike", iterations=4, at=at), store, tmp_path, quiet)
    height = load_file(folder / "mask.safetensors")["height"]
    assert height.shape == (64, 64)
    terms = Terms(recipe, how(), store)
    assert read(folder)["mean"] == pytest.approx(mask_figures(terms, height)["mean"])


def test_pixels_start_from_the_relief_of_another_kind(recipe, store, tmp_path):
    first = design(recipe, how(kind="rings", iterations=2), store, tmp_path, quiet)
    file, deep = str(first / "mask.safetensors"), read(first)["depth"] * 1e6
    given = how(
        iterations=8, grid=64, start=file, max_height=f"{1.2 * deep} um", learning_rate=1e-4
    )
    second = design(recipe, given, store, tmp_path, quiet)
    assert read(second)["loss"] < read(first)["loss"]
    with pytest.raises(
        DesignError, match=r"start: mask mask.safetensors is .* deep: set a larger max_height"
    ):
        design(recipe, how(iterations=1, start=file, max_height="1 um"), store, tmp_path, quiet)


def test_all_bands_are_seen_in_time(recipe, store):
    terms = Terms(recipe, how(bands=2), store)
    drawn = [terms.drawn(number) for number in range(40)]
    assert drawn[3] == terms.drawn(3)
    assert {band for pair in drawn for band in pair} == set(range(5))
    assert terms.even() == [0, 4]
    assert Terms(recipe, how(bands=None), store).drawn(0) is None


def test_the_recipes_own_relief_is_learnt_sample_by_sample_until_it_is_enough(store, tmp_path):
    """From a half-ring on: what a filter leaves wrong falls, and an LSR that is enough pulls no
    more.
    """
    ring = load("half_ring", [*SMALL, "doe.waves=[2]"])
    weights = {"lsr": 2.0, "bsr": 1.0, "wiener": 1.0}
    given = how(
        kind="recipe_mask",
        iterations=12,
        weights=weights,
        up_to=0.1,
        enough=0.3,
        bands=None,
        learning_rate=0.02,
    )
    terms = Terms(ring, given, store)
    start = neusee.run(ring, store=store, outputs=["height"])["height"]
    before, after = (
        terms.parts(height)
        for height in (
            start,
            load_file(design(ring, given, store, tmp_path, quiet) / "mask.safetensors")["height"],
        )
    )
    assert float(before["lsr"]) == pytest.approx(math.log(0.3), rel=1e-6)
    assert float(after["lsr"]) == pytest.approx(math.log(0.3), rel=1e-6)
    assert float(after["wiener"]) < float(before["wiener"]) - 0.05
    free = Terms(ring, given.model_copy(update={"enough": None}), store)
    assert float(free.parts(start)["lsr"]) < math.log(0.3)


def test_a_filter_leaves_the_same_wrong_of_all_bands_chosen_or_not(recipe, store):
    given = how(bands=None, weights={"wiener": 1.0})
    terms = Terms(recipe, given, store)
    height = neusee.run(recipe, store=store, outputs=["height"])["height"]
    whole, chosen = (float(terms.parts(height, bands)["wiener"]) for bands in (None, range(5)))
    assert whole == pytest.approx(chosen, rel=1e-6)
    assert float(terms.parts(height, [1, 3])["wiener"]) != pytest.approx(whole, rel=1e-3)


def test_a_relief_that_is_not_learnt_is_refused(store, tmp_path):
    flat = load("plain_lens", SMALL)
    with pytest.raises(
        DesignError, match=r"kind: the step height \(doe.flat\) has no trainable parameters"
    ):
        design(flat, how(kind="recipe_mask", iterations=1), store, tmp_path, quiet)


@pytest.mark.parametrize(("values", "said"), [
    ({"height": "hight"}, r"height: .*'hight'.*height"),
    ({"weights": {"wiener": 1.0}, "responses": "response"}, r"responses: .*'response'.*responses"),
    ({"psf": "psf[mast]"}, r"psf: .*psf\[mast\]"),
    ({"at": {"optics.sample": 3}}, r"at: .*sample"),
])  # fmt: skip
def test_what_is_not_in_the_recipe_is_said(values, said, recipe, store, tmp_path):
    with pytest.raises((DesignError, ValueError), match=said):
        design(recipe, how(iterations=1, **values), store, tmp_path, quiet)
    assert not list(tmp_path.glob("[!.]*"))


@pytest.mark.parametrize("kind", ["pixelwise", "five_half_rings"])
def test_a_loss_that_is_not_finite_stops_with_its_place(kind, recipe, store, tmp_path, monkeypatch):
    monkeypatch.setattr(
        Terms, "total", lambda self, parts: next(iter(parts.values())) * float("nan")
    )
    with pytest.raises(DesignError, match=r"(iteration 0|mask number 0).*is NaN or infinite"):
        design(recipe, how(kind=kind, iterations=2), store, tmp_path, quiet)


@pytest.mark.parametrize("values", [{"kind": "cubic"}, {"iterations": 0}, {"slopes": [9, 3]}, {"learning_rat": 1},
                                    {"weights": {"lsr": 0, "bsr": 0}}, {"max_height": 3}])  # fmt: skip
def test_settings_that_cannot_be_are_refused(values):
    with pytest.raises(ValidationError):
        how(**values) if "weights" not in values else MaskTraining.model_validate(values)


@pytest.mark.parametrize("schedule", ["cosine", "step"])
def test_the_rate_falls(schedule):
    given = how(schedule=schedule, iterations=50)
    rates = [gradient_descent.rate(given, number) for number in range(50)]
    assert rates[0] == given.rate
    assert rates == sorted(rates, reverse=True)
    assert rates[-1] < 0.1 * rates[0]
