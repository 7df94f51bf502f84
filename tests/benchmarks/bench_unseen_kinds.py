"""Try kinds of own nodes that read what no key has: is one served stale without a word? Are honest
ones still cached?

    python tests/benchmarks/bench_unseen_kinds.py --results FILE [NAME ...] [--again] [--root
    CHECKOUT] [--list]

Each case of the folder `unseen_kinds` runs in a folder and a cache of its own: `neusee run`, a
change of what the node reads, `neusee run` again, and, where the second run took a result from the
cache, once more with an empty cache, which is the truth. Names, or parts of names, choose cases.
FILE has one line of JSON for each case and grows as cases end, so that the next call goes on;
`--again` tries those again that were bad.

| verdict | meaning |
|---|---|
| right | the second run gives the truth, and no word was said |
| told | the node was refused, or the run warned, and nothing was served stale |
| stale | the second run gives another value than the truth |
| kept | an honest node: the second run took it from the cache |
| refused, unsaved | an honest node that is refused, or computed again |
| unreached | the change does not reach the step, so that it changes no truth: the step has neither
  variables of the environment that no key has, nor what other steps leave in the process |
| no case | the node fails: mend the case |
| skipped | this machine lacks what the case needs |
"""

from __future__ import annotations

import argparse
import importlib
import json
import os
import pkgutil
import shutil
import subprocess
import sys
import tempfile
from collections import Counter
from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path

import numpy as np
import unseen_kinds
from safetensors.numpy import load_file
from unseen_kinds.case import Case, now

VERDICTS = (
    "right",
    "told",
    "unreached",
    "stale",
    "kept",
    "refused",
    "unsaved",
    "no case",
    "skipped",
)
BAD = ("stale", "refused", "unsaved", "no case")
#: in each of its own warnings, and in none of a library
OF_NEUSEE = ("cache key", "not stored", "no other step")
_ROOT = Path(__file__).parents[2]
_PLAIN = ("PATH", "HOME", "XDG_CACHE_HOME", "VIRTUAL_ENV", "LANG", "LC_ALL", "USER", "TMPDIR")
_SHOWN = 400  #: of an output, this many numbers are compared and written down
_PATIENCE = 900  #: s that one run may take on a machine that is busy with other work


@dataclass(frozen=True)
class Place:
    """Where a case runs, and with which checkout of neusee."""

    root: Path
    folder: Path


@dataclass(frozen=True)
class Run:
    """What one run of the program did."""

    code: int
    values: dict[str, list[float]]
    states: dict[str, str]
    words: str


def cases() -> Iterator[tuple[str, Case]]:
    """Yield each case with its full name, `family.name`."""
    for module in sorted(pkgutil.iter_modules(unseen_kinds.__path__), key=lambda found: found.name):
        if module.name != "case":
            family = importlib.import_module(f"unseen_kinds.{module.name}")
            for case in family.CASES:
                yield f"{module.name}.{case.name}", case


def filled(text: str, folder: Path) -> str:
    """Return a text with its places filled in."""
    places = {"{folder}": str(folder), "{prefix}": sys.prefix, "{tmp}": tempfile.gettempdir()}
    for name, place in places.items():
        text = text.replace(name, place)
    return text


def arrange(case: Case, folder: Path, turn: int) -> None:
    """Write the files of a turn; one that is None goes."""
    texts = {**case.files, "own.py": case.own(), "r.yaml": case.recipe(turn)}
    for name, change in texts.items():
        text, path = now(change, turn), folder / filled(name, folder)
        if text is None:
            path.unlink(missing_ok=True)
            continue
        path.parent.mkdir(parents=True, exist_ok=True)
        data = text if isinstance(text, bytes) else filled(text, folder).encode()
        if not path.exists() or path.read_bytes() != data:
            path.write_bytes(data)
    if case.make is not None:
        case.make(folder, turn)


def leave(case: Case, folder: Path) -> None:
    """Remove the files of a case that lie outside of its folder."""
    for name in case.files:
        path = Path(filled(name, folder))
        if path.is_absolute() and not path.is_relative_to(folder):
            path.unlink(missing_ok=True)


def environment(case: Case, place: Place, turn: int, cache: Path) -> dict[str, str]:
    """Return the variables of a run."""
    env = {name: os.environ[name] for name in _PLAIN if name in os.environ}
    env |= {
        "NEUSEE_CACHE": str(cache),
        "PYTHONPATH": str(place.root / ".src"),
        "OMP_NUM_THREADS": "1",
    }
    for name, change in case.env.items():
        value = now(change, turn)
        if value is None:
            env.pop(name, None)
        elif name == "PYTHONPATH":
            env[name] += os.pathsep + filled(value, place.folder)
        else:
            env[name] = filled(value, place.folder)
    return env


def call(case: Case, place: Place, turn: int, cache: Path) -> Run:
    """Run the program once in a new process."""
    out = cache.with_suffix(f".{turn}")
    command = filled(now(case.prefix, turn), place.folder).split()
    command += [
        sys.executable,
        "-P",
        "-m",
        "neusee",
        "run",
        str(place.folder / "r.yaml"),
        "--json",
        "--out",
        str(out),
    ]
    ended = subprocess.run(
        command,
        env=environment(case, place, turn, cache),
        cwd=filled(now(case.folder, turn), place.folder),
        input=now(case.stdin, turn),
        capture_output=True,
        text=True,
        timeout=_PATIENCE,
    )
    if ended.returncode:
        return Run(ended.returncode, {}, {}, ended.stderr.strip() or ended.stdout.strip())
    report = json.loads(ended.stdout)
    numbers = load_file(
        place.folder / Path(report["report"]).parent / "data" / "outputs.safetensors"
    )
    values = {
        name: np.asarray(value, float).ravel()[:_SHOWN].tolist() for name, value in numbers.items()
    }
    states = {step["step"]: step["state"] for step in report["steps"]}
    return Run(0, values, states, "\n".join([*report["warnings"], ended.stderr.strip()]).strip())


def same(one: Run, other: Run, watched: str) -> bool:
    """Return whether an output of two runs has the same bits."""
    return repr(one.values[watched]) == repr(other.values[watched])


def judged(case: Case, place: Place) -> dict[str, object]:
    """Return the verdict on a case, and what led to it."""
    cache = place.folder.with_name(place.folder.name + ".cache")
    runs = []
    for turn in (1, 2):
        arrange(case, place.folder, turn)
        runs.append(call(case, place, turn, cache))
        if runs[-1].code:
            return {"verdict": _of_failure(case, runs[-1]), "words": runs[-1].words, "turn": turn}
    first, second = runs
    words = "\n".join(dict.fromkeys([first.words, second.words])).strip()
    if case.honest:
        cached = set(second.states.values()) <= {"cached", "not needed"}
        warned = any(each in words for each in OF_NEUSEE)
        return {
            "verdict": "kept" if cached and not warned else "unsaved",
            "words": words,
            "states": second.states,
        }
    truth = second
    if set(second.states.values()) != {"run"}:
        truth = call(case, place, 2, cache.with_suffix(".empty"))
        if truth.code:
            return {"verdict": "no case", "words": truth.words, "turn": 3}
    values = {"first": first.values, "second": second.values, "truth": truth.values}
    if same(first, truth, case.watched):
        verdict = "unreached" if same(first, second, case.watched) else "stale"
    elif not same(second, truth, case.watched):
        verdict = "stale"
    else:
        verdict = "told" if words else "right"
    return {"verdict": verdict, "words": words, "states": second.states} | values


def _of_failure(case: Case, run: Run) -> str:
    """Return the verdict on a run that ended with an error."""
    if run.code != 2 or "nothing was run" in run.words:
        return "no case"
    return "refused" if case.honest else "told"


def tried(name: str, case: Case, root: Path, scratch: Path) -> dict[str, object]:
    """Run one case in a new folder."""
    folder = scratch / name
    for old in scratch.glob(name + "*"):
        shutil.rmtree(old)
    folder.mkdir(parents=True)
    try:
        found = judged(case, Place(root, folder))
    except (PermissionError, FileNotFoundError) as error:
        found = {"verdict": "skipped", "words": str(error)}
    except (subprocess.TimeoutExpired, ImportError) as error:
        found = {"verdict": "no case", "words": str(error)}
    finally:
        leave(case, folder)
    return {"name": name, "about": case.about} | found


def results(path: Path) -> dict[str, dict[str, object]]:
    """Return the newest line of each case."""
    if not path.exists():
        return {}
    lines = [json.loads(line) for line in path.read_text().splitlines()]
    return {line["name"]: line for line in lines}


def table(found: dict[str, dict[str, object]]) -> str:
    """Return how often each verdict was reached in each family, and the bad cases with what was
    said.
    """
    counts = Counter((name.partition(".")[0], str(line["verdict"])) for name, line in found.items())
    verdicts = [each for each in VERDICTS if any(verdict == each for _, verdict in counts)]
    lines = [f"| family | {' | '.join(verdicts)} |", f"|---{'|---' * len(verdicts)}|"]
    for family in sorted({family for family, _ in counts}):
        lines.append(
            f"| {family} | {' | '.join(str(counts[family, each] or '') for each in verdicts)} |"
        )
    sums = [
        sum(count for (_, verdict), count in counts.items() if verdict == each) for each in verdicts
    ]
    lines.append(f"| all {sum(sums)} | {' | '.join(map(str, sums))} |")
    for name, line in found.items():
        if line["verdict"] in BAD:
            words = str(line.get("words", "")).replace("\n", " ")[-300:]
            lines.append(f"\n{line['verdict']}: {name}: {line['about']}\n  {words}")
    return "\n".join(lines)


def selected(every: dict[str, Case], words: list[str]) -> dict[str, Case]:
    """Return the cases that a name, or a part of a name, chooses; all if there is none."""
    exact = set(words) & set(every)
    parts = set(words) - exact
    return {
        n: case
        for n, case in every.items()
        if not words or n in exact or any(part in n for part in parts)
    }


def main() -> None:
    """Try the cases that are chosen, and print what was found."""
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("names", nargs="*", help="parts of names of cases; all if none")
    parser.add_argument("--results", type=Path, help="file of JSON lines that grows")
    parser.add_argument("--again", action="store_true", help="try the bad ones of the file again")
    parser.add_argument("--root", type=Path, default=_ROOT, help="checkout of neusee that is tried")
    parser.add_argument("--list", action="store_true", help="print the names, and end")
    parser.add_argument(
        "--scratch", type=Path, default=Path.home(), help="where the folders of the cases are made"
    )
    words = parser.parse_args()
    chosen = selected(dict(cases()), words.names)
    if words.list:
        print("\n".join(chosen))
        return
    path = (words.results or Path(tempfile.mkdtemp()) / "results.jsonl").absolute()
    found = results(path)
    with tempfile.TemporaryDirectory(prefix="unseen_kinds_", dir=words.scratch) as scratch:
        for name, case in chosen.items():
            if name not in found or (words.again and found[name]["verdict"] in BAD):
                found[name] = tried(name, case, words.root.absolute(), Path(scratch))
                with path.open("a") as file:
                    file.write(json.dumps(found[name]) + "\n")
                print(f"{found[name]['verdict']:8} {name}", flush=True)
    print(table({name: found[name] for name in chosen}))


if __name__ == "__main__":
    main()
