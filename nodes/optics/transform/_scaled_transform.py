"""The scaled Fourier transform by matrix products, and the choice of the fastest method."""

from typing import Literal, NamedTuple

import torch
from torch import Tensor

from neusee.nodes.optics.transform._fft_transforms import bluestein, fft_length, kaiser_bessel
from neusee.nodes.optics.transform._sample_axis import (
    Axis,
    Sink,
    Source,
    Workspace,
    borrowed,
    centred,
    last_type,
    patch_view,
    radians,
    row_chunks,
    unit_phasor,
)

# --- matrix transform -----------------------------------------------------------------------------

# The scaled Fourier transform as matrix products: complex, or real for the even and odd parts of
# the field.


def direct(rows: Axis, columns: Axis, source: Source, sink: Sink, work: Workspace) -> None:
    """Transform the field by complex matrix products with the full kernel; symmetry is not used."""
    last_kind = last_type(columns.n_in, rows.n_out, work.dtype)
    column_kernel, row_kernel = (
        _kernel(columns, work.dtype, work.device),
        _kernel(rows, last_kind, work.device),
    )
    columns_transformed = torch.empty(
        rows.n_in, columns.n_out, dtype=column_kernel.dtype, device=work.device
    )
    for start, stop in row_chunks(rows.n_in, columns.n_in):
        planes = work.take("planes", 2, stop - start, columns.n_in)
        source(start, stop, planes)
        torch.mm(
            torch.complex(planes[0], planes[1]),
            column_kernel.T,
            out=columns_transformed[start:stop],
        )
    columns_transformed = columns_transformed.to(row_kernel.dtype)
    for start, stop in row_chunks(rows.n_out, columns.n_out):
        patch = torch.view_as_real(row_kernel[start:stop] @ columns_transformed).movedim(2, 0)
        sink(slice(start, stop), slice(0, columns.n_out), patch)


def folded(rows: Axis, columns: Axis, source: Source, sink: Sink, work: Workspace) -> None:
    """Transform the even and odd parts of the field by real matrix products, with a quarter of the
    operations of `direct`.
    """
    last_kind = last_type(columns.n_in, rows.n_out, work.dtype)
    column_kernels, row_kernels = (
        _half_kernels(columns, work.dtype, work.device),
        _half_kernels(rows, last_kind, work.device),
    )
    columns_transformed = work.take("half", 2, rows.n_in, columns.n_out)
    for start, stop in row_chunks(rows.n_in, columns.n_in):
        planes = work.take("planes", 2, stop - start, columns.n_in)
        source(start, stop, planes)
        even, odd = _even_and_odd(planes, columns.n_in)
        _write_halves(
            even @ column_kernels[0].T,
            odd @ column_kernels[1].T,
            columns,
            columns_transformed[:, start:stop],
        )
    even, odd = _even_and_odd(columns_transformed.transpose(1, 2).to(last_kind), rows.n_in)
    for start, stop in row_chunks(columns.n_out, 4 * rows.n_out):
        patch = work.take("patch", 2, stop - start, rows.n_out, dtype=last_kind)
        _write_halves(
            even[:, start:stop] @ row_kernels[0].T,
            odd[:, start:stop] @ row_kernels[1].T,
            rows,
            patch,
        )
        sink(slice(0, rows.n_out), slice(start, stop), patch.transpose(1, 2))


def _kernel(axis: Axis, dtype: torch.dtype, device: torch.device) -> Tensor:
    """Return the kernel (output, input) exp(sign 2 pi i alpha j k) of one axis."""
    turns = torch.outer(centred(axis.n_out, device), centred(axis.n_in, device))
    return unit_phasor(turns.mul_(axis.sign * axis.alpha), dtype)


def _half_kernels(axis: Axis, dtype: torch.dtype, device: torch.device) -> tuple[Tensor, Tensor]:
    """Return the cosines and signed sines of the Fourier kernel on the half grids j >= 0, k >= 0.

    The cosine is halved at a sample on the axis, which both halves of the field contain.
    """
    input_samples, output_samples = (
        centred(axis.n_in, device)[axis.n_in // 2 :],
        centred(axis.n_out, device)[axis.n_out // 2 :],
    )
    angle = radians(torch.outer(output_samples, input_samples).mul_(axis.alpha))
    cosine, sine = angle.cos().to(dtype), angle.sin().mul_(axis.sign).to(dtype)
    if axis.n_in % 2:
        cosine[:, 0] /= 2
    return cosine, sine


def _even_and_odd(field: Tensor, n: int) -> tuple[Tensor, Tensor]:
    """Return the even and the odd part of a field of ``n`` samples along the last axis, on its
    upper half.
    """
    upper_half, mirrored_lower_half = field[..., n // 2 :], field[..., : (n + 1) // 2].flip(-1)
    return upper_half + mirrored_lower_half, upper_half - mirrored_lower_half


def _write_halves(even: Tensor, odd: Tensor, axis: Axis, out: Tensor) -> None:
    """Write even(k) + i odd(k) and its mirror image to the halves of ``out``; all tensors are
    (re, im) planes.
    """
    output_count = axis.n_out
    lower_count = (output_count + 1) // 2
    mirror_image = torch.stack((even[0] + odd[1], even[1] - odd[0]))
    out[..., :lower_count] = mirror_image.flip(-1)
    torch.sub(even[0], odd[1], out=out[0, ..., output_count // 2 :])
    torch.add(even[1], odd[0], out=out[1, ..., output_count // 2 :])


# --- scaled transform -----------------------------------------------------------------------------

# The scaled Fourier transform between two grids of any pitch, and the choice of the fastest method.


Method = Literal["auto", "direct", "folded", "bluestein", "kaiser_bessel"]
#: below this time-bandwidth product the banded products are too few and too long to be fast
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
    chirp_samples = rows.n_in * fft_length(
        columns.n_in + columns.n_out
    ) + columns.n_out * fft_length(rows.n_in + rows.n_out)
    information = rows.bandwidth * columns.bandwidth
    few_samples = min(rows.bandwidth, columns.bandwidth) < _FEW_SAMPLES
    return {
        # measured: a constant, plus seconds for each product or sample
        "direct": 0.15e-3 + 57e-12 * products,
        "folded": 0.3e-3 + 0.3e-9 * n_in + 14e-12 * products,
        "bluestein": 0.15e-3 + 3.5e-9 * chirp_samples,
        "kaiser_bessel": 0.5e-3
        + (2.4e-9 if few_samples else 1.2e-9) * n_in
        + 35e-9 * information
        + 3e-9 * n_out,
    }


class Grids(NamedTuple):
    """Pitch and centres of the grids of a field and of its transform, along both axes."""

    alpha: tuple[float, float]  #: turns of phase per input sample and output sample
    centre_in: tuple[float, float]  #: centre of the field in samples; any real number
    centre_out: tuple[float, float]  #: centre of the transform in samples; any real number
    sign: int = -1  #: sign of the exponent


def transform(
    field: Tensor,
    shape: tuple[int, int],
    grids: Grids,
    method: Method = "auto",
) -> Tensor:
    """Return ``U = K_y P K_x^T`` with kernels ``exp(sign 2 pi i alpha (j - centre_in) (k -
    centre_out))`` on each axis.

    The field is complex64 or complex128, of any shape (v, u). Both centres may lie between
    samples or outside the grid. Phases are computed in float64 and reduced to half a turn before a
    cast.
    """
    axes = [
        Axis(n, k, a, grids.sign) for n, k, a in zip(field.shape, shape, grids.alpha, strict=True)
    ]
    real_type = field.real.dtype
    # the shifts of both centres are phase factors before and after a transform about the middles
    phasors_before, phasors_after = _centre_phasors(axes, grids, real_type, field.device)
    out = torch.empty(shape, dtype=field.dtype, device=field.device)

    def source(start: int, stop: int, into: Tensor) -> None:
        into.copy_(
            torch.view_as_real(
                (field[start:stop] * phasors_before[1]).mul_(phasors_before[0][start:stop, None])
            ).movedim(2, 0)
        )

    def sink(rows: slice, columns: slice, patch: Tensor) -> None:
        patch_view(torch.view_as_real(out).movedim(2, 0), rows, columns, patch).copy_(patch)

    with borrowed(real_type, field.device) as work:
        propagate(axes[0], axes[1], source, sink, work, method)
    return out.mul_(phasors_after[0][:, None]).mul_(phasors_after[1])


def _centre_phasors(
    axes: list[Axis], grids: Grids, real: torch.dtype, device: torch.device
) -> tuple[list[Tensor], list[Tensor]]:
    """Return the phasors before and after a Fourier transform about the middles that shift its
    centres to the given ones.
    """
    before, after = [], []
    for axis, input_centre, output_centre in zip(
        axes, grids.centre_in, grids.centre_out, strict=True
    ):
        input_shift, output_shift = (
            (axis.n_in - 1) / 2 - input_centre,
            (axis.n_out - 1) / 2 - output_centre,
        )
        signed_alpha = axis.sign * axis.alpha
        before.append(unit_phasor(centred(axis.n_in, device) * (signed_alpha * output_shift), real))
        after.append(
            unit_phasor(
                (centred(axis.n_out, device) + output_shift) * (signed_alpha * input_shift), real
            )
        )
    return before, after
