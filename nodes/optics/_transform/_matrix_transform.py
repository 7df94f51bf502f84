"""The scaled Fourier transform as matrix products: complex, or real for the even and odd parts of the field."""

import torch
from torch import Tensor

from neusee.nodes.optics._transform._sample_axis import (
    Axis,
    Sink,
    Source,
    centred,
    last_type,
    radians,
    row_chunks,
    unit_phasor,
)
from neusee.nodes.optics._transform._workspace import Workspace


def direct(rows: Axis, columns: Axis, source: Source, sink: Sink, work: Workspace) -> None:
    """Transform the field by complex matrix products with the full kernel, without use of symmetry."""
    last = last_type(columns.n_in, rows.n_out, work.dtype)
    along_x, along_y = _kernel(columns, work.dtype, work.device), _kernel(rows, last, work.device)
    half = torch.empty(rows.n_in, columns.n_out, dtype=along_x.dtype, device=work.device)
    for start, stop in row_chunks(rows.n_in, columns.n_in):
        planes = work.take("planes", 2, stop - start, columns.n_in)
        source(start, stop, planes)
        torch.mm(torch.complex(planes[0], planes[1]), along_x.T, out=half[start:stop])
    half = half.to(along_y.dtype)
    for start, stop in row_chunks(rows.n_out, columns.n_out):
        patch = torch.view_as_real(along_y[start:stop] @ half).movedim(2, 0)
        sink(slice(start, stop), slice(0, columns.n_out), patch)


def folded(rows: Axis, columns: Axis, source: Source, sink: Sink, work: Workspace) -> None:
    """Transform the even and odd parts of the field by real matrix products, in a quarter of the operations of
    `direct`.
    """
    last = last_type(columns.n_in, rows.n_out, work.dtype)
    turn_x, turn_y = _half_kernels(columns, work.dtype, work.device), _half_kernels(rows, last, work.device)
    half = work.take("half", 2, rows.n_in, columns.n_out)
    for start, stop in row_chunks(rows.n_in, columns.n_in):
        planes = work.take("planes", 2, stop - start, columns.n_in)
        source(start, stop, planes)
        even, odd = _fold(planes, columns.n_in)
        _unfold(even @ turn_x[0].T, odd @ turn_x[1].T, columns, half[:, start:stop])
    even, odd = _fold(half.transpose(1, 2).to(last), rows.n_in)
    for start, stop in row_chunks(columns.n_out, 4 * rows.n_out):
        patch = work.take("patch", 2, stop - start, rows.n_out, dtype=last)
        _unfold(even[:, start:stop] @ turn_y[0].T, odd[:, start:stop] @ turn_y[1].T, rows, patch)
        sink(slice(0, rows.n_out), slice(start, stop), patch.transpose(1, 2))


def _kernel(axis: Axis, dtype: torch.dtype, device: torch.device) -> Tensor:
    turns = torch.outer(centred(axis.n_out, device), centred(axis.n_in, device))
    return unit_phasor(turns.mul_(axis.sign * axis.alpha), dtype)


def _half_kernels(axis: Axis, dtype: torch.dtype, device: torch.device) -> tuple[Tensor, Tensor]:
    """Return the cosines and signed sines of the Fourier kernel on the half grids j >= 0, k >= 0.

    The cosine is halved at a sample on the axis, which both halves of the field contain.
    """
    j, k = centred(axis.n_in, device)[axis.n_in // 2 :], centred(axis.n_out, device)[axis.n_out // 2 :]
    angle = radians(torch.outer(k, j).mul_(axis.alpha))
    cosine, sine = angle.cos().to(dtype), angle.sin().mul_(axis.sign).to(dtype)
    if axis.n_in % 2:
        cosine[:, 0] /= 2
    return cosine, sine


def _fold(field: Tensor, n: int) -> tuple[Tensor, Tensor]:
    upper, lower = field[..., n // 2 :], field[..., : (n + 1) // 2].flip(-1)
    return upper + lower, upper - lower


def _unfold(even: Tensor, odd: Tensor, axis: Axis, out: Tensor) -> None:
    """Write even(k) + i odd(k) and its mirror image to the halves of ``out``; all tensors are (re, im) planes."""
    n = axis.n_out
    low = (n + 1) // 2
    mirrored = torch.stack((even[0] + odd[1], even[1] - odd[0]))
    out[..., :low] = mirrored.flip(-1)
    torch.sub(even[0], odd[1], out=out[0, ..., n // 2 :])
    torch.add(even[1], odd[0], out=out[1, ..., n // 2 :])
