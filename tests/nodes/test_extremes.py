"""What once failed at the extremes: each case with its closed form, or against float64."""

import math

import pytest
import torch

from neusee.nodes import doe, flare, losses, metrics, optics, restore, sensor, spectra
from neusee.nodes.optics.transform import Grids, transform
from neusee.nodes.precision import refuse_half, refuse_not_finite, single
from neusee.nodes.values import Bands, Psf, Pupil


def psf_of(intensity, clear_peak=0.1):
    return Psf(intensity, torch.full((len(intensity),), clear_peak, dtype=torch.float64))


def slope_of(loss, x):
    x = x.clone().requires_grad_()
    return torch.autograd.grad(loss(x), x)[0]


# --- losses at zero -------------------------------------------------------------------------------


@pytest.mark.parametrize("log", [False, True])
@pytest.mark.parametrize("scale", [0.0, 1e-40, 1e-32])
def test_an_opaque_mask_has_a_finite_loss_and_no_slope(log, scale):
    dark = torch.full((2, 5, 5), scale)
    loss = float(losses.suppression_loss(psf_of(dark), log=log))
    assert loss == pytest.approx(2 * math.log(1e-30) if log else 0.0, abs=1e-5 * abs(loss) + 1e-29)
    assert (
        float(slope_of(lambda x: losses.suppression_loss(psf_of(x), log=log), dark).abs().max())
        == 0
    )


def test_the_log_of_the_lsr_is_the_same_in_both_precisions_when_one_band_is_dark():
    psf = torch.rand(2, 5, 5, generator=torch.Generator().manual_seed(1))
    psf[0] = 0
    single_, double = (
        float(losses.suppression_loss(psf_of(x), log=True)) for x in (psf, psf.double())
    )
    assert single_ == pytest.approx(double, rel=1e-6)


def test_the_reference_of_the_lsr_has_a_slope_where_some_pixels_are_black():
    psf = torch.rand(1, 5, 5, generator=torch.Generator().manual_seed(1), dtype=torch.float64)
    psf[0, :2] = 0
    usual, truth = (
        slope_of(lambda x, f=f: f(psf_of(x)), psf)
        for f in (losses.suppression_loss, losses.suppression_loss.hooks.reference)
    )
    torch.testing.assert_close(usual, truth)


def test_a_penalty_at_zero_slope_is_one_and_pulls_nowhere():
    still = torch.zeros(3, 2, 4, 4)
    assert float(losses.gradient_penalty(still)) == 1.0
    assert float(slope_of(losses.gradient_penalty, still).abs().max()) == 0.0


@pytest.mark.parametrize("size", [1e-30, 1e-12, 1.0, 1e12])
def test_the_penalty_and_its_slope_follow_the_closed_form(size):
    slopes = torch.randn(3, 8, generator=torch.Generator().manual_seed(1)) * size
    norm = slopes.double().norm(dim=1, keepdim=True)
    expected = 2 * (norm - 1) / 3 * slopes.double() / norm
    assert float(losses.gradient_penalty(slopes)) == pytest.approx(
        float((norm - 1).square().mean()), rel=1e-5
    )
    torch.testing.assert_close(
        slope_of(losses.gradient_penalty, slopes).double(), expected, rtol=1e-5, atol=1e-7
    )


def test_the_penalty_can_be_differentiated_twice_as_training_needs():
    slopes = torch.randn(
        2, 3, generator=torch.Generator().manual_seed(1), dtype=torch.float64
    ).requires_grad_()
    assert torch.autograd.gradcheck(losses.gradient_penalty, slopes)
    assert torch.autograd.gradgradcheck(losses.gradient_penalty, slopes)


@pytest.mark.parametrize("loss", [losses.charbonnier, losses.fft_l1])
def test_equal_pictures_have_a_loss_near_zero_and_no_slope(loss):
    picture = torch.rand(3, 6, 7, generator=torch.Generator().manual_seed(1))
    assert 0 <= float(loss(picture, picture)) <= 1.001e-3
    assert float(slope_of(lambda x: loss(x, picture), picture).abs().max()) == 0


def test_spectra_of_smooth_differences_have_the_slope_of_float64():
    """Nearly all of their coefficients are 0, and of 0 in single precision only the rounding is
    left.
    """
    ramp = torch.linspace(0, 1e4, 32).expand(3, 32, 32)
    truth = torch.rand(3, 32, 32, generator=torch.Generator().manual_seed(1))
    usual, exact = (
        slope_of(lambda x: losses.fft_l1(x, truth.to(x)), x) for x in (ramp, ramp.double())
    )
    torch.testing.assert_close(usual.double(), exact, rtol=0, atol=1e-6 * float(exact.abs().max()))


# --- pictures without light -----------------------------------------------------------------------


@pytest.mark.parametrize("scale", [0.0, 1e-40])
def test_no_light_has_no_contrast_and_its_slope_is_zero(scale):
    dark = torch.full((2, 9, 8), scale)
    assert all(float(x.abs().max()) == 0 for x in metrics.mtf(psf_of(dark)))
    assert float(slope_of(lambda x: metrics.mtf(psf_of(x)).rms.sum(), dark).abs().max()) == 0


def test_the_median_contrast_of_a_symmetric_psf_has_no_slope_by_chance():
    """Equal frequencies are sorted by their rounding."""
    line = torch.exp(-torch.linspace(-2, 2, 9).square())
    found = metrics.mtf(psf_of((line[:, None] * line)[None].requires_grad_()))
    assert found.rms.requires_grad
    assert not found.median.requires_grad
    assert not found.low.requires_grad


# --- precision ------------------------------------------------------------------------------------


@pytest.mark.parametrize("half", [torch.float16, torch.bfloat16])
def test_half_precision_is_computed_in_single(half):
    psf = psf_of(torch.rand(2, 16, 16, generator=torch.Generator().manual_seed(1)).to(half))
    wide = Psf(psf.intensity.float(), psf.clear_peak)
    one, two = (
        torch.rand(3, 16, 16, generator=torch.Generator().manual_seed(s)).to(half) for s in (1, 2)
    )
    for loss in (losses.charbonnier, losses.fft_l1):
        assert loss(one, two).dtype == torch.float32
        assert float(loss(one, two)) == pytest.approx(
            float(loss(one.float(), two.float())), rel=1e-6
        )
    found = losses.background_loss(psf, one[:2])
    assert found.dtype == torch.float32
    assert float(found) == pytest.approx(
        float(losses.background_loss(wide, one[:2].float())), rel=1e-6
    )
    assert float(losses.suppression_loss(psf)) == pytest.approx(
        float(losses.suppression_loss(wide)), rel=1e-6
    )
    torch.testing.assert_close(metrics.mtf(psf).rms, metrics.mtf(wide).rms)


def test_what_half_precision_cannot_hold_is_refused_and_the_rest_widened():
    half = torch.ones(2, dtype=torch.float16)
    assert single(half).dtype == torch.float32
    assert single(half.double()).dtype == torch.float64
    with pytest.raises(ValueError, match=r"height is float16.*float32"):
        refuse_half(path=half.float(), height=half)
    with pytest.raises(ValueError, match="height holds values that are not finite: no light"):
        refuse_not_finite("no light", path=half, height=half / 0)


# --- numbers that are none ------------------------------------------------------------------------


def test_a_ratio_of_what_is_no_number_is_none():
    picture = torch.rand(2, 5, 5, generator=torch.Generator().manual_seed(1))
    broken = picture.clone()
    broken[0, 2, 2] = math.nan
    for kernel, scene in ((broken, picture), (picture, broken), (broken, None)):
        assert math.isnan(float(losses.background_loss(psf_of(kernel), scene)))
    assert math.isnan(float(losses.suppression_loss(psf_of(broken))))
    assert math.isnan(float(losses.gradient_penalty(broken)))


def bands_of(count):
    centres = torch.linspace(450e-9, 650e-9, count, dtype=torch.float64)
    return Bands(centres, torch.full_like(centres, 10e-9), torch.ones_like(centres))


def pupil_of(height, path=None):
    flat = torch.ones_like(height)
    wavelengths = torch.tensor([550e-9], dtype=torch.float64)
    path = torch.zeros_like(height) if path is None else path
    return Pupil(
        flat,
        flat,
        height,
        path,
        torch.tensor([0.46], dtype=torch.float64),
        wavelengths,
        torch.tensor(1e-4),
    )


LENS = {"focal_length": 0.11, "pixel_pitch": 2.9e-6, "shape": (9, 9)}
SENSOR = {"full_well": 25500.0, "quantum_efficiency": 0.56, "pixel_pitch": 2.9e-6, "exposure": 0.1}


@pytest.mark.parametrize("part", ["height", "path"])
@pytest.mark.parametrize("wrong", [math.nan, math.inf])
def test_a_phase_that_is_no_number_is_refused(part, wrong):
    """A path that was not a number was taken for no path at all, and the picture was that of a
    clean lens.
    """
    screen = torch.zeros(16, 16)
    screen[3, 4] = wrong
    pupil = pupil_of(torch.zeros(16, 16))._replace(**{part: screen})
    with pytest.raises(ValueError, match=f"{part} holds values that are not finite"):
        optics.psf(pupil, **LENS)


@pytest.mark.parametrize("part", ["height", "path"])
def test_a_phase_without_digits_is_refused(part):
    """At 1e15 m neighbouring float64 numbers are 1e5 turns apart, and the PSF was that of a
    random phase.
    """
    pupil = pupil_of(torch.zeros(16, 16))._replace(**{part: torch.full((16, 16), 1e15)})
    with pytest.raises(
        ValueError, match=r"turns of phase, more than 1e\+09.*give heights and paths in metres"
    ):
        optics.psf(pupil, **LENS)


def test_the_light_of_what_is_no_number_is_not_left_out():
    bands, responses = bands_of(2), torch.ones(3, 2, dtype=torch.float64)
    image = torch.rand(2, 5, 5, generator=torch.Generator().manual_seed(1))
    image[0, 2, 2] = math.nan
    for rule in ("channel_sum", "per_band"):
        with pytest.raises(ValueError, match="plain_image holds values that are not finite"):
            sensor.level(image, bands, responses, strength=0.7, rule=rule, **SENSOR)
    assert math.isnan(float(metrics.bsr(psf_of(torch.rand(2, 3, 3)), image)[0]))
    raw = torch.zeros(3, 5, 5)
    raw[0, 2, 2] = math.nan
    well = {"full_well": 25500.0, "gain": 1 / 0.37}
    assert int(restore.clipped(raw, **well).sum()) == 1
    assert float(metrics.saturated(raw, **well).pixels) == 1


# --- sensor, in the dark and in half precision ----------------------------------------------------


@pytest.mark.parametrize("photons", [0.0, 1e-40])
def test_the_noise_of_the_dark_has_no_slope_without_end(photons):
    dark = torch.full((4, 4), photons)

    def noise(x):
        rng = torch.Generator().manual_seed(1)
        return sensor.photon_noise(x, quantum_efficiency=0.56, rng=rng).sum()

    assert float(noise(dark)) <= 1e-38
    assert float(slope_of(noise, dark).abs().max()) <= 1.0


def test_half_precision_does_not_end_the_light_at_65504():
    half = torch.full((3, 4, 4), 60000.0, dtype=torch.float16)
    assert float(sensor.add_photons(half, [half]).max()) == 120000
    assert float(sensor.full_well(half, capacity=255000.0).max()) == 60000
    assert float(sensor.digitize(half, gain=2.0).max()) == 65535
    assert float(restore.electrons(half, gain=0.1, offset=0.0).max()) == 600000
    reference = sensor.digitize.hooks.reference(half, gain=1 / 0.37)
    torch.testing.assert_close(sensor.digitize(half, gain=1 / 0.37), reference, rtol=0, atol=0)


# --- reliefs --------------------------------------------------------------------------------------


@pytest.mark.parametrize("levels", [None, 2])
def test_a_deep_relief_wraps_as_in_float64(levels):
    """The period in float32 is off by up to 6e-8 of itself, 83 times over in 100 um."""
    height = 100e-6 * torch.rand(64, 64, generator=torch.Generator().manual_seed(1))
    how = {"material": "fused silica", "wrap_at": 550e-9, "levels": levels, "max_height": None}
    made, exact = doe.fabricate(height, **how), doe.fabricate.hooks.reference(height, **how)
    wave = doe.wave_height("fused silica", 550e-9)
    assert float((made.double() - exact).abs().max()) <= 1e-7 * wave


@pytest.mark.parametrize("half", [torch.float16, torch.bfloat16])
def test_a_relief_in_half_precision_is_refused(half):
    height = torch.full((16, 16), 1e-6).to(half)
    bands = bands_of(1)
    with pytest.raises(ValueError, match="too coarse for a phase"):
        optics.pupil(
            height,
            torch.tensor([0.46]),
            bands,
            optics.stop(samples=16, pitch=1e-4, diameter=1.6e-3),
        )
    with pytest.raises(ValueError, match="too coarse for a phase"):
        optics.psf(pupil_of(height), **LENS)
    with pytest.raises(ValueError, match="too coarse for a phase"):
        doe.fabricate(height, wrap_at=550e-9)


# --- the image ------------------------------------------------------------------------------------


@pytest.mark.parametrize("border", ["zero", "reflect"])
def test_a_lamp_a_million_times_as_bright_does_not_drown_the_dark(border):
    rng = torch.Generator().manual_seed(1)
    scene = 1e-6 * torch.rand(2, 48, 40, generator=rng)
    scene[0, 20, 20] = 1.0  # the other band has no lamp
    kernel = torch.rand(2, 7, 7, generator=rng).pow(8)
    psf = psf_of(kernel / kernel.sum((-2, -1), keepdim=True))
    found, exact = (
        optics.image(scene, psf, border=border),
        optics.image.hooks.reference(scene, psf, border=border),
    )
    dim = exact < 1e-5
    assert bool(dim[0].any())
    assert float((found - exact)[dim].abs().max()) <= 1e-5 * float(exact[dim].max())
    alone = optics.image(scene[1:], Psf(psf.intensity[1:], psf.clear_peak[1:]), border=border)
    assert torch.equal(found[1:], alone), "a band is the same whatever stands beside it"


def test_a_picture_of_usual_contrast_is_transformed_in_single():
    scene = torch.rand(1, 32, 32, generator=torch.Generator().manual_seed(1), requires_grad=True)
    psf = psf_of(torch.full((1, 3, 3), 1 / 9))
    assert optics.image(scene, psf).dtype == torch.float32
    optics.image(scene, psf).sum().backward()
    assert bool(scene.grad.isfinite().all())


@pytest.mark.parametrize("half", [torch.float16, torch.bfloat16])
def test_an_image_in_half_precision_is_formed_in_single(half):
    scene = torch.rand(1, 8, 8, generator=torch.Generator().manual_seed(1)).to(half)
    psf = psf_of(torch.full((1, 3, 3), 1 / 9))
    torch.testing.assert_close(optics.image(scene, psf), optics.image(scene.float(), psf))


@pytest.mark.parametrize("lift", [spectra.lift_mallett, spectra.lift_lmmse])
def test_black_has_the_slope_of_the_reference(lift):
    black = torch.zeros(3, 4, 4, dtype=torch.float64)
    usual, truth = (
        slope_of(lambda x, f=f: f(x, bands_of(5)).sum(), black)
        for f in (lift, lift.hooks.reference)
    )
    torch.testing.assert_close(usual, truth)


# --- the scaled transform -------------------------------------------------------------------------


@pytest.mark.parametrize("method", ["folded", "bluestein", "kaiser_bessel"])
@pytest.mark.parametrize(
    ("shape", "window", "alpha", "off"),
    [
        ((1, 1), (1, 1), 1e-3, 0.0),
        ((1, 16), (7, 1), 5e-3, 0.0),
        ((61, 59), (31, 29), 1.5e-2, 0.0),
        ((64, 64), (64, 64), 7.8e-3, 0.0),  # the whole field that is free of aliases
        ((64, 64), (16, 16), 1e-7, 0.0),  # a pixel so small that all of it is one value
        ((48, 48), (24, 24), 5e-3, 4e4),  # 200 turns from sample to sample of the tilt
    ],
)
def test_every_method_agrees_with_the_plain_sum_at_the_extremes(method, shape, window, alpha, off):
    rng = torch.Generator().manual_seed(1)
    field = torch.complex(*(torch.randn(2, *shape, generator=rng, dtype=torch.float64).unbind(0)))
    grids = Grids(alpha=(alpha, alpha), centre_in=(0.0, 0.0), centre_out=(off, -off))
    exact = transform(field, window, grids, "direct")
    top = float(exact.abs().max())
    for dtype, bound in ((torch.complex128, 1e-11), (torch.complex64, 3e-6)):
        found = transform(field.to(dtype), window, grids, method)
        assert float((found - exact).abs().max()) <= bound * top


# --- restoration ----------------------------------------------------------------------------------


@pytest.fixture
def blurred():
    rng = torch.Generator().manual_seed(1)
    kernel = torch.rand(3, 5, 5, generator=rng)
    psf = psf_of(kernel / kernel.sum((-2, -1), keepdim=True))
    electrons = 1000 * torch.rand(3, 12, 12, generator=rng)
    clipped = electrons > 900
    return [electrons, psf, torch.ones(3), torch.rand(3, 3, generator=rng), bands_of(3), clipped]


def test_restoration_has_a_slope_beside_clipped_pixels(blurred):
    def restored(x):
        return restore.wiener(x, *blurred[1:], read_noise=10.5).square().mean()

    usual = slope_of(restored, blurred[0])
    assert bool(blurred[5].any())
    assert bool(usual.isfinite().all())
    step = 1e-4 * torch.randn(
        3, 12, 12, generator=torch.Generator().manual_seed(2), dtype=torch.float64
    )
    double = [x.double() if torch.is_tensor(x) and x.is_floating_point() else x for x in blurred]
    double[1] = Psf(double[1].intensity.double(), double[1].clear_peak)

    def wide(x):
        return float(restore.wiener(x, *double[1:], read_noise=10.5).square().mean())

    moved = (wide(double[0] + step) - wide(double[0] - step)) / 2
    assert float((usual.double() * step).sum()) == pytest.approx(moved, rel=1e-3)


def test_a_channel_that_sees_none_of_the_bands_leaves_the_others_restored(blurred):
    blurred[3][2] = 0
    found = restore.wiener(*blurred, read_noise=10.5)
    assert bool(found.isfinite().all())


@pytest.mark.parametrize("wrong", [math.nan, math.inf])
def test_restoration_refuses_what_is_not_finite(wrong, blurred):
    broken = blurred[0].clone()
    broken[1, 3, 3] = wrong
    with pytest.raises(ValueError, match="electrons holds values that are not finite"):
        restore.wiener(broken, *blurred[1:], read_noise=10.5)
    with pytest.raises(ValueError, match="glare holds values that are not finite"):
        restore.wiener(*blurred, [broken], read_noise=10.5)


def test_the_slope_of_a_psf_without_light_is_finite(blurred):
    dark = torch.full((3, 5, 5), 1e-40)
    slope = slope_of(
        lambda k: restore.wiener(blurred[0], psf_of(k), *blurred[2:], read_noise=10.5).sum(), dark
    )
    assert bool(slope.isfinite().all())


# --- ghosts ---------------------------------------------------------------------------------------


def test_ghosts_of_no_light_have_a_finite_slope_and_those_of_no_number_are_none():
    def ghosts(x):
        rng = torch.Generator().manual_seed(1)
        towards = torch.zeros(2, dtype=torch.float64)
        return flare.ghosts(x, bands_of(2), towards, focal_length=0.11, pixel_pitch=2.9e-6, rng=rng)

    dark = torch.zeros(2, 32, 32)
    assert float(ghosts(dark).abs().max()) == 0
    assert bool(slope_of(lambda x: ghosts(x).sum(), dark).isfinite().all())
    dark[0, 3, 3] = math.nan
    assert bool(ghosts(dark).isnan().any())
    assert ghosts(torch.ones(2, 32, 32, dtype=torch.float16)).dtype == torch.float32
