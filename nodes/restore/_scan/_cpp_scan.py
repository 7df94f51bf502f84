"""The selective scan in C++, compiled for the processor of this machine on first use and then reused.

The source needs only a compiler, no headers of torch or Python. It compiles in a second or two, and the library works
with any version of both. The library is compiled in a temporary folder and moved by an atomic rename: two processes
that compile at once both get a valid library, and a process that is killed leaves no lock behind.
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

#: what the code reads: the C++ source decides a result; compiler, processor and threads change it within rounding
__depends__ = (
    "_scan.cpp",
    "unaffected:CXX",
    "unaffected:XDG_CACHE_HOME",
    "unaffected:ctypes",
    "unaffected:subprocess",
    "unaffected:platform",
    "unaffected:pathlib.Path.home",
    "unaffected:torch.get_num_threads",
)
CODE = Path(__file__).with_name("_scan.cpp")
#: digest of the source: keys of cached results depend on this file, and so on the C++ source; a test compares both
DIGEST = "379aa95ba41e1932"
FLAGS = (
    *("-std=c++17", "-O3", "-march=native", "-fopenmp", "-fPIC", "-shared", "-w"),
    *("-ffp-contract=fast", "-fno-math-errno", "-fno-trapping-math"),
)
NAMES = {torch.float32: "f32", torch.float64: "f64"}


class NoCompilerError(RuntimeError):
    """The error of a machine on which the C++ scan cannot be compiled; the message gives the reason in one line."""


def folder() -> Path:
    """Return the folder of the compiled C++ scan: ``$XDG_CACHE_HOME/neusee/build``, else ``~/.cache/neusee/build``.

    The folder must outlive the process, or each process would compile. No result is kept there or depends on it.
    """
    return Path(os.environ.get("XDG_CACHE_HOME") or Path.home() / ".cache") / "neusee" / "build"


def _processor() -> str:
    """Return a text that identifies the processor, because different machines may share a home folder."""
    try:
        lines = Path("/proc/cpuinfo").read_text(encoding="utf-8", errors="replace").splitlines()
    except OSError:
        lines = []
    facts = [next((x for x in lines if x.startswith(word)), "") for word in ("model name", "flags", "Features")]
    return "\n".join([platform.platform(), platform.machine(), platform.processor(), *facts])


def _compile(where: Path) -> None:
    """Compile the C++ scan to the file ``where``; raise `NoCompilerError` if that fails."""
    compiler = os.environ.get("CXX") or shutil.which("g++") or shutil.which("c++") or shutil.which("clang++")
    if compiler is None:
        raise NoCompilerError("no C++ compiler is installed: install g++, or set CXX to a compiler")
    try:
        where.parent.mkdir(parents=True, exist_ok=True)
        with tempfile.TemporaryDirectory(dir=where.parent) as aside:
            library = Path(aside) / where.name
            command = [*compiler.split(), *FLAGS, str(CODE), "-o", str(library)]
            done = subprocess.run(command, capture_output=True, text=True, timeout=300, check=False)
            if done.returncode:
                reason = next((x for x in done.stderr.splitlines() if "error" in x), f"exit status {done.returncode}")
                raise NoCompilerError(f"{compiler} failed: {reason.strip()}")
            os.replace(library, where)
    except (OSError, subprocess.SubprocessError) as error:
        raise NoCompilerError(f"{compiler} could not be run: {error}") from error


@functools.cache
def _library(build: Path, compiler: str | None) -> ctypes.CDLL | NoCompilerError:
    """Return the compiled library, or the error of the single attempt to compile for this folder and compiler."""
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
    """Return the library of the C++ scan, compiled if needed; raise `NoCompilerError` if it cannot be compiled."""
    library = _library(folder(), os.environ.get("CXX"))
    if isinstance(library, NoCompilerError):
        raise library
    return library


@functools.cache
def _say_once(why: str) -> None:
    warnings.warn(f"the C++ scan is not compiled and torch computes the scan more slowly: {why}", stacklevel=4)


def compiled() -> bool:
    """Return True if the C++ scan is available, compiled if needed; otherwise warn once and return False."""
    try:
        operators()
    except NoCompilerError as error:
        _say_once(str(error))
        return False
    return True


def _sizes(u: Tensor, rate: Tensor) -> tuple[int, int, int, int, int, int]:
    """Return the sizes that the C++ scan takes: batch, length, d, n, groups of channels, and threads.

    Each group of channels sums its own gradients of B and C.
    """
    (batch, length, d), n, threads = u.shape, rate.shape[1], torch.get_num_threads()
    blocks = -(-d // (64 // u.element_size()))
    return batch, length, d, n, min(blocks, -(-threads // batch)), threads


def _call(name: str, sizes: tuple[int, ...], *tensors: Tensor) -> None:
    """Call the C++ function ``name`` for the type of the contiguous tensors, without the global interpreter lock."""
    operator = getattr(operators(), f"neusee_scan_{name}_{NAMES[tensors[0].dtype]}")
    operator((ctypes.c_int64 * len(sizes))(*sizes), *(ctypes.c_void_p(x.data_ptr()) for x in tensors))


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
        y, states = torch.empty_like(u), u.new_empty(batch, -(-length // operators().neusee_scan_steps()), n, d)
        _call("forward", ctx.sizes, *inputs, y, states)
        ctx.save_for_backward(*inputs, states)
        return y

    @staticmethod
    def backward(ctx: Any, *seen: Tensor) -> tuple[Tensor, ...]:
        refuse_twice()
        *inputs, states = ctx.saved_tensors
        u = inputs[0]
        batch, length, d, n, groups, _ = ctx.sizes
        du, ddt, dA = torch.empty_like(u), torch.empty_like(u), u.new_empty(batch, n, d)
        dB, dC = u.new_empty(groups, batch, length, n), u.new_empty(groups, batch, length, n)
        _call("backward", ctx.sizes, *inputs, seen[0].contiguous(), states, du, ddt, dA, dB, dC)
        return du, ddt, dA.sum(0).T, dB.sum(0), dC.sum(0)
