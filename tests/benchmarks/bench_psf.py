"""The PSF beside prysm, hcipy, poppy, scipy and finufft: `python tests/benchmarks/bench_psf.py
[REPEATS] [OPTIONS]`.

`--one-thread` takes the least processor time of one thread instead of the median of the time on two
threads, for a machine on which others compute. `--size 2160 64` takes one size. `--part forward`
takes one table (forward, methods, backward, spectra). `--fast` leaves out plain matrices: those of
the peers for windows of 1024 and more, where they take six to thirty times as long as ours, and
those with torch's own gradient. Everybody gets the same number of threads and the same clear or
defocused disc at 550 nm, and returns the intensity. The peers are handed the complex pupil and keep
their operators; ours keeps its own, starts from the height map and makes the phase each time. What
making the complex64 pupil costs in NumPy is a row of its own, and a column adds it to the peers;
the other way round, `neusee, ready pupil` is handed it as they are, and computes in torch. Calls
are interleaved, so that a loaded machine slows all alike, and each is preceded by a pause and by a
call that does not count, because the threads of one library spin for a while and would slow the
next. The error is against the double sum in complex128 on a subset of rows and columns, relative to
the peak. Prints tables in Markdown.
"""

# ruff: noqa: E402 (threads are set before anybody starts theirs)
import os
import sys

ONE = "--one-thread" in sys.argv
THREADS = 1 if ONE else 2
os.environ.update(
    {name: str(THREADS) for name in ("OMP_NUM_THREADS", "OPENBLAS_NUM_THREADS", "MKL_NUM_THREADS")}
)

import math
import statistics
import subprocess
import time
import warnings
from functools import partial
from pathlib import Path

import numpy as np
import scipy.fft
import scipy.signal
import torch

warnings.simplefilter("ignore")
import finufft
import hcipy
import poppy.matrixDFT
import prysm.propagation
from prysm.conf import config

from neusee.nodes.optics import psf
from neusee.nodes.optics._psf import _Camera, _focus
from neusee.nodes.optics.transform import Grids, transform
from neusee.nodes.values import Pupil

WAVELENGTH, FOCAL, PIXEL, DIAMETER, INDEX = 550e-9, 0.11, 2.9e-6, 2160 * 3.74e-6, 0.46
SIZES = [(2160, 2048), (2160, 1024), (2160, 512), (2160, 256), (2160, 64), (1024, 1024), (256, 256)]
SLOW = 1.0  #: seconds beyond which a peer is called twice only


def pupil(n, waves=0.0, wavelengths=(WAVELENGTH,), height=None):
    """A clear disc of n samples, with ``waves`` of defocus cut into the element."""
    x = (torch.arange(n) - (n - 1) / 2) / (n / 2)
    square = x[:, None] ** 2 + x**2
    disc = (square <= 1).float()
    height = (square * waves * WAVELENGTH / INDEX).float() * disc if height is None else height
    bands = torch.tensor(wavelengths, dtype=torch.float64)
    pitch = torch.tensor(DIAMETER / n, dtype=torch.float64)
    return Pupil(disc, disc, height, torch.zeros_like(disc), INDEX + 0 * bands, bands, pitch)


def field(p, kind=np.complex64):
    turns = p.height.double() * (INDEX / WAVELENGTH)
    return (p.amplitude * torch.exp(2j * torch.pi * turns)).numpy().astype(kind)


def pupil_call(p):
    """The complex64 pupil from the height map, with no copy more than NumPy needs."""
    height, amplitude = p.height.numpy(), p.amplitude.numpy()

    def call():
        angle, made = (
            np.float32(2 * np.pi * INDEX / WAVELENGTH) * height,
            np.empty(height.shape, np.complex64),
        )
        np.cos(angle, out=made.real)
        np.sin(angle, out=made.imag)
        return np.multiply(made, amplitude, out=made)

    return call


def ours(p, k, method="auto"):
    camera = _Camera(FOCAL, PIXEL, (k, k))
    return lambda: _focus(p, camera, torch.float32, method).intensity[0].numpy()


def by_torch(p, k):
    """Ours where there is no compiler, by grids."""
    return _focus(p, _Camera(FOCAL, PIXEL, (k, k)), torch.float32, "kaiser_bessel")


def from_field(f, k):
    """Ours from the same ready complex pupil that the peers get."""
    n, ready = len(f), torch.from_numpy(f)
    alpha, centre = DIAMETER / n * PIXEL / (WAVELENGTH * FOCAL), (n - 1) / 2
    grids = Grids((alpha, alpha), (centre, centre), (k // 2, k // 2))
    return lambda: power(transform(ready, (k, k), grids).numpy())


def power(u):
    return u.real**2 + u.imag**2


def prysm_call(f, k, method):
    n, precision = len(f), 32 if f.dtype == np.complex64 else 64

    def call():
        config.precision = precision
        lengths = DIAMETER / n * 1e3, FOCAL * 1e3, WAVELENGTH * 1e6, PIXEL * 1e6
        return power(prysm.propagation.focus_fixed_sampling(f, *lengths, k, method=method))

    return call


def hcipy_call(f, k, kind):
    n, bin_ = len(f), 2 * np.pi * PIXEL / (WAVELENGTH * FOCAL)
    grids = [
        hcipy.CartesianGrid(hcipy.RegularCoords([d, d], [m, m], [-z * d, -z * d]))
        for d, m, z in ((DIAMETER / n, n, (n - 1) / 2), (bin_, k, k // 2))
    ]
    transform, values = kind(*grids), hcipy.Field(f.ravel(), grids[0])
    return lambda: power(np.asarray(transform.forward(values)).reshape(k, k))


def poppy_call(f, k):
    n_lam_d = k * PIXEL * DIAMETER / (WAVELENGTH * FOCAL)
    return lambda: power(
        poppy.matrixDFT.matrix_dft(f, n_lam_d, k, offset=(0.5, 0.5), centering="ADJUSTABLE")
    )


def scipy_call(f, k):
    n, turn = len(f), -2j * np.pi * DIAMETER / len(f) * PIXEL / (WAVELENGTH * FOCAL)
    czt = scipy.signal.CZT(n, k, np.exp(turn), np.exp(turn * (k // 2)))
    return lambda: power(czt(czt(f, axis=1), axis=0))


def finufft_call(f, k, eps, kind):
    n, step = len(f), 2 * np.pi * DIAMETER / len(f) * PIXEL / (WAVELENGTH * FOCAL)
    points = (step * (np.arange(k) - k // 2)).astype(
        "float32" if kind == "complex64" else "float64"
    )
    plans = [finufft.Plan(2, (n,), m, eps, -1, kind, nthreads=THREADS) for m in (n, k)]
    for plan in plans:
        plan.setpts(points)

    def call():
        rows = np.ascontiguousarray(plans[0].execute(f).T)
        return power(plans[1].execute(rows)).T

    return call


def contenders(n, k, p):
    f, exact = field(p), field(p, np.complex128)
    every = {
        "neusee": ours(p, k),
        "neusee, ready pupil": from_field(f, k),
        "hcipy ZoomFFT c64": hcipy_call(f, k, hcipy.ZoomFastFourierTransform),
        "hcipy MFT c64": hcipy_call(f, k, hcipy.MatrixFourierTransform),
        "prysm czt c64": prysm_call(f, k, "czt"),
        "prysm czt c128": prysm_call(exact, k, "czt"),
        "prysm mdft c64": prysm_call(f, k, "mdft"),
        "scipy CZT": scipy_call(f, k),
        "finufft 1d2 c64, 1e-6": finufft_call(f, k, 1e-6, "complex64"),
        "finufft 1d2 c128, 1e-8": finufft_call(exact, k, 1e-8, "complex128"),
        "poppy MFT": poppy_call(exact, k),
    }
    fast = "--fast" in sys.argv and k >= 1024
    return {
        name: call
        for name, call in every.items()
        if not (fast and {"MFT", "mdft"} & set(name.split()))
    }


def subset(p, k):
    """Rows and columns, and |U|^2 there, by the double sum in complex128."""
    n = len(p.height)
    pick = np.unique(
        np.r_[np.linspace(0, k - 1, 48).astype(int), np.clip(k // 2 + np.arange(-8, 9), 0, k - 1)]
    )
    j = np.arange(n) - (n - 1) / 2
    kernel = np.exp(
        -2j * np.pi * DIAMETER / n * PIXEL / (WAVELENGTH * FOCAL) * np.outer(pick - k // 2, j)
    )
    return np.ix_(pick, pick), power(kernel @ field(p, np.complex128) @ kernel.T)


def error(image, where, truth):
    """Largest error over the peak, after the best common scale: normalisations differ."""
    part = image[where].astype(np.float64)
    return float(
        np.abs(part * ((part * truth).sum() / (part**2).sum()) - truth).max() / truth.max()
    )


def seconds(call):
    """Time of a second call in a row, after the threads of whoever ran before have stopped
    spinning.
    """
    clock = time.process_time if ONE else time.perf_counter
    if not ONE:
        time.sleep(0.15)
        call()
    start = clock()
    call()
    return clock() - start


def interleaved(calls, repeats):
    """Median seconds of each call (on one thread the least), taken in turns; what is slow is
    taken twice.
    """
    times = {name: [] for name in calls}
    first = {name: seconds(call) for name, call in calls.items()}
    for turn in range(repeats):
        for name, call in calls.items():
            if turn < 2 or first[name] < SLOW:
                times[name].append(seconds(call))
    return {name: (min if ONE else statistics.median)(t) for name, t in times.items()}


def forward(repeats):
    print(
        "| pupil -> window | who | ms | of ours | with the pupil made | error, clear | error, 10"
        " waves |"
    )
    print("|---|---|---|---|---|---|---|")
    for n, k in SIZES:
        clear, bent = pupil(n), pupil(n, 10.0)
        calls, others = contenders(n, k, clear), contenders(n, k, bent)
        truths = subset(clear, k), subset(bent, k)
        times = interleaved({**calls, "made": pupil_call(bent)}, repeats)
        made, mine = times.pop("made"), times["neusee"]
        print(f"| {n} -> {k} | *the complex pupil alone, NumPy* | {1e3 * made:.1f} | | | | |")
        for name, t in sorted(times.items(), key=lambda item: item[1]):
            # ours with a ready pupil, too: as a peer
            whole = 1.0 if name == "neusee" else (t + made) / mine
            errors = error(calls[name](), *truths[0]), error(others[name](), *truths[1])
            print(f"| {n} -> {k} | {name} | {1e3 * t:.1f} | {t / mine:.2f} | {whole:.2f} | "
                  f"{errors[0]:.0e} | {errors[1]:.0e} |", flush=True)  # fmt: skip


def methods(repeats):
    names = ("auto", "kaiser_bessel", "bluestein", "folded", "direct")
    print("\n| pupil -> window | " + " | ".join(names) + " |\n|---|---|---|---|---|---|")
    for n, k in SIZES:
        times = interleaved({m: ours(pupil(n), k, m) for m in names}, repeats)
        print(
            f"| {n} -> {k} | " + " | ".join(f"{1e3 * times[m]:.1f}" for m in names) + " |",
            flush=True,
        )


def plain_autograd(p, k):
    """What one writes without us: complex matrix products and torch's own gradient."""
    n = len(p.height)
    j, x = torch.arange(n).double() - (n - 1) / 2, torch.arange(k).double() - k // 2
    turns = DIAMETER / n * PIXEL / (WAVELENGTH * FOCAL) * torch.outer(x, j)
    kernel = torch.exp(-2j * torch.pi * turns).to(torch.complex64)

    def image(height):
        u = (
            kernel
            @ (p.amplitude * torch.exp(2j * torch.pi * INDEX / WAVELENGTH * height))
            @ kernel.T
        )
        return u.abs().square()

    return image


def backward(repeats):
    print(
        "\n| pupil -> window | forward ms | forward + backward ms | ratio | the same without C++ |"
        " ratio of both | torch autograd, matrices: f + b ms |\n|---|---|---|---|---|---|---|"
    )
    for n, k in SIZES:
        p = pupil(n, 3.0)
        camera = dict(focal_length=FOCAL, pixel_pitch=PIXEL, shape=(k, k))
        weight = torch.rand(k, k)

        def learn(image, p=p, weight=weight):
            height = p.height.clone().requires_grad_()
            (image(height) * weight).sum().backward()

        def image(height, p=p, camera=camera):
            return psf(p._replace(height=height), **camera).intensity[0]

        def grids(height, p=p, k=k):
            return by_torch(p._replace(height=height), k).intensity[0]

        calls = {"f": ours(p, k), "fb": partial(learn, image), "grids": partial(learn, grids)}
        if "--fast" not in sys.argv:
            calls["torch"] = partial(learn, plain_autograd(p, k))
        t = interleaved(calls, repeats)
        print(f"| {n} -> {k} | {1e3 * t['f']:.1f} | {1e3 * t['fb']:.1f} | {t['fb'] / t['f']:.2f} | "
              f"{1e3 * t['grids']:.1f} | {t['fb'] / t['grids']:.2f} | "
              f"{1e3 * t.get('torch', math.nan):.0f} |",
              flush=True)  # fmt: skip


def peak_gigabytes():
    """Largest resident size of this process since its peak was last cleared."""
    (line,) = (
        x for x in Path("/proc/self/status").read_text().splitlines() if x.startswith("VmHWM")
    )
    return int(line.split()[1]) / 2**20


def all_bands(who, learn=False):
    """31 bands from one rough height map, at full size; prints seconds and peak GB. Runs in its
    own process.
    """
    torch.manual_seed(1)
    bands = [400e-9 + 10e-9 * i for i in range(31)]
    p = pupil(2160, wavelengths=bands, height=1e-6 * torch.rand(2160, 2160))
    # the peak so far, the parent's too, no longer counts
    Path("/proc/self/clear_refs").write_text("5")
    before = peak_gigabytes()
    start, worked = time.perf_counter(), time.process_time()
    if who == "neusee":
        height = p.height.requires_grad_(learn)
        out = psf(
            p._replace(height=height), focal_length=FOCAL, pixel_pitch=PIXEL, shape=(2048, 2048)
        ).intensity
        if learn:
            out.backward(torch.ones(()).expand_as(out))
    else:
        out = np.empty((31, 2048, 2048), np.float32)
        for band, wavelength in enumerate(bands):
            globals()["WAVELENGTH"] = wavelength
            out[band] = hcipy_call(field(p), 2048, hcipy.ZoomFastFourierTransform)()
    took, worked, after = (
        time.perf_counter() - start,
        time.process_time() - worked,
        peak_gigabytes(),
    )
    print(f"{took:.2f} {worked:.2f} {after:.2f} {before:.2f}")


def spectra():
    print(
        "\n| 31 bands, height -> 2048^2 PSFs, a process of its own, cold | s (three runs) |"
        " processor s | peak GB | before the call |\n|---|---|---|---|---|"
    )
    for who, title in (
        ("neusee", "neusee"),
        ("learn", "neusee, forward + backward"),
        ("hcipy", "hcipy ZoomFFT c64"),
    ):
        command = [sys.executable, __file__, "--bands", who, *["--one-thread"] * ONE]
        runs = [
            subprocess.run(command, capture_output=True, text=True, check=True).stdout.split()[-4:]
            for _ in range(3)
        ]
        took, worked, peak, before = zip(*runs, strict=True)
        print(
            f"| {title} | {', '.join(took)} | {', '.join(worked)} | {max(peak)} | {before[0]} |",
            flush=True,
        )


if __name__ == "__main__":
    torch.set_num_threads(THREADS)
    with scipy.fft.set_workers(THREADS):
        if "--bands" in sys.argv:
            who = sys.argv[sys.argv.index("--bands") + 1]
            all_bands("hcipy" if who == "hcipy" else "neusee", learn=who == "learn")
        else:
            repeats = int(sys.argv[1]) if sys.argv[1:] and sys.argv[1].isdigit() else 9
            if "--size" in sys.argv:
                SIZES[:] = [tuple(int(n) for n in sys.argv[sys.argv.index("--size") + 1 :][:2])]
            part = sys.argv[sys.argv.index("--part") + 1] if "--part" in sys.argv else ""
            print(
                f"load {os.getloadavg()[0]:.1f} at the start, torch {torch.__version__}, {repeats}"
                " repeats\n"
            )
            for table in (forward, methods, backward):
                if part in ("", table.__name__):
                    table(repeats)
            if part in ("", "spectra"):
                spectra()
            print(f"\nload {os.getloadavg()[0]:.1f} at the end")
