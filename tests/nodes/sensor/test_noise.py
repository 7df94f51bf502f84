"""Noise: its moments in every reading, its extremes, and bounds that are true."""

import math

import pytest
import torch
from hypothesis import given, settings
from hypothesis import strategies as st

from neusee.nodes import ErrorBound, ParameterError, TensorStats
from neusee.nodes.sensor import dark_current, photon_noise, read_noise
from neusee.nodes.units import ElectronsPerSecond

N = 200_000


def seeded(seed=0):
    return torch.Generator().manual_seed(seed)


def moments(photons, **how):
    flat = torch.full((N,), photons, dtype=torch.float64)
    found = photon_noise(flat, quantum_efficiency=0.56, rng=seeded(), **how)
    return float(found.mean()), float(found.var())


def test_a_dark_current_by_time_is_that_of_the_exposure_times_the_rate():
    dark = torch.zeros(N, dtype=torch.float64)
    by_time = dark_current(dark, mean=ElectronsPerSecond(50.0), exposure=0.1, rng=seeded())
    assert torch.equal(by_time, dark_current(dark, mean=5.0, rng=seeded()))
    long = dark_current(dark, mean=ElectronsPerSecond(50.0), exposure=1.0, rng=seeded())
    assert float(long.mean()) == pytest.approx(50.0, abs=5 * math.sqrt(50 / N))
    facts = TensorStats.of(torch.full((3, 3), 100.0))
    bound = dark_current.hooks.skip_bound
    params = {"full_well": None, "mean_of": "sensor"}
    assert bound(facts, mean=ElectronsPerSecond(50.0), exposure=0.1, **params) == bound(
        facts, mean=5.0, **params
    )
    with pytest.raises(ParameterError, match="50 e-/s needs the exposure"):
        dark_current.hooks.preflight(mean=ElectronsPerSecond(50.0), exposure=None)


@pytest.mark.parametrize(
    ("text", "read"), [("0.02 e-", 0.02), ("0.02 e-/s", (0.02,)), ("3 ke-/s", (3000.0,))]
)
def test_a_dark_current_is_read_with_its_unit(text, read):
    found = dark_current.params(mean=text).mean
    assert found == read
    assert isinstance(found, ElectronsPerSecond) == isinstance(read, tuple)


@pytest.mark.parametrize("distribution", ["gaussian", "poisson"])
@pytest.mark.parametrize("photons", [100.0, 45536.0])
def test_in_electrons_the_variance_is_the_mean(distribution, photons):
    mean, variance = moments(photons, distribution=distribution)
    assert mean == pytest.approx(0.56 * photons, abs=5 * math.sqrt(0.56 * photons / N))
    assert variance == pytest.approx(0.56 * photons, rel=5 * math.sqrt(2 / N))


def test_drawn_in_photons_the_noise_is_sqrt_of_the_efficiency_too_small():
    mean, variance = moments(45536.0, drawn_in="photons")
    assert mean == pytest.approx(25500, rel=1e-3)
    assert math.sqrt(variance) == pytest.approx(119.5, rel=0.01)
    assert math.sqrt(moments(45536.0)[1]) == pytest.approx(159.7, rel=0.01)


@pytest.mark.parametrize("drawn_in", ["electrons", "photons"])
@pytest.mark.parametrize("distribution", ["gaussian", "poisson"])
def test_c1_and_c2_in_both_readings(drawn_in, distribution):
    how = {"mean_shift": 0.2, "spread": 0.9, "drawn_in": drawn_in, "distribution": distribution}
    added, variance = moments(1e4, mean="additive", **how)
    literal, _ = moments(1e4, mean="literal", **how)
    assert added == pytest.approx(1.2 * 5600, rel=1e-3)
    assert literal == pytest.approx(0.2 * 5600, rel=1e-3)
    assert variance == pytest.approx(
        0.81 * 5600 * (1.0 if drawn_in == "electrons" else 0.56), rel=0.02
    )


@pytest.mark.parametrize("mean", ["additive", "literal"])
@pytest.mark.parametrize("drawn_in", ["electrons", "photons"])
@pytest.mark.parametrize(("photons", "less"), [(4.0, 4.0), (100.0, 10.0), (1e4, 100.0), (1e6, 1.0)])
def test_with_the_same_draws_other_light_has_a_noise_that_is_off_by_no_more_than_stated(
    photons, less, drawn_in, mean
):
    how = {"drawn_in": drawn_in, "mean": mean, "mean_shift": 0.0, "distribution": "gaussian"}
    light = torch.full((N,), photons, dtype=torch.float64)
    found, true = (
        photon_noise(x, quantum_efficiency=0.56, rng=seeded(), **how) for x in (light, light - less)
    )
    off = float((found - true).square().mean().sqrt())
    given = ErrorBound(less, TensorStats.of(light))
    told = photon_noise.hooks.propagate_error(
        given, result=TensorStats.of(found), quantum_efficiency=0.56, **how
    )
    assert off <= told <= 4 * off


@pytest.mark.parametrize("photons", [0.05, 0.37, 1.0, 5.0, 20.0])
def test_the_cut_at_zero_lifts_the_mean_by_what_the_docstring_says(photons):
    flat = torch.full((N,), photons, dtype=torch.float64)
    found = photon_noise(flat, quantum_efficiency=1.0, rng=seeded())
    sampling = 4 * math.sqrt(photons / N)
    assert -sampling < float(found.mean()) - photons < 0.1013 + sampling
    if photons > 10:
        assert float(found.mean()) - photons < 1e-3 + sampling


@settings(max_examples=60, deadline=None)
@given(
    st.floats(-1.0, 999999995904.0, width=32, allow_subnormal=True),
    st.sampled_from(["gaussian", "poisson"]),
    st.sampled_from(["electrons", "photons"]),
    st.sampled_from(["additive", "literal"]),
    st.sampled_from([torch.float32, torch.float64]),
)
def test_never_negative_always_finite(photons, distribution, drawn_in, mean, dtype):
    flat = torch.full((1, 1), photons, dtype=dtype)
    how = {"distribution": distribution, "drawn_in": drawn_in, "mean": mean, "mean_shift": 0.1}
    found = photon_noise(flat, quantum_efficiency=0.5, rng=seeded(), **how)
    assert found.dtype == dtype
    assert found.shape == (1, 1)
    assert torch.isfinite(found).all()
    assert bool((found >= 0).all())
    if photons <= 0:
        assert not found.any()


@pytest.mark.parametrize("distribution", ["gaussian", "poisson"])
def test_gradient_is_finite_in_the_dark_and_follows_the_mean(distribution):
    photons = torch.tensor([0.0, 1e-40, 1e4]).requires_grad_()
    photon_noise(
        photons, quantum_efficiency=0.5, distribution=distribution, rng=seeded()
    ).sum().backward()
    assert torch.isfinite(photons.grad).all()
    assert float(photons.grad[2]) == pytest.approx(0.5, abs=0.05)


def test_the_same_seed_draws_the_same():
    flat = torch.full((50,), 100.0)
    one, two = (photon_noise(flat, quantum_efficiency=0.5, rng=seeded(3)) for _ in range(2))
    assert torch.equal(one, two)


def test_dark_current_is_poisson():
    found = dark_current(torch.zeros(N, dtype=torch.float64), mean=0.5, rng=seeded())
    assert torch.equal(found, found.round())
    assert float(found.mean()) == pytest.approx(0.5, abs=0.01)
    assert float(found.var()) == pytest.approx(0.5, abs=0.01)


def test_read_noise_has_a_pedestal_and_a_spread():
    found = read_noise(
        torch.zeros(N, dtype=torch.float64), offset=390.0, read_noise=10.5, rng=seeded()
    )
    assert float(found.mean()) == pytest.approx(390, abs=0.15)
    assert float(found.std()) == pytest.approx(10.5, rel=0.01)


def change(electrons, node, draws=400, **params):
    """max over pixels of the rms change, over the same of the result; rms over the noise."""
    rng = seeded(7)
    results = torch.stack([node(electrons, **params, rng=rng) for _ in range(draws)])
    change = (results - electrons).square().mean(0).sqrt().max()
    return float(change / results.square().mean(0).sqrt().max())


@pytest.mark.parametrize("scale", [1.0, 100.0, 2e4])
@pytest.mark.parametrize(
    ("node", "params"),
    [
        (dark_current, {"mean": 0.002}),
        (dark_current, {"mean": 30.0}),
        (read_noise, {"offset": 0.0, "read_noise": 10.5}),
        (read_noise, {"offset": 390.0, "read_noise": 10.5}),
    ],
)
def test_bounds_are_true_and_not_far(node, params, scale):
    electrons = scale * torch.rand(4, 4, dtype=torch.float64, generator=seeded(1))
    bound, found = (
        node.hooks.skip_bound(TensorStats.of(electrons), full_well=None, **params),
        change(electrons, node, **params),
    )
    # The largest of 16 sampled rms values lies above the true one by a few of its own errors,
    # 1/sqrt(2 * draws).
    assert found <= bound * (1 + 5 / math.sqrt(800) + (2.0 if params.get("mean") == 0.002 else 0.0))
    assert params.get("mean") == 0.002 or bound < 1.1 * found


def test_bounds_of_nothing():
    dark, any_well = TensorStats.of(torch.zeros(2, 2)), {"full_well": None}
    assert dark_current.hooks.skip_bound(dark, mean=0.0, **any_well) == 0.0
    assert read_noise.hooks.skip_bound(dark, offset=0.0, read_noise=0.0, **any_well) == 0.0
    assert dark_current.hooks.skip_bound(dark, mean=0.1, **any_well) == 1.0
    assert read_noise.hooks.skip_bound(dark, offset=0.0, read_noise=1.0, **any_well) == 1.0


def test_what_a_reader_is_told():
    assert "as the paper prints" in photon_noise.hooks.preflight(mean="literal", mean_shift=0.2)[0]
    assert photon_noise.hooks.preflight(mean="additive", mean_shift=0.2) == []
    assert photon_noise.hooks.check(torch.ones(2), torch.ones(2))[0].ok
    assert not photon_noise.hooks.check(torch.ones(2), torch.tensor([-5.0, 1.0]))[0].ok


def test_a_laser_above_the_well_hides_no_noise():
    dazzled = TensorStats.of(torch.tensor([[10.0, 1e7]]))
    noise = {"offset": 390.0, "read_noise": 10.5}
    assert read_noise.hooks.skip_bound(dazzled, **noise, full_well=25500.0) > 0.01
    assert read_noise.hooks.skip_bound(dazzled, **noise, full_well=None) < 1e-4
    dark = dark_current.hooks.skip_bound(dazzled, mean=0.002, full_well=25500.0)
    assert dark == pytest.approx(math.hypot(0.002, math.sqrt(0.002)) / 25500, rel=1e-3)


@pytest.mark.parametrize("dtype", [torch.float16, torch.float64])
def test_another_precision_draws_the_same_numbers(dtype):
    electrons = torch.full((64,), 100.0)
    single = read_noise(electrons, offset=0.0, read_noise=1.0, rng=seeded())
    other = read_noise(electrons.to(dtype), offset=0.0, read_noise=1.0, rng=seeded())
    torch.testing.assert_close(
        other.double(), single.double(), rtol=torch.finfo(dtype).eps, atol=1e-4
    )


@pytest.mark.parametrize("distribution", ["gaussian", "poisson"])
def test_the_noise_of_light_is_the_same_in_single_and_double(distribution):
    photons = torch.linspace(0, 1e4, 500)
    how = {"quantum_efficiency": 0.56, "distribution": distribution}
    single, double = (
        photon_noise(photons.to(d), rng=seeded(), **how) for d in (torch.float32, torch.float64)
    )
    torch.testing.assert_close(single.double(), double, rtol=1e-6, atol=1e-2)


@pytest.mark.parametrize(
    "shape", [(3, 100, 217), (65536 + 5,), (3 * 32768 + 15,), (1, 65536), (2, 256, 129)]
)
@pytest.mark.parametrize("dtype", [torch.float16, torch.float32, torch.float64])
def test_parts_that_stay_in_cache_are_the_whole_to_the_last_bit(shape, dtype):
    """With a gradient all is computed at once, without one by parts."""
    x = (torch.rand(shape, generator=torch.Generator().manual_seed(1)) * 300 - 2).to(dtype)
    makers = [
        lambda rng: photon_noise(x, quantum_efficiency=0.56, spread=1.2, mean_shift=0.1, rng=rng),
        lambda rng: photon_noise(
            x, quantum_efficiency=0.56, distribution="poisson", drawn_in="photons", rng=rng
        ),
        lambda rng: dark_current(x.mT if x.ndim > 1 else x, mean=0.3, rng=rng),
        lambda rng: read_noise(x.mT if x.ndim > 1 else x, offset=3.0, read_noise=2.0, rng=rng),
    ]
    for make in makers:
        whole = make(torch.Generator().manual_seed(2))
        with torch.no_grad():
            parts = make(torch.Generator().manual_seed(2))
        assert torch.equal(parts, whole)
        assert (parts.shape, parts.dtype) == (whole.shape, whole.dtype)
