"""The level of a frame: the electrons of white, counted by hand with constants of CODATA."""

import numpy as np
import pytest
import torch

from neusee.nodes.restore import colour, colour_matrix, white_level
from neusee.nodes.values import Bands, Psf

NM = np.array([450.0, 550.0, 650.0])
BANDS = Bands(
    torch.tensor(NM * 1e-9),
    torch.full((3,), 1e-7, dtype=torch.float64),
    torch.ones(3, dtype=torch.float64),
)
LIGHT = torch.tensor([0.8, 1.0, 0.6], dtype=torch.float64)
RESPONSES = torch.tensor([[0.0, 0.3, 0.9], [0.1, 1.0, 0.2], [0.9, 0.1, 0.0]], dtype=torch.float64)
SENSOR = {"full_well": 20000.0, "quantum_efficiency": 0.5, "pixel_pitch": 3e-6, "exposure": 0.02}
PIXEL = {name: SENSOR[name] for name in ("quantum_efficiency", "pixel_pitch", "exposure")}


def electrons_of_white(level):
    """Photons are power times wavelength over hc."""
    photons = level * LIGHT.numpy() * NM * 1e-9 / (6.62607015e-34 * 299792458.0) * 0.02 * 9e-12
    return 0.5 * RESPONSES.numpy() @ photons


def spread(share=1.0):
    kernel = torch.zeros(3, 5, 5, dtype=torch.float64)
    kernel[:, 2, 2] = share
    return Psf(kernel, torch.ones(3, dtype=torch.float64))


def level(signal, clipped=None, share=1.0, **how):
    none = torch.zeros(signal.shape, dtype=torch.bool)
    return white_level(
        signal,
        none if clipped is None else clipped,
        spread(share),
        BANDS,
        LIGHT,
        RESPONSES,
        **SENSOR,
        **how,
    )


def test_white_fills_the_stated_part_of_the_well():
    found = level(torch.rand(3, 8, 8), white=0.7)
    assert float((found - found[0]).abs().max()) == 0
    assert electrons_of_white(float(found[0])).max() == pytest.approx(0.7 * 20000, rel=1e-6)


@pytest.mark.parametrize("share", [1.0, 0.25])
def test_a_white_frame_is_shown_white(share):
    """A fourfold loss of light behind the lens does not make the scene darker."""
    white = torch.from_numpy(electrons_of_white(3e-3))
    signal = (share * white)[:, None, None].expand(3, 20, 20).clone()
    found = level(signal, share=share)
    assert float(found[0]) == pytest.approx(3e-3, rel=1e-5)
    matrix = colour_matrix(BANDS, LIGHT, RESPONSES, found, **PIXEL)
    assert colour(signal / share, matrix).mean((1, 2)).numpy() == pytest.approx([1, 1, 1], abs=0.1)


def test_clipped_pixels_and_the_brightest_of_a_thousand_do_not_count():
    signal = torch.full((3, 40, 40), 1000.0)
    plain = level(signal)
    signal[:, 3, 3:8] = 60000.0
    assert torch.equal(level(signal), plain)
    signal[:, :20], clipped = 60000.0, torch.zeros(3, 40, 40, dtype=torch.bool)
    clipped[1, :20] = True
    assert torch.equal(level(signal, clipped), plain)
    assert float(level(signal)[0]) > 10 * float(plain[0])


def test_a_frame_that_is_clipped_everywhere_still_has_a_level():
    signal = torch.full((3, 4, 4), 1000.0)
    assert float(level(signal, torch.ones(3, 4, 4, dtype=torch.bool))[0]) > 0


def test_the_restored_picture_gives_the_white_and_not_the_blurred_frame():
    """By hand: the 99.5 % quantile of the largest colour is 1, in a picture whose frame is
    blurred to a third of it.
    """
    rng = np.random.default_rng(4)
    reflectance = torch.from_numpy(rng.uniform(0.02, 1.0, (50, 60)))
    sharp = torch.from_numpy(electrons_of_white(3e-3))[:, None, None] * reflectance
    frame = sharp.mean((1, 2), keepdim=True).expand_as(sharp) * 0.66
    found = level(frame.clone(), restored=sharp)
    shown = colour(sharp, colour_matrix(BANDS, LIGHT, RESPONSES, found, **PIXEL)).amax(0).numpy()
    assert np.quantile(shown, 0.995) == pytest.approx(1.0, rel=1e-5)
    assert float(found[0]) > 1.3 * float(level(frame.clone())[0])
    clipped = torch.zeros(3, 50, 60, dtype=torch.bool)
    clipped[0] = reflectance > 0.9
    without = level(frame.clone(), clipped, restored=sharp)
    shown = colour(sharp, colour_matrix(BANDS, LIGHT, RESPONSES, without, **PIXEL)).amax(0)
    assert np.quantile(shown[~clipped[0]].numpy(), 0.995) == pytest.approx(1.0, rel=1e-5)
    assert torch.equal(
        level(frame.clone(), restored=sharp, white=0.7), level(frame.clone(), white=0.7)
    )
