"""Richardson-Lucy deconvolution with a known PSF, for scenes with lamps much brighter than the
rest.
"""

import math
from typing import Annotated, Any, NamedTuple

import torch
from pydantic import Field
from torch import Tensor

from neusee.nodes import Check, node
from neusee.nodes.precision import single
from neusee.nodes.restore.inverse._masked_blur import edge, effective_psf, torus, wrapped
from neusee.nodes.restore.inverse._wiener import refuse_other_pictures
from neusee.nodes.sensor._digitization import crop
from neusee.nodes.units import Electrons
from neusee.nodes.values import Bands, Psf

#: lower limit of the share of a scene pixel's light that reaches known pixels: it is a divisor
_UNSEEN = 1e-3
_LEAST_EXPECTED = 1e-6  #: e-, smallest expected count, because the expectation is a divisor
#: e-: a scene pixel with less light becomes 0, because its gradient would grow with each step and
#: overflow
_GONE = 1e-30


@node(rtol=3e-4, additive_inputs=[("glare",), ("ghosts",)])
def richardson_lucy(
    electrons: Tensor,
    psf: Psf,
    illuminant: Tensor,
    responses: Tensor,
    bands: Bands,
    clipped: Tensor,
    glare: list[Tensor] | None = None,
    ghosts: list[Tensor] | None = None,
    *,
    iterations: Annotated[int, Field(ge=1, le=1000)] = 40,
    read_noise: Electrons,
) -> Tensor:
    """Deconvolve a picture with a known PSF: approach the most likely scene without negative light,
    step by step.

    Each step multiplies the scene by the blurred ratio of the picture to the picture that the scene
    would give, which raises the likelihood of Poisson counts. The scene stays nonnegative, so that
    no dark ring can balance the glare of a lamp, as it does in `restore.wiener`. Few steps keep the
    result smooth. The variance of the read noise is added to the counts. Clipped pixels, and the
    border beyond the edge, are unknown, and so is the strength of each pattern of ``glare`` and
    ``ghosts``, as in `restore.wiener`.

    Shapes: electrons and clipped (channel, y, x), psf.intensity (band, any, any), responses
            (channel, band), each glare and ghost (channel, at least y, at least x), cropped to the
            centre -> (channel, y, x).
    Units:  e-; glare any; the result as behind a perfect lens without losses.
    Error:  a grey scene is assumed. The number of steps decides between blur and noise, and is no
            convergence: more steps restore finer detail and more noise. Without such lamps
            `restore.wiener` leaves less error. float32: 1e-5 of the brightest pixel after 40 steps,
            and 3e-4 at pixels of which 1e-3 of the light is seen, where the rounding of a Fourier
            transform, 1e-7, counts a thousandfold.
    Raises: ValueError where shapes or bands differ, and for pictures and PSFs that are not finite.
    Source: Richardson, J. Opt. Soc. Am. 62, 55 (1972); Lucy, Astron. J. 79, 745 (1974); read noise
            as in Snyder, Hammoud and White, J. Opt. Soc. Am. A 10, 1014 (1993).
    """
    electrons = single(electrons)
    glare = [*(glare or ()), *(ghosts or ())]
    refuse_other_pictures(electrons, psf, responses, clipped, glare)
    frame = (electrons.shape[-2], electrons.shape[-1])
    kernels = effective_psf(psf, illuminant, responses, bands).to(electrons)
    unclipped = _unclipped_weight(clipped, electrons)
    patterns = []
    for light in glare:
        pattern = crop(light.to(electrons), shape=frame)
        peak = float((pattern.detach().abs() * unclipped).max())
        if peak > 0:
            patterns.append(pattern / peak)
    grid = torus(frame, edge(kernels, frame))
    psf_sum = kernels.sum((-2, -1), keepdim=True)
    psf_sum = torch.where(psf_sum > 0, psf_sum, 1.0)
    # PSFs of sum 1, so that a PSF of any scale cannot overflow
    blur = _Blur(torch.fft.rfft2(wrapped(kernels / psf_sum, grid)), grid)
    return _climb(electrons, unclipped, blur, patterns, iterations, read_noise**2) / psf_sum


@richardson_lucy.check
def _(result: Tensor, electrons: Tensor, *inputs: Any, **params: Any) -> list[Check]:
    # `inputs`: psf, illuminant, responses, bands, then `clipped` at index 4
    share = float(inputs[4].any(-3).double().mean())
    ratio = float(result.mean() / electrons.mean())
    return [
        Check(
            f"{share:.2%} of pixels clipped, restored mean {ratio:.2f} of raw mean",
            math.isfinite(ratio),
        )
    ]


def _unclipped_weight(clipped: Tensor, like: Tensor) -> Tensor:
    """Return 1 for unclipped pixels and 0 for clipped ones; 1 for all pixels of a channel in which
    every pixel is clipped.
    """
    unclipped = (~clipped).to(like)
    return torch.where(unclipped.amax((-2, -1), keepdim=True) > 0, unclipped, 1.0)


class _Blur(NamedTuple):
    """The blur of each channel on a periodic grid."""

    transfer: Tensor  #: (channel, fy, fx)
    grid: tuple[int, int]

    def picture(self, scene: Tensor) -> Tensor:
        """Return the blurred scene, on the whole grid."""
        blurred: Tensor = torch.fft.irfft2(self.transfer * torch.fft.rfft2(scene), s=self.grid)
        return blurred

    def gathered(self, pixels: Tensor) -> Tensor:
        """Return the adjoint of the blur, applied to the pixels of a picture."""
        spectrum = torch.fft.rfft2(pixels, s=self.grid)
        scene: Tensor = torch.fft.irfft2(self.transfer.conj() * spectrum, s=self.grid)
        return scene


def _climb(
    electrons: Tensor,
    unclipped: Tensor,
    blur: _Blur,
    patterns: list[Tensor],
    iterations: int,
    variance: float,
) -> Tensor:
    """Return the scene after ``iterations`` steps, which start from a uniform scene with the mean
    of the picture.

    Each step also updates the strengths of the ``patterns`` of glare. The ``variance`` of the read
    noise is added to data and expectation, so that their total noise is nearly Poisson.
    """
    y, x = electrons.shape[-2:]
    shifted_counts = (electrons + variance).clamp_min(0) * unclipped
    mean = (electrons * unclipped).sum((-2, -1), keepdim=True) / unclipped.sum(
        (-2, -1), keepdim=True
    )
    scene = mean.clamp_min(0).expand(-1, *blur.grid)
    seen_share = blur.gathered(unclipped).clamp_min(_UNSEEN)
    strengths = [mean.mean().clamp_min(0) for _ in patterns]
    for _ in range(iterations):
        expected = blur.picture(scene)[..., :y, :x].clamp_min(0) + variance
        for strength, pattern in zip(strengths, patterns, strict=True):
            expected = expected + strength * pattern
        # Richardson-Lucy step: scene times the adjoint blur of the ratio of data to model
        ratio = shifted_counts / expected.clamp_min(_LEAST_EXPECTED)
        scene = torch.where(
            scene <= _GONE, 0.0, scene * (blur.gathered(ratio) / seen_share).clamp_min(0)
        )
        strengths = [
            s * (p * ratio).sum() / (p * unclipped).sum()
            for s, p in zip(strengths, patterns, strict=True)
        ]
    return scene[..., :y, :x]
