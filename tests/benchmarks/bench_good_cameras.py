"""How often a good camera is refused by the checks: `python tests/benchmarks/bench_good_cameras.py
[CAMERAS] [FILE]`.

CAMERAS (100) of `plain_camera`, which shares no code with neusee: a third each linear, bent by 2 to
3 %, and cubic by 3 %. A line of Markdown for each response: calibrations, checks that failed by
name, z of the gain, effective share and k-hat of the importance samples. Rows are kept in FILE, so
that what was stopped goes on.
"""

import json
import sys
import tempfile
import time
from collections import Counter
from pathlib import Path

import numpy as np
import torch
from plain_camera import PlainCamera, table

from neusee.workflows.calibration import run_calibration
from neusee.workflows.recipe.loading import load
from neusee.workflows.store.result_store import Store

LAWS = []  #: importance samples of the last calibration, which `find_posterior` does not return
RESPONSES = ("linear", "bent", "cubic")


def camera_of(number, rng):
    kind = RESPONSES[number % 3]
    terms = {
        "linear": {},
        "bent": {
            "bend": float(rng.choice([-1, 1]) * rng.uniform(0.02, 0.03)),
            "twist": float(rng.uniform(-0.01, 0.01)),
        },
        "cubic": {"cube": 0.03},
    }[kind]
    return kind, PlainCamera(
        lamp=float(rng.uniform(0.001, 0.01)), drift=0.02, scatter=0.001, **terms
    )


def kept(*arguments, sampled=run_calibration.importance_samples):
    LAWS.append(sampled(*arguments))
    return LAWS[-1]


def calibrated(number):
    rng = np.random.default_rng([1288, number])
    kind, camera = camera_of(number, rng)
    with tempfile.TemporaryDirectory() as folder:
        file = table(camera, [1288, number, 1], Path(folder) / "levels.csv")
        recipe = load("calibrate_camera", [f"table.file={file}"])
        began = time.process_time()
        try:
            found = run_calibration.find_posterior(
                recipe,
                Store(Path(folder) / "s"),
                lambda _: None,
                run_calibration.CalibrationOptions(64, "de", 1000),
            )
        except ValueError as error:
            return {"number": number, "kind": kind, "refused": str(error)}
        seconds = time.process_time() - began
        law = LAWS.pop()
    stated = {m.name: m.stated for m in found.models}["gain"]
    gain = found.draws["gain"]
    return {
        "number": number, "kind": kind, "seconds": seconds, "tau": found.chains.tau, "steps": found.chains.steps,
        "share": float(1 / (law.weights**2).sum() / len(law.weights)), "tail": law.tail,
        "failed": [c.name for c in found.checks if c.mark == "fail"],
        "warned": [c.name for c in found.checks if c.mark == "warn"],
        "z": float((gain.mean() - camera.gain) / gain.std()), "stated": stated.low <= camera.gain <= stated.high,
        "text": {c.name: c.found for c in found.checks},
    }  # fmt: skip


def main(count=100, file="good_cameras.jsonl"):
    torch.set_num_threads(1)
    run_calibration.importance_samples = kept
    path = Path(file)
    rows = [json.loads(line) for line in path.read_text().splitlines()] if path.exists() else []
    done = {row["number"] for row in rows}
    for number in range(int(count)):
        if number not in done:
            rows.append(calibrated(number))
            with path.open("a") as opened:
                opened.write(json.dumps(rows[-1]) + "\n")
    columns = (
        "cameras | refused | checks that fail | z of the gain, sd | gain in stated 90 % | tau |"
        " share | k-hat"
    )
    print(f"| response | {columns} |")
    print("|---|---|---|---|---|---|---|---|---|")
    for kind in RESPONSES:
        own = [row for row in rows if row["kind"] == kind]
        good = [row for row in own if "refused" not in row]
        names = Counter(name for row in good for name in row["failed"])
        print(
            f"| {kind} | {len(own)} | {len(own) - len(good)} | {dict(names) or 'none'} |"
            f" {np.std([row['z'] for row in good]):.2f} |"
            f" {np.mean([row['stated'] for row in good]):.0%} |"
            f" {np.median([row['tau'] for row in good]):.1f} (at most"
            f" {max(row['tau'] for row in good):.1f}) |"
            f" {np.median([row['share'] for row in good]):.2f} (at least"
            f" {min(row['share'] for row in good):.2f}) | {max(row['tail'] for row in good):.2f} at"
            " most |"
        )
    print(
        "\nSeconds of a calibration without page:"
        f" {np.median([r['seconds'] for r in rows if 'seconds' in r]):.1f}."
    )


if __name__ == "__main__":
    main(*sys.argv[1:])
