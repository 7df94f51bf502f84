"""The selective scan against the loop that defines it: any length, any decay, both backends, one
derivative.
"""

import hashlib
import os
import shutil
import subprocess
import sys
from functools import lru_cache
from pathlib import Path

import numpy as np
import pytest
import torch
from torch.utils._python_dispatch import TorchDispatchMode

from neusee.nodes import cpp_library
from neusee.nodes.restore.networks import ScanPlan, _selective_scan, reference, selective_scan

ROOT = Path(__file__).parents[4]
RATES = [1e-6, 1e-3, 0.1, 1.0, 50.0, 200.0, "mix"]


@pytest.fixture(scope="session")
def cpp():
    """One compilation for all, of a second or two, where the user keeps such libraries."""
    if shutil.which("g++") is None:
        pytest.skip("no g++: the torch backend is tested by itself")
    _selective_scan.operators()  # where there is a compiler, code that does not compile is a failure


#: the scan in torch as it runs on a processor and, in pairs of steps, on a GPU; and the one in C++
@pytest.fixture(params=["torch", "pairs", "cpp"])
def backend(request):
    if request.param == "cpp":
        request.getfixturevalue("cpp")
    return request.param


def plan_of_a_gpu(length, width, cuda, plan=_selective_scan.plan_scan):
    return plan(length, width, cuda=True)


def scan_by(*values, backend):
    """The scan by one of the two backends, as the environment selects it; ``pairs`` is that in
    torch with the plan of a GPU.
    """
    with pytest.MonkeyPatch.context() as environment:
        environment.setenv("NEUSEE_SCAN", "torch" if backend == "pairs" else backend)
        if backend == "pairs":
            environment.setattr(_selective_scan, "plan_scan", plan_of_a_gpu)
        return selective_scan(*values)


def draw(length, d=4, n=4, *, batch=1, rate=None, kind=torch.float64, seed=0, even=False):
    """u, dt, A, B, C with dt |A| about ``rate``, or spread by logarithms over 1e-6 to 50, or of
    many sizes.
    """
    rng = torch.Generator().manual_seed(seed)
    one = {"dtype": torch.float64, "generator": rng}
    u, B, C = (torch.randn(batch, length, m, **one) for m in (d, n, n))
    dt = torch.ones(batch, length, d, dtype=torch.float64)
    dt = dt if even else dt * (0.5 + torch.rand(batch, length, d, **one))
    if rate == "mix":
        A = -torch.logspace(-6, np.log10(50), d * n, dtype=torch.float64).view(d, n)
    else:
        A = (
            -torch.rand(d, n, **one) - 0.1
            if rate is None
            else torch.full((d, n), -rate, dtype=torch.float64)
        )
    return [x.to(kind) for x in (u, dt, A, B, C)]


def loop(u, dt, A, B, C):
    """The definition, in NumPy and float64: nothing of ours."""
    u, dt, A, B, C = (x.double().numpy() for x in (u, dt, A, B, C))
    decay = np.exp(dt[..., None] * A)
    push, h = (dt * u)[..., None] * B[:, :, None], np.zeros((len(u), *A.shape))
    states = np.empty_like(push)
    for t in range(u.shape[1]):
        states[:, t] = h = decay[:, t] * h + push[:, t]
    return torch.from_numpy((states * C[:, :, None]).sum(-1))


@lru_cache(maxsize=24)
def long_line(rate, kind, even, d=4, n=4, seed=0):
    """A line of 65536 with its truth: the loop of as many steps is run once for all backends and
    plans.
    """
    values = draw(65_536, d, n, rate=rate, kind=kind, even=even, seed=seed)
    return values, loop(*values)


def worst(found, truth):
    assert found.shape == truth.shape
    assert bool(found.isfinite().all())
    return float(
        (found.detach().double() - truth.detach()).abs().max()
        / truth.detach().abs().max().clamp_min(1e-300)
    )


def gradients(scan, values, seen):
    leaves = [x.clone().requires_grad_() for x in values]
    return torch.autograd.grad((scan(*leaves) * seen).sum(), leaves)


@pytest.mark.slow
@pytest.mark.parametrize("even", [False, True])
@pytest.mark.parametrize("rate", RATES)
def test_a_long_line_is_that_of_the_loop(rate, even, backend):
    values, truth = long_line(rate, torch.float32, even)
    assert worst(scan_by(*values, backend=backend), truth) < (8e-7 if backend == "torch" else 3e-7)


@pytest.mark.slow
@pytest.mark.parametrize("seed", [1, 2])
@pytest.mark.parametrize("steps", [(16, 1), (10, 9), (1000, 1, True)])
def test_a_state_that_hardly_decays_is_not_rounded_away_in_wide_lines(monkeypatch, steps, seed):
    """As many carries as lines of 1536 numbers and more have; 2e-6 where they are in single
    precision.
    """
    values, truth = long_line(1e-6, torch.float32, True, 2, 2, seed)
    monkeypatch.setattr(_selective_scan, "plan_scan", lambda *_: ScanPlan(*steps))
    assert worst(scan_by(*values, backend="torch"), truth) < 4e-7


@pytest.mark.parametrize("rate", [1e-6, "mix", 200.0])
def test_a_long_line_in_double_precision(rate, backend):
    values, truth = long_line(rate, torch.float64, False)
    assert worst(scan_by(*values, backend=backend), truth) < 1e-12


@pytest.mark.parametrize(
    ("length", "d", "n", "batch"),
    [(1, 1, 1, 1), (2, 3, 2, 1), (31, 16, 4, 2), (33, 17, 1, 3), (257, 5, 7, 1), (1021, 33, 16, 2)],
)
def test_any_size_and_its_gradients(length, d, n, batch, backend):
    values = draw(length, d, n, batch=batch)
    seen = torch.randn(
        batch, length, d, dtype=torch.float64, generator=torch.Generator().manual_seed(1)
    )
    assert worst(scan_by(*values, backend=backend), reference(*values)) < 1e-13
    found = gradients(lambda *x: scan_by(*x, backend=backend), values, seen)
    for one, truth in zip(found, gradients(reference, values, seen), strict=True):
        assert worst(one, truth) < 1e-12 or (length == 1 and not truth.any())


@pytest.mark.slow
@pytest.mark.usefixtures("cpp")
@pytest.mark.parametrize("rate", [1e-6, 1e-2, 50.0, "mix", None])
def test_gradients_in_single_precision(rate):
    values = draw(1500, 3, 2, rate=rate, kind=torch.float32)
    seen = torch.randn(1, 1500, 3, generator=torch.Generator().manual_seed(1))
    truth = gradients(reference, [x.double() for x in values], seen.double())
    for backend in ("torch", "pairs", "cpp"):
        found = gradients(lambda *x, b=backend: scan_by(*x, backend=b), values, seen)
        assert max(map(worst, found, truth)) < 5e-6, backend


@pytest.mark.parametrize(
    "steps",
    [
        *[(1, 1), (5, 1), (3, 4), (1, 7), (40, 1), (6, 7)],
        *[(1, 1, True), (2, 1, True), (3, 1, True), (13, 1, True), (40, 1, True)],
    ],
)
def test_any_cut_of_the_length_gives_the_same(monkeypatch, steps):
    values, seen = draw(40, 3, 2), torch.randn(1, 40, 3, dtype=torch.float64)
    monkeypatch.setattr(_selective_scan, "plan_scan", lambda *_: ScanPlan(*steps))
    found = gradients(lambda *x: scan_by(*x, backend="torch"), values, seen)
    for one, truth in zip(found, gradients(reference, values, seen), strict=True):
        assert worst(one, truth) < 1e-12


class Operations(TorchDispatchMode):
    """Counts the operations of torch and the elements that they write."""

    def __init__(self):
        super().__init__()
        self.count = self.elements = 0

    def __torch_dispatch__(self, func, types, args=(), kwargs=None):
        result = func(*args, **(kwargs or {}))
        if not func.is_view:
            self.count += 1
            self.elements += result.numel()
        return result


def test_pairs_take_few_operations_and_work_in_proportion_to_the_length():
    """A loop would take as many operations as steps; pairs without reuse the length times its
    logarithm of products.
    """
    cost = {}
    for length in (512, 4096):
        h, lost = torch.rand(length, 1, 1, 2, 2), -torch.rand(length, 1, 1, 2, 2)
        with Operations() as cost[length]:
            _selective_scan._scan_in_pairs(h, lost, back=False)
    added_levels = 3
    assert cost[4096].count - cost[512].count <= 8 * added_levels
    assert cost[4096].count <= 8 * 12
    assert cost[4096].elements <= 8.1 * cost[512].elements


@pytest.mark.usefixtures("cpp")
def test_both_backends_give_the_same_numbers():
    values = draw(3001, 19, 5, batch=2, kind=torch.float32)
    assert (
        worst(
            scan_by(*values, backend="torch"),
            scan_by(*values, backend="cpp").double(),
        )
        < 1e-6
    )


@pytest.mark.usefixtures("cpp")
def test_the_number_of_threads_changes_nothing_but_roundings(monkeypatch):
    values, seen = draw(300, 40, 3, batch=1), torch.ones(1, 300, 40, dtype=torch.float64)
    found = []
    for threads in (1, 3):
        monkeypatch.setattr(torch, "get_num_threads", lambda n=threads: n)
        found.append(gradients(lambda *x: scan_by(*x, backend="cpp"), values, seen))
    assert all(worst(one, other) < 1e-13 for one, other in zip(*found, strict=True))


def test_gradcheck(backend):
    values = [x.requires_grad_() for x in (*draw(17, 3, 2), torch.randn(3, dtype=torch.float64))]
    assert torch.autograd.gradcheck(lambda *x: scan_by(*x, backend=backend), values)


def test_a_second_derivative_is_refused(backend):
    leaves = [x.requires_grad_() for x in draw(9, 3, 2)]
    y = scan_by(*leaves, backend=backend)
    with pytest.raises(RuntimeError, match="no second derivative"):
        torch.autograd.grad(y.sum(), leaves, create_graph=True)


def test_half_precision_and_autocast_are_computed_in_single(backend):
    halves = [x.bfloat16() for x in draw(400, 8, 4)]
    singles = [x.float() for x in halves]
    seen = torch.randn(1, 400, 8, generator=torch.Generator().manual_seed(1))
    expected = gradients(lambda *x: scan_by(*x, backend=backend), singles, seen)
    with torch.autocast("cpu", dtype=torch.bfloat16):
        y = scan_by(*halves, backend=backend)
        found = gradients(lambda *x: scan_by(*x, backend=backend), singles, seen)
    assert y.dtype == torch.float32
    assert torch.equal(y, scan_by(*singles, backend=backend))
    assert all(torch.equal(a, b) for a, b in zip(found, expected, strict=True))


def test_decays_that_leave_nothing_and_lines_of_nothing(backend):
    u, dt, A, B, C = draw(300, 3, 2, kind=torch.float32)
    for dt_, u_ in ((dt * 1e30, u), (dt * 0, u), (dt, u * 0), (dt * 1e-38, u)):
        values = (u_, dt_, A, B, C)
        y = scan_by(*values, backend=backend)
        assert bool(y.isfinite().all())
        found = gradients(lambda *x: scan_by(*x, backend=backend), values, torch.ones_like(u))
        assert all(bool(x.isfinite().all()) for x in found)
    assert not scan_by(u * 0, dt, A, B, C, backend=backend).any()


@pytest.mark.usefixtures("cpp")
def test_a_state_that_dies_away_never_gets_to_the_slow_subnormal_numbers():
    u, dt, A, B, C = draw(3000, 4, 1, rate=0.7, kind=torch.float32, even=True)
    u[:, 1:] = 0
    y = scan_by(u, dt, A, B, torch.ones_like(C), backend="cpp").abs()
    tiny = torch.finfo(torch.float32).tiny
    assert bool((y[:, :100] > 0).all() & (y[:, 1000:] < 10 * tiny).all())
    assert not bool(((y > 0) & (y < tiny)).any())
    assert torch.tensor(1e-40).mul(0.5).item() > 0, "others still have such numbers"


def test_a_value_that_is_no_number_is_not_hidden(backend):
    u, dt, A, B, C = draw(50, 3, 2, kind=torch.float32)
    dt[0, 20, 1] = float("nan")
    y = scan_by(u, dt, A, B, C, backend=backend)
    assert bool(y[:, :20].isfinite().all())
    assert bool(y[:, 20:, 1].isnan().all())
    assert bool(y[:, :, [0, 2]].isfinite().all())


def test_strided_inputs_and_the_direct_path(backend):
    u, dt, A, B, C = draw(60, 5, 3)
    D = torch.linspace(-1, 1, 5, dtype=torch.float64)
    turned = [x.transpose(1, 2).contiguous().transpose(1, 2) for x in (u, dt, B, C)]
    y = scan_by(turned[0], turned[1], A.T.contiguous().T, turned[2], turned[3], D, backend=backend)
    assert worst(y, loop(u, dt, A, B, C) + D * u) < 1e-13
    assert worst(y, reference(u, dt, A, B, C, D)) < 1e-13


def test_the_backward_of_the_reference_is_linear_in_length():
    nodes, todo = (
        set(),
        [reference(*(x.requires_grad_() for x in draw(64, 2, 2))).grad_fn],
    )
    while todo:
        one = todo.pop()
        if one is not None and one not in nodes:
            nodes.add(one)
            todo += [f for f, _ in one.next_functions]
    assert sum(x.name() == "UnbindBackward0" for x in nodes) == 4, (
        "one for each line, none for a row"
    )
    assert len(nodes) < 64 * 20


@pytest.mark.parametrize("name", ["dt", "A", "B", "C", "D"])
def test_shapes_that_do_not_fit_are_named(name):
    values = dict(
        zip(("u", "dt", "A", "B", "C", "D"), (*draw(6, 3, 2), torch.zeros(3)), strict=True)
    )
    values[name] = values[name][..., :1]
    with pytest.raises(ValueError, match=rf"^(B|{name}) is \("):
        selective_scan(**values)


def test_what_cannot_be_scanned_is_refused():
    values = draw(6, 3, 2)
    with pytest.raises(ValueError, match="nothing to scan"):
        selective_scan(*(x[:, :0] if x.ndim == 3 else x for x in values))
    with pytest.raises(ValueError, match="real numbers in floating point"):
        selective_scan(*(x.to(torch.complex64) for x in values))
    with pytest.raises(ValueError, match=r"u must be \(batch, length, d\)"):
        selective_scan(values[0][0], *values[1:])
    with pytest.raises(ValueError, match="NEUSEE_SCAN is 'fast': write torch or cpp"):
        scan_by(*values, backend="fast")


def test_the_environment_chooses(monkeypatch):
    values, called = draw(6, 3, 2), []
    monkeypatch.setattr(_selective_scan, "compiled", lambda: called.append(1))
    monkeypatch.setenv("NEUSEE_SCAN", "torch")
    selective_scan(*values)
    assert not called
    monkeypatch.setenv("NEUSEE_SCAN", "cpp")
    selective_scan(*values)
    assert called
    monkeypatch.setenv("NEUSEE_SCAN", "fortran")
    with pytest.raises(ValueError, match="NEUSEE_SCAN is 'fortran'"):
        selective_scan(*values)


def test_without_a_compiler_torch_computes_and_it_is_said_once(monkeypatch, tmp_path):
    monkeypatch.setenv("XDG_CACHE_HOME", str(tmp_path))
    monkeypatch.setenv("CXX", str(tmp_path / "no-such-compiler"))
    cpp_library._say_once.cache_clear()
    values = draw(20, 3, 2)
    with pytest.warns(
        UserWarning, match="C\\+\\+ of the scan is not compiled and torch computes the scan"
    ) as said:
        found = [selective_scan(*values), scan_by(*values, backend="cpp")]
    assert len(said) == 1
    assert "\n" not in str(said[0].message)
    truth = scan_by(*values, backend="torch")
    assert all(torch.equal(y, truth) for y in found)
    assert not list(tmp_path.rglob("*.so"))


@pytest.mark.slow
@pytest.mark.skipif(shutil.which("g++") is None, reason="no g++")
def test_two_processes_that_compile_at_once_both_succeed(tmp_path):
    code = (
        "from neusee.nodes.restore.networks import _selective_scan;"
        " print(_selective_scan.operators().neusee_scan_steps())"
    )
    env = {**os.environ, "XDG_CACHE_HOME": str(tmp_path), "PYTHONPATH": str(ROOT / ".src")}
    runs = [
        subprocess.Popen([sys.executable, "-c", code], env=env, stdout=subprocess.PIPE)
        for _ in range(2)
    ]
    assert [run.communicate()[0] for run in runs] == [b"32\n"] * 2
    assert [x.suffix for x in (tmp_path / "neusee" / "build").iterdir()] == [".so"]


def test_the_digest_of_the_source_is_that_of_the_source():
    assert (
        hashlib.sha256(_selective_scan.CPP_FILE.read_bytes())
        .hexdigest()
        .startswith(_selective_scan.CPP_DIGEST)
    )
    assert len(_selective_scan.CPP_DIGEST) == 16


def test_what_is_kept_for_the_way_back_is_little():
    u, *others = draw(4096, 96, 16, kind=torch.float32)
    kept = []
    with torch.autograd.graph.saved_tensors_hooks(
        lambda x: (kept.append(x.numel()), x)[1], lambda x: x
    ):
        scan_by(u.requires_grad_(), *others, backend="torch")
    assert sum(kept) < 0.2 * 4096 * 96 * 16
