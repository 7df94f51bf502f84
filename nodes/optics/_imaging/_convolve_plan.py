"""The convolution of a scene with PSFs by a chosen plan, with borders, kernels and an estimate of the round-off."""

import math

import torch
from torch import Tensor
from torch.nn.functional import avg_pool2d, max_pool2d, pad

from neusee.nodes.optics._imaging._collapsed_plan import Given, Plan, transform
from neusee.nodes.optics._imaging._psf_energy import centred
from neusee.nodes.optics._imaging._summed_convolution import Mix, Where, summed

_CELL = 8  #: pixels along the side of the cells in which the largest error of a pixel is bounded
_SOME = 16  #: rows of the PSF summed at a time; these rows of 31 bands fit in the cache


def convolved(planes: Tensor, intensity: Tensor, given: Given, plan: Plan) -> Tensor:
    """Return weighted sums (row, y, x) over the bands of the image, from the basis images and kernels of ``plan``."""
    scene = bordered(planes[: plan.planes], given, plan.window)
    return summed(scene, _kernels(intensity, given, plan), plan.mix, _where(given, plan.window))


def _where(given: Given, window: tuple[int, int]) -> Where:
    """Return the zero padding of scene and kernel, and the window of their convolution that is the image."""
    (m, n), zero = window, (0, 0)
    at = (m - 1, n - 1) if given.reflect else (m // 2, n // 2)
    return Where(zero, zero, at, given.size, transform(given, window))


def majorant(off: Tensor, intensity: Tensor, given: Given) -> Tensor:
    """Return an upper bound (y, x) of the image error from an error ``off`` (y, x) in every band of the scene."""
    window, kernel = (intensity.shape[1], intensity.shape[2]), _heaviest(intensity, given)
    reached = summed(bordered(off[None], given, window), kernel, Mix(None, None, None), _where(given, window))
    return reached[0].clamp_min_(0)


def majorant_by_cell(off: Tensor, intensity: Tensor, given: Given) -> Tensor:
    """Return an upper bound of `majorant` over cells of 8 x 8 pixels: (cell, cell) float64, far faster.

    A part of the kernel in one cell takes light to the pixels of a cell from four neighbouring cells of the scene, and
    from none of their pixels more than from the one with the largest error.
    """
    window, kernel = (intensity.shape[1], intensity.shape[2]), _heaviest(intensity, given)[0]
    at = _where(given, window).at
    before = [-k % _CELL for k in at]  # so that the middle of the kernel begins a cell
    around = [-(k + b) % _CELL for k, b in zip(window, before, strict=True)]
    wide = pad(kernel.double(), (before[1], around[1], before[0], around[0]))
    light = avg_pool2d(wide[None], _CELL)[0] * _CELL**2
    worst = max_pool2d(pad(cells(bordered(off[None], given, window))[None], (1, 1, 1, 1)), 2, 1)[0, 0].to(light)
    length = [a + b for a, b in zip(light.shape, worst.shape, strict=True)]
    whole = torch.fft.irfft2(torch.fft.rfft2(light, length) * torch.fft.rfft2(worst, length), length)
    first = [(k + b) // _CELL for k, b in zip(at, before, strict=True)]
    y, x = (slice(f, f + -(-n // _CELL)) for f, n in zip(first, given.size, strict=True))
    inside: Tensor = whole[y, x]
    return inside.clamp_min_(0)


def cells(planes: Tensor) -> Tensor:
    """Return the largest number in each cell of planes (k, y, x): (k, cell, cell); the last cells may be smaller."""
    largest: Tensor = max_pool2d(planes[None], _CELL, ceil_mode=True)
    return largest[0]


def _heaviest(intensity: Tensor, given: Given) -> Tensor:
    """Return the PSF (1, y, x) of all bands together, each with its largest weight in any row."""
    heaviest = given.rows.abs().amax(0).to(intensity)
    weights = heaviest[None] if given.share is None else heaviest[None] @ given.share.to(heaviest)
    return _summed_bands(weights, intensity, given.passed.signed)


def bordered(planes: Tensor, given: Given, window: tuple[int, int]) -> Tensor:
    """Return the basis images of the scene, with a mirrored border if the convolution with the PSF needs a border."""
    if not given.reflect:
        return planes
    m, n = window
    around = (n - 1 - n // 2, n // 2, m - 1 - m // 2, m // 2)
    wide: Tensor = pad(planes, around, mode="reflect")
    return wide


def _kernels(intensity: Tensor, given: Given, plan: Plan) -> Tensor:
    stack = centred(intensity, plan.window)
    if plan.kernels is None:
        return stack if plan.number == len(stack) else stack[plan.bands.to(stack.device)]
    weights = plan.kernels.new_zeros(len(plan.kernels), len(given.basis))
    weights = weights.index_copy_(1, plan.bands, plan.kernels)
    weights = weights if given.share is None else weights @ given.share
    return _summed_bands(weights.to(stack), stack)


def _summed_bands(weights: Tensor, stack: Tensor, absolute: bool = False) -> Tensor:
    """Return weighted sums (kernel, y, x) over the bands of a PSF, or over the absolute values of a PSF.

    A stack that must be copied is copied in slabs of a few rows.
    """
    if stack.requires_grad or (stack.is_contiguous() and not absolute):
        return (weights @ stack.flatten(1)).view(-1, *stack.shape[1:])
    sums = stack.new_empty(len(weights), *stack.shape[1:])
    for y in range(0, stack.shape[1], _SOME):
        rows = stack[:, y : y + _SOME]
        rows = rows.abs() if absolute else rows
        sums[:, y : y + _SOME] = (weights @ rows.flatten(1)).view(-1, *rows.shape[1:])
    return sums


def guessed(planes: Tensor, given: Given) -> Tensor:
    """Return an estimate of the brightest pixel of each weighted sum over the image bands.

    The estimate is the smaller of two numbers: a quarter of the brightest pixel without blur, and half of an upper
    bound of the brightest pixel with blur.
    """
    through = given.passed.total
    room, sharp = planes.new_empty(planes[0].numel()), torch.zeros_like(given.rows[:, 0])
    for i, weights in enumerate((given.rows * through @ given.basis).to(planes)):
        bright = torch.mv(planes.flatten(1).T, weights, out=room)
        sharp[i] = torch.maximum(bright.amax(), -bright.amin())
    power = ((given.basis @ given.gram) * given.basis).sum(1).clamp_min(0) * given.copies
    blurred = given.rows.abs() @ (power * through * given.passed.peak).sqrt()
    return torch.minimum(sharp / 4, blurred / 2)


def rounding(given: Given, plan: Plan, found: Tensor, eps: float) -> Tensor:
    """Return an estimate of the largest FFT round-off in each weighted sum over the image bands.

    The round-off is close to white: a share eps sqrt(log2 N) / 2 of the power, spread over all N samples. The estimate
    takes eight standard deviations of that noise. It adds ten roundings of the brightest pixel for errors that are not
    spread: sums over the bands, planes and rows of a PSF, of which five roundings were measured.
    """
    count = math.prod(transform(given, plan.window))
    u, x, y, _ = plan.mix
    plane = given.gram.diagonal()[: plan.planes].clamp_min(0).sqrt() * math.sqrt(given.copies)
    kernel = (given.passed.total * given.passed.peak).sqrt()
    if plan.kernels is not None:
        kernel = plan.kernels.abs() @ kernel[plan.bands]
    else:  # the band of each PSF, or the band in which a PSF has the weight 1
        kernel = kernel[plan.bands if given.share is None else given.share.argmax(0)]
    terms = (plane if x is None else x.abs() @ plane) * (kernel if y is None else y.abs() @ kernel)
    white = terms[None].sum(1) if u is None else u.abs() @ terms
    return eps * (8 * math.sqrt(math.log2(count + 1)) * white / math.sqrt(count) + 10 * found)
