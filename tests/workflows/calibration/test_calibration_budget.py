"""The split of a calibration's variance, beside the scatter of measurements that NumPy repeats
(JCGM 101).
"""

import csv

import numpy as np
import pytest

from neusee.nodes.calibrate import STATISTICS, Laboratory
from neusee.workflows.calibration.calibration_page import CalibrationResult
from neusee.workflows.calibration.emcee_sampler import Chains
from neusee.workflows.calibration.identifiability import identify
from neusee.workflows.calibration.log_posterior import SensorPosterior, find_mode, initial_theta
from neusee.workflows.calibration.uncertainty_budget import budgets, two_digits
from neusee.workflows.recipe.loading import load
from neusee.workflows.store.result_store import Store

K, ETA, NOISE, PIXELS, LIT, LAMP = 0.25, 0.5, 12.0, 2000, 24, 0.015
TIMES = 40
#: a linear response, so that the lamp and the frames decide the efficiency
FIXED = ("steps.prior.with.bend=null", "steps.prior.with.twist=null")


def write_table(file, rng, lamp):
    """Moments of six darks and 24 lit levels, whose light differs from the told one by ``lamp``
    (level,).
    """
    photons = np.concatenate([np.zeros(6), np.linspace(1200, 24000, LIT)])
    exposure = np.concatenate([1e-3 + 1e-2 * np.arange(6), np.full(LIT, 1e-3)])
    electrons = ETA * photons * (1 + np.concatenate([np.zeros(6), lamp])) + 40 * exposure
    variance = K**2 * (NOISE**2 + electrons) + 1 / 12
    mean = 60 + K * electrons + rng.standard_normal(6 + LIT) * np.sqrt(variance / (2 * PIXELS))
    variance *= rng.chisquare(PIXELS, 6 + LIT) / PIXELS
    with file.open("w", newline="") as opened:
        writer = csv.writer(opened)
        writer.writerow(["photons", "exposure_s", "pixels", "mean", "variance"])
        writer.writerows(zip(photons, exposure, [PIXELS] * (6 + LIT), mean, variance, strict=True))


def fitted(file, store):
    problem = SensorPosterior.of(load("calibrate_camera", [f"table.file={file}", *FIXED]), store)
    return problem, find_mode(problem, initial_theta(problem))


@pytest.mark.slow
def test_the_statistics_of_the_frames_are_the_scatter_under_the_same_lamp(tmp_path):
    """40 measurements under one pattern of lamp errors of 1.5 % scatter as the frames alone."""
    rng, store = np.random.default_rng(2), Store(tmp_path / "store")
    lamp, found = LAMP * rng.standard_normal(LIT), []
    for i in range(TIMES):
        write_table(tmp_path / f"{i}.csv", rng, lamp)
        problem, mode = fitted(tmp_path / f"{i}.csv", store)
        found.append({name: float(x) for name, x in problem.parameters(mode.theta).items()})
    draws = mode.draw(2000, rng).reshape(4, 100, 5, -1)
    chains = Chains(draws, np.zeros(draws.shape[:-1]), 0.5, 1.0, 100, True)
    unwidened = {name: float(x.std()) for name, x in problem.parameters(draws).items()}
    result = CalibrationResult(problem, mode, identify(problem, mode), chains, [])
    lines = {
        b.key: {c.source: c.share or 0.0 for c in b.contributions}
        for b in budgets(result, Laboratory())
    }
    for name in ("gain", "quantum_efficiency", "temporal_dark_noise"):
        scatter = np.std([each[name] for each in found], ddof=1)
        # 3.5 standard errors of 40
        assert lines[name][STATISTICS] == pytest.approx(scatter, rel=0.4), name
        assert np.hypot.reduce(list(lines[name].values())) == pytest.approx(
            unwidened[name], rel=1e-6
        ), name
    assert lines["dark_signal"][STATISTICS] < 3 * np.std(
        [each["dark_signal"] for each in found], ddof=1
    )
    of_lamp = lines["quantum_efficiency"]["lamp, from level to level"]
    # 24 levels tell the lamp to 15 %
    assert of_lamp == pytest.approx(ETA * LAMP / np.sqrt(LIT), rel=0.5)


def test_an_expanded_uncertainty_has_two_digits_and_no_exponent_of_a_large_number():
    assert [two_digits(x) for x in (1043.0, 708.0, 0.0148, 2.96)] == ["1000", "710", "0.015", "3"]
