"""How much less than its light at the aperture a fit finds in the pattern of a laser, behind lenses
with drawn dirt.

    python tests/benchmarks/bench_lost_light.py results.jsonl --seeds 1000 320 --side 64
    python tests/benchmarks/bench_lost_light.py results.jsonl --seeds 5000 70 --side 128
    python tests/benchmarks/bench_lost_light.py results.jsonl --report

The constants of `nodes/restore/lasers/_find_lasers.py` were learnt from these frames. A lens is
clean in one case of four; in the others it has dust, scratches, grease and dents, each in 3 to 100
% of the amount in `recipes/flare/dirty_windshield.yaml` (log-uniform), and the defocus of
`recipes/mismatch/usual.yaml`. Scene, noise and converter are those of
`tests/nodes/restore/lasers/own_camera.py`; pattern and dirt are those of the nodes, because this
script learns and does not judge: `bench_laser_search.py --wrong` judges, with another lens. The fit
begins at the true place and wavelength. A fit that ends farther than half a pixel or 8 nm away does
not count. The report fits the law again, and says how many channels of how many lasers lie in their
intervals. A frame that stands in the file is not computed again.
"""

import argparse
import json
import math
import sys
from pathlib import Path
from unittest.mock import patch

import numpy as np
import torch
from scipy.optimize import nnls

ROOT = Path(__file__).parents[2]
sys.path.insert(0, str(ROOT))

from neusee.nodes import flare, optics  # noqa: E402
from neusee.nodes.restore.inverse import View  # noqa: E402
from neusee.nodes.restore.lasers import (  # noqa: E402
    Camera,
    Known,
    Laser,
    Lens,
    at_the_aperture,
    data_of,
    fitted,
    lamp_light,
    line_pattern,
    spreads,
)
from neusee.nodes.restore.lasers import _find_lasers as law  # noqa: E402
from tests.benchmarks import bench_restored_frames as masks  # noqa: E402
from tests.nodes.restore.lasers import own_camera as own  # noqa: E402
from tests.nodes.restore.lasers.as_inputs import inputs, pupil_of  # noqa: E402

MASKS = ("plain", "half_ring", "cubic", "designed")
#: of recipes/flare/dirty_windshield.yaml
FULL = {"dust": 30.0, "scratches": 30.0, "grease": 0.05, "dents": 0.1}
LINE = torch.tensor(1e-9, dtype=torch.float64)


def drawn(rng):
    """The dirt of a lens as shares of that in the recipe, and its defocus in waves."""
    if rng.integers(4) == 0:
        return dict.fromkeys([*FULL, "defocus"], 0.0)
    return {name: float(10 ** rng.uniform(-1.5, 0)) for name in FULL} | {
        "defocus": float(rng.normal(0, 0.1))
    }


def dirty(pupil, amounts, rng):
    """A pupil with dirt and defocus."""
    stop = optics.stop(samples=own.SAMPLES, pitch=own.DIAMETER / own.SAMPLES, diameter=own.DIAMETER)
    seed = torch.Generator().manual_seed(int(rng.integers(2**40)))
    dirt = flare.dirt(stop, **{name: full * amounts[name] for name, full in FULL.items()}, rng=seed)
    at = (torch.arange(own.SAMPLES, dtype=torch.float64) - (own.SAMPLES - 1) / 2) / (
        own.SAMPLES / 2
    )
    path = dirt.path.double() + amounts["defocus"] * 550e-9 * (at[:, None] ** 2 + at**2)
    amplitude = pupil.amplitude * dirt.amplitude.to(pupil.amplitude)
    return pupil._replace(amplitude=amplitude, path=pupil.path + path.to(pupil.path))


def row(seed, side):
    """One frame of a laser behind a lens, and what a fit of the pattern finds."""
    rng = np.random.default_rng([seed, 4711])
    mask, strength = MASKS[seed % len(MASKS)], 10 ** rng.uniform(0.3, 6)
    kind = ("sample", "leaves", "noise")[int(rng.integers(3))]
    spot, wavelength = rng.uniform(-0.35, 0.35, 2) * side, rng.uniform(420e-9, 670e-9)
    amounts = drawn(rng)
    scene = own.irradiance(mask, kind, side, rng)
    lens = Lens(own.FOCAL, own.PITCH, (side, side))
    lens_pupil = dirty(pupil_of(mask, torch.float64), amounts, rng)
    towards, line = (
        torch.tensor(spot * own.PITCH / own.FOCAL),
        torch.tensor(wavelength, dtype=torch.float64),
    )
    laser = own.Laser(tuple(spot), wavelength, strength)
    pattern = line_pattern(lens_pupil, towards, line, lens, LINE).numpy()
    electrons, clipped = own.digitized(scene + laser.channels[:, None, None] * pattern, rng)
    part, told = fit_of(own.Frame(electrons, clipped), mask, laser, lens)
    away = part.values[:3] - torch.tensor([*spot, wavelength * 1e9])
    return {
        "seed": seed, "side": side, "mask": mask, "strength": strength, "amounts": amounts, "away": away.tolist(),
        "clipped": clipped.mean((1, 2)).tolist(), "truth": laser.channels.tolist(), "found": part.channels().tolist(),
        "spread": told.covariance.diagonal()[3:].sqrt().tolist(), "ideal": told.ideal.tolist(),
    }  # fmt: skip


def fit_of(frame, mask, laser, lens):
    """The laser that a fit from the truth ends at, and how well the frame tells it."""
    electrons, clipped, psf, pupil, light, responses, bands = inputs(frame, mask)
    electrons = electrons.double()
    camera = Camera(pupil, responses, bands, lens, LINE)
    lamp = lamp_light(View(psf, light, responses, bands), pupil, lens, torch.float64)
    known = Known(
        electrons, (~clipped).to(electrons), camera, lamp, None, own.READ, (1e-9, 5e-9, 10e-9)
    )
    light = laser.strength * own.WELL / own.clear_peak(laser.wavelength)
    parts = (
        Laser(
            camera, torch.tensor([*laser.spot, laser.wavelength * 1e9, light, *[0.0] * 4]).double()
        ),
    )
    for _ in range(2):
        fit = fitted(data_of(known, parts), parts, 12)
        parts = fit.parts
    return parts[0], spreads(fit, known.seen)[0]


def run(path, first, count, side):
    """Append the frames that the file lacks."""
    done = {(r["seed"], r["side"]) for r in rows(path)}
    with patch.object(own, "pupil", masks.true_pupil), torch.no_grad():
        for seed in range(first, first + count):
            if (seed, side) not in done:
                each = row(seed, side)
                with path.open("a") as file:
                    file.write(json.dumps(each) + "\n")


def rows(path):
    return [json.loads(line) for line in path.read_text().splitlines()] if path.exists() else []


def channels(all_rows):
    """What is known of each channel of each laser that was found where it is."""
    found = []
    for r in all_rows:
        if max(map(abs, r["away"][:2])) > 0.5 or abs(r["away"][2]) > 8:
            continue
        each = (torch.tensor(r[name], dtype=torch.float64) for name in ("found", "spread", "ideal"))
        seen = (1.0 - torch.tensor(r["clipped"]))[:, None, None].expand(-1, r["side"], r["side"])
        middle, ends = (x.numpy() for x in at_the_aperture(*each, seen))
        for c, truth in enumerate(r["truth"]):
            found.append(
                {
                    **{name: r[name] for name in ("side", "mask", "strength")}, "clean": not r["amounts"]["dust"],
                    "amounts": r["amounts"],
                    "held": ends[c, 0] <= truth <= ends[c, 1], "width": (ends[c, 1] - ends[c, 0]) / middle[c],
                    "lost": math.log(truth / r["found"][c]) if r["found"][c] > 0 else math.nan, "clip": r["clipped"][c],
                    "spread": r["spread"][c] / r["found"][c], "ideal": r["ideal"][c] / r["found"][c],
                    "rest": math.log(truth / max(middle[c], 1e-9 * truth)), "heard": truth > 0.03 * max(r["truth"]),
                }
            )  # fmt: skip
    return found


def report(all_rows):
    """Print what the pattern lacks, the law that fits it, and the coverage of the intervals of
    strengths.
    """
    every = channels(all_rows)
    dirty_lenses = [x for x in every if not x["clean"] and x["heard"] and x["lost"] == x["lost"]]
    print(
        "mask, strength: channels, what is lost of the pattern (median, 5 and 95 %), of the"
        " estimate, as logarithms"
    )
    for mask in MASKS:
        for low, high in ((2, 1e2), (1e2, 1e4), (1e4, 1e6)):
            some = [x for x in dirty_lenses if x["mask"] == mask and low <= x["strength"] < high]
            lost, rest = (
                np.quantile([x[name] for x in some], [0.5, 0.05, 0.95]) for name in ("lost", "rest")
            )
            texts = ["{:+.3f} ({:+.3f} to {:+.3f})".format(*x) for x in (lost, rest)]
            print(f"{mask:9} {low:g} to {high:g}: {len(some):3}  {'  '.join(texts)}")
    causes(dirty_lenses)
    fit_law(dirty_lenses)
    print(
        "lens, side, strength: channels in their interval, half of the intervals narrower than this"
        " over the strength"
    )
    for clean in (False, True):
        for side in sorted({x["side"] for x in every}):
            for weak in (True, False):
                some = [
                    x
                    for x in every
                    if (x["clean"], x["side"], x["strength"] < 1e3) == (clean, side, weak)
                ]
                held, width = (
                    np.mean([x["held"] for x in some]),
                    np.median([x["width"] for x in some]),
                )
                lens = f"{'clean' if clean else 'dirty'} {side:4} {'below' if weak else 'from'} 1e3"
                print(f"{lens}: {held:.3f} of {len(some)}, {width:.3f}")


def causes(some):
    """Print what each kind of dirt takes out of the pattern where few pixels are clipped
    (non-negative least squares).

    Black marks take in proportion to their number, and paths to the square of their size.
    """
    few = [x for x in some if x["clip"] < 0.1 and x["spread"] < 0.1]
    powers = {"dust": 1, "scratches": 1, "grease": 2, "dents": 2, "defocus": 2}
    matrix = np.array(
        [[abs(x["amounts"][name]) ** power for name, power in powers.items()] for x in few]
    )
    sizes, _ = nnls(matrix, np.array([x["lost"] for x in few]))
    sizes[-1] *= 0.1**2
    named = ", ".join(f"{name} {size:.3f}" for name, size in zip(powers, sizes, strict=True))
    print(
        f"lost by the dirt of the recipe, and by 0.1 waves of defocus, {len(few)} channels: {named}"
    )


def fit_law(some):
    """Print the law of least squares for the frames that tell of dirt."""
    told = [
        x
        for x in some
        if x["spread"] > law._CLEAN_LENS_GROWTH * x["ideal"]
        and x["lost"] > 0.004
        and x["spread"] < 0.3
    ]
    sizes = [
        math.sqrt(x["spread"] ** 2 - x["ideal"] ** 2) * x["side"] / law._SCATTER_SIDE for x in told
    ]
    matrix = np.array(
        [[1.0, math.log(size), x["clip"]] for x, size in zip(told, sizes, strict=True)]
    )
    counts = {side: sum(x["side"] == side for x in told) for side in {x["side"] for x in told}}
    weight = np.array([counts[x["side"]] ** -0.5 for x in told])
    values = np.log([x["lost"] for x in told])
    answer = np.linalg.lstsq(matrix * weight[:, None], values * weight, rcond=None)[0]
    rest = (values - matrix @ answer).std()
    terms = "factor {:.2f}, power {:.2f}, growth with clipping {:.2f}".format(
        math.exp(answer[0]), *answer[1:]
    )
    print(f"law of {len(told)} channels: {terms}, standard deviation {rest:.2f}")


if __name__ == "__main__":
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("file", type=Path)
    parser.add_argument("--seeds", type=int, nargs=2, metavar=("FIRST", "COUNT"))
    parser.add_argument("--side", type=int, default=64, help="pixels a side")
    parser.add_argument("--report", action="store_true")
    given = parser.parse_args()
    torch.set_num_threads(1)
    if given.seeds:
        run(given.file, *given.seeds, given.side)
    if given.report:
        report(rows(given.file))
