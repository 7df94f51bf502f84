"""Wiener: sharpens what it can, keeps the level, survives clipping and every extreme."""

import math

import pytest
import torch
from hypothesis import given, settings
from hypothesis import strategies as st

from neusee.nodes.optics import image
from neusee.nodes.restore import wiener
from neusee.nodes.restore.inverse import _masked_blur, _wiener, effective_psf, strengths
from neusee.nodes.sensor import crop
from neusee.nodes.spectra import bands, illuminant, leaves, reflectances, responses
from neusee.nodes.values import Bands, Psf

ONE = torch.ones(1, dtype=torch.float64)
BANDS = Bands(550e-9 * ONE, 1e-8 * ONE, ONE)


def disc(radius, size=33):
    y = torch.arange(size) - size // 2
    kernel = (torch.hypot(y[:, None].float(), y[None].float()) <= radius).float()
    return Psf((kernel / kernel.sum())[None], ONE)


def scene(size=96):
    """Blocks of many sizes, in electrons: flat with edges, as pictures are."""
    rng = torch.Generator().manual_seed(3)
    picture = torch.zeros(size, size)
    for width in (size // 3, size // 6, size // 12):
        n = size // width
        picture += (
            torch.rand(n, n, generator=rng).repeat_interleave(width, 0).repeat_interleave(width, 1)
        )
    return 16000 * (picture / picture.max())[None]


def seen(truth, psf, border="reflect", seed=0):
    blurred = image(truth, psf, border=border)
    rng = torch.Generator().manual_seed(seed)
    noise = torch.randn(blurred.shape, generator=rng)
    return blurred + (blurred.clamp_min(0) + 10.5**2).sqrt() * noise


def run(electrons, psf, clipped=None, glare=None, **how):
    marked = torch.zeros(electrons.shape, dtype=torch.bool) if clipped is None else clipped
    channels = torch.ones(len(electrons), 1, dtype=torch.float64)
    return wiener(
        electrons, psf, ONE, channels, BANDS, marked, glare, **{"read_noise": 10.5, **how}
    )


def error(a, b):
    return float((a - b).square().mean().sqrt())


@pytest.mark.parametrize("border", ["reflect", "zero"])
@pytest.mark.parametrize("radius", [2, 4, 8])
def test_restores_what_a_disc_blurred(radius, border):
    truth, psf = scene(), disc(radius)
    blurred = seen(truth, psf, border)
    found = run(blurred, psf)
    inside = (slice(None), slice(16, -16), slice(16, -16))
    assert error(found[inside], truth[inside]) < 0.9 * error(blurred[inside], truth[inside])
    assert error(found, truth) < (0.9 if border == "reflect" else 1.4) * error(blurred, truth)


def test_light_that_came_over_the_edge_is_not_amplified():
    """A PSF as wide as the picture, and nothing beyond the edge: worse than noise, and the mean
    is still safe.
    """
    truth, psf = scene(), disc(40, 95)
    blurred = seen(truth, psf, "zero")
    assert error(run(blurred, psf), truth) < error(blurred, truth)


def test_a_perfect_lens_is_left_alone():
    truth = scene()
    found = run(seen(truth, disc(0)), disc(0))
    assert error(found, truth) < 1.05 * error(seen(truth, disc(0)), truth)


def test_lost_light_is_put_back():
    flat = torch.full((1, 40, 40), 5000.0)
    dim = Psf(0.5 * disc(2).intensity, ONE)
    torch.testing.assert_close(run(0.5 * flat, dim), flat, rtol=1e-4, atol=0.0)


@pytest.mark.parametrize("power", [-30, -17, -10, 4])
def test_a_grey_filter_scales_the_scene_of_the_same_electrons(power):
    """A power of two divides and multiplies without rounding; floors of the program made strong
    filters too dark.
    """
    psf = disc(2.0)
    electrons = seen(scene(48), psf)
    plain, dimmed = run(electrons, psf), run(electrons, Psf(psf.intensity * 2.0**power, ONE))
    assert torch.equal(dimmed, plain * 2.0**-power)


def test_balance_trades_sharpness_for_noise():
    blurred, psf = seen(scene(), disc(5)), disc(5)
    rough = [float(run(blurred, psf, balance=b).diff().square().mean()) for b in (0.01, 1.0, 100.0)]
    assert rough[0] > rough[1] > rough[2]


def test_a_clipped_laser_does_not_ring_everywhere():
    truth, psf = scene(), disc(4)
    laser = torch.zeros_like(truth)
    laser[0, 45:50, 45:50] = 1e6
    bright = seen(truth, psf) + image(laser, psf)
    clipped = bright > 24000
    far = torch.ones_like(clipped)
    far[0, 25:70, 25:70] = False
    masked = run(bright.clamp_max(24000), psf, clipped)
    naive = run(bright.clamp_max(24000), psf)
    alone = run(seen(truth, psf), psf)
    assert error(masked[far], truth[far]) < 1.5 * error(alone[far], truth[far])
    assert error(masked, truth) < error(naive, truth)


def test_each_channel_has_its_own_psf():
    line = Bands(
        *(torch.tensor(x, dtype=torch.float64) for x in ([400e-9, 700e-9], [1e-8] * 2, [1.0] * 2))
    )
    psf = Psf(torch.stack([disc(1).intensity[0], disc(3).intensity[0]]), torch.ones(2))
    seen_by = torch.tensor([[1.0, 0.0], [0.0, 1.0], [1.0, 1.0]], dtype=torch.float64)
    found = effective_psf(psf, torch.tensor([3.0, 1.0]), seen_by, line)
    torch.testing.assert_close(found[:2], psf.intensity)
    torch.testing.assert_close(found[2], (1200 * psf.intensity[0] + 700 * psf.intensity[1]) / 1900)
    with pytest.raises(ValueError, match="one `bands` step"):
        effective_psf(psf, torch.ones(3), seen_by, line)


def photographs(count, size=16):
    """Pictures of measured reflectances in daylight, as a camera's three channels see them:
    (channel, y, x).
    """
    visible = bands(start=400e-9, stop=700e-9, count=31)
    seen_by = responses(visible) * illuminant(visible) * visible.centres
    seen_by, measured = (seen_by / seen_by.sum(1, keepdim=True)).float(), reflectances(visible)
    for seed in range(count):
        rng = torch.Generator().manual_seed(seed)
        spectra = measured[torch.randint(len(measured), (200,), generator=rng)]
        yield torch.tensordot(seen_by, leaves(spectra, visible, shape=(size, size), rng=rng), 1)


def test_of_measured_colours_no_other_correlation_of_channels_tells_more_of_a_hidden_one(
    monkeypatch,
):
    errors, tried = {}, [0.0, 0.3, 0.6, 0.8, 0.99]
    for grey in ["as shipped", *tried]:
        if grey in tried:
            monkeypatch.setattr(_wiener, "GREY", grey)
        apart = []
        for n, picture in enumerate(photographs(6)):
            hidden = torch.zeros(picture.shape, dtype=torch.bool)
            hidden[n % 3, 4:12, 4:12] = True
            truth = 5000 * picture
            raw = torch.cat(
                [seen(channel[None], disc(0), seed=n + 10 * c) for c, channel in enumerate(truth)]
            )
            apart.append((run(raw, disc(0), hidden) - truth)[hidden].square().mean())
        errors[grey] = float(torch.stack(apart).mean().sqrt())
    assert errors["as shipped"] < 1.02 * min(errors.values())


@settings(max_examples=60, deadline=None)
@given(
    st.integers(1, 9),
    st.integers(1, 9),
    st.integers(1, 12),
    st.sampled_from([0.0, -3.0, 1e-40, 1.0, 1e12]),
    st.sampled_from([0.0, 0.5, 1.0]),
    st.sampled_from([0.0, 10.5]),
)
def test_finite_at_every_extreme(y, x, size, value, share, read):
    electrons = torch.full((2, y, x), value)
    clipped = torch.rand(2, y, x, generator=torch.Generator().manual_seed(1)) < share
    for kernel in (torch.rand(1, size, size), torch.zeros(1, size, size)):
        found = run(
            electrons, Psf(kernel, ONE), clipped, [torch.ones(2, y + 1, x + 2)], read_noise=read
        )
        assert found.shape == electrons.shape
        assert torch.isfinite(found).all()


def test_gradient_reaches_picture_and_psf():
    electrons = seen(scene(12), disc(1, 5)).double().requires_grad_()
    kernel = disc(1, 5).intensity.double().requires_grad_()
    run(electrons, Psf(kernel, ONE)).square().mean().backward()
    assert torch.isfinite(electrons.grad).all()
    assert bool(kernel.grad.any())


@pytest.mark.parametrize("size", [12, 44, 96])
def test_value_and_gradients_in_single_precision_are_those_of_double(size):
    """Of bright pictures, whose signal is far above the noise, with clipped pixels and glare."""
    kernel, crossing = disc(2, 9).intensity, crossed(size)
    bright = 1e3 * scene(192)[:, :size, :size] + 4e6 * crop(crossing, shape=(size, size))
    clipped = bright > bright.quantile(0.7)
    values = []
    for dtype in (torch.float32, torch.float64):
        leaves = [
            x.to(dtype).requires_grad_() for x in (bright.clone(), kernel.clone(), crossing.clone())
        ]
        found = run(leaves[0], Psf(leaves[1], ONE), clipped, [leaves[2]])
        weights = torch.rand(found.shape, generator=torch.Generator().manual_seed(5)).to(found)
        values.append([found.detach(), *torch.autograd.grad((weights * found).sum(), leaves)])
    assert values[0][0].dtype == torch.float32
    for single, double in zip(*values, strict=True):
        assert float((single - double).abs().max()) <= 3e-7 * float(double.abs().max())


def test_shapes_must_agree():
    with pytest.raises(ValueError, match="same channels and pixels"):
        run(torch.ones(1, 4, 4), disc(1, 3), torch.zeros(1, 4, 5, dtype=torch.bool))


def crossed(size=96):
    """Glare of a laser: a cross of stripes, wider than the picture."""
    y = torch.arange(2 * size) - size
    wave = torch.cos(y / 3.0).square()
    return (
        wave[:, None] * torch.exp(-((y[None] / 20.0) ** 2))
        + wave * torch.exp(-((y[:, None] / 20.0) ** 2))
    )[None]


@pytest.mark.parametrize("unit", [1.0, 1e-6, 1e6])
def test_a_known_laser_is_taken_out_whatever_its_strength(unit):
    truth, psf = scene(), disc(4)
    bright = seen(truth, psf) + 4000 * crossed()[:, 48:-48, 48:-48]
    alone, taken = run(seen(truth, psf), psf), run(bright, psf, glare=[unit * crossed()])
    assert error(run(bright, psf), truth) > 2 * error(alone, truth)
    assert error(taken, truth) < 1.05 * error(alone, truth)


def test_a_laser_that_is_not_there_or_not_seen_changes_little():
    truth, psf = scene(), disc(4)
    alone = run(seen(truth, psf), psf)
    assert torch.equal(run(seen(truth, psf), psf, glare=[0 * crossed()]), alone)
    assert error(run(seen(truth, psf), psf, glare=[crossed(), crossed()]), alone) < 0.1 * error(
        alone, truth
    )


def test_what_lies_beyond_the_edge_is_unknown_not_mirrored():
    """Half of the light of the rim comes from outside, and the picture is better than before
    even there.
    """
    wide, psf = scene(192), disc(16, 65)
    truth, blurred = (x[:, 48:-48, 48:-48] for x in (wide, seen(wide, psf)))
    found = run(blurred, psf)
    assert error(found, truth) < 0.75 * error(blurred, truth)
    rim = torch.ones_like(truth, dtype=torch.bool)
    rim[:, 12:-12, 12:-12] = False
    assert error(found[rim], truth[rim]) < 0.8 * error(blurred[rim], truth[rim])


def test_a_point_for_a_psf_and_no_noise_change_nothing():
    truth = scene()
    torch.testing.assert_close(run(truth, disc(0), balance=1e-7), truth, rtol=1e-3, atol=1.0)


def test_check_says_what_was_not_seen():
    electrons, clipped = torch.full((1, 4, 4), 8.0), torch.zeros(1, 4, 4, dtype=torch.bool)
    clipped[0, 0, 0] = True
    (line,) = wiener.hooks.check(electrons, electrons, None, None, None, None, clipped)
    assert line.text == f"{1 / 16:.2%} of pixels clipped, restored mean 1.00 of raw mean"
    assert not wiener.hooks.check(electrons * math.nan, electrons, None, None, None, None, clipped)[
        0
    ].ok


def test_the_first_guess_of_the_glare_is_least_squares_beside_a_constant():
    """Of more rows than are looked at together, in float64 at once."""
    rng = torch.Generator().manual_seed(0)
    electrons, one, two = torch.rand(3, 2, 150, 20, generator=rng)
    known = (torch.rand(2, 150, 20, generator=rng) > 0.2).float()
    fit_one, fit_two = strengths(electrons, known, [one, two])
    found = fit_one * one + fit_two * two
    seen = known.double()
    centred = [
        p - (seen * p).sum((1, 2), keepdim=True) / seen.sum((1, 2), keepdim=True)
        for p in (one, two)
    ]
    design = torch.stack([(seen * c).flatten() for c in centred], 1)
    fit = torch.linalg.solve(design.T @ design, design.T @ electrons.double().flatten())
    torch.testing.assert_close(found, (fit[0] * one + fit[1] * two).float(), rtol=1e-5, atol=1e-6)


def test_a_narrow_psf_needs_no_coarser_grids():
    """Dim light behind a grey filter: read noise of 10.5 e- and a fall of the PSF as wide as the
    window.
    """
    at = torch.arange(-32, 33).double()
    kernel = (1 + (at[:, None].square() + at.square()) / 1.5**2).pow(-1.5)
    psf = Psf((kernel / kernel.sum()).float()[None], ONE)
    electrons = seen(scene() / 400, psf)
    nested, alone = (run(electrons, psf, coarser_grids=coarser) for coarser in (True, False))
    exact = run(electrons[..., : _masked_blur.DENSE, : _masked_blur.DENSE], psf)
    assert error(alone, nested) < 0.01 * float(nested.std())
    assert error(alone, nested) > 0  # another start of the iteration
    # solved without an iteration
    assert run(
        electrons[..., : _masked_blur.DENSE, : _masked_blur.DENSE], psf, coarser_grids=False
    ).equal(exact)
