"""The C++ at each width of a vector, against float64 definitions and against the C++ at the other
widths.

The PSF has the same bits everywhere. The scan has the same bits on all processors that fuse a
product and a sum.
"""

import ctypes
import platform
import shutil
import subprocess
from itertools import pairwise
from pathlib import Path

import pytest
import torch

from neusee.nodes import cpp_library
from neusee.nodes.optics.transform import (
    Axis,
    Sampling,
    View,
    _fused,
    centred,
    fused_axis,
    intensity_of,
    last_type,
    work_by_axis,
)
from neusee.nodes.restore.networks import _selective_scan, selective_scan

pytestmark = [pytest.mark.slow, pytest.mark.skipif(shutil.which("g++") is None, reason="no g++")]

#: bytes of a vector, and the flags in /proc/cpuinfo without which the processor cannot run the code
LEVELS = {
    "x86-64-v2": (16, {"sse4_2", "ssse3", "popcnt"}),
    "x86-64-v3": (32, {"avx2", "fma", "bmi1", "bmi2", "f16c", "movbe"}),
    "x86-64-v4": (64, {"avx512f", "avx512bw", "avx512cd", "avx512dq", "avx512vl"}),
}
#: samples (v, u) of the pupil and pixels (y, x) of the window: every remainder of every number of
#: lanes
SHAPES = [((n + 2, n), (n, n + 1)) for n in range(1, 18)]
SHAPES += [
    ((64, 64), (64, 64)),
    ((301, 240), (33, 47)),
    ((17, 240), (250, 3)),
    ((48, 61), (350, 340)),
]
#: types of the pupil and of the result
TYPES = [
    (torch.float32, torch.float32),
    (torch.float64, torch.float32),
    (torch.float64, torch.float64),
]
LIMIT = {torch.float32: 2e-6, torch.float64: 1e-12}
DRIVER = Path(__file__).with_name("psf_driver.cpp")


def processor_flags() -> set[str]:
    try:
        lines = Path("/proc/cpuinfo").read_text(encoding="utf-8").splitlines()
    except OSError:
        return set()
    return set(next((line for line in lines if line.startswith("flags")), "").split())


def skip_unless_it_runs(level):
    if platform.machine() not in ("x86_64", "AMD64"):
        pytest.skip(f"a processor of type {platform.machine()} runs no {level}")
    missing = LEVELS[level][1] - processor_flags()
    if missing:
        pytest.skip(f"this processor runs no {level}: it lacks {', '.join(sorted(missing))}")


@pytest.fixture(scope="module")
def compiled(tmp_path_factory):
    """Return a function that makes the C++ of one level the one that is used, in a folder of its
    own.
    """
    with pytest.MonkeyPatch.context() as patch:
        patch.setenv("XDG_CACHE_HOME", str(tmp_path_factory.mktemp("libraries")))

        def at(level):
            skip_unless_it_runs(level)
            patch.setenv("CXX", f"g++ -march={level}")

        yield at


def optics(samples, pixels, kind, dtype):
    """Return random factors of a pupil (amplitude, height, path), and a view with tilt and
    envelope in two bands.
    """
    draw = torch.Generator().manual_seed(sum(samples) + sum(pixels))
    height, path, grey = (
        torch.rand(samples, generator=draw, dtype=torch.float64) for _ in range(3)
    )
    lit = torch.rand(samples, generator=draw) < 0.8
    lit[samples[0] // 2, samples[1] // 2] = True
    factors = [x.to(kind) for x in (lit * grey, 7 * height, path)]
    # at most a tenth of the alias-free field, so that the window is one that the Kaiser-Bessel
    # kernel is made for
    rows, columns = (Axis(n, k, 0.4 / max(n, k)) for n, k in zip(samples, pixels, strict=True))
    envelope = tuple((1 + torch.rand(k, generator=draw)).to(dtype) for k in pixels)
    views = (
        View(0, rows, columns, 1.5, 0.0, (0.01, -0.02), 0.7, envelope),
        View(1, rows, columns, 0.9, 2.1, (0, 0), 2),
    )
    return factors, views


def intensity(factors, views, dtype):
    return intensity_of(*factors, Sampling(views, dtype, "fused"))


def definition(factors, views):
    """Return weight * envelope * |K_y P K_x^T|^2 by matrices in complex128, with torch's own
    gradient.
    """
    amplitude, height, path = (x.double() for x in factors)
    images = []
    for view in views:
        v, u = (centred(n, torch.device("cpu")) for n in height.shape)
        turns = (
            view.turns_height * height
            + view.turns_path * path
            + view.tilt[0] * v[:, None]
            + view.tilt[1] * u
        )
        sums = [
            torch.exp(-2j * torch.pi * axis.alpha * torch.outer(centred(axis.n_out, v.device), x))
            for axis, x in ((view.rows, v), (view.columns, u))
        ]
        field = sums[0] @ (amplitude * torch.exp(2j * torch.pi * turns)) @ sums[1].T
        y, x = view.envelope or (torch.ones(view.rows.n_out), torch.ones(view.columns.n_out))
        images.append(view.weight * y.double()[:, None] * x.double() * field.abs().square())
    return torch.stack(images)


def image_and_slopes(evaluate, factors, weight):
    inputs = [x.clone().requires_grad_() for x in factors]
    image = evaluate(inputs)
    return [image.detach(), *torch.autograd.grad((image * weight).sum(), inputs)]


def results(samples, pixels, kind, dtype):
    """Return the intensity and three gradients by C++, and the same by the definition."""
    factors, views = optics(samples, pixels, kind, dtype)
    weight = torch.rand(2, *pixels, generator=torch.Generator().manual_seed(1), dtype=torch.float64)
    ours = image_and_slopes(lambda x: intensity(x, views, dtype), factors, weight.to(dtype))
    truth = image_and_slopes(lambda x: definition(x, views), [x.double() for x in factors], weight)
    return ours, truth


def bound(factors, views):
    """Return the largest intensity that any phase could give: light that all arrives in phase."""
    total = float(factors[0].double().sum())
    return 4 * max(view.weight for view in views) * total**2


@pytest.mark.parametrize("level", LEVELS)
def test_a_vector_is_as_wide_as_the_registers(compiled, level):
    compiled(level)
    assert _fused.operators().neusee_psf_vector_bytes() == LEVELS[level][0]
    assert _selective_scan.operators().neusee_scan_vector_bytes() == LEVELS[level][0]


@pytest.mark.parametrize("level", LEVELS)
def test_the_psf_is_its_definition_and_its_bits_are_those_of_every_width(compiled, level):
    compiled(level)
    reference = {}
    for samples, pixels in SHAPES:
        for kind, dtype in TYPES:
            ours, truth = results(samples, pixels, kind, dtype)
            reference[samples, pixels, kind, dtype] = ours
            largest = bound(*optics(samples, pixels, kind, dtype))
            assert float((ours[0] - truth[0]).abs().max()) <= LIMIT[dtype] * largest
            for found, slope in zip(ours[1:], truth[1:], strict=True):
                # one sample alone has slope 0: there 1, as that of two
                size = max(float(slope.abs().max()), 1.0)
                assert float((found - slope).abs().max()) <= 3 * LIMIT[dtype] * size
    compiled("x86-64-v2")
    for case, expected in reference.items():
        again, _ = results(*case)
        assert all(torch.equal(a, b) for a, b in zip(again, expected, strict=True)), case


def test_the_cases_transform_in_all_three_pairs_of_types():
    pairs = set()
    for samples, pixels in SHAPES:
        for kind, dtype in TYPES:
            view = optics(samples, pixels, kind, dtype)[1][0]
            pairs.add(
                (
                    dtype,
                    last_type(
                        *work_by_axis(view.rows, view.columns), dtype, _fused._FLOAT64_WORK_SHARE
                    ),
                )
            )
    assert pairs == set(_fused._NAMES)


def scan_results(d, n, dtype, evaluate):
    draw = torch.Generator().manual_seed(d)
    u, B, C = (torch.randn(2, 70, m, generator=draw, dtype=torch.float64) for m in (d, n, n))
    dt = torch.rand(2, 70, d, generator=draw, dtype=torch.float64)
    A = -torch.rand(d, n, generator=draw, dtype=torch.float64) - 0.1
    inputs = [x.to(dtype).requires_grad_() for x in (u, dt, A, B, C)]
    y = evaluate(*inputs)
    weight = torch.rand(y.shape, generator=draw, dtype=torch.float64).to(dtype)
    return [y.detach(), *torch.autograd.grad((y * weight).sum(), inputs)]


def scan_by_loop(u, dt, A, B, C):
    """Return y by the loop over time that defines the scan."""
    state, rows = u.new_zeros(len(u), *A.shape), []
    for push, step, into, out in zip(
        (dt * u).unbind(1), dt.unbind(1), B.unbind(1), C.unbind(1), strict=True
    ):
        state = torch.exp(step[..., None] * A) * state + push[..., None] * into[:, None]
        rows.append((state @ out[..., None])[..., 0])
    return torch.stack(rows, 1)


@pytest.mark.parametrize("level", LEVELS)
@pytest.mark.parametrize("dtype", [torch.float32, torch.float64])
def test_the_scan_and_its_gradient_are_the_loop(compiled, level, dtype):
    compiled(level)
    for d in (1, 3, 4, 7, 16, 17, 40):
        ours = scan_results(d, 3, dtype, selective_scan)
        truth = scan_results(d, 3, torch.float64, scan_by_loop)
        rounding = 4e-6 if dtype == torch.float32 else 1e-13
        for found, expected in zip(ours, truth, strict=True):
            assert float((found - expected).abs().max()) <= rounding * float(expected.abs().max())


def test_the_scan_has_the_same_bits_at_every_width_with_fma(compiled):
    both = []
    for level in ("x86-64-v3", "x86-64-v4"):
        compiled(level)
        both.append(
            [
                scan_results(d, 3, t, selective_scan)
                for d in (5, 16, 45, 100)
                for t in (torch.float32, torch.float64)
            ]
        )
    for narrow, wide in pairwise(both):
        assert all(
            torch.equal(a, b)
            for x, y in zip(narrow, wide, strict=True)
            for a, b in zip(x, y, strict=True)
        )


#: a compiler, and the program that runs what it compiles
TARGETS = {
    "x86-64-v2": ("g++ -march=x86-64-v2", ""),
    "aarch64": ("aarch64-linux-gnu-g++", "qemu-aarch64 -L /usr/aarch64-linux-gnu"),
    "clang": ("clang++ -march=x86-64-v3", ""),
}


@pytest.fixture(scope="module")
def driver(tmp_path_factory):
    """Return a function that compiles the driver for a target, once, or skips the test."""
    folder = tmp_path_factory.mktemp("drivers")

    def compile_for(target):
        compiler, runner = (words.split() for words in TARGETS[target])
        for program in (compiler[0], *runner[:1]):
            if shutil.which(program) is None:
                pytest.skip(f"no {program}")
        if not runner:
            skip_unless_it_runs(compiler[-1].removeprefix("-march="))
        program = folder / target
        if not program.exists():
            flags = [
                flag
                for flag in cpp_library.FLAGS
                if not flag.startswith(("-march", "-fopenmp", "-shared"))
            ]
            include = f"-I{_fused.SOURCES[0].parent.resolve()}"
            command = [*compiler, *flags, cpp_library.UNFUSED, include, DRIVER, "-o", program]
            subprocess.run(command, check=True)
        return [*runner, program]

    return compile_for


@pytest.mark.parametrize("target", TARGETS)
@pytest.mark.parametrize("kinds", list(_fused._NAMES))
def test_another_target_and_compiler_give_the_same_bits(tmp_path, driver, target, kinds):
    """A driver in C++ calls the transform as Python does, because the Python here loads no code
    of another target.
    """
    command, dtype = driver(target), kinds[0]
    samples, pixels = ((61, 47), (90, 97)) if kinds == (torch.float32,) * 2 else ((70, 83), (9, 7))
    factors, views = optics(samples, pixels, torch.float64, dtype)
    view = views[0]
    assert (
        last_type(*work_by_axis(view.rows, view.columns), dtype, _fused._FLOAT64_WORK_SHARE)
        == kinds[1]
    )
    data, result = tmp_path / "in", tmp_path / "out"
    data.write_bytes(b"".join(packed(x) for x in arguments(factors, view, *kinds)))
    subprocess.run([*command, data, result], check=True)
    image = torch.frombuffer(bytearray(result.read_bytes()), dtype=dtype).view(pixels)
    expected = intensity(factors, (view,), dtype)[0]
    assert torch.equal(image, expected)


def packed(array):
    """Return the number of bytes of an array and its bytes."""
    content = array.contiguous().numpy().tobytes()
    return len(content).to_bytes(8, "little") + content


def arguments(factors, view, dtype, kind):
    """Yield what the driver reads: the pair of types, both axes, the pupil and the window."""
    yield torch.tensor([list(_fused._NAMES).index((dtype, kind))])
    for axis, gathered in ((view.rows, dtype), (view.columns, kind)):
        plan = fused_axis(axis, dtype, gathered, kind)
        names = [name for name, of in plan._fields_ if of is ctypes.c_int64]
        yield torch.tensor([getattr(plan, name) for name in names])
        yield from plan.held
    yield from factors
    yield torch.tensor([view.turns_height, view.turns_path, view.weight], dtype=torch.float64)
    for n, tilt in zip(factors[0].shape, view.tilt, strict=True):
        yield centred(n, torch.device("cpu")) * tilt
    yield from view.envelope
