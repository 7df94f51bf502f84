"""The selective scan in torch operations: on any device that torch supports."""

from collections.abc import Iterator
from typing import Any, NamedTuple

import torch
from torch import Tensor
from torch.nn import functional as F

# --- torch scan -----------------------------------------------------------------------------------

# The selective scan in torch operations: on any device that torch supports, in little memory.
#
# The length is cut into segments that fit in a cache, and each segment into chunks that are walked
# in parallel. A segment takes as many operations as a chunk has steps, and one more for the carry
# of each chunk. Only the states between segments are stored; back-propagation computes all other
# states again. Decays enter as exp(x) - 1, because the round-off of a decay near 1 would act at
# each step. The carry between chunks is float64, because a state that hardly decays is rounded at
# each carry.


#: Numbers in the states of a segment, and in one operation: the fastest on one core at 1536 numbers
#: a step, by 3 % over segments twice as long, by a tenth over no chunks. Smaller operations take
#: longer to call than to compute.
SEGMENT, ROW = 1 << 17, 1 << 14
SEGMENT_CUDA, ROW_CUDA = 1 << 23, 1 << 17  #: the same two numbers on a GPU: chosen, not measured


def refuse_twice() -> None:
    """Raise RuntimeError for a second derivative, which would be silently wrong without a graph
    of the gradient.
    """
    if torch.is_grad_enabled():
        raise RuntimeError(
            "the selective scan has no second derivative: do not use create_graph for a gradient"
            " through the scan"
        )


class Plan(NamedTuple):
    """The division of a sequence into segments of ``chunks`` chunks, each of ``steps`` time
    steps.
    """

    steps: int
    chunks: int

    @property
    def segment(self) -> int:
        return self.steps * self.chunks


def plan(length: int, width: int, cuda: bool) -> Plan:
    """Divide a sequence of ``length`` time steps with ``width`` numbers each into segments and
    chunks.
    """
    row, segment_numbers = (ROW_CUDA, SEGMENT_CUDA) if cuda else (ROW, SEGMENT)
    segment = min(length, max(16, segment_numbers // width))
    chunks = max(1, min(row // width, int(segment**0.5)))
    return Plan(-(-segment // chunks), chunks)


class _Segment:
    """The inputs and decays of one segment of a sequence, (step, chunk, batch, d or n), padded
    by steps of length 0.
    """

    def __init__(self, division: Plan, rows: slice, rate: Tensor, *lines: Tensor) -> None:
        """Cut ``rows`` out of the sequences u, dt, B and C (``lines``) and compute their decays."""
        self.division, self.rows, self.rate = division, rows, rate
        self.size = min(division.segment, lines[0].shape[1] - rows.start)
        self.u, self.dt, self.into, self.out = (self.turn(x) for x in lines)
        self.pushed = self.u * self.dt
        # decay - 1 in each step
        self.lost = (self.dt[..., None] * rate).expm1_()

    def turn(self, x: Tensor) -> Tensor:
        """Rearrange one segment of a sequence from (batch, length, m) to (step, chunk, batch,
        m).
        """
        segment = F.pad(x[:, self.rows], (0, 0, 0, self.division.segment - self.size)).contiguous()
        return (
            segment.view(len(x), self.division.chunks, self.division.steps, -1)
            .permute(2, 1, 0, 3)
            .contiguous()
        )

    def back(self, x: Tensor) -> Tensor:
        """Rearrange one segment of a sequence from (step, chunk, batch, m) to (batch, rows, m)."""
        return x.permute(2, 1, 0, 3).flatten(1, 2)[:, : self.size]

    def states(self, start: Tensor) -> tuple[Tensor, Tensor]:
        """Return the state of the scan after each step, from ``start`` (batch, d, n), and the
        last state in float64.
        """
        h = self.pushed[..., None] * self.into[..., None, :]
        return h, _walk(h, list(self.lost.unbind(0)), start)

    def slopes(self, output_slope: Tensor, end: Tensor) -> tuple[Tensor, Tensor]:
        """Return the gradients of all states of a scan, and of the state before the first step in
        float64.

        The gradient of a state is the sum of the gradients through its output, ``output_slope``,
        and through the next state, or ``end`` for the last state.
        """
        state_slopes = output_slope[..., None] * self.out[..., None, :]
        first_decay, *later_decays = self.lost.unbind(0)
        next_first_decay = torch.cat([first_decay[1:], torch.zeros_like(first_decay[:1])])
        slope_at_first = _walk(
            state_slopes, [next_first_decay, *later_decays[::-1]], end, back=True
        )
        return state_slopes, slope_at_first + first_decay[0] * slope_at_first

    def gradients(self, dy: Tensor, start: Tensor, end: Tensor) -> tuple[Tensor, ...]:
        """Return the gradients of u, dt, B, C (batch, rows, m), A and the state before the first
        step (batch, d, n).
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
        # now the gradient of dt * A
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
    """Turn the inputs ``h`` (step, chunk, ...) of a scan into states in place: h_i <- h_i + (1 +
    lost_i) h_(i-1).

    The state before the first step is ``start``. ``back`` walks from the last step to the first;
    ``lost``, (chunk, ...) for each step, is in the order of the walk. Every chunk starts from 0,
    and the state that earlier chunks carry over is added afterwards. The last state is returned in
    float64.
    """
    order = slice(None, None, -1 if back else 1)
    states, growth = h.unbind(0)[order], torch.empty_like(h)
    growth_by_step = growth.unbind(0)[order]
    growth_by_step[0].copy_(lost[0])
    for loss, state_before, state, growth_here, growth_next in zip(
        lost[1:], states, states[1:], growth_by_step, growth_by_step[1:], strict=False
    ):
        state.addcmul_(loss, state_before).add_(state_before)
        # (1 + e)(1 + l) - 1, exact near 0
        torch.add(loss, growth_here, out=growth_next).addcmul_(loss, growth_here)
    last_state, last_growth, chunk_starts = (
        states[-1].double(),
        growth_by_step[-1].double(),
        torch.empty_like(states[-1]),
    )
    for chunk in range(h.shape[1])[order]:
        chunk_starts[chunk] = start
        start = (last_state[chunk] + start).addcmul_(last_growth[chunk], start)
    # each state plus what its chunk's start has grown to: s + l s, l being growth - 1
    h.addcmul_(growth, chunk_starts).add_(chunk_starts)
    return start


def _segments(length: int, division: Plan) -> Iterator[slice]:
    return (slice(i, i + division.segment) for i in range(0, length, division.segment))


class Scan(torch.autograd.Function):
    """The selective scan in torch as an autograd function that can be differentiated once.

    u, dt (batch, length, d), A (d, n), B, C (batch, length, n) -> as u.
    """

    @staticmethod
    def forward(ctx: Any, *inputs: Tensor) -> Tensor:
        u, dt, rate, *into_out = inputs
        (batch, length, _), (d, n) = u.shape, rate.shape
        ctx.division = plan(length, batch * d * n, u.is_cuda)
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
