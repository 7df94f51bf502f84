"""Runs of shipped recipes at several sizes, with the processor time and the peak memory of each
step, for cost laws.

    python tests/benchmarks/measured_runs.py FOLDER [NAME ...]   # one file for each run that FOLDER lacks

Each run has an empty cache and its own process with one thread. The time of a step is the processor
time of its thread, so that other work on the machine counts little. The peak memory is that of the
kernel, which misses nothing. ``fit_costs.py`` fits the laws to the runs in FIT, and
``bench_memory.py`` compares with all runs.
"""

import json
import os
import subprocess
import sys
import tempfile
import time
from pathlib import Path
from types import SimpleNamespace


def at(scene, sensor, samples, window):
    """Changes of a recipe to a scene, sensor, pupil and window of other sizes; the pupil keeps
    its width.
    """
    sizes = {"scene.shape": [scene] * 2, "sensor.shape": [sensor] * 2, "optics.samples": samples}
    sizes |= {"optics.pitch": f"{8.0784 / samples * 1e3:.4f} um", "optics.window": [window] * 2}
    return [f"{name}={value}" for name, value in sizes.items()]


N, S, T = at(96, 64, 128, 96), at(160, 128, 180, 160), at(224, 192, 225, 192)
A, U = at(288, 240, 270, 256), at(320, 256, 300, 256)
B, C, E = at(384, 320, 360, 320), at(512, 448, 432, 416), at(1152, 960, 900, 896)
P = ["outputs=[raw, developed]"]  # pictures alone, for which PSFs of few bands may do
FIT = {  # small ones first
    "calibrate_camera (as shipped)": ["calibrate_camera"],
    "calibrate, 128 px": ["calibrate", "flats.shape=[128,128]"],
    "calibrate, 1024 px": ["calibrate", "flats.shape=[1024,1024]"],
    "train_lift, 32 px (as shipped)": ["train_lift"],
    "train_lift, 512 px": ["train_lift", "patch.shape=[512,512]"],
    "first_light, 96 px": ["first_light", *N],
    "first_light, 288 px": ["first_light", *A],
    "dirty_windshield, 288 px": ["dirty_windshield", *A],
    "hdr_night, 288 px": ["hdr_night", *A],
    "demonstration, 384 px": ["demonstration", *at(384, 320, 540, 320)],
    "train_small, 96 px (as shipped)": ["train_small"],
    "train_small, 384 px": ["train_small", *B],
    "axicon, 224 px": ["axicon", *T],
    "six_lasers, 288 px": ["six_lasers", *at(288, 240, 540, 256)],
    "hdr_night, 512 px": ["hdr_night", *C],
    "first_light, 768 px (as shipped)": ["first_light"],
    "first_light --exact, 384 px": ["first_light", *B, "--exact"],
    "paper_table1, 1024 px": ["paper_table1", *at(1024, 1024, 1080, 1024)],
    "first_light, pictures, 384 px": ["first_light", *B, *P],
    "dirty_windshield, pictures, 512 px": ["dirty_windshield", *C, *P, "tolerance=1e-2"],
    "first_light, pictures, 768 px (as shipped)": ["first_light", *P, "tolerance=1e-2"],
    "paper_table1, pictures, 1024 px": [
        "paper_table1",
        *at(1024, 1024, 1080, 1024),
        *P,
        "tolerance=1e-2",
    ],
}
HELD_OUT = {
    "calibrate, 256 px (as shipped)": ["calibrate"],
    "train_lift, 128 px": ["train_lift", "patch.shape=[128,128]"],
    "five_half_rings, 160 px": ["five_half_rings", *S],
    "half_ring, 224 px": ["half_ring", *T],
    "laser_free, 320 px": ["laser_free", *U],
    "plain_lens, 384 px": ["plain_lens", *B],
    "train, 288 px": ["train", *A],
    "train_small, 192 px": ["train_small", *at(192, 128, 256, 192)],
    "train_demonstration, 160 px": ["train_demonstration", *S],
    "hdr_night, 384 px": ["hdr_night", *B],
    "hdr_night, 768 px (as shipped)": ["hdr_night"],
    "dirty_windshield, 160 px": ["dirty_windshield", *S],
    "half_ring, 320 px": ["half_ring", *U],
    "six_lasers, 160 px": ["six_lasers", *at(160, 128, 540, 160)],
    "demonstration, 160 px": ["demonstration", *at(160, 128, 540, 160)],
    "axicon, 320 px": ["axicon", *U],
    "five_half_rings, 320 px": ["five_half_rings", *U],
    "plain_lens, 224 px": ["plain_lens", *T],
    "train, 160 px": ["train", *S],
    "train_demonstration, 320 px": ["train_demonstration", *U],
    "laser_free, 96 px": ["laser_free", *N],
    "six_lasers, 224 px": ["six_lasers", *at(224, 192, 540, 192)],
    "demonstration, 224 px": ["demonstration", *at(224, 192, 540, 192)],
    "dirty_windshield, 384 px": ["dirty_windshield", *B],
    "axicon, 96 px": ["axicon", *N],
    "five_half_rings, 96 px": ["five_half_rings", *N],
    "half_ring, 96 px": ["half_ring", *N],
    "plain_lens, 96 px": ["plain_lens", *N],
    "laser_free, 224 px": ["laser_free", *T],
    "train, 96 px": ["train", *N],
    "train_demonstration, 96 px": ["train_demonstration", *N],
    "paper_table1, 512 px": ["paper_table1", *C],
    "paper_table1, 768 px": ["paper_table1", *at(768, 640, 720, 704)],
    "first_light, 384 px": ["first_light", *B],
    "axicon, 768 px (as shipped)": ["axicon"],
    "first_light, 1152 px": ["first_light", *E],
    "paper_table1, 2048 px (as shipped)": ["paper_table1"],
    "first_light, pictures, 512 px": ["first_light", *C, *P],
    "dirty_windshield, pictures, 768 px (as shipped)": ["dirty_windshield", *P],
    "six_lasers, pictures, 768 px (as shipped)": ["six_lasers", *P, "tolerance=1e-2"],
    "first_light, pictures, 1152 px": ["first_light", *E, *P, "tolerance=1e-2"],
    "paper_table1, pictures, 768 px": ["paper_table1", *at(768, 640, 720, 704), *P],
    "paper_table1, pictures, 2048 px (as shipped)": ["paper_table1", *P, "tolerance=1e-2"],
}
RUNS = FIT | HELD_OUT


def file_of(name):
    """Return the name of the file of a run."""
    return name.replace(",", "").replace(" ", "_").replace("(", "").replace(")", "") + ".json"


def collect(folder, names):
    """Carry out each run of ``names`` that ``folder`` lacks, in its own process with an empty
    cache.
    """
    for name in names:
        target = Path(folder, file_of(name))
        if target.exists():
            continue
        with tempfile.TemporaryDirectory() as place:
            env = {**os.environ, "NEUSEE_CACHE": f"{place}/cache", "OMP_NUM_THREADS": "1"}
            words = ["run", *RUNS[name], "--quiet", "--out", f"{place}/runs"]
            began = time.perf_counter()
            done = subprocess.run(
                [sys.executable, __file__, "--measure", f"{place}/marks.json", *words],
                env=env,
                capture_output=True,
                text=True,
                check=False,
            )
            took = time.perf_counter() - began
            marks = Path(place, "marks.json")
            if not marks.exists() or done.returncode not in (0, 3):
                print(
                    f"{name}: exit {done.returncode}: {(done.stdout + done.stderr)[-600:]}",
                    flush=True,
                )
                continue
            lines = Path(place, "cache", "journal.jsonl").read_text().splitlines()[1:]
            rows = [json.loads(line) for line in lines if line]
            kept = ("step", "node", "seconds", "bytes", "peak", "device")
            found = {"name": name, "words": RUNS[name], **json.loads(marks.read_text())}
            target.write_text(
                json.dumps(found | {"steps": [{key: row.get(key) for key in kept} for row in rows]})
            )
        print(
            f"{name}: {took:.0f} s, {found['running'] / 1e6:.0f},"
            f" {found['reporting'] / 1e6:.0f} MB",
            flush=True,
        )


def measure(target, words):
    """Run the program in this process, with processor time for the times of steps, and write
    what the process held.
    """
    from neusee.workflows.cli.app import main
    from neusee.workflows.engine import machine_resources as memory_use
    from neusee.workflows.engine import step_job
    from neusee.workflows.simulation import simulate_recipe

    step_job.time = SimpleNamespace(time=time.time, perf_counter=time.thread_time)
    marks, inner, computed = {"grown": []}, simulate_recipe.run, step_job._computed

    def watched(work, *others):
        before, there = (
            memory_use.process_memory(),
            {name.partition(".")[0] for name in sys.modules},
        )
        outcome = computed(work, *others)
        new = sorted({name.partition(".")[0] for name in sys.modules} - there)
        grown = memory_use.process_memory() - before - outcome.bytes
        marks["grown"].append([work.step.name, work.step.node.path, grown, new])
        return outcome

    def run(*args, **options):
        marks["before"] = memory_use.process_memory()
        result = inner(*args, **options)
        marks["running"], marks["after"] = memory_use.process_peak(), memory_use.process_memory()
        marks["values"] = sum(
            done.bytes for name, done in result.done.items() if name in result.values
        )
        memory_use._peak_reset()
        memory_use._highest = 0
        return result

    simulate_recipe.run, step_job._computed = run, watched
    sys.argv = ["neusee", *words]
    try:
        main()
    finally:
        if "running" in marks:
            marks |= {"reporting": memory_use.process_peak(), "end": memory_use.process_memory()}
            Path(target).write_text(json.dumps(marks))


if __name__ == "__main__":
    if sys.argv[1] == "--measure":
        measure(sys.argv[2], sys.argv[3:])
    else:
        Path(sys.argv[1]).mkdir(parents=True, exist_ok=True)
        collect(sys.argv[1], sys.argv[2:] or RUNS)
