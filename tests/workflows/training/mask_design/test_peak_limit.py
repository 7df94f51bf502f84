"""Masks designed for the picture behind a peak limit: the loss falls, the limit holds, the rival
is told.
"""

import json
import math

import numpy as np
import pytest
import torch
from pydantic import ValidationError
from safetensors.torch import load_file

from neusee.nodes import losses
from neusee.workflows import load
from neusee.workflows.store.result_store import Store
from neusee.workflows.training import design_run
from neusee.workflows.training import mask_optimisers as gradient_descent
from neusee.workflows.training.design_run import MaskTraining, design
from neusee.workflows.training.design_terms import Terms

SMALL = [
    "optics.samples=64",
    "optics.pitch=126 um",
    "optics.window=[80, 80]",
    "optics.bands=3",
    "scene.shape=[80, 80]",
    "sensor.shape=[64, 64]",
    "lasers.green.angle=[0 mrad, 0 mrad]",
]
PROTECTED = {"bands": None, "grid": 32, "scale": 0.2, "max_height": "4 um", "limit": 0.03, "light": "30 e-",
             "weights": {"lsr": 0, "bsr": 0, "filtered_error": 1}}  # fmt: skip


@pytest.fixture(scope="module")
def recipe():
    return load("first_light", SMALL)


@pytest.fixture(scope="module")
def store(tmp_path_factory):
    return Store(tmp_path_factory.mktemp("cache"))


def how(**values):
    return MaskTraining.model_validate({**PROTECTED, **values})


@pytest.mark.slow
@pytest.mark.parametrize(
    "weights", [{"filtered_error": 1}, {"information": 1}], ids=lambda w: next(iter(w))
)
def test_the_loss_falls_and_the_page_has_the_rival(weights, recipe, store, tmp_path, monkeypatch):
    monkeypatch.setattr(design_run, "design_pictures", lambda *_: {})
    given = how(weights={"lsr": 0, "bsr": 0, **weights}, iterations=8)
    terms, said = Terms(recipe, given, store), []
    start = gradient_descent.shape_of(terms, 0)(terms.stop)
    before = float(terms.total(terms.parts(start)).detach())
    folder = design(recipe, given, store, tmp_path, said.append)
    found = json.loads((folder / "mask.json").read_text())
    assert found["loss"] < 1.2 * before < 0
    assert any("against the best stop and filter" in text for text in said)
    page = next(folder.glob("*.html")).read_text()
    assert "Behind a peak limit" in page
    rows = found["protected"]["rows"]
    assert [row["light"] for row in rows] == [10, 30, 100, 300, 1000]
    assert found["protected"]["filter"] == pytest.approx(min(1, 0.03 / found["protected"]["lsr"]))
    own = _by_numpy(terms, load_file(folder / "mask.safetensors")["height"])
    assert rows[1]["filtered_error"] == pytest.approx(own, abs=1e-6)


def _by_numpy(terms, height):
    """The error of the picture at 30 e-, from the PSF by NumPy alone."""
    with torch.no_grad():
        psf = terms.psf(height)
    intensity, clear = psf.intensity.double().numpy(), psf.clear_peak.double().numpy()
    light, responses, bands = terms.seen()
    grey = min(1.0, 0.03 / (intensity / clear[:, None, None]).max())
    nu = np.hypot(*np.meshgrid(*(np.fft.fftfreq(80),) * 2, indexing="ij"))
    nu[0, 0] = np.inf
    scene = nu**-2.0 * 0.1 / (nu**-2.0).mean()
    logs = []
    for channel in responses.double().numpy() * light.double().numpy() * bands.centres.numpy():
        kernel = np.tensordot(channel / channel.sum(), intensity, 1)
        snr = (grey * 30 * np.abs(np.fft.fft2(kernel))) ** 2 / (grey * 30 + 10.5**2) * scene
        logs.append(math.log((scene / (1 + snr)).sum() / scene.sum()))
    return float(np.mean(logs))


def test_a_law_of_defocus_is_drawn_in_learning_and_averaged_in_the_end(recipe, store):
    terms = Terms(recipe, how(defocus_spread="0.5 waves"), store)
    height = gradient_descent.shape_of(terms, 0)(terms.stop).detach()
    sharp = float(Terms(recipe, how(), store).parts(height)["filtered_error"])
    points = [float(terms.parts(height, None, number)["filtered_error"]) for number in range(3)]
    assert len(set(points)) == 3
    exact = losses.filtered_error(terms.psf(height), *terms.seen(), **terms.exposure())
    assert float(exact) == pytest.approx(_by_numpy(terms, height), abs=1e-6)
    whole = float(terms.parts(height)["filtered_error"])
    assert whole != pytest.approx(sharp, abs=1e-6)
    far = [
        float(terms._parts(height, None, (x, 0, 0, 0), None)["filtered_error"])
        for x in (-(3**0.5), 3**0.5)
    ]
    assert whole == pytest.approx(2 / 3 * sharp + sum(far) / 6, abs=1e-5)


@pytest.mark.parametrize(
    ("values", "said"),
    [
        ({"weights": {"lsr": 1}}, "limit = 0.03 affects no term"),
        ({"weights": {"lsr": 0, "bsr": 0}}, "every weight of the loss is 0: set lsr, bsr"),
        ({"limit": 2}, "less than or equal to 1"),
        ({"light": "0 e-"}, "greater than 0"),
    ],
)
def test_settings_that_cannot_be_are_refused(values, said):
    with pytest.raises(ValidationError, match=said):
        how(**values)
