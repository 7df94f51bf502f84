"""Preconditioned conjugate gradients, which find the most likely picture in place, in little memory."""

from __future__ import annotations

from collections.abc import Iterator

import torch
from torch import Tensor

from neusee.nodes.restore._inverse._lowest_frequencies import MODES, Lowest
from neusee.nodes.restore._inverse._masked_blur import Blurred, Size, inverse_colour, mixed, weighing

LOWEST = 512  #: pixels a side, up to which each step solves the lowest frequencies exactly
_PIECE = 2**18  #: numbers of a spectrum worked on at a time, which fit in the cache


def descend(seen: Blurred, x: Tensor, steps: int, enough: float, inverse: Preconditioner | None = None) -> Tensor:
    """Improve the half spectrum `x` of a picture in place by at most `steps` conjugate-gradient steps, and return `x`.

    The steps end early when the squared distance from the solution, in units of the posterior, is about `enough`.
    `inverse` is the preconditioner of the problem, where the caller has it: it depends on no pixel of the picture.
    """
    if steps < 1:
        return x
    normal, inverse = _Normal(seen), inverse or Preconditioner(seen)
    left, way, change = normal.slope(x), torch.empty_like(x), torch.empty_like(x)
    size = inverse(left, way)
    enough = max(enough, 1e-20 * float(size))
    for _ in range(steps):
        if not float(size) > enough:
            break
        length = float(size / normal(way, change))
        for rows in pieces(x):
            x[:, rows].add_(way[:, rows], alpha=length)
            left[:, rows].sub_(change[:, rows], alpha=length)
        new = inverse(left, change)
        way.mul_(float(new / size)).add_(change)
        size = new
    return x


def pieces(spectrum: Tensor) -> Iterator[slice]:
    """Return slices that cut half a spectrum into blocks of a few rows, which fit in the cache."""
    return _few(spectrum.shape[-2], len(spectrum) * spectrum.shape[-1])


def _few(count: int, numbers: int) -> Iterator[slice]:
    """Return slices that divide `count` array lines of `numbers` values each into blocks that fit in the cache."""
    step = max(1, _PIECE // numbers)
    return (slice(i, i + step) for i in range(0, count, step))


def corner(spectrum: Tensor, torus: Size, pixels: Tensor) -> None:
    """Write the top left corner of the inverse FFT of half a spectrum (fy, fx) to `pixels`, faster than `irfft2`."""
    rows, columns = pixels.shape
    tall = spectrum.new_empty(rows, spectrum.shape[1])
    for some in _few(spectrum.shape[1], torus[0]):
        tall[:, some] = torch.fft.ifft(spectrum[:, some], dim=0)[:rows]
    for some in _few(rows, torus[1]):
        pixels[some] = torch.fft.irfft(tall[some], n=torus[1])[:, :columns]


class _Normal:
    """The normal matrix of a least-squares deconvolution, whose inverse is the posterior covariance of the picture."""

    def __init__(self, seen: Blurred) -> None:
        self.seen, self.weigh = seen, weighing(seen)
        self.inverse = 1.0 / seen.power.clamp_min(1e-30)
        self.plane, self.pixels = seen.picture.new_zeros(seen.torus), torch.empty_like(seen.picture)

    def __call__(self, x: Tensor, result: Tensor) -> Tensor:
        """Write the product of the normal matrix and x to `result`, and return the inner product of x and `result`."""
        self._gather(self.weigh(self._blurred(x, result)), result)
        self._finish(x, result, 1.0)
        self._hold(x, result, 1.0)
        return inner(x, result, self.seen.torus)

    def slope(self, x: Tensor) -> Tensor:
        """Return the gradient of the log posterior at the picture of spectrum x."""
        result = torch.empty_like(x)
        self._gather(self.weigh(self._blurred(x, result).neg_().add_(self.seen.picture)), result)
        self._finish(x, result, -1.0)
        self._hold(x, result, -1.0)
        return result if self.seen.pull is None else result.add_(self.seen.pull)

    def _blurred(self, x: Tensor, room: Tensor) -> Tensor:
        for channel, transfer in enumerate(self.seen.transfer):
            torch.mul(transfer, x[channel], out=room[channel])
            corner(room[channel], self.seen.torus, self.pixels[channel])
        return self.pixels

    def _gather(self, pixels: Tensor, result: Tensor) -> None:
        """Write the spectrum of each channel of a picture to `result`; `_finish` applies the adjoint of the blur."""
        rows, columns = pixels.shape[-2:]
        for channel, picture in enumerate(pixels):
            self.plane[:rows, :columns] = picture
            torch.fft.rfft2(self.plane, out=result[channel])

    def _hold(self, x: Tensor, result: Tensor, sign: float) -> None:
        """Add `sign` times the precision of the further prior in the frame, times x, to `result`."""
        if self.seen.held is None:
            return
        rows, columns = self.pixels.shape[-2:]
        for channel, held in enumerate(self.seen.held):
            corner(x[channel], self.seen.torus, self.pixels[channel])
            self.plane[:rows, :columns] = self.pixels[channel].mul_(held)
            result[channel].add_(torch.fft.rfft2(self.plane), alpha=sign)

    def _finish(self, x: Tensor, result: Tensor, sign: float) -> None:
        """Multiply `result` by the adjoint of the blur, and add `sign` times the inverse prior covariance times x."""
        own, shared = inverse_colour(len(x), self.seen.grey)
        for rows in pieces(x):
            prior = mixed(x[:, rows], own, -shared).mul_(self.inverse[rows])
            result[:, rows].mul_(self.seen.transfer[:, rows].conj()).add_(prior, alpha=sign)


class Preconditioner:
    """The inverse normal matrix of a picture without edges, made exact at the lowest frequencies."""

    def __init__(self, seen: Blurred, modes: int = MODES) -> None:
        own, shared = inverse_colour(len(seen.picture), seen.grey)
        known = (seen.weight > 0).sum((-2, -1)).clamp_min(1)
        mean = (seen.weight.sum((-2, -1)) / known)[:, None, None]
        held = torch.zeros_like(mean) if seen.held is None else seen.held.mean((-2, -1), keepdim=True)
        self.torus = seen.torus
        self.gain = torch.empty(seen.transfer.shape, dtype=seen.power.dtype, device=seen.power.device)
        self.shared = torch.empty_like(seen.power)
        for rows in pieces(self.gain):
            inverse = 1.0 / seen.power[rows].clamp_min(1e-30)
            through = seen.transfer[:, rows]
            told = mean * (through.real.square() + through.imag.square())
            self.gain[:, rows] = 1.0 / (own * inverse + told + held)
            self.shared[rows] = shared * inverse / (1.0 - shared * inverse * self.gain[:, rows].sum(0))
        self.lowest = Lowest(seen, self.gain, modes) if max(seen.picture.shape[-2:]) <= LOWEST else None

    def __call__(self, slope: Tensor, result: Tensor) -> Tensor:
        """Write the preconditioner times the gradient to `result`, and return the inner product of the gradient and
        `result`.
        """
        for rows in pieces(slope):
            gain = self.gain[:, rows]
            own = torch.mul(slope[:, rows], gain, out=result[:, rows])
            own += gain * (self.shared[rows] * own.sum(0))
        total = inner(slope, result, self.torus)
        return total if self.lowest is None else total + self.lowest.add(slope, result)


def inner(a: Tensor, b: Tensor, torus: Size) -> Tensor:
    """Return the inner product of two pictures, given half of their Fourier transforms."""
    whole = torch.stack([torch.vdot(p.flatten(), q.flatten()) for p, q in zip(a, b, strict=True)]).sum() * 2.0
    for column in (0,) if torus[1] % 2 else (0, -1):
        whole = whole - torch.linalg.vecdot(a[..., column], b[..., column]).sum()
    total: Tensor = whole.real.double() / (torus[0] * torus[1])
    return total
