"""The selective scan in torch's own operations: anywhere torch runs, in little memory.

The length is cut into segments that stay in a cache, and a segment into chunks that are walked side by side: as many
operations as a chunk has steps, then one for each chunk's carry. Only the states between segments are kept; the rest
is computed again on the way back. Decays enter as exp(x) - 1: one near 1 that is rounded forgets wrongly at each step.
What one chunk hands to the next is in float64, for a state that hardly decays is rounded as often as it is handed on.
"""

from collections.abc import Iterator
from typing import Any, NamedTuple

import torch
from torch import Tensor
from torch.nn import functional as F

#: Numbers of a segment's states, and of one operation: what was fastest on one core at 1536 numbers a step, by 3 % over
#: twice the segment, by a tenth over a walk without chunks; smaller operations cost more to call than to do.
SEGMENT, ROW = 1 << 17, 1 << 14
SEGMENT_CUDA, ROW_CUDA = 1 << 23, 1 << 17  #: the same on a GPU: chosen, not measured


def refuse_twice() -> None:
    """Refuse a gradient of a gradient, which would be wrong without a word: the way back has no graph of its own."""
    if torch.is_grad_enabled():
        raise RuntimeError("the selective scan has no second derivative: do not ask for create_graph through it")


class Plan(NamedTuple):
    """How a length is cut: ``chunks`` chunks of ``steps`` steps make a segment."""

    steps: int
    chunks: int

    @property
    def segment(self) -> int:
        return self.steps * self.chunks


def plan(length: int, width: int, cuda: bool) -> Plan:
    """Cut ``length`` steps of ``width`` numbers each."""
    row, whole = (ROW_CUDA, SEGMENT_CUDA) if cuda else (ROW, SEGMENT)
    segment = min(length, max(16, whole // width))
    chunks = max(1, min(row // width, int(segment**0.5)))
    return Plan(-(-segment // chunks), chunks)


class _Segment:
    """Its lines with time first, (step, chunk, batch, d or n), and its decays; filled up with steps of no length."""

    def __init__(self, how: Plan, rows: slice, rate: Tensor, *lines: Tensor) -> None:
        self.how, self.rows, self.rate = how, rows, rate
        self.size = min(how.segment, lines[0].shape[1] - rows.start)
        self.u, self.dt, self.into, self.out = (self.turn(x) for x in lines)
        self.pushed = self.u * self.dt
        self.lost = (self.dt[..., None] * rate).expm1_()

    def turn(self, x: Tensor) -> Tensor:
        """(batch, length, m) -> (step, chunk, batch, m)."""
        part = F.pad(x[:, self.rows], (0, 0, 0, self.how.segment - self.size)).contiguous()
        return part.view(len(x), self.how.chunks, self.how.steps, -1).permute(2, 1, 0, 3).contiguous()

    def back(self, x: Tensor) -> Tensor:
        """(step, chunk, batch, m) -> (batch, rows, m)."""
        return x.permute(2, 1, 0, 3).flatten(1, 2)[:, : self.size]

    def states(self, start: Tensor) -> tuple[Tensor, Tensor]:
        """After each step, from ``start`` (batch, d, n); the last one's, in float64."""
        h = self.pushed[..., None] * self.into[..., None, :]
        return h, _walk(h, list(self.lost.unbind(0)), start)

    def slopes(self, seen: Tensor, end: Tensor) -> tuple[Tensor, Tensor]:
        """Of the states: what is ``seen`` of each, and what the next step leaves of the next one's; ``end`` beyond.

        And of the state before the first step, in float64.
        """
        g = seen[..., None] * self.out[..., None, :]
        first, *others = self.lost.unbind(0)
        next_chunk = torch.cat([first[1:], torch.zeros_like(first[:1])])
        at_first = _walk(g, [next_chunk, *others[::-1]], end, back=True)
        return g, at_first + first[0] * at_first

    def gradients(self, dy: Tensor, start: Tensor, end: Tensor) -> tuple[Tensor, ...]:
        """Of u, dt, B, C, each (batch, rows, m), of A, and of the state before the first step, (batch, d, n)."""
        seen = self.turn(dy)
        (h, _), (g, before) = self.states(start), self.slopes(seen, end)
        pushed = (g @ self.into[..., None])[..., 0]
        into, out = (seen_by[..., None, :] @ x for seen_by, x in ((self.pushed, g), (seen, h)))
        g[1:] *= h[:-1]
        g[0, 1:] *= h[-1, :-1]
        g[0, 0] *= start
        g *= torch.mul(self.dt[..., None], self.rate, out=self.lost).exp_()  # now the slope of dt * A
        dt = torch.mul(g, self.rate, out=h).sum(-1).addcmul_(pushed, self.u)
        rate = g.mul_(self.dt[..., None]).sum((0, 1, 2))
        lines = (self.dt * pushed, dt, into[..., 0, :], out[..., 0, :])
        return *(self.back(x) for x in lines), rate, before


def _walk(h: Tensor, lost: list[Tensor], start: Tensor, back: bool = False) -> Tensor:
    """Turn pushes (step, chunk, ...) into states: h_i <- h_i + h_(i-1) + lost_i * h_(i-1), from ``start``.

    ``back`` walks from the last to the first; ``lost``, one (chunk, ...) a step, is in the order of the walk. Every
    chunk begins with nothing, and is then given what the ones before it left; what the last leaves, in float64.
    """
    turn = slice(None, None, -1 if back else 1)
    rows, through = h.unbind(0)[turn], torch.empty_like(h)
    shares = through.unbind(0)[turn]
    shares[0].copy_(lost[0])
    for less, before, now, share, further in zip(lost[1:], rows, rows[1:], shares, shares[1:], strict=False):
        now.addcmul_(less, before).add_(before)
        torch.add(less, share, out=further).addcmul_(less, share)  # (1 + e)(1 + l) - 1: what is near 0 stays exact
    left, kept, given = rows[-1].double(), shares[-1].double(), torch.empty_like(rows[-1])
    for chunk in range(h.shape[1])[turn]:
        given[chunk] = start
        start = (left[chunk] + start).addcmul_(kept[chunk], start)
    h.addcmul_(through, given).add_(given)
    return start


def _segments(length: int, how: Plan) -> Iterator[slice]:
    return (slice(i, i + how.segment) for i in range(0, length, how.segment))


class Scan(torch.autograd.Function):
    """u, dt (batch, length, d), A (d, n), B, C (batch, length, n) -> y (batch, length, d); once differentiable."""

    @staticmethod
    def forward(ctx: Any, *given: Tensor) -> Tensor:
        u, dt, rate, *into_out = given
        (batch, length, _), (d, n) = u.shape, rate.shape
        ctx.how = plan(length, batch * d * n, u.is_cuda)
        y, state, starts = torch.empty_like(u), u.new_zeros(batch, d, n, dtype=torch.float64), list[Tensor]()
        for rows in _segments(length, ctx.how):
            starts.append(state.to(u))
            part = _Segment(ctx.how, rows, rate, u, dt, *into_out)
            h, state = part.states(state)
            y[:, rows] = part.back((h @ part.out[..., None])[..., 0])
        ctx.save_for_backward(*given, torch.stack(starts))
        return y

    @staticmethod
    def backward(ctx: Any, *seen: Tensor) -> tuple[Tensor, ...]:
        refuse_twice()
        *given, starts = ctx.saved_tensors
        u, dt, rate, *into_out = given
        du, ddt, dB, dC = (torch.empty_like(x) for x in (u, dt, *into_out))
        end, dA = torch.zeros_like(starts[0], dtype=torch.float64), torch.zeros_like(rate, dtype=torch.float64)
        with torch.autocast(u.device.type, enabled=False):
            for rows, start in reversed(list(zip(_segments(u.shape[1], ctx.how), starts, strict=True))):
                part = _Segment(ctx.how, rows, rate, u, dt, *into_out)
                *lines, slope, end = part.gradients(seen[0], start, end)
                for whole, line in zip((du, ddt, dB, dC), lines, strict=True):
                    whole[:, rows] = line
                dA += slope
        return du, ddt, dA.to(rate), dB, dC
