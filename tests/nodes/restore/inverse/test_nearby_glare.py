"""Patterns that a laser may have: each is the PSF of its own direction, wavelength and focus,
drawn by the laws.
"""

import pytest
import torch

from neusee.nodes import doe, optics, restore, spectra
from neusee.nodes.restore.inverse import _glare as _nearby_glare

LENS = {"focal_length": 0.11, "pixel_pitch": 2.9e-6}
STOP = optics.stop(samples=48, pitch=168.3e-6, diameter=48 * 168.3e-6)
LINE = spectra.line(wavelength=532e-9, fwhm=10e-9, count=3)
RESPONSES = spectra.responses(LINE)
DIRECTION = torch.tensor([2e-5, -1e-5], dtype=torch.float64)
SHAPE = (40, 36)
HEIGHT = doe.half_rings(STOP, waves=(2.0,))


def pattern(direction=DIRECTION, line=LINE, index=None, defocus=0.0):
    """The photons of a laser by the nodes of the camera, as a recipe computes them."""
    index = doe.material(LINE) if index is None else index
    pupil = optics.pupil(HEIGHT, index, line, STOP, defocus=defocus)
    psf = optics.psf(pupil, direction, shape=SHAPE, **LENS)
    weights = RESPONSES.double() * (LINE.weights * LINE.centres)
    return torch.tensordot(weights.float(), psf.intensity, 1), pupil


def drawn(count=6, **how):
    glare, pupil = pattern()
    rng = torch.Generator().manual_seed(2)
    return restore.nearby_glare(
        3e5 * glare, pupil, DIRECTION, LINE, RESPONSES, patterns=count, rng=rng, **{**LENS, **how}
    )


def test_each_pattern_is_that_of_its_direction_wavelength_and_focus():
    laws = {"pixels": 1.5, "wavelength": 4e-9, "defocus": 0.1}
    numbers = _nearby_glare._normal(6, torch.Generator().manual_seed(2)).tolist()
    for found, (y, x, longer, further) in zip(drawn(**laws), numbers, strict=True):
        towards = DIRECTION + 1.5 * 2.9e-6 / 0.11 * torch.tensor([y, x], dtype=torch.float64)
        line = LINE._replace(centres=LINE.centres + 4e-9 * longer)
        expected = 3e5 * pattern(towards, line, doe.material(LINE), 0.1 * further)[0]
        torch.testing.assert_close(found, expected, rtol=1e-4, atol=3e-3 * float(expected.max()))


def test_without_errors_every_pattern_is_the_glare():
    glare = 3e5 * pattern()[0]
    for found in drawn(pixels=0.0, wavelength=0.0, defocus=0.0):
        torch.testing.assert_close(found, glare, rtol=1e-5, atol=1e-6 * float(glare.max()))


def test_the_draws_fill_the_normal_laws_evenly():
    numbers = _nearby_glare._normal(64, torch.Generator().manual_seed(0))
    assert float(numbers.mean(0).abs().max()) < 0.02
    assert float((numbers.std(0) - 1).abs().max()) < 0.1
    assert float((torch.corrcoef(numbers.T) - torch.eye(4)).abs().max()) < 0.4


def test_no_glare_has_no_patterns_and_other_lines_are_refused():
    _, pupil = pattern()
    how = {"rng": torch.Generator(), "patterns": 2, **LENS}
    dark = restore.nearby_glare(torch.zeros(3, *SHAPE), pupil, DIRECTION, LINE, RESPONSES, **how)
    assert not bool(dark.any())
    with pytest.raises(ValueError, match="compute all from one `line` step"):
        restore.nearby_glare(torch.zeros(2, *SHAPE), pupil, DIRECTION, LINE, RESPONSES, **how)
