"""The selective scan's Triton kernel: its numbers under Triton's interpreter, its code for a
GPU, and on one if any.
"""

import importlib.util
import os
import subprocess
import sys
import warnings
from importlib.metadata import version
from pathlib import Path

import pytest
import torch

from neusee.nodes.restore._scan import _torch_scan
from neusee.nodes.restore._scan._selective_scan import reference, selective_scan

ROOT = Path(__file__).parents[4]
FILE = Path(_torch_scan.__file__).with_name("_triton_scan.py")
HERE = importlib.util.find_spec("triton") is not None
needs_triton = pytest.mark.skipif(not HERE, reason="no Triton: it comes with torch's CUDA builds")


def refuses_arrays():
    """Return True where Triton's interpreter makes numbers of arrays of one element, which NumPy
    2.5 refuses.
    """
    triton, numpy = (tuple(map(int, version(name).split(".")[:2])) for name in ("triton", "numpy"))
    return triton <= (3, 6) and numpy >= (2, 5)


@pytest.fixture
def interpreted(monkeypatch):
    """The module anew, as Triton decides when it reads one whether to interpret; with few
    channels and short chunks.
    """
    if refuses_arrays():
        pytest.skip("the interpreter of Triton up to 3.6 cannot run with NumPy 2.5")
    monkeypatch.setenv("TRITON_INTERPRET", "1")
    spec = importlib.util.spec_from_file_location("scan_triton", FILE)
    _scan_triton = importlib.util.module_from_spec(spec)
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")  # Triton's own
        spec.loader.exec_module(_scan_triton)
    monkeypatch.setattr(_scan_triton, "CHANNELS", 2)
    monkeypatch.setattr(_scan_triton, "CHUNK", 3)
    return _scan_triton


def draw(length, d, n, batch, rate):
    """u, dt, A, B, C in float32, with dt |A| about ``rate``, or spread by logarithms from 1e-6
    to 200.
    """
    rng = torch.Generator().manual_seed(length)
    u, B, C = (torch.randn(batch, length, m, generator=rng) for m in (d, n, n))
    dt = 0.5 + torch.rand(batch, length, d, generator=rng)
    A = -torch.logspace(-6, 2.3, d * n).view(d, n) if rate is None else torch.full((d, n), -rate)
    return u, dt, A, B, C


def gradients(scan, values, seen):
    leaves = [x.clone().requires_grad_() for x in values]
    y = scan(*leaves)
    return [y.detach(), *torch.autograd.grad((y * seen).sum(), leaves)]


def compare(scan, values, limit):
    seen = torch.randn(values[0].shape, generator=torch.Generator().manual_seed(1)).to(
        values[0].device
    )
    truth = gradients(reference, [x.double() for x in values], seen.double())
    for one, true in zip(gradients(scan, values, seen), truth, strict=True):
        assert one.shape == true.shape
        # what float32 has not
        assert float((one - true).abs().max()) <= limit * float(true.abs().max()) + 1e-36


@needs_triton
@pytest.mark.slow
@pytest.mark.parametrize("rate", [None, 1e-6, 1.0, 200.0])
def test_interpreted_it_is_the_loop_in_float64(interpreted, rate):
    """Two blocks of channels of which one is not full, three chunks of which one is not, a
    number of states between.
    """
    compare(interpreted.Scan.apply, draw(7, 3, 3, 2, rate), 1e-6)


@needs_triton
@pytest.mark.slow
def test_interpreted_it_refuses_a_second_derivative(interpreted):
    leaves = [x.requires_grad_() for x in draw(2, 1, 1, 1, None)]
    y = interpreted.Scan.apply(*leaves)
    with pytest.raises(RuntimeError, match="no second derivative"):
        torch.autograd.grad(y.sum(), leaves, create_graph=True)


COMPILE = """
from triton.backends.compiler import GPUTarget
from triton.compiler import ASTSource, compile
from neusee.nodes.restore._scan import _triton_scan as module

fixed = {"channels": module.CHANNELS, "wide": 16, "chunk": module.CHUNK}
kind = {**dict.fromkeys(fixed, "constexpr"), **dict.fromkeys(("length", "d", "n"), "i32")}
for kernel in (module._forward, module._backward):
    signature = {name: kind.get(name, "*fp32") for name in kernel.arg_names}
    constants = {(kernel.arg_names.index(name),): value for name, value in fixed.items()}
    for capability in (80, 90):
        made = compile(ASTSource(kernel, signature, constants), target=GPUTarget("cuda", capability, 32))
        code = made.asm["ptx"]
        print(len(made.asm["cubin"]) > 0, ".entry" in code, "atom." in code, "red.global" in code)
"""


@needs_triton
@pytest.mark.slow
def test_it_compiles_for_gpus_that_are_not_here_and_has_no_atomics(tmp_path):
    """In a process of its own, for who has interpreted cannot compile."""
    env = {
        **os.environ,
        "TRITON_CACHE_DIR": str(tmp_path),
        "TRITON_INTERPRET": "0",
        "PYTHONPATH": str(ROOT / ".src"),
    }
    done = subprocess.run(
        [sys.executable, "-c", COMPILE], env=env, capture_output=True, text=True, check=True
    )
    assert done.stdout == "True True False False\n" * 4


@pytest.mark.gpu
@needs_triton
@pytest.mark.skipif(not torch.cuda.is_available(), reason="no CUDA device")
@pytest.mark.parametrize(
    ("length", "d", "n"), [(1, 1, 1), (65, 17, 3), (1000, 128, 16), (4096, 64, 16)]
)
@pytest.mark.parametrize("rate", [None, 1e-6, 1.0, 200.0])
def test_on_a_gpu_it_is_the_loop_in_float64(length, d, n, rate):
    values = [x.cuda() for x in draw(length, d, n, 2, rate)]
    compare(lambda *x: selective_scan(*x, backend="triton"), values, 5e-6)
    wanted = reference(*values)
    found = [selective_scan(*values, backend="triton") for _ in range(2)]
    assert torch.equal(*found)
    assert float((found[0] - wanted).abs().max()) <= 1e-6 * float(wanted.abs().max())
