"""First forecasts against the runs that follow, on two kinds of processor.

    python tests/benchmarks/bench_forecasts.py FOLDER [NAME ...]   # runs that FOLDER lacks, then the table

Each packaged recipe runs at a small size with an empty cache, in a process of its own: with all
instructions of the processor, and with ATEN_CPU_CAPABILITY=default and one thread in place of
another processor. The forecast is that of an empty cache under the same conditions; it is computed
anew each time, the runs are kept. All times are processor times, so that other work on the machine
counts little. A forecast holds its interval if the measured time lies in it.
"""

import json
import os
import subprocess
import sys
import tempfile
from pathlib import Path
from statistics import median

from measured_runs import N, S, at, file_of

CONDITIONS = {
    "all instructions": {},
    "default instructions": {"ATEN_CPU_CAPABILITY": "default", "OMP_NUM_THREADS": "1"},
}
SMALL = {
    **{name: [name, *N] for name in ("first_light", "axicon", "half_ring", "laser_free")},
    **{name: [name, *N] for name in ("plain_lens", "five_half_rings", "train", "pointer")},
    **{name: [name, *S] for name in ("dirty_windshield", "hdr_night", "train_unrolled")},
    **{name: [name, *at(160, 128, 540, 160)] for name in ("six_lasers", "demonstration")},
    "paper_table1": ["paper_table1", *at(384, 320, 360, 320)],
    "paper_protocol": ["paper_protocol", *S],
    "train_demonstration": ["train_demonstration", *S],
    "first_light, pictures": ["first_light", *S, "outputs=[raw, developed]"],
    "first_light, one number": ["first_light", *S, "outputs=[lsr]"],
    "first_light, 224 px": ["first_light", *at(224, 192, 225, 192)],
    "half_ring, 224 px": ["half_ring", *at(224, 192, 225, 192)],
    "train_small": ["train_small"],
    "train_lift": ["train_lift"],
    "calibrate": ["calibrate", "flats.shape=[128,128]"],
    "calibrate_camera": ["calibrate_camera"],
    "calibrate_stray_light": ["calibrate_stray_light"],
}


def collect(folder, names):
    """Carry out the runs that ``folder`` lacks, and write what they took."""
    for name in names:
        for condition, variables in CONDITIONS.items():
            target = Path(folder, file_of(f"{name} {condition}"))
            if not target.exists():
                one_run(target, SMALL[name], variables)
                print(target.name, "done" if target.exists() else "failed", flush=True)


def one_run(target, words, variables):
    """Run a recipe in a process of its own, and write the marks and the journal of the run."""
    with tempfile.TemporaryDirectory() as place:
        done = child(["--measure", f"{place}/marks.json", *words], variables, place)
        if done.returncode not in (0, 3):
            print(done.stderr[-600:], flush=True)
            return
        marks = json.loads(Path(place, "marks.json").read_text())
        lines = Path(place, "cache", "journal.jsonl").read_text().splitlines()[1:]
        rows = [json.loads(line) for line in lines if line]
        kept = ("step", "node", "processor_seconds", "processor", "threads")
        steps = [{key: row.get(key) for key in kept} for row in rows]
        target.write_text(json.dumps({"words": words, **marks, "steps": steps}))


def child(arguments, variables, place):
    """Run this file in a process of its own with an empty cache."""
    environment = {**os.environ, **variables, "NEUSEE_CACHE": f"{place}/cache"}
    command = [sys.executable, __file__, *arguments]
    return subprocess.run(
        command, env=environment, cwd=place, capture_output=True, text=True, check=False
    )


def compared(folder, names):
    """Print measured over expected time, and how often the interval held, of steps and of whole
    commands under each condition.
    """
    for condition, variables in CONDITIONS.items():
        ratios, held = {"steps": [], "command": []}, {"steps": 0, "command": 0}
        for name in names:
            path = Path(folder, file_of(f"{name} {condition}"))
            if not path.exists():
                continue
            run = json.loads(path.read_text())
            measured = {"steps": measured_steps(run), "command": run["end"]}
            for part, span in forecast_of(run["words"], variables).items():
                ratio = measured[part] / span["expected"]
                ratios[part].append(ratio)
                held[part] += span["least"] <= measured[part] <= span["most"]
                ends = f"({span['least']:.2g}-{span['most']:.2g})"
                print(
                    f"  {name}, {condition}: {part} {measured[part]:.2f} s, forecast"
                    f" {span['expected']:.2f} {ends}",
                    flush=True,
                )
        for part, found in ratios.items():
            middle = f"{median(found):.2f}" if found else "-"
            print(
                f"{condition}: {part}: {held[part]} of {len(found)} in the interval, measured"
                f" over expected {middle} in the median",
                flush=True,
            )


def measured_steps(run):
    """Return the processor time of all steps of a run."""
    return sum(row["processor_seconds"] or 0.0 for row in run["steps"])


def forecast_of(words, variables):
    """Return the forecast of the steps and of the command, for an empty cache."""
    with tempfile.TemporaryDirectory() as place:
        done = child(["--forecast", *words], variables, place)
    totals = json.loads(done.stdout)["totals"]
    return {"steps": totals["seconds"], "command": totals["seconds_of_command"]}


def forecast(words):
    """Print the forecast of a run as JSON, as `neusee plan` does, of a recipe that trains too."""
    from neusee.workflows.cli.app import settle_threads

    settle_threads("plan")
    from neusee.workflows import Store, load
    from neusee.workflows.explain.run_forecast import forecast as forecast_of_run

    found = forecast_of_run(load(words[0], words[1:]), Store(Path("cache")))
    print(json.dumps({"totals": found.totals}))


def measure(target, words):
    """Run the program in this process, and write the processor time before, with and after the
    steps.
    """
    from neusee.workflows.cli.app import main, settle_threads

    settle_threads("run")  # before the first import of torch, as the program does
    from neusee.workflows.engine.processor_speed import process_seconds
    from neusee.workflows.simulation import simulate_recipe

    marks, inner = {}, simulate_recipe.run

    def run(*args, **options):
        marks["before"] = process_seconds()
        result = inner(*args, **options)
        marks["after_steps"] = process_seconds()
        marks["shown"] = sum(done.bytes or 0 for done in result.done.values())
        return result

    simulate_recipe.run = run
    sys.argv = ["neusee", "run", *words, "--quiet", "--out", "runs"]
    try:
        main()
    finally:
        if "after_steps" in marks:
            Path(target).write_text(json.dumps(marks | {"end": process_seconds()}))


if __name__ == "__main__":
    if sys.argv[1] == "--measure":
        measure(sys.argv[2], sys.argv[3:])
    elif sys.argv[1] == "--forecast":
        forecast(sys.argv[2:])
    else:
        Path(sys.argv[1]).mkdir(parents=True, exist_ok=True)
        collect(sys.argv[1], sys.argv[2:] or SMALL)
        compared(sys.argv[1], SMALL)
