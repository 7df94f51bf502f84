"""Simulated frames of a flat field: the means and variances of the model, level by level."""

import math

import pytest
import torch

from neusee.nodes.calibrate import expose

SENSOR = {
    "quantum_efficiency": 0.5,
    "dark_current": 20.0,
    "dark_exposure": 0.1,
    "offset": 300.0,
    "read_noise": 10.0,
}
SENSOR |= {"full_well": 1e5, "gain": 2.0}


def frames(photons=1000.0, exposure=0.1, seed=1, **how):
    rng = torch.Generator().manual_seed(seed)
    return expose(
        photons=photons, exposure=exposure, shape=(200, 100), rng=rng, **{**SENSOR, **how}
    )


@pytest.mark.parametrize("distribution", ["gaussian", "poisson"])
@pytest.mark.parametrize(
    ("photons", "exposure"), [(0.0, 0.1), (0.0, 10.0), (1000.0, 0.1), (20000.0, 1.0)]
)
def test_mean_and_variance_are_those_of_the_model(distribution, photons, exposure):
    found = frames(photons, exposure, frames=3, distribution=distribution).double()
    electrons = 0.5 * photons + 20.0 * exposure / 0.1
    variance = 4 * (electrons + 100.0) + 1 / 12
    assert float(found.mean()) == pytest.approx(
        2 * (electrons + 300.0), abs=4 * math.sqrt(variance / 60_000)
    )
    assert float(found.var()) == pytest.approx(variance, rel=4 * math.sqrt(2 / 60_000))


def test_shape_and_whole_numbers():
    found = frames(frames=3, gain=1 / 0.37)
    assert found.shape == (3, 200, 100)
    assert torch.equal(found, found.round())
    assert not torch.equal(found[0], found[1])
    assert frames().shape[0] == 2


def test_the_well_and_the_converter_end_what_is_seen():
    assert frames(1e7).unique().tolist() == [65535.0]
    assert frames(1e7, full_well=1000.0).unique().tolist() == [2000.0]


def test_spread_and_shift_are_those_of_the_paper():
    found = frames(20000.0, spread=2.0, mean_shift=0.1).double()
    assert float(found.mean()) == pytest.approx(2 * (11000 + 20 + 300), rel=1e-3)
    assert float(found.var()) == pytest.approx(4 * (4 * 10000 + 120), rel=0.05)


def test_the_same_stream_gives_the_same_frames():
    assert torch.equal(frames(seed=4), frames(seed=4))
    assert not torch.equal(frames(seed=4), frames(seed=5))


def test_the_check_says_the_mean():
    assert (
        expose.hooks.check(torch.full((1, 2, 2), 7.0))[0].text == "mean 7 DN, pixels of 7 to 7 DN"
    )
