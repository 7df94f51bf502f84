"""The scaled Fourier transform: matrix products, and the choice of the fastest method."""

from typing import Literal

import torch
from torch import Tensor

from neusee.nodes.optics._transform._fft_transforms import bluestein, kaiser_bessel, smooth
from neusee.nodes.optics._transform._sample_axis import (
    Axis,
    Sink,
    Source,
    Workspace,
    borrowed,
    centred,
    last_type,
    patch_of,
    radians,
    row_chunks,
    unit_phasor,
)

# --- matrix transform -----------------------------------------------------------------------------

# The scaled Fourier transform as matrix products: complex, or real for the even and odd parts of
# the field.


def direct(rows: Axis, columns: Axis, source: Source, sink: Sink, work: Workspace) -> None:
    """Transform the field by complex matrix products with the full kernel, without use of
    symmetry.
    """
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
    """Transform the even and odd parts of the field by real matrix products, in a quarter of the
    operations of `direct`.
    """
    last = last_type(columns.n_in, rows.n_out, work.dtype)
    turn_x, turn_y = (
        _half_kernels(columns, work.dtype, work.device),
        _half_kernels(rows, last, work.device),
    )
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
    j, k = (
        centred(axis.n_in, device)[axis.n_in // 2 :],
        centred(axis.n_out, device)[axis.n_out // 2 :],
    )
    angle = radians(torch.outer(k, j).mul_(axis.alpha))
    cosine, sine = angle.cos().to(dtype), angle.sin().mul_(axis.sign).to(dtype)
    if axis.n_in % 2:
        cosine[:, 0] /= 2
    return cosine, sine


def _fold(field: Tensor, n: int) -> tuple[Tensor, Tensor]:
    upper, lower = field[..., n // 2 :], field[..., : (n + 1) // 2].flip(-1)
    return upper + lower, upper - lower


def _unfold(even: Tensor, odd: Tensor, axis: Axis, out: Tensor) -> None:
    """Write even(k) + i odd(k) and its mirror image to the halves of ``out``; all tensors are
    (re, im) planes.
    """
    n = axis.n_out
    low = (n + 1) // 2
    mirrored = torch.stack((even[0] + odd[1], even[1] - odd[0]))
    out[..., :low] = mirrored.flip(-1)
    torch.sub(even[0], odd[1], out=out[0, ..., n // 2 :])
    torch.add(even[1], odd[0], out=out[1, ..., n // 2 :])


# --- scaled transform -----------------------------------------------------------------------------

# The scaled Fourier transform between two grids of any pitch, and the choice of the fastest method.


Method = Literal["auto", "direct", "folded", "bluestein", "kaiser_bessel"]
#: with fewer samples than this the banded products are too few and too long to be fast
_FEW_SAMPLES = 60.0
_METHODS = {
    "direct": direct,
    "folded": folded,
    "bluestein": bluestein,
    "kaiser_bessel": kaiser_bessel,
}


def propagate(
    rows: Axis, columns: Axis, source: Source, sink: Sink, work: Workspace, method: Method = "auto"
) -> None:
    """Transform the field that ``source`` writes, chunk by chunk, and pass each part of the
    result to ``sink``.
    """
    name = cheapest(rows, columns, work.device) if method == "auto" else method
    _METHODS[name](rows, columns, source, sink, work)


def cheapest(rows: Axis, columns: Axis, device: torch.device) -> str:
    """Return the transform method with the shortest expected time; on a GPU always the folded
    matrix product.
    """
    if device.type != "cpu":
        return "folded"
    expected = _expected_seconds(rows, columns)
    return min(expected, key=expected.__getitem__)


def _expected_seconds(rows: Axis, columns: Axis) -> dict[str, float]:
    """Return the expected seconds of each transform method on two AVX-512 cores
    (tests/benchmarks/bench_psf.py).
    """
    n_in, n_out = rows.n_in * columns.n_in, rows.n_out * columns.n_out
    products = rows.n_in * columns.n_out * (columns.n_in + rows.n_out)
    chirped = rows.n_in * smooth(columns.n_in + columns.n_out) + columns.n_out * smooth(
        rows.n_in + rows.n_out
    )
    carried = rows.bandwidth * columns.bandwidth
    few = min(rows.bandwidth, columns.bandwidth) < _FEW_SAMPLES
    return {
        "direct": 0.15e-3 + 57e-12 * products,
        "folded": 0.3e-3 + 0.3e-9 * n_in + 14e-12 * products,
        "bluestein": 0.15e-3 + 3.5e-9 * chirped,
        "kaiser_bessel": 0.5e-3
        + (2.4e-9 if few else 1.2e-9) * n_in
        + 35e-9 * carried
        + 3e-9 * n_out,
    }


def transform(
    field: Tensor,
    shape: tuple[int, int],
    alpha: tuple[float, float],
    centre_in: tuple[float, float],
    centre_out: tuple[float, float],
    *,
    sign: int = -1,
    method: Method = "auto",
) -> Tensor:
    """Return ``U = K_y P K_x^T`` with kernels ``exp(sign 2 pi i alpha (j - centre_in) (k -
    centre_out))`` on each axis.

    The field is complex64 or complex128, of any shape (v, u). Both centres may lie between
    samples or outside the grid. Phases are computed in float64 and reduced to half a turn before a
    cast.
    """
    axes = [Axis(n, k, a, sign) for n, k, a in zip(field.shape, shape, alpha, strict=True)]
    real = field.real.dtype
    before, after = _tilts(axes, centre_in, centre_out, real, field.device)
    out = torch.empty(shape, dtype=field.dtype, device=field.device)

    def source(start: int, stop: int, into: Tensor) -> None:
        into.copy_(
            torch.view_as_real(
                (field[start:stop] * before[1]).mul_(before[0][start:stop, None])
            ).movedim(2, 0)
        )

    def sink(rows: slice, columns: slice, patch: Tensor) -> None:
        patch_of(torch.view_as_real(out).movedim(2, 0), rows, columns, patch).copy_(patch)

    with borrowed(real, field.device) as work:
        propagate(axes[0], axes[1], source, sink, work, method)
    return out.mul_(after[0][:, None]).mul_(after[1])


def _tilts(
    axes: list[Axis],
    centre_in: tuple[float, float],
    centre_out: tuple[float, float],
    real: torch.dtype,
    device: torch.device,
) -> tuple[list[Tensor], list[Tensor]]:
    """Return the phasors along each axis that move the centre of a Fourier transform to the
    given centres.
    """
    before, after = [], []
    for axis, c_in, c_out in zip(axes, centre_in, centre_out, strict=True):
        d_in, d_out = (axis.n_in - 1) / 2 - c_in, (axis.n_out - 1) / 2 - c_out
        a = axis.sign * axis.alpha
        before.append(unit_phasor(centred(axis.n_in, device) * (a * d_out), real))
        after.append(unit_phasor((centred(axis.n_out, device) + d_out) * (a * d_in), real))
    return before, after
