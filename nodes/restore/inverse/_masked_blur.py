"""The blur of a camera on a periodic grid, with unknown pixels and the prior of the picture."""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import dataclass
from typing import NamedTuple

import torch
from torch import Tensor
from torch.nn.functional import pad

from neusee.nodes.precision import single
from neusee.nodes.values import Bands, Psf

# --- grey psf -------------------------------------------------------------------------------------

# Properties of the sensor channels for a grey scene: the PSF and signal of each channel, and the
# share of each band in the signal.


def effective_psf(
    psf: Psf,
    illuminant: Tensor,
    responses: Tensor,
    bands: Bands,
    dtype: torch.dtype = torch.float32,
) -> Tensor:
    """Return the PSF (channel, y, x) of each channel of the sensor for a grey scene.

    Its type is that of the PSF or ``dtype``, whichever is more precise.
    """
    counts = {len(psf.intensity), len(illuminant), responses.shape[-1], len(bands.centres)}
    if len(counts) > 1:
        raise ValueError(
            f"PSF, illuminant, responses and bands have {sorted(counts)} bands: use one `bands`"
            " step"
        )
    intensity = single(psf.intensity)
    shares = grey_shares(illuminant, responses, bands).to(intensity.device)
    if torch.promote_types(intensity.dtype, dtype) == intensity.dtype:
        kernels: Tensor = torch.tensordot(shares.to(intensity), intensity, 1)
        return kernels
    # band by band, without a copy of all bands
    planes = zip(shares.to(dtype).T, intensity, strict=True)
    kernels_sum = torch.zeros(
        len(shares), *intensity.shape[-2:], dtype=dtype, device=intensity.device
    )
    for share, plane in planes:
        kernels_sum = kernels_sum + share[:, None, None] * plane.to(dtype)
    return kernels_sum


def grey_shares(illuminant: Tensor, responses: Tensor, bands: Bands) -> Tensor:
    """Return the share (channel, band) of each band in the signal that a grey scene gives in each
    channel, in float64; the shares of a channel sum to 1.
    """
    share = responses.cpu().double() * illuminant.cpu().double() * bands.centres.cpu()
    blind = share.sum(-1, keepdim=True) <= 0  # a channel without response gets equal shares
    share = share.where(~blind, 1.0)
    return share / share.sum(-1, keepdim=True)


def grey_white(illuminant: Tensor, responses: Tensor, bands: Bands) -> Tensor:
    """Return the signal (channel, 1, 1) that a grey scene gives in each channel, relative to the
    channel with the largest signal, in float64.
    """
    light = (responses.cpu().double() * illuminant.cpu().double() * bands.centres.cpu()).sum(-1)
    return (light / light.max().clamp_min(1e-30)).clamp_min(1e-3)[:, None, None]


# --- psf on grid ----------------------------------------------------------------------------------

# A PSF on the periodic grid of a picture, and its radius.


#: fraction of the light of the PSF within the radius that determines the border of the picture
_BORDER_LIGHT = 0.999


def edge(kernels: Tensor, picture: tuple[int, int]) -> tuple[int, int]:
    """Return the radii (y, x) that contain 99.9 % of the light of the PSF.

    A radius is limited to 256 pixels or half the picture, whichever is larger, and to the picture.
    """
    radii = []
    for dim, size in ((-1, picture[0]), (-2, picture[1])):
        # light of each row (then column), summed over channels and from the middle outwards
        profile = kernels.detach().sum((0, dim)).double()
        radius = (torch.arange(len(profile), device=profile.device) - len(profile) // 2).abs()
        light_within = (
            profile.new_zeros(int(radius.max()) + 1).index_add(0, radius, profile).cumsum(0)
        )
        radii.append(
            min(
                int((light_within < _BORDER_LIGHT * light_within[-1]).sum()),
                max(256, size // 2),
                size,
            )
        )
    return radii[0], radii[1]


def bordered(reach: tuple[int, int], border: float) -> tuple[int, int]:
    """Return the width (y, x) of the unknown border around a picture: ``border`` times the radius
    of the PSF.
    """
    return math.ceil(border * reach[0]), math.ceil(border * reach[1])


def wrapped(kernels: Tensor, size: tuple[int, int]) -> Tensor:
    """Return PSFs centred on the first sample of a periodic grid; a PSF wider than the grid
    wraps around.
    """
    (m, n), (y, x) = kernels.shape[-2:], size
    # number of grids that cover the PSF along each axis, rounded up
    grids_down, grids_across = -(-m // y), -(-n // x)
    padded = pad(kernels, (0, grids_across * x - n, 0, grids_down * y - m))
    if grids_down * grids_across > 1:
        # samples at the same place of the grid are added
        padded = padded.reshape(-1, grids_down, y, grids_across, x).sum((1, 3))
    return padded.roll((-(m // 2), -(n // 2)), (-2, -1))


# --- masked blur ----------------------------------------------------------------------------------

# The model of a blurred picture of which only some pixels are known, and the prior of the picture
# before the blur.
#
# All spectra are half spectra on a periodic grid ("torus"): (channel, fy, fx) with fx >= 0, as
# `torch.fft.rfft2` returns them.


Size = tuple[int, int]
Map = Callable[[Tensor], Tensor]

#: added to the diagonal of the Gram matrix of unit patterns, so that equal patterns can be factored
_ALIKE = 1e-13
_PIECE_PIXELS = 2**18  #: number of pixels that are converted to float64 at a time


@dataclass(frozen=True)
class Blurred:
    """The model  picture = (blur of x) + noise,  where x has mean 0 and correlated channels."""

    picture: Tensor  #: (channel, y, x)
    weight: Tensor  #: (channel, y, x), 1 / variance of the noise; 0 for an unknown pixel
    #: (channel, fy, fx), transfer function of the blur on the torus; the picture is the top left
    #: corner of the torus
    transfer: Tensor
    #: (fy, fx), power spectrum of x; the mean over the whole spectrum is the variance of x
    power: Tensor
    torus: Size
    grey: float  #: correlation of any two channels of x, below 1
    #: (channel, y, x) patterns of unknown strength that are added to the picture
    glare: tuple[Tensor, ...] = ()
    pull: Tensor | None = None  #: (channel, fy, fx), a further term of the log posterior's gradient
    #: number of patterns at the end of ``glare`` whose strengths have a prior with mean 0 and
    #: variance 1; the other strengths have no prior
    bounded: int = 0
    #: (channel, y, x), precision of a second prior of x in the frame, with mean 0
    held: Tensor | None = None

    def blur(self, spectrum: Tensor) -> Tensor:
        """Return the blurred picture, from the half spectrum of x."""
        y, x = self.picture.shape[-2:]
        return blurred(self.transfer, spectrum, self.torus, (y, x))

    def first(self, spectrum: Tensor) -> Tensor:
        """Return the pixels of x in the frame of the picture, from the half spectrum of x."""
        y, x = self.picture.shape[-2:]
        # channel by channel: one batch of all takes twice as long
        pictures = [torch.fft.irfft2(s, s=self.torus)[:y, :x] for s in spectrum]
        return torch.stack(pictures)

    def gathered(self, pixels: Tensor) -> Tensor:
        """Return the half spectrum of the adjoint of `blur`, applied to a picture."""
        return gathered(self.transfer, pixels, self.torus)

    def slope(self, x: Tensor) -> Tensor:
        """Return the gradient of the log posterior at the picture with spectrum x; it is 0 at the
        most likely picture.
        """
        own_factor, shared_factor = inverse_colour(len(x), self.grey)
        prior = mixed(x, own_factor, -shared_factor) / self.power.clamp_min(1e-30)
        gradient = self.gathered(weighing(self)(self.picture - self.blur(x))) - prior
        if self.held is not None:
            gradient = gradient - torch.fft.rfft2(self.held * self.first(x), s=self.torus)
        return gradient if self.pull is None else gradient + self.pull


def blurred(transfer: Tensor, spectrum: Tensor, torus: Size, size: Size) -> Tensor:
    """Return the top left corner (..., channel, *size) of blurred pictures, from their half spectra
    (..., fy, fx).
    """
    spectra = spectrum.expand(*spectrum.shape[:-3], *transfer.shape)
    # one batch of all channels takes twice as long
    pairs = zip(transfer, spectra.unbind(-3), strict=True)
    return torch.stack(
        [torch.fft.irfft2(t * s, s=torus)[..., : size[0], : size[1]] for t, s in pairs], -3
    )


def gathered(transfer: Tensor, pixels: Tensor, torus: Size) -> Tensor:
    """Return the half spectra of the adjoint of `blurred`, applied to pictures (..., channel, y,
    x).
    """
    spectrum: Tensor = transfer.conj() * torch.fft.rfft2(pixels, s=torus)
    return spectrum


def weighing(problem: Blurred) -> Map:
    """Return a function that multiplies a residual by the pixel weights and subtracts the glare
    patterns at their fitted strengths.
    """
    if not problem.glare:
        return lambda residual: problem.weight * residual
    flat_patterns = torch.stack(problem.glare).flatten(1)
    weighted_patterns = problem.weight.flatten() * flat_patterns
    products = with_bounds(weighted_patterns.double() @ flat_patterns.double().T, problem.bounded)
    if problem.bounded:  # similar patterns: differences of large sums would lose digits in float32
        # these combinations of patterns already include the square root of the inverse
        weighted_patterns, inverse = _whitened_patterns(weighted_patterns, products), None
    else:
        inverse = torch.linalg.pinv(products, hermitian=True).to(flat_patterns)

    def weigh(residual: Tensor) -> Tensor:
        weighted_residual, strengths = (
            problem.weight * residual,
            weighted_patterns @ residual.flatten(),
        )
        for strength, pattern in zip(
            strengths if inverse is None else inverse @ strengths, weighted_patterns, strict=True
        ):
            weighted_residual.addcmul_(strength, pattern.view_as(weighted_residual), value=-1.0)
        return weighted_residual

    return weigh


def with_bounds(products: Tensor, bounded: int) -> Tensor:
    """Return the Gram matrix of the glare patterns, plus the prior precision of their strengths: 1
    for the last ``bounded`` patterns.
    """
    if not bounded:
        return products
    certain = torch.zeros(len(products), dtype=products.dtype, device=products.device)
    certain[-bounded:] = 1.0
    return products + certain.diag()


def _whitened_patterns(weighted: Tensor, products: Tensor) -> Tensor:
    """Return L^-1 P, where the rows of P are the ``weighted`` patterns and L is the Cholesky factor
    of their ``products`` G.

    The sum of the outer products of the rows of L^-1 P is P^T G^-1 P. The result is computed in
    float64 piece by piece.
    """
    scale = products.diagonal().detach().clamp_min(1e-300).rsqrt()
    scaled_products = scale[:, None] * products * scale
    scaled_products = scaled_products + _ALIKE * torch.eye(
        len(scaled_products), dtype=scaled_products.dtype, device=scaled_products.device
    )
    lower_factor = torch.linalg.cholesky(scaled_products)
    pieces = (
        scale[:, None] * patterns.double() for patterns in torch.split(weighted, _PIECE_PIXELS, 1)
    )
    return torch.cat(
        [
            torch.linalg.solve_triangular(lower_factor, piece, upper=False).to(weighted)
            for piece in pieces
        ],
        1,
    )


def mixed(spectrum: Tensor, own: float, shared: float) -> Tensor:
    """Return `own` times the spectrum of each channel plus `shared` times the sum of the spectra
    of all channels.
    """
    return own * spectrum + shared * spectrum.sum(0)


def inverse_colour(channels: int, grey: float) -> tuple[float, float]:
    """Return (own, shared) such that  own I - shared J  is the inverse of  (1 - grey) I + grey J,
    where I is the unit matrix of the channels and J the matrix of ones.
    """
    return 1.0 / (1.0 - grey), grey / ((1.0 - grey) * (1.0 - grey + channels * grey))


def variance(power: Tensor, size: Size) -> Tensor:
    """Return the variance of pictures with a given power spectrum (a half spectrum): its mean over
    all frequencies.
    """
    return (power.sum(-2) * times(size, power)).sum(-1) / (size[0] * size[1])


def times(size: Size, like: Tensor) -> Tensor:
    """Return how many times each column of a half spectrum occurs in the whole spectrum: 1 or 2."""
    count = torch.full((size[1] // 2 + 1,), 2.0, dtype=like.real.dtype, device=like.device)
    # the mean and, of an even size, the Nyquist frequency have no mirror image
    count[0] = 1.0
    if size[1] % 2 == 0:
        count[-1] = 1.0
    return count


def narrowed(spectrum: Tensor, size: Size) -> Tensor:
    """Return a half spectrum, cropped to the frequencies of a coarser grid `size`; its Nyquist
    frequencies are 0.
    """
    nonnegative_rows, negative_rows, columns = (
        (size[0] + 1) // 2,
        (size[0] - 1) // 2,
        (size[1] + 1) // 2,
    )
    narrow_spectrum = spectrum.new_zeros(*spectrum.shape[:-2], size[0], size[1] // 2 + 1)
    narrow_spectrum[..., :nonnegative_rows, :columns] = spectrum[..., :nonnegative_rows, :columns]
    narrow_spectrum[..., size[0] - negative_rows :, :columns] = spectrum[
        ..., spectrum.shape[-2] - negative_rows :, :columns
    ]
    return narrow_spectrum


def widened(spectrum: Tensor, size: Size, wide: Size) -> Tensor:
    """Return a half spectrum of a grid `size`, padded with zeros to a grid `wide` that is twice as
    fine.
    """
    nonnegative_rows, negative_rows, columns = (
        (size[0] + 1) // 2,
        (size[0] - 1) // 2,
        (size[1] + 1) // 2,
    )
    wide_spectrum = spectrum.new_zeros(*spectrum.shape[:-2], wide[0], wide[1] // 2 + 1)
    # 4: a transform on the finer grid sums over four times as many pixels
    wide_spectrum[..., :nonnegative_rows, :columns] = (
        4.0 * spectrum[..., :nonnegative_rows, :columns]
    )
    wide_spectrum[..., wide[0] - negative_rows :, :columns] = (
        4.0 * spectrum[..., size[0] - negative_rows :, :columns]
    )
    return wide_spectrum


# --- fft grid -------------------------------------------------------------------------------------

# The size of the periodic grid for a deconvolution: the picture with unknown pixels around it,
# rounded up to a size with a fast FFT.


DENSE = 20  #: largest side in pixels of a picture that is solved exactly, as a dense system


def torus(picture: Size, edge: Size) -> Size:
    """Return the size of a periodic grid for the picture and `edge` unknown pixels on each side."""
    granule = 2 ** halvings(picture)
    y, x = (
        granule * _smooth(-(-(n + 2 * e) // granule)) for n, e in zip(picture, edge, strict=True)
    )
    return y, x


def _smooth(n: int) -> int:
    """Return the smallest integer >= ``n`` without prime factors above 7; FFTs of this length are
    fast.
    """
    # 210 = 2 x 3 x 5 x 7: its power is a multiple of n if n has no other prime factors
    while 210**32 % n:
        n += 1
    return n


def halvings(picture: Size) -> int:
    """Return how many times a picture is halved until it is small enough for an exact solution."""
    return max(0, math.ceil(math.log2(max(picture) / DENSE)))


# --- frame blur -----------------------------------------------------------------------------------

# The blur of a camera as a linear operator from a scene, which is wider than the frame, to the
# frame; and the adjoint operator.


class FrameBlur(NamedTuple):
    """The blur from a scene (..., channel, *scene) to a frame (..., channel, *frame), and the
    adjoint of this blur.

    The frame is the middle of the scene. The border of the scene beyond the frame is as wide as the
    radius that holds 99.9 % of the PSF, as in `restore.wiener`. Each pixel of the frame is thus a
    sum over scene pixels that are unknowns themselves. Light from beyond the border is taken from
    the opposite side of the scene.
    """

    #: (channel, fy, fx), half the spectrum of the PSF of each channel on the grid of the scene
    transfer: Tensor
    scene: Size
    frame: Size

    def seen(self, scene: Tensor) -> Tensor:
        """Return the frame that the camera records of a scene: blurred, then cropped to the
        sensor.
        """
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
        """Return the place (y, x) of the first pixel of the frame in the scene."""
        y, x = ((wide - n) // 2 for wide, n in zip(self.scene, self.frame, strict=True))
        return y, x

    def gain(self) -> float:
        """Return the largest absolute value of the transfer function: an upper bound of the norm of
        the blur.
        """
        return float(self.transfer.abs().max())

    def _transfer(self, like: Tensor) -> Tensor:
        """Return the transfer function in the precision of a picture, so that the result keeps this
        precision.
        """
        return self.transfer.to(like.dtype.to_complex())


def frame_blur(
    psf: Psf,
    illuminant: Tensor,
    responses: Tensor,
    bands: Bands,
    frame: Size,
    dtype: torch.dtype = torch.float32,
) -> FrameBlur:
    """Return the blur of a camera for a grey scene, whose frames have the size ``frame``.

    Shapes: psf.intensity (band, any, any), illuminant (band,), responses (channel, band).
    Units:  scene and frame in one unit: the electrons of a pixel behind a perfect lens without
            losses, and behind the lens of the PSF.
    Error:  a grey scene is assumed, as in `restore.wiener`. 0.1 % of the light, and what falls
            beyond the window of the PSF, comes from the wrong place or from none.
    Raises: ValueError where the number of bands differs.
    """
    kernels = effective_psf(psf, illuminant, responses, bands, torch.float64)
    scene = torus(frame, edge(kernels, frame))
    return FrameBlur(torch.fft.rfft2(wrapped(kernels, scene)).to(dtype.to_complex()), scene, frame)
