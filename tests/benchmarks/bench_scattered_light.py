"""What it is worth that the filter knows of scattered laser light: one search of each frame,
restored with and without.

    python tests/benchmarks/bench_scattered_light.py FOLDER --seeds 100 5 --pictures photographs/
    python tests/benchmarks/bench_scattered_light.py FOLDER --report --found

Frames as in `bench_restored_frames.py`, from a camera in NumPy that the recipe describes wrongly:
crops of photographs for even seeds, made scenes for odd ones. The search is that of the command,
and stands in FOLDER, so that a run that was stopped continues. The filter then restores with
`scatter` and with `doubt` as before, and states its interval; the score is that of
`bench_restored_frames.py`. The interval is compared with the scene, scaled for each colour to the
frame without its laser, the tilt of the camera taken back, saturated pixels and eight at the border
apart.
"""

import argparse
import json
import tempfile
import time
from pathlib import Path
from unittest.mock import patch

import numpy as np
import torch
from safetensors.torch import load_file
from scipy.stats import t as student

from neusee.nodes.restore.inverse import (
    LaserLight,
    Settings,
    effective_psf,
    frame_deviation,
    grey_white,
    known_and_light,
    most_likely,
    posed,
)
from neusee.nodes.values import Bands, Psf
from neusee.workflows.report.figures.camera_pictures import half_width
from tests.benchmarks import bench_restored_frames as frames
from tests.benchmarks.bench_laser_search import rate
from tests.nodes.restore.lasers import own_camera as own

RANKS, DRAWS = ("first", "second", "third"), 8
FOUND = [f"found_{what}[{rank}]" for what in ("glare", "nearby") for rank in RANKS]
OUTPUTS = [
    "signal[mask]",
    "clipped[mask]",
    "developed[mask]",
    "matrix",
    "illuminant",
    "responses",
    "search",
    *FOUND,
]


def searched(numbers, mask, folder, optics):
    """The outputs of `neusee restore` for a frame, and those that depend on the mask alone."""
    wanted = OUTPUTS + ([] if optics.exists() else ["psf[mask]", "bands"])
    found = frames.outputs_of(numbers, mask, ["restore=search"], wanted, folder, load_file)
    apart = {k: v for k, v in found.items() if k.startswith(("psf", "bands"))}
    if apart:
        torch.save(apart, optics)
    return {k: v for k, v in found.items() if k not in apart}


def search(folder, first, count, strengths, pictures):
    """Search the frames that the folder lacks."""
    photographs = frames.photographs(pictures)
    with tempfile.TemporaryDirectory() as place:
        frames.written_camera(Path(place))
        for seed in range(first, first + count):
            made = ("sample", "leaves", "noise")[seed // 2 % 3]
            source = (made, own.picture) if seed % 2 else (seed, photographs)
            for strength in strengths:
                for mask in frames.MASKS:
                    path = folder / f"{seed}_{mask}_{strength:g}.pt"
                    if path.exists():
                        continue
                    numbers, truth, laser = frames.taken(mask, strength, seed, *source)
                    found = searched(numbers, mask, Path(place), folder / f"psf_{mask}.pt")
                    told = (laser.spot, laser.wavelength, laser.strength)
                    torch.save({"out": found, "truth": truth, "laser": told}, path)


def restored(found, optics, scatter, interval):
    """The picture (3, y, x) that the filter restores, and half the width of its 90 % interval,
    or None.
    """
    bands = Bands(*(optics[f"bands.{name}"] for name in Bands._fields))
    psf = Psf(optics["psf[mask].intensity"], optics["psf[mask].clear_peak"])
    light = LaserLight(
        glare=[found[name] for name in FOUND[: len(RANKS)]],
        nearby=[found[name] for name in FOUND[len(RANKS) :]],
    )
    camera = (found["illuminant"], found["responses"], bands)
    fine, known, glare = known_and_light(
        psf, camera[1], found["signal[mask]"], found["clipped[mask]"].bool(), light
    )
    kernels = effective_psf(psf, *camera, fine.dtype).to(fine)
    settings = Settings(1.0, own.READ, None, 0.3, scatter)
    scaled = posed(fine, known, kernels, glare, settings, grey_white(*camera))
    matrix = found["matrix"].double()
    picture = torch.tensordot(
        matrix, scaled.pixels(most_likely(scaled.problem)) + scaled.mean, 1
    ).numpy()
    if not interval:
        return picture, None
    spread = frame_deviation(scaled, matrix, DRAWS, torch.Generator().manual_seed(1)).numpy()
    return picture, half_width(spread, DRAWS)


def judged(path, folder, interval):
    """Gains over the frame as developed, and shares of pixels in an interval, without and with
    scattered light.
    """
    seed, *mask, strength = path.stem.split("_")
    mask, each = "_".join(mask), torch.load(path, weights_only=False)
    found, truth = each["out"], each["truth"]
    optics = torch.load(folder / f"psf_{mask}.pt")
    with patch.object(own, "pupil", frames.true_pupil):
        light = own.Laser(*each["laser"]).electrons(f"{mask}~{seed}", (frames.SIDE, frames.SIDE))
    seen = ~found["clipped[mask]"].bool().any(0).numpy()
    scene = np.tensordot(
        found["matrix"].double().numpy(), found["signal[mask]"].double().numpy() - light, 1
    )
    aim = truth * (scene[:, seen].mean(1) / truth[:, seen].mean(1))[:, None, None]
    # of the tilt in `frames.true_pupil`
    towards = np.random.default_rng([int(seed), 99]).uniform(0, 2 * np.pi)
    tilt = -0.5 * np.array([np.cos(towards), np.sin(towards)])
    fy, fx = np.fft.fftfreq(frames.SIDE)[:, None], np.fft.fftfreq(frames.SIDE)
    turn = np.exp(-2j * np.pi * (fy * tilt[0] + fx * tilt[1]))
    rim = frames.RIM
    seen[:rim], seen[-rim:], seen[:, :rim], seen[:, -rim:] = False, False, False, False
    row = {
        "seed": int(seed),
        "mask": mask,
        "strength": float(strength),
        "seen": round(float(seen.mean()), 3),
    }
    row["developed"] = frames.score(found["developed[mask]"].numpy().astype(float), truth)
    for name, scatter in (("before", False), ("now", True)):
        start = time.process_time()
        picture, half = restored(found, optics, scatter, interval)
        error = (np.fft.ifft2(np.fft.fft2(picture) * turn).real - aim)[:, seen]
        row[name] = frames.score(picture, truth) - row["developed"]
        row[f"{name} inside"] = (
            float(np.mean(np.abs(error) < half[:, seen])) if interval else np.nan
        )
        row[f"{name} rms"] = float(np.sqrt(np.mean(error**2)))
        row[f"{name} seconds"] = time.process_time() - start
    return row


def laser_found(path):
    """Errors of place (pixels) and wavelength (nm) of the strongest laser found, whose interval
    holds what is true.
    """
    seed, strength = path.stem.split("_")[0], float(path.stem.split("_")[-1])
    each = torch.load(path, weights_only=False)
    spot, wavelength, _ = each["laser"]
    found = {
        k.split(".")[1]: v.double().numpy()
        for k, v in each["out"].items()
        if k.startswith("search.")
    }
    # of the tilt in `frames.true_pupil`
    towards = np.random.default_rng([int(seed), 99]).uniform(0, 2 * np.pi)
    aim = np.array([*spot]) + 0.5 * np.array([np.cos(towards), np.sin(towards)])
    true = np.array([*(aim * own.PITCH / own.FOCAL), wavelength])
    ends = np.stack([*found["direction_interval"][0], found["wavelength_interval"][0]])
    errors = [
        *(found["direction"][0] * own.FOCAL / own.PITCH - aim),
        (found["wavelength"][0] - wavelength) * 1e9,
    ]
    return strength, int(found["number"]), errors, (ends[:, 0] <= true) & (true <= ends[:, 1])


def report_found(lasers):
    """Print how often the laser is found where it is, and how often intervals of 90 % hold what
    is true.
    """
    print(
        "strength: found within 0.2 px and 5 nm; largest errors of those (px, nm); intervals hold"
        " place, wavelength"
    )
    for strength in [*sorted({each[0] for each in lasers}), None]:
        some = [each for each in lasers if strength in (each[0], None)]
        right = [e for e in some if e[1] and max(map(abs, e[2][:2])) < 0.2 and abs(e[2][2]) < 5]
        place, hue = (np.array([e[3][part] for e in right]) for part in (slice(2), slice(2, 3)))
        largest = [max(abs(e[2][k]) for e in right for k in part) for part in ((0, 1), (2,))]
        held = "; ".join(rate(int(x.sum()), x.size) for x in (place, hue))
        name = "all" if strength is None else f"{strength:g}"
        print(
            f"  {name:>6}: {rate(len(right), len(some))}; {largest[0]:.2f}, {largest[1]:.1f};"
            f" {held}"
        )


def report(rows):
    print(
        "| strength | frames | before: gain | least | now: gain | least | now over before | worse"
        " by 0.1 dB |",
        end="",
    )
    print(" before: in the interval | now | 85 to 95 %, before and now |")
    print("|---" * 11 + "|")
    for strength in [*sorted({r["strength"] for r in rows}), None]:
        some = [r for r in rows if strength in (r["strength"], None)]
        old, new = (np.array([r[k] for r in some]) for k in ("before", "now"))
        half = student.ppf(0.975, len(some) - 1) * (new - old).std(ddof=1) / len(some) ** 0.5
        inside = [np.array([r[f"{k} inside"] for r in some]) for k in ("before", "now")]
        held = [
            "-" if np.isnan(x).any() else f"{x.mean():.0%} ({x.min():.0%} to {x.max():.0%})"
            for x in inside
        ]
        right = " and ".join(str(int(((x >= 0.85) & (x <= 0.95)).sum())) for x in inside)
        name = "all" if strength is None else f"{strength:g}"
        print(
            f"| {name} | {len(some)} | {old.mean():+.2f} | {old.min():+.2f} | {new.mean():+.2f} |"
            f" {new.min():+.2f} | {(new - old).mean():+.2f} ± {half:.2f} |"
            f" {int((new - old < -0.1).sum())} | {held[0]} | {held[1]} | {right} |"
        )


if __name__ == "__main__":
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("folder", type=Path)
    parser.add_argument("--seeds", type=int, nargs=2, metavar=("FIRST", "COUNT"))
    parser.add_argument("--pictures", type=Path, help="folder of photographs")
    parser.add_argument("--strengths", type=float, nargs="+", default=(1e5, 1e6, 1e4))
    parser.add_argument(
        "--report",
        action="store_true",
        help="restore the frames of the folder, and print the tables",
    )
    parser.add_argument(
        "--pictures-alone", action="store_true", help="without intervals, which take longer"
    )
    parser.add_argument(
        "--found", action="store_true", help="print how exactly the lasers were found"
    )
    given = parser.parse_args()
    torch.set_num_threads(1)
    given.folder.mkdir(exist_ok=True)
    if given.seeds:
        search(given.folder, *given.seeds, given.strengths, given.pictures)
    if given.report:
        table = given.folder / ("pictures.jsonl" if given.pictures_alone else "judged.jsonl")
        done = {(r["seed"], r["mask"], r["strength"]) for r in frames.rows(table)}
        for path in sorted(given.folder.glob("[0-9]*.pt"), reverse=True):
            seed, *mask, strength = path.stem.split("_")
            if (int(seed), "_".join(mask), float(strength)) not in done:
                with table.open("a") as file:
                    file.write(
                        json.dumps(judged(path, given.folder, not given.pictures_alone)) + "\n"
                    )
        report(frames.rows(table))
    if given.found:
        report_found([laser_found(path) for path in given.folder.glob("[0-9]*.pt")])
