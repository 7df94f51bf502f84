"""The claims of speed, each beside its peers in one run: `python tests/benchmarks/all.py [NAME ...]
[--turns 10]`.

Writes the page `recipes/guide/benchmarks.md` of the handbook, and stores the same tables for `RESULTS.md`.
With names, such as `scan`, only these claims are measured again, and the other parts stay; `--page`
measures none, and writes both files from the page. One thread; processor seconds, so that other
work on the machine changes little; the load is recorded.
"""

import argparse
import os

os.environ.update(
    {name: "1" for name in ("OMP_NUM_THREADS", "OPENBLAS_NUM_THREADS", "MKL_NUM_THREADS")}
)

import platform
import re
import statistics
import warnings
from collections.abc import Iterable, Mapping
from datetime import date
from importlib.metadata import version
from pathlib import Path

import torch
from claims import CLAIMS
from paired_times import OURS, Comparison, Figures
from stored_results import store, stored, tables_of

PAGE = Path(__file__).parents[2] / "recipes" / "guide" / "benchmarks.md"
DOCUMENT = "claims"  #: in `results/`
ABOUT = """# Speed beside peers

Each table is one claim. neusee and its peers do the same work in turns, in one run of
`python tests/benchmarks/all.py`, with one thread each. The seconds are those of the processor (the median of all
turns), because other work on the machine changes them little. The ratio is the peer's seconds over those of neusee in
the same turn: its median and, in brackets, the interval of the sign test that holds this median with a probability of
95 % (of fewer than six turns: the least and the largest). A ratio above 1 means that neusee is faster. Where a result
has an error, it is that from a reference in double precision. A table without peers has the milliseconds of neusee.

Peers: {peers}.
"""
_PEERS = (
    "joblib",
    "apache-hamilton",
    "hcipy",
    "prysm",
    "scipy",
    "finufft",
    "poppy",
    "mambapy",
    "torch",
)
_SECTION = re.compile(r"<!-- claim (\w+) -->\n(.*?)<!-- end -->\n", re.S)


def table(found: Comparison | Figures) -> str:
    """Return one claim as a table in Markdown."""
    if isinstance(found, Figures):
        head = [
            f"| {found.what} | {' | '.join(found.columns)} |",
            f"|---{'|---' * len(found.columns)}|",
        ]
        return "\n".join([*head, *(f"| {' | '.join(row)} |" for row in found.rows)]) + _load(found)
    ours, turns = found.seconds[OURS], len(found.seconds[OURS])
    remarks = any(found.remarks.values())
    last = (" |", "---|") if remarks else ("", "")
    lines = [
        f"| {found.what} | ms | ratio |{' error' + last[0] if remarks else ''}",
        f"|---|---|---|{last[1]}",
    ]
    note = f" {found.remarks.get(OURS, '').removeprefix('error ')} |" if remarks else ""
    lines.append(f"| neusee | {1e3 * statistics.median(ours):.4g} | |{note}")
    for peer in found.peers():
        middle, low, high = found.ratio(peer)
        note = f" {found.remarks.get(peer, '').removeprefix('error ')} |" if remarks else ""
        milliseconds = 1e3 * statistics.median(found.seconds[peer])
        lines.append(
            f"| {peer} | {milliseconds:.4g} | {middle:.2f} ({low:.2f} to {high:.2f}) |{note}"
        )
    return "\n".join(lines) + _load(found, f"{turns} turns; ")


def _load(found: Comparison | Figures, turns: str = "") -> str:
    text = f"{turns}load of the machine {found.load:.1f}."
    return f"\n\n{text[0].upper()}{text[1:]}\n\n"


def section(name: str, found: Iterable[Comparison | Figures]) -> str:
    """Return the part of the page that one claim fills."""
    where = (
        f"{platform.processor() or platform.machine()}, {os.cpu_count()} cores, torch"
        f" {torch.__version__}"
    )
    head = f"Measured on {date.today().isoformat()}; {where}.\n\n"
    return f"<!-- claim {name} -->\n{head}{''.join(map(table, found))}<!-- end -->\n"


def main() -> None:
    """Measure the claims that are named, and write them in the page."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("names", nargs="*", choices=[*CLAIMS, []])
    parser.add_argument("--turns", type=int, default=10)
    parser.add_argument(
        "--page", action="store_true", help="Measure nothing, and write both files from the page."
    )
    args = parser.parse_args()
    if args.page:
        return write({})
    warnings.simplefilter("ignore")
    torch.set_num_threads(1)
    for name in args.names or CLAIMS:
        print(name, flush=True)
        write({name: section(name, CLAIMS[name](args.turns))})
    return None


def write(new: Mapping[str, str]) -> None:
    """Write the parts ``new`` of the page anew and keep the others, and store the tables of all
    parts.
    """
    old = PAGE.read_text(encoding="utf-8") if PAGE.exists() else ""
    parts = {found[1]: found[0] for found in _SECTION.finditer(old)} | new
    peers = ", ".join(f"{peer} {version(peer)}" for peer in _PEERS)
    body = "".join(f"\n## {heading(name)}\n\n{parts[name]}" for name in CLAIMS if name in parts)
    PAGE.write_text(ABOUT.format(peers=peers) + body, encoding="utf-8")
    document = stored(DOCUMENT)
    document["tables"] = []
    for name in CLAIMS:
        document["tables"] += tables_of(parts.get(name, ""), heading(name))
    store(DOCUMENT, document)


def heading(name: str) -> str:
    """Return the first sentence of the docstring of a claim, without its verb."""
    first = (CLAIMS[name].__doc__ or name).strip().splitlines()[0]
    text = first.removeprefix("Yield ").rstrip(".")
    return text[0].upper() + text[1:]


if __name__ == "__main__":
    main()
