"""The selective scan: a linear recurrence whose step, input and output depend on the position."""

import os
from typing import Literal, get_args

import torch
from torch import Tensor

from neusee.nodes.restore._scan import _cpp_scan, _torch_scan

#: both backends differ only within rounding, but NEUSEE_SCAN chooses one for all
__depends__ = ("env:NEUSEE_SCAN",)
Backend = Literal["torch", "cpp"]


def selective_scan(
    u: Tensor,
    dt: Tensor,
    A: Tensor,
    B: Tensor,
    C: Tensor,
    D: Tensor | None = None,
    *,
    backend: Literal["auto", "torch", "cpp"] = "auto",
) -> Tensor:
    """Run the scan h_t = exp(dt_t A) h_(t-1) + dt_t B_t u_t from h = 0, and return y_t = <C_t, h_t>
    + D u_t.

    ``A`` is negative and ``dt`` positive: decays are at most 1 and are only multiplied, so nothing
    overflows at any length. ``backend`` "auto" is C++ on a CPU with a compiler, and torch in all
    other cases. ``NEUSEE_SCAN=torch`` selects torch everywhere. The scan is differentiable once: a
    gradient of its gradient raises an error.

    Shapes: u, dt (batch, length, d), A (d, n), B, C (batch, length, n), D (d) -> (batch, length,
            d).
    Units:  none; dt in those of 1 / A.
    Error:  float32, also from half precision and under autocast: of the largest |y|, over 65 536
            steps and for dt |A| from 1e-6 to 200, 2e-7 in C++, 7e-7 in torch. float64 if any input
            is float64: 1e-12.
    Raises: ValueError for shapes that do not fit and for a backend that these tensors, or this
            machine, do not support.
    Source: Gu and Dao, Mamba: Linear-Time Sequence Modeling with Selective State Spaces, 2023,
            algorithm 2.
    """
    _check_shapes(u, dt, A, B, C, D)
    kind = _kind(u, dt, A, B, C)
    backend_used = _auto(u) if backend == "auto" else backend
    with torch.autocast(u.device.type, enabled=False):
        y = _run(backend_used, *(x.to(kind) for x in (u, dt, A, B, C)))
        return y if D is None else torch.addcmul(y, D.to(kind), u.to(kind))


def reference(
    u: Tensor, dt: Tensor, A: Tensor, B: Tensor, C: Tensor, D: Tensor | None = None
) -> Tensor:
    """Compute the selective scan by a loop over positions in float64, a slow reference with all
    derivatives.

    Shapes: as `selective_scan`.
    """
    _check_shapes(u, dt, A, B, C, D)
    u, dt, A, B, C = (x.double() for x in (u, dt, A, B, C))
    states, outputs = u.new_zeros(u.shape[0], *A.shape), []
    # unbind, because the gradient of an indexed row is as long as all rows
    for step_input, step, input_weight, output_weight in zip(
        (dt * u).unbind(1), dt.unbind(1), B.unbind(1), C.unbind(1), strict=True
    ):
        states = (
            torch.exp(step[..., None] * A) * states + step_input[..., None] * input_weight[:, None]
        )
        outputs.append((states @ output_weight[..., None])[..., 0])
    y = torch.stack(outputs, 1)
    return y if D is None else y + D.double() * u


def _check_shapes(u: Tensor, dt: Tensor, A: Tensor, B: Tensor, C: Tensor, D: Tensor | None) -> None:
    """Raise ValueError unless u, dt (batch, length, d), A (d, n), B, C (batch, length, n) and D
    (d,) fit each other and lie on one device.
    """
    if u.ndim != 3 or A.ndim != 2:
        raise ValueError(
            f"u must be (batch, length, d) and A (d, n), not {tuple(u.shape)} and {tuple(A.shape)}"
        )
    if not (u.numel() and A.numel()):
        raise ValueError(
            f"there is nothing to scan: u is {tuple(u.shape)} and A is {tuple(A.shape)}"
        )
    (*line, d), n = u.shape, A.shape[1]
    shapes = {"dt": (*line, d), "A": (d, n), "B": (*line, n), "C": (*line, n), "D": (d,)}
    for (name, shape), x in zip(shapes.items(), (dt, A, B, C, D), strict=True):
        if x is None:
            continue
        if tuple(x.shape) != shape:
            raise ValueError(
                f"{name} is {tuple(x.shape)}; u {tuple(u.shape)} and A {tuple(A.shape)} need"
                f" {shape}"
            )
        if x.device != u.device:
            raise ValueError(
                f"{name} is on {x.device}, but u is on {u.device}: move both to one device"
            )


def _kind(*tensors: Tensor) -> torch.dtype:
    """Return float64 if any tensor is, else float32; raise ValueError for numbers not in floating
    point.
    """
    for x in tensors:
        if not x.is_floating_point():
            raise ValueError(
                f"the selective scan needs real numbers in floating point, not {x.dtype}"
            )
    return torch.float64 if any(x.dtype == torch.float64 for x in tensors) else torch.float32


def _auto(u: Tensor) -> Backend:
    """Return the backend that the variable NEUSEE_SCAN names, else the C++ one on a CPU if it can
    be compiled.
    """
    backend_named = os.environ.get("NEUSEE_SCAN") or ""
    if backend_named not in ("", *get_args(Backend)):
        raise ValueError(f"NEUSEE_SCAN is {backend_named!r}: write torch or cpp")
    if backend_named == "torch" or u.device.type != "cpu":
        return "torch"
    return "cpp" if _cpp_scan.compiled() else "torch"


def _run(backend: str, u: Tensor, dt: Tensor, A: Tensor, B: Tensor, C: Tensor) -> Tensor:
    """Return the scan (batch, length, d) without the term of D, by the named backend."""
    if backend not in get_args(Backend):
        raise ValueError(f"backend is {backend!r}: write auto, {', '.join(get_args(Backend))}")
    if backend == "cpp" and u.device.type != "cpu":
        raise ValueError(f"the backend cpp is for the CPU, but u is on {u.device}")
    scan = _cpp_scan.Scan if backend == "cpp" and _cpp_scan.compiled() else _torch_scan.Scan
    y: Tensor = scan.apply(u, dt, A, B, C)  # type: ignore[no-untyped-call]
    return y
