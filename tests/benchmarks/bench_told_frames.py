"""`restore: neusee` beside filters that are told the laser, for frames of a camera that the recipe describes wrongly.

    python tests/benchmarks/bench_told_frames.py results.jsonl --seeds 20 3 --pictures photographs/
    python tests/benchmarks/bench_told_frames.py results.jsonl --report

Frames, command and score are those of `bench_restored_frames.py`: a camera in NumPy with another lens, well and sensor
than that of the training, defocus, tilt, dirt and another illuminant. Direction and wavelength of the laser are told.
"""

import argparse
from pathlib import Path

import numpy as np
import torch
from bench_restored_frames import MASKS, STRENGTHS, interval, own, photographs, rows, run

METHODS = ("told", "likeliest", "uncertain", "neusee")


def report(found):
    """Print the means by mask and strength, and the gains of the network over each filter."""
    by = {(r["seed"], r["mask"], r["strength"], r["method"]): r["psnr"] for r in found}
    places = sorted({k[:3] for k in by if all((*k[:3], m) in by for m in METHODS)})
    print(f"mask, strength: frames, PSNR of {', '.join(METHODS)}; gain of neusee over each filter (dB)")
    groups = [(mask, f"{s:g}", (mask,), (s,)) for mask in MASKS for s in STRENGTHS]
    for mask, strength, masks, strengths in [*groups, ("all", "all", MASKS, STRENGTHS)]:
        some = [p for p in places if p[1] in masks and p[2] in strengths]
        if some:
            table = np.array([[by[*p, m] for m in METHODS] for p in some])
            means = " ".join(f"{v:6.2f}" for v in table.mean(0))
            gains = "  ".join(interval(table[:, -1] - table[:, k]) for k in range(len(METHODS) - 1))
            print(f"{mask:9} {strength:>6}: {len(some):3}  {means}   {gains}")


if __name__ == "__main__":
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("file", type=Path)
    parser.add_argument("--seeds", type=int, nargs=2, metavar=("FIRST", "COUNT"))
    parser.add_argument("--pictures", type=Path, help="folder of photographs in place of the three made kinds")
    parser.add_argument("--strengths", type=float, nargs="+", default=STRENGTHS)
    parser.add_argument("--report", action="store_true")
    given = parser.parse_args()
    torch.set_num_threads(1)
    if given.seeds:
        made = (own.picture, ("sample", "leaves", "noise"))
        shots = (photographs(given.pictures), range(10**6)) if given.pictures else made
        run(given.file, *given.seeds, *shots, MASKS, given.strengths, METHODS)
    if given.report:
        report(rows(given.file))
