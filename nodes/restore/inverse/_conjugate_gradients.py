"""Conjugate gradients with a preconditioner that is exact at the lowest frequencies."""

from __future__ import annotations

import math
from collections.abc import Iterator

import torch
from torch import Tensor
from torch.nn.functional import pad

from neusee.nodes.restore.inverse._masked_blur import (
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
# Known pixels determine unknown pixels (beyond the edge and in holes) through the lowest
# frequencies, where the signal is up to 1e8 times the noise. There, the inverse for a picture
# without edges is wrong by this factor. The dense inverse is exact.


#: added to the diagonal, relative to its largest element: the rounding error in float64
_LEAST_DIAGONAL = 1e-11
#: number of real unknowns of each channel, for up to three channels; more channels share the total
#: of three. Time grows with the cube: 1000 took three quarters of the time of the filter, and left
#: nearly the same error
MODES = 500
_INVERSE_ROWS = 256  #: number of rows of the inverse that are read at a time
SHARE = 24  #: smallest number of grid points for each unknown, on a small torus


class Lowest:
    """The inverse of the normal matrix of a blurred picture at the lowest frequencies, including
    the mean.
    """

    def __init__(self, problem: Blurred, gain: Tensor, modes: int = MODES) -> None:
        """Build the inverse; the normal matrix is scaled by `gain` (channel, fy, fx), the diagonal
        of an approximate inverse.
        """
        self.torus = problem.torus
        # each frequency has two unknowns, real and imaginary
        unknowns = min(
            # more than three channels share the total of three
            modes,
            3 * modes // len(problem.picture),
            int(math.prod(problem.torus) / SHARE),
        )
        self.fy, self.fx = (
            f.to(gain.device) for f in _lowest(problem.torus, max(1, unknowns // 2))
        )
        root_gain = gain[:, self.fy, self.fx].double().sqrt()
        root_gain[:, 0] *= 0.5**0.5  # the mean is its own mirror image
        root_gain = torch.cat([root_gain, root_gain[:, 1:]], 1).flatten()
        matrix = self._matrix(problem).mul_(root_gain[:, None]).mul_(root_gain)
        matrix.diagonal().add_(_LEAST_DIAGONAL * matrix.diagonal().max())
        inverse_factor = _inverse(torch.linalg.cholesky(matrix)).mul_(root_gain)
        # the factor is lower triangular: elements beyond `end` are 0
        ends = range(_INVERSE_ROWS, len(inverse_factor) + _INVERSE_ROWS, _INVERSE_ROWS)
        self.whiten = [
            inverse_factor[end - _INVERSE_ROWS : end, :end].to(gain, copy=True) for end in ends
        ]

    def add(self, slope: Tensor, onto: Tensor) -> Tensor:
        """Add a step, the inverse normal matrix times the gradient `slope`, to `onto`.

        Return the inner product of the step and `slope`.
        """
        real_slope = _real(slope[:, self.fy, self.fx])
        real_step, inner_product = (
            torch.zeros_like(real_slope),
            torch.zeros((), dtype=torch.float64, device=slope.device),
        )
        for rows in self.whiten:  # both products while the rows are in the cache
            whitened = rows @ real_slope[: rows.shape[1]]
            real_step[: rows.shape[1]] += whitened @ rows
            inner_product += whitened.square().sum(dtype=torch.float64)
        real_step = real_step.reshape(len(slope), -1)
        real, imag = real_step[:, : len(self.fy)], pad(real_step[:, len(self.fy) :], (1, 0))
        step = torch.complex(real, imag)
        # the mean is its own mirror image, see `inverse_power` in `_matrix`
        step[:, 0] *= 2.0
        onto[:, self.fy, self.fx] += step
        in_first_column = (self.fx == 0) & (self.fy > 0)
        # the column fx = 0 of a half spectrum contains both frequencies of a mirror pair
        onto[:, -self.fy[in_first_column], 0] += step[:, in_first_column].conj()
        return inner_product * (2.0 / (self.torus[0] * self.torus[1]))

    def _matrix(self, problem: Blurred) -> Tensor:
        """Return the float64 normal matrix of prior, noise and glare; rows and columns are the real
        and imaginary parts of the lowest frequencies, channel by channel.
        """
        transfer = problem.transfer[:, self.fy, self.fx].to(torch.complex128)
        inverse_power = 1.0 / problem.power[self.fy, self.fx].double().clamp_min(1e-30)
        # order: real part of the mean, real parts of the other frequencies, their imaginary parts
        inverse_power = torch.cat([2.0 * inverse_power[:1], inverse_power[1:], inverse_power[1:]])
        own_factor, shared_factor = inverse_colour(len(transfer), problem.grey)
        colours = (
            own_factor * torch.eye(len(transfer), dtype=torch.float64, device=inverse_power.device)
            - shared_factor
        )
        matrix = inverse_power.new_zeros(
            len(transfer), len(inverse_power), len(transfer), len(inverse_power)
        )
        matrix.diagonal(dim1=1, dim2=3).copy_(colours[..., None] * inverse_power)
        for channel, channel_transfer in enumerate(transfer):
            weight = torch.fft.rfft2(problem.weight[channel].double(), s=problem.torus)
            matrix[channel, :, channel] += self._noise(weight, channel_transfer)
            if problem.held is not None:
                held_spectrum = torch.fft.rfft2(problem.held[channel].double(), s=problem.torus)
                matrix[channel, :, channel] += self._noise(
                    held_spectrum, torch.ones_like(channel_transfer)
                )
        size = len(transfer) * len(inverse_power)
        return self._without_glare(matrix.view(size, size), problem, transfer)

    def _noise(self, weight: Tensor, through: Tensor) -> Tensor:
        """Return the part of the normal matrix from the noise of one channel, for all pairs of
        frequencies.

        ``weight`` is the spectrum of the weights, ``through`` the transfer function at the lowest
        frequencies.
        """
        difference_part, sum_part = (
            self._at_frequency_pairs(weight, s) * through.conj()[:, None] for s in (-1, 1)
        )
        difference_part, sum_part = difference_part * through, sum_part * through.conj()
        real_rows = torch.cat(
            [difference_part.real + sum_part.real, (sum_part.imag - difference_part.imag)[:, 1:]], 1
        )
        imaginary_rows = torch.cat(
            [difference_part.imag + sum_part.imag, (difference_part.real - sum_part.real)[:, 1:]], 1
        )
        matrix: Tensor = torch.cat([real_rows, imaginary_rows[1:]]) / (
            self.torus[0] * self.torus[1]
        )
        return matrix

    def _at_frequency_pairs(self, spectrum: Tensor, sign: int) -> Tensor:
        """Return the spectrum at the sums (`sign` 1) or differences (`sign` -1) of all pairs of
        lowest frequencies.
        """
        y, x = self.torus
        fy, fx = self.fy[:, None] + sign * self.fy, (self.fx[:, None] + sign * self.fx) % x
        # other half of the spectrum: complex conjugate at the mirror frequency
        beyond_half = fx > x // 2
        values = spectrum[
            torch.where(beyond_half, -fy, fy) % y, torch.where(beyond_half, x - fx, fx)
        ]
        return torch.where(beyond_half, values.conj(), values)

    def _without_glare(self, matrix: Tensor, problem: Blurred, transfer: Tensor) -> Tensor:
        """Subtract from the normal matrix the information that is lost to the unknown strengths of
        the glare; return the matrix.
        """
        if not problem.glare:
            return matrix
        flat_patterns = torch.stack(problem.glare).double().flatten(1)
        weighted_patterns = problem.weight.double().flatten() * flat_patterns
        products = with_bounds(weighted_patterns @ flat_patterns.T, problem.bounded)
        inverse_products = torch.linalg.pinv(products, hermitian=True) * (
            2.0 / (self.torus[0] * self.torus[1])
        )
        weighted_pictures = weighted_patterns.reshape(-1, *problem.picture.shape)
        spectra = (
            torch.fft.rfft2(shape, s=problem.torus)[:, self.fy, self.fx]
            for shape in weighted_pictures
        )
        blurred_back = torch.stack([_real(transfer.conj() * s) for s in spectra])
        return matrix.addmm_(blurred_back.T, inverse_products @ blurred_back, alpha=-1.0)


def _inverse(lower: Tensor) -> Tensor:
    """Return the inverse of a lower triangular matrix, by recursion: faster than
    `solve_triangular` with the unit matrix.
    """
    inverse = torch.zeros_like(lower)
    _invert(lower, inverse)
    return inverse


def _invert(lower: Tensor, inverse: Tensor) -> None:
    """Write the inverse of a lower triangular matrix to ``inverse``, from the inverses of its
    diagonal blocks A and B: [[A, 0], [C, B]]^-1 = [[A^-1, 0], [-B^-1 C A^-1, B^-1]].
    """
    middle = len(lower) // 2
    if middle < 128:
        unit = torch.eye(len(lower), dtype=lower.dtype, device=lower.device)
        inverse.copy_(torch.linalg.solve_triangular(lower, unit, upper=False))
        return
    _invert(lower[:middle, :middle], inverse[:middle, :middle])
    _invert(lower[middle:, middle:], inverse[middle:, middle:])
    inverse[middle:, :middle] = (
        inverse[middle:, middle:] @ (lower[middle:, :middle] @ inverse[:middle, :middle])
    ).neg_()


def _real(spectrum: Tensor) -> Tensor:
    """Return the real and imaginary parts of the spectrum of each channel, without the imaginary
    part of the mean.
    """
    return torch.cat([spectrum.real, spectrum.imag[:, 1:]], 1).flatten()


def _lowest(size: Size, count: int) -> tuple[Tensor, Tensor]:
    """Return the indices (fy, fx) of the `count` lowest frequencies, the mean first, with one
    frequency of each mirror pair.
    """
    reach = (size[0] - 1) // 2
    fy = torch.arange(-reach, reach + 1)[:, None]
    fx = torch.arange((size[1] - 1) // 2 + 1)
    squared = (fy / size[0]).square() + (fx / size[1]).square()
    # in the column fx = 0, the frequency of a mirror pair with negative fy is left out
    squared[:reach, 0] = torch.inf
    order = squared.flatten().argsort(stable=True)[: min(count, squared.numel() - reach)]
    return order // len(fx) - reach, order % len(fx)


# --- conjugate gradients --------------------------------------------------------------------------

# Preconditioned conjugate gradients for the most likely picture, in place, with little memory.


LOWEST = 512  #: largest side in pixels for which each step solves the lowest frequencies exactly
_PIECE_NUMBERS = 2**18  #: number of elements that are processed at a time and fit in the cache


def descend(
    problem: Blurred, x: Tensor, steps: int, enough: float, inverse: Preconditioner | None = None
) -> Tensor:
    """Improve the half spectrum `x` of a picture in place by at most `steps` conjugate gradient
    steps, and return `x`.

    The steps end early if the squared distance from the solution, in the norm of the inverse
    posterior covariance, is about `enough`. `inverse` is the preconditioner of the problem, if the
    caller has it; it does not depend on the pixels of the picture.
    """
    if steps < 1:
        return x
    normal, inverse = _Normal(problem), inverse or Preconditioner(problem)
    # gradient at the start, search direction, and normal matrix times direction
    residual, direction, product = normal.slope(x), torch.empty_like(x), torch.empty_like(x)
    residual_norm = inverse(residual, direction)
    # below 1e-20 of the first norm, only rounding errors are left
    enough = max(enough, 1e-20 * float(residual_norm))
    for _ in range(steps):
        if not float(residual_norm) > enough:
            break
        step = float(residual_norm / normal(direction, product))
        for rows in pieces(x):
            x[:, rows].add_(direction[:, rows], alpha=step)
            residual[:, rows].sub_(product[:, rows], alpha=step)
        new_norm = inverse(residual, product)
        # Fletcher-Reeves: the next direction is conjugate to the earlier ones
        direction.mul_(float(new_norm / residual_norm)).add_(product)
        residual_norm = new_norm
    return x


def pieces(spectrum: Tensor) -> Iterator[slice]:
    """Return slices of the rows of a half spectrum; each block fits in the cache."""
    return _cache_blocks(spectrum.shape[-2], len(spectrum) * spectrum.shape[-1])


def _cache_blocks(count: int, numbers: int) -> Iterator[slice]:
    """Return slices of `count` lines of `numbers` values each; each block of lines fits in the
    cache.
    """
    step = max(1, _PIECE_NUMBERS // numbers)
    return (slice(i, i + step) for i in range(0, count, step))


def corner(spectrum: Tensor, torus: Size, pixels: Tensor) -> None:
    """Write the top left corner of the inverse FFT of a half spectrum (fy, fx) to `pixels`; this is
    faster than `irfft2`.
    """
    rows, columns = pixels.shape
    column_transforms = spectrum.new_empty(rows, spectrum.shape[1])
    for block in _cache_blocks(spectrum.shape[1], torus[0]):
        column_transforms[:, block] = torch.fft.ifft(spectrum[:, block], dim=0)[:rows]
    for block in _cache_blocks(rows, torus[1]):
        pixels[block] = torch.fft.irfft(column_transforms[block], n=torus[1])[:, :columns]


class _Normal:
    """The normal matrix of a least-squares deconvolution, whose inverse is the posterior
    covariance of the picture.
    """

    def __init__(self, problem: Blurred) -> None:
        """Prepare the products for a problem; each product reuses the memory `plane` and
        `pixels`.
        """
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
        """Return the blurred picture of spectrum x in `self.pixels`; ``room`` is working memory."""
        for channel, transfer in enumerate(self.seen.transfer):
            torch.mul(transfer, x[channel], out=room[channel])
            corner(room[channel], self.seen.torus, self.pixels[channel])
        return self.pixels

    def _gather(self, pixels: Tensor, result: Tensor) -> None:
        """Write the spectrum of each channel of a picture to `result`; then `_finish` applies the
        adjoint of the blur.
        """
        rows, columns = pixels.shape[-2:]
        for channel, picture in enumerate(pixels):
            self.plane[:rows, :columns] = picture
            torch.fft.rfft2(self.plane, out=result[channel])

    def _hold(self, x: Tensor, result: Tensor, sign: float) -> None:
        """Add `sign` times the precision of the second prior (`Blurred.held`), times x, to
        `result`.
        """
        if self.seen.held is None:
            return
        rows, columns = self.pixels.shape[-2:]
        for channel, precision in enumerate(self.seen.held):
            corner(x[channel], self.seen.torus, self.pixels[channel])
            self.plane[:rows, :columns] = self.pixels[channel].mul_(precision)
            result[channel].add_(torch.fft.rfft2(self.plane), alpha=sign)

    def _finish(self, x: Tensor, result: Tensor, sign: float) -> None:
        """Multiply `result` by the adjoint of the blur, and add `sign` times the inverse prior
        covariance times x.
        """
        own_factor, shared_factor = inverse_colour(len(x), self.seen.grey)
        for rows in pieces(x):
            prior = mixed(x[:, rows], own_factor, -shared_factor).mul_(self.inverse[rows])
            result[:, rows].mul_(self.seen.transfer[:, rows].conj()).add_(prior, alpha=sign)


class Preconditioner:
    """The inverse normal matrix of a picture without edges, made exact at the lowest
    frequencies.
    """

    def __init__(self, problem: Blurred, modes: int = MODES) -> None:
        """Build the inverse of (inverse prior + mean weight x |transfer|^2) for each frequency; up
        to `LOWEST` pixels a side, the lowest frequencies are exact.
        """
        own_factor, shared_factor = inverse_colour(len(problem.picture), problem.grey)
        count = (problem.weight > 0).sum((-2, -1)).clamp_min(1)
        mean_weight = (problem.weight.sum((-2, -1)) / count)[:, None, None]
        mean_held = (
            torch.zeros_like(mean_weight)
            if problem.held is None
            else problem.held.mean((-2, -1), keepdim=True)
        )
        self.torus = problem.torus
        self.gain = torch.empty(
            problem.transfer.shape, dtype=problem.power.dtype, device=problem.power.device
        )
        self.shared = torch.empty_like(problem.power)
        for rows in pieces(self.gain):
            inverse_power = 1.0 / problem.power[rows].clamp_min(1e-30)
            transfer = problem.transfer[:, rows]
            information = mean_weight * (transfer.real.square() + transfer.imag.square())
            self.gain[:, rows] = 1.0 / (own_factor * inverse_power + information + mean_held)
            # Sherman-Morrison: the prior couples all channels by a term of rank one
            self.shared[rows] = (
                shared_factor
                * inverse_power
                / (1.0 - shared_factor * inverse_power * self.gain[:, rows].sum(0))
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
            step = torch.mul(slope[:, rows], gain, out=result[:, rows])
            step += gain * (self.shared[rows] * step.sum(0))
        total = inner(slope, result, self.torus)
        return total if self.lowest is None else total + self.lowest.add(slope, result)


def inner(a: Tensor, b: Tensor, torus: Size) -> Tensor:
    """Return the inner product of two pictures, from their half spectra."""
    total_over_halves = (
        torch.stack([torch.vdot(p.flatten(), q.flatten()) for p, q in zip(a, b, strict=True)]).sum()
        * 2.0
    )
    # columns that occur only once in the whole spectrum
    for column in (0,) if torus[1] % 2 else (0, -1):
        total_over_halves = (
            total_over_halves - torch.linalg.vecdot(a[..., column], b[..., column]).sum()
        )
    total: Tensor = total_over_halves.real.double() / (torus[0] * torus[1])
    return total
