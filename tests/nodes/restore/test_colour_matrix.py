"""The colour matrix: right where it can be, balanced, and never wrong in scale."""

import colour as science
import numpy as np
import pytest
import torch

from neusee.nodes.restore import colour, colour_matrix
from neusee.nodes.sensor import expose
from neusee.nodes.values import Bands

CENTRES = torch.linspace(400e-9, 700e-9, 31, dtype=torch.float64)
BANDS = Bands(CENTRES, torch.full_like(CENTRES, 1e-8), torch.ones_like(CENTRES))
SHUTTER = {"pixel_pitch": 2.9e-6, "exposure": 0.1}
LEVEL = torch.full((31,), 3e-4, dtype=torch.float64)


def sampled(distribution):
    return torch.tensor(
        np.interp(CENTRES.numpy() * 1e9, distribution.wavelengths, distribution.values)
    )


OBSERVER = science.MSDS_CMFS["CIE 1931 2 Degree Standard Observer"]
CIE = torch.stack([sampled(OBSERVER.signals[n]) for n in OBSERVER.labels]) / 1.8
D65, LAMP = (sampled(science.SDS_ILLUMINANTS[n]) / 100 for n in ("D65", "A"))
PAINTS = torch.stack([sampled(s) for s in science.SDS_COLOURCHECKERS["ISO 17321-1"].values()])


def seen(paints, light, responses):
    """Linear sRGB that the camera makes of the paints, through its own photon count."""
    matrix = colour_matrix(BANDS, light, responses, LEVEL, quantum_efficiency=0.56, **SHUTTER)
    photons = expose((paints * light).T[:, :, None], BANDS, responses, LEVEL, **SHUTTER)
    return colour(0.56 * photons, matrix)[..., 0].T, matrix


def truth(paints):
    rgb = torch.tensor(science.RGB_COLOURSPACES["sRGB"].matrix_XYZ_to_RGB) @ (CIE * D65)
    return paints @ (rgb / rgb.sum(1, keepdim=True)).T


def test_colours_of_a_chart_under_the_paper_s_camera():
    found, _ = seen(PAINTS, D65, CIE)
    assert float((found - truth(PAINTS)).square().mean().sqrt()) < 0.02


def test_an_observer_that_counts_energy_is_exact():
    """With responses over wavelength, photons are tristimulus values, and a matrix can be exact."""
    found, matrix = seen(PAINTS, D65, CIE * 550e-9 / CENTRES)
    torch.testing.assert_close(found, truth(PAINTS), rtol=0.0, atol=1e-6)
    assert colour_matrix.hooks.check(
        matrix, BANDS, D65, CIE * 550e-9 / CENTRES, LEVEL, quantum_efficiency=0.56, **SHUTTER
    )[0].ok


def test_a_warm_lamp_is_balanced_to_daylight():
    white = torch.full((1, 31), 0.9, dtype=torch.float64)
    found, _ = seen(white, LAMP, CIE)
    torch.testing.assert_close(found, torch.full_like(found, 0.9), rtol=0.0, atol=0.04)


@pytest.mark.parametrize("scale", [1e-30, 1.0, 1e30])
def test_any_level_is_undone(scale):
    one = colour_matrix(BANDS, D65, CIE, LEVEL, quantum_efficiency=0.56, **SHUTTER)
    other = colour_matrix(BANDS, D65, CIE, LEVEL * scale, quantum_efficiency=0.56, **SHUTTER)
    torch.testing.assert_close(other * scale, one, rtol=1e-6, atol=0.0)


def test_darkness_has_a_finite_matrix():
    matrix = colour_matrix(BANDS, D65, CIE, LEVEL * 0, quantum_efficiency=0.56, **SHUTTER)
    assert torch.isfinite(matrix).all()


def test_bands_must_agree():
    with pytest.raises(ValueError, match="differ in the number of bands"):
        colour_matrix(BANDS, D65, CIE[:, :5], LEVEL, quantum_efficiency=0.56, **SHUTTER)
