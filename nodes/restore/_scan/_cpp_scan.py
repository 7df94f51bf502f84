"""The selective scan in C++, compiled for this very processor on first use and kept for the next.

The source asks for nothing but a compiler: no headers of torch and none of Python, so that it compiles in a second or
two and the library serves any version of both. A library is made beside its place and moved there whole: two processes
that make it at once both end with a good one, and one that is killed leaves nothing that others wait for.
"""

import ctypes
import functools
import hashlib
import os
import platform
import shutil
import subprocess
import tempfile
import warnings
from pathlib import Path
from typing import Any

import torch
from torch import Tensor

from neusee.nodes.restore._scan._torch_scan import refuse_twice

CODE = Path(__file__).with_name("_scan.cpp")
#: of the source: the keys of what is cached follow this file, and so that one; a test compares
DIGEST = "863111a7de82003b"
FLAGS = (
    *("-std=c++17", "-O3", "-march=native", "-fopenmp", "-fPIC", "-shared", "-w"),
    *("-ffp-contract=fast", "-fno-math-errno", "-fno-trapping-math"),
)
NAMES = {torch.float32: "f32", torch.float64: "f64"}


class NoCompilerError(RuntimeError):
    """The operator cannot be made here; says why in one line."""


def folder() -> Path:
    """Where compiled code lies: ``$XDG_CACHE_HOME/neusee/build``, else ``~/.cache/neusee/build``.

    It must outlive the process, or each would compile; no result is ever kept there, nor hangs on it.
    """
    return Path(os.environ.get("XDG_CACHE_HOME") or Path.home() / ".cache") / "neusee" / "build"


def _processor() -> str:
    """What tells processors apart that cannot run each other's code, as a home shared by many machines needs."""
    try:
        lines = Path("/proc/cpuinfo").read_text(encoding="utf-8", errors="replace").splitlines()
    except OSError:
        lines = []
    told = [next((x for x in lines if x.startswith(word)), "") for word in ("model name", "flags", "Features")]
    return "\n".join([platform.platform(), platform.machine(), platform.processor(), *told])


def _compile(where: Path) -> None:
    """Make the library at ``where``; a `NoCompilerError` where that fails."""
    compiler = os.environ.get("CXX") or shutil.which("g++") or shutil.which("c++") or shutil.which("clang++")
    if compiler is None:
        raise NoCompilerError("there is no C++ compiler")
    try:
        where.parent.mkdir(parents=True, exist_ok=True)
        with tempfile.TemporaryDirectory(dir=where.parent) as aside:
            made = Path(aside) / where.name
            command = [*compiler.split(), *FLAGS, str(CODE), "-o", str(made)]
            done = subprocess.run(command, capture_output=True, text=True, timeout=300, check=False)
            if done.returncode:
                said = next((x for x in done.stderr.splitlines() if "error" in x), f"it returned {done.returncode}")
                raise NoCompilerError(f"{compiler} failed: {said.strip()}")
            os.replace(made, where)
    except (OSError, subprocess.SubprocessError) as error:
        raise NoCompilerError(f"{compiler} could not be run: {error}") from error


@functools.cache
def _made(build: Path, compiler: str | None) -> ctypes.CDLL | NoCompilerError:
    """The library, or why there is none: tried once a process for each folder and compiler."""
    words = [CODE.read_text(encoding="utf-8"), *FLAGS, compiler or "", _processor()]
    where = build / f"scan_{hashlib.sha256(chr(0).join(words).encode()).hexdigest()[:32]}.so"
    try:
        if not where.is_file():
            _compile(where)
        return ctypes.CDLL(str(where))
    except NoCompilerError as error:
        return error
    except OSError as error:
        return NoCompilerError(f"{where} cannot be loaded: {error}")


def operators() -> ctypes.CDLL:
    """The compiled operator; a `NoCompilerError` where it cannot be made."""
    found = _made(folder(), os.environ.get("CXX"))
    if isinstance(found, NoCompilerError):
        raise found
    return found


@functools.cache
def _say_once(why: str) -> None:
    warnings.warn(f"the selective scan is not compiled, torch computes it, slower: {why}", stacklevel=4)


def compiled() -> bool:
    """Whether the operator is there, made now if need be; warns the first time it is not."""
    try:
        operators()
    except NoCompilerError as error:
        _say_once(str(error))
        return False
    return True


def _sizes(u: Tensor, rate: Tensor) -> tuple[int, int, int, int, int, int]:
    """Batch, length, d, n, groups of channels whose gradients of B and C are summed apart, and threads."""
    (batch, length, d), n, threads = u.shape, rate.shape[1], torch.get_num_threads()
    blocks = -(-d // (64 // u.element_size()))
    return batch, length, d, n, min(blocks, -(-threads // batch)), threads


def _call(name: str, sizes: tuple[int, ...], *tensors: Tensor) -> None:
    """Hand contiguous tensors to the operator ``name`` of their type; Python's other threads run meanwhile."""
    operator = getattr(operators(), f"neusee_scan_{name}_{NAMES[tensors[0].dtype]}")
    operator((ctypes.c_int64 * len(sizes))(*sizes), *(ctypes.c_void_p(x.data_ptr()) for x in tensors))


class Scan(torch.autograd.Function):
    """u, dt (batch, length, d), A (d, n), B, C (batch, length, n) -> y (batch, length, d); once differentiable."""

    @staticmethod
    def forward(ctx: Any, *tensors: Tensor) -> Tensor:
        given = [x.contiguous() for x in tensors]
        u, rate = given[0], given[2]
        ctx.sizes = _sizes(u, rate)
        batch, length, d, n, *_ = ctx.sizes
        y, states = torch.empty_like(u), u.new_empty(batch, -(-length // operators().neusee_scan_steps()), n, d)
        _call("forward", ctx.sizes, *given, y, states)
        ctx.save_for_backward(*given, states)
        return y

    @staticmethod
    def backward(ctx: Any, *seen: Tensor) -> tuple[Tensor, ...]:
        refuse_twice()
        *given, states = ctx.saved_tensors
        u = given[0]
        batch, length, d, n, groups, _ = ctx.sizes
        du, ddt, dA = torch.empty_like(u), torch.empty_like(u), u.new_empty(batch, n, d)
        dB, dC = u.new_empty(groups, batch, length, n), u.new_empty(groups, batch, length, n)
        _call("backward", ctx.sizes, *given, seen[0].contiguous(), states, du, ddt, dA, dB, dC)
        return du, ddt, dA.sum(0).T, dB.sum(0), dC.sum(0)
