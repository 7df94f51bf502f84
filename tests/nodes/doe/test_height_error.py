"""The error of a mask that was made: its statistics against the closed form, its depth, and what
it does to a spot.
"""

import numpy as np
import pytest
import torch

from neusee.nodes import TensorStats, doe, optics
from neusee.nodes.values import Bands

SAMPLES, DIAMETER = 33, 11e-3


def stop(samples=SAMPLES):
    return optics.stop(samples=samples, pitch=DIAMETER / samples, diameter=DIAMETER)


def rng(seed=0):
    return torch.Generator().manual_seed(seed)


def ramp(samples=SAMPLES):
    return torch.linspace(0, 5e-6, samples).expand(samples, samples).contiguous()


def test_the_random_error_has_its_rms_and_its_correlation():
    """Over 400 masks; the error of an average of 400 normal squares is 7 %, and averages over
    places are closer.
    """
    flat = torch.zeros(SAMPLES, SAMPLES, dtype=torch.float64)
    made = [
        doe.height_error(flat, stop(), rms=20e-9, scale=0.2, rng=rng(i)).numpy() for i in range(400)
    ]
    fields = np.array(made) / 20e-9
    assert (fields**2).mean() == pytest.approx(1, abs=0.03)
    for apart in (2, 4, 7):
        found = (fields[:, :, apart:] * fields[:, :, :-apart]).mean()
        assert found == pytest.approx(np.exp(-((apart / SAMPLES / 0.2) ** 2)), abs=0.03)
    assert abs(fields.mean((1, 2)).mean()) < 0.05


def test_the_draw_does_not_depend_on_the_sampling():
    coarse, fine = (
        doe.height_error(torch.zeros(n, n), stop(n), rms=1e-8, rng=rng()) for n in (33, 99)
    )
    assert torch.allclose(fine[1::3, 1::3], coarse, atol=1e-14)


def test_a_depth_error_scales_every_height_and_none_is_the_design():
    deeper = doe.height_error(ramp(), stop(), depth=0.02, rng=rng())
    assert np.allclose(deeper.numpy(), 1.02 * ramp().double().numpy(), rtol=1e-6)
    assert torch.equal(doe.height_error(ramp(), stop(), rng=rng()), ramp())
    with pytest.raises(ValueError, match="pupil grid"):
        doe.height_error(ramp(32), stop(), rng=rng())


@pytest.mark.parametrize(
    "error", [{"rms": 3e-9}, {"depth": -0.003}, {"rms": 2e-9, "depth": 0.01}, {}]
)
def test_the_bound_of_leaving_it_out_covers_height_and_phase(error):
    made = doe.height_error(ramp(), stop(), **error, rng=rng(4))
    change = float((made - ramp()).abs().max())
    stats = TensorStats.of(ramp())
    bound = doe.height_error.hooks.skip_bound(
        stats, None, **{"rms": 0.0, "scale": 0.1, "depth": 0.0, **error}
    )
    assert change / float(made.max()) <= bound
    assert 2 * np.pi * change / 400e-9 <= bound
    assert bool(bound) == bool(error)


def test_the_peak_behind_a_rough_flat_is_that_of_marechal():
    """A fine error of rms s leaves exp(-(2 pi (n - 1) s / wavelength)^2) of the peak, the mean
    over masks.
    """
    bands = Bands(*(torch.tensor([x], dtype=torch.float64) for x in (550e-9, 1e-9, 1.0)))
    index, flat = doe.material(bands, material="fused silica"), torch.zeros(SAMPLES, SAMPLES)
    peaks = []
    for seed in range(60):
        made = doe.height_error(flat, stop(), rms=40e-9, scale=0.05, rng=rng(seed))
        pupil = optics.pupil(made, index, bands, stop())
        psf = optics.psf(pupil, focal_length=0.11, pixel_pitch=2.9e-6, shape=(1, 1))
        peaks.append(float(psf.intensity[0, 0, 0] / psf.clear_peak[0]))
    expected = np.exp(-((2 * np.pi * (1.45991 - 1) * 40e-9 / 550e-9) ** 2))
    assert np.mean(peaks) == pytest.approx(expected, abs=0.003)
