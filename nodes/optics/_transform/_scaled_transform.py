"""The scaled Fourier transform between two grids of any pitch, and the choice of the fastest method."""

from typing import Literal

import torch
from torch import Tensor

from neusee.nodes.optics._transform._chirp_transform import bluestein, smooth
from neusee.nodes.optics._transform._kaiser_bessel_transform import kaiser_bessel
from neusee.nodes.optics._transform._matrix_transform import direct, folded
from neusee.nodes.optics._transform._sample_axis import Axis, Sink, Source, centred, patch_of, unit_phasor
from neusee.nodes.optics._transform._workspace import Workspace, borrowed

Method = Literal["auto", "direct", "folded", "bluestein", "kaiser_bessel"]
_FEW_SAMPLES = 60.0  #: with fewer samples than this the banded products are too few and too long to be fast
_METHODS = {"direct": direct, "folded": folded, "bluestein": bluestein, "kaiser_bessel": kaiser_bessel}


def propagate(rows: Axis, columns: Axis, source: Source, sink: Sink, work: Workspace, method: Method = "auto") -> None:
    """Transform the field that ``source`` writes, chunk by chunk, and pass each part of the result to ``sink``."""
    name = cheapest(rows, columns, work.device) if method == "auto" else method
    _METHODS[name](rows, columns, source, sink, work)


def cheapest(rows: Axis, columns: Axis, device: torch.device) -> str:
    """Return the transform method with the shortest expected time; on a GPU always the folded matrix product."""
    if device.type != "cpu":
        return "folded"
    expected = _expected_seconds(rows, columns)
    return min(expected, key=expected.__getitem__)


def _expected_seconds(rows: Axis, columns: Axis) -> dict[str, float]:
    """Return the expected seconds of each transform method on two AVX-512 cores (tests/benchmarks/bench_psf.py)."""
    n_in, n_out = rows.n_in * columns.n_in, rows.n_out * columns.n_out
    products = rows.n_in * columns.n_out * (columns.n_in + rows.n_out)
    chirped = rows.n_in * smooth(columns.n_in + columns.n_out) + columns.n_out * smooth(rows.n_in + rows.n_out)
    carried = rows.bandwidth * columns.bandwidth
    few = min(rows.bandwidth, columns.bandwidth) < _FEW_SAMPLES
    return {
        "direct": 0.15e-3 + 57e-12 * products,
        "folded": 0.3e-3 + 0.3e-9 * n_in + 14e-12 * products,
        "bluestein": 0.15e-3 + 3.5e-9 * chirped,
        "kaiser_bessel": 0.5e-3 + (2.4e-9 if few else 1.2e-9) * n_in + 35e-9 * carried + 3e-9 * n_out,
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
    """Return ``U = K_y P K_x^T`` with kernels ``exp(sign 2 pi i alpha (j - centre_in) (k - centre_out))`` on each axis.

    The field is complex64 or complex128, of any shape (v, u). Both centres may lie between
    samples or outside the grid. Phases are computed in float64 and reduced to half a turn before a cast.
    """
    axes = [Axis(n, k, a, sign) for n, k, a in zip(field.shape, shape, alpha, strict=True)]
    real = field.real.dtype
    before, after = _tilts(axes, centre_in, centre_out, real, field.device)
    out = torch.empty(shape, dtype=field.dtype, device=field.device)

    def source(start: int, stop: int, into: Tensor) -> None:
        into.copy_(torch.view_as_real((field[start:stop] * before[1]).mul_(before[0][start:stop, None])).movedim(2, 0))

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
    """Return the phasors along each axis that move the centre of a Fourier transform to the given centres."""
    before, after = [], []
    for axis, c_in, c_out in zip(axes, centre_in, centre_out, strict=True):
        d_in, d_out = (axis.n_in - 1) / 2 - c_in, (axis.n_out - 1) / 2 - c_out
        a = axis.sign * axis.alpha
        before.append(unit_phasor(centred(axis.n_in, device) * (a * d_out), real))
        after.append(unit_phasor((centred(axis.n_out, device) + d_out) * (a * d_in), real))
    return before, after
