"""The estimated error by the number of bands, against a sum of many bands in the same interval."""

import numpy as np
import pytest
import torch

from neusee.nodes import doe, optics, spectra
from neusee.nodes.metrics import spectral_error
from neusee.nodes.metrics._psf_quality import _interpolated
from tests.nodes.optics.independent_psf import window

LENS = {"focal_length": 0.11, "pixel_pitch": 2.9e-6}
STOP = optics.stop(samples=270, pitch=29.92e-6, diameter=8e-3)
MASKS = {
    "flat": doe.flat,
    "five half-rings": lambda stop: doe.half_rings(stop, waves=(12.0, 18.0, 24.0, 30.0, 36.0)),
    "cubic": lambda stop: doe.cubic(stop, waves=5.0),
}


def pupil(mask, bands):
    return optics.pupil(MASKS[mask](STOP), doe.material(bands), bands, STOP)


def light(mask, bands, weights):
    """Add up the PSF of each channel over the bands, (channel, pixel), scaled to a sum of 1."""
    intensity = (
        optics.psf(pupil(mask, bands), shape=(192, 192), **LENS).intensity.double().flatten(1)
    )
    seen = weights @ intensity
    return seen / seen.sum(1, keepdim=True)


def true_error(mask, few, many, of_few, of_many):
    truth = light(mask, many, of_many)
    return (light(mask, few, of_few) - truth).norm(dim=1) / truth.norm(dim=1)


def photons(bands):
    return spectra.responses(bands) * spectra.illuminant(bands) * bands.centres


@pytest.mark.parametrize(("mask", "count"), [pytest.param("flat", 31, marks=pytest.mark.slow),
                                             pytest.param("cubic", 31, marks=pytest.mark.slow), ("five half-rings", 31),
                                             ("five half-rings", 16)])  # fmt: skip
def test_a_white_point(mask, count):
    few = spectra.bands(start=400e-9, stop=700e-9, count=count)
    width = float(few.widths[0]) / 8
    fine = (few.centres[0] - few.widths[0] / 2 + width * (torch.arange(8 * count) + 0.5)).tolist()
    many = spectra.filters(centres=tuple(fine), widths=(width,))
    found = spectral_error(
        pupil(mask, few), few, spectra.illuminant(few), spectra.responses(few), **LENS
    )
    truth = true_error(mask, few, many, photons(few), photons(many))
    assert bool((found < (3 if mask == "flat" else 2) * truth).all())
    assert bool((found > truth / 2).all())
    if mask == "five half-rings":
        assert float((found / truth).log().abs().max()) < 0.2  # where it matters: within a fifth
    if count == 31:
        size = {"flat": (3e-5, 3e-4), "cubic": (3e-4, 5e-3), "five half-rings": (1e-2, 3e-2)}[mask]
        assert bool(((found > size[0]) & (found < size[1])).all())


@pytest.mark.parametrize(("wavelength", "fwhm"), [(405e-9, 10e-9), (532e-9, 1e-9)])
def test_a_laser_line(wavelength, fwhm):
    line = {"wavelength": wavelength, "fwhm": fwhm}
    few, many = (spectra.line(**line, count=count) for count in (5, 121))
    found = spectral_error(pupil("five half-rings", few), few, **LENS)
    truth = true_error("five half-rings", few, many, few.weights[None], many.weights[None])
    assert found.shape == (1,)
    assert 0.5 < float(found / truth) < 2


def test_filters_that_do_not_adjoin_are_split():
    apart = {"centres": (450e-9, 650e-9), "widths": (20e-9,)}
    few = spectra.filters(**apart)
    fine = [c + 20e-9 * ((i + 0.5) / 16 - 0.5) for c in apart["centres"] for i in range(16)]
    many = spectra.filters(centres=tuple(fine), widths=(20e-9 / 16,))
    one, both = torch.eye(2, dtype=torch.float64), torch.ones(2, dtype=torch.float64)
    found = spectral_error(pupil("five half-rings", few), few, both, one, **LENS)
    truth = true_error("five half-rings", few, many, one, one.repeat_interleave(16, 1))
    assert bool(((found / truth).log().abs() < 0.7).all())


def test_one_band_and_darkness_and_other_bands():
    single = spectra.bands(start=500e-9, stop=600e-9, count=1)
    none, one = torch.zeros(3, 1), torch.ones(1)
    assert spectral_error(pupil("flat", single), single, one, none, **LENS).tolist() == [
        0.0,
        0.0,
        0.0,
    ]
    assert 0 < float(spectral_error(pupil("flat", single), single, **LENS)) < 1
    with pytest.raises(ValueError, match="pupil, bands and weights have 1, 1 and 2 bands"):
        spectral_error(pupil("flat", single), single, torch.ones(2), torch.ones(3, 2), **LENS)


def test_the_index_between_bands():
    few, more = (spectra.bands(start=400e-9, stop=700e-9, count=n) for n in (31, 61))
    found = _interpolated(few.centres, doe.material(few), more.centres)
    torch.testing.assert_close(found, doe.material(more), rtol=1e-6, atol=0)


NARROW = spectra.bands(start=500e-9, stop=501e-9, count=5)
COARSE = optics.stop(samples=48, pitch=8e-3 / 48, diameter=8e-3)
SIDE = 113  # the alias-free field of 0.1667 mm samples at 500 nm, in pixels of 2.9 um


def narrow(dtype=torch.float32):
    height = doe.half_rings(COARSE, waves=(3.0,))
    found = optics.pupil(height, doe.material(NARROW), NARROW, COARSE)
    screens = {
        name: getattr(found, name).to(dtype) for name in ("aperture", "amplitude", "height", "path")
    }
    return found._replace(**screens)


def doubled_rule(pupil, height):
    """Return the estimate for one channel of equal weights by its definition, with PSFs that
    share no code.
    """
    centres = NARROW.centres.numpy()
    lengths = np.concatenate([centres, (centres[1:] + centres[:-1]) / 2])
    index = np.polynomial.Polynomial.fit(centres, pupil.index.numpy(), 4)(lengths)
    lens = {"pitch": float(pupil.pitch), **LENS, "shape": (SIDE, SIDE)}
    light = [
        window(height, pupil.path, pupil.aperture, n, w, **lens)
        for n, w in zip(index, lengths, strict=True)
    ]
    # by the trapezoidal rule, and with half its step
    coarse = sum(light[:5]) - (light[0] + light[4]) / 2
    fine = (coarse + sum(light[5:])) / 2
    return np.linalg.norm(coarse - fine) / np.linalg.norm(sum(light[:5]))


def estimate(pupil):
    one = torch.ones(1, 5, dtype=torch.float64) / (NARROW.centres * NARROW.widths)
    return spectral_error(pupil, NARROW, torch.ones(5), one, **LENS)[0]


def test_bands_of_a_fifth_of_a_nanometre_and_the_gradient_of_their_estimate():
    """The PSFs of both rules differ by 1e-5 or less, so that float32 would leave two digits of
    the result.
    """
    pupil = narrow()
    truth = doubled_rule(pupil, pupil.height)
    assert 1e-7 < truth < 1e-4
    height = pupil.height.clone().requires_grad_()
    found = estimate(pupil._replace(height=height))
    assert float(found.detach()) == pytest.approx(truth, rel=1e-4)
    found.backward()
    way = (
        torch.rand(48, 48, generator=torch.Generator().manual_seed(2), dtype=torch.float64).numpy()
        * 1e-9
    )
    low, high = (
        doubled_rule(pupil, pupil.height.double().numpy() + sign * way) for sign in (-1, 1)
    )
    assert float((height.grad.double() * torch.tensor(way)).sum()) == pytest.approx(
        (high - low) / 2, rel=1e-3
    )


def test_a_pupil_in_half_precision_is_refused():
    with pytest.raises(ValueError, match="height is float16, which is too coarse"):
        estimate(narrow()._replace(height=narrow().height.half()))
