"""How much quicker a study of uncertainty is than as many runs: `python bench_uncertainty.py
[RECIPE] [DRAWS]`.

The sensor of RECIPE (paper_table1) is known as well as normal laws of 1 % say, but for the offset
(1 e-). DRAWS (400) draws by the study, from an empty cache, with its page; against as many runs
with the same outputs, from an empty cache each: in this process, median of three, and `neusee run`
as a whole, once, which makes the page of a run too. Last, what the study takes when all its draws
are there, and how it goes on when it is killed half way.
"""

import json
import os
import signal
import statistics
import subprocess
import sys
import tempfile
import time
from pathlib import Path

from neusee.workflows import load
from neusee.workflows.engine.runner import run
from neusee.workflows.store.result_store import Store

OUTPUTS = "outputs=[saturated, lsr, transfer]"
LAWS = [
    "sensor.gain=lognormal(0.37 e-/DN, 1.01)",
    "sensor.quantum_efficiency=lognormal(0.56, 1.01)",
    "sensor.full_well=lognormal(25500 e-, 1.01)",
    "sensor.read_noise=lognormal(10.5 e-, 1.01)",
    "sensor.offset=normal(390 e-, 1 e-)",
    "sensor.dark_current=lognormal(0.002 e-, 1.2)",
]


def seconds(work):
    began = time.perf_counter()
    work()
    return time.perf_counter() - began


def cold(recipe):
    with tempfile.TemporaryDirectory() as folder:
        return seconds(lambda: run(recipe, Store(folder)))


def neusee(cache, *words, kill_after=None):
    """Seconds and exit code of a command of its own, which is killed after so many seconds."""
    environment = {**os.environ, "NEUSEE_CACHE": str(cache)}
    command = [sys.executable, "-m", "neusee.workflows.cli", *words, "--out", str(cache / "runs")]
    began = time.perf_counter()
    process = subprocess.Popen(command, env=environment, stdout=subprocess.DEVNULL)
    try:
        process.wait(kill_after)
    except subprocess.TimeoutExpired:
        process.send_signal(signal.SIGKILL)
        process.wait()
    return time.perf_counter() - began, process.returncode


def main(name="paper_table1", draws="400"):
    recipe = load(name, [OUTPUTS])
    alone = statistics.median(cold(recipe) for _ in range(3))
    print(f"a cold run of {OUTPUTS}: {alone:.1f} s in this process", flush=True)
    with tempfile.TemporaryDirectory() as folder:
        whole, _ = neusee(Path(folder), "run", name, OUTPUTS)
    print(f"`neusee run`, cold: {whole:.1f} s", flush=True)
    words = ["study", "uncertainty", name, OUTPUTS, *LAWS, "--most", draws, "--error", "0.001"]
    with tempfile.TemporaryDirectory() as folder:
        cache = Path(folder)
        took, _ = neusee(cache, *words)
        doc = json.loads((cache / "runs" / "latest" / "provenance.json").read_text())
        again, _ = neusee(cache, *words)
    each = doc["seconds a draw"]
    print(
        f"the study of {doc['draws']} draws: {took:.1f} s, {each:.3f} s a draw; with all draws"
        f" there: {again:.1f} s"
    )
    print(f"every standard deviation to {doc['error']:.1%}")
    print(f"{draws} runs in this process over the study: {int(draws) * alone / took:.0f}")
    print(f"{draws} times `neusee run` over the study: {int(draws) * whole / took:.0f}")
    with tempfile.TemporaryDirectory() as folder:
        cache = Path(folder)
        before, code = neusee(cache, *words, kill_after=0.6 * took)
        rest, _ = neusee(cache, *words)
        other = json.loads((cache / "runs" / "latest" / "provenance.json").read_text())
    same = other["quantities"] == doc["quantities"]
    print(
        f"killed after {before:.1f} s ({code}); went on for {rest:.1f} s and {other['computed']}"
        f" draws: same {same}"
    )


if __name__ == "__main__":
    main(*sys.argv[1:])
