"""Few bands for the PSFs of all: chosen by an error that is estimated on parts of the scene, and
compared again.
"""

import numpy as np
import pytest
import torch

from neusee.nodes import doe
from neusee.nodes.optics import (
    _few_bands,
    few_bands,
    few_bands_checked,
    image_channels,
    psf,
    pupil,
    pupil_of_bands,
    stop,
)
from neusee.nodes.spectra import bands, compress, responses, rows
from neusee.nodes.values import FewBands, Psf

SCENE = bands(start=400e-9, stop=700e-9, count=31)
ROWS = rows(SCENE, responses(SCENE), well=False)
LENS = {"focal_length": 0.11, "pixel_pitch": 2.9e-6}
SIZE = (256, 256)


def light():
    """Edges and fine grain, another in each band."""
    rng = torch.Generator().manual_seed(3)
    colours = (
        (torch.rand(3, 16, 16, generator=rng) > 0.5)
        .float()
        .repeat_interleave(16, 1)
        .repeat_interleave(16, 2)
    )
    weights = torch.rand(31, 3, generator=rng)
    cube = torch.tensordot(weights, colours + 0.1 * torch.rand(3, *SIZE, generator=rng), 1)
    return compress(cube, within=1e-6)


def lens(height=None):
    shape = stop(samples=256, pitch=16e-6, diameter=4e-3)
    flat = doe.flat(shape) if height is None else height
    return pupil(flat, doe.material(SCENE), SCENE, shape, defocus=0.7 * 550e-9)


@pytest.fixture(scope="module")
def camera():
    return lens(), light()


def off(found, exact):
    """The root mean square error of the worst row, over its brightest pixel."""
    error = np.sqrt(((found - exact) ** 2).mean((1, 2)))
    return float((error / exact.max((1, 2))).max())


def convolved(scene, kernels):
    """Sums over the bands of the image in float64, with NumPy's transforms, in the middle of the
    picture.
    """
    cube = np.einsum("bk,kyx->byx", scene.basis.numpy(), scene.planes.double().numpy())
    n = SIZE[0]
    product = np.fft.rfft2(cube, (2 * n, 2 * n)) * np.fft.rfft2(
        kernels.double().numpy(), (2 * n, 2 * n)
    )
    whole = np.fft.irfft2(np.einsum("rb,byx->ryx", ROWS.numpy(), product))
    return whole[:, n // 2 : n // 2 + n, n // 2 : n // 2 + n]


def test_the_weights_interpolate_between_the_bands_in_use():
    used = torch.tensor([0, 4, 9, 12])
    share = _few_bands.share_of_bands(used, 13)
    for j in range(4):
        np.testing.assert_allclose(
            share[:, j], np.interp(np.arange(13), used.numpy(), np.eye(4)[j]), atol=1e-15
        )
    assert _few_bands.share_of_bands(torch.tensor([2]), 3).tolist() == [[1.0]] * 3


@pytest.mark.parametrize("within", [3e-3, pytest.param(3e-4, marks=pytest.mark.slow)])
def test_the_image_is_within_the_estimate_and_the_estimate_within_what_is_allowed(camera, within):
    """An error is not estimated far too large either."""
    clear, scene = camera
    few = few_bands(clear, scene, ROWS, **LENS, shape=SIZE, within=within)
    assert 2 <= len(few.used) < 31
    found = psf(pupil_of_bands(clear, few), **LENS, shape=SIZE)
    again = few_bands_checked(few, found, clear, scene, ROWS, **LENS)
    got = image_channels(scene, found, ROWS, again)
    exact = convolved(scene, psf(clear, **LENS, shape=SIZE).intensity)
    error = off(got.planes.double().numpy(), exact)
    assert error <= float(few.error) <= within
    assert error <= float(again.error) <= 20 * error
    assert image_channels.hooks.approximation_error(got) == (
        float(got.bound) + float(again.error),
        float(got.largest) + float(again.largest),
    )


def test_a_stricter_limit_takes_more_bands(camera):
    clear, scene = camera
    counts = [
        len(few_bands(clear, scene, ROWS, **LENS, shape=SIZE, within=w).used)
        for w in (1e-2, 1e-3, 1e-4, 1e-9)
    ]
    assert counts == sorted(counts)
    assert (counts[0] < counts[2], counts[-1]) == (True, 31)


def test_a_choice_of_few_bands_is_compared_with_every_second_band(camera, monkeypatch):
    """All bands have PSFs only where few of every second one are not enough."""
    clear, scene = camera
    counted, focused = [], _few_bands.psf_intensity
    monkeypatch.setattr(
        _few_bands, "psf_intensity", lambda p, *a: counted.append(len(p.index)) or focused(p, *a)
    )
    for within, expected in ((1e-2, 16), (1e-4, 31)):
        counted.clear()
        few = few_bands(clear, scene, ROWS, **LENS, shape=SIZE, within=within)
        assert (len(few.used) <= 5) == (expected == 16)
        assert sum(counted) - counted[0] == expected  # the first three find the window


def test_an_estimate_that_was_too_low_is_raised(camera):
    clear, scene = camera
    share = _few_bands.share_of_bands(torch.tensor([0, 30]), 31)
    nothing = torch.zeros((), dtype=torch.float64)
    wrong = FewBands(share, torch.tensor([0, 30]), nothing, nothing)
    found = psf(pupil_of_bands(clear, wrong), **LENS, shape=SIZE)
    right = few_bands_checked(wrong, found, clear, scene, ROWS, **LENS)
    exact = convolved(scene, psf(clear, **LENS, shape=SIZE).intensity)
    error = off(image_channels(scene, found, ROWS, right).planes.double().numpy(), exact)
    assert error <= float(right.error) <= 10 * error
    whole = FewBands(torch.eye(31, dtype=torch.float64), torch.arange(31), nothing, nothing)
    assert few_bands_checked(whole, found, clear, scene, ROWS, **LENS) is whole


def test_all_bands_are_kept_where_an_estimate_costs_more_or_misses_the_light(camera):
    clear, scene = camera
    rough = 1e-6 * torch.rand(256, 256, generator=torch.Generator().manual_seed(1))
    for given, shape, within in (
        (clear, (200, 200), 1e-2),
        (clear, SIZE, 0.0),
        (lens(rough), SIZE, 1e-2),
    ):
        few = few_bands(given, scene, ROWS, **LENS, shape=shape, within=within)
        assert torch.equal(few.share, torch.eye(31, dtype=torch.float64))
        assert few_bands.hooks.check(few)[0].text.startswith("all 31 bands")
    light = Psf(torch.rand(31, 9, 9), torch.ones(31, dtype=torch.float64))
    same = image_channels(scene, light, ROWS, few, within=1e-4)
    assert torch.equal(same.planes, image_channels(scene, light, ROWS, within=1e-4).planes)


def test_sums_by_few_bands_agree_with_interpolated_psfs():
    rng = torch.Generator().manual_seed(5)
    share, scene = (
        _few_bands.share_of_bands(torch.tensor([0, 7, 15, 30]), 31),
        compress(torch.rand(31, 12, 14, generator=rng)),
    )
    few = FewBands(share, torch.tensor([0, 7, 15, 30]), *torch.zeros(2, dtype=torch.float64))
    found = Psf(torch.rand(4, 9, 7, generator=rng), torch.ones(4, dtype=torch.float64))
    all_of_them = found._replace(intensity=torch.tensordot(share, found.intensity.double(), 1))
    for border in ("zero", "reflect"):
        for within, largest in ((0.0, True), (1e-3, False)):
            sums = image_channels(
                scene, found, ROWS, few, border=border, within=within, largest=largest
            )
            exact = image_channels.hooks.reference(scene, found, ROWS, few, border=border).planes
            same = image_channels.hooks.reference(scene, all_of_them, ROWS, border=border).planes
            assert torch.equal(exact, same)
            assert (
                off(sums.planes.double().numpy(), exact.numpy())
                <= float(sums.bound)
                <= max(within, 1e-5)
            )
            assert bool(torch.isfinite(sums.largest)) == largest


def test_different_bands_are_refused(camera):
    clear, scene = camera
    with pytest.raises(ValueError, match="30 bands"):
        few_bands(clear, scene, ROWS[:, :30], **LENS, shape=SIZE, within=1e-2)
    few = FewBands(
        _few_bands.share_of_bands(torch.tensor([0, 15, 30]), 31),
        torch.tensor([0, 15, 30]),
        *torch.zeros(2),
    )
    with pytest.raises(ValueError, match="same bands"):
        image_channels(scene, Psf(torch.rand(4, 9, 9), torch.ones(4)), ROWS, few)
