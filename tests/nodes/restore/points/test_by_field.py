"""Restoration with a PSF that was measured by field: beside the true PSF, and its error in the
interval.
"""

import numpy as np
import pytest
import torch
from scipy.stats import t

from neusee.nodes.restore import (
    measured_psf,
    spread_by_field,
    wiener,
    wiener_by_field,
    wiener_spread,
)
from neusee.nodes.values import Bands, MeasuredPsf, Psf
from tests.nodes.restore.inverse.test_posterior_spread import chinese_house
from tests.nodes.restore.points.independent_camera import (
    CAMERA,
    READ,
    blurred,
    centred,
    place_in,
    points,
)

STRONG = {"lobe": 0.5, "far": 12.0}  #: half of the light moves by 12 pixels over the field
ONE, COLOURS = torch.ones(3, dtype=torch.float64), torch.eye(3, dtype=torch.float64)


def known(kernels, draws=None):
    """A measured PSF without error, or with the given draws."""
    kernels = torch.as_tensor(kernels)
    drawn = kernels[None].expand(4, *kernels.shape) if draws is None else draws
    return MeasuredPsf(
        kernels, torch.zeros_like(kernels), drawn.float(), torch.zeros(1, 4).double(), *[ONE] * 4
    )


def picture(size, seed=0):
    rng = np.random.default_rng(seed)
    electrons = torch.tensor(
        rng.poisson(2000 * (1 + rng.random((3, *size)))) + rng.normal(0, READ, (3, *size))
    )
    return electrons, torch.zeros(3, *size, dtype=torch.bool)


def test_one_zone_is_the_filter_with_the_psf_of_each_channel():
    electrons, clipped = picture((20, 18))
    kernels = centred((0.1, -0.2), (9, 9))
    found = wiener_by_field(electrons, known(kernels[None, None]), clipped, read_noise=READ)
    bands = Bands(550e-9 * ONE[:1], 1e-8 * ONE[:1], ONE[:1])
    for channel in range(3):  # alone, so that the channels of the filter do not tell of one another
        only = [x[channel : channel + 1] for x in (electrons, torch.tensor(kernels), clipped)]
        alone = wiener_by_field(only[0], known(only[1][None, None]), only[2], read_noise=READ)
        there = wiener(
            only[0],
            Psf(only[1], ONE[:1]),
            ONE[:1],
            COLOURS[:1, :1],
            bands,
            only[2],
            read_noise=READ,
        )
        torch.testing.assert_close(alone, there, rtol=0, atol=1e-9)
        assert float((alone[0] - found[channel]).abs().max()) > 1e-3


def test_equal_psfs_in_all_zones_restore_as_one_and_so_does_the_blend_at_a_node():
    electrons, clipped = picture((40, 44))
    kernels = centred((0.0, 0.0), (9, 9))
    one = wiener_by_field(electrons, known(kernels[None, None]), clipped, read_noise=READ)
    four = wiener_by_field(
        electrons, known(np.tile(kernels, (2, 2, 1, 1, 1))), clipped, read_noise=READ
    )
    contrast = float((one - one.mean()).square().mean().sqrt())
    # each part has a prior of its own
    assert float((one - four).square().mean().sqrt()) < 0.2 * contrast
    assert abs(float((one - four).mean())) < 0.01 * contrast


def test_the_glare_of_a_laser_is_removed_around_each_node(tmp_path):
    """A pattern that decays from a bright spot, with no other light in the model: what is left
    is as without it.
    """
    electrons, clipped = picture((40, 44))
    y, x = np.indices((40, 44))
    rings = np.cos(0.9 * np.hypot(y - 12.0, x - 30.0)) ** 2 / (
        1 + 0.05 * ((y - 12.0) ** 2 + (x - 30.0) ** 2)
    )
    glare = torch.tensor(np.stack([rings, 0.8 * rings, 0.5 * rings]))
    kernels = np.tile(centred((0.0, 0.0), (9, 9)), (2, 2, 1, 1, 1))
    clean, blind, told = (
        wiener_by_field(seen, known(kernels), clipped, light, read_noise=READ, doubt=0.05)
        for seen, light in (
            (electrons, None),
            (electrons + 2e4 * glare, None),
            (electrons + 2e4 * glare, [3.0 * glare]),
        )
    )
    away, near = (float((found - clean).square().mean().sqrt()) for found in (blind, told))
    assert near < 0.1 * away


def test_one_zone_knows_as_much_as_the_filter_that_is_told_of_lasers():
    electrons, clipped = (x[:1] for x in picture((24, 26)))
    away = np.hypot(*(np.indices((24, 26)) - 9.0))
    glare, others = (torch.tensor(np.cos(r * away) ** 2 / (1 + away**2))[None] for r in (0.9, 0.95))
    kernels = torch.tensor(centred((0.0, 0.0), (9, 9)))[:1]
    bands, colour = Bands(550e-9 * ONE[:1], 1e-8 * ONE[:1], ONE[:1]), COLOURS[:1, :1]
    told, settings = (
        ([glare], [torch.stack([others, 1.01 * glare])]),
        {"doubt": 0.1, "draws": 2, "read_noise": READ},
    )
    seen, seed = electrons + 3e4 * glare, torch.Generator().manual_seed
    found = spread_by_field(
        seen, known(kernels[None, None]), clipped, colour, *told, **settings, rng=seed(0)
    )
    camera = (Psf(kernels, ONE[:1]), ONE[:1], colour, bands)
    there = wiener_spread(seen, *camera, clipped, colour, *told, **settings, rng=seed(0))
    torch.testing.assert_close(found, there, rtol=1e-6, atol=1e-3)
    blind = spread_by_field(
        seen, known(kernels[None, None]), clipped, colour, rng=seed(0), draws=2, read_noise=READ
    )
    assert float((found - blind).abs().mean()) > 1.0


def test_another_number_of_channels_is_refused():
    electrons, clipped = picture((20, 20))
    with pytest.raises(ValueError, match="measured PSF has 2 channels and the picture 3"):
        wiener_by_field(electrons, known(np.ones((1, 1, 2, 5, 5)) / 25), clipped, read_noise=READ)


def test_the_error_of_the_psf_makes_the_interval_wider():
    rng = np.random.default_rng(0)
    light = blurred(2e4 * chinese_house(56, rng), (32, 32), reach=8)
    electrons, clipped = (
        torch.tensor(rng.poisson(light).astype(float)),
        torch.zeros(3, 32, 32, dtype=torch.bool),
    )
    kernels = centred((0.0, 0.0), (9, 9))[None, None]
    wrong = rng.normal(0, 0.01, (8, *kernels.shape))
    draws = torch.tensor(kernels + wrong - wrong.mean((-2, -1), keepdims=True))
    sure, doubted = (
        spread_by_field(
            electrons,
            psf,
            clipped,
            COLOURS,
            draws=8,
            read_noise=READ,
            rng=torch.Generator().manual_seed(0),
        )
        for psf in (known(kernels), known(kernels, draws))
    )
    assert float(doubted.mean()) > 1.05 * float(sure.mean())


@pytest.fixture(scope="module")
def seen():
    """A picture behind a PSF that changes strongly over the field, and the grid of its nodes."""
    rng, shape = np.random.default_rng(7), (100, 100)
    scene = 6000 * chinese_house(140, rng)
    light = blurred(scene, shape, **STRONG)
    electrons = torch.tensor(rng.poisson(light) + rng.normal(0, READ, light.shape))
    nodes = [(y, x) for y in (24.5, 74.5) for x in (24.5, 74.5)]
    true = np.stack([centred(place_in(p, shape), (25, 25), **STRONG) for p in nodes])
    return electrons, scene[:, 20:-20, 20:-20], nodes, true.reshape(2, 2, 3, 25, 25)


def scored(restored, truth):
    """Give PSNR and difference within the rim, after the shift, scale and turn that explain most of
    the difference.

    The centre of a measured PSF is its own choice at each node: a distortion of the picture is not
    measured.
    """
    inner = (slice(None), slice(8, -8), slice(8, -8))
    y, x = np.indices(truth.shape[1:]) / truth.shape[1] - 0.5
    slopes = [slope * way for slope in np.gradient(restored, axis=(1, 2)) for way in (1.0, y, x)]
    columns = np.stack([part[inner].ravel() for part in (*slopes, np.ones_like(restored))], 1)
    rest = (truth - restored)[inner].ravel()
    rest = rest - columns @ np.linalg.lstsq(columns, rest, rcond=None)[0]
    return 10 * np.log10(truth.max() ** 2 / (rest**2).mean()), rest.reshape(restored[inner].shape)


def taken(folder, nodes, signals, seed, draws):
    rng = np.random.default_rng(seed)
    for number, signal in enumerate(signals):
        places = [tuple(c + rng.uniform(-0.5, 0.5) for c in p) for p in nodes]
        np.save(folder / f"p{number}.npy", points(rng, (100, 100), places, [signal] * 4, **STRONG))
    files = tuple(sorted(folder.iterdir()))
    return measured_psf(
        torch.ones(3, 3),
        files=files,
        window=(25, 25),
        zones=(2, 2),
        draws=draws,
        shape=(100, 100),
        rng=torch.Generator().manual_seed(1),
        **CAMERA,
    )


@pytest.mark.slow
def test_restoring_with_the_measured_psf_comes_near_restoring_with_the_true_one(seen, tmp_path):
    electrons, truth, nodes, kernels = seen
    clipped = torch.zeros(electrons.shape, dtype=torch.bool)
    # of which the filter uses none
    found = taken(tmp_path, nodes, [6e4, 6e4, 6e5, 6e5], 3, draws=4)
    middle = known(kernels.mean((0, 1), keepdims=True))
    measured, told, mean = (
        scored(wiener_by_field(electrons, psf, clipped, read_noise=READ).numpy(), truth)[0]
        for psf in (found, known(kernels), middle)
    )
    raw, _ = scored(electrons.numpy(), truth)
    print(
        f"measured {measured:.3f} dB, told {told:.3f} dB, one PSF {mean:.3f} dB, raw {raw:.3f} dB"
    )
    assert abs(measured - told) < 0.05
    assert measured > mean + 0.3
    assert measured > raw + 1


@pytest.mark.slow
def test_the_interval_holds_the_scene_when_the_psf_is_poorly_known(seen, tmp_path):
    """Two faint frames: without the draws of the PSF the interval is far too narrow, with them
    somewhat.
    """
    electrons, truth, nodes, _ = seen
    clipped = torch.zeros(electrons.shape, dtype=torch.bool)
    # as many as there are drawn scenes below
    found = taken(tmp_path, nodes, [2e3, 2e3], 5, draws=8)
    _, wrong = scored(wiener_by_field(electrons, found, clipped, read_noise=READ).numpy(), truth)
    inside = []
    for psf in (found, known(found.kernels)):
        seed = torch.Generator().manual_seed(2)
        deviation = spread_by_field(
            electrons, psf, clipped, COLOURS, draws=8, read_noise=READ, rng=seed
        ).numpy()
        inside.append((abs(wrong) < t.ppf(0.95, 32) * deviation[:, 8:-8, 8:-8]).mean())
    print(f"90 % intervals hold {inside[0]:.1%} with the error of the PSF, {inside[1]:.1%} without")
    assert 0.7 < inside[0] < 0.97
    assert inside[0] > inside[1] + 0.1
