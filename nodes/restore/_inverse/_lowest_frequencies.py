"""The exact inverse of the normal matrix at the lowest frequencies of a picture, as a dense matrix.

Seen pixels constrain unseen pixels (beyond the edge and in holes) through the lowest frequencies, where the signal is
up to 1e8 times the noise. There the inverse for a picture without edges is wrong by that factor; this inverse is right.
"""

from __future__ import annotations

import math

import torch
from torch import Tensor
from torch.nn.functional import pad

from neusee.nodes.restore._inverse._masked_blur import Blurred, Size, inverse_colour, with_bounds

_LEAST = 1e-11  #: times the largest diagonal number of the matrix: its round-off in float64
MODES = 500  #: real unknowns of each channel for up to three channels; more channels share the total of three.
#: The time of the matrix grows with its cube: 1000 took three quarters of the filter and left nearly the same error
_ROWS = 256  #: rows of the inverse that are read at a time
SHARE = 24  #: grid points for each unknown, at least, on a small torus


class Lowest:
    """The inverse of the normal matrix of a blurred picture at the lowest frequencies, including the mean."""

    def __init__(self, seen: Blurred, gain: Tensor, modes: int = MODES) -> None:
        """Build the inverse; `gain` (channel, fy, fx), an approximate inverse's diagonal, scales the normal matrix."""
        self.torus = seen.torus
        count = min(modes, 3 * modes // len(seen.picture), int(math.prod(seen.torus) / SHARE))
        self.fy, self.fx = (f.to(gain.device) for f in _lowest(seen.torus, max(1, count // 2)))
        root = gain[:, self.fy, self.fx].double().sqrt()
        root[:, 0] *= 0.5**0.5  # the mean is its own mirror image
        root = torch.cat([root, root[:, 1:]], 1).flatten()
        matrix = self._matrix(seen).mul_(root[:, None]).mul_(root)
        matrix.diagonal().add_(_LEAST * matrix.diagonal().max())
        whiten = _inverse(torch.linalg.cholesky(matrix)).mul_(root)
        ends = range(_ROWS, len(whiten) + _ROWS, _ROWS)  # lower triangular: numbers beyond `end` are 0
        self.whiten = [whiten[end - _ROWS : end, :end].to(gain, copy=True) for end in ends]

    def add(self, slope: Tensor, onto: Tensor) -> Tensor:
        """Add a step, the inverse normal matrix times the gradient `slope`, to `onto`.

        Return the inner product of the step and `slope`.
        """
        risen = _real(slope[:, self.fy, self.fx])
        both, rise = torch.zeros_like(risen), torch.zeros((), dtype=torch.float64, device=slope.device)
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

    def _matrix(self, seen: Blurred) -> Tensor:
        """Return the float64 normal matrix of prior, noise and glare, for real and imaginary parts of each channel."""
        transfer = seen.transfer[:, self.fy, self.fx].to(torch.complex128)
        inverse = 1.0 / seen.power[self.fy, self.fx].double().clamp_min(1e-30)
        inverse = torch.cat([2.0 * inverse[:1], inverse[1:], inverse[1:]])
        own, shared = inverse_colour(len(transfer), seen.grey)
        colours = own * torch.eye(len(transfer), dtype=torch.float64, device=inverse.device) - shared
        matrix = inverse.new_zeros(len(transfer), len(inverse), len(transfer), len(inverse))
        matrix.diagonal(dim1=1, dim2=3).copy_(colours[..., None] * inverse)
        for channel, through in enumerate(transfer):
            weight = torch.fft.rfft2(seen.weight[channel].double(), s=seen.torus)
            matrix[channel, :, channel] += self._noise(weight, through)
            if seen.held is not None:
                held = torch.fft.rfft2(seen.held[channel].double(), s=seen.torus)
                matrix[channel, :, channel] += self._noise(held, torch.ones_like(through))
        size = len(transfer) * len(inverse)
        return self._without_glare(matrix.view(size, size), seen, transfer)

    def _noise(self, weight: Tensor, through: Tensor) -> Tensor:
        """Return the part of the normal matrix from the noise of one channel, for all pairs of frequencies."""
        plus, minus = (self._at(weight, s) * through.conj()[:, None] for s in (-1, 1))
        plus, minus = plus * through, minus * through.conj()
        top = torch.cat([plus.real + minus.real, (minus.imag - plus.imag)[:, 1:]], 1)
        bottom = torch.cat([plus.imag + minus.imag, (plus.real - minus.real)[:, 1:]], 1)
        both: Tensor = torch.cat([top, bottom[1:]]) / (self.torus[0] * self.torus[1])
        return both

    def _at(self, spectrum: Tensor, sign: int) -> Tensor:
        """Return the spectrum at the sums (`sign` 1) or differences (`sign` -1) of all pairs of lowest frequencies."""
        y, x = self.torus
        fy, fx = self.fy[:, None] + sign * self.fy, (self.fx[:, None] + sign * self.fx) % x
        far = fx > x // 2
        values = spectrum[torch.where(far, -fy, fy) % y, torch.where(far, x - fx, fx)]
        return torch.where(far, values.conj(), values)

    def _without_glare(self, matrix: Tensor, seen: Blurred, transfer: Tensor) -> Tensor:
        """Subtract from the normal matrix the information lost to unknown glare strengths, and return the matrix."""
        if not seen.glare:
            return matrix
        flat = torch.stack(seen.glare).double().flatten(1)
        weighted = seen.weight.double().flatten() * flat
        products = with_bounds(weighted @ flat.T, seen.bounded)
        inverse = torch.linalg.pinv(products, hermitian=True) * (2.0 / (self.torus[0] * self.torus[1]))
        shapes = weighted.reshape(-1, *seen.picture.shape)
        spectra = (torch.fft.rfft2(shape, s=seen.torus)[:, self.fy, self.fx] for shape in shapes)
        rows = torch.stack([_real(transfer.conj() * s) for s in spectra])
        return matrix.addmm_(rows.T, inverse @ rows, alpha=-1.0)


def _inverse(lower: Tensor) -> Tensor:
    """Return the inverse of a lower triangular matrix by recursive halving, faster than a solve for the unit matrix."""
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
    inverse[half:, :half] = (inverse[half:, half:] @ (lower[half:, :half] @ inverse[:half, :half])).neg_()


def _real(spectrum: Tensor) -> Tensor:
    """Return the real and imaginary parts of the spectrum of each channel, without the imaginary part of the mean."""
    return torch.cat([spectrum.real, spectrum.imag[:, 1:]], 1).flatten()


def _lowest(size: Size, count: int) -> tuple[Tensor, Tensor]:
    """Return the `count` lowest frequencies (fy, fx), the mean first, with one frequency of each mirror pair."""
    reach = (size[0] - 1) // 2
    fy = torch.arange(-reach, reach + 1)[:, None]
    fx = torch.arange((size[1] - 1) // 2 + 1)
    squared = (fy / size[0]).square() + (fx / size[1]).square()
    squared[:reach, 0] = torch.inf
    order = squared.flatten().argsort(stable=True)[: min(count, squared.numel() - reach)]
    return order // len(fx) - reach, order % len(fx)
