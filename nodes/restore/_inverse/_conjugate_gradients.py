"""Preconditioned conjugate gradients, exact at the lowest frequencies of a picture."""

from __future__ import annotations

import math
from collections.abc import Iterator

import torch
from torch import Tensor
from torch.nn.functional import pad

from neusee.nodes.restore._inverse._masked_blur import (
    Blurred,
    Size,
    inverse_colour,
    mixed,
    weighing,
    with_bounds,
)

# --- lowest frequencies ---------------------------------------------------------------------------

# The exact inverse of the normal matrix at the lowest frequencies of a picture, as a dense matrix.
#
# Seen pixels constrain unseen pixels (beyond the edge and in holes) through the lowest frequencies,
# where the signal is up to 1e8 times the noise. There the inverse for a picture without edges is
# wrong by that factor; this inverse is right.


_LEAST = 1e-11  #: times the largest diagonal number of the matrix: its round-off in float64
#: real unknowns of each channel for up to three channels; more channels share the total of three.
MODES = 500
#: The time of the matrix grows with its cube: 1000 took three quarters of the filter and left
#: nearly the same error
_ROWS = 256  #: rows of the inverse that are read at a time
SHARE = 24  #: grid points for each unknown, at least, on a small torus


class Lowest:
    """The inverse of the normal matrix of a blurred picture at the lowest frequencies, including
    the mean.
    """

    def __init__(self, problem: Blurred, gain: Tensor, modes: int = MODES) -> None:
        """Build the inverse; `gain` (channel, fy, fx), an approximate inverse's diagonal, scales
        the normal matrix.
        """
        self.torus = problem.torus
        count = min(modes, 3 * modes // len(problem.picture), int(math.prod(problem.torus) / SHARE))
        self.fy, self.fx = (f.to(gain.device) for f in _lowest(problem.torus, max(1, count // 2)))
        root = gain[:, self.fy, self.fx].double().sqrt()
        root[:, 0] *= 0.5**0.5  # the mean is its own mirror image
        root = torch.cat([root, root[:, 1:]], 1).flatten()
        matrix = self._matrix(problem).mul_(root[:, None]).mul_(root)
        matrix.diagonal().add_(_LEAST * matrix.diagonal().max())
        whiten = _inverse(torch.linalg.cholesky(matrix)).mul_(root)
        # lower triangular: numbers beyond `end` are 0
        ends = range(_ROWS, len(whiten) + _ROWS, _ROWS)
        self.whiten = [whiten[end - _ROWS : end, :end].to(gain, copy=True) for end in ends]

    def add(self, slope: Tensor, onto: Tensor) -> Tensor:
        """Add a step, the inverse normal matrix times the gradient `slope`, to `onto`.

        Return the inner product of the step and `slope`.
        """
        risen = _real(slope[:, self.fy, self.fx])
        both, rise = (
            torch.zeros_like(risen),
            torch.zeros((), dtype=torch.float64, device=slope.device),
        )
        for some in self.whiten:  # both products while the rows are in the cache
            white = some @ risen[: some.shape[1]]
            both[: some.shape[1]] += white @ some
            rise += white.square().sum(dtype=torch.float64)
        both = both.reshape(len(slope), -1)
        real, imag = both[:, : len(self.fy)], pad(both[:, len(self.fy) :], (1, 0))
        step = torch.complex(real, imag)
        step[:, 0] *= 2.0
        onto[:, self.fy, self.fx] += step
        mirrored = (self.fx == 0) & (self.fy > 0)
        onto[:, -self.fy[mirrored], 0] += step[:, mirrored].conj()
        return rise * (2.0 / (self.torus[0] * self.torus[1]))

    def _matrix(self, problem: Blurred) -> Tensor:
        """Return the float64 normal matrix of prior, noise and glare, for real and imaginary
        parts of each channel.
        """
        transfer = problem.transfer[:, self.fy, self.fx].to(torch.complex128)
        inverse = 1.0 / problem.power[self.fy, self.fx].double().clamp_min(1e-30)
        inverse = torch.cat([2.0 * inverse[:1], inverse[1:], inverse[1:]])
        own, shared = inverse_colour(len(transfer), problem.grey)
        colours = (
            own * torch.eye(len(transfer), dtype=torch.float64, device=inverse.device) - shared
        )
        matrix = inverse.new_zeros(len(transfer), len(inverse), len(transfer), len(inverse))
        matrix.diagonal(dim1=1, dim2=3).copy_(colours[..., None] * inverse)
        for channel, through in enumerate(transfer):
            weight = torch.fft.rfft2(problem.weight[channel].double(), s=problem.torus)
            matrix[channel, :, channel] += self._noise(weight, through)
            if problem.held is not None:
                held = torch.fft.rfft2(problem.held[channel].double(), s=problem.torus)
                matrix[channel, :, channel] += self._noise(held, torch.ones_like(through))
        size = len(transfer) * len(inverse)
        return self._without_glare(matrix.view(size, size), problem, transfer)

    def _noise(self, weight: Tensor, through: Tensor) -> Tensor:
        """Return the part of the normal matrix from the noise of one channel, for all pairs of
        frequencies.
        """
        plus, minus = (self._at(weight, s) * through.conj()[:, None] for s in (-1, 1))
        plus, minus = plus * through, minus * through.conj()
        top = torch.cat([plus.real + minus.real, (minus.imag - plus.imag)[:, 1:]], 1)
        bottom = torch.cat([plus.imag + minus.imag, (plus.real - minus.real)[:, 1:]], 1)
        both: Tensor = torch.cat([top, bottom[1:]]) / (self.torus[0] * self.torus[1])
        return both

    def _at(self, spectrum: Tensor, sign: int) -> Tensor:
        """Return the spectrum at the sums (`sign` 1) or differences (`sign` -1) of all pairs of
        lowest frequencies.
        """
        y, x = self.torus
        fy, fx = self.fy[:, None] + sign * self.fy, (self.fx[:, None] + sign * self.fx) % x
        far = fx > x // 2
        values = spectrum[torch.where(far, -fy, fy) % y, torch.where(far, x - fx, fx)]
        return torch.where(far, values.conj(), values)

    def _without_glare(self, matrix: Tensor, problem: Blurred, transfer: Tensor) -> Tensor:
        """Subtract from the normal matrix the information lost to unknown glare strengths, and
        return the matrix.
        """
        if not problem.glare:
            return matrix
        flat = torch.stack(problem.glare).double().flatten(1)
        weighted = problem.weight.double().flatten() * flat
        products = with_bounds(weighted @ flat.T, problem.bounded)
        inverse = torch.linalg.pinv(products, hermitian=True) * (
            2.0 / (self.torus[0] * self.torus[1])
        )
        shapes = weighted.reshape(-1, *problem.picture.shape)
        spectra = (torch.fft.rfft2(shape, s=problem.torus)[:, self.fy, self.fx] for shape in shapes)
        rows = torch.stack([_real(transfer.conj() * s) for s in spectra])
        return matrix.addmm_(rows.T, inverse @ rows, alpha=-1.0)


def _inverse(lower: Tensor) -> Tensor:
    """Return the inverse of a lower triangular matrix by recursive halving, faster than a solve
    for the unit matrix.
    """
    inverse = torch.zeros_like(lower)
    _invert(lower, inverse)
    return inverse


def _invert(lower: Tensor, inverse: Tensor) -> None:
    half = len(lower) // 2
    if half < 128:
        unit = torch.eye(len(lower), dtype=lower.dtype, device=lower.device)
        inverse.copy_(torch.linalg.solve_triangular(lower, unit, upper=False))
        return
    _invert(lower[:half, :half], inverse[:half, :half])
    _invert(lower[half:, half:], inverse[half:, half:])
    inverse[half:, :half] = (
        inverse[half:, half:] @ (lower[half:, :half] @ inverse[:half, :half])
    ).neg_()


def _real(spectrum: Tensor) -> Tensor:
    """Return the real and imaginary parts of the spectrum of each channel, without the imaginary
    part of the mean.
    """
    return torch.cat([spectrum.real, spectrum.imag[:, 1:]], 1).flatten()


def _lowest(size: Size, count: int) -> tuple[Tensor, Tensor]:
    """Return the `count` lowest frequencies (fy, fx), the mean first, with one frequency of each
    mirror pair.
    """
    reach = (size[0] - 1) // 2
    fy = torch.arange(-reach, reach + 1)[:, None]
    fx = torch.arange((size[1] - 1) // 2 + 1)
    squared = (fy / size[0]).square() + (fx / size[1]).square()
    squared[:reach, 0] = torch.inf
    order = squared.flatten().argsort(stable=True)[: min(count, squared.numel() - reach)]
    return order // len(fx) - reach, order % len(fx)


# --- conjugate gradients --------------------------------------------------------------------------

# Preconditioned conjugate gradients, which find the most likely picture in place, in little memory.


LOWEST = 512  #: pixels a side, up to which each step solves the lowest frequencies exactly
_PIECE = 2**18  #: numbers of a spectrum worked on at a time, which fit in the cache


def descend(
    problem: Blurred, x: Tensor, steps: int, enough: float, inverse: Preconditioner | None = None
) -> Tensor:
    """Improve the half spectrum `x` of a picture in place by at most `steps` conjugate-gradient
    steps, and return `x`.

    The steps end early when the squared distance from the solution, in units of the posterior, is
    about `enough`. `inverse` is the preconditioner of the problem, where the caller has it: it
    depends on no pixel of the picture.
    """
    if steps < 1:
        return x
    normal, inverse = _Normal(problem), inverse or Preconditioner(problem)
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
    """Return slices that divide `count` array lines of `numbers` values each into blocks that
    fit in the cache.
    """
    step = max(1, _PIECE // numbers)
    return (slice(i, i + step) for i in range(0, count, step))


def corner(spectrum: Tensor, torus: Size, pixels: Tensor) -> None:
    """Write the top left corner of the inverse FFT of half a spectrum (fy, fx) to `pixels`,
    faster than `irfft2`.
    """
    rows, columns = pixels.shape
    tall = spectrum.new_empty(rows, spectrum.shape[1])
    for some in _few(spectrum.shape[1], torus[0]):
        tall[:, some] = torch.fft.ifft(spectrum[:, some], dim=0)[:rows]
    for some in _few(rows, torus[1]):
        pixels[some] = torch.fft.irfft(tall[some], n=torus[1])[:, :columns]


class _Normal:
    """The normal matrix of a least-squares deconvolution, whose inverse is the posterior
    covariance of the picture.
    """

    def __init__(self, problem: Blurred) -> None:
        self.seen, self.weigh = problem, weighing(problem)
        self.inverse = 1.0 / problem.power.clamp_min(1e-30)
        self.plane, self.pixels = (
            problem.picture.new_zeros(problem.torus),
            torch.empty_like(problem.picture),
        )

    def __call__(self, x: Tensor, result: Tensor) -> Tensor:
        """Write the product of the normal matrix and x to `result`, and return the inner product
        of x and `result`.
        """
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
        """Write the spectrum of each channel of a picture to `result`; `_finish` applies the
        adjoint of the blur.
        """
        rows, columns = pixels.shape[-2:]
        for channel, picture in enumerate(pixels):
            self.plane[:rows, :columns] = picture
            torch.fft.rfft2(self.plane, out=result[channel])

    def _hold(self, x: Tensor, result: Tensor, sign: float) -> None:
        """Add `sign` times the precision of the further prior in the frame, times x, to
        `result`.
        """
        if self.seen.held is None:
            return
        rows, columns = self.pixels.shape[-2:]
        for channel, held in enumerate(self.seen.held):
            corner(x[channel], self.seen.torus, self.pixels[channel])
            self.plane[:rows, :columns] = self.pixels[channel].mul_(held)
            result[channel].add_(torch.fft.rfft2(self.plane), alpha=sign)

    def _finish(self, x: Tensor, result: Tensor, sign: float) -> None:
        """Multiply `result` by the adjoint of the blur, and add `sign` times the inverse prior
        covariance times x.
        """
        own, shared = inverse_colour(len(x), self.seen.grey)
        for rows in pieces(x):
            prior = mixed(x[:, rows], own, -shared).mul_(self.inverse[rows])
            result[:, rows].mul_(self.seen.transfer[:, rows].conj()).add_(prior, alpha=sign)


class Preconditioner:
    """The inverse normal matrix of a picture without edges, made exact at the lowest
    frequencies.
    """

    def __init__(self, problem: Blurred, modes: int = MODES) -> None:
        own, shared = inverse_colour(len(problem.picture), problem.grey)
        count = (problem.weight > 0).sum((-2, -1)).clamp_min(1)
        mean = (problem.weight.sum((-2, -1)) / count)[:, None, None]
        held = (
            torch.zeros_like(mean)
            if problem.held is None
            else problem.held.mean((-2, -1), keepdim=True)
        )
        self.torus = problem.torus
        self.gain = torch.empty(
            problem.transfer.shape, dtype=problem.power.dtype, device=problem.power.device
        )
        self.shared = torch.empty_like(problem.power)
        for rows in pieces(self.gain):
            inverse = 1.0 / problem.power[rows].clamp_min(1e-30)
            through = problem.transfer[:, rows]
            information = mean * (through.real.square() + through.imag.square())
            self.gain[:, rows] = 1.0 / (own * inverse + information + held)
            self.shared[rows] = (
                shared * inverse / (1.0 - shared * inverse * self.gain[:, rows].sum(0))
            )
        self.lowest = (
            Lowest(problem, self.gain, modes) if max(problem.picture.shape[-2:]) <= LOWEST else None
        )

    def __call__(self, slope: Tensor, result: Tensor) -> Tensor:
        """Write the preconditioner times the gradient to `result`, and return the inner product of
        the gradient and `result`.
        """
        for rows in pieces(slope):
            gain = self.gain[:, rows]
            own = torch.mul(slope[:, rows], gain, out=result[:, rows])
            own += gain * (self.shared[rows] * own.sum(0))
        total = inner(slope, result, self.torus)
        return total if self.lowest is None else total + self.lowest.add(slope, result)


def inner(a: Tensor, b: Tensor, torus: Size) -> Tensor:
    """Return the inner product of two pictures, given half of their Fourier transforms."""
    half_sum = (
        torch.stack([torch.vdot(p.flatten(), q.flatten()) for p, q in zip(a, b, strict=True)]).sum()
        * 2.0
    )
    for column in (0,) if torus[1] % 2 else (0, -1):
        half_sum = half_sum - torch.linalg.vecdot(a[..., column], b[..., column]).sum()
    total: Tensor = half_sum.real.double() / (torus[0] * torus[1])
    return total
