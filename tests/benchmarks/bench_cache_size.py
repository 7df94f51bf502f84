"""`cache ls`, `cache gc` and the start of a run with a large cache: seconds and memory, as a table
in RESULTS.md.

    python tests/benchmarks/bench_cache_size.py [--results N ...]

Makes a cache of N results (100 000) in a temporary folder, one in four with a file of 1 kB, and
runs each command in a process of its own. An empty cache shows what the start of the program takes.
"""

from __future__ import annotations

import argparse
import os
import random
import subprocess
import sys
import tempfile
from pathlib import Path
from typing import Any

from stored_results import store_rows

from neusee.workflows.keys.sealed_files import seal_record
from neusee.workflows.store.journal import row_of

DOCUMENT = "cache_size"  #: in `results/`
ABOUT = """Processor seconds (user and system) and peak resident memory of each process, the start of the \
program included, on a machine that others used too. One result in four has a file of 1 kB."""
COMMANDS = {
    "cache ls": ["cache", "ls"],
    "cache ls --all": ["cache", "ls", "--all"],
    "plan laser_free": ["plan", "laser_free"],
    "run laser_free": ["run", "laser_free", "--quiet"],
    "cache gc --dry-run": ["cache", "gc", "--dry-run"],
    "cache gc --budget 155 MB": ["cache", "gc", "--budget", "155 MB"],
    "cache gc, again": ["cache", "gc", "--budget", "155 MB"],
}


def about_of(i: int, key: str, rng: random.Random) -> dict[str, Any]:
    """Return the metadata of one result, of the length that a PSF has in a recipe."""
    found: dict[str, Any] = {
        "key": key,
        "step": f"psf[mask,{i % 7}]",
        "recipe": "first_light",
        "origin": {
            "node": "optics.psf",
            "code": "c" * 32,
            "params": {f"p{k}": 1.1 * k for k in range(10)},
        },
        "facts": {
            "shape": [31, 64, 64],
            "dtype": "float32",
            "min": 0.0,
            "max": 1.0,
            "sum": 12.0,
            "finite": True,
        },
        "checks": [["phase step 0.31 turn < 0.5", True]] * 3,
        "seconds": rng.random(),
        "bytes": 512,
        "peak": 123456,
        "device": "cpu",
        "versions": {"neusee": "0.1.0", "torch": "2.5", "python": "3.11"},
        "date": f"2026-01-{i % 28 + 1:02d}T00:00:00+00:00",
        "layout": {"tensor": 0},
        "kept": True,
        "payload": None,
    }
    if i % 4:
        return {**found, "tensors": [["F32", [128], False, "AAAA" * 170 + "AAA="]]}
    return {**found, "payload": {"size": 1024, "xxh3": "0" * 32}}


def fill(root: Path, count: int) -> None:
    """Write a cache of ``count`` results and its journal."""
    rng = random.Random(1)
    for name in ("tmp", *(f"{i:02x}" for i in range(256))):
        (root / name).mkdir(parents=True)
    with (root / "journal.jsonl").open("wb") as journal:
        journal.write(b'{"journal":"%s","format":2}' % (b"0" * 16))
        for i in range(count):
            key = f"{rng.getrandbits(128):032x}"
            about = about_of(i, key, rng)
            if about["payload"]:
                (root / key[:2] / f"{key}.safetensors").write_bytes(bytes(1024))
            (root / key[:2] / f"{key}.json").write_bytes(seal_record("result", about))
            journal.write(b"\n" + seal_record("journal", row_of(key, about)))


def measured(root: Path, words: list[str]) -> tuple[float, float, str]:
    """Return the processor seconds and the peak in MB of one command, and the last line that it
    prints.
    """
    command = [sys.executable, "-m", "neusee", *words]
    with tempfile.TemporaryFile() as out:
        process = subprocess.Popen(
            command, env={**os.environ, "NEUSEE_CACHE": str(root)}, stdout=out, cwd=root.parent
        )
        _, status, used = os.wait4(process.pid, 0)
        if status:
            raise SystemExit(f"{' '.join(command)} ended with status {status}")
        out.seek(0)
        last = out.read().decode().rstrip().rpartition("\n")[2]
    return used.ru_utime + used.ru_stime, used.ru_maxrss / 1e3, last


def main() -> None:
    """Measure every command on caches of each size, and record them."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--results", type=int, nargs="+", default=[0, 100_000])
    rows = []
    for count in parser.parse_args().results:
        with tempfile.TemporaryDirectory() as place:
            fill(Path(place) / "cache", count)
            for name, words in COMMANDS.items():
                seconds, peak, last = measured(Path(place) / "cache", words)
                print(f"{count} {name}: {seconds:.2f} s, {peak:.0f} MB; {last}", flush=True)
                rows.append([str(count), f"`{name}`", f"{seconds:.1f}", f"{peak:.0f}"])
    store_rows(DOCUMENT, rows, ABOUT)


if __name__ == "__main__":
    main()
