"""What `neusee calibrate` says of frames with planted faults.

    python tests/benchmarks/bench_contaminated.py FILE [FILE ...] [options]

    FILE             JSON lines, one a camera; cameras that are in any FILE are not computed again, and new lines go to
                     the first
    --shard K/N      of N equal parts of the cameras the K-th alone, 1 to N: each with a first FILE of its own
    --cameras N      cameras of each row (20)
    --clean N        clean cameras through the whole calibration (20)
    --minutes M      stop after M minutes
    --only A,B       rows by the name of their fault
    --modes A,B      of density, camera
    --quick          importance samples about the mode in place of chains, with all checks of frames and levels
    --table          only print the table of FILE

The frames come from a camera in NumPy that shares no code with the nodes; they are written to files
and calibrated with the search, the chains and all checks of the command. Where a check fails, or
the frames are refused, the command ends with 3. Only values that a calibration with exit code 0
states are judged: by their distance from the truth in stated standard deviations, and by the
interval between the 0.5 % and the 99.5 % quantile of the draws.
"""

import argparse
import json
import random
import sys
import time
from collections import defaultdict
from pathlib import Path
from tempfile import TemporaryDirectory

import numpy as np
import torch
from scipy.stats import binomtest

from neusee.workflows.calibration.calibration_page import CalibrationResult
from neusee.workflows.calibration.emcee_sampler import Chains
from neusee.workflows.calibration.frame_validity import frame_checks, inspect_recipe, widened
from neusee.workflows.calibration.identifiability import identify
from neusee.workflows.calibration.log_posterior import SensorPosterior, find_mode, initial_theta
from neusee.workflows.calibration.posterior_checks import (
    Check,
    count_failures,
    data_checks,
    importance_samples,
)
from neusee.workflows.calibration.run_calibration import (
    CalibrationOptions,
    CalibrationRefused,
    FramesRefused,
    find_posterior,
)
from neusee.workflows.recipe.loading import load
from neusee.workflows.store.result_store import Store

sys.path.insert(0, str(Path(__file__).parents[1] / "nodes/calibrate"))
from numpy_camera import Camera

#: rows of the table: a name, and the faults of its cameras
ROWS = {
    "clean": {},
    "unequal pixels": {"prnu": 0.01, "dsnu": 3},
    "mixing 0.01": {"mixing": 0.01},
    "mixing 0.03": {"mixing": 0.03},
    "mixing 0.1": {"mixing": 0.1},
    "lag 0.01": {"lag": 0.01},
    "lag 0.03": {"lag": 0.03},
    "dsnu 8": {"dsnu": 8},
    "prnu 0.01": {"prnu": 0.01},
    "telegraph 0.02": {"telegraph": 0.02},
    "stuck 0": {"stuck": 0},
    "stuck 3": {"stuck": 3},
    "black 0": {"black": 0},
    "black -2": {"black": -2},
    "rows 1": {"rows": 1},
    "rows 3": {"rows": 3},
    "columns 1": {"columns": 1},
    "compression 1": {"compression": 1},
    "compression 4": {"compression": 4},
    "drift 0.01": {"drift": 0.01},
    "hot 0.01": {"hot": 0.01},
    "knee 0.7": {"knee": 0.7},
    "knee 0.5": {"knee": 0.5},
    "truncation": {"truncation": 1},
}
NOISE = {"density": "read_noise", "camera": "temporal_dark_noise"}
RECIPE = """\
steps:
  frames: {node: calibrate.frames, each: measured, with: {files: "${item.files}"}}
  level:
    node: calibrate.reduce
    each: measured
    from: frames
    with: {photons: "${item.photons}", exposure: "${item.exposure}", scatter: SCATTER}
  levels: {node: calibrate.levels, from: level}
"""
LIKELIHOOD = {
    "density": (
        """\
  sufficient: {node: calibrate.sufficient, from: levels}
  prior:
    node: calibrate.prior
    with:
      gain: [0.15 DN/e-, 2]
      offset: [800 e-, 100 e-]
      read_noise: [10 e-, 2]
      dark_current: [5 e-, 10]
      quantum_efficiency: [0.6, 2]
  density:
    node: calibrate.density
    from: {levels: sufficient}
    with:
      gain: 0.15 DN/e-
      quantum_efficiency: 0.6
      offset: 800 e-
      read_noise: 10 e-
      dark_current: 5 e-
      dark_exposure: 1 s
      full_well: 100000 e-
      arrivals: poisson
      bits: 12
outputs: [density]
"""
    ),
    "camera": (
        """\
  prior:
    node: calibrate.camera_prior
    with:
      gain: [0.15 DN/e-, 10]
      quantum_efficiency: [0.6, 2]
      dark_signal: [90, 1000]
      temporal_dark_noise: [10 e-, 5]
      dark_current: [5 e-, 10]
      scatter: [0.003, 3]
      lamp: [0.01, 10]
      drift: [0.03, 3]
      bend: [0, 0.05]
      twist: [0, 0.05]
  camera:
    node: calibrate.camera
    from: {levels: levels}
    with:
      gain: 0.15 DN/e-
      quantum_efficiency: 0.6
      dark_signal: 90
      temporal_dark_noise: 10 e-
      dark_current: 5 e-
      dark_exposure: 1 s
      lamp: 0.01
      drift: 0.03
outputs: [camera]
"""
    ),
}


def camera(mode, row, seed):
    """A camera of 20 levels; of a real one the lamp scatters from level to level, and so does
    that of a clean one.
    """
    faults = {**ROWS[row], **({"lamp": 0.005} if mode == "camera" else {})}
    return Camera(list(ROWS).index(row) * 10_000 + seed, size=96, lit=16, darks=4, faults=faults)


def truth(made, mode):
    """What a calibration of the pixels of this camera should say."""
    current = 5 + float(made._hot.mean())
    level = made.offset + made.gain * (float(made._dsnu.mean()) + 1e-3 * current)
    # numbers that are cut are those of an offset lower by half a number
    level -= 0.5 * made._of("truncation")
    if "black" in made.faults:
        level -= np.rint(made.offset + made._of("black") * made.gain * made.noise)
    known = {
        "gain": made.gain,
        "quantum_efficiency": made.efficiency * float(made._prnu.mean()),
        NOISE[mode]: made.noise,
    }
    known["dark_current"] = current
    return known | (
        {"dark_signal": level}
        if mode == "camera"
        else {"offset": level / made.gain - 1e-3 * current}
    )


def written(folder, made, mode):
    """Write the frames and the recipe of a camera; return the truth. The light is the mean of
    both frames of a pair.
    """
    lines = ["# Frames of a camera in NumPy.", "measured:"]
    for name, photons, exposure, frames in made.levels():
        file = name.replace(" ", "_") + ".npy"
        np.save(folder / file, frames.astype(np.uint16))
        light = photons * (1 + made._of("drift") * (made.frames - 1) / 2)
        lines.append(
            f"  {file[:-4]}: {{files: {file}, photons: {light:.6f}, exposure: {exposure:.6g} s}}"
        )
    scatter = "all" if mode == "density" else "steady"
    (folder / "mine.yaml").write_text(
        "\n".join([*lines, RECIPE.replace("SCATTER", scatter) + LIKELIHOOD[mode]])
    )
    return truth(made, mode)


def sampled(recipe, store):
    """The result of a calibration from importance samples of 4000 draws, without chains and
    models of the response.
    """
    tests = inspect_recipe(recipe, store)
    if any(test.verdict == "refused" for test in tests):
        raise FramesRefused(tests)
    problem = SensorPosterior.of(recipe, store)
    mode = find_mode(problem, initial_theta(problem))
    identifiability = identify(problem, mode)
    if identifiability.refused:
        raise CalibrationRefused(identifiability.refused)
    law = importance_samples(problem, mode, recipe.seed)
    chosen = np.random.default_rng(1).choice(len(law.weights), 8000, p=law.weights)
    chains = Chains(
        law.samples[chosen][None, :, None], np.zeros((1, 8000, 1)), 0.3, 1.0, 8000, True
    )
    search = Check("the search found the mode", "", "settled", "pass" if mode.settled else "fail")
    found = [*frame_checks(tests), search, *data_checks(problem, mode, identifiability, law)]
    return CalibrationResult(
        problem, mode, identifiability, widened(problem, chains, tests, 2), found, (), tests
    )


def calibrated(mode, row, seed, quick):
    """Return the line of one camera: exit code, failed checks, and what is stated of each
    parameter.
    """
    began = time.process_time()
    line = {
        "mode": mode,
        "row": row,
        "seed": seed,
        "quick": quick,
        "exit": 0,
        "wrong": [],
        "stated": {},
    }
    with TemporaryDirectory() as name:
        folder = Path(name)
        known = written(folder, camera(mode, row, seed), mode)
        recipe, store = load("mine.yaml", folder=folder), Store(folder / "store")
        try:
            if quick:
                result = sampled(recipe, store)
            else:
                result = find_posterior(
                    recipe, store, lambda text: None, CalibrationOptions(64, "de", 1000)
                )
        except FramesRefused as refused:
            line |= {"exit": 3, "wrong": [t.name for t in refused.tests if t.verdict == "refused"]}
        except (CalibrationRefused, ValueError) as error:
            line |= {"exit": 2, "wrong": [str(error)[:80]]}
        else:
            line |= told(result, known)
    return line | {"seconds": round(time.process_time() - began, 1)}


def told(result, known):
    stated = {}
    for name, kind in result.identifiability.kinds.items():
        if kind == "estimate" and name in known:
            draws = result.draws[name].reshape(-1)
            low, high = np.quantile(draws, [0.005, 0.995])
            z = float((draws.mean() - known[name]) / draws.std())
            stated[name] = {"z": round(z, 3), "outside": bool(not low <= known[name] <= high)}
    models = {m.name: m.stated for m in result.models if m.name in stated}
    for name, interval in models.items():
        # 90 %
        stated[name]["spread outside"] = bool(not interval.low <= known[name] <= interval.high)
    spread = result.draws["gain"].std() / result.draws["gain"].mean()
    at = result.problem.names.index("gain")  # whose coordinate is its logarithm
    alone = float(np.sqrt(result.mode.covariance[at, at]))
    return {
        "exit": 3 if count_failures(result.checks) else 0,
        "wrong": [check.name for check in result.checks if check.mark == "fail"],
        "verdicts": {t.name: t.verdict for t in result.frames if t.verdict != "passed"},
        "stated": stated,
        "gain sd": round(float(spread), 5),
        "wider": round(float(spread / alone), 2),
    }


def key(line):
    return line["mode"], line["row"], line["seed"], line["quick"]


def lines_of(files):
    """All cameras of the files, each once; a line that was cut off is left out."""
    text = "\n".join(file.read_text() for file in files if file.exists())
    found = [json.loads(line) for line in text.splitlines() if line.endswith("}")]
    return list({key(line): line for line in found}.values())


def cameras(given):
    """The cameras (mode, row, seed, quick) of one shard, by their seeds; rows in another order for
    each seed.

    So each row gets its cameras at the same pace, and all shards take about the same time.
    """
    counts = {
        row: given.clean if row in ("clean", "unequal pixels") else given.cameras for row in ROWS
    }
    rows = [row for row in ROWS if row in given.only.split(",")]
    number, of = map(int, given.shard.split("/"))
    every = []
    for seed in range(max(counts.values())):
        own = [(mode, row, seed, given.quick) for row in rows for mode in given.modes.split(",")]
        own = [
            one for one in own if seed < (given.cameras if one[:2] == _UNTRUE else counts[one[1]])
        ]
        every += random.Random(seed).sample(own, len(own))
    return every[number - 1 :: of]


def table(lines):
    """Print the rows of each mode, and the clean cameras that were refused."""
    groups = defaultdict(list)
    for line in lines:
        groups[line["mode"], line["row"]].append(line)
    print(
        "| mode | fault | cameras | exit 3 | by | values stated | beyond 5 sd | outside 99 % |"
        " largest z | wider | s |"
    )
    print("|---|---|---|---|---|---|---|---|---|---|---|")
    every = []
    for (mode, row), group in sorted(
        groups.items(), key=lambda x: (x[0][0], list(ROWS).index(x[0][1]))
    ):
        good = [line for line in group if not line["exit"]]
        values = [value for line in good for value in line["stated"].values()]
        every += values
        wrong = defaultdict(int)
        for line in group:
            for name in line["wrong"]:
                wrong[name] += 1
        by = ", ".join(f"{name} {n}" for name, n in sorted(wrong.items(), key=lambda x: -x[1])[:3])
        z = [abs(value["z"]) for value in values]
        wider = f"{np.median([line['wider'] for line in good]):.1f}" if good else ""
        print(
            f"| {mode} | {row} | {len(group)} | {len(group) - len(good)} | {by} | {len(values)} |"
            f" {sum(x > 5 for x in z)} | {sum(v['outside'] for v in values)} |"
            f" {max(z, default=0):.1f} | {wider} |"
            f" {np.median([line['seconds'] for line in group]):.1f} |"
        )
    outside = sum(value["outside"] for value in every)
    ends = binomtest(outside, max(1, len(every))).proportion_ci(0.95, "exact")
    print(
        f"\n{outside} of {len(every)} stated values outside 99 % ({ends.low:.2%} to"
        f" {ends.high:.2%})."
    )
    clean = [
        line
        for line in lines
        if line["row"] in ("clean", "unequal pixels") and (line["mode"], line["row"]) != _UNTRUE
    ]
    if clean:
        false = sum(line["exit"] > 0 for line in clean)
        ends = binomtest(false, len(clean)).proportion_ci(0.95, "exact")
        print(
            f"{false} of {len(clean)} clean cameras with exit code 3 ({ends.low:.2%} to"
            f" {ends.high:.2%})."
        )


#: pixels that differ are no clean camera where all pixels count as alike
_UNTRUE = ("density", "unequal pixels")


def main():
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("files", type=Path, nargs="+")
    for name, kind, default in (("cameras", int, 20), ("clean", int, 20), ("minutes", float, 1e9)):
        parser.add_argument(f"--{name}", type=kind, default=default)
    parser.add_argument("--only", default=",".join(ROWS))
    parser.add_argument("--modes", default="density,camera")
    parser.add_argument("--shard", default="1/1")
    for name in ("quick", "table"):
        parser.add_argument(f"--{name}", action="store_true")
    given = parser.parse_args()
    torch.set_num_threads(1)
    done = {key(line) for line in lines_of(given.files)}
    until = time.monotonic() + (0 if given.table else 60 * given.minutes)
    for one in cameras(given):
        if one not in done and time.monotonic() < until:
            line = calibrated(*one)
            with given.files[0].open("a") as opened:
                opened.write(json.dumps(line) + "\n")
    for quick in (False, True):
        if chosen := [line for line in lines_of(given.files) if line["quick"] == quick]:
            print(f"\n{'Importance samples' if quick else 'Chains'}:\n")
            table(chosen)


if __name__ == "__main__":
    main()
