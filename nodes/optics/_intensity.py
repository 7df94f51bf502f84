"""Pupil to intensity, with the gradient written by hand: little is kept, the pupil's field is computed again."""

import math
from dataclasses import dataclass
from typing import Any

import torch
from torch import Tensor
from torch.autograd.function import once_differentiable

from neusee.nodes.optics._axis import Axis, Source, centred
from neusee.nodes.optics._transform import Method, propagate
from neusee.nodes.optics._workspace import Workspace, borrowed

KEPT_FIELD_BYTES = 1 << 29  #: focal fields up to this size wait for the backward pass; larger ones are computed again


@dataclass(frozen=True, slots=True)
class View:
    """One window of point samples in one band. ``|U|^2`` is weighed by ``weight`` and by ``envelope_y envelope_x``."""

    band: int
    rows: Axis
    columns: Axis
    turns_height: float  #: turns of phase per metre of height
    turns_path: float  #: turns of phase per metre of path
    tilt: tuple[float, float]  #: turns per pupil sample (v, u) that move the window onto the spot
    weight: float
    envelope: tuple[Tensor, Tensor] | None = None


@dataclass(frozen=True, slots=True)
class Sampling:
    """All views, the type and the method they are computed with."""

    views: tuple[View, ...]
    dtype: torch.dtype
    method: Method = "auto"


class Field:
    """The pupil of one view, row by row: amplitude * exp(2 pi i (height + path + tilt))."""

    def __init__(self, amplitude: Tensor, height: Tensor, path: Tensor, view: View) -> None:
        self.amplitude, self.height, self.path, self.view = amplitude, height, path, view
        rows, columns = (centred(n, height.device) for n in height.shape)
        self.tilt_v, self.tilt_u = rows.mul_(view.tilt[0])[:, None], columns.mul_(view.tilt[1])

    def phasor(self, start: int, stop: int, planes: Tensor, work: Workspace) -> None:
        """Write cosine and sine of rows start..stop, from float64 turns reduced to half a turn."""
        shape = stop - start, self.height.shape[1]
        turns = work.take("turns", *shape, dtype=torch.float64)
        torch.mul(self.height[start:stop], self.view.turns_height, out=turns)
        turns.add_(self.path[start:stop], alpha=self.view.turns_path).add_(self.tilt_u).add_(self.tilt_v[start:stop])
        angle = work.take("angle", *shape)
        torch.mul(turns.sub_(turns.round()), 2 * math.pi, out=angle)
        torch.cos(angle, out=planes[0])
        torch.sin(angle, out=planes[1])

    def rows(self, work: Workspace) -> Source:
        """The field as a source for a transform."""

        def fill(start: int, stop: int, planes: Tensor) -> None:
            self.phasor(start, stop, planes, work)
            planes.mul_(self.amplitude[start:stop])

        return fill


class PupilIntensity(torch.autograd.Function):
    """``sum over views of weight * envelope * |U|^2``; the backward pass is the adjoint transform of g U."""

    @staticmethod
    def forward(ctx: Any, amplitude: Tensor, height: Tensor, path: Tensor, sampling: Sampling) -> Tensor:
        views, shape = sampling.views, (sampling.views[0].rows.n_out, sampling.views[0].columns.n_out)
        intensity = torch.zeros(views[-1].band + 1, *shape, dtype=sampling.dtype, device=height.device)
        keep = any(ctx.needs_input_grad) and len(views) * shape[0] * shape[1] * 8 <= KEPT_FIELD_BYTES
        ctx.fields = []
        with borrowed(sampling.dtype, height.device) as work:
            for view in views:
                field = Field(amplitude, height, path, view)
                kept = torch.empty(2, *shape, dtype=sampling.dtype, device=height.device) if keep else None
                _add_intensity(field, intensity[view.band], kept, sampling.method, work)
                ctx.fields.append(kept)
        ctx.save_for_backward(amplitude, height, path)
        ctx.sampling = sampling
        return intensity

    @staticmethod
    @once_differentiable  # type: ignore[untyped-decorator]
    def backward(ctx: Any, weight: Tensor) -> tuple[Tensor | None, ...]:
        amplitude, height, path = ctx.saved_tensors
        grads = [
            torch.zeros_like(x) if need else None
            for x, need in zip(ctx.saved_tensors, ctx.needs_input_grad[:3], strict=True)
        ]
        with borrowed(weight.dtype, weight.device) as work:
            for view, kept in zip(ctx.sampling.views, ctx.fields, strict=True):
                field = Field(amplitude, height, path, view)
                planes = kept if kept is not None else _focal(field, ctx.sampling, work)
                _add_gradient(field, planes, weight[view.band], grads, ctx.sampling.method, work)
        return (*grads, None)


def _scaled(view: View, values: Tensor, rows: slice, columns: slice) -> Tensor:
    """``values`` times what the view weighs |U|^2 with, on one patch."""
    if view.envelope is None:
        return values.mul_(view.weight)
    y, x = view.envelope
    return values.mul_(y[rows, None]).mul_(x[columns]).mul_(view.weight)


def _add_intensity(field: Field, out: Tensor, kept: Tensor | None, method: Method, work: Workspace) -> None:
    def sink(rows: slice, columns: slice, patch: Tensor) -> None:
        if kept is not None:
            kept[:, rows, columns] = patch
        power = work.take("power", *patch.shape[1:])
        torch.mul(patch[0], patch[0], out=power).addcmul_(patch[1], patch[1])
        out[rows, columns] += _scaled(field.view, power, rows, columns)

    propagate(field.view.rows, field.view.columns, field.rows(work), sink, work, method)


def _focal(field: Field, sampling: Sampling, work: Workspace) -> Tensor:
    view = field.view
    planes = work.take("focal", 2, view.rows.n_out, view.columns.n_out)

    def sink(rows: slice, columns: slice, patch: Tensor) -> None:
        planes[:, rows, columns] = patch

    propagate(view.rows, view.columns, field.rows(work), sink, work, sampling.method)
    return planes


def _add_gradient(
    field: Field, planes: Tensor, weight: Tensor, grads: list[Tensor | None], method: Method, work: Workspace
) -> None:
    """Add the gradients of ``sum(weight * scaled |U|^2)``: the adjoint of 2 weight U, against the pupil."""
    view, everywhere = field.view, slice(0, planes.shape[2])

    def source(start: int, stop: int, out: Tensor) -> None:
        gain = torch.mul(weight[start:stop], 2.0, out=work.take("gain", stop - start, planes.shape[2]))
        torch.mul(planes[:, start:stop], _scaled(view, gain, slice(start, stop), everywhere), out=out)

    def sink(rows: slice, columns: slice, patch: Tensor) -> None:
        _chain(field, rows, columns, patch, grads, work)

    propagate(view.rows.adjoint(), view.columns.adjoint(), source, sink, work, method)


def _chain(
    field: Field, rows: slice, columns: slice, patch: Tensor, grads: list[Tensor | None], work: Workspace
) -> None:
    """From the gradient with respect to the field, ``patch``, to amplitude, height and path."""
    count = rows.stop - rows.start
    unit = work.take("unit", 2, count, field.height.shape[1])
    field.phasor(rows.start, rows.stop, unit, work)
    unit = unit[:, :, columns]
    if grads[0] is not None:
        grads[0][rows, columns] += unit[0] * patch[0] + unit[1] * patch[1]
    if grads[1] is None and grads[2] is None:
        return
    turning = (unit[0] * patch[1] - unit[1] * patch[0]).mul_(field.amplitude[rows, columns])
    for grad, turns in ((grads[1], field.view.turns_height), (grads[2], field.view.turns_path)):
        if grad is not None:
            grad[rows, columns].add_(turning, alpha=2 * math.pi * turns)
