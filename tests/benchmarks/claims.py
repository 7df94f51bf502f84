"""What neusee claims of its speed, each beside the peers that do the same work; `all.py` runs them.

Each function yields comparisons. One thread each, and processor time, so that other work on the
machine changes little. Errors are against references in double precision that share no code with
either.
"""

import os
import shutil
import sys
import tempfile
from collections.abc import Iterator
from functools import partial
from pathlib import Path

import bench_peers
import bench_psf
import bench_scan
import bench_sweep
from bench_engine import chain, new_run, wide
from paired_times import OURS, Comparison, Figures, compared, process

_ACCURATE = 2e-6  #: largest error, of the peak, of a peer of the PSF
_PROGRAM = [sys.executable, "-m", "neusee"]


def point_spread(turns: int) -> Iterator[Comparison]:
    """Yield the PSF from a height map, beside transforms whose error is at most 2e-6 of the
    peak.
    """
    for samples, window in ((2160, 2048), (2160, 512), (1024, 1024), (256, 256), (2160, 64)):
        lens = bench_psf.pupil(samples, 10.0)
        where, truth = bench_psf.subset(lens, window)
        made, calls = bench_psf.pupil_call(lens), bench_psf.contenders(samples, window, lens)
        calls.pop("neusee, ready pupil")
        errors = {name: bench_psf.error(call(), where, truth) for name, call in calls.items()}
        chosen = {
            name: call for name, call in calls.items() if name == OURS or errors[name] <= _ACCURATE
        }
        works = {
            name: call if name == OURS else partial(_both, made, call)
            for name, call in chosen.items()
        }
        remarks = {name: f"error {errors[name]:.0e}" for name in works}
        yield compared(
            f"PSF of {samples}² samples in {window}² pixels, height map and all",
            works,
            turns,
            remarks,
        )


def _both(first, second):
    first()
    second()


def bands(turns: int) -> Iterator[Comparison]:
    """Yield 31 PSFs of one height map, each program in a process of its own."""
    folder = str(Path(__file__).parent)
    works = {
        name: partial(process, [sys.executable, "bench_psf.py", "--bands", who], {}, folder)
        for name, who in ((OURS, "neusee"), ("hcipy ZoomFFT c64", "hcipy"))
    }
    yield compared(
        "31 PSFs of 2160² samples in 2048² pixels, start of the program and all",
        works,
        max(3, turns // 3),
    )


def scan(turns: int) -> Iterator[Comparison]:
    """Yield the selective scan, forward and backward."""
    values = bench_scan.draw(4096)
    truth = bench_scan.reference(*(x.detach() for x in values))
    scans = {
        OURS if name == "neusee, C++" else name: call for name, call in bench_scan.SCANS.items()
    }
    remarks = {}
    for name, call in scans.items():
        error = float((call(*values).detach() - truth).abs().max() / truth.abs().max())
        remarks[name] = f"error {error:.0e}"
    works = {name: partial(bench_scan.once, call, values) for name, call in scans.items()}
    yield compared(
        "selective scan of 4096 steps, 96 channels, 16 states, forward and backward",
        works,
        turns,
        remarks,
    )


def cached_steps(turns: int) -> Iterator[Comparison]:
    """Yield 1000 trivial steps, computed and from the cache, beside joblib.Memory and Hamilton."""
    sys.setrecursionlimit(30_000)  # Hamilton fails on the chain without it
    with tempfile.TemporaryDirectory() as place:
        sys.path.insert(0, place)
        for name, ours, joblib, graph in (
            ("a chain", chain(1000), bench_peers.joblib_chain, bench_peers.small_chain),
            ("side by side", wide(1000), bench_peers.joblib_wide, bench_peers.small_wide),
        ):
            folder = Path(place) / name.replace(" ", "_")
            peer = graph(1000, Path(place))
            for state in ("computed", "cached"):
                new = _NewFolder(folder) if state == "computed" else None
                works = {
                    OURS: partial(_in, new, folder / "ours", partial(new_run, ours)),
                    "joblib": partial(_in, new, folder / "joblib", partial(joblib, 1000)),
                    "Hamilton": partial(_in, new, folder / "hamilton", partial(_hamilton, peer)),
                }
                yield compared(f"1000 trivial steps, {name}: {state}", works, turns)
        sys.path.remove(place)


class _NewFolder:
    """Makes the folder of an engine empty before each of its turns."""

    def __init__(self, root: Path) -> None:
        self.root = root

    def empty(self, folder: Path) -> None:
        shutil.rmtree(folder, ignore_errors=True)


def _in(new, folder, work):
    if new is not None:
        new.empty(folder)
    work(folder)


def _hamilton(graph, folder):
    bench_peers.hamilton(graph, folder)()


def large_values(turns: int) -> Iterator[Comparison]:
    """Yield a cached chain of nine arrays of 111 MB, beside joblib and Hamilton, which read them
    all.
    """
    with tempfile.TemporaryDirectory() as place:
        sys.path.insert(0, place)
        folder, count = Path(place), bench_peers.COUNT
        graph = bench_peers.large_chain(9, folder)
        works = {
            OURS: partial(new_run, chain(9, count), folder / "ours"),
            "joblib": partial(bench_peers.joblib_chain, 9, folder / "joblib", count),
            "Hamilton": partial(_hamilton, graph, folder / "hamilton"),
        }
        yield compared("10 steps with 1 GB of results, cached", works, max(3, turns // 3))
        sys.path.remove(place)


def repeated_commands(turns: int) -> Iterator[Comparison]:
    """Yield cached commands as whole processes, beside a bare `import torch`."""
    with tempfile.TemporaryDirectory() as place:
        cache = {"NEUSEE_CACHE": f"{place}/cache"}
        torch_alone = partial(process, [sys.executable, "-c", "import torch"], {}, place)
        for words in (
            ["run", "first_light", "--quiet"],
            ["plan", "first_light"],
            ["validate", "first_light"],
        ):
            ours = partial(process, [*_PROGRAM, *words], cache, place)
            ours()  # computed
            ours()  # the answer is kept
            what = f"`neusee {' '.join(words)}`, again"
            yield compared(what, {OURS: ours, "`import torch` alone": torch_alone}, turns)


def long_sweeps(turns: int) -> Iterator[Figures]:
    """Yield the overhead of a point of a sweep of 1000 points, in milliseconds of the processor
    beside its nodes.
    """
    points, load = 100 * turns, os.getloadavg()[0]
    rows = []
    for which, what in bench_sweep.RECIPES.items():
        found = bench_sweep.overhead(which, points)
        rows.append([what, *(f"{each:.1f}" for each in (found.point, found.plan, *found.run))])
    fifths = [f"fifth {n}" for n in range(1, 1 + bench_sweep.FIFTHS)]
    yield Figures(f"{points} points, ms a point", ["in all", "planning", *fifths], rows, load)


def workers(turns: int) -> Iterator[Comparison]:
    """Yield two worker processes beside one, by the clock: 64 draws of a study, and a sweep of
    32 points.
    """
    with bench_sweep.draws() as draw, bench_sweep.sweep_of(32) as sweep:
        for what, work in (
            ("64 draws of an uncertainty study", draw),
            ("32 points of a sweep", sweep),
        ):
            works = {OURS: partial(work, 2), "one worker": partial(work, 1)}
            yield compared(
                f"{what}, two workers, by the clock", works, max(3, turns // 3), by_clock=True
            )


CLAIMS = {
    "point_spread": point_spread,
    "bands": bands,
    "scan": scan,
    "cached_steps": cached_steps,
    "large_values": large_values,
    "repeated_commands": repeated_commands,
    "long_sweeps": long_sweeps,
    "workers": workers,
}
