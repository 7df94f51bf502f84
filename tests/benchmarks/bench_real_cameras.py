"""What `neusee calibrate` says of real cameras, clean and faulty, by a simulator that shares no
line with it.

    python tests/benchmarks/bench_real_cameras.py FILE [options]

    FILE             JSON lines, one a camera; cameras that are in FILE are not computed again
    --cameras N      clean cameras in this process, with weighted draws in place of chains (300)
    --commands N     clean cameras by the command itself (100)
    --faulty N       cameras of each fault in this process (20)
    --side N         pixels of a frame on a side; by default as many as a clean statement needs
    --minutes M      begin no camera after M minutes
    --table          only print the table of FILE

A clean camera is drawn by its number: gain, well, read noise, vignetting, flicker and drift of the
lamp, spread of the pixels, hot pixels, a well below the converter's top, numbers shifted to the
left. Its frames are written as PNG files, whose names tell exposure and photons. Wrong means: a
value that is stated with exit code 0 lies more than 3 combined standard uncertainties of its budget
from the truth. Two ratios say how wide the gain is: over all that scatters from level to level
(sampling, lamp, dark signal, variances), and over sampling alone. A lamp that flickers makes the
second one large although nothing was added: the means of the levels tell the bend of the response,
on which the gain depends.
"""

import argparse
import json
import math
import os
import subprocess
import sys
import time
from collections import Counter
from contextlib import suppress
from pathlib import Path
from tempfile import TemporaryDirectory

import numpy as np
import torch
from PIL import Image

ROOT = Path(__file__).parents[2]
sys.path.insert(0, str(ROOT))

from neusee.nodes.calibrate import (  # noqa: E402
    CLEAN_PAIRS,
    SOURCES,
    STATISTICS,
)
from neusee.workflows.calibration import emcee_sampler  # noqa: E402
from neusee.workflows.calibration.run_calibration import (  # noqa: E402
    CalibrationOptions,
    CalibrationRefused,
    find_posterior,
)
from neusee.workflows.frames.folder_recipe import recipe_of_folder  # noqa: E402
from neusee.workflows.store.result_store import Store  # noqa: E402
from tests.drawn_chains import drawn_chains  # noqa: E402
from tests.workflows.calibration.own_real_camera import RealCamera  # noqa: E402

FAULTS = {
    "smoothing 0.01": {"smoothing": 0.01},
    "smoothing 0.02": {"smoothing": 0.02},
    "smoothing 0.05": {"smoothing": 0.05},
    "smoothing 0.2": {"smoothing": 0.2},
    "sharpening 0.05": {"sharpening": 0.05},
    "lag 0.003": {"lag": 0.003},
    "lag 0.01": {"lag": 0.01},
    "lag 0.03": {"lag": 0.03},
    "compression 98": {"quality": 98},
    "compression 90": {"quality": 90},
    "demosaicing": {"demosaiced": True},
    "mosaic": {"mosaic": (0.6, 1.0, 0.5)},
    "median": {"median": True},
}
FITTED = 0.55  #: share of the lit levels that the fit uses, at least


def camera_of(number, side, **faults):
    """The clean camera of a number; ``side`` 0 for as many pixels as a clean statement needs."""
    rng = np.random.default_rng([33, number])
    lit = int(rng.integers(12, 21))
    side = side or 8 * math.ceil(math.sqrt(CLEAN_PAIRS / (FITTED * lit)) / 8)
    well = float(np.exp(rng.uniform(np.log(8e3), np.log(1e5))))
    offset = float(rng.uniform(60, 200))
    fill = rng.uniform(0.7, 1.15)  # of the converter's range by the well
    gain = fill * (4095 - offset) / well
    noise = max(1.0, 1.0 / gain) * rng.uniform(1.0, 3.0)
    return RealCamera(
        seed=number,
        size=(side, side),
        gain=gain,
        efficiency=float(rng.uniform(0.3, 0.8)),
        read_noise=float(noise),
        read_spread=float(rng.uniform(0, 0.5)),
        well=well,
        well_spread=float(rng.uniform(0, 0.03)),
        offset=offset,
        shift=int(4 * (rng.random() < 0.2)),
        lit=lit,
        brightest=float(rng.uniform(1.02, 1.3)),
        prnu=float(rng.uniform(0, 0.015)),
        dsnu=float(rng.uniform(0, 0.5) * noise),
        vignetting=float(rng.uniform(0, 0.4)),
        flicker=float(rng.uniform(0, 0.004)),
        lamp=float(rng.uniform(0, 0.006)),
        hot=float(rng.uniform(0, 0.008)),
        **faults,
    )


def written(camera, folder):
    """Write the frames as PNG files whose names tell exposure and photons; return the truth of
    the camera.
    """
    folder.mkdir()
    for shot in camera.shots():
        kind = f"lit_{1e3 * shot.exposure:g}ms_{shot.photons:.7g}ph" if shot.photons else shot.name
        for index, frame in enumerate(shot.frames):
            Image.fromarray(frame).save(folder / f"{kind}_{index}.png", compress_level=1)
    kept = ~camera.hot_pixels
    return {
        "gain": camera.gain,
        "quantum_efficiency": camera.efficiency,
        "temporal_dark_noise": float(np.sqrt(np.mean(camera._read[kept] ** 2))),
    }


def in_process(camera):
    with TemporaryDirectory() as name:
        folder = Path(name)
        truth = written(camera, folder / "lab")
        store = Store(folder / "store")
        try:
            recipe = recipe_of_folder(folder / "lab", store)
            result = find_posterior(
                recipe, store, lambda _: None, CalibrationOptions(64, "de", 1000)
            )
        except (CalibrationRefused, ValueError) as error:
            return {"exit": 3, "failed": [str(error)[:160]]}
    failed = [check.name for check in result.checks if check.mark == "fail"]
    budgets = {budget.key: budget for budget in result.budgets}
    widths = {
        name: (budgets[name].value, budgets[name].combined) for name in truth if name in budgets
    }
    shares = {c.source: c.share for c in budgets["gain"].contributions if c.share}
    return judged(truth, widths, shares, failed)


def by_command(camera):
    """The same by `neusee calibrate FOLDER` in another process."""
    with TemporaryDirectory() as name:
        folder = Path(name)
        truth = written(camera, folder / "lab")
        command = [sys.executable, "-m", "neusee", "calibrate", "lab", "--quiet", "--out", "runs"]
        environment = {**os.environ, "NEUSEE_CACHE": str(folder / "cache")}
        done = subprocess.run(
            command, cwd=folder, env=environment, capture_output=True, text=True, check=False
        )
        if done.returncode not in (0, 3):
            return {"exit": done.returncode, "failed": [done.stderr[-160:]]}
        (run,) = (path for path in (folder / "runs").iterdir() if not path.is_symlink())
        posterior = json.loads((run / "posterior.json").read_text())
        failed = [check["name"] for check in posterior["checks"] if check["mark"] == "fail"]
        if not posterior["parameters"]:
            return {"exit": 3, "failed": failed}
        quantities = json.loads((run / "budget.json").read_text())["quantities"]
    widths = {
        name: (quantities[name]["value"], quantities[name]["combined standard uncertainty"])
        for name in truth
        if name in quantities
    }
    rows = quantities["gain"]["sources"]
    shares = {row["source"]: row["contribution"] for row in rows if row.get("contribution")}
    return judged(truth, widths, shares, failed)


def judged(truth, widths, shares, failed):
    """The line of a camera; ``shares`` are the contributions of the sources to the width of the
    gain.
    """
    z = {name: (value - truth[name]) / width for name, (value, width) in widths.items()}
    value, width = widths["gain"]
    return {
        "exit": 3 if failed else 0,
        "failed": failed,
        "z": {name: round(x, 3) for name, x in z.items()},
        "width": round(width / value, 6),
        "ratio": round(width / math.hypot(*(shares.get(source, 0.0) for source in SOURCES)), 3),
        "over sampling": round(width / shares[STATISTICS], 3),
        "sources": {source: round(share / value, 7) for source, share in shares.items()},
    }


def jobs(given):
    """The cameras (row, number, function) that are asked for, in an order that brings each row
    forward.
    """
    rows = [
        ("clean, in process", given.cameras, 0, in_process),
        ("clean, by command", given.commands, 0, by_command),
    ]
    rows += [(fault, given.faulty, 10_000, in_process) for fault in FAULTS]
    most = max(count for _, count, _, _ in rows)
    for number in range(most):
        for row, count, first, function in rows:
            if number * count // most < (number + 1) * count // most:
                yield row, first + number * count // most, function


def table(lines):
    columns = (
        "row",
        "cameras",
        "exit 3",
        "by",
        "values stated",
        "beyond 3 sd",
        "largest z",
        "width of the gain",
    )
    print(f"| {' | '.join(columns)} | over all that scatters | over sampling |")
    print("|---|---|---|---|---|---|---|---|---|---|")
    for row in dict.fromkeys(line["row"] for line in lines):
        own = [line for line in lines if line["row"] == row]
        good = [line for line in own if line["exit"] == 0]
        names = Counter(
            name.split(":")[0] for line in own if line["exit"] for name in line["failed"]
        )
        z = [abs(x) for line in good for x in line["z"].values()]
        text = (
            f"| {row} | {len(own)} | {len(own) - len(good)} |"
            f" {', '.join(f'{n} {c}' for n, c in names.items())} "
        )
        text += f"| {len(z)} | {sum(x > 3 for x in z)} | {max(z, default=0):.1f} "
        if good:
            width = 100 * np.median([line["width"] for line in good])
            text += f"| {width:.2g} % | {spread(good, 'ratio')} | {spread(good, 'over sampling')} |"
        else:
            text += "| | | |"
        print(text)


def spread(lines, name):
    ratios = [line[name] for line in lines]
    within = sum(ratio <= 1.3 for ratio in ratios)
    return f"{np.median(ratios):.2f} (most {max(ratios):.2f}, {within} of {len(ratios)} within 1.3)"


def kept(file):
    lines = []
    for text in file.read_text().splitlines() if file.exists() else []:
        with suppress(json.JSONDecodeError):
            lines.append(json.loads(text))
    return lines


def main():
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("file", type=Path)
    parser.add_argument("--cameras", type=int, default=300)
    parser.add_argument("--commands", type=int, default=100)
    parser.add_argument("--faulty", type=int, default=20)
    parser.add_argument("--side", type=int, default=0)
    parser.add_argument("--minutes", type=float, default=math.inf)
    parser.add_argument("--table", action="store_true")
    given = parser.parse_args()
    torch.set_num_threads(1)
    emcee_sampler.sample = drawn_chains
    end = time.monotonic() + 60 * given.minutes
    done = {(line["row"], line["number"], line["side"]) for line in kept(given.file)}
    for row, number, function in [] if given.table else jobs(given):
        if (row, number, given.side) in done:
            continue
        if time.monotonic() > end:
            break
        began = time.process_time()
        line = {"row": row, "number": number, "side": given.side}
        line |= function(camera_of(number, given.side, **FAULTS.get(row, {})))
        line["seconds"] = round(time.process_time() - began, 1)
        with given.file.open("a") as opened:
            opened.write(json.dumps(line) + "\n")
    table(kept(given.file))


if __name__ == "__main__":
    main()
