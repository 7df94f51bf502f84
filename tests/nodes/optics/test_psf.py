import math
import shutil
import subprocess
import sys

import pytest
import torch
from hypothesis import given, settings
from hypothesis import strategies as st

from neusee.nodes.optics import psf
from neusee.nodes.optics._psf import _Camera, _focus
from neusee.nodes.optics.transform import Axis, PupilIntensity, Sampling, View, _intensity
from neusee.nodes.values import Pupil

DIAMETER, FOCAL, PIXEL, GREEN = 2160 * 3.74e-6, 0.11, 2.9e-6, 550e-9
SENSOR = dict(focal_length=FOCAL, pixel_pitch=PIXEL)


@pytest.fixture(autouse=True)
def _one_thread():
    """Small problems: threads that wait for each other would cost more than the work."""
    before = torch.get_num_threads()
    torch.set_num_threads(1)
    yield
    torch.set_num_threads(before)


def make(n=128, wavelengths=(GREEN,), height=None, path=None, diameter=DIAMETER, shape=None):
    """Inscribed disc of ``n`` samples; height and path are functions of (v, u) in units of the
    pupil's radius.
    """
    rows, columns = shape or (n, n)
    v, u = ((torch.arange(k, dtype=torch.float64) - (k - 1) / 2) / (n / 2) for k in (rows, columns))
    v, u = torch.meshgrid(v, u, indexing="ij")
    aperture = (v.square() + u.square() <= 1).double()
    parts = [torch.zeros_like(v) if part is None else part(v, u) for part in (height, path)]
    bands = torch.tensor(wavelengths, dtype=torch.float64)
    return Pupil(
        aperture,
        aperture,
        *parts,
        0.46 * torch.ones_like(bands),
        bands,
        torch.tensor(diameter / n, dtype=torch.float64),
    )


def airy(radius, wavelength, diameter):
    """(2 J1(x) / x)^2 at ``radius`` in metres."""
    x = (math.pi * diameter / (wavelength * FOCAL) * radius).clamp(min=1e-9)
    return (2 * torch.special.bessel_j1(x) / x).square()


def radii(n, pixel=PIXEL):
    x = (torch.arange(n, dtype=torch.float64) - n // 2) * pixel
    return torch.hypot(x[:, None], x)


def test_peak_of_the_clear_pupil_is_the_closed_form():
    result = psf(make(2160), shape=(9, 9), **SENSOR)
    expected = math.pi * DIAMETER**2 * PIXEL**2 / (4 * GREEN**2 * FOCAL**2)
    assert expected == pytest.approx(0.11777, abs=5e-6)
    assert float(result.intensity[0, 4, 4]) == pytest.approx(expected, rel=1e-4)
    assert float(result.clear_peak[0]) == pytest.approx(expected, rel=1e-4)


@pytest.mark.parametrize("wavelength", [400e-9, 550e-9, 700e-9])
def test_clear_pupil_is_the_airy_pattern(wavelength):
    pupil = make(720, (wavelength,))
    result = psf(pupil, shape=(65, 65), **SENSOR)
    area = float(pupil.aperture.sum()) * float(pupil.pitch) ** 2
    pattern = airy(radii(65), wavelength, math.sqrt(4 * area / math.pi))
    assert float((result.intensity[0] / result.clear_peak[0] - pattern).abs().max()) < 2e-5


def test_first_dark_ring_stands_at_1_22_lambda_f_over_d():
    fine = (
        psf(make(720), focal_length=FOCAL, pixel_pitch=0.02e-6, shape=(1, 1201))
        .intensity[0, 0]
        .double()
    )
    dark = (int(fine[600 + 300 :].argmin()) + 300) * 0.02e-6
    assert dark == pytest.approx(1.2197 * GREEN * FOCAL / DIAMETER, rel=2e-3)


def rough(v, u):
    return 1e-6 * torch.rand(
        v.shape, dtype=torch.float64, generator=torch.Generator().manual_seed(3)
    )


@pytest.mark.parametrize("precision", ["single", "double"])
def test_all_light_lands_in_one_alias_free_window(precision):
    """Parseval: with pitch pixel / (lambda f) = 1 / 256, 256 pixels are exactly one period."""
    pupil = make(96, height=rough, diameter=96 * GREEN * FOCAL / (256 * PIXEL))
    result = psf(pupil, shape=(256, 256), precision=precision, **SENSOR)
    tolerance = 1e-6 if precision == "single" else 1e-12
    assert float(result.intensity.sum(dtype=torch.float64)) == pytest.approx(1.0, abs=tolerance)
    dimmed = pupil._replace(amplitude=0.5 * pupil.amplitude)
    result = psf(dimmed, shape=(256, 256), precision=precision, **SENSOR)
    assert float(result.intensity.sum(dtype=torch.float64)) == pytest.approx(0.25, abs=tolerance)


def centroid(image):
    y, x = (torch.arange(n, dtype=torch.float64) - n // 2 for n in image.shape)
    return float((image.sum(1) * y).sum() / image.sum()), float(
        (image.sum(0) * x).sum() / image.sum()
    )


def test_a_tilt_towards_plus_y_moves_the_spot_to_plus_y():
    slope = 10.0 * PIXEL / FOCAL * DIAMETER / 2
    y, x = centroid(
        psf(make(256, path=lambda v, u: slope * v), shape=(65, 65), **SENSOR).intensity[0].double()
    )
    assert (y, x) == pytest.approx((10, 0), abs=0.1)
    y, x = centroid(
        psf(make(256, path=lambda v, u: slope * u), shape=(65, 65), **SENSOR).intensity[0].double()
    )
    assert (y, x) == pytest.approx((0, 10), abs=0.1)


def test_an_angle_is_a_shift_by_f_n_to_a_fraction_of_a_pixel():
    pupil = make(128, height=rough, diameter=128 * 20e-6)
    plain = psf(pupil, shape=(31, 31), **SENSOR).intensity
    moved = psf(
        pupil, shape=(31, 31), angle=(3 * PIXEL / FOCAL, -5 * PIXEL / FOCAL), **SENSOR
    ).intensity
    torch.testing.assert_close(
        moved[:, 3:, :-5], plain[:, :-3, 5:], rtol=0, atol=1e-6 * float(plain.max())
    )
    tilted = pupil._replace(
        path=make(128, path=lambda v, u: 0.3 * PIXEL / FOCAL * 64 * 20e-6 * v).path
    )
    part = psf(pupil, shape=(31, 31), angle=(0.3 * PIXEL / FOCAL, 0.0), **SENSOR).intensity
    other = psf(tilted, shape=(31, 31), **SENSOR).intensity
    torch.testing.assert_close(part, other, rtol=0, atol=1e-6 * float(plain.max()))


@pytest.mark.parametrize("waves", [0.25, 0.5, 1.0, 1.5, 2.0])
def test_defocus_dims_the_axis_by_sinc_squared(waves):
    result = psf(
        make(1080, path=lambda v, u: waves * GREEN * (v**2 + u**2)), shape=(1, 1), **SENSOR
    )
    ratio = float(result.intensity[0, 0, 0] / result.clear_peak[0])
    assert ratio == pytest.approx(float(torch.sinc(torch.tensor(waves)) ** 2), abs=3e-4)


def test_a_small_aberration_dims_the_axis_by_exp_of_minus_its_variance():
    astigmatism = 0.05 * GREEN * math.sqrt(6)
    result = psf(make(512, path=lambda v, u: astigmatism * (u**2 - v**2)), shape=(1, 1), **SENSOR)
    ratio = float(result.intensity[0, 0, 0] / result.clear_peak[0])
    assert ratio == pytest.approx(math.exp(-((2 * math.pi * 0.05) ** 2)), rel=2e-3)


def test_pillars_wear_the_sinc_envelope_of_their_square():
    """Drawn as 8 x 8 finer samples, what midpoints miss falls to 1/64; with the envelope nothing
    is missed.
    """
    pupil = make(48, height=rough, diameter=48 * 80e-6)
    fine = Pupil(
        *(p.repeat_interleave(8, 0).repeat_interleave(8, 1) for p in pupil[:4]),
        *pupil[4:6],
        pupil.pitch / 8,
    )
    truth = psf(fine, shape=(200, 200), precision="double", **SENSOR).intensity
    held = psf(pupil, shape=(200, 200), pixel="zoh", precision="double", **SENSOR).intensity
    plain = psf(pupil, shape=(200, 200), precision="double", **SENSOR).intensity
    assert float((held - truth).abs().max()) < 1.1 / 64 * float((plain - truth).abs().max())
    assert float(held[0, 100, 100]) == pytest.approx(float(plain[0, 100, 100]))


@pytest.mark.parametrize("wavelength", [400e-9, 700e-9])
def test_integrated_pixels_are_the_mean_over_their_square(wavelength):
    pupil = make(128, (wavelength,))
    result = psf(pupil, shape=(15, 15), sensor="integrated", precision="double", **SENSOR)
    fine = psf(
        pupil, focal_length=FOCAL, pixel_pitch=PIXEL / 25, shape=(375, 375), precision="double"
    ).intensity[0]
    fine = torch.roll(fine, (0, 0), (0, 1)) * 625
    mean = torch.nn.functional.avg_pool2d(fine[None], 25)[0]
    # 25 midpoints a side: their own error is (1/25)^2 / 24 of the curvature
    torch.testing.assert_close(result.intensity[0], mean, rtol=0, atol=1.5e-3 * float(mean.max()))
    assert float(result.intensity[0, 7, 7]) == pytest.approx(float(result.clear_peak[0]), rel=1e-12)
    assert float(result.clear_peak[0]) < 0.97 * float(
        psf(pupil, shape=(1, 1), **SENSOR).clear_peak[0]
    )


CASES = [
    {},
    {"pixel": "zoh"},
    {"angle": (1e-4, -3e-5)},
    {"sensor": "integrated"},
    {"pixel": "zoh", "sensor": "integrated", "angle": (2e-5, 1e-5)},
]


@pytest.mark.parametrize("params", CASES)
@pytest.mark.parametrize("shape", [(1, 1), (32, 33), (7, 128)])
def test_the_node_agrees_with_its_reference(shape, params):
    pupil = make(
        60,
        (420e-9, 650e-9),
        height=rough,
        path=lambda v, u: 3e-6 * (v**2 + u**3),
        diameter=60 * 40e-6,
    )
    pupil = Pupil(*(p.float() for p in pupil[:4]), *pupil[4:])
    truth = psf.hooks.reference(pupil, shape=shape, **SENSOR, **params)
    result = psf(pupil, shape=shape, **SENSOR, **params)
    double = psf(pupil, shape=shape, precision="double", **SENSOR, **params)
    assert result.intensity.dtype == torch.float32
    assert (
        double.intensity.dtype == truth.intensity.dtype == result.clear_peak.dtype == torch.float64
    )
    peak = float(psf.hooks.reference(pupil, shape=(65, 65), **SENSOR).intensity.max())
    assert float((result.intensity - truth.intensity).abs().max()) < psf.rtol * peak
    assert float((double.intensity - truth.intensity).abs().max()) < 1e-12 * peak
    torch.testing.assert_close(result.clear_peak, truth.clear_peak, rtol=1e-10, atol=0)
    direct = _focus(pupil, _Camera(**SENSOR, shape=shape, **params), torch.float64, "direct")
    assert float((double.intensity - direct.intensity).abs().max()) < 1e-12 * peak
    torch.testing.assert_close(result.clear_peak, direct.clear_peak, rtol=1e-10, atol=0)


def test_the_same_call_gives_the_same_bits():
    pupil = make(300, (420e-9, 650e-9), height=rough, diameter=300 * 10e-6)
    first, second = (psf(pupil, shape=(257, 256), **SENSOR).intensity for _ in range(2))
    assert torch.equal(first, second)


@settings(max_examples=25, deadline=None)
@given(rows=st.integers(1, 40), columns=st.integers(1, 40), y=st.integers(1, 30), x=st.integers(1, 30),
       scale=st.sampled_from([0.0, 1e-42, 1e-6, 1e-3]))  # fmt: skip
def test_any_shape_and_any_height_is_finite_and_right(rows, columns, y, x, scale):
    height = torch.rand(rows, columns) * scale
    ones = torch.ones(rows, columns)
    bands = torch.tensor([GREEN]).double()
    pupil = Pupil(
        ones, ones, height, 0 * ones, bands / GREEN * 0.46, bands, torch.tensor(1e-5).double()
    )
    result, truth = (f(pupil, shape=(y, x), **SENSOR).intensity for f in (psf, psf.hooks.reference))
    assert float((result - truth).abs().max()) <= 3e-6 * float(
        psf(pupil, shape=(1, 1), **SENSOR).clear_peak
    )


@pytest.mark.slow
@pytest.mark.parametrize("method", ["direct", "folded", "bluestein", "kaiser_bessel", "fused"])
@pytest.mark.parametrize("kept", [True, False])
def test_gradients_are_those_of_finite_differences(method, kept, monkeypatch):

    if method == "fused" and shutil.which("g++") is None:
        pytest.skip("no g++")
    monkeypatch.setattr(_intensity, "KEPT_FIELD_BYTES", 1 << 30 if kept else 0)
    axes = Axis(5, 3, 0.03), Axis(4, 6, 0.02)
    envelope = torch.linspace(0.5, 1, 3).double(), torch.linspace(1, 0.3, 6).double()
    views = (View(0, *axes, 1.3, 0.7, (0.1, -0.2), 0.3, envelope), View(0, *axes, 1.3, 0.7, (0.0, 0.1), 0.2),
             View(1, *axes, 0.9, 0.5, (0.1, -0.2), 0.3))  # fmt: skip
    sampling = Sampling(views, torch.float64, method)
    parts = [torch.rand(5, 4, dtype=torch.float64, requires_grad=True) for _ in range(3)]
    assert torch.autograd.gradcheck(lambda *p: PupilIntensity.apply(*p, sampling), parts)


@pytest.mark.parametrize("params", CASES[:4])
def test_gradients_through_the_node(params):
    pupil = make(4, (GREEN, 450e-9), diameter=4 * 300e-6)

    def seen(amplitude, height, path):
        lit = pupil._replace(amplitude=amplitude, height=1e-6 * height, path=1e-6 * path)
        return 1e3 * psf(lit, shape=(2, 3), precision="double", **SENSOR, **params).intensity

    parts = [torch.rand(4, 4, dtype=torch.float64, requires_grad=True) for _ in range(3)]
    assert torch.autograd.gradcheck(seen, parts)


def test_a_second_derivative_is_refused_aloud():
    pupil = make(16, diameter=16 * 200e-6)
    height = torch.zeros(16, 16, dtype=torch.float64, requires_grad=True)
    light = psf(pupil._replace(height=height), shape=(4, 4), **SENSOR).intensity.sum()
    with pytest.raises(RuntimeError, match="no second derivative"):
        torch.autograd.grad(light, height, create_graph=True)


def test_a_window_beyond_the_alias_free_field_is_refused_with_numbers():
    pupil = make(64, diameter=64 * 30e-6)  # half the field: 550 nm 0.11 m / 60 um = 1.008 mm
    psf(pupil, shape=(601, 601), **SENSOR)
    with pytest.raises(
        ValueError,
        match=r"reaches 1\.16 mm from the spot along x.*550 nm.*30 um carries only 1\.01 mm",
    ):
        psf(pupil, shape=(601, 801), **SENSOR)
    with pytest.raises(ValueError, match="along y"):
        psf(pupil, shape=(601, 601), angle=(2e-3, 0.0), **SENSOR)
    psf(pupil, shape=(601, 801), pixel="zoh", **SENSOR)


def test_parts_that_disagree_are_refused():
    pupil = make(16)
    with pytest.raises(ValueError, match=r"differ in shape.*\(16, 15\)"):
        psf(pupil._replace(path=pupil.path[:, 1:]), shape=(4, 4), **SENSOR)
    with pytest.raises(ValueError, match="one index for each band"):
        psf(pupil._replace(index=torch.ones(3)), shape=(4, 4), **SENSOR)
    with pytest.raises(ValueError, match="closed everywhere"):
        psf(pupil._replace(aperture=0 * pupil.aperture), shape=(4, 4), **SENSOR)
    with pytest.raises(ValueError, match="index"):
        psf(pupil._replace(index=pupil.index.clone().requires_grad_()), shape=(4, 4), **SENSOR)


def test_check_reads_the_energy_in_the_window():
    pupil = make(96, height=rough, diameter=96 * GREEN * FOCAL / (256 * PIXEL))
    whole = psf.hooks.check(psf(pupil, shape=(256, 256), **SENSOR), pupil)
    assert [(c.text, c.ok) for c in whole] == [("energy in window 100.0 %", True)]


def test_a_direction_adds_to_the_angle():
    pupil = make(64, diameter=64 * 30e-6)
    together = psf(
        pupil,
        torch.tensor([1e-4, 2e-4], dtype=torch.float64),
        shape=(20, 20),
        angle=(1e-4, 0.0),
        **SENSOR,
    )
    plain = psf(pupil, shape=(20, 20), angle=(2e-4, 2e-4), **SENSOR)
    assert torch.equal(together.intensity, plain.intensity)


@pytest.mark.slow
@pytest.mark.parametrize("wavelength", [400e-9, 700e-9])
def test_tails_at_1e_minus_8_of_the_peak_at_full_size(wavelength):
    """Against the double sum in float64, on 64 rows times 64 columns."""
    pupil = make(2160, (wavelength,))
    pupil = Pupil(*(p.float() for p in pupil[:4]), *pupil[4:])
    result = psf(pupil, shape=(2048, 2048), **SENSOR).intensity[0].double()
    pick = torch.cat([torch.arange(0, 2048, 48), torch.arange(1014, 1035)])
    k, j = (pick - 1024).double(), torch.arange(2160).double() - 1079.5
    alpha = float(pupil.pitch) * PIXEL / (wavelength * FOCAL)
    kernel = torch.exp(-2j * math.pi * alpha * torch.outer(k, j))
    field = kernel @ pupil.aperture.to(torch.complex128) @ kernel.T
    truth = field.abs().square() * alpha**2 / float(pupil.aperture.double().sum())
    ours, peak = result[pick][:, pick], float(truth.max())
    assert float((ours - truth).abs().max()) < 1e-6 * peak
    tail = (truth > 1e-9 * peak) & (truth < 1e-7 * peak)
    assert int(tail.sum()) > 500
    assert float(((ours - truth).abs() / truth)[tail].quantile(0.95)) < 1e-4


FULL = """
import torch
torch.set_num_threads(2)
from neusee.nodes.optics import psf
from neusee.nodes.values import Pupil
x = torch.arange(2160) - 1079.5
disc = (x[:, None] ** 2 + x**2 <= 1080**2).float()
bands = torch.linspace(400e-9, 700e-9, 31, dtype=torch.float64)
height = 1e-6 * torch.rand(2160, 2160)
pupil = Pupil(disc, disc, height, torch.zeros_like(disc), 0.46 + 0 * bands, bands, torch.tensor(3.74e-6).double())
out = psf(pupil, focal_length=0.11, pixel_pitch=2.9e-6, shape=(2048, 2048))
assert out.intensity.shape == (31, 2048, 2048)
assert 0.1 < float(out.intensity[-1].sum()) < 1
(peak,) = (line for line in open("/proc/self/status") if line.startswith("VmHWM"))
print(int(peak.split()[1]) / 2**20)
"""


@pytest.mark.slow
@pytest.mark.skipif(
    not sys.platform.startswith("linux"), reason="reads the peak of a process from /proc"
)
def test_31_bands_at_full_size_stay_under_1_2_gigabytes():
    done = subprocess.run([sys.executable, "-c", FULL], capture_output=True, text=True, check=True)
    assert float(done.stdout) < 1.2
