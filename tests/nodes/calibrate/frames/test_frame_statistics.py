"""Frames to counts, means and variances, against numpy on whole stacks; histograms where moments
mislead.
"""

import math

import numpy as np
import pytest
import torch
from hypothesis import given, settings
from hypothesis import strategies as st
from hypothesis.extra import numpy as hnp

from neusee.nodes.calibrate import _light_levels, levels, reduce

STACKS = hnp.arrays(
    st.sampled_from([np.uint8, np.uint16, np.int32, np.float32, np.float64]),
    hnp.array_shapes(min_dims=3, max_dims=3, max_side=9).filter(lambda s: np.prod(s) > 1),
    elements=st.integers(0, 255),
)


def noise(*shape, mean=1000.0, sigma=30.0, seed=3):
    return (
        (mean + sigma * torch.randn(*shape, generator=torch.Generator().manual_seed(seed)))
        .round()
        .clamp_min(0)
    )


def one(frames, scatter="all"):
    return reduce(frames, photons=5.0, exposure=0.1, scatter=scatter)


@given(STACKS)
@settings(max_examples=100, deadline=None)
def test_all_pixels_alike_is_numpy_over_the_whole_stack(stack):
    found, numbers = one(torch.from_numpy(stack)), stack.astype(np.float64)
    assert float(found.mean) == pytest.approx(numbers.mean(), rel=1e-13)
    assert float(found.variance) == pytest.approx(numbers.var(ddof=1), rel=1e-12, abs=1e-12)
    assert (float(found.pixels), float(found.degrees_of_freedom)) == (stack.size, stack.size - 1)
    assert (float(found.photons), float(found.exposure)) == (5.0, 0.1)


@given(STACKS.filter(lambda s: len(s) > 1))
@settings(max_examples=100, deadline=None)
def test_temporal_is_numpy_within_each_pixel(stack):
    found, numbers = one(torch.from_numpy(stack), "temporal"), stack.astype(np.float64)
    assert float(found.mean) == pytest.approx(numbers.mean(), rel=1e-13)
    assert float(found.variance) == pytest.approx(
        numbers.var(axis=0, ddof=1).mean(), rel=1e-12, abs=1e-12
    )
    assert (float(found.pixels), float(found.degrees_of_freedom)) == (
        stack.size,
        stack[0].size * (len(stack) - 1),
    )


@given(STACKS.filter(lambda s: len(s) > 1 and s[0].size > 1), st.integers(-5, 5))
@settings(max_examples=100, deadline=None)
def test_steady_is_numpy_without_what_a_frame_has_in_common(stack, drift):
    """Two frames: half the mean squared difference less half the squared difference of the means
    (EMVA 1288, 4.0).
    """
    numbers = stack.astype(np.float64)
    apart = numbers - numbers.mean(0)
    apart -= apart.mean((1, 2), keepdims=True)
    found, freedom = one(torch.from_numpy(stack), "steady"), (stack[0].size - 1) * (len(stack) - 1)
    assert float(found.degrees_of_freedom) == freedom
    scale = float(np.square(numbers).sum())
    assert float(found.variance) == pytest.approx(
        np.square(apart).sum() / freedom, rel=1e-9, abs=1e-15 * scale
    )


def test_a_lamp_that_drifts_within_a_pair_is_no_noise():
    """5 % between the frames: 1250 DN2 beside 100 of noise; of pixels that differ by 1 % a part
    in 1000 is left.
    """
    rng = torch.Generator().manual_seed(1)
    unlike = 1000 * (1 + 0.01 * torch.randn(128, 128, generator=rng, dtype=torch.float64))
    pair = torch.stack(
        [
            (light * unlike + 10 * torch.randn(128, 128, generator=rng)).round()
            for light in (1.0, 1.05)
        ]
    )
    assert float(one(pair, "temporal").variance) > 1200
    assert float(one(pair, "steady").variance) == pytest.approx(100, rel=3 * math.sqrt(2 / 128**2))


@given(STACKS)
@settings(max_examples=100, deadline=None)
def test_the_histogram_is_numpys(stack):
    value, count = _light_levels.histogram(torch.from_numpy(stack))
    wanted = np.unique(stack, return_counts=True)
    np.testing.assert_array_equal(value.numpy(), wanted[0])
    np.testing.assert_array_equal(count.numpy(), wanted[1])


@pytest.mark.parametrize("scatter", ["all", "temporal", "steady"])
def test_pieces_give_what_the_whole_gives(monkeypatch, scatter):
    frames = noise(3, 40, 50)
    whole = one(frames, scatter)
    monkeypatch.setattr(_light_levels, "_BLOCK_NUMBERS", 100)
    for a, b in zip(one(frames, scatter), whole, strict=True):
        assert torch.allclose(a, b, rtol=1e-14, atol=0)


def test_the_difference_of_the_means_of_a_pair_stays_in_its_variance():
    pair = torch.stack([torch.full((4, 4), 10.0), torch.full((4, 4), 16.0)])
    assert float(one(pair, "temporal").variance) == 18.0  # half of 6 squared


@pytest.mark.parametrize("value", [0, 255, 256, 32767, 32768, 65535, (1 << 24) - 1])
@pytest.mark.parametrize(
    "dtype", [torch.uint16, torch.int32, torch.int64, torch.float32, torch.float64]
)
def test_one_number_everywhere_is_exact_and_kept_as_a_histogram(value, dtype):
    if dtype == torch.uint16 and value > 65535:
        value = 65535
    found = one(torch.full((2, 5, 7), value).to(dtype))
    assert (float(found.mean), float(found.variance)) == (value, 0.0)
    assert (found.cell_value.tolist(), found.cell_count.tolist(), found.cell_level.tolist()) == (
        [value],
        [70.0],
        [0],
    )


@pytest.mark.parametrize("sigma", [1.0, 3.0, 30.0, 400.0])
@pytest.mark.parametrize("scatter", ["all", "temporal"])
def test_a_gaussian_needs_no_histogram(sigma, scatter):
    for seed in range(5):
        assert not len(
            one(noise(2, 256, 256, mean=5000, sigma=sigma, seed=seed), scatter).cell_value
        )


@pytest.mark.parametrize(("sigma", "kept"), [(0.5, True), (0.7, True), (0.9, False)])
def test_coarse_numbers_keep_their_histogram(sigma, kept):
    found = one(noise(2, 64, 64, sigma=sigma))
    assert (len(found.cell_value) > 0) == kept
    assert float(found.cell_count.sum()) == (float(found.pixels) if kept else 0.0)


@pytest.mark.parametrize("end", ["top", "bottom"])
@pytest.mark.parametrize("at", [-1.0, 0.0, 1.0, 2.0])
def test_numbers_piled_up_at_an_end_are_counted(end, at):
    frames = noise(2, 128, 128, sigma=59.0)
    limit = round(59 * at)
    cut = frames.clamp_max(1000 + limit) if end == "top" else frames.clamp_min(1000 - limit)
    for scatter in ("all", "temporal"):
        found = one(cut, scatter)
        assert float(found.cell_count.sum()) == cut.numel()
        assert bool((found.cell_value.diff() > 0).all())


def test_alike_pixels_show_a_coarse_cut_that_unlike_ones_might_be():
    cut = noise(2, 128, 128, sigma=2.3).clamp_max(1004)  # an 8-bit camera near its end
    assert len(one(cut).cell_value) > 0
    assert len(one(cut, "temporal").cell_value) == 0


@pytest.mark.parametrize("spread", [0.2, 0.5])
def test_pixels_of_unequal_noise_have_long_tails_and_no_pile(spread):
    """Their tails exceed those of a Gaussian: the shortest dark frames were left out because of
    them.
    """
    generator = torch.Generator().manual_seed(5)
    width = torch.exp(spread * torch.randn(1, 400, 400, dtype=torch.float64, generator=generator))
    noise_of_pixels = width * torch.randn(2, 400, 400, dtype=torch.float64, generator=generator)
    for sigma in (1.15, 20.0):
        assert len(one((300 + sigma * noise_of_pixels).round(), "steady").cell_value) == 0
    numbers = (300 + 20 * noise_of_pixels).round()
    for cut in (numbers.clamp_min(262), numbers.clamp_max(338)):
        assert len(one(cut, "steady").cell_value) > 0


def test_fixed_patterns_alone_keep_no_histogram():
    pattern = noise(1, 128, 128, sigma=200.0, mean=5000.0)
    frames = (
        pattern
        + noise(2, 128, 128, mean=0.0, sigma=2.0, seed=9) * 0
        + noise(2, 128, 128, mean=50, sigma=2.0)
    )
    assert len(one(frames, "temporal").cell_value) == 0


@pytest.mark.parametrize("bad", [-1.0, 0.5, float("nan"), float("inf"), 2.0**24, 3e38])
def test_what_is_no_digital_number_is_refused(bad):
    frames = torch.full((2, 3, 3), 7.0)
    frames[1, 2, 0] = bad
    with pytest.raises(ValueError, match="not a digital number"):
        one(frames)


def test_negative_integers_are_refused():
    with pytest.raises(ValueError, match="-3, not a digital number"):
        one(torch.tensor([[[4, -3]]]))


@pytest.mark.parametrize("shape", [(4, 4), (0, 4, 4), (2, 0, 4), (1, 2, 3, 4)])
def test_what_is_no_stack_is_refused(shape):
    with pytest.raises(ValueError, match="not \\(frame, y, x\\)"):
        one(torch.zeros(shape))


def test_what_has_no_variance_is_refused():
    with pytest.raises(ValueError, match="give two frames"):
        one(torch.zeros(1, 4, 4), "temporal")
    with pytest.raises(ValueError, match="one pixel value has no variance"):
        one(torch.zeros(2, 1, 1), "steady")
    with pytest.raises(ValueError, match="no variance"):
        one(torch.zeros(1, 1, 1))


def test_levels_are_joined_in_their_order():
    parts = [
        one(noise(2, 8, 8, sigma=0.3)),
        one(noise(2, 64, 64, sigma=50.0)),
        one(torch.full((2, 2, 2), 9.0)),
    ]
    found = levels(parts)
    assert found.mean.tolist() == [float(p.mean) for p in parts]
    assert sorted(set(found.cell_level.tolist())) == [0, 2]
    assert found.cell_value[found.cell_level == 2].tolist() == [9.0]
    again = levels([levels(parts[:1]), levels(parts[1:])])
    assert all(torch.equal(a, b) for a, b in zip(found, again, strict=True))
    with pytest.raises(ValueError, match="no light levels"):
        levels([])


def test_checks_say_what_was_found():
    part = one(torch.full((2, 2, 2), 9.0))
    assert reduce.hooks.check(part)[0].text == "mean 9 DN, variance 0 DN2, histogram of 1 numbers"
    assert (
        levels.hooks.check(levels([part, part]))[0].text
        == "2 light levels, 0 dark, 2 with a histogram"
    )
