"""How many pixels of a restored frame lie in their 90 % interval, frame by frame.

    python tests/benchmarks/bench_restored_intervals.py results.jsonl --seeds 200 3
    python tests/benchmarks/bench_restored_intervals.py results.jsonl --seeds 200 3 --exact
    python tests/benchmarks/bench_restored_intervals.py results.jsonl --report

Frames as in `bench_restored_frames.py`, from a camera in NumPy that the recipe describes wrongly,
or exactly with `--exact`. Each is restored by `neusee restore` with the search, and compared with
the light of each pixel behind a perfect lens, in the three channels of the sensor, converted by the
matrix of the picture. The known tilt of the wrong camera is taken back, and eight pixels at the
border do not count there; saturated pixels never count. *Edges* are the fifth of the pixels with
the steepest slopes of the scene, *even* places the two fifths with the smallest slopes.
"""

import argparse
import json
import sys
import tempfile
import time
from pathlib import Path
from unittest.mock import patch

import colour
import numpy as np
import torch
from scipy.ndimage import maximum_filter
from scipy.signal import fftconvolve

sys.path.insert(0, str(Path(__file__).parents[2]))

from neusee.workflows.report.figures.camera_pictures import half_width
from tests.benchmarks import bench_restored_frames as frames
from tests.nodes.restore.lasers import own_camera as own

DRAWS, SIDE, RIM = 8, frames.SIDE, frames.RIM
D65 = colour.SDS_ILLUMINANTS["D65"]
KINDS = ("sample", "leaves", "noise")


def recipe_daylight(wavelength):
    """The illuminant of the recipe, for a camera that it describes exactly."""
    return np.interp(np.asarray(wavelength) * 1e9, D65.wavelengths, D65.values) / 100


def light_and_truth(mask, whole, daylight):
    """Electrons of a scene behind a mask, and behind a perfect lens: (channel, y, x)."""
    rim = SIDE // 2
    basis = np.stack(
        [np.exp(-0.5 * ((own.BANDS - c) / 45e-9) ** 2) for c in (610e-9, 545e-9, 460e-9)]
    )
    basis /= basis.sum(0) + 0.05
    weight, psf = (
        own.band_response() * daylight(own.BANDS) * own.BANDS,
        own.scene_psf(mask, 2 * rim + 1),
    )
    seen, truth = np.zeros((2, 3, SIDE, SIDE))
    for k in range(3):
        kernels = np.tensordot(weight * basis[k], psf, 1)
        seen += fftconvolve(whole[None, :, :, k], kernels, "valid", axes=(1, 2))[:, :SIDE, :SIDE]
        truth += (weight * basis[k]).sum(1)[:, None, None] * whole[
            rim : rim + SIDE, rim : rim + SIDE, k
        ]
    scale = 0.7 * own.WELL / seen.max()
    return seen * scale, truth * scale


def taken(mask, strength, seed, kind, picture, exact):
    """A frame in digital numbers (y, x, 3), and the electrons behind a perfect lens."""
    rng = np.random.default_rng([seed, *mask.encode(), int(strength)])
    laser = own.Laser(
        tuple(rng.uniform(-0.35, 0.35, 2) * SIDE), rng.uniform(420e-9, 670e-9), strength
    )
    name = mask if exact else f"{mask}~{seed}"
    with patch.object(own, "pupil", frames.true_pupil):
        own.scene_psf.cache_clear()
        light, truth = light_and_truth(
            name, picture(kind, 2 * SIDE, rng), recipe_daylight if exact else own.daylight
        )
        if strength:
            light = light + laser.electrons(name, (SIDE, SIDE))
    electrons, _ = own.digitized(light, rng)
    return np.rint((electrons + own.OFFSET) * own.GAIN).astype(np.uint16).transpose(1, 2, 0), truth


def restored(numbers, mask, folder):
    """The outputs of `neusee restore` for a frame."""
    outputs = ["restored", "restored_spread", "clipped[mask]", "developed[mask]", "matrix"]
    return frames.outputs_of(
        numbers, mask, ["restore=search", f"frame.draws={DRAWS}"], outputs, folder
    )


def moved(picture, shift):
    """A picture, shifted by parts of a pixel."""
    fy, fx = np.fft.fftfreq(SIDE)[:, None], np.fft.fftfreq(SIDE)
    return np.fft.ifft2(
        np.fft.fft2(picture) * np.exp(-2j * np.pi * (fy * shift[0] + fx * shift[1]))
    ).real


def judged(results, truth, seed, exact):
    """Shares of pixels in the interval: all, edges and even places; and root mean square errors."""
    truth = np.tensordot(results["matrix"].astype(float), truth, 1)
    shown, developed = (results[k].astype(float) for k in ("restored", "developed[mask]"))
    seen = ~results["clipped[mask]"].astype(bool).any(0)
    if not exact:
        # of the tilt in `frames.true_pupil`
        towards = np.random.default_rng([seed, 99]).uniform(0, 2 * np.pi)
        tilt = -0.5 * np.array([np.cos(towards), np.sin(towards)])
        shown, developed = moved(shown, tilt), moved(developed, tilt)
        seen[:RIM], seen[-RIM:], seen[:, :RIM], seen[:, -RIM:] = False, False, False, False
    slope = maximum_filter(np.hypot(*np.gradient(truth.mean(0))), 3)
    edge, even = slope >= np.quantile(slope, 0.8), slope <= np.quantile(slope, 0.4)
    half = half_width(results["restored_spread"], DRAWS)
    inside = np.abs(shown - truth) < half
    error = {
        k: np.sqrt(np.mean((x - truth)[:, seen] ** 2))
        for k, x in (("rms", shown), ("developed", developed))
    }
    named = {"all": seen, "edges": seen & edge, "even": seen & even}
    shares = {k: inside[:, where].mean() if where.any() else np.nan for k, where in named.items()}
    return {
        k: round(float(v), 4)
        for k, v in (shares | error | {"half": float(np.median(half[:, seen]))}).items()
    }


def run(path, given, kinds, picture):
    """Append the frames that the file lacks."""
    camera = "exact" if given.exact else "wrong"
    done = {
        (r["camera"], r["seed"], r["mask"], r["strength"], r["from"]) for r in frames.rows(path)
    }
    source = given.pictures.name if given.pictures else "made"
    with tempfile.TemporaryDirectory() as place:
        frames.written_camera(Path(place))
        for seed in range(given.seeds[0], sum(given.seeds)):
            for mask in given.masks:
                for strength in given.strengths:
                    if (camera, seed, mask, strength, source) in done:
                        continue
                    start, kind = time.process_time(), kinds[seed % len(kinds)]
                    numbers, truth = taken(mask, strength, seed, kind, picture, given.exact)
                    found = judged(restored(numbers, mask, Path(place)), truth, seed, given.exact)
                    what = {
                        "camera": camera,
                        "seed": seed,
                        "mask": mask,
                        "strength": strength,
                        "from": source,
                    }
                    each = what | found | {"seconds": round(time.process_time() - start, 1)}
                    with path.open("a") as file:
                        file.write(json.dumps(each) + "\n")


def report(rows):
    """Print the share of pixels in the interval, with the 90 % interval of its mean over frames,
    and of each frame.
    """
    print(
        "| camera | mask | laser | frames | all | edges | even | frames with 85 to 95 % | 80 to 97"
        " % | least, most |"
    )
    print("|---|---|---|---|---|---|---|---|---|---|")
    lasers = {
        "none": lambda s: s == 0,
        "to 1e4": lambda s: 0 < s <= 1e4,
        "1e5": lambda s: s == 1e5,
        "1e6": lambda s: s == 1e6,
    }
    for camera in ("exact", "wrong"):
        for mask in (*frames.MASKS, "all masks"):
            for name, which in {**lasers, "all": lambda s: True}.items():
                some = [
                    r
                    for r in rows
                    if r["camera"] == camera
                    and mask in (r["mask"], "all masks")
                    and which(r["strength"])
                ]
                if not some:
                    continue
                x = np.array([r["all"] for r in some])
                within = [
                    np.mean((x >= low) & (x <= high)) for low, high in ((0.85, 0.95), (0.8, 0.97))
                ]
                edges, even = (np.nanmean([r[k] for r in some]) for k in ("edges", "even"))
                shown = [f"{x.mean():.1%} ({low_and_high(x)})", f"{edges:.0%}", f"{even:.0%}"]
                shown += [f"{v:.0%}" for v in within] + [f"{x.min():.0%}, {x.max():.0%}"]
                print(f"| {camera} | {mask} | {name} | {len(x)} | {' | '.join(shown)} |")


def low_and_high(shares):
    """The 90 % interval of a mean over frames, by 4000 bootstrap samples."""
    if len(shares) < 3:
        return "-"
    means = np.random.default_rng(0).choice(shares, (4000, len(shares))).mean(1)
    return " to ".join(f"{v:.1%}" for v in np.quantile(means, (0.05, 0.95)))


if __name__ == "__main__":
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("file", type=Path)
    parser.add_argument("--seeds", type=int, nargs=2, metavar=("FIRST", "COUNT"))
    parser.add_argument("--exact", action="store_true", help="the camera that the recipe describes")
    parser.add_argument(
        "--pictures", type=Path, help="folder of photographs in place of the three made kinds"
    )
    parser.add_argument("--masks", nargs="+", default=frames.MASKS)
    parser.add_argument("--strengths", type=float, nargs="+", default=frames.STRENGTHS)
    parser.add_argument("--report", action="store_true")
    given = parser.parse_args()
    torch.set_num_threads(1)
    if given.seeds:
        made = (KINDS, own.picture)
        run(
            given.file,
            given,
            *((range(10**6), frames.photographs(given.pictures)) if given.pictures else made),
        )
    if given.report:
        report(frames.rows(given.file))
