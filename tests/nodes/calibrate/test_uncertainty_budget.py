"""Budgets of the GUM: a published example, and draws in NumPy (JCGM 101) that share no line with
the budgets.
"""

import math

import numpy as np
import pytest
import torch

from neusee.nodes.calibrate import (
    Budget,
    Contribution,
    Laboratory,
    camera_sources,
    coverage_factor,
    emva_sheet,
    laboratory_contributions,
    sheet_budgets,
    variance_shares,
)
from neusee.nodes.values import Levels

K, ETA, NOISE, OFFSET, PIXELS = 0.25, 0.5, 12.0, 60.0, 4096
LAMP, PHOTONS = 0.004, 0.02


def test_the_gauge_block_of_the_gum_has_its_published_degrees_of_freedom_and_factor():
    """JCGM 100:2008, H.1: components of 25, 9.7, 2.9 and 16.6 nm give 32 nm, 16 degrees of
    freedom, k99 = 2.92.
    """
    parts = [(25.0, 18.0), (9.7, 25.6), (2.9, 50.0), (16.6, 2.0)]
    lines = [Contribution(str(u), "B", "normal", u, "nm", 1.0, nu) for u, nu in parts]
    budget = Budget("length", "length", "l", "nm", 50.000838e6, tuple(lines))
    assert budget.combined == pytest.approx(32, abs=0.5)
    assert math.floor(budget.freedom) == 16
    assert coverage_factor(budget.freedom, 0.99) == pytest.approx(2.92, abs=0.005)
    assert budget.missing == ()
    lone = Budget(
        "x", "x", "x", "", 1.0, (lines[0], Contribution("lamp", "B", reason="not stated"))
    )
    assert lone.missing == ("lamp",)
    assert lone.combined == 25.0


def camera(rng=None, lamp=0.0, scale=1.0):
    """Moments of a linear camera in NumPy: 2 darks and 24 lit levels, the last ones saturated."""
    photons = np.concatenate([[0.0, 0.0], np.linspace(1500, 36000, 24)])
    light = photons * (1 + lamp * (rng.standard_normal(len(photons)) if rng else 0))
    electrons = ETA * light
    mean, variance = OFFSET + K * electrons, K**2 * (NOISE**2 + electrons) + 1 / 12
    full = mean >= 4000
    mean, variance = np.where(full, 4000.0, mean), np.where(full, 0.01, variance)
    if rng:
        mean = mean + rng.standard_normal(len(mean)) * np.sqrt(variance / (2 * PIXELS))
        variance = variance * rng.chisquare(PIXELS, len(mean)) / PIXELS
    return photons * scale, mean, variance


def fitted(photons, mean, variance):
    """K, eta in percent, sigma_d and mu_e.sat by the formulas of the standard, in NumPy alone."""
    dark, lit = photons == 0, photons > 0
    signal, excess = mean[lit] - mean[dark][0], variance[lit] - variance[dark][0]
    top = int(variance[lit].argmax())
    used = signal <= 0.7 * signal[top]
    gain = signal[used] @ excess[used] / (signal[used] @ signal[used])
    response = photons[lit][used] @ signal[used] / (photons[lit][used] @ photons[lit][used])
    noise = math.sqrt(max(variance[dark][0], 0.24) - 1 / 12) / gain
    return np.array([gain, 100 * response / gain, noise, response / gain * photons[lit][top]])


def tabled(photons, mean, variance):
    one = torch.full((len(photons),), float(PIXELS), dtype=torch.float64)
    none = torch.zeros(0, dtype=torch.float64)
    found = (torch.tensor(x, dtype=torch.float64) for x in (photons, np.full(len(photons), 0.01)))
    moments = (torch.tensor(x, dtype=torch.float64) for x in (mean, variance))
    return Levels(*found, 2 * one, *moments, one, none.long(), none, none)


def test_the_budget_of_a_sheet_is_that_of_draws_in_numpy():
    """4000 measurements drawn in NumPy, each fitted in NumPy; the budget sees one of them."""
    rng = np.random.default_rng(1)
    draws = 4000
    found = np.array(
        [fitted(*camera(rng, LAMP, 1 + PHOTONS * rng.standard_normal())) for _ in range(draws)]
    )
    levels = tabled(*camera(np.random.default_rng(9), LAMP))
    laboratory = Laboratory(photons=PHOTONS)
    budgets = {b.symbol: b for b in sheet_budgets(levels, emva_sheet(levels), laboratory)}
    names = ("K", "η", "σ_d", "μ_e.sat")
    # the deviations of 24 levels from a line tell the lamp to 15 %; which level saturates is a
    # matter of chance
    for name, u, room in zip(names, found.std(0, ddof=1), (0.06, 0.06, 0.06, 0.15), strict=True):
        parts = [
            c.share
            for c in budgets[name].contributions
            if c.share and c.source != "model of the response"
        ]
        assert math.hypot(*parts) == pytest.approx(u, rel=room), name
    light = next(c for c in budgets["η"].contributions if c.source.startswith("photometric"))
    assert light.share == pytest.approx(PHOTONS * budgets["η"].value, rel=1e-6)
    assert {c.reason for c in budgets["K"].contributions if c.source.startswith("photometric")} == {
        "does not enter"
    }
    assert "temperature" in budgets["K"].missing


def test_what_a_laboratory_states_enters_with_its_sensitivity():
    """By hand: an efficiency of 0.5, 3 % of the photons, 1 % of drift, 2 nm at 0.5 % a nm, 0.4 K
    at 0.1 % a kelvin.
    """
    told = Laboratory(
        photons=0.03,
        drift=0.01,
        wavelength=2.0,
        slope=0.005,
        temperature=0.4,
        coefficients={"quantum_efficiency": 1e-3},
    )
    lines = list(laboratory_contributions("quantum_efficiency", 0.5, -0.5, told))
    assert [c.share for c in lines] == pytest.approx([0.015, 0.005, 0.005, 0.0002])
    lines = list(laboratory_contributions("gain", 0.25, 0.0, told))
    assert [c.reason for c in lines] == ["does not enter"] * 3 + [
        "not stated: no coefficient of this quantity"
    ]
    lines = list(laboratory_contributions("quantum_efficiency", 0.5, -0.5, Laboratory()))
    assert {c.reason for c in lines} == {"not stated"}
    assert {c.share for c in lines} == {None}


def test_the_variance_of_a_weighted_mean_splits_into_its_sources_as_by_hand():
    """Mean of rows whose errors are 1 and 2 of two sources: weights 4/5 and 1/5 without a prior
    that counts.
    """
    slopes = torch.tensor([[1e4], [0.5e4]], dtype=torch.float64)
    sources = {"a": torch.tensor([1.0, 0.0]).double(), "b": torch.tensor([0.0, 1.0]).double()}
    shares = variance_shares(slopes, sources, torch.ones(1, dtype=torch.float64))
    assert shares["a"] == pytest.approx(0.64 / (0.64 + 0.04 * 4), rel=1e-6)
    assert shares["prior"] < 1e-6
    levels = tabled(*camera(np.random.default_rng(3), LAMP))
    params = {"gain": K, "quantum_efficiency": ETA, "dark_signal": OFFSET, "temporal_dark_noise": NOISE,
              "dark_current": 0.0, "scatter": 0.002, "lamp": LAMP, "drift": 0.01, "bend": 0.0, "twist": 0.0,
              "share": 0.7}  # fmt: skip
    rows = torch.stack(list(camera_sources(levels, params).values()))
    assert torch.allclose(rows.sum(0), torch.ones(rows.shape[1], dtype=torch.float64))
