"""The least feature: against the plain average, and what it keeps."""

import math

import pytest
import torch

from neusee.nodes import optics
from neusee.nodes.doe import Drawn, Modes, Pixels, Rings, Written, half_rings, smooth, zernike

STOP = optics.stop(samples=24, pitch=2e-6, diameter=48e-6)


def relief(seed=1):
    return 1e-6 * torch.rand(24, 24, generator=torch.Generator().manual_seed(seed))


@pytest.mark.parametrize("feature", [0.5e-6, 4e-6, 20e-6, 1e-3])
def test_it_agrees_with_its_reference(feature):
    found, truth = (
        smooth(relief(), STOP, feature=feature),
        smooth.hooks.reference(relief(), STOP, feature=feature),
    )
    assert float((found.double() - truth).abs().max()) <= 1e-6 * float(truth.max())


def test_it_keeps_planes_and_the_depth():
    flat = torch.full((24, 24), 1e-6)
    torch.testing.assert_close(smooth(flat, STOP, feature=6e-6), flat)
    made = smooth(relief(), STOP, feature=6e-6)
    assert float(relief().min()) <= float(made.min()) <= float(made.max()) <= float(relief().max())


def test_a_wave_fades_as_the_spot_has_it():
    """exp(-(pi f w)^2 / (4 ln 2)) for a full width w at half maximum, away from the edges."""
    stop = optics.stop(samples=200, pitch=1e-6, diameter=200e-6)
    wave = torch.cos(2 * math.pi * torch.arange(200) / 10).expand(200, 200) * 1e-6
    made = smooth(wave, stop, feature=5e-6)[100, 80:120]
    assert float(made.max() / 1e-6) == pytest.approx(
        math.exp(-((math.pi * 0.5) ** 2) / (4 * math.log(2))), rel=1e-3
    )


def test_gradient():
    height = (1e-6 * torch.rand(6, 6, dtype=torch.float64)).requires_grad_()
    small = optics.stop(samples=6, pitch=2e-6, diameter=12e-6)
    assert torch.autograd.gradcheck(
        lambda h: 1e6 * smooth(h / 1e6, small, feature=5e-6), (height * 1e6,)
    )


def test_what_does_not_fit_is_refused_and_a_narrow_spot_said():
    with pytest.raises(ValueError, match="pupil grid"):
        smooth(torch.zeros(3, 3), STOP, feature=4e-6)
    with pytest.raises(ValueError, match="too coarse for a phase"):
        smooth(relief().half(), STOP, feature=4e-6)
    assert "1.5 samples" in smooth.hooks.preflight(stop=STOP, feature=1e-6)[0]
    assert smooth.hooks.preflight(stop=STOP, feature=4e-6) == []
    # the grid is known only during the run
    assert smooth.hooks.preflight(stop=None, feature=1e-6) == []


# --- reliefs with numbers to learn ----------------------------------------------------------------


def shapes():
    rng = torch.Generator().manual_seed(1)
    return [Pixels(32, 1e-6, 0.1, rng), Modes(12, 2.0, 550e-9, "PMMA", rng), Rings(10, True, 1.0, 550e-9, "PMMA", rng),
            Rings(7, False, 1.0, 550e-9, "PMMA", rng), Drawn(4, 32, 1e-6, rng),
            Written(Pixels(32, 1e-6, 0.1, rng), 60e-6)]  # fmt: skip


@pytest.mark.parametrize("number", range(6))
def test_a_relief_counts_from_zero_at_every_sampling_and_reaches_all_its_numbers(number):
    shape = shapes()[number]
    for samples in (32, 48):
        height = shape(optics.stop(samples=samples, pitch=1e-3 / samples, diameter=1e-3))
        assert height.shape == (samples, samples)
        assert height.dtype == torch.float32
        assert float(height.detach().min()) >= 0
        assert float(height.detach().std()) > 0
    weights = torch.rand(48, 48, generator=torch.Generator().manual_seed(3))
    (height * weights * 1e6).square().sum().backward()
    assert all(
        p.grad is not None and bool(p.grad.isfinite().all()) and float(p.grad.abs().sum()) > 0
        for p in shape.parameters()
    )


def test_rings_hold_five_half_rings_and_modes_are_those_of_zernike():
    stop = optics.stop(samples=64, pitch=1e-5, diameter=64e-5)
    rings = Rings(15, True, 0.0, 550e-9, "fused silica", torch.Generator())
    known = half_rings(stop, waves=(12.0, 18.0, 24.0, 30.0, 36.0))
    made = rings(stop).detach()
    assert float((made - known).abs().max()) <= 1e-5 * float(known.max())
    modes = Modes(5, 2.0, 550e-9, "fused silica", torch.Generator().manual_seed(1))
    paths = {4 + k: 550e-9 * wave for k, wave in enumerate(modes.waves.tolist())}
    made, known = modes(stop).detach(), zernike(stop, coefficients=paths)
    assert float((made - known).abs().max()) <= 1e-5 * float(known.max())
