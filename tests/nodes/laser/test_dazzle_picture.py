"""Saturated and veiled pixels of a picture against the criterion written out pixel by pixel."""

import math

import numpy as np
import pytest
import torch

from neusee.nodes.laser import dazzle, veil_limit

SENSOR = {"shape": (24, 30), "full_well": 1000.0, "quantum_efficiency": 0.5, "read_noise": 4.0}


def rand(seed, *shape):
    return torch.rand(*shape, generator=torch.Generator().manual_seed(seed), dtype=torch.float64)


def spot(peak, shape=(24, 30), width=4.0):
    y, x = (torch.arange(n, dtype=torch.float64) - n // 2 for n in shape)
    return peak * torch.exp(-(y[:, None] ** 2 + x**2) / (2 * width**2)).expand(2, *shape)


def by_loops(scene, lasers, feature, contrast, rule, threshold, offset):
    """The counts by plain loops over the pixels, in NumPy, with means over windows cut at the
    border.
    """
    scene, veil = scene.numpy() * 0.5, sum(x.numpy() for x in lasers) * 0.5
    saturated = veiled = visible = 0
    channels, rows, columns = scene.shape
    before, after = feature // 2, feature - feature // 2
    for y in range(rows):
        for x in range(columns):
            lost = (scene[:, y, x] >= 1000 - offset).any()
            filled = (scene[:, y, x] + veil[:, y, x] >= 1000 - offset).any()
            shown = []
            for light in (0, 1):
                seen = False
                for c in range(channels):
                    window = np.s_[
                        c, max(0, y - before) : y + after, max(0, x - before) : x + after
                    ]
                    n, v = scene[window].mean(), light * veil[window].mean()
                    signal = (
                        contrast
                        * n
                        * (feature / math.sqrt(n + v + 16) if rule == "snr" else 1 / (n + v))
                    )
                    seen |= signal >= threshold
                shown.append(seen)
            visible += shown[0] and not lost
            saturated += filled and not lost
            veiled += shown[0] and not lost and not filled and not shown[1]
    return saturated, veiled, visible / (rows * columns)


@pytest.mark.parametrize(("rule", "threshold"), [("snr", 5.0), ("snr", 6.0), ("contrast", 0.05)])
@pytest.mark.parametrize("feature", [3, 4])
@pytest.mark.parametrize("offset", [0.0, 100.0])
def test_the_counts_are_those_of_the_criterion_at_each_pixel(rule, threshold, feature, offset):
    scene = 40 * rand(3, 2, 24, 30) + torch.tensor([110.0, 20.0])[:, None, None]
    scene[:, :3, :3] = 2100.0
    lasers = [spot(5000.0), spot(40.0, width=9.0)]
    choice = {
        "feature": feature,
        "contrast": 0.3,
        "rule": rule,
        "threshold": threshold,
        "offset": offset,
    }
    found = dazzle(scene, lasers, **SENSOR, **choice)
    expected = by_loops(scene, lasers, **choice)
    assert (int(found.saturated), int(found.veiled)) == expected[:2]
    assert float(found.visible) == pytest.approx(expected[2])
    assert float(found.share) == pytest.approx(sum(expected[:2]) / 720)
    assert expected[0] > 20
    assert expected[1] > 20


def test_without_a_laser_nothing_is_dazzled_and_ghosts_dazzle_as_lasers_do():
    scene = 800 + 100 * rand(1, 2, 24, 30)
    none = dazzle(scene, **SENSOR)
    assert (float(none.saturated), float(none.veiled), float(none.share)) == (0, 0, 0)
    assert float(none.visible) == 1
    light = spot(5000.0)
    assert dazzle(scene, [light], **SENSOR) == dazzle(scene, None, [light], **SENSOR)


def test_pixels_that_are_full_without_the_laser_are_not_counted():
    scene = torch.full((1, 24, 30), 2500.0)
    assert float(dazzle(scene, [spot(5000.0)[:1]], **SENSOR).share) == 0


def test_the_sensor_counts_its_own_window_of_the_scene():
    scene = torch.full((2, 40, 50), 600.0)
    scene[:, 8:32, 10:40] = 700.0
    light = spot(4000.0, (40, 50))
    inside = dazzle(scene[:, 8:32, 10:40], [light[:, 8:32, 10:40]], **SENSOR)
    assert dazzle(scene, [light], **SENSOR) == inside


@pytest.mark.parametrize("rule", ["snr", "contrast"])
def test_at_the_limit_the_veil_leaves_just_the_threshold(rule):
    background = torch.tensor([50.0, 300.0, 4000.0], dtype=torch.float64)
    choice = {"contrast": 0.2, "feature": 10, "threshold": 5.0 if rule == "snr" else 0.05}
    veil = veil_limit(background, rule=rule, read_noise=8.0, **choice)
    assert (veil > 0).all()
    left = 0.2 * background / (background + veil)
    snr = 0.2 * background * 10 / (background + veil + 64).sqrt()
    torch.testing.assert_close(
        left if rule == "contrast" else snr, torch.full_like(left, choice["threshold"])
    )


@pytest.mark.parametrize("value", [math.nan, math.inf])
def test_light_that_is_not_finite_is_refused_and_named(value):
    scene, light = torch.full((2, 24, 30), 600.0), spot(4000.0)
    broken = scene.clone()
    broken[1, 4, 5] = value
    with pytest.raises(
        ValueError, match="photons holds values that are not finite: its dazzled pixels"
    ):
        dazzle(broken, [light], **SENSOR)
    for lasers, ghosts in (([light, broken], None), ([light], [broken])):
        with pytest.raises(ValueError, match="laser holds values that are not finite"):
            dazzle(scene, lasers, ghosts, **SENSOR)
