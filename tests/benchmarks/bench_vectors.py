"""The PSF in C++ and in torch, by instruction set: `python tests/benchmarks/bench_vectors.py
[REPEATS]`.

Each instruction set is a process of its own, in which the C++ is compiled for it, and torch, MKL
and NumPy use no wider one. Least processor time of one thread, calls in turns within the process.
`scipy CZT` and `hcipy ZoomFFT` get the ready complex pupil; ours makes it from the height map.
Prints a table in Markdown, with the time of torch and of the peers over that of the C++: the C++ is
what runs wherever there is a compiler, so that no ratio may be below 1.
"""

import os
import subprocess
import sys

LEVELS = {
    "x86-64-v2": {"ATEN_CPU_CAPABILITY": "default", "MKL_ENABLE_INSTRUCTIONS": "SSE4_2"},
    "x86-64-v3": {"ATEN_CPU_CAPABILITY": "avx2", "MKL_ENABLE_INSTRUCTIONS": "AVX2"},
    "x86-64-v4": {},
}
SIZES = ((2160, 2048), (2160, 256), (2160, 64), (540, 512), (128, 64))
PEERS = ("torch", "scipy CZT", "hcipy ZoomFFT")


def one_level(level, repeats):
    """Print the rows of one instruction set; the environment is that of the level."""
    import time

    import hcipy
    import torch
    from bench_psf import (
        DIAMETER,
        FOCAL,
        PIXEL,
        WAVELENGTH,
        field,
        hcipy_call,
        ours,
        pupil,
        scipy_call,
    )

    from neusee.nodes.optics.transform import Axis, cheapest

    torch.set_num_threads(1)
    for samples, window in SIZES:
        lens = pupil(samples, 10.0)
        ready = field(lens)
        axis = Axis(samples, window, DIAMETER / samples * PIXEL / (WAVELENGTH * FOCAL))
        calls = {
            "C++": ours(lens, window, "fused"),
            "torch": ours(lens, window, cheapest(axis, axis, torch.device("cpu"))),
            "scipy CZT": scipy_call(ready, window),
            "hcipy ZoomFFT": hcipy_call(ready, window, hcipy.ZoomFastFourierTransform),
        }
        seconds = {name: [] for name in calls}
        for turn in range(repeats + 1):
            for name, call in calls.items():
                start = time.process_time()
                call()
                if turn:
                    seconds[name].append(time.process_time() - start)
        least = {name: min(times) for name, times in seconds.items()}
        ratios = " | ".join(f"{least[name] / least['C++']:.2f}" for name in PEERS)
        print(
            f"| {level} | {samples} -> {window} | {1e3 * least['C++']:.3g} | {ratios} |", flush=True
        )


def main():
    repeats = next((int(word) for word in sys.argv[1:] if word.isdigit()), 5)
    if "--level" in sys.argv:
        one_level(sys.argv[sys.argv.index("--level") + 1], repeats)
        return
    head = f"| instruction set | pupil -> window | C++ ms | {' | '.join(PEERS)} |"
    print(f"{head}\n|---|---|---|---|---|---|", flush=True)
    threads = {name: "1" for name in ("OMP_NUM_THREADS", "OPENBLAS_NUM_THREADS", "MKL_NUM_THREADS")}
    for level, limits in LEVELS.items():
        env = {**os.environ, **threads, **limits, "CXX": f"g++ -march={level}"}
        subprocess.run(
            [sys.executable, __file__, str(repeats), "--level", level], env=env, check=True
        )


if __name__ == "__main__":
    main()
