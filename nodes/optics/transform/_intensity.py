"""Intensity of the PSF with an explicit gradient, which recomputes the field in the pupil to save
memory.
"""

import math
from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any, Literal

import torch
from torch import Tensor
from torch.autograd.forward_ad import unpack_dual

from neusee.nodes.optics.transform._fused import FusedPupil, available, operators
from neusee.nodes.optics.transform._pupil_field import Field, Screens, View, refuse_too_many_turns
from neusee.nodes.optics.transform._sample_axis import Workspace, borrowed, patch_view
from neusee.nodes.optics.transform._scaled_transform import Method, propagate
from neusee.nodes.precision import one_by_one, transformed

_NO_SECOND_DERIVATIVE = (
    "the PSF has no second derivative here: differentiate without create_graph=True"
)
KEPT_FIELD_BYTES = 1 << 30  #: largest size in bytes of focal fields stored for back-propagation


@dataclass(frozen=True, slots=True)
class Sampling:
    """The grids of focal points, and the precision and method of the transform from the pupil to
    these grids.
    """

    views: tuple[View, ...]
    dtype: torch.dtype
    method: Method | Literal["fused"] = "auto"
    #: focal fields are stored for back-propagation, if they fit in `KEPT_FIELD_BYTES`
    keep: bool = True

    @property
    def by_torch(self) -> Method:
        """Return the transform method in torch, for computations without the fused C++ code."""
        return "auto" if self.method == "fused" else self.method

    def fused(self, device: torch.device) -> bool:
        """Return True if the C++ code computes intensity and gradient.

        Where it can be compiled, it does for every size and instruction set: it was faster than
        torch in each row of tests/benchmarks/bench_vectors.py, and its bits are the same in all.
        Raise NoCompilerError if the method is "fused" and the C++ code cannot be compiled.
        """
        if self.method == "fused":
            operators()
        return self.method == "fused" or (self.method == "auto" and available(device))


def intensity_of(amplitude: Tensor, height: Tensor, path: Tensor, sampling: Sampling) -> Tensor:
    """Return the intensity of the PSF, differentiable by back-propagation and by the transforms
    of `torch.func`.
    """
    factors = amplitude, height, path
    if not _is_differentiated(factors):
        return _intensity_and_fields(Screens.of(*factors), sampling, False)[0]
    form = _Transformed if transformed() else PupilIntensity
    result: Tensor = form.apply(*factors, sampling)  # type: ignore[no-untyped-call]
    return result


def _is_differentiated(factors: Sequence[Tensor]) -> bool:
    """Return True if a derivative with respect to one of the factors may be asked for."""
    return (
        transformed()
        or any(unpack_dual(x).tangent is not None for x in factors)  # type: ignore[no-untyped-call]
        or (torch.is_grad_enabled() and any(x.requires_grad for x in factors))
    )


class PupilIntensity(torch.autograd.Function):
    """The PSF intensity ``sum over views of weight * envelope * |U|^2``; its gradient uses the
    adjoint transform.
    """

    @staticmethod
    def forward(
        ctx: Any, amplitude: Tensor, height: Tensor, path: Tensor, sampling: Sampling
    ) -> Tensor:
        screens = Screens.of(amplitude, height, path)
        intensity, fields = _intensity_and_fields(screens, sampling, any(ctx.needs_input_grad))
        # saved tensors are freed with the graph, even if a result still refers to this node
        ctx.save_for_backward(
            amplitude, height, path, *(field for field in fields if field is not None)
        )
        ctx.sampling, ctx.screens = sampling, screens[3:]
        return intensity

    @staticmethod
    def backward(ctx: Any, weight: Tensor) -> tuple[Tensor | None, ...]:
        if torch.is_grad_enabled():
            raise RuntimeError(_NO_SECOND_DERIVATIVE)
        amplitude, height, path, *fields = ctx.saved_tensors
        screens = Screens(amplitude, height, path, *ctx.screens)
        fields = fields or [None] * len(ctx.sampling.views)
        return (*_gradients(weight, screens, ctx.sampling, fields, ctx.needs_input_grad[:3]), None)


class _Transformed(torch.autograd.Function):
    """The PSF intensity for `torch.func`, differentiable once and without stored focal fields."""

    @staticmethod
    def forward(amplitude: Tensor, height: Tensor, path: Tensor, sampling: Sampling) -> Tensor:
        return _intensity_and_fields(Screens.of(amplitude, height, path), sampling, False)[0]

    @staticmethod
    def setup_context(ctx: Any, inputs: tuple[Any, ...], output: Tensor) -> None:
        ctx.save_for_backward(*inputs[:3])
        ctx.save_for_forward(*inputs[:3])
        ctx.sampling = inputs[3]

    @staticmethod
    def backward(ctx: Any, weight: Tensor) -> tuple[Tensor | None, ...]:
        return (*_Gradient.apply(weight, *ctx.saved_tensors, ctx.sampling), None)  # type: ignore[no-untyped-call]

    @staticmethod
    def jvp(ctx: Any, *tangents: Tensor | None) -> Any:
        saved = ctx.saved_tensors
        pushed = [
            torch.zeros_like(x) if t is None else t for x, t in zip(saved, tangents, strict=False)
        ]
        return _Tangent.apply(*saved, *pushed, ctx.sampling)  # type: ignore[no-untyped-call]

    @staticmethod
    def vmap(info: Any, in_dims: tuple[int | None, ...], *inputs: Any) -> Any:
        return one_by_one(_Transformed.apply, info.batch_size, in_dims, inputs)


class _FirstDerivative(torch.autograd.Function):
    """A first derivative for `torch.func`; a second derivative raises an error."""

    @staticmethod
    def setup_context(ctx: Any, inputs: tuple[Any, ...], output: Any) -> None:
        pass

    @staticmethod
    def backward(ctx: Any, *grads: Tensor) -> Any:
        raise RuntimeError(_NO_SECOND_DERIVATIVE)

    @staticmethod
    def jvp(ctx: Any, *tangents: Tensor | None) -> Any:
        raise RuntimeError(_NO_SECOND_DERIVATIVE)


class _Tangent(_FirstDerivative):
    """The change of the PSF intensity for small changes of amplitude, height and path (forward
    mode).
    """

    @staticmethod
    def forward(*inputs: Any) -> Tensor:
        return _intensity_change(Screens.of(*inputs[:3]), inputs[3:6], inputs[6])

    @staticmethod
    def vmap(info: Any, in_dims: tuple[int | None, ...], *inputs: Any) -> Any:
        return one_by_one(_Tangent.apply, info.batch_size, in_dims, inputs)


class _Gradient(_FirstDerivative):
    """The gradients of the PSF intensity for amplitude, height and path (reverse mode)."""

    @staticmethod
    def forward(
        weight: Tensor, amplitude: Tensor, height: Tensor, path: Tensor, sampling: Sampling
    ) -> Any:
        fields = [None] * len(sampling.views)
        return tuple(
            _gradients(
                weight, Screens.of(amplitude, height, path), sampling, fields, (True, True, True)
            )
        )

    @staticmethod
    def vmap(info: Any, in_dims: tuple[int | None, ...], *inputs: Any) -> Any:
        return one_by_one(_Gradient.apply, info.batch_size, in_dims, inputs)


def _intensity_and_fields(
    screens: Screens, sampling: Sampling, keep: bool
) -> tuple[Tensor, list[Tensor | None]]:
    """Return the PSF intensity, and the focal field of each view, or None for a field that is not
    stored.
    """
    refuse_too_many_turns(screens, sampling.views)
    views, shape = sampling.views, (sampling.views[0].rows.n_out, sampling.views[0].columns.n_out)
    device, fields, last_band = screens.height.device, list[Tensor | None](), -1
    intensity = torch.empty(views[-1].band + 1, *shape, dtype=sampling.dtype, device=device)
    # real and imaginary part: twice the bytes of the intensity of each view
    keep = keep and sampling.keep and 2 * len(views) * intensity[0].nbytes <= KEPT_FIELD_BYTES
    fused = sampling.fused(device)
    with borrowed(sampling.dtype, device) as work:
        pupil = FusedPupil(screens, sampling.dtype, work) if fused else None
        for view in views:
            focal_field = (
                # torch stores the field transposed, the C++ code does not
                torch.empty(2, *shape[:: 1 if fused else -1], dtype=sampling.dtype, device=device)
                if keep
                else None
            )
            if pupil is not None:
                pupil.forward(view, intensity[view.band], view.band == last_band, focal_field)
            else:
                field = Field(screens, view, sampling.dtype)
                _write_intensity(
                    field,
                    intensity[view.band],
                    view.band == last_band,
                    focal_field,
                    sampling.by_torch,
                    work,
                )
            fields.append(focal_field)
            last_band = view.band
    return intensity, fields


def _gradients(
    weight: Tensor,
    screens: Screens,
    sampling: Sampling,
    fields: Sequence[Tensor | None],
    needs: Sequence[bool],
) -> list[Tensor | None]:
    """Return the gradients with respect to amplitude, height and path, each only if autograd
    requests the gradient.

    A focal field that was not stored is computed again.
    """
    grads = [
        torch.zeros_like(x) if need else None for x, need in zip(screens[:3], needs, strict=True)
    ]
    with borrowed(weight.dtype, weight.device) as work:
        if sampling.fused(weight.device):
            FusedPupil(screens, weight.dtype, work).add_gradients(
                sampling.views, weight, fields, grads
            )
            return grads
        for view, focal in zip(sampling.views, fields, strict=True):
            field = Field(screens, view, weight.dtype)
            planes = focal if focal is not None else _focal_field(field, sampling, work)
            _add_gradient(field, planes, weight[view.band], grads, sampling.by_torch, work)
    return grads


def _intensity_change(screens: Screens, tangents: Sequence[Tensor], sampling: Sampling) -> Tensor:
    """Return the change of the PSF intensity, 2 Re(U* dU), for changes ``tangents`` of
    amplitude, height and path.
    """
    views, shape = sampling.views, (sampling.views[0].rows.n_out, sampling.views[0].columns.n_out)
    change = torch.zeros(
        views[-1].band + 1, *shape, dtype=sampling.dtype, device=screens.height.device
    )
    with borrowed(sampling.dtype, change.device) as work:
        for view in views:
            field = Field(screens, view, sampling.dtype)
            planes = _focal_field(field, sampling, work)
            _add_change(field, tangents, planes, change[view.band], sampling.by_torch, work)
    return change


def _add_change(
    field: Field,
    tangents: Sequence[Tensor],
    planes: Tensor,
    change: Tensor,
    method: Method,
    work: Workspace,
) -> None:
    """Add the change of the weighted intensity of one view to ``change``, given the focal field
    ``planes``.
    """

    def source(start: int, stop: int, out: Tensor) -> None:
        rows, all_columns = slice(start, stop), slice(0, out.shape[2])
        phasor = work.take("unit", *out.shape)
        field.phasor(rows, all_columns, phasor, work)
        amplitude, height, path = (x[rows].to(out.dtype) for x in tangents)
        phase_change = field.view.turns_height * height + field.view.turns_path * path
        phase_change = phase_change.mul_(2 * math.pi).mul_(field.screens.amplitude[rows])
        # d(a e^(i t)) = e^(i t) (da + i a dt), in real and imaginary parts
        torch.mul(phasor[0], amplitude, out=out[0]).addcmul_(phasor[1], phase_change, value=-1)
        torch.mul(phasor[1], amplitude, out=out[1]).addcmul_(phasor[0], phase_change)

    def sink(rows: slice, columns: slice, patch: Tensor) -> None:
        focal_patch = patch_view(planes.transpose(1, 2), rows, columns, patch)
        patch_view(change, rows, columns, patch).add_(
            _weigh(field.view, (2 * focal_patch * patch).sum(0), rows, columns)
        )

    propagate(field.view.rows, field.view.columns, source, sink, work, method)


def _weigh(view: View, values: Tensor, rows: slice, columns: slice) -> Tensor:
    """Multiply ``values`` on one patch of the focal plane, in place, by the weight and the
    envelope of the view.
    """
    if view.envelope is None:
        return values.mul_(view.weight)
    row_envelope, column_envelope = view.envelope
    return (
        values.mul_(row_envelope[rows].view(*values.shape[:-1], 1))
        .mul_(column_envelope[columns])
        .mul_(view.weight)
    )


def _write_intensity(
    field: Field, out: Tensor, add: bool, focal: Tensor | None, method: Method, work: Workspace
) -> None:
    """Write the weighted intensity |U|^2 of one window of the focal plane to ``out``, or add it
    to ``out``.
    """

    def sink(rows: slice, columns: slice, patch: Tensor) -> None:
        if focal is not None:
            _store_focal(focal, rows, columns, patch)
        intensity = _weigh(
            field.view, patch[0].square().addcmul_(patch[1], patch[1]), rows, columns
        )
        target = patch_view(out, rows, columns, patch)
        target.add_(intensity) if add else target.copy_(intensity)

    propagate(field.view.rows, field.view.columns, field.rows(work), sink, work, method)


def _store_focal(focal: Tensor, rows: slice, columns: slice, patch: Tensor) -> None:
    """Store a patch of the focal field transposed, the memory layout of the fastest transform
    and its adjoint.
    """
    patch_view(focal.transpose(1, 2), rows, columns, patch).copy_(patch)


def _focal_field(field: Field, sampling: Sampling, work: Workspace) -> Tensor:
    """Compute the focal field of a view again for back-propagation, and return the transposed
    field.
    """
    view = field.view
    planes = work.take("focal", 2, view.columns.n_out, view.rows.n_out)

    def sink(rows: slice, columns: slice, patch: Tensor) -> None:
        _store_focal(planes, rows, columns, patch)

    propagate(view.rows, view.columns, field.rows(work), sink, work, sampling.by_torch)
    return planes


def _add_gradient(
    field: Field,
    planes: Tensor,
    weight: Tensor,
    grads: list[Tensor | None],
    method: Method,
    work: Workspace,
) -> None:
    """Add the gradients of ``sum(weight * |U|^2)`` to ``grads`` by the adjoint transform of 2
    weight U.

    The transform runs on the transposed problem, so that its result comes back in rows of the
    pupil.
    """
    view, all_rows = field.view, slice(0, planes.shape[2])
    # copied at once: slabs with a power of two as side are slow
    transposed_weight = work.take("gain", *planes.shape[1:]).copy_(weight.T)

    def source(start: int, stop: int, out: Tensor) -> None:
        _weigh(view, transposed_weight[start:stop].mul_(2).T, all_rows, slice(start, stop))
        torch.mul(planes[:, start:stop], transposed_weight[start:stop], out=out)

    def sink(rows: slice, columns: slice, patch: Tensor) -> None:
        pupil_patch = work.take("flat", 2, columns.stop - columns.start, rows.stop - rows.start)
        patch_view(pupil_patch.transpose(1, 2), slice(None), slice(None), patch).copy_(patch)
        _add_factor_gradients(field, columns, rows, pupil_patch, grads, work)

    propagate(view.columns.adjoint(), view.rows.adjoint(), source, sink, work, method)


def _add_factor_gradients(
    field: Field,
    rows: slice,
    columns: slice,
    patch: Tensor,
    grads: list[Tensor | None],
    work: Workspace,
) -> None:
    """Add the gradients of amplitude, height and path by the chain rule, given the gradient
    ``patch`` of the field.
    """
    phasor = work.take("unit", *patch.shape)
    field.phasor(rows, columns, phasor, work)
    if grads[0] is not None:
        grads[0][rows, columns].addcmul_(phasor[0], patch[0]).addcmul_(phasor[1], patch[1])
    if grads[1] is None and grads[2] is None:
        return
    phase_gradient = torch.mul(phasor[0], patch[1], out=work.take("turning", *patch.shape[1:]))
    # gradient of the phase: amplitude x Im(conj(phasor) x gradient of the field)
    phase_gradient.addcmul_(phasor[1], patch[0], value=-1).mul_(
        field.screens.amplitude[rows, columns]
    )
    for grad, turns in ((grads[1], field.view.turns_height), (grads[2], field.view.turns_path)):
        if grad is not None:
            grad[rows, columns].add_(phase_gradient, alpha=2 * math.pi * turns)
