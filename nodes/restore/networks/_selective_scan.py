"""The selective scan: a linear recurrence whose step, input and output depend on the position.

Two backends compute it: one in torch operations, for any device that torch supports, and one in
C++, which is compiled for the processor of this machine on first use and then reused.
"""

import ctypes
import os
from collections.abc import Iterator
from pathlib import Path
from typing import Any, NamedTuple

import torch
from torch import Tensor
from torch.nn import functional as F

from neusee.nodes import cpp_library

#: the result depends on the C++ source; NEUSEE_SCAN and the number of threads change it only within
#: rounding, but the variable selects one backend for all
__depends__ = (
    "_selective_scan.cpp",
    "env:NEUSEE_SCAN",
    "unaffected:ctypes",
    "unaffected:torch.get_num_threads",
)


def selective_scan(
    u: Tensor,
    dt: Tensor,
    A: Tensor,
    B: Tensor,
    C: Tensor,
    D: Tensor | None = None,
) -> Tensor:
    """Run the scan h_t = exp(dt_t A) h_(t-1) + dt_t B_t u_t from h = 0, and return y_t = <C_t, h_t>
    + D u_t.

    ``A`` is negative and ``dt`` positive: decays are at most 1 and are only multiplied, so nothing
    overflows at any length. The scan runs in C++ on a CPU with a compiler, and in torch in all
    other cases; ``NEUSEE_SCAN=torch`` selects torch everywhere. The scan is differentiable once:
    a gradient of its gradient raises an error.

    Shapes: u, dt (batch, length, d), A (d, n), B, C (batch, length, n), D (d) -> (batch, length,
            d).
    Units:  none; dt in those of 1 / A.
    Error:  float32, also from half precision and under autocast: of the largest |y|, over 65 536
            steps and for dt |A| from 1e-6 to 200, 2e-7 in C++, 7e-7 in torch. float64 if any input
            is float64: 1e-12.
    Raises: ValueError for shapes that do not fit, and for another value of NEUSEE_SCAN than torch
            and cpp.
    Source: Gu and Dao, Mamba: Linear-Time Sequence Modeling with Selective State Spaces, 2023,
            algorithm 2.
    """
    _check_shapes(u, dt, A, B, C, D)
    dtype = _common_dtype(u, dt, A, B, C)
    scan = CppScan if _runs_in_cpp(u) else TorchScan
    with torch.autocast(u.device.type, enabled=False):
        y: Tensor = scan.apply(*(x.to(dtype) for x in (u, dt, A, B, C)))  # type: ignore[no-untyped-call]
        return y if D is None else torch.addcmul(y, D.to(dtype), u.to(dtype))


def reference(
    u: Tensor, dt: Tensor, A: Tensor, B: Tensor, C: Tensor, D: Tensor | None = None
) -> Tensor:
    """Return the selective scan, computed by a loop over positions in float64: a slow reference
    with derivatives of any order.

    Shapes: as `selective_scan`.
    """
    _check_shapes(u, dt, A, B, C, D)
    u, dt, A, B, C = (x.double() for x in (u, dt, A, B, C))
    states, outputs = u.new_zeros(u.shape[0], *A.shape), []
    # `unbind`: the gradient of an indexed row would have the size of all rows
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


def _common_dtype(*tensors: Tensor) -> torch.dtype:
    """Return float64 if any tensor is float64, otherwise float32; raise ValueError for a tensor
    that is not floating-point.
    """
    for x in tensors:
        if not x.is_floating_point():
            raise ValueError(
                f"the selective scan needs real numbers in floating point, not {x.dtype}"
            )
    return torch.float64 if any(x.dtype == torch.float64 for x in tensors) else torch.float32


def _runs_in_cpp(u: Tensor) -> bool:
    """Return True if the tensor is on the CPU and the C++ scan can be compiled, unless NEUSEE_SCAN
    is "torch".
    """
    backend_named = os.environ.get("NEUSEE_SCAN") or ""
    if backend_named not in ("", "torch", "cpp"):
        raise ValueError(f"NEUSEE_SCAN is {backend_named!r}: write torch or cpp")
    return backend_named != "torch" and u.device.type == "cpu" and compiled()


def refuse_twice() -> None:
    """Raise RuntimeError for a second derivative, which would be wrong without notice: the gradient
    has no graph.
    """
    if torch.is_grad_enabled():
        raise RuntimeError(
            "the selective scan has no second derivative: do not use create_graph for a gradient"
            " through the scan"
        )


# --- in torch operations --------------------------------------------------------------------------

# The sequence is divided into segments, and only the states between segments are stored;
# back-propagation computes all other states again. On a processor a segment fits in a cache, and is
# divided into chunks that are scanned in parallel: it takes one tensor operation for each step of a
# chunk, and one more for the carry of each chunk. On a GPU, where the number of operations counts,
# a segment is scanned in pairs of steps, pairs of pairs and so on: some ten operations for each
# doubling of its length. A decay is stored as exp(x) - 1, because the rounding error of a decay
# near 1 would act at each step. The carry between chunks and segments is float64, because a state
# that hardly decays would be rounded at each carry.

#: number of elements in the states of a segment, and in one operation: the fastest on one core for
#: 1536 elements a step, by 3 % over segments twice as long, by a tenth over no chunks. Smaller
#: operations take longer to call than to compute
SEGMENT, ROW = 1 << 17, 1 << 14
SEGMENT_CUDA = 1 << 25  #: elements of a segment on a GPU, 128 MB in float32: chosen, not measured


class ScanPlan(NamedTuple):
    """The division of a sequence into segments of ``chunks`` chunks, each of ``steps`` time
    steps.

    With ``in_pairs`` a segment is one chunk, whose steps are scanned in pairs.
    """

    steps: int
    chunks: int
    in_pairs: bool = False

    @property
    def segment(self) -> int:
        return self.steps * self.chunks


def plan_scan(length: int, width: int, cuda: bool) -> ScanPlan:
    """Return the division into segments and chunks of a sequence of ``length`` time steps with
    ``width`` elements each.
    """
    if cuda:
        return ScanPlan(min(length, max(16, SEGMENT_CUDA // width)), chunks=1, in_pairs=True)
    segment = min(length, max(16, SEGMENT // width))
    chunks = max(1, min(ROW // width, int(segment**0.5)))
    return ScanPlan(-(-segment // chunks), chunks)


class _Segment:
    """The inputs and decays of one segment of a sequence, (step, chunk, batch, d or n), padded with
    time steps of 0.
    """

    def __init__(self, division: ScanPlan, rows: slice, rate: Tensor, *lines: Tensor) -> None:
        """Take ``rows`` from the sequences u, dt, B and C (``lines``), and compute the decays."""
        self.division, self.rows, self.rate = division, rows, rate
        self.size = min(division.segment, lines[0].shape[1] - rows.start)
        self.u, self.dt, self.into, self.out = (self.turn(x) for x in lines)
        self.pushed = self.u * self.dt
        # decay of each step, minus 1
        self.lost = (self.dt[..., None] * rate).expm1_()

    def turn(self, x: Tensor) -> Tensor:
        """Return one segment of a sequence (batch, length, m), rearranged to (step, chunk, batch,
        m).
        """
        segment = F.pad(x[:, self.rows], (0, 0, 0, self.division.segment - self.size)).contiguous()
        return (
            segment.view(len(x), self.division.chunks, self.division.steps, -1)
            .permute(2, 1, 0, 3)
            .contiguous()
        )

    def back(self, x: Tensor) -> Tensor:
        """Return one segment (step, chunk, batch, m), rearranged to (batch, rows, m)."""
        return x.permute(2, 1, 0, 3).flatten(1, 2)[:, : self.size]

    def states(self, start: Tensor) -> tuple[Tensor, Tensor]:
        """Return the state of the scan after each step, from ``start`` (batch, d, n), and the
        last state in float64.
        """
        h = self.pushed[..., None] * self.into[..., None, :]
        if self.division.in_pairs:
            return h, _walk_in_pairs(h, self.lost, start)
        return h, _walk(h, list(self.lost.unbind(0)), start)

    def slopes(self, output_slope: Tensor, end: Tensor) -> tuple[Tensor, Tensor]:
        """Return the gradients with respect to all states of a scan, and with respect to the state
        before the first step, in float64.

        The gradient of a state is the sum of the gradient through its output (``output_slope``) and
        the gradient through the next state (``end`` for the last state).
        """
        state_slopes = output_slope[..., None] * self.out[..., None, :]
        first_decay, *later_decays = self.lost.unbind(0)
        # of each chunk, the first decay of the next one; ``end`` has that of the next segment
        next_first_decay = torch.cat([first_decay[1:], torch.zeros_like(first_decay[:1])])
        if self.division.in_pairs:
            lost_after_step = torch.cat([self.lost[1:], next_first_decay[None]])
            slope_at_first = _walk_in_pairs(state_slopes, lost_after_step, end, back=True)
        else:
            slope_at_first = _walk(
                state_slopes, [next_first_decay, *later_decays[::-1]], end, back=True
            )
        return state_slopes, slope_at_first + first_decay[0] * slope_at_first

    def gradients(self, dy: Tensor, start: Tensor, end: Tensor) -> tuple[Tensor, ...]:
        """Return the gradients with respect to u, dt, B, C (batch, rows, m), A, and the state
        before the first step (batch, d, n).
        """
        output_slope = self.turn(dy)
        (state_values, _), (state_slopes, start_slope) = (
            self.states(start),
            self.slopes(output_slope, end),
        )
        pushed_slope = (state_slopes @ self.into[..., None])[..., 0]
        into_slope, out_slope = (
            factor[..., None, :] @ x
            for factor, x in ((self.pushed, state_slopes), (output_slope, state_values))
        )
        state_slopes[1:] *= state_values[:-1]
        state_slopes[0, 1:] *= state_values[-1, :-1]
        state_slopes[0, 0] *= start
        # from here on, `state_slopes` is the gradient with respect to dt * A
        state_slopes *= torch.mul(self.dt[..., None], self.rate, out=self.lost).exp_()
        dt = (
            torch.mul(state_slopes, self.rate, out=state_values)
            .sum(-1)
            .addcmul_(pushed_slope, self.u)
        )
        rate = state_slopes.mul_(self.dt[..., None]).sum((0, 1, 2))
        line_slopes = (self.dt * pushed_slope, dt, into_slope[..., 0, :], out_slope[..., 0, :])
        return *(self.back(x) for x in line_slopes), rate, start_slope


def _walk(h: Tensor, lost: list[Tensor], start: Tensor, back: bool = False) -> Tensor:
    """Convert the inputs ``h`` (step, chunk, ...) of a scan to states in place, and return the last
    state in float64: h_i <- h_i + (1 + lost_i) h_(i-1).

    The state before the first step is ``start``. With ``back`` the scan runs from the last step to
    the first; ``lost``, (chunk, ...) for each step, is in the order of the scan. Each chunk starts
    from 0, and the state carried over from earlier chunks is added afterwards.
    """
    order = slice(None, None, -1 if back else 1)
    states, growth = h.unbind(0)[order], torch.empty_like(h)
    growth_by_step = growth.unbind(0)[order]
    growth_by_step[0].copy_(lost[0])
    for loss, state_before, state, growth_here, growth_next in zip(
        lost[1:], states, states[1:], growth_by_step, growth_by_step[1:], strict=False
    ):
        state.addcmul_(loss, state_before).add_(state_before)
        # (1 + e)(1 + l) - 1 = e + l + e l, precise near 0
        torch.add(loss, growth_here, out=growth_next).addcmul_(loss, growth_here)
    last_state, last_growth, chunk_starts = (
        states[-1].double(),
        growth_by_step[-1].double(),
        torch.empty_like(states[-1]),
    )
    for chunk in range(h.shape[1])[order]:
        chunk_starts[chunk] = start
        start = (last_state[chunk] + start).addcmul_(last_growth[chunk], start)
    # each state plus the contribution s + l s of the start s of its chunk, with l = growth - 1
    h.addcmul_(growth, chunk_starts).add_(chunk_starts)
    return start


def _walk_in_pairs(h: Tensor, lost: Tensor, start: Tensor, back: bool = False) -> Tensor:
    """Convert the inputs ``h`` (step, 1, ...) of a scan to states in place, as `_walk` does, with
    ``lost`` (step, 1, ...) in the order of the steps, in few operations.
    """
    growth, last = lost.clone(), 0 if back else -1
    _scan_in_pairs(h, growth, back)
    end = (h[last, 0].double() + start).addcmul_(growth[last, 0].double(), start)
    first_state = start.to(h)
    h.addcmul_(growth, first_state).add_(first_state)
    return end


def _scan_in_pairs(h: Tensor, growth: Tensor, back: bool) -> None:
    """Add to each state the decayed state before it, h_i <- h_i + (1 + growth_i) h_(i-1), and
    multiply the decays in ``growth``, all pairs of steps at once and in place; ``back``: h_(i+1).

    The number of products is proportional to the length, as in a loop, and the number of operations
    to its logarithm.
    """
    steps = len(h)
    if steps == 1:
        return
    early, late, single, before_single = _steps_of_pairs(steps, back)
    _add_step(h, growth, late, early)
    _scan_in_pairs(h[late], growth[late], back)
    # the later states of all pairs are complete: one more step gives the others
    _add_step(h, growth, single, before_single)


def _add_step(h: Tensor, growth: Tensor, step: slice, before: slice) -> None:
    """Add the states ``before`` to the states ``step``, and their decay to that of these steps."""
    h[step].addcmul_(growth[step], h[before]).add_(h[before])
    # (1 + e)(1 + l) - 1 = l + l e + e, precise near 0
    growth[step].addcmul_(growth[step], growth[before]).add_(growth[before])


def _steps_of_pairs(steps: int, back: bool) -> tuple[slice, slice, slice, slice]:
    """Return the earlier and the later step of each pair in the order of a scan, the earlier steps
    that follow a pair, and the last step of this pair.

    An odd step that is left over follows the last pair.
    """
    odd = steps % 2
    if back:
        early, late = slice(odd + 1, None, 2), slice(odd, steps - 1, 2)
        return early, late, slice(1 - odd, steps - 1, 2), slice(2 - odd, None, 2)
    early, late = slice(0, steps - odd, 2), slice(1, None, 2)
    return early, late, slice(2, None, 2), slice(1, steps - 1, 2)


def _segments(length: int, division: ScanPlan) -> Iterator[slice]:
    return (slice(i, i + division.segment) for i in range(0, length, division.segment))


class TorchScan(torch.autograd.Function):
    """The selective scan in torch as an autograd function that can be differentiated once.

    u, dt (batch, length, d), A (d, n), B, C (batch, length, n) -> as u.
    """

    @staticmethod
    def forward(ctx: Any, *inputs: Tensor) -> Tensor:
        u, dt, rate, *into_out = inputs
        (batch, length, _), (d, n) = u.shape, rate.shape
        ctx.division = plan_scan(length, batch * d * n, u.is_cuda)
        y, state, starts = (
            torch.empty_like(u),
            u.new_zeros(batch, d, n, dtype=torch.float64),
            list[Tensor](),
        )
        for rows in _segments(length, ctx.division):
            starts.append(state.to(u))
            segment = _Segment(ctx.division, rows, rate, u, dt, *into_out)
            h, state = segment.states(state)
            y[:, rows] = segment.back((h @ segment.out[..., None])[..., 0])
        ctx.save_for_backward(*inputs, torch.stack(starts))
        return y

    @staticmethod
    def backward(ctx: Any, *slopes: Tensor) -> tuple[Tensor, ...]:
        refuse_twice()
        *inputs, starts = ctx.saved_tensors
        u, dt, rate, *into_out = inputs
        du, ddt, dB, dC = (torch.empty_like(x) for x in (u, dt, *into_out))
        end, dA = (
            torch.zeros_like(starts[0], dtype=torch.float64),
            torch.zeros_like(rate, dtype=torch.float64),
        )
        with torch.autocast(u.device.type, enabled=False):
            for rows, start in reversed(
                list(zip(_segments(u.shape[1], ctx.division), starts, strict=True))
            ):
                segment = _Segment(ctx.division, rows, rate, u, dt, *into_out)
                *lines, slope, end = segment.gradients(slopes[0], start, end)
                for gradient, line in zip((du, ddt, dB, dC), lines, strict=True):
                    gradient[:, rows] = line
                dA += slope
        return du, ddt, dA.to(rate), dB, dC


# --- in C++ ---------------------------------------------------------------------------------------

CPP_FILE = Path(__file__).with_name("_selective_scan.cpp")
#: digest of the C++ source. The keys of cached results depend on this file, and through the digest
#: on the C++ source; a test compares both
CPP_DIGEST = "ec3adefd9b3ec78c"
TYPE_NAMES = {torch.float32: "f32", torch.float64: "f64"}


def operators() -> ctypes.CDLL:
    """Return the library of the C++ scan, compiled if needed; raise `NoCompilerError` if it
    cannot be compiled.
    """
    return cpp_library.load(CPP_FILE)  # without FMA the scan would take 1.2 to 1.5 times as long


def compiled() -> bool:
    """Return True if the C++ scan is available, compiled if needed; otherwise warn once and
    return False.
    """
    return cpp_library.compiled("scan", CPP_FILE)


def _sizes(u: Tensor, rate: Tensor) -> tuple[int, int, int, int, int, int]:
    """Return the size arguments of the C++ scan: batch, length, d, n, number of groups of channels,
    number of threads.

    Each group of channels sums the gradients of B and C separately.
    """
    (batch, length, d), n, threads = u.shape, rate.shape[1], torch.get_num_threads()
    # the smallest group has the number of channels that the C++ code processes at a time
    most_groups = -(-d // operators().neusee_scan_channels(u.element_size()))
    return batch, length, d, n, min(most_groups, -(-threads // batch)), threads


def _call(name: str, sizes: tuple[int, ...], *tensors: Tensor) -> None:
    """Call the C++ function ``name`` for the type of the contiguous tensors, without the global
    interpreter lock.
    """
    operator = getattr(operators(), f"neusee_scan_{name}_{TYPE_NAMES[tensors[0].dtype]}")
    operator(
        (ctypes.c_int64 * len(sizes))(*sizes), *(ctypes.c_void_p(x.data_ptr()) for x in tensors)
    )


class CppScan(torch.autograd.Function):
    """The selective scan in C++ as an autograd function that can be differentiated once.

    u, dt (batch, length, d), A (d, n), B, C (batch, length, n) -> as u.
    """

    @staticmethod
    def forward(ctx: Any, *tensors: Tensor) -> Tensor:
        inputs = [x.contiguous() for x in tensors]
        u, rate = inputs[0], inputs[2]
        ctx.sizes = _sizes(u, rate)
        batch, length, d, n, *_ = ctx.sizes
        y, states = (
            torch.empty_like(u),
            u.new_empty(batch, -(-length // operators().neusee_scan_steps()), n, d),
        )
        _call("forward", ctx.sizes, *inputs, y, states)
        ctx.save_for_backward(*inputs, states)
        return y

    @staticmethod
    def backward(ctx: Any, *slopes: Tensor) -> tuple[Tensor, ...]:
        refuse_twice()
        *inputs, states = ctx.saved_tensors
        u = inputs[0]
        batch, length, d, n, groups, _ = ctx.sizes
        du, ddt, dA = torch.empty_like(u), torch.empty_like(u), u.new_empty(batch, n, d)
        dB, dC = u.new_empty(groups, batch, length, n), u.new_empty(groups, batch, length, n)
        _call("backward", ctx.sizes, *inputs, slopes[0].contiguous(), states, du, ddt, dA, dB, dC)
        return du, ddt, dA.sum(0).T, dB.sum(0), dC.sum(0)
