"""How often lasers are found in one frame, how exactly, and how often no laser is taken for one.

    python tests/benchmarks/bench_laser_search.py results.jsonl --seeds 1000 40
    python tests/benchmarks/bench_laser_search.py results.jsonl --seeds 1000 50 --only empty --side
    64 python tests/benchmarks/bench_laser_search.py results.jsonl --seeds 1000 40 --only lasers
    --wrong python tests/benchmarks/bench_laser_search.py results.jsonl --report

The frames come from `tests/nodes/restore/lasers/own_camera.py`, a camera in NumPy alone. Each seed
makes, for each mask, two frames without a laser, one of them with lamps, one with a laser of 1000
or more, and one with a weaker laser. ``--only`` keeps the frames without a laser, those with one,
or those with one of 1000 or more. With ``--wrong`` the camera has the errors of
`bench_restored_frames.py`, of which the search is not told: defocus, half a pixel of tilt, grains
of dirt, another illuminant. The tilt moves the spot that counts as true, because no frame can tell
it from a direction. The strength that counts as true is that of the light at the aperture, as in a
recipe: grains of dirt absorb part of it, which `own_camera` makes up for, so that its light counts
over the share of the pupil that is open. A frame that stands in the file is not computed again, so
that a run that was stopped continues. The patterns on the axis, which depend on the mask alone, are
computed once. Intervals of rates are of 90 % (Clopper and Pearson).
"""

import argparse
import functools
import json
import sys
import time
from pathlib import Path
from unittest.mock import patch

import numpy as np
import torch
from scipy.stats import beta

ROOT = Path(__file__).parents[2]
sys.path.insert(0, str(ROOT))

from neusee.nodes.restore.lasers import _find_lasers  # noqa: E402
from tests.benchmarks import bench_restored_frames as wrong_camera  # noqa: E402
from tests.benchmarks.bench_restored_intervals import recipe_daylight  # noqa: E402
from tests.nodes.restore.lasers import own_camera as own  # noqa: E402
from tests.nodes.restore.lasers.as_inputs import found_in, kept_templates  # noqa: E402

MASKS = ("plain", "half_ring", "cubic")
STRONG, WEAK = (1e3, 1e4, 1e5, 1e6), (1.0, 10.0, 100.0)
KINDS = ("sample", "leaves", "noise")
KEPT = {
    None: lambda s: True,
    "empty": lambda s: s == 0,
    "lasers": lambda s: s > 0,
    "strong": lambda s: s >= STRONG[0],
}


def cases(seed, masks=MASKS):
    """Name, mask, strength and number of lamps of each frame of a seed."""
    for mask in masks:
        yield f"{mask}-none", mask, 0.0, 0
        yield f"{mask}-lamps", mask, 0.0, 1 + seed % 3
        yield f"{mask}-strong", mask, STRONG[seed % len(STRONG)], 0
        yield f"{mask}-weak", mask, WEAK[seed % len(WEAK)], 0


def taken(seed, name, mask, strength, lamps, side, wrong):
    """A frame, what it shows, the spot in pixels from the middle, its wavelength, and its
    electrons at the aperture.
    """
    rng = np.random.default_rng([seed, *name.encode()])
    kind = KINDS[int(rng.integers(len(KINDS)))]
    spot, wavelength = tuple(rng.uniform(-0.35, 0.35, 2) * side), rng.uniform(420e-9, 670e-9)
    lasers = [own.Laser(spot, wavelength, strength)] if strength else []
    if wrong:
        own.scene_psf.cache_clear()  # of seeds that do not come again
    frame = own.frame(f"{mask}~{seed}" if wrong else mask, kind, side, lasers, rng, lamps)
    channels = lasers[0].channels if lasers else np.zeros(3)
    if wrong:
        channels = channels * own.pupil(mask)[0].sum() / own.pupil(f"{mask}~{seed}")[0].sum()
        bend = own.silica(wavelength) / own.silica(550e-9)  # the tilt is one of glass
        spot = np.add(spot, bend * np.array(wrong_camera.tilt_of(seed)))
    return frame, kind, channels, list(map(float, spot)), wavelength


def row(seed, name, mask, strength, lamps, side, wrong):
    """What is true of one frame, and what was found."""
    frame, kind, channels, spot, wavelength = taken(seed, name, mask, strength, lamps, side, wrong)
    start = time.process_time()
    with patch.object(own, "daylight", recipe_daylight if wrong else own.daylight):
        found = found_in(frame, mask)
    pixel = own.PITCH / own.FOCAL
    return {
        "seed": seed, "name": name, "side": side, "mask": mask, "strength": strength, "lamps": lamps, "kind": kind,
        "camera": "wrong" if wrong else "exact",
        "clipped": float(frame.clipped.any(0).mean()), "seconds": round(time.process_time() - start, 2),
        "spot": spot, "nm": wavelength * 1e9, "channels": channels.tolist(),
        "number": int(found.number), "found_spot": (found.direction[0] / pixel).tolist(),
        "spot_ends": (found.direction_interval[0] / pixel).tolist(), "found_nm": float(found.wavelength[0]) * 1e9,
        "nm_ends": (found.wavelength_interval[0] * 1e9).tolist(), "found_channels": found.strength[0].tolist(),
        "channel_ends": found.strength_interval[0].tolist(), "identifiable": found.identifiable[0].tolist(),
        "gain": found.gain.tolist(),
    }  # fmt: skip


def run(path, first, count, side, only, wrong):
    """Append the frames that the file lacks."""
    camera = "wrong" if wrong else "exact"
    done = {(r["seed"], r["name"], r["side"], r.get("camera", "exact")) for r in rows(path)}
    keep = functools.cache(kept_templates)
    with patch.object(own, "pupil", wrong_camera.true_pupil):
        for seed in range(first, first + count):
            for name, mask, strength, lamps in cases(seed, wrong_camera.MASKS if wrong else MASKS):
                if (seed, name, side, camera) in done or not KEPT[only](strength):
                    continue
                with patch.object(
                    _find_lasers, "line_templates", lambda *_, mask=mask: keep(mask, side)
                ):
                    each = row(seed, name, mask, strength, lamps, side, wrong)
                with path.open("a") as file:
                    file.write(json.dumps(each) + "\n")


def rows(path):
    return [json.loads(line) for line in path.read_text().splitlines()] if path.exists() else []


def inside(value, ends):
    return ends[0] <= value <= ends[1]


def rate(count, of):
    """A share with its interval of 90 %, in percent."""
    low, high = beta.ppf([0.05, 0.95], [count, count + 1], [of - count + 1, of - count])
    return (
        f"{count:3} of {of:3}, {0 if count == 0 else 100 * low:3.0f} to"
        f" {100 if count == of else 100 * high:.1f} %"
    )


def report(all_rows):
    """Print the rates of each mask and strength."""
    free = [r for r in all_rows if not r["strength"]]
    for lamps in (False, True):
        some = [r for r in free if bool(r["lamps"]) == lamps]
        alarms = rate(sum(r["number"] > 0 for r in some), len(some))
        print(f"false alarms {'with' if lamps else 'without'} lamps: {alarms}")
    print(f"false alarms: {rate(sum(r['number'] > 0 for r in free), len(free))}")
    seconds = np.array([r["seconds"] for r in all_rows])
    print(
        f"seconds of a processor a frame: {np.median(seconds):.1f} in the median,"
        f" {seconds.max():.1f} at most"
    )
    print("strength: found where it is (0.2 px and 5 nm), with the interval of 90 % of that rate")
    for strength in (*WEAK, *STRONG):
        some = [r for r in all_rows if r["strength"] == strength]
        if some:
            print(f"  {strength:7g}: {rate(sum(map(right, some)), len(some))}")
    print(
        "mask, strength: frames, found, identifiable, place within 0.2 px, within 5 nm, coverage of"
        " place, nm, channels"
    )
    groups = {(r["mask"], r["strength"]) for r in all_rows if r["strength"]}
    for mask, strength in [*sorted(groups), ("all", 1e3), ("all", 0.0)]:
        some = [r for r in all_rows if (r["mask"], r["strength"]) == (mask, strength)]
        if mask == "all":
            some = [
                r
                for r in all_rows
                if (r["strength"] >= 1e3 if strength else 0 < r["strength"] < 1e3)
            ]
        print(f"{mask:9} {strength:7g}: {line(some)}")
    extra = [r for r in all_rows if r["strength"] and r["number"] > 1]
    print(
        f"more than one laser found where there is one: {len(extra)} of"
        f" {sum(r['strength'] > 0 for r in all_rows)}"
    )


def right(r):
    """True if the strongest laser found is the one of the frame."""
    near = max(abs(np.subtract(r["spot"], r["found_spot"]))) < 0.2
    return r["number"] > 0 and near and abs(r["nm"] - r["found_nm"]) < 5


def line(some):
    """The rates of some frames with a laser."""
    seen = [r for r in some if r["number"]]
    near = [r for r in seen if max(abs(np.subtract(r["spot"], r["found_spot"]))) < 0.2]
    hue = [r for r in seen if abs(r["nm"] - r["found_nm"]) < 5]
    sure = [r for r in seen if all(r["identifiable"])]
    place = [inside(a, e) for r in sure for a, e in zip(r["spot"], r["spot_ends"], strict=True)]
    colour = [inside(r["nm"], r["nm_ends"]) for r in sure]
    amounts = [
        inside(a, e) for r in sure for a, e in zip(r["channels"], r["channel_ends"], strict=True)
    ]
    shares = [f"{np.mean(x):.2f} of {len(x)}" if x else "-" for x in (place, colour, amounts)]
    return (
        f"{len(some):3} {len(seen):3} {len(sure):3} {len(near):3} {len(hue):3}  {'  '.join(shares)}"
    )


if __name__ == "__main__":
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("file", type=Path)
    parser.add_argument("--seeds", type=int, nargs=2, metavar=("FIRST", "COUNT"))
    parser.add_argument("--side", type=int, default=128, help="pixels a side")
    parser.add_argument("--only", choices=["empty", "lasers", "strong"])
    parser.add_argument(
        "--wrong", action="store_true", help="a camera with errors that the search is not told"
    )
    parser.add_argument("--report", action="store_true")
    given = parser.parse_args()
    torch.set_num_threads(1)
    if given.seeds:
        run(given.file, *given.seeds, given.side, given.only, given.wrong)
    if given.report:
        report(rows(given.file))
