"""The calibration study: tests of a posterior on simulated sensors, and sensitivity of the
posterior to the prior.
"""

from __future__ import annotations

from collections import Counter
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import asdict, dataclass
from functools import partial
from tempfile import TemporaryDirectory
from typing import Any

from neusee.workflows.calibration.identifiability import KINDS, identify, words_of
from neusee.workflows.calibration.log_posterior import SensorPosterior, find_mode, initial_theta
from neusee.workflows.engine.local_executor import one_thread
from neusee.workflows.graph.recipe_graph import Recipe
from neusee.workflows.keys.cache_key import digest
from neusee.workflows.report.study_report import (
    CsvTable,
    Marked,
    Progress,
    Section,
    StudyOutcome,
    StudyReport,
)
from neusee.workflows.store.result_store import Store
from neusee.workflows.studies.posterior_tests import (
    DRAWS,
    ENOUGH,
    RankTest,
    Sampler,
    Sensitivity,
    SensorSimulation,
    SensorSimulator,
    rank_tests,
    ranks,
    sensitivity,
    walk_draws,
)

PIXELS = 128
_SIMULATIONS_A_LINE = 20  #: number of simulations per line of progress
_WEIGHED = 1000  #: number of draws for the sensitivity
_COLUMNS = (
    "parameter",
    "simulations",
    "p",
    "least p",
    "coverage",
    "from",
    "to",
    "z mean",
    "z sd",
    "holds",
)


@dataclass(frozen=True)
class CalibrationStudyResult:
    """The result of the calibration study: simulations, tests of each parameter, and sensitivity to
    the prior.
    """

    simulations: Sequence[SensorSimulation]
    rank_tests: Sequence[RankTest]
    prior_widths: Mapping[str, float]
    sensitivity: Sensitivity | None
    no_sensitivity: str  #: why the sensitivity is unknown

    @property
    def refused(self) -> Sequence[str]:
        return [simulation.refused for simulation in self.simulations if simulation.refused]

    @property
    def short(self) -> int:
        """Return the number of simulations whose Markov chain is too short for its
        autocorrelation time.
        """
        return sum(
            not simulation.refused and not simulation.independent for simulation in self.simulations
        )

    @property
    def stranded(self) -> int:
        """Return the number of simulations in which a walker stays where the posterior is
        almost 0.
        """
        return sum(simulation.stranded > 0 for simulation in self.simulations)

    @property
    def failed(self) -> int:
        """Return the number of failed criteria: two for each parameter, and three for all
        simulations together.
        """
        return (
            sum(test.failed for test in self.rank_tests)
            + bool(self.refused)
            + bool(self.short)
            + bool(self.stranded)
        )


@dataclass(frozen=True)
class CalibrationOptions:
    """Which sensors are simulated, and how their posterior is sampled."""

    simulations: int = 200
    move: str = "de"  #: of the walkers
    pixels: int = PIXELS
    sampler: Sampler | None = None  #: sampler to use instead of the walkers


def study(
    recipe: Recipe, store: Store, progress: Progress, options: CalibrationOptions
) -> StudyOutcome:
    """Simulate and calibrate sensors."""
    with one_thread():
        sampler = options.sampler or partial(walk_draws, move_name=options.move)
        simulator = SensorSimulator(recipe, store, options.pixels, sampler, options.move)
        simulations_done = list(_simulate_all(simulator, options.simulations, progress))
        sensitivity_to_prior, reason = _sensitivity(recipe, options.move)
    result = CalibrationStudyResult(
        simulations_done,
        rank_tests(simulations_done),
        simulator.prior_widths(),
        sensitivity_to_prior,
        reason,
    )
    content = _document(result)
    return StudyOutcome(
        digest(content["verdicts"]), content, _report(recipe, result, options.pixels)
    )


def _simulate_all(
    simulator: SensorSimulator, count: int, progress: Progress
) -> Iterator[SensorSimulation]:
    """Yield each simulation, with a line of progress for some of them."""
    for number in range(count):
        simulation = simulator.simulation(number)
        if simulation.refused:
            progress(f"simulation {number}: {simulation.refused}")
        yield simulation
        if (number + 1) % _SIMULATIONS_A_LINE == 0 or number + 1 == count:
            progress(f"{number + 1} of {count} simulations")


def _sensitivity(recipe: Recipe, move: str) -> tuple[Sensitivity | None, str]:
    """Return the sensitivity of the recipe's posterior to the prior, or None and the reason why it
    is unknown.
    """
    with TemporaryDirectory(prefix="neusee-") as folder:
        problem = SensorPosterior.of(recipe, Store(folder))
    mode = find_mode(problem, initial_theta(problem))
    identified = identify(problem, mode)
    if identified.refused:
        return None, identified.refused
    sampled = walk_draws(problem, mode, recipe.seed, move, _WEIGHED)
    if not sampled.independent:
        return (
            None,
            f"the chain is too short for its autocorrelation time of {sampled.tau:.0f} steps",
        )
    return sensitivity(problem, sampled.samples, identified.kinds), ""


def _document(result: CalibrationStudyResult) -> dict[str, Any]:
    """Return the numbers of the study as JSON values."""
    return {
        "failed": result.failed,
        "simulations": len(result.simulations),
        "refused": list(result.refused),
        "verdicts": [asdict(test) for test in result.rank_tests],
        "widths": dict(result.prior_widths),
        "sensitivity": asdict(result.sensitivity) if result.sensitivity else result.no_sensitivity,
    }


# --- the page -------------------------------------------------------------------------------------


def _report(recipe: Recipe, result: CalibrationStudyResult, pixels: int) -> StudyReport:
    """Return the page of the study with its tables."""
    picture = ranks(result.rank_tests)
    sections = [
        _ranks(result, picture, pixels),
        _intervals(result),
        _weighed(result),
        *_refusals(result),
    ]
    tables: dict[str, CsvTable] = {
        "table.csv": (_COLUMNS, map(_line, result.rank_tests)),
        "simulations.csv": (("parameter", "truth", "rank", "inside", "z", "told"), _each(result)),
    }
    return StudyReport(
        f"{recipe.name}: is the posterior correct?",
        _lead(result),
        sections,
        {"ranks": picture},
        tables,
    )


def _line(v: RankTest) -> Sequence[Any]:
    return v.name, sum(v.counts), v.p, v.least_p, v.coverage, *v.bar, v.z_mean, v.z_sd, not v.failed


def _each(result: CalibrationStudyResult) -> Iterator[Sequence[Any]]:
    """Yield the rows of simulations.csv: one for each parameter of each simulation."""
    for simulation in result.simulations:
        for name in simulation.rank:
            yield (
                name,
                simulation.truth[name],
                simulation.rank[name],
                simulation.inside[name],
                simulation.z[name],
                simulation.kinds[name],
            )


def _lead(result: CalibrationStudyResult) -> str:
    """Return the summary of the study in a few sentences."""
    held_text = (
        "All criteria hold" if not result.failed else f"{result.failed} criteria do not hold"
    )
    seconds = sum(simulation.seconds for simulation in result.simulations) / len(result.simulations)
    longest_time = max((simulation.tau for simulation in result.simulations), default=0.0)
    chains = f"{result.short} a chain that is too short, {result.stranded} a stranded walker"
    return (
        f"{held_text}. Of {len(result.simulations)} simulations of {seconds:.2g} s each,"
        f" {len(result.refused)} have no posterior, {chains}. The longest autocorrelation time is"
        f" {longest_time:.0f} steps."
    )


def _ranks(result: CalibrationStudyResult, picture: bytes, pixels: int) -> Section:
    """Return the section on the ranks of the true parameters, with the widths of the priors."""
    text = f"""Parameters are drawn from the prior, the recipe's own steps simulate frames of
        {pixels} x {pixels} pixels with these parameters, and {DRAWS} nearly independent draws are
        made from the posterior of the frames. If the posterior is correct, the number of draws
        below the truth, its rank, is uniform. The grey band contains 99 of 100 bins of uniform
        ranks. If ranks are frequent at both ends, the posterior is too narrow; in the middle, too
        wide; at one end, biased.

        The prior is that of the recipe, but no wider than the standard deviations below (of the
        logarithm; in e- for the offset), so that frames of the recipe's levels constrain every
        sensor that is drawn. The search for the mode starts near the truth: this study tests the
        posterior and the draws, not the search. A walker is stranded if its median log posterior
        lies 20 nats below that of the others."""
    rows = [(words_of(name), width) for name, width in result.prior_widths.items()]
    return Section("Ranks of the truth", text, ("parameter", "width of the prior"), rows, picture)


def _intervals(result: CalibrationStudyResult) -> Section:
    """Return the section on p values, coverage and scatter of each parameter."""
    text = """p: the probability that uniform ranks in ten bins are at least as uneven as the ranks
        found; p must exceed 0.01 divided by the number of parameters. Coverage: how often the
        central 90 % of the draws contain the truth; a correct posterior is within the bar in 999 of
        1000 studies. z: posterior mean minus truth, in posterior standard deviations. For a normal
        posterior z has mean 0 and standard deviation 1; for a posterior cut off by a limit, only
        about. Told: in how many simulations the frames estimate the parameter, or only limit it."""
    columns = ("parameter", "p", "at least", "coverage", "bar", "z mean", "z sd", "told")
    rows = []
    for test in result.rank_tests:
        p_cell = Marked(test.p, "pass" if test.uniform else "fail")
        coverage_cell = Marked(test.coverage, "pass" if test.covered else "fail")
        limits_text = f"{test.bar[0]:.3f} to {test.bar[1]:.3f}"
        test_cells = (p_cell, test.least_p, coverage_cell, limits_text)
        rows.append(
            (
                words_of(test.name),
                *test_cells,
                test.z_mean,
                test.z_sd,
                _count_kinds(result, test.name),
            )
        )
    return Section("Coverage", text, columns, rows)


def _count_kinds(result: CalibrationStudyResult, name: str) -> str:
    """Return as text in how many simulations a parameter is estimated, or only limited."""
    simulations_by_kind = Counter(
        simulation.kinds[name] for simulation in result.simulations if not simulation.refused
    )
    return ", ".join(
        f"{number} {KINDS[kind] or 'estimated'}"
        for kind, number in simulations_by_kind.most_common()
    )


def _weighed(result: CalibrationStudyResult) -> Section:
    """Return the section on the sensitivity to the prior, or on the reason why it is unknown."""
    heading = "Sensitivity to the prior"
    if result.sensitivity is None:
        return Section(
            heading, f"The sensitivity to the prior is not known: {result.no_sensitivity}."
        )
    names, effective_fractions = list(result.sensitivity.left), result.sensitivity.left
    text = f"""Draws from the posterior of the recipe's own frames and prior, reweighted as if one
        prior were twice as wide. Value: the mean, or the 95 % limit of a parameter that the frames
        only limit. Under each prior: the change of the value, in posterior standard deviations.
        Last row: the effective sample size as a share of the draws. Below {ENOUGH:g} reweighting is
        unreliable, and the table has a dash: the prior of this parameter constrains the parameter
        at least about as much as the frames do."""
    columns = (
        "parameter",
        "from these frames",
        "value",
        "sd",
        *(f"{words_of(name)} x 2" for name in names),
    )
    rows: list[list[Any]] = []
    for finding in result.sensitivity.findings:
        # changes in standard deviations
        changes = [
            None if doubled_value is None else (doubled_value - finding.value) / finding.sd
            for doubled_value in finding.doubled.values()
        ]
        rows.append(
            [
                words_of(finding.name),
                KINDS[finding.kind] or "estimate",
                finding.value,
                finding.sd,
                *changes,
            ]
        )
    shares = [
        Marked(share, "warn" if share < ENOUGH else None) for share in effective_fractions.values()
    ]
    rows.append(["draws left", "", None, None, *shares])
    return Section(heading, text, columns, rows)


def _refusals(result: CalibrationStudyResult) -> list[Section]:
    """Return the section on simulations without a posterior and the reasons; empty if all
    have one.
    """
    if not result.refused:
        return []
    rows = Counter(result.refused).most_common()
    return [
        Section(
            "Simulations without a posterior",
            "They are left out of the ranks.",
            ("why", "count"),
            rows,
        )
    ]
