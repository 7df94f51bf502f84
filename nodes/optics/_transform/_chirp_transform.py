"""The scaled Fourier transform by chirps (Bluestein): two FFTs for each line, exact up to round-off."""

import functools
from typing import NamedTuple

import torch
from torch import Tensor

from neusee.nodes.optics._transform._sample_axis import Axis, Sink, Source, centred, row_chunks, unit_phasor
from neusee.nodes.optics._transform._workspace import Workspace


class _Chirps(NamedTuple):
    """The phase factors of the chirp transform, from ``jk = (j^2 + k^2 - (j - k)^2) / 2``, one for each term."""

    before: Tensor
    spectrum: Tensor
    behind: Tensor
    length: int


@functools.lru_cache(maxsize=32)
def _chirps(axis: Axis, dtype: torch.dtype, device: torch.device) -> _Chirps:
    a = axis.sign * axis.alpha / 2
    j, k = centred(axis.n_in, device), centred(axis.n_out, device)
    span = axis.n_in + axis.n_out - 1
    length = smooth(span)
    lag = torch.arange(span, dtype=torch.float64, device=device) + (k[0] - j[-1])
    kernel = torch.zeros(length, dtype=torch.complex128, device=device)
    kernel[:span] = unit_phasor(lag.square_().mul_(-a), torch.float64)
    spectrum = torch.fft.fft(kernel).to(dtype.to_complex())
    before, behind = unit_phasor(j.square_().mul_(a), dtype), unit_phasor(k.square_().mul_(a), dtype)
    return _Chirps(before, spectrum, behind, length)


def bluestein(rows: Axis, columns: Axis, source: Source, sink: Sink, work: Workspace) -> None:
    """Compute the scaled Fourier transform of a field by chirps, along rows and then along columns, in small chunks."""
    kind = work.dtype.to_complex()
    along_x, along_y = (_chirps(axis, work.dtype, work.device) for axis in (columns, rows))
    half = work.take("half", columns.n_out, rows.n_in, dtype=kind)
    for start, stop in row_chunks(rows.n_in, along_x.length):
        planes = work.take("planes", 2, stop - start, columns.n_in)
        source(start, stop, planes)
        line = torch.complex(planes[0], planes[1], out=work.take("field", stop - start, columns.n_in, dtype=kind))
        half[:, start:stop] = _convolve(line, along_x, columns, work).T
    for start, stop in row_chunks(columns.n_out, along_y.length):
        patch = _convolve(half[start:stop], along_y, rows, work)
        sink(slice(0, rows.n_out), slice(start, stop), torch.view_as_real(patch).permute(2, 1, 0))


def _convolve(lines: Tensor, chirps: _Chirps, axis: Axis, work: Workspace) -> Tensor:
    """Return the chirp transform along the last dimension, in a buffer that the next call overwrites."""
    padded = work.take("padded", lines.shape[0], chirps.length, dtype=lines.dtype)
    torch.mul(lines, chirps.before, out=padded[:, : axis.n_in])
    padded[:, axis.n_in :] = 0
    product = torch.fft.fft(padded, dim=1).mul_(chirps.spectrum)
    window: Tensor = torch.fft.ifft(product, dim=1)[:, axis.n_in - 1 : axis.n_in - 1 + axis.n_out]
    return window.mul_(chirps.behind)


@functools.lru_cache(maxsize=256)
def smooth(n: int, even: bool = False) -> int:
    """Return the smallest FFT length of at least ``n`` without prime factors above 5, for which FFTs are fast."""
    n += even and n % 2
    while _rough(n):
        n += 1 + even
    return n


def _rough(n: int) -> bool:
    for p in (2, 3, 5):
        while n % p == 0:
            n //= p
    return n > 1
