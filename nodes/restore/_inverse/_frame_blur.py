"""The blur of a camera as a linear operator, from a scene wider than the frame to the frame, and its adjoint."""

from __future__ import annotations

from typing import NamedTuple

import torch
from torch import Tensor

from neusee.nodes.restore._inverse._fft_grid import torus
from neusee.nodes.restore._inverse._grey_psf import effective_psf
from neusee.nodes.restore._inverse._masked_blur import Size, blurred, gathered
from neusee.nodes.restore._inverse._psf_on_grid import edge, wrapped
from neusee.nodes.values import Bands, Psf


class FrameBlur(NamedTuple):
    """The blur from a scene (..., channel, *scene) to a frame (..., channel, *frame), and the adjoint of this blur.

    The frame is the middle of the scene. The border of the scene beyond the frame is as wide as the radius that holds
    99.9 % of the PSF, as in `restore.wiener`. Each pixel of the frame is thus a sum over scene pixels that are unknowns
    themselves. Light from beyond the border is taken from the opposite side of the scene.
    """

    transfer: Tensor  #: (channel, fy, fx), half the spectrum of the PSF of each channel on the grid of the scene
    scene: Size
    frame: Size

    def seen(self, scene: Tensor) -> Tensor:
        """Return the frame that the camera sees of a scene: blurred, and cropped to the sensor."""
        spectrum = torch.fft.rfft2(scene.roll([-n for n in self.corner()], (-2, -1)))
        return blurred(self._transfer(scene), spectrum, self.scene, self.frame)

    def adjoint(self, frame: Tensor) -> Tensor:
        """Return the adjoint of `seen`, applied to a frame."""
        spectrum = gathered(self._transfer(frame), frame, self.scene)
        gathered_light: Tensor = torch.fft.irfft2(spectrum, s=self.scene)
        return gathered_light.roll(self.corner(), (-2, -1))

    def cropped(self, scene: Tensor) -> Tensor:
        """Return the part of a scene that lies in the frame."""
        (top, left), (y, x) = self.corner(), self.frame
        return scene[..., top : top + y, left : left + x]

    def corner(self) -> Size:
        """Return the place of the first pixel of the frame in the scene."""
        y, x = ((wide - n) // 2 for wide, n in zip(self.scene, self.frame, strict=True))
        return y, x

    def gain(self) -> float:
        """Return the largest gain at any frequency, which the norm of the blur does not exceed."""
        return float(self.transfer.abs().max())

    def _transfer(self, like: Tensor) -> Tensor:
        """Return the transfer function in the precision of a picture, which the result then has too."""
        return self.transfer.to(like.dtype.to_complex())


def frame_blur(
    psf: Psf, illuminant: Tensor, responses: Tensor, bands: Bands, frame: Size, dtype: torch.dtype = torch.float32
) -> FrameBlur:
    """Return the blur of a camera for a grey scene, whose frames have the size ``frame``.

    Shapes: psf.intensity (band, any, any), illuminant (band,), responses (channel, band).
    Units:  scene and frame in one unit: the electrons of a pixel behind a perfect lens without losses, and behind the
            lens of the PSF.
    Error:  a grey scene is assumed, as in `restore.wiener`. 0.1 % of the light, and what falls beyond the window of the
            PSF, comes from the wrong place or from none.
    Raises: ValueError where the number of bands differs.
    """
    kernels = effective_psf(psf, illuminant, responses, bands, torch.float64)
    scene = torus(frame, edge(kernels, frame))
    return FrameBlur(torch.fft.rfft2(wrapped(kernels, scene)).to(dtype.to_complex()), scene, frame)
