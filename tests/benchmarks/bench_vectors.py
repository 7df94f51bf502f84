"""The PSF in C++ and in torch, by instruction set and number of threads: `python
tests/benchmarks/bench_vectors.py [TURNS] [--level NAME] [--threads 1] [--up-to SAMPLES]`.

Each instruction set is a process of its own, in which the C++ is compiled for it, and torch, MKL
and OpenBLAS use no wider one; the FFTs of SciPy and finufft are as they were installed. All calls of a row are
made in turns in this process, small ones in more turns, and each of these behind the same call that
does not count: else a small call waits for its own code, which the calls of the others have driven
out of the cache. A time is the least of the turns, of the processor on one thread and of the clock
on two.

The peers keep their operators and are handed the ready complex pupil; ours starts from the height
map, makes every check of the node, and its time is compared both with that of the best peer and
with that peer and the pupil made in NumPy. Exact is a peer whose error is at most that of the node,
2e-6 of the peak, for 10 waves of defocus. The gradient is that of the height, its time without that
of the forward pass.

The rows stand in `results/psf_by_instruction_set.json`; new rows replace those of the same
instruction set, threads and size. C++ runs wherever there is a compiler, so that no ratio of torch
may be below 1: the script ends with an error there.
"""

import json
import os
import statistics
import subprocess
import sys
import time

LEVELS = {
    "x86-64-v2": {
        "ATEN_CPU_CAPABILITY": "default",
        "MKL_ENABLE_INSTRUCTIONS": "SSE4_2",
        "OPENBLAS_CORETYPE": "Nehalem",
    },
    "x86-64-v3": {
        "ATEN_CPU_CAPABILITY": "avx2",
        "MKL_ENABLE_INSTRUCTIONS": "AVX2",
        "OPENBLAS_CORETYPE": "Haswell",
    },
    "x86-64-v4": {},
}
THREAD_VARIABLES = ("OMP_NUM_THREADS", "OPENBLAS_NUM_THREADS", "MKL_NUM_THREADS")
SIZES = ((2160, 2048), (2160, 512), (2160, 64), (1024, 1024), (256, 256), (128, 64), (64, 64))
DOCUMENT = "psf_by_instruction_set"
COLUMNS = (
    "instruction set",
    "threads",
    "pupil -> window",
    "C++ ms",
    "median / least",
    "torch",
    "best exact peer",
    "peer",
    "peer and pupil",
    "error",
    "error of the peer",
    "gradient / forward",
)
EXACT = 2e-6  #: largest error over the peak
SMALL = 256  #: samples a side up to which the same call goes before each that counts
LARGE = 1024  #: plain matrices of the peers are left out for windows of this side and more


def gradient_call(psf, lens, camera):
    """Return a call of forward pass and gradient of the height."""
    import torch

    weight = torch.rand(camera["shape"], generator=torch.Generator().manual_seed(1))

    def call():
        height = lens.height.clone().requires_grad_()
        (psf(lens._replace(height=height), **camera).intensity[0] * weight).sum().backward()

    return call


def calls_of(samples, window, lens):
    """Return the calls of a row by name: ours, the making of the pupil, and the peers."""
    import bench_psf
    import torch

    from neusee.nodes.optics.transform import Axis, cheapest

    peers = bench_psf.contenders(samples, window, lens)
    for name in ("neusee", "neusee, ready pupil", "poppy MFT", "prysm czt c128"):
        peers.pop(name, None)
    if window >= LARGE:
        peers = {
            name: call for name, call in peers.items() if not {"MFT", "mdft"} & {*name.split()}
        }
    alpha = bench_psf.DIAMETER / samples * bench_psf.PIXEL
    axis = Axis(samples, window, alpha / (bench_psf.WAVELENGTH * bench_psf.FOCAL))
    camera = {
        "focal_length": bench_psf.FOCAL,
        "pixel_pitch": bench_psf.PIXEL,
        "shape": (window, window),
    }
    ours = {
        "C++": bench_psf.ours(lens, window, "fused"),
        "torch": bench_psf.ours(lens, window, cheapest(axis, axis, torch.device("cpu"))),
        "gradient": gradient_call(bench_psf.psf, lens, camera),
        "pupil": bench_psf.pupil_call(lens),
    }
    return ours, peers


def timed(calls, turns, clock, warm):
    """Return the times of each call, taken in turns after one that does not count; where ``warm``,
    such a call goes before each.
    """
    for call in calls.values():
        call()
    seconds = {name: [] for name in calls}
    for _ in range(turns):
        for name, call in calls.items():
            if warm:
                call()
            start = clock()
            call()
            seconds[name].append(clock() - start)
    return seconds


def row(level, threads, size, turns):
    """Return the cells of one row."""
    import bench_psf

    lens = bench_psf.pupil(size[0], 10.0)
    ours, peers = calls_of(*size, lens)
    where, truth = bench_psf.subset(lens, size[1])
    errors = {
        name: bench_psf.error(call(), where, truth)
        for name, call in {**peers, "C++": ours["C++"]}.items()
    }
    exact = {name: call for name, call in peers.items() if errors[name] <= EXACT}
    clock = time.process_time if threads == 1 else time.perf_counter
    turns *= max(1, min(20, (2160 // size[0]) ** 2))
    seconds = timed({**ours, **exact}, turns, clock, size[0] <= SMALL)
    least = {name: min(times) for name, times in seconds.items()}
    best, mine = min(exact, key=least.__getitem__), least["C++"]
    spread = statistics.median(seconds["C++"]) / mine
    ratios = [least["torch"] / mine, least[best] / mine, (least[best] + least["pupil"]) / mine]
    torch_ratio, peer_ratio, ready_ratio = (f"{ratio:.2f}" for ratio in ratios)
    return [
        *(level, str(threads), f"{size[0]} -> {size[1]}", f"{1e3 * mine:.3g}", f"{spread:.2f}"),
        *(torch_ratio, best, peer_ratio, ready_ratio),
        *(f"{errors['C++']:.0e}", f"{errors[best]:.0e}"),
        f"{(least['gradient'] - mine) / mine:.2f}",
    ]


def measure(level, threads, turns):
    """Print the rows of one instruction set as JSON; the environment is that of the level."""
    import scipy.fft
    import torch

    torch.set_num_threads(threads)
    with scipy.fft.set_workers(threads):
        for size in SIZES:
            if size[0] > int(option("--up-to", "2160")):
                continue
            print(json.dumps(row(level, threads, size, turns)), flush=True)


def keep(rows, turns):
    """Store rows, in place of earlier ones of the same instruction set, threads and size."""
    from stored_results import store, stored

    document = stored(DOCUMENT)
    [table] = document["tables"]
    earlier = table["rows"] if table["columns"] == list(COLUMNS) else []
    by_case = {tuple(cells[:3]): cells for cells in [*earlier, *rows]}
    load = os.getloadavg()[0]
    table |= {
        "columns": list(COLUMNS),
        "rows": [by_case[case] for case in sorted(by_case, key=_place)],
        "date": time.strftime("%Y-%m-%d"),
        "conditions": (
            f"Times are the least of {turns} turns, or more where they are small, of the processor"
            " on one thread and of the clock on two, with the load"
            f" {load:.0f} at the end; up to {SMALL} samples a side a call that does not count goes"
            " before each. Torch and peers are their time over that of the C++: below 1"
            " they are faster. The best peer is the fastest one whose error is at most 2e-6 of the"
            " peak for 10 waves of defocus; it is handed the complex pupil, and *peer and pupil*"
            " adds its making in NumPy, because the C++ starts from the height map."
        ),
    }
    document["command"] = f"python tests/benchmarks/bench_vectors.py {turns}"
    store(DOCUMENT, document)


def _place(case):
    """Return the place of a row in the table."""
    sizes = [f"{samples} -> {window}" for samples, window in SIZES]
    return case[0], case[1], sizes.index(case[2]) if case[2] in sizes else len(sizes)


def option(name, default):
    """Return the word behind an option of the command line."""
    return sys.argv[sys.argv.index(name) + 1] if name in sys.argv else default


def main():
    turns = int(sys.argv[1]) if sys.argv[1:] and sys.argv[1].isdigit() else 5
    if "--measure" in sys.argv:
        measure(option("--level", ""), int(option("--threads", "1")), turns)
        return
    levels = [option("--level", "")] if "--level" in sys.argv else list(LEVELS)
    counts = [option("--threads", "1")] if "--threads" in sys.argv else ["1", "2"]
    print(f"| {' | '.join(COLUMNS)} |\n|{'---|' * len(COLUMNS)}")
    slower = []
    for level in levels:
        for threads in counts:
            counted = {name: threads for name in THREAD_VARIABLES}
            env = {**os.environ, **counted, **LEVELS[level], "CXX": f"g++ -march={level}"}
            words = [str(turns), "--measure", "--level", level, "--threads", threads]
            words += ["--up-to", option("--up-to", "2160")]
            one = ["--one-thread"] if threads == "1" else []  # read by bench_psf
            command = [sys.executable, __file__, *words, *one]
            with subprocess.Popen(command, env=env, stdout=subprocess.PIPE, text=True) as process:
                for line in process.stdout:
                    cells = json.loads(line)
                    print(f"| {' | '.join(cells)} |", flush=True)
                    keep([cells], turns)
                    slower += [cells[:3]] * (float(cells[COLUMNS.index("torch")]) < 1)
            if process.returncode:
                sys.exit(process.returncode)
    sys.exit(f"torch is faster than the C++: {slower}" if slower else 0)


if __name__ == "__main__":
    main()
