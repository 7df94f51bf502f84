"""What a laboratory states: mistakes are told where they stand, and draws have the uncertainty
of the light.
"""

from types import SimpleNamespace

import numpy as np
import pytest
import torch

from neusee.nodes.calibrate import Laboratory
from neusee.workflows.calibration.emcee_sampler import Chains
from neusee.workflows.calibration.identifiability import Identifiability
from neusee.workflows.calibration.uncertainty_budget import (
    RELATIVE,
    laboratory_of,
    with_laboratory,
    without_efficiency,
)
from neusee.workflows.graph.errors import RecipeError
from neusee.workflows.recipe.loading import load

NAMES = ("gain", "quantum_efficiency", "dark_signal")


def told(*changes):
    return load("calibrate_camera", [f"traceability.{change}" for change in changes])


def test_statements_become_uncertainties_and_no_statement_none():
    found = laboratory_of(
        told(
            "photons={relative_uncertainty: 0.03, degrees_of_freedom: 12, distribution: rectangular}",
            "lamp={centroid: 525 nm, centroid_uncertainty: 2 nm, efficiency_per_nm: -0.004, drift: 0.01}",
            "temperature={value: 25 °C, uncertainty: 0.5 K, coefficients: {gain: 1e-3}}",
        )
    )
    assert found.light == [
        ("rectangular", 0.03),
        ("normal", 0.01),
        ("normal", pytest.approx(0.008)),
    ]
    assert (found.photons_freedom, found.temperature, dict(found.coefficients)) == (
        12,
        0.5,
        {"gain": 1e-3},
    )
    assert (
        load(
            "calibrate_camera", ["traceability.temperature.value=298.15 K"]
        ).traceability.temperature.text
        == "25 °C"
    )
    assert laboratory_of(load("calibrate_camera")) == Laboratory()


@pytest.mark.parametrize(
    ("change", "message"),
    [
        ("photon.certificate=1", "unknown; did you mean photons?"),
        ("photons.relative_uncertainty=3", "less than 1"),
        ("temperature.value=25", "needs a unit: write 25 °C or 25 K"),
        ("lamp.centroid=525", "needs a unit"),
        ("lamp.fwhm=20 K", "wrong unit"),
    ],
)
def test_a_mistake_is_told_where_it_stands(change, message):
    with pytest.raises(RecipeError) as error:
        told(change)
    (only,) = error.value.diagnostics
    assert message in only.message
    assert str(only.mark).startswith("argument 1")


def test_a_coefficient_of_what_has_none_is_refused():
    with pytest.raises(ValueError, match="gian has no coefficient; did you mean gain"):
        laboratory_of(told("temperature.coefficients={gian: 1e-3}"))


def test_draws_of_the_efficiency_alone_move_with_the_light_and_the_temperature_moves_all_together():
    rng = np.random.default_rng(1)
    draws = np.array([0.25, 0.5, 60.0]) * (1 + 1e-3 * rng.standard_normal((4, 500, 8, 3)))
    problem = SimpleNamespace(
        parameters=lambda x: {name: torch.from_numpy(x[..., i]) for i, name in enumerate(NAMES)},
        theta=lambda values: np.stack([values[name].numpy() for name in NAMES], -1),
    )
    chains = Chains(draws, np.zeros(draws.shape[:-1]), 0.5, 1.0, 500, True)
    light = Laboratory(photons=0.03, photons_distribution="rectangular", drift=0.01)
    moved = with_laboratory(problem, chains, light, 7).flat / chains.flat
    assert np.all(moved[:, [0, 2]] == 1)
    assert moved[:, 1].std() == pytest.approx(np.hypot(0.03, 0.01), rel=0.03)
    assert abs(np.corrcoef(moved[:, 1], chains.flat[:, 0])[0, 1]) < 0.03
    warm = Laboratory(temperature=0.5, coefficients={"gain": 0.02, "dark_signal": -0.04})
    moved = with_laboratory(problem, chains, warm, 7).flat / chains.flat
    assert moved[:, 0].std() == pytest.approx(0.01, rel=0.03)
    assert np.allclose(moved[:, 2] - 1, -2 * (moved[:, 0] - 1))
    assert np.all(moved[:, 1] == 1)
    assert with_laboratory(problem, chains, Laboratory(), 7) is chains


def test_relative_light_leaves_no_efficiency():
    known = Identifiability(
        {"gain": "estimate", "quantum_efficiency": "estimate"}, [], [9.0, 8.0], ""
    )
    found = without_efficiency(known)
    assert found.told == ("gain",)
    assert found.directions == [RELATIVE]
