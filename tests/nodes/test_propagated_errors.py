"""How errors pass through nodes: errors of known size are put in, and what comes out is within
the bound.
"""

import math

import pytest
import torch

from neusee.nodes import ErrorBound, TensorStats, doe, optics, restore, sensor
from neusee.nodes.values import Bands, Channels

CAMERA = {"pixel_pitch": 3e-6, "exposure": 0.01}


def seeded(seed):
    return torch.Generator().manual_seed(seed)


def off(draw, value, size, spread=1.0):
    """Return an error of ``value`` with the rms ``size`` times its largest element, in a share
    of its elements.
    """
    noise = torch.randn(value.shape, generator=draw, dtype=torch.float64)
    noise = noise.where(torch.rand(value.shape, generator=draw) <= spread, 0.0)
    rms = float(noise.square().mean().sqrt())
    return noise * (size * float(value.abs().max()) / rms) if rms else noise


def rms_of(error):
    return float(error.double().square().mean().sqrt())


def bound_of(value, error, **more):
    return ErrorBound(rms_of(error), TensorStats.of(value), **more)


@pytest.mark.parametrize("seed", range(40))
def test_no_tensor_of_its_count_range_and_sum_has_a_larger_root_mean_square(seed):
    draw = seeded(seed)
    low, high = (
        -3.0 * float(torch.rand((), generator=draw)),
        0.1 + 5.0 * float(torch.rand((), generator=draw)),
    )
    share = torch.rand(3, 4, generator=draw, dtype=torch.float64) ** (1 + seed % 5)
    value = low + (high - low) * share.where(torch.rand(3, 4, generator=draw) > 0.5, share.round())
    facts = TensorStats.of(value)
    rms = float(value.square().mean().sqrt())
    assert rms <= facts.largest_rms * (1 + 1e-12)
    assert facts.largest_rms <= max(abs(facts.min), abs(facts.max))


def test_of_zeros_and_ones_the_bound_is_exact():
    value = torch.tensor([0.0, 1.0, 0.0, 0.0, 1.0, 0.0, 0.0, 0.0])
    assert TensorStats.of(value).largest_rms == pytest.approx(0.5, rel=1e-3)
    assert TensorStats.of(-value).largest_rms == pytest.approx(0.5, rel=1e-3)
    assert TensorStats.of(torch.full((4,), 2.0)).largest_rms == 2.0
    unknown = TensorStats((4,), "float32", -3.0, 1.0, math.nan, 4, True)
    assert unknown.largest_rms == 3.0


@pytest.mark.parametrize("both", [True, False])
def test_the_errors_of_light_and_level_multiply_too(both):
    """Light and level that are 10 % too low: the product is 19 % too low, of which 1 % is that
    of both.
    """
    bands = Bands(*(torch.tensor([x], dtype=torch.float64) for x in (550e-9, 1e-8, 1.0)))
    responses, rows = (
        torch.ones(1, 1, dtype=torch.float64),
        torch.full((1, 1), 550e-9, dtype=torch.float64),
    )
    planes, level = (
        torch.full((1, 4, 4), 9.0, dtype=torch.float64),
        torch.tensor([9.0], dtype=torch.float64),
    )
    light = ErrorBound(1.0, TensorStats.of(planes), peak=0.1)  # the light is 10
    factor = ErrorBound(1.0, TensorStats.of(level)) if both else ErrorBound(0.0)
    zero = torch.zeros((), dtype=torch.float64)
    found = sensor.expose(Channels(planes, rows, zero), bands, responses, level, **CAMERA)
    true = sensor.expose(Channels(planes + 1, rows, zero), bands, responses, level + both, **CAMERA)
    told = sensor.expose.hooks.propagate_error(
        light, ErrorBound(0.0), ErrorBound(0.0), factor, result=TensorStats.of(found), **CAMERA
    )
    assert told == pytest.approx(rms_of(true - found), rel=1e-6)


def test_an_error_of_single_bands_has_no_bound_behind_a_channel():
    """A bright band that no channel sees would make the error of a dark band look small."""
    image = ErrorBound(1e-3, TensorStats((2, 4, 4), "float32", 0.0, 1e6, 1.0, 32, True))
    result = TensorStats((1, 4, 4), "float32", 0.0, 1.0, 1.0, 16, True)
    exact = ErrorBound(0.0)
    assert (
        sensor.expose.hooks.propagate_error(image, exact, exact, result=result, **CAMERA)
        == math.inf
    )
    assert sensor.expose.hooks.propagate_error(exact, exact, exact, result=result, **CAMERA) == 0.0


def test_levels_of_single_bands_have_no_bound():
    image = ErrorBound(1e-3, TensorStats((2, 4, 4), "float32", 0.0, 1.0, 1.0, 32, True), peak=1e-3)
    facts = TensorStats((2,), "float64", 1.0, 2.0, 3.0, 2, True)
    how = {"result": facts, "strength": 0.7}
    assert sensor.level.hooks.propagate_error(image, rule="per_band", **how) == math.inf
    assert sensor.level.hooks.propagate_error(image, rule="channel_sum", **how) == pytest.approx(
        2.0 * 1e-3 / 0.999
    )
    matrix = TensorStats((3, 3), "float64", -1.0, 2.0, 3.0, 9, True)
    exact = ErrorBound(0.0)
    uneven, even = (
        ErrorBound(1e-3, TensorStats((2,), "float64", low, 2.0, 4.0, 2, True)) for low in (1.0, 2.0)
    )
    hook = restore.colour_matrix.hooks.propagate_error
    assert hook(exact, exact, exact, uneven, result=matrix) == math.inf
    assert 0 < hook(exact, exact, exact, even, result=matrix) <= 2.0 * 5e-4 / (1 - 5e-4)


@pytest.mark.parametrize("seed", range(30))
def test_a_filter_carries_the_errors_of_its_light_and_of_its_ratio(seed):
    draw = seeded(seed)
    bands = Bands(
        torch.linspace(4e-7, 7e-7, 5, dtype=torch.float64),
        torch.full((5,), 6e-8, dtype=torch.float64),
        torch.ones(5, dtype=torch.float64),
    )
    lines = (
        [Bands(*(torch.tensor([x], dtype=torch.float64) for x in (4.1e-7, 1e-9, 1.0)))]
        if seed % 2
        else None
    )
    ratio = torch.rand(5, generator=draw, dtype=torch.float64) * torch.logspace(
        -3, 0, 5, dtype=torch.float64
    )
    light = 100 * torch.rand(3, 6, 6, generator=draw, dtype=torch.float64)
    error, wrong = off(draw, light, 0.01), off(draw, ratio, 3e-4, spread=0.3)
    found = doe.equal_filter(light, ratio, bands, lines)
    true = doe.equal_filter(light + error, (ratio + wrong).abs(), bands, lines)
    told = doe.equal_filter.hooks.propagate_error(
        bound_of(light, error), bound_of(ratio, wrong), result=TensorStats.of(found)
    )
    assert rms_of(found - true) <= told * (1 + 1e-6)


@pytest.mark.parametrize("channels", [1, 3, 4])
@pytest.mark.parametrize("seed", range(10))
def test_noise_in_the_channels_is_enlarged_by_no_more_than_the_matrix_can(seed, channels):
    """A matrix that takes differences of channels enlarges their noise many times, and their
    light not at all.
    """
    draw = seeded(seed)
    matrix = torch.randn(3, channels, generator=draw, dtype=torch.float64)
    matrix[0] = matrix[0] - matrix[0].mean() * (channels > 1)
    light = 50 + torch.rand(channels, 20, 20, generator=draw, dtype=torch.float64)
    error = off(draw, light, 0.01, spread=0.5)
    found = restore.colour(light, matrix)
    change = rms_of(restore.colour(light + error, matrix) - found)
    exact = ErrorBound(0.0, TensorStats.of(matrix))
    told = restore.colour.hooks.propagate_scattered(
        bound_of(light, error), exact, result=TensorStats.of(found)
    )
    assert change <= told * (1 + 1e-6)
    assert told <= 10 * change


def test_without_statistics_the_noise_of_colours_is_unknown():
    facts = TensorStats((3, 2, 2), "float32", 0.0, 1.0, 1.0, 12, True)
    unknown, known = ErrorBound(1.0), ErrorBound(1.0, facts)
    assert restore.colour.hooks.propagate_scattered(unknown, known, result=facts) == math.inf
    assert restore.colour.hooks.propagate_scattered(known, unknown, result=facts) == math.inf


@pytest.mark.parametrize("node", [optics.image, optics.image_channels])
def test_what_a_psf_lacks_is_missing_in_each_pixel_and_in_the_brightest(node):
    psf = ErrorBound(
        0.02, TensorStats((2, 4, 4), "float32", 0.0, 2.0, 1.0, 32, True), estimated=True
    )
    picture = TensorStats((2, 6, 6), "float32", 0.0, 50.0, 1.0, 72, True)
    exact = ErrorBound(0.0)
    told = node.hooks.propagate_error(exact, psf, result=picture)
    assert told.rms == pytest.approx(0.01 * 50.0)
    assert told.peak == pytest.approx(0.01 / 0.99)
    assert node.hooks.propagate_error(ErrorBound(1.0, picture), psf, result=picture) == math.inf


@pytest.mark.parametrize("shape", [(2, 2), (3, 5), (8, 8)])
def test_all_of_an_error_may_lie_in_the_window(shape):
    image = torch.zeros(8, 8)
    error = torch.zeros(8, 8, dtype=torch.float64)
    error[4, 4] = 1.0
    told = sensor.crop.hooks.propagate_error(
        bound_of(image, error), result=TensorStats.of(torch.zeros(shape))
    )
    assert told == pytest.approx(rms_of(sensor.crop(error, shape=shape)), rel=1e-12)


def test_errors_of_electrons_count_in_digital_numbers_and_back():
    facts = TensorStats((5,), "float32", 0.0, 1.0, 1.0, 5, True)
    assert sensor.digitize.hooks.propagate_error(ErrorBound(3.0), result=facts, gain=0.25) == 0.75
    assert restore.electrons.hooks.propagate_error(ErrorBound(3.0), gain=0.25) == 12.0
    assert (
        sensor.full_well.hooks.propagate_error(ErrorBound(3.0), result=facts, capacity=1.0) == 3.0
    )
    assert (
        sensor.add_photons.hooks.propagate_error(
            ErrorBound(1.0), [ErrorBound(2.0), ErrorBound(4.0)], None, result=facts
        )
        == 7.0
    )
