"""The study of a calibration: whether its posterior is right, and what of it is the prior's."""

from __future__ import annotations

import json
import time
from collections import Counter
from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import asdict, dataclass
from functools import partial
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import Any

from neusee.workflows.calibration.identifiability import KINDS, known
from neusee.workflows.calibration.initial_guess import begin
from neusee.workflows.calibration.log_posterior import SensorPosterior
from neusee.workflows.calibration.posterior_mode import peak
from neusee.workflows.engine.provenance import timestamp, versions
from neusee.workflows.engine.threads import one_thread
from neusee.workflows.graph.recipe_graph import Recipe
from neusee.workflows.keys.cache_key import digest
from neusee.workflows.report.run_folder import RunFolder, new_run
from neusee.workflows.report.study_page import Mark, Section, page
from neusee.workflows.store.result_store import Store
from neusee.workflows.studies.calibration.independent_draws import DRAWS, walked
from neusee.workflows.studies.calibration.prior_sensitivity import ENOUGH, Finding, Sensitivity, sensitivity
from neusee.workflows.studies.calibration.rank_uniformity import Verdict, verdicts
from neusee.workflows.studies.calibration.simulated_sensors import Bench, Sampler, Simulation, widths

Tell = Callable[[str], None]
PIXELS = 128
_EVERY = 20  #: simulations by line
_WEIGHED = 1000  #: draws for the sensitivity
_COLUMNS = ("parameter", "simulations", "p", "least p", "coverage", "from", "to", "z mean", "z sd", "holds")


@dataclass(frozen=True)
class Found:
    """All that the study measured."""

    simulations: Sequence[Simulation]
    verdicts: Sequence[Verdict]
    widths: Mapping[str, float]
    sensitivity: Sensitivity | None
    untold: str  #: why there is no sensitivity

    @property
    def refused(self) -> Sequence[str]:
        return [s.refused for s in self.simulations if s.refused]

    @property
    def short(self) -> int:
        """Simulations whose chain was given up before it was long enough."""
        return sum(not s.refused and not s.independent for s in self.simulations)

    @property
    def stranded(self) -> int:
        """Simulations with walkers that stay where the posterior is none."""
        return sum(s.stranded > 0 for s in self.simulations)

    @property
    def failed(self) -> int:
        """Bars that do not hold; that all simulations have a posterior, long chains and no lost walker are three."""
        return sum(v.failed for v in self.verdicts) + bool(self.refused) + bool(self.short) + bool(self.stranded)


def study(
    recipe: Recipe,
    store: Store,
    runs: Path,
    command: Sequence[str],
    tell: Tell,
    simulations: int = 200,
    move: str = "de",
    pixels: int = PIXELS,
    sampler: Sampler | None = None,
) -> Path:
    """Simulate, fit and rank so many times; ``sampler`` in place of walkers that move by ``move``."""
    began = time.perf_counter()
    with one_thread():
        bench = Bench(recipe, store, pixels, sampler or partial(walked, how=move), move)
        made = list(_simulated(bench, simulations, tell))
        weighed, untold = _sensitivity(recipe, move)
    found = Found(made, verdicts(made), widths(bench.nominal.coordinates.prior), weighed, untold)
    doc = _document(recipe, command, found, time.perf_counter() - began)
    with new_run(runs, f"{recipe.name}_calibration", digest(doc["verdicts"])) as folder:
        _write(folder, recipe, found, doc, pixels)
    return folder.path


def _simulated(bench: Bench, count: int, tell: Tell) -> Iterator[Simulation]:
    for number in range(count):
        found = bench.simulation(number)
        if found.refused:
            tell(f"simulation {number}: {found.refused}")
        yield found
        if (number + 1) % _EVERY == 0 or number + 1 == count:
            tell(f"{number + 1} of {count} simulations")


def _sensitivity(recipe: Recipe, move: str) -> tuple[Sensitivity | None, str]:
    """Of the recipe as it is, with all its pixels and with its own prior."""
    with TemporaryDirectory(prefix="neusee-") as folder:
        problem = SensorPosterior.of(recipe, Store(folder))
    highest = peak(problem, begin(problem))
    told = known(problem, highest)
    if told.refused:
        return None, told.refused
    drawn = walked(problem, highest, recipe.seed, move, _WEIGHED)
    if not drawn.independent:
        return None, f"its chain is too short for its autocorrelation time of {drawn.tau:.0f} steps"
    return sensitivity(problem, drawn.places, told.kinds), ""


def _document(recipe: Recipe, command: Sequence[str], found: Found, seconds: float) -> dict[str, Any]:
    return {
        "study": "calibration",
        "recipe": recipe.name,
        "command": " ".join(command),
        "date": timestamp(),
        "seconds": seconds,
        "failed": found.failed,
        "simulations": len(found.simulations),
        "refused": list(found.refused),
        "verdicts": [asdict(v) for v in found.verdicts],
        "widths": dict(found.widths),
        "sensitivity": asdict(found.sensitivity) if found.sensitivity else found.untold,
        "versions": versions(),
        "config": recipe.config.to_yaml(),
    }


# --- the page ---------------------------------------------------------------------------------------------------------


def _write(folder: RunFolder, recipe: Recipe, found: Found, doc: Mapping[str, Any], pixels: int) -> None:
    from neusee.workflows.studies.calibration.rank_figures import ranks

    picture = ranks(found.verdicts)
    folder.write("figures/ranks.png", picture)
    folder.write_rows("table.csv", _COLUMNS, map(_line, found.verdicts))
    folder.write_rows("simulations.csv", ("parameter", "truth", "rank", "inside", "z", "told"), _each(found))
    folder.write("provenance.json", json.dumps(doc, indent=1, ensure_ascii=False))
    sections = [_ranks(found, picture, pixels), _intervals(found), _weighed(found), *_refusals(found)]
    told = {name: doc[name] for name in ("command", "date", "seconds", "versions")}
    folder.write("report.html", page(f"{recipe.name}: is the posterior right?", _lead(found), sections, told))


def _line(v: Verdict) -> Sequence[Any]:
    return v.name, sum(v.counts), v.p, v.least_p, v.coverage, *v.bar, v.z_mean, v.z_sd, not v.failed


def _each(found: Found) -> Iterator[Sequence[Any]]:
    for s in found.simulations:
        for name in s.rank:
            yield name, s.truth[name], s.rank[name], s.inside[name], s.z[name], s.kinds[name]


def _lead(found: Found) -> str:
    held = "All bars hold" if not found.failed else f"{found.failed} bars do not hold"
    seconds = sum(s.seconds for s in found.simulations) / len(found.simulations)
    taus = max((s.tau for s in found.simulations), default=0.0)
    short = f"{found.short} a chain that is too short, {found.stranded} a walker that is lost"
    return (
        f"{held}, of {len(found.simulations)} simulations of {seconds:.2g} s each: {len(found.refused)} have no "
        f"posterior, {short}. The longest autocorrelation time is {taus:.0f} steps."
    )


def _ranks(found: Found, picture: bytes, pixels: int) -> Section:
    text = f"""Parameters are drawn from the prior, frames of {pixels} x {pixels} pixels are taken with them by the
        recipe's own steps, and {DRAWS} nearly independent draws are made from the posterior of these frames. Where
        simulation and posterior are of one law, and the draws from it, the number of draws below the truth is uniform.
        Grey: what 99 of 100 bins keep to by chance. Heaped at both ends, the posterior is too narrow; in the middle,
        too wide; at one end, beside the truth.

        The prior is that of the recipe, but no wider than the standard deviations below (of the logarithm; of the
        offset in e-), so that frames of the recipe's levels tell something of every sensor that is drawn. The search
        for the peak starts near the truth: this study judges the posterior and the draws, not that search. A walker
        is lost whose median log posterior lies 20 nats under that of the others."""
    rows = [(_plain(name), width) for name, width in found.widths.items()]
    return Section("Ranks of the truth", text, ("parameter", "width of the prior"), rows, picture)


def _intervals(found: Found) -> Section:
    text = """p: of ranks as uneven as these or more, in ten bins, were they uniform; the least is 0.01 by the number of
        parameters. Coverage: how often the central 90 % of the draws hold the truth; a right posterior keeps to
        the bar in 999 of 1000 studies. z: posterior mean less truth, in posterior standard deviations; of a normal
        posterior mean 0 and standard deviation 1, of one that a limit cuts off not quite. Told: what the frames of how
        many simulations tell of the parameter."""
    columns = ("parameter", "p", "at least", "coverage", "bar", "z mean", "z sd", "told")
    rows, marks = [], dict[tuple[int, int], Mark]()
    for i, v in enumerate(found.verdicts):
        bar = f"{v.bar[0]:.3f} to {v.bar[1]:.3f}"
        rows.append((_plain(v.name), v.p, v.least_p, v.coverage, bar, v.z_mean, v.z_sd, _told(found, v.name)))
        marks[i, 1] = "pass" if v.uniform else "fail"
        marks[i, 3] = "pass" if v.covered else "fail"
    return Section("Coverage", text, columns, rows, marks=marks)


def _told(found: Found, name: str) -> str:
    count = Counter(s.kinds[name] for s in found.simulations if not s.refused)
    return ", ".join(f"{n} {KINDS[kind] or 'estimated'}" for kind, n in count.most_common())


def _weighed(found: Found) -> Section:
    heading = "What the prior does"
    if found.sensitivity is None:
        return Section(heading, f"Nothing can be said of the recipe's own frames: {found.untold}.")
    names = [f.name for f in found.sensitivity.findings]
    text = f"""Draws from the posterior of the recipe's own frames and prior, weighed as if one prior had been twice as
        wide. Value: the mean, of what is only limited the limit of 95 %. Under each prior: how far the value moves, in
        posterior standard deviations. Last row: the share of the draws that weighing leaves as independent ones;
        below {ENOUGH:g} it cannot tell, and there is a dash: the prior of that parameter says about as much as the
        frames, or more."""
    columns = ("parameter", "from these frames", "value", "sd", *(f"{_plain(name)} x 2" for name in names))
    rows = [_finding(f) for f in found.sensitivity.findings]
    left: list[Any] = ["draws left", "", None, None, *(found.sensitivity.left[name] for name in names)]
    marks: dict[tuple[int, int], Mark] = {
        (len(rows), 4 + i): "warn" for i, name in enumerate(names) if found.sensitivity.left[name] < ENOUGH
    }
    return Section(heading, text, columns, [*rows, left], marks=marks)


def _finding(f: Finding) -> list[Any]:
    moved = [None if x is None else (x - f.value) / f.sd for x in f.doubled.values()]
    return [_plain(f.name), KINDS[f.kind] or "estimate", f.value, f.sd, *moved]


def _refusals(found: Found) -> list[Section]:
    if not found.refused:
        return []
    rows = [(text, count) for text, count in Counter(found.refused).most_common()]
    return [Section("Simulations without a posterior", "They are left out of the ranks.", ("why", "count"), rows)]


def _plain(name: str) -> str:
    return name.replace("_", " ")
