"""The blur of a camera as a linear operator: against SciPy's convolution, its adjoint, and
torch.func.
"""

import numpy as np
import pytest
import torch
from scipy.signal import convolve2d

from neusee.nodes.restore import FrameBlur, frame_blur
from neusee.nodes.values import Bands, Psf

DRAW = np.random.default_rng(5)
FRAME, CENTRES = (13, 18), torch.linspace(450e-9, 650e-9, 4, dtype=torch.float64)
BANDS = Bands(
    CENTRES, torch.full((4,), 50e-9, dtype=torch.float64), torch.ones(4, dtype=torch.float64)
)
RESPONSES = torch.tensor(DRAW.uniform(0, 1, (3, 4)))
ILLUMINANT = torch.tensor(DRAW.uniform(0.5, 1, 4))


def spread(size):
    """A PSF of a few pixels in a window of another size, uneven, so that a flip would be seen."""
    intensity = np.zeros((4, size, size))
    middle = size // 2
    intensity[:, middle - 2 : middle + 3, middle - 2 : middle + 3] = DRAW.uniform(
        0, 0.04, (4, 5, 5)
    )
    return Psf(torch.tensor(intensity), torch.ones(4, dtype=torch.float64))


def blur(psf=None, dtype=torch.float64):
    return frame_blur(psf or spread(9), ILLUMINANT, RESPONSES, BANDS, FRAME, dtype)


@pytest.mark.parametrize("size", [5, 9, 32, 33])
def test_a_frame_is_the_valid_convolution_of_a_larger_scene(size):
    psf = spread(size)
    made = blur(psf)
    scene = DRAW.uniform(0, 1, (3, *made.scene))
    share = (RESPONSES * ILLUMINANT * CENTRES).numpy()
    share /= share.sum(1, keepdims=True)
    found = made.seen(torch.tensor(scene)).numpy()
    (top, left), (y, x) = made.corner(), FRAME
    assert top >= 2
    assert left >= 2
    for channel in range(3):
        kernel = np.tensordot(share[channel], psf.intensity.numpy(), 1)
        middle = size // 2
        kernel = kernel[middle - 2 : middle + 3, middle - 2 : middle + 3]  # the rest is 0
        wide = convolve2d(scene[channel], kernel, mode="same")
        np.testing.assert_allclose(found[channel], wide[top : top + y, left : left + x], atol=1e-13)


@pytest.mark.parametrize(("dtype", "most"), [(torch.float32, 1e-6), (torch.float64, 1e-14)])
def test_the_adjoint_is_exact(dtype, most):
    made = blur(dtype=dtype)
    scenes, frames = (
        torch.randn(20, 3, *made.scene, dtype=dtype),
        torch.randn(20, 3, *FRAME, dtype=dtype),
    )
    seen, back = made.seen(scenes), made.adjoint(frames)
    assert (seen.dtype, back.dtype) == (dtype, dtype)
    one = (seen.double() * frames.double()).sum((1, 2, 3))
    other = (scenes.double() * back.double()).sum((1, 2, 3))
    assert float((one - other).norm() / one.norm()) < most


@pytest.mark.filterwarnings("ignore:`torch.jit.script`")  # of torch
def test_a_matrix_of_the_blur_has_the_transposed_matrix_of_the_adjoint():
    made = frame_blur(spread(5), ILLUMINANT, RESPONSES, BANDS, (4, 3), torch.float64)
    scene, frame = torch.zeros(3, *made.scene).double(), torch.zeros(3, 4, 3).double()
    there = torch.func.jacrev(made.seen)(scene).reshape(frame.numel(), -1)
    back = torch.func.jacfwd(made.adjoint)(frame).reshape(scene.numel(), -1)
    torch.testing.assert_close(there, back.T, rtol=0, atol=1e-14)


@pytest.mark.filterwarnings("ignore:`torch.jit.script`")  # of torch
def test_batches_vmap_and_derivatives_agree():
    made = blur()
    scenes = torch.randn(2, 5, 3, *made.scene, dtype=torch.float64)
    whole = made.seen(scenes)
    alone = torch.stack([torch.stack([made.seen(s) for s in some]) for some in scenes])
    torch.testing.assert_close(whole, alone, rtol=0, atol=1e-13)
    torch.testing.assert_close(
        torch.func.vmap(torch.func.vmap(made.seen))(scenes), whole, rtol=0, atol=1e-13
    )
    tangent = torch.func.jvp(made.seen, (scenes[0, 0],), (scenes[0, 1],))[1]
    torch.testing.assert_close(tangent, whole[0, 1], rtol=0, atol=1e-13)
    pulled = torch.func.vjp(made.seen, scenes[0, 0])[1](whole[0, 1])[0]
    torch.testing.assert_close(pulled, made.adjoint(whole[0, 1]), rtol=0, atol=1e-13)


def test_the_norm_is_at_most_the_gain_and_near_it():
    made = frame_blur(spread(5), ILLUMINANT, RESPONSES, BANDS, (12, 11), torch.float64)
    matrix = (
        torch.func.jacrev(made.seen)(torch.zeros(3, *made.scene).double()).flatten(-3).flatten(0, 2)
    )
    norm = float(torch.linalg.matrix_norm(matrix, 2))
    assert 0.8 * made.gain() < norm <= made.gain() * (1 + 1e-12)


def test_the_middle_of_a_scene_is_the_frame():
    made = blur()
    # a lens that does not blur
    sharp = FrameBlur(torch.ones_like(made.transfer), made.scene, made.frame)
    scene = torch.randn(3, *made.scene, dtype=torch.float64)
    torch.testing.assert_close(sharp.seen(scene), made.cropped(scene), rtol=0, atol=1e-13)


def test_another_number_of_bands_is_refused():
    with pytest.raises(ValueError, match=r"\[3, 4\] bands"):
        frame_blur(spread(5), ILLUMINANT[:3], RESPONSES, BANDS, FRAME)
