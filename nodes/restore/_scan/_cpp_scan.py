"""The selective scan in C++, compiled for the processor of this machine on first use and then
reused.
"""

import ctypes
from pathlib import Path
from typing import Any

import torch
from torch import Tensor

from neusee.nodes import _cpp_library
from neusee.nodes.restore._scan._torch_scan import refuse_twice

#: what the code reads: the C++ source decides a result; the threads change it within rounding
__depends__ = ("_scan.cpp", "unaffected:ctypes", "unaffected:torch.get_num_threads")
CODE = Path(__file__).with_name("_scan.cpp")
#: digest of the source: keys of cached results depend on this file, and so on the C++ source; a
#: test compares both
DIGEST = "4eb56a2cbcf29286"
NAMES = {torch.float32: "f32", torch.float64: "f64"}


def operators() -> ctypes.CDLL:
    """Return the library of the C++ scan, compiled if needed; raise `NoCompilerError` if it
    cannot be compiled.
    """
    return _cpp_library.load(CODE)  # without FMA the scan would take 1.2 to 1.5 times as long


def compiled() -> bool:
    """Return True if the C++ scan is available, compiled if needed; otherwise warn once and
    return False.
    """
    return _cpp_library.compiled("scan", CODE)


def _sizes(u: Tensor, rate: Tensor) -> tuple[int, int, int, int, int, int]:
    """Return the sizes that the C++ scan takes: batch, length, d, n, groups of channels, and
    threads.

    Each group of channels sums its own gradients of B and C.
    """
    (batch, length, d), n, threads = u.shape, rate.shape[1], torch.get_num_threads()
    # groups of as many channels as the C++ takes at a time
    most_groups = -(-d // operators().neusee_scan_channels(u.element_size()))
    return batch, length, d, n, min(most_groups, -(-threads // batch)), threads


def _call(name: str, sizes: tuple[int, ...], *tensors: Tensor) -> None:
    """Call the C++ function ``name`` for the type of the contiguous tensors, without the global
    interpreter lock.
    """
    operator = getattr(operators(), f"neusee_scan_{name}_{NAMES[tensors[0].dtype]}")
    operator(
        (ctypes.c_int64 * len(sizes))(*sizes), *(ctypes.c_void_p(x.data_ptr()) for x in tensors)
    )


class Scan(torch.autograd.Function):
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
