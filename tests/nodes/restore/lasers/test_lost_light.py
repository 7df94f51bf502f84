"""The strength of a laser behind a dirty lens, and light that such a lens scatters, which is no
laser.

The frames come from the camera in NumPy, whose pupil has black grains and defocus that the nodes
are not told of.
"""

import functools

import numpy as np
import pytest
import torch
from scipy.stats import norm

from neusee.nodes.restore.inverse import View
from neusee.nodes.restore.lasers import (
    NORMAL,
    Camera,
    Choice,
    Found,
    Known,
    Laser,
    Lens,
    at_the_aperture,
    data_of,
    fitted,
    lamp_light,
    misfit_of,
    spreads,
    without_scattered,
)
from tests.nodes.restore.lasers import own_camera as own
from tests.nodes.restore.lasers.as_inputs import found_in, inputs

SIDE, LEAST = 64, 40.0
clean_pupil = own.pupil


@functools.lru_cache
def pupil(name):
    """A pupil of the camera; one such as `half_ring~5` has 40 black grains and 0.1 wave of
    defocus.
    """
    mask, _, seed = name.partition("~")
    inside, height = clean_pupil(mask)
    if not seed:
        return inside, height
    rng = np.random.default_rng(int(seed))
    at = (np.arange(own.SAMPLES) - (own.SAMPLES - 1) / 2) / (own.SAMPLES / 2)
    v, u = np.meshgrid(at, at, indexing="ij")
    clear = np.ones_like(inside)
    for y, x, r in zip(*rng.uniform(-1, 1, (2, 40)), rng.uniform(0.01, 0.04, 40), strict=True):
        clear[(v - y) ** 2 + (u - x) ** 2 < r**2] = 0
    return inside * clear, (height + 55e-9 * (v**2 + u**2) / own.silica(550e-9)) * inside


@pytest.fixture(autouse=True)
def dirty_lenses(monkeypatch):
    monkeypatch.setattr(own, "pupil", pupil)


def fit_of(frame, mask, lasers):
    """What a fit from these lasers finds, as the search would return it."""
    electrons, clipped, psf, known_pupil, light, responses, bands = inputs(frame, mask)
    lens = Lens(own.FOCAL, own.PITCH, (SIDE, SIDE))
    camera = Camera(known_pupil, responses, bands, lens, torch.tensor(1e-9, dtype=torch.float64))
    lamp = lamp_light(View(psf, light, responses, bands), known_pupil, lens, torch.float64)
    known = Known(electrons.double(), (~clipped).double(), camera, lamp, None, own.READ, (1e-9,))
    parts = tuple(
        Laser(
            camera,
            torch.tensor(
                [
                    *x.spot,
                    x.wavelength * 1e9,
                    x.channels.max() / own.response(x.wavelength).max(),
                    *[0] * 4,
                ]
            ),
        )
        for x in lasers
    )
    for _ in range(2):
        data = data_of(known, parts)
        fit = fitted(data, parts, 12)
        parts = fit.parts
    open_data = data._replace(clipped=None)
    now = misfit_of(open_data, parts, 1)[1]
    rests = [parts[:n] + parts[n + 1 :] for n in range(len(parts))] if len(parts) > 1 else [()]
    gains = [misfit_of(open_data, rest, 5 if rest else 0)[1] - now for rest in rests]
    choices = tuple(Choice(part, gain, gain, gain) for part, gain in zip(parts, gains, strict=True))
    return Found(fit, choices, data), known


def strength_of(found, known):
    """The interval of the electrons that follow the pattern of the first laser, and what is said
    of all of them.
    """
    told = spreads(found.fit, known.seen)[0]
    straight, spread = found.fit.parts[0].channels(), told.covariance.diagonal()[3:].sqrt()
    ends = torch.stack(
        [
            straight - NORMAL * spread,
            straight + NORMAL * spread,
        ],
        -1,
    )
    return ends.numpy(), at_the_aperture(straight, spread, told.ideal, known.seen)


def holds(ends, truth):
    return (ends[:, 0] < truth) & (truth < ends[:, 1])


@pytest.mark.slow
@pytest.mark.parametrize(("mask", "strength"), [("plain", 1e4), ("half_ring", 1e3), ("cubic", 1e5)])
def test_the_strength_behind_dirt_and_defocus_is_that_at_the_aperture(mask, strength):
    laser = own.Laser((4.3, -7.8), 533e-9, strength)
    rng = np.random.default_rng(2)
    light = own.irradiance(mask, "noise", SIDE, rng) + laser.electrons(f"{mask}~5", (SIDE, SIDE))
    found, known = fit_of(own.Frame(*own.digitized(light, rng)), mask, [laser])
    truth = laser.channels * pupil(mask)[0].sum() / pupil(f"{mask}~5")[0].sum()
    straight, (middle, ends) = strength_of(found, known)
    assert not holds(straight, truth)[1]  # a fit of the pattern alone misses what is scattered
    assert holds(ends.numpy(), truth).all()
    assert abs(float(middle[1]) - truth[1]) < 0.8 * abs(straight[1].mean() - truth[1])


@pytest.mark.slow
@pytest.mark.parametrize("mask", ["plain", "half_ring", "cubic"])
def test_behind_a_clean_lens_the_interval_is_hardly_wider(mask):
    laser = own.Laser((4.3, -7.8), 533e-9, 1e3)
    found, known = fit_of(
        own.frame(mask, "noise", SIDE, [laser], np.random.default_rng(2)), mask, [laser]
    )
    straight, (middle, ends) = strength_of(found, known)
    assert holds(ends.numpy(), laser.channels).all()
    assert (ends[:, 1] - ends[:, 0]).numpy()[1] < 1.2 * np.ptp(straight[1])
    assert float(middle[1]) == pytest.approx(laser.channels[1], rel=0.01)


def test_the_interval_is_that_of_draws_from_the_stated_law():
    """NumPy draws a dirty or a clean lens, the logarithm that is lost, and the error of the fit."""
    rng = np.random.default_rng(0)
    straight, spread, ideal, side = 1e6, 2.5e4, 2.0e4, 128
    seen = torch.ones(1, side, side)
    seen[:, :16] = 0
    for growth in (spread, ideal):
        scatter, faint = (
            np.sqrt(max(x, 0)) / straight * 2 for x in (growth**2 - ideal**2, 0.1025 * ideal**2)
        )
        hidden = norm.cdf(np.log(faint / 0.004) / np.log(2.0))
        dirty = rng.random(400_000) < (1 if scatter > faint else hidden / (1 + hidden))
        size, width = (scatter, 0.7) if scatter > faint else (min(faint, 0.004), 1.2)
        lost = 2.10 * size**0.74 * np.exp(2.15 / 8 + width * rng.normal(size=dirty.shape))
        draws = straight * np.exp(np.where(dirty, lost, 0)) + growth * rng.normal(size=dirty.shape)
        given = (torch.tensor([x], dtype=torch.float64) for x in (straight, growth, ideal))
        middle, ends = at_the_aperture(*given, seen)
        expected = np.quantile(draws, [0.5, 0.05, 0.95])
        assert np.abs(
            np.array([float(middle), *ends[0].tolist()]) - expected
        ).max() < 0.02 * np.ptp(expected)


def test_a_channel_that_does_not_see_the_laser_has_a_finite_interval():
    given = [
        torch.tensor(x, dtype=torch.float64)
        for x in ([-3.0, 0.0, 5.0], [10.0, 0.0, 9.0], [10.0, 0.0, 1.0])
    ]
    middle, ends = at_the_aperture(
        *given, torch.tensor([1.0, 0.0, 0.0])[:, None, None].expand(3, 300, 300)
    )
    assert middle.isfinite().all()
    assert ends.isfinite().all()
    assert ends[0, 0] < -3 < ends[0, 1]
    assert ends[2, 0] < middle[2] < ends[2, 1]


@pytest.mark.slow
def test_speckle_of_a_strong_laser_is_no_laser_and_a_second_laser_is():
    laser = own.Laser((4.3, -7.8), 533e-9, 1e3)
    other = own.Laser((-9.6, 11.2), 610e-9, 1e2)
    rng = np.random.default_rng(2)
    scene = own.irradiance("half_ring", "noise", SIDE, rng)
    strong, weak = (x.electrons("half_ring~5", (SIDE, SIDE)) for x in (laser, other))
    frame = own.Frame(*own.digitized(scene + strong, rng))
    # the grain of speckle that a second laser explains best
    speck = own.Laser((2.3, -12.8), 533e-9, 10.0)
    found, known = fit_of(frame, "half_ring", [laser, speck])
    assert found.choices[1].gain > LEAST
    assert len(without_scattered(found, known, LEAST).fit.parts) == 1
    found, known = fit_of(
        own.Frame(*own.digitized(scene + strong + weak, rng)), "half_ring", [laser, other]
    )
    assert without_scattered(found, known, LEAST) is found


@pytest.mark.slow
def test_one_laser_behind_a_dirty_lens_is_one():
    laser = own.Laser((4.3, -7.8), 533e-9, 1e3)
    rng = np.random.default_rng(2)
    light = own.irradiance("half_ring", "noise", SIDE, rng) + laser.electrons(
        "half_ring~5", (SIDE, SIDE)
    )
    found = found_in(own.Frame(*own.digitized(light, rng)), "half_ring", lamps=0, most=2)
    assert int(found.number) == 1
    truth = laser.channels * pupil("half_ring")[0].sum() / pupil("half_ring~5")[0].sum()
    assert holds(found.strength_interval[0].numpy(), truth).all()
