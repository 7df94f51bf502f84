"""Energy and error of PSFs averaged over pixels, on random cameras, and their time against points.

    python -m tests.benchmarks.bench_pixel_energy --cameras 300 --compared 60 --out
    pixel_energy.json python -m tests.benchmarks.bench_pixel_energy --times

Cameras from f/1.2 to f/32, 1 to 20 um and 355 to 1600 nm, with windows inside the alias-free field;
draws whose pupil cannot carry the window are counted apart. A run that is stopped goes on where its
file ends. Times are processor times of one thread, points and averages in turns in one run.
"""

import argparse
import json
import time
from pathlib import Path

import numpy as np
import torch

from neusee.nodes.optics import _psf
from neusee.nodes.values import Pupil
from tests.nodes.optics import own_pixel_average as own
from tests.nodes.optics.random_pixel_cameras import compared, drawn, energy

TIMED = [  # samples, pixels a side, f-number, focal length in m, pixel in m
    (2160, 256, 13.6, 0.11, 2.9e-6),
    (2160, 256, 4.0, 0.05, 3.45e-6),
    (2160, 256, 1.4, 0.05, 3.45e-6),
    (2160, 2048, 13.6, 0.11, 2.9e-6),
    (3400, 2048, 4.0, 0.05, 3.45e-6),
]


def judged(path, cameras, compare):
    """Judge random cameras, and keep what is known of each in a file."""
    rows = json.loads(path.read_text()) if path.exists() else {}
    seed = 0
    while sum(row is not None for row in rows.values()) < cameras:
        if str(seed) not in rows:
            camera = drawn(seed)
            rows[str(seed)] = None
            if camera is not None:
                done = sum(row is not None and "error" in row for row in rows.values())
                rows[str(seed)] = {"camera": list(camera), "energy": energy(camera)}
                if done < compare:
                    rows[str(seed)]["error"] = compared(camera)
            path.write_text(json.dumps(rows))
        seed += 1
    return rows


def report(rows):
    """Print the largest energy and the largest error."""
    cameras = [row for row in rows.values() if row is not None]
    errors = [row["error"] for row in cameras if "error" in row]
    highest = max(row["energy"] for row in cameras)
    print(
        f"{len(cameras)} cameras, {len(rows) - len(cameras)} draws refused: energy at most 1"
        f" {highest - 1:+.2e}"
    )
    print(
        f"{len(errors)} compared with separate code: error at most {max(errors):.2e} of the clear"
        " peak"
    )


def timed(samples, side, number, focal, pixel, repeats=3):
    """The processor time of points and of averages, in seconds."""
    clear = torch.from_numpy(own.disc(samples)).float()
    height = torch.from_numpy(1e-7 * np.random.default_rng(1).random(clear.shape)).float()
    one = torch.tensor([532e-9], dtype=torch.float64)
    pitch = torch.tensor(focal / number / samples, dtype=torch.float64)
    pupil = Pupil(clear, clear, height, 0 * clear, own.SILICA + 0 * one, one, pitch)
    camera = _psf._Camera(focal, pixel, (side, side), sensor="point_as_printed")
    light = [1 / float(clear.sum())]
    calls = (
        lambda: _psf._intensity_at_points(pupil, camera, light, torch.float32, "auto"),
        lambda: _psf._focus(pupil, camera._replace(sensor="integrated"), torch.float32, "auto"),
    )
    least = [np.inf, np.inf]
    for _ in range(repeats + 1):
        for which, call in enumerate(calls):
            start = time.process_time()
            call()
            least[which] = min(least[which], time.process_time() - start)
    return least


def main():
    words = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    words.add_argument("--cameras", type=int, default=300)
    words.add_argument("--compared", type=int, default=60)
    words.add_argument("--out", type=Path, default=Path("pixel_energy.json"))
    words.add_argument("--times", action="store_true")
    chosen = words.parse_args()
    torch.set_num_threads(1)
    if not chosen.times:
        report(judged(chosen.out, chosen.cameras, chosen.compared))
        return
    for case in TIMED:
        points, averages = timed(*case)
        print(
            f"{case[0]} -> {case[1]}, f/{case[2]}: {1e3 * points:.1f} ms at points,"
            f" {averages / points:.2f} times that"
        )


if __name__ == "__main__":
    main()
