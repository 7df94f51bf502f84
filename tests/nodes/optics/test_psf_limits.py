"""What a PSF refuses, at its borders: one pixel within the alias-free field, and light just
above what passes.
"""

import re

import pytest
import torch

from neusee.nodes import doe, optics
from neusee.nodes.optics._psf import refuse_gained_light
from neusee.nodes.values import Bands

FOCAL, PIXEL, WAVELENGTH = 50e-3, 3e-6, 500e-9
#: m, of the pupil: its PSF repeats beyond 500 nm 50 mm / (2 60 um) = 208.33 um, or 69.44 pixels
PITCH = 60e-6
ACROSS = 9  #: pixels of a window along its other axis


def pupil(samples=64, pitch=PITCH):
    centres = torch.tensor([WAVELENGTH], dtype=torch.float64)
    line = Bands(centres, centres, torch.ones_like(centres))
    stop = optics.stop(samples=samples, pitch=pitch, diameter=0.9 * samples * pitch)
    return optics.pupil(torch.zeros(samples, samples), doe.material(line), line, stop)


def psf(lens, pixels, axis="x", offset=0.0):
    """Return the PSF of a window of ``pixels`` along ``axis``, whose spot is ``offset`` pixels
    behind pixel n // 2.
    """
    tilt = offset * PIXEL / FOCAL
    along = {"y": ((pixels, ACROSS), (tilt, 0.0)), "x": ((ACROSS, pixels), (0.0, tilt))}
    shape, angle = along[axis]
    return optics.psf(
        lens, focal_length=FOCAL, pixel_pitch=PIXEL, shape=shape, angle=angle, sensor="integrated"
    )


@pytest.mark.parametrize("axis", ["y", "x"])
@pytest.mark.parametrize(("pixels", "offset", "refused"), [
    (139, 0.0, False),  # 69 pixels on either side of the spot
    (138, 0.0, False),  # 69 before the spot, 68 behind
    (140, 0.0, True),  # 70 before
    (141, 0.0, True),  # 70 before and behind
    (138, 1.0, True),  # 70 before
    (138, -1.0, False),  # 68 before, 69 behind
    (138, -2.0, True),  # 70 behind
    (137, 1.4, False),  # 69.4 before
    (137, 1.5, True),
    (137, -1.4, False),  # 69.4 behind
    (137, -1.5, True),
])  # fmt: skip
def test_a_window_ends_where_the_furthest_pixel_reaches_the_alias(axis, pixels, offset, refused):
    if refused:
        with pytest.raises(ValueError, match=f"along {axis}"):
            psf(pupil(), pixels, axis, offset)
    else:
        window = psf(pupil(), pixels, axis, offset).intensity
        assert max(window.shape) == pixels


def written(error):
    """Return the samples and the pitch (m) that an error says to write."""
    samples, pitch = re.search(
        r'optics\.samples=(\d+) optics\.pitch="(\S+) um"', str(error)
    ).groups()
    return int(samples), float(pitch) * 1e-6


@pytest.mark.parametrize("samples", [63, 64])
@pytest.mark.parametrize("pixels", [140, 141, 151, 171, 201])
def test_the_samples_to_write_are_the_fewest_that_carry_the_window_with_the_same_middle(
    samples, pixels
):
    with pytest.raises(ValueError, match="along x") as refused:
        psf(pupil(samples), pixels)
    enough, pitch = written(refused.value)
    width = samples * PITCH
    assert enough % 2 == samples % 2, "the axis moves by half a sample"
    assert enough * pitch == pytest.approx(width, rel=1e-9)
    psf(pupil(enough, pitch), pixels)
    with pytest.raises(ValueError, match="along x"):
        psf(pupil(enough - 2, width / (enough - 2)), pixels)


@pytest.mark.parametrize(("dtype", "allowed"), [(torch.float32, 1e-5), (torch.float64, 1e-9)])
@pytest.mark.parametrize("light", [1.0, 0.01])
def test_more_light_than_rounding_explains_is_refused(dtype, allowed, light):
    wavelengths = torch.tensor([WAVELENGTH], dtype=torch.float64)
    window = torch.zeros(1, 4, 4, dtype=dtype)
    window[0, 1, 2] = light * (1 + 0.5 * allowed)
    refuse_gained_light(window, [light], wavelengths)
    window[0, 1, 2] = light * (1 + 2 * allowed)
    with pytest.raises(ValueError, match="pupil passes only"):
        refuse_gained_light(window, [light], wavelengths)
