"""Full well, converter and window: exact numbers, both readings of the paper, true bounds."""

import math
from fractions import Fraction

import pytest
import torch
from hypothesis import given, settings
from hypothesis import strategies as st

from neusee.nodes import ErrorBound, TensorStats
from neusee.nodes.sensor import clipping_number, crop, digitize, electrons_to_clip, full_well
from neusee.nodes.units import read_quantity


def seeded():
    return torch.Generator().manual_seed(0)


@settings(max_examples=60, deadline=None)
@given(
    st.lists(st.floats(-1e6, 999999995904.0, width=32), min_size=1, max_size=6),
    st.floats(1e-3, 1e3),
    st.sampled_from(["e-/DN", "DN/e-"]),
    st.sampled_from(["nearest", "truncation", "dithered_floor"]),
    st.integers(1, 16),
)
def test_digitize_agrees_with_its_reference(values, gain, unit, rounding, bits):
    electrons = torch.tensor(values)
    how = {"gain": read_quantity(f"{gain!r} {unit}", "DN/e-"), "rounding": rounding, "bits": bits}
    found = digitize(electrons, **how, rng=seeded())
    assert torch.equal(found, digitize.hooks.reference(electrons, **how, rng=seeded()))
    assert torch.equal(found, found.round())
    assert float(found.min()) >= 0
    assert float(found.max()) <= 2**bits - 1


@pytest.mark.parametrize("gain", [1 / 0.37, 0.37, 65535 / 25500])
def test_no_number_is_further_from_the_exact_product_than_half(gain):
    electrons = torch.rand(30_000, generator=torch.Generator().manual_seed(2)) * 65535 / gain
    exact = [Fraction(x) * Fraction(gain) for x in electrons.tolist()]
    away = [
        abs(int(n) - x) for n, x in zip(digitize(electrons, gain=gain).tolist(), exact, strict=True)
    ]
    assert max(away) <= Fraction(1, 2) + Fraction(1e-11)


@pytest.mark.parametrize("gain", [1 / 0.37, 0.37, 65535 / 25500])
def test_a_dithered_number_is_the_floor_of_the_exact_sum(gain):
    electrons = (1 + torch.rand(30_000, generator=torch.Generator().manual_seed(2)) * 65533) / gain
    found = digitize(electrons, gain=gain, rounding="dithered_floor", rng=seeded()).tolist()
    dither = torch.rand(30_000, generator=seeded()).tolist()
    sums = [
        Fraction(x) * Fraction(gain) + Fraction(d - 0.5)
        for x, d in zip(electrons.tolist(), dither, strict=True)
    ]
    above = [x - int(n) for n, x in zip(found, sums, strict=True)]
    assert min(above) >= -Fraction(1e-11)
    assert max(above) < 1 + Fraction(1e-11)


def test_the_numbers_are_the_same_with_a_gradient():
    electrons = torch.rand(100_000, generator=torch.Generator().manual_seed(3)) ** 6 * 26000 - 1
    learnt = digitize(electrons.clone().requires_grad_(), gain=1 / 0.37)
    assert torch.equal(learnt, digitize(electrons, gain=1 / 0.37))


@pytest.mark.parametrize("rounding", ["nearest", "truncation", "dithered_floor"])
def test_blocks_of_pixels_leave_no_trace(rounding, monkeypatch):
    electrons = (
        torch.rand(3, 7, 11, generator=torch.Generator().manual_seed(5)).transpose(0, 2) * 26000
    )
    whole = digitize(electrons, gain=1 / 0.37, rounding=rounding, rng=seeded())
    monkeypatch.setattr("neusee.nodes.sensor._digitization._BLOCK_PIXELS", 10)
    assert torch.equal(digitize(electrons, gain=1 / 0.37, rounding=rounding, rng=seeded()), whole)
    assert whole.shape == (11, 7, 3)


def test_dithered_floor_agrees_with_its_reference():
    electrons = torch.rand(500, dtype=torch.float64) * 100
    how = {"gain": 1 / 0.37, "rounding": "dithered_floor", "bits": 8}
    assert torch.equal(
        digitize(electrons, **how, rng=seeded()),
        digitize.hooks.reference(electrons, **how, rng=seeded()),
    )


def test_gain_in_both_units():
    well = torch.tensor([25500.0])
    assert float(digitize(well, gain=read_quantity("0.37 DN/e-", "DN/e-"))) == 9435
    assert float(digitize(well, gain=read_quantity("0.37 e-/DN", "DN/e-"))) == 65535
    assert "24248 e-" in digitize.hooks.preflight(gain=1 / 0.37, bits=16)[0]


def test_dithered_floor_lies_half_a_number_low_and_is_noisier():
    line = (
        torch.rand(400_000, dtype=torch.float64, generator=torch.Generator().manual_seed(1)) * 50
        + 10
    )
    near = digitize(line, gain=1.0) - line
    floor = digitize(line, gain=1.0, rounding="dithered_floor", rng=seeded()) - line
    cut = digitize(line, gain=1.0, rounding="truncation") - line
    assert float(cut.mean()) == pytest.approx(-0.5, abs=3e-3)
    assert float(cut.var()) == pytest.approx(1 / 12, rel=0.01)
    assert float(near.mean()) == pytest.approx(0.0, abs=3e-3)
    assert float(near.var()) == pytest.approx(1 / 12, rel=0.01)
    assert float(floor.mean()) == pytest.approx(-0.5, abs=3e-3)
    assert float(floor.var()) == pytest.approx(1 / 6, rel=0.01)


def test_dither_needs_a_generator():
    with pytest.raises(ValueError, match="rng"):
        digitize(torch.ones(1), gain=1.0, rounding="dithered_floor")


@pytest.mark.parametrize("rounding", ["nearest", "truncation", "dithered_floor"])
def test_gradient_is_the_line_and_nothing_where_it_clips(rounding):
    electrons = torch.tensor([-5.0, 10.2, 1e9]).requires_grad_()
    digitize(electrons, gain=2.0, rounding=rounding, bits=8, rng=seeded()).sum().backward()
    assert electrons.grad.tolist() == [0.0, 2.0, 0.0]


@settings(max_examples=60, deadline=None)
@given(
    st.lists(st.floats(0, 999999995904.0, width=32), min_size=1, max_size=8), st.floats(1.0, 1e6)
)
def test_the_bound_of_the_full_well_is_true(values, capacity):
    electrons = torch.tensor(values, dtype=torch.float64)
    result = full_well(electrons, capacity=capacity)
    bound = full_well.hooks.skip_bound(TensorStats.of(electrons), capacity=capacity)
    assert float((result - electrons).abs().max()) <= bound * float(result.abs().max()) * (1 + 1e-9)
    assert (bound == 0) == (max(values) <= capacity)


def test_full_well_counts():
    (line,) = full_well.hooks.check(torch.tensor([5.0, 9.0, 9.0]), torch.zeros(3), capacity=9.0)
    assert line.text == "2 of 3 pixels reach the full well"


@settings(max_examples=60, deadline=None)
@given(st.integers(1, 12), st.integers(1, 12), st.integers(1, 12), st.integers(1, 12))
def test_crop_keeps_the_axis(y, x, h, w):
    image = torch.zeros(2, y, x)
    image[:, y // 2, x // 2] = 1.0
    if h > y or w > x:
        with pytest.raises(ValueError, match="enlarge"):
            crop(image, shape=(h, w))
        return
    window = crop(image, shape=(h, w))
    assert window.shape == (2, h, w)
    assert float(window[1, h // 2, w // 2]) == 1.0
    assert crop.hooks.skip_bound(TensorStats.of(image), shape=(h, w)) == (
        0.0 if (h, w) == (y, x) else math.inf
    )


def test_check_of_the_converter():
    assert not digitize.hooks.check(torch.full((4,), 255.0), torch.zeros(4), bits=8)[0].ok
    assert (
        digitize.hooks.check(torch.tensor([0.0, 1.0, 2.0, 255.0]), bits=8)[0].text
        == "25.00% of pixels are at the largest digital number, 25.00% at 0 DN"
    )


@pytest.mark.parametrize("rounding", ["nearest", "truncation", "dithered_floor"])
@pytest.mark.parametrize("error", [1e-7, 1e-5, 3e-3, 0.2, 0.5, 0.9, 3.3])
def test_numbers_changed_by_rounding_are_as_many_as_estimated(error, rounding):
    """Values spread by noise, errors of any law: the rms of the changed numbers, and at most
    half as much again.
    """
    draw = torch.Generator().manual_seed(1)
    values = 200.0 * torch.rand(400, 500, generator=draw, dtype=torch.float64)
    for errors in (
        torch.randn(values.shape, generator=draw, dtype=torch.float64),
        torch.ones_like(values),
    ):
        off = errors * error / errors.square().mean().sqrt()
        before, after = (
            digitize(x, gain=1.0, rounding=rounding, rng=torch.Generator().manual_seed(2))
            for x in (values, values + off)
        )
        found = float((after - before).square().mean().sqrt())
        told = digitize.hooks.rounding_error(error, result=TensorStats.of(after), gain=1.0)
        assert error <= told
        assert found <= told
        # so few numbers that their count is chance
        assert told <= 1.5 * found or told**2 * values.numel() < 60


@pytest.mark.parametrize("mean", [1e-6, 1e-3, 0.1, 0.9, 5.0, 400.0])
def test_more_numbers_change_in_one_of_ten_thousand_cases(mean):
    pixels = 10**7
    most = (
        digitize.hooks.rounding_error(
            mean / pixels, result=TensorStats((pixels,), "float32", 0, 1, 1, 1, True)
        )
        ** 2
    )
    few = math.floor(most * pixels + 1e-6)
    more = 1.0 - sum(
        math.exp(n * math.log(mean) - mean - math.lgamma(n + 1)) for n in range(few + 1)
    )
    assert more <= 1e-4
    assert few <= mean + 8.0 * math.sqrt(mean) + 9.0


# --- borders --------------------------------------------------------------------------------------


@pytest.mark.parametrize("bits", [1, 8, 12, 16])
def test_the_ends_of_the_converter_are_zero_and_two_to_the_bits_less_one(bits):
    top = 2**bits - 1
    found = digitize(
        torch.tensor([-0.6, -0.4, 0.4, top - 0.6, top + 0.4, top + 1.0, 1e9]), gain=1.0, bits=bits
    )
    assert found.tolist() == [0, 0, 0, top - 1, top, top, top]


def test_halves_are_rounded_to_even_and_truncation_cuts():
    halves = torch.tensor([0.5, 1.5, 2.5, 3.5])
    assert digitize(halves, gain=1.0).tolist() == [0, 2, 2, 4]
    assert digitize(halves, gain=1.0, rounding="truncation").tolist() == [0, 1, 2, 3]


@pytest.mark.parametrize(("high", "ok"), [(1, True), (2, False)])
def test_half_of_the_pixels_at_the_largest_number_are_too_many(high, ok):
    numbers = torch.tensor([255.0] * high + [254.0] * (4 - high))
    assert digitize.hooks.check(numbers, bits=8)[0].ok == ok


def test_a_full_well_is_reached_by_the_well_itself():
    assert full_well(torch.tensor([8.9, 9.0, 9.1]), capacity=9.0).tolist() == pytest.approx(
        [8.9, 9.0, 9.0]
    )
    at_well = TensorStats.of(torch.tensor([9.0]))
    above = TensorStats.of(torch.tensor([10.0, -2.0], dtype=torch.float64))
    assert full_well.hooks.skip_bound(at_well, capacity=9.0) == 0.0
    assert full_well.hooks.skip_bound(TensorStats.of(torch.tensor([6.0])), capacity=9.0) == 0.0
    assert full_well.hooks.skip_bound(above, capacity=9.0) == pytest.approx(1 / 9)
    below = TensorStats.of(torch.tensor([10.0, -30.0], dtype=torch.float64))
    assert full_well.hooks.skip_bound(below, capacity=9.0) == pytest.approx(1 / 30)


def test_a_well_limits_from_above_alone():
    assert full_well(torch.tensor([-3.0, 5.0, 20.0]), capacity=10.0).tolist() == [-3.0, 5.0, 10.0]


@pytest.mark.parametrize("bits", [8, 10, 12])
@pytest.mark.parametrize("gain", [0.013, 0.0777, 0.1003, 0.25, 0.9, 3.1])
def test_a_full_pixel_has_at_least_the_clipping_number_and_may_have_no_more(bits, gain):
    """Full pixels by all three roundings; the dither draws the lowest of their numbers."""
    full = full_well(torch.full((5000,), 2000.0, dtype=torch.float64), capacity=1237.0)
    numbers = [
        digitize(full, gain=gain, rounding=rounding, bits=bits, rng=seeded())
        for rounding in ("nearest", "truncation", "dithered_floor")
    ]
    assert clipping_number(1237.0, gain, bits) == min(float(x.min()) for x in numbers)


def test_black_is_not_clipped():
    assert clipping_number(10.0, 0.01, 8) == 1


@pytest.mark.parametrize(
    ("well", "gain", "bits"), [(1237.0, 0.1003, 12), (1e5, 0.1, 12), (5000.0, 0.25, 10)]
)
@pytest.mark.parametrize("offset", [0.0, 37.0])
def test_the_light_that_fills_a_pixel_is_the_least_that_gives_the_clipping_number(
    well, gain, bits, offset
):
    light = electrons_to_clip(well, gain, bits, offset)
    around = torch.tensor([light * (1 - 1e-6), light * (1 + 1e-6)], dtype=torch.float64) + offset
    below, above = digitize(full_well(around, capacity=well), gain=gain, bits=bits).tolist()
    assert below < clipping_number(well, gain, bits) <= above


@pytest.mark.parametrize("error", [0.1, 0.3, 0.45, 0.7])
def test_of_very_many_pixels_the_share_that_changes_its_number_is_the_expected_one(error):
    """A number changes with the probability e, so that the mean square grows by e - e^2, and by
    1/4 from e = 1/2 on.
    """
    many = TensorStats(
        (10**7, 10**7), "float32", min=0.0, max=9.0, sum=4e14, support=10**14, finite=True
    )
    found = digitize.hooks.rounding_error(error, result=many)
    share = error - error**2 if error < 0.5 else 0.25
    assert found == pytest.approx(math.sqrt(error**2 + share), rel=1e-4)


def test_a_run_says_the_end_of_the_converter_and_its_error_in_numbers():
    assert digitize.hooks.preflight(gain=0.5, bits=8) == [
        "the largest digital number is 255 DN = 510 e-"
    ]
    assert digitize.hooks.propagate_error(ErrorBound(3.0), result=None, gain=0.5) == 1.5
