"""The selective scan as one CUDA kernel for each direction, in Triton, which is part of torch's
CUDA builds.

A program walks the line of one picture for some of its channels, with the states in registers. It
stores the states between chunks; the backward pass computes the states within a chunk again, in its
own memory. Torch sums partial sums over channels and pictures, without atomics, so every run gives
the same numbers. As in C++, decays enter as exp(x) - 1, and the round-off of a state is added at
its next step.
"""

# Triton reads the annotations of a kernel as its own, so kernels have none.
# mypy: disallow-untyped-defs=False, disallow-incomplete-defs=False
# mypy: disallow-untyped-calls=False, disallow-untyped-decorators=False

import functools
from typing import Any

import torch
import triton
import triton.language as tl
from torch import Tensor

from neusee.nodes.restore._scan._torch_scan import refuse_twice

__depends__ = ("unaffected:triton",)

#: Channels of a program, steps of a chunk, and warps: chosen, not measured. 1 / CHUNK of all states
#: are stored.
CHANNELS, CHUNK, WARPS = 16, 64, 2


@triton.jit
def _lost(x):
    """Return exp(x) - 1 to one or two ulp, for x <= 0: near 0 by a series to the ninth power."""
    series = 1.0 + x * (1.0 / 9.0)
    series = 1.0 + x * (1.0 / 8.0) * series
    series = 1.0 + x * (1.0 / 7.0) * series
    series = 1.0 + x * (1.0 / 6.0) * series
    series = 1.0 + x * (1.0 / 5.0) * series
    series = 1.0 + x * (1.0 / 4.0) * series
    series = 1.0 + x * (1.0 / 3.0) * series
    series = 1.0 + x * (1.0 / 2.0) * series
    return tl.where(x > -0.4, x * series, tl.exp(x) - 1.0)


@triton.jit
def _add(total, missed, addend):
    """Return the sum of ``total`` and ``addend``, and the round-off, which is added at the next
    step.
    """
    addend = addend + missed
    now = total + addend
    return now, addend - (now - total)


@triton.jit
def _forward(
    u,
    dt,
    A,
    B,
    C,
    y,
    states,
    length,
    d,
    n,
    channels: tl.constexpr,
    wide: tl.constexpr,
    chunk: tl.constexpr,
):
    b = tl.program_id(0).to(tl.int64)
    at_d, at_n = tl.program_id(1) * channels + tl.arange(0, channels), tl.arange(0, wide)
    some_d, some_n = at_d < d, at_n < n
    some, place = some_d[:, None] & some_n[None, :], at_d[:, None] * n + at_n[None, :]
    rate = tl.load(A + place, mask=some, other=0.0)
    h = tl.zeros([channels, wide], tl.float32)
    missed = tl.zeros([channels, wide], tl.float32)
    chunks = tl.cdiv(length, chunk)
    for k in range(0, chunks):
        tl.store(states + (b * chunks + k) * d * n + place, h, mask=some)
        for t in range(k * chunk, tl.minimum(k * chunk + chunk, length)):
            row = b * length + t
            step = tl.load(dt + row * d + at_d, mask=some_d, other=0.0)
            push = step * tl.load(u + row * d + at_d, mask=some_d, other=0.0)
            into = tl.load(B + row * n + at_n, mask=some_n, other=0.0)
            out = tl.load(C + row * n + at_n, mask=some_n, other=0.0)
            h, missed = _add(
                h, missed, _lost(step[:, None] * rate) * h + push[:, None] * into[None, :]
            )
            tl.store(y + row * d + at_d, tl.sum(h * out[None, :], 1), mask=some_d)


@triton.jit
def _backward(
    u,
    dt,
    A,
    B,
    C,
    dy,
    states,
    room,
    du,
    ddt,
    dA,
    dB,
    dC,
    length,
    d,
    n,
    channels: tl.constexpr,
    wide: tl.constexpr,
    chunk: tl.constexpr,
):
    b, block = tl.program_id(0).to(tl.int64), tl.program_id(1).to(tl.int64)
    at_d, at_n = block * channels + tl.arange(0, channels), tl.arange(0, wide)
    some_d, some_n = at_d < d, at_n < n
    some, place = some_d[:, None] & some_n[None, :], at_d[:, None] * n + at_n[None, :]
    own = tl.arange(0, channels)[:, None] * wide + at_n[None, :]
    own = own + (b * tl.num_programs(1) + block) * chunk * channels * wide
    rate = tl.load(A + place, mask=some, other=0.0)
    carry = tl.zeros([channels, wide], tl.float32)
    carried = tl.zeros([channels, wide], tl.float32)
    slope = tl.zeros([channels, wide], tl.float32)
    chunks = tl.cdiv(length, chunk)
    for back in range(0, chunks):
        k = chunks - 1 - back
        steps = tl.minimum(chunk, length - k * chunk)
        h = tl.load(states + (b * chunks + k) * d * n + place, mask=some, other=0.0)
        missed = tl.zeros([channels, wide], tl.float32)
        for i in range(0, steps):
            tl.store(room + own + i * channels * wide, h)
            row = b * length + k * chunk + i
            step = tl.load(dt + row * d + at_d, mask=some_d, other=0.0)
            push = step * tl.load(u + row * d + at_d, mask=some_d, other=0.0)
            into = tl.load(B + row * n + at_n, mask=some_n, other=0.0)
            h, missed = _add(
                h, missed, _lost(step[:, None] * rate) * h + push[:, None] * into[None, :]
            )
        tl.debug_barrier()  # a thread may load numbers that another thread stored
        here = tl.zeros([channels, wide], tl.float32)
        for turn in range(0, steps):
            i = steps - 1 - turn
            row = b * length + k * chunk + i
            before = tl.load(room + own + i * channels * wide)
            step = tl.load(dt + row * d + at_d, mask=some_d, other=0.0)
            input_value = tl.load(u + row * d + at_d, mask=some_d, other=0.0)
            output_slope = tl.load(dy + row * d + at_d, mask=some_d, other=0.0)
            into = tl.load(B + row * n + at_n, mask=some_n, other=0.0)
            out = tl.load(C + row * n + at_n, mask=some_n, other=0.0)
            x = step[:, None] * rate
            g, carried = _add(carry, carried, output_slope[:, None] * out[None, :])
            row_of_block = (block * tl.num_programs(0) + b) * length + k * chunk + i
            tl.store(
                dB + row_of_block * n + at_n,
                tl.sum(g * (step * input_value)[:, None], 0),
                mask=some_n,
            )
            tl.store(
                dC + row_of_block * n + at_n, tl.sum(h * output_slope[:, None], 0), mask=some_n
            )
            pushed, turned = tl.sum(g * into[None, :], 1), g * (before * tl.exp(x))
            tl.store(du + row * d + at_d, step * pushed, mask=some_d)
            tl.store(
                ddt + row * d + at_d, input_value * pushed + tl.sum(turned * rate, 1), mask=some_d
            )
            here += turned * step[:, None]
            carry, carried = _add(g, carried, _lost(x) * g)
            h = before
        slope += here
        tl.debug_barrier()  # before the memory is written again
    tl.store(dA + b * d * n + place, slope, mask=some)


@functools.cache
def _wide(n: int) -> int:
    """Return the least power of 2 that is at least ``n``; the sizes of Triton tensors are powers
    of 2.
    """
    return 1 << (n - 1).bit_length()


def _sizes(u: Tensor, rate: Tensor) -> tuple[int, int, int, int, int, int]:
    """Return the sizes that the Triton kernels take: batch, length, d, n, blocks of channels,
    and chunks.
    """
    (batch, length, d), n = u.shape, rate.shape[1]
    return batch, length, d, n, -(-d // CHANNELS), -(-length // CHUNK)


class Scan(torch.autograd.Function):
    """The selective scan in Triton as an autograd function that can be differentiated once.

    u, dt (batch, length, d), A (d, n), B, C (batch, length, n) -> as u.
    """

    @staticmethod
    def forward(ctx: Any, *tensors: Tensor) -> Tensor:
        inputs = [x.contiguous() for x in tensors]
        u, rate = inputs[0], inputs[2]
        batch, length, d, n, blocks, chunks = _sizes(u, rate)
        y, states = torch.empty_like(u), u.new_empty(batch, chunks, d, n)
        _forward[(batch, blocks)](
            *inputs, y, states, length, d, n, CHANNELS, _wide(n), CHUNK, num_warps=WARPS
        )
        ctx.save_for_backward(*inputs, states)
        return y

    @staticmethod
    def backward(ctx: Any, *slopes: Tensor) -> tuple[Tensor, ...]:
        refuse_twice()
        *inputs, states = ctx.saved_tensors
        u, rate = inputs[0], inputs[2]
        batch, length, d, n, blocks, _ = _sizes(u, rate)
        du, ddt, dA = torch.empty_like(u), torch.empty_like(u), u.new_empty(batch, d, n)
        dB, dC = u.new_empty(blocks, batch, length, n), u.new_empty(blocks, batch, length, n)
        room = u.new_empty(batch, blocks, CHUNK, CHANNELS, _wide(n))
        gradients = (du, ddt, dA, dB, dC)
        _backward[(batch, blocks)](
            *inputs,
            slopes[0].contiguous(),
            states,
            room,
            *gradients,
            length,
            d,
            n,
            CHANNELS,
            _wide(n),
            CHUNK,
            num_warps=WARPS,
        )
        return du, ddt, dA.sum(0), dB.sum(0), dC.sum(0)
