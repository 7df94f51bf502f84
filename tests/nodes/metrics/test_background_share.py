"""The background suppression ratio is a share of the scene's light: at most 1, and the sum of what
stays in the field.

PSFs of random masks come from `independent_psf`, and the light in the field from a sum over pairs
of pixels in NumPy.
"""

from typing import get_args

import numpy as np
import pytest
import torch
from hypothesis import given, settings
from hypothesis import strategies as st

from neusee.nodes import doe, optics, spectra
from neusee.nodes.losses import background_loss
from neusee.nodes.metrics import bsr, light_outside
from neusee.nodes.values import LowRankCube, Psf, Pupil
from tests.nodes.optics.independent_psf import round_stop, window

#: pixels after which the PSF of the shorter wavelength repeats: one period holds all light
PERIOD = 64
LENS = {"wavelength": 2.0**-21, "pitch": 2.0**-17, "focal_length": 2.0**-4, "pixel_pitch": 2.0**-14}
SAMPLES, INDEX = 24, 0.46
ROUND_OFF = {torch.float32: 1e-6, torch.float64: 1e-12}


def mask(kind, rng):
    """Draw a height map, m: flat, rough in every sample, or a prism that moves all light to one
    side.
    """
    if kind == "prism":
        v, u = np.indices((SAMPLES, SAMPLES))
        return rng.uniform(-1, 1) * 2e-7 * v + rng.uniform(-1, 1) * 2e-7 * u
    return 2e-6 * rng.random((SAMPLES, SAMPLES)) * (kind == "rough")


def scene(kind, shape, rng):
    """Draw a picture: noise, one point, light along an edge alone, or darkness with few lamps."""
    picture = rng.random((2, *shape))
    if kind == "edge":
        picture[:, :, 1:] = 0
    elif kind == "lamps":
        picture = np.where(picture > 0.9, 1e6 * picture, 1e-6)
    elif kind == "point":
        y, x = (rng.integers(n) for n in shape)
        picture[:, :y], picture[:, y + 1 :], picture[:, :, :x], picture[:, :, x + 1 :] = 0, 0, 0, 0
    return picture


def psf_of(height, shape):
    seen = [
        window(
            height,
            0 * height,
            round_stop(SAMPLES, LENS["pitch"], SAMPLES * LENS["pitch"]),
            INDEX,
            **LENS | {"wavelength": LENS["wavelength"] * s},
            shape=shape,
        )
        for s in (1.0, 2.0)
    ]
    return np.stack(seen)


def by_pairs(kernel, picture):
    """Add up, for each scene pixel, the PSF samples that reach a pixel of the field, and weigh
    with the scene.
    """
    (m, n), (y, x) = kernel.shape, picture.shape
    kept = 0.0
    for v in range(y):
        for u in range(x):
            rows = slice(max(m // 2 - v, 0), max(min(m // 2 - v + y, m), 0))
            columns = slice(max(n // 2 - u, 0), max(min(n // 2 - u + x, n), 0))
            kept += picture[v, u] * kernel[rows, columns].sum()
    return kept / picture.sum()


sizes = st.tuples(st.integers(1, 40), st.integers(1, 40))


@settings(max_examples=60, deadline=None)
@given(
    st.integers(0, 2**31), st.sampled_from(("flat", "rough", "prism")),
    st.sampled_from(("noise", "edge", "lamps", "point")), sizes,
    st.tuples(st.integers(1, PERIOD), st.integers(1, PERIOD)), st.sampled_from((torch.float32, torch.float64)),
)  # fmt: skip
def test_no_passive_mask_keeps_more_than_all_light(seed, relief, picture, size, seen, dtype):
    rng = np.random.default_rng(seed)
    kernel, light = psf_of(mask(relief, rng), seen), scene(picture, size, rng)
    psf = Psf(torch.tensor(kernel, dtype=dtype), torch.ones(2, dtype=torch.float64))
    found = bsr(psf, torch.tensor(light, dtype=dtype))
    assert found.dtype == torch.float64
    assert float(found.max()) <= 1 + ROUND_OFF[dtype]
    assert float(found.min()) >= 0
    expected = [by_pairs(k, x) for k, x in zip(kernel, light, strict=True)]
    np.testing.assert_allclose(found.numpy(), expected, rtol=0, atol=ROUND_OFF[dtype])
    np.testing.assert_allclose(
        bsr.hooks.reference(psf, torch.tensor(light, dtype=dtype)), expected, atol=1e-6
    )
    assert float(background_loss(psf, torch.tensor(light, dtype=dtype))) >= 2 * (
        1 - ROUND_OFF[dtype]
    )
    assert bsr.hooks.check(found)[0].ok


def test_all_light_stays_where_field_and_window_hold_it():
    kernel = psf_of(mask("rough", np.random.default_rng(1)), (PERIOD, PERIOD))[[0, 0]]
    middle = torch.zeros(2, 127, 127, dtype=torch.float64)
    middle[:, 63, 63] = 3.0
    psf = Psf(torch.tensor(kernel), torch.ones(2, dtype=torch.float64))
    for found in (bsr(psf, middle), bsr(psf)):
        torch.testing.assert_close(found, torch.ones(2, dtype=torch.float64), rtol=0, atol=1e-12)
    few = Psf(psf.intensity[:, 16:-16, 16:-16], psf.clear_peak)
    torch.testing.assert_close(bsr(few, middle), few.intensity.sum((1, 2)), rtol=0, atol=1e-12)


def test_each_scene_of_a_batch_has_its_own_share():
    rng = torch.Generator().manual_seed(2)
    kernel = torch.rand(5, 9, 12, generator=rng, dtype=torch.float64) / 120
    psf, light = (
        Psf(kernel, kernel[:, 0, 0]),
        torch.rand(3, 5, 14, 11, generator=rng, dtype=torch.float64),
    )
    found = bsr(psf, light)
    torch.testing.assert_close(found, torch.stack([bsr(psf, one) for one in light]), rtol=0, atol=0)


def test_a_low_rank_scene_is_refused_by_its_type():
    """What a low-rank scene leaves out has no bound here."""
    assert LowRankCube not in get_args(bsr.hints["radiance"])


def test_darkness_and_scenes_of_other_bands():
    psf, dark = Psf(torch.full((2, 3, 3), 0.1), torch.ones(2)), torch.zeros(2, 4, 4)
    assert bsr(psf, dark).tolist() == [1.0, 1.0]
    assert float(background_loss(psf, dark)) == 2.0
    for radiance in (torch.ones(3, 4, 4), torch.ones(4, 4)):
        with pytest.raises(
            ValueError, match=r"radiance \(.*must have the same bands: compute both"
        ):
            bsr(psf, radiance)


def test_the_loss_sees_light_that_leaves_window_and_field():
    rng = torch.Generator().manual_seed(3)
    kernel = torch.rand(2, 5, 5, generator=rng, dtype=torch.float64) / 50
    light = torch.rand(2, 4, 4, generator=rng, dtype=torch.float64)

    def loss(kernel):
        return background_loss(Psf(kernel, torch.ones(2, dtype=torch.float64)), light)

    assert torch.autograd.gradcheck(loss, (kernel.clone().requires_grad_(),))
    slope = torch.func.grad(loss)(kernel)
    assert bool((slope < 0).all())  # more light in the window, less loss
    assert float(loss(kernel)) == pytest.approx(
        float((1 / bsr(Psf(kernel, torch.ones(2)), light)).sum())
    )
    assert float(background_loss(Psf(kernel, torch.ones(2)))) == pytest.approx(
        float((1 / kernel.sum((1, 2))).sum())
    )


def test_the_light_outside_is_what_passes_and_misses_the_window():
    line = spectra.bands(start=500e-9, stop=600e-9, count=2)
    stop = optics.stop(samples=96, pitch=8e-3 / 96, diameter=8e-3)
    clear = optics.pupil(doe.half_rings(stop, waves=(12.0,)), doe.material(line), line, stop)
    dirty = clear._replace(amplitude=clear.amplitude * 0.5)
    sizes = [(24, 24), (160, 160)]
    few, many, dim = (
        optics.psf(p, focal_length=0.11, pixel_pitch=3e-6, shape=s)
        for p, s in ((clear, sizes[0]), (clear, sizes[1]), (dirty, sizes[1]))
    )
    found = light_outside(many, clear)
    assert bool((light_outside(few, clear) > 0.5).all())
    assert bool((found < 0.2).all())
    # a loss of dirt, not of the window
    torch.testing.assert_close(light_outside(dim, dirty), found, rtol=0, atol=1e-6)
    assert light_outside(many, clear).tolist() == pytest.approx(
        (1 - many.intensity.double().sum((1, 2))).tolist(), rel=1e-12
    )
    assert "outside the window" in light_outside.hooks.check(found)[0].text
    black = dirty._replace(amplitude=dirty.amplitude * 0)
    assert light_outside(Psf(many.intensity * 0, many.clear_peak), Pupil(*black)).tolist() == [
        0.0,
        0.0,
    ]
