"""The uncertainty study: the scatter of a recipe's outputs caused by the uncertain values in the
recipe.
"""

from __future__ import annotations

import io
from collections.abc import Mapping, Sequence
from dataclasses import asdict, dataclass, replace
from typing import Any

import numpy as np

from neusee.workflows.graph.errors import RecipeError
from neusee.workflows.graph.recipe_graph import Recipe
from neusee.workflows.keys.cache_key import digest
from neusee.workflows.recipe.distributions.joint_distribution import Z_90
from neusee.workflows.recipe.distributions.nominal_values import standing_rows
from neusee.workflows.recipe.uncertain_inputs import (
    NEGLIGIBLE,
    SCRAMBLES,
    InputDraws,
    Inputs,
)
from neusee.workflows.report.study_report import Content, Progress, StudyOutcome, StudyReport
from neusee.workflows.store.result_store import Store
from neusee.workflows.studies.linear_page import (
    LinearResult,
    lead_of_linear,
    sections_of_linear,
    tornado_of_linear,
)
from neusee.workflows.studies.linear_propagation import (
    CHECKS,
    FAR,
    OutputRuns,
    propagate,
    without_distance,
)
from neusee.workflows.studies.output_draws import (
    AllowedDraws,
    FloatArray,
    Numbers,
    OutputDraws,
    Scatter,
    refuse_combinations,
    scatter,
    worst_known,
)
from neusee.workflows.studies.run_study import StudyRefused
from neusee.workflows.studies.sobol_indices import indices
from neusee.workflows.studies.uncertainty_page import (
    Rung,
    UncertaintyResult,
    draw_pictures,
    lead,
    sections,
)

LEAST = 64  #: draws before the first decision to stop
_ROUND = 16  #: independent draws in each further round
#: number of draws for the mean and standard deviation of pictures; it gives the deviation to 13 %
PICTURED = 32
_PICTURE_STATISTICS = ("mean", "sd")  #: statistics of each picture
_COLUMNS = ("quantity", "element", "at the medians", "mean", "sd", "5 %", "95 %")
_LINEAR_COLUMNS = ("quantity", "element", "at the medians", "mean", "sd", "bias", "error of sd")


@dataclass(frozen=True)
class UncertaintyOptions:
    """When the study ends, and how it samples."""

    error: float = 0.05  #: relative error of each standard deviation
    most: int = 1000  #: draws
    points: str = "draws"  #: or ``"sobol"``
    #: or ``"linear"``: linear propagation, and the draws only where its error is larger than
    #: ``error``
    method: str = "sampling"
    workers: int = 0  #: processes that draw on the CPU; 0 means one for each free processor
    device: str = "cpu"
    #: outputs or quantities whose standard deviations end the study; empty for all
    until: Sequence[str] = ()


def study(
    recipe: Recipe, store: Store, progress: Progress, options: UncertaintyOptions
) -> StudyOutcome:
    """Sample the inputs until the standard deviations of all outputs are known accurately
    enough.
    """
    inputs = _inputs(recipe)
    _chosen([name.partition(".")[0] for name in options.until], inputs.recipe.outputs)
    sequences = SCRAMBLES if options.points == "sobol" else 0
    points = _points(inputs, recipe.seed, options.most, options.points)
    allowed = AllowedDraws(inputs, points, sequences)
    allowed.extend(LEAST)
    refuse_combinations(inputs, _ends(inputs), allowed)
    draws = OutputDraws(inputs, store, options.device, options.workers)
    rule = StopRule(options.error, sequences, tuple(options.until))
    first_runs = _first_runs(draws, progress, rule)
    rungs = []
    if options.method == "linear":
        linear = _linear(draws, allowed, first_runs, rule)
        progress(linear.statement)
        if linear.holds:
            return _linear_outcome(linear, draws)
        rungs.append(linear.rung)
    result = _measure(draws, allowed, progress, rule, first_runs)
    result = replace(result, rungs=(*rungs, _rung_of_draws(result, draws)))
    content = _document(result, draws)
    return StudyOutcome(digest(content["quantities"]), content, _report(result))


@dataclass(frozen=True)
class StopRule:
    """The criterion for enough draws."""

    wanted: float  #: relative error of each standard deviation
    sequences: int  #: number of Sobol sequences; 0 for independent draws
    #: outputs or quantities whose standard deviations must be accurate; empty for all
    until: tuple[str, ...]

    @property
    def text(self) -> str:
        """Return in words which standard deviations must be accurate."""
        return (
            f"standard deviations of {', '.join(self.until)}"
            if self.until
            else "every standard deviation"
        )

    def needed(self, count: int, error: float, available: int) -> int:
        """Return an estimate of the number of draws needed, from the ``error`` after ``count``
        draws.
        """
        return (
            count
            if error <= self.wanted
            else min(available, int(count * (error / self.wanted) ** 2))
        )

    def following(self, count: int) -> int:
        """Return the number of draws of the next round after ``count`` draws."""
        # Sobol points are evenly spread only for a power of two
        return max(LEAST, 2 * count if self.sequences else count + _ROUND)


def _inputs(recipe: Recipe) -> Inputs:
    """Return the uncertain inputs of a recipe; raise `StudyRefused` if the recipe has none."""
    try:
        return Inputs.of(recipe, negligible=NEGLIGIBLE)
    except RecipeError:
        raise
    except ValueError as error:
        raise StudyRefused(str(error)) from error


def _points(inputs: Inputs, seed: int, limit: int, points: str) -> InputDraws:
    """Return at most ``limit`` draws of the inputs: independent draws or Sobol points.

    The number of Sobol points is `SCRAMBLES` times a power of two.
    """
    if points == "sobol":
        return inputs.sobol(SCRAMBLES * 2 ** int(np.log2(max(limit, LEAST) / SCRAMBLES)), seed)
    draws = limit if inputs.most_draws is None else min(limit, inputs.most_draws)
    return inputs.independent(draws, seed)


def _ends(inputs: Inputs) -> FloatArray:
    """Return the input values of the first runs: all at their medians, then each input alone at its
    5 % and its 95 % quantile.
    """
    return np.concatenate(
        [inputs.at(np.zeros((1, len(inputs.names)))), _one_at_a_time(inputs, Z_90)]
    )


def _one_at_a_time(inputs: Inputs, score: float) -> FloatArray:
    """Return input values with one input at a time at ``-score`` and ``+score``, and all others at
    their medians.
    """
    scores = []
    for direction in np.eye(len(inputs.names)):
        scores += [-score * direction, score * direction]
    return inputs.at(np.stack(scores))


def _chosen(until: Sequence[str], names: Sequence[str]) -> tuple[str, ...]:
    """Return the ``names`` selected by ``until``, or all if it is empty; raise `StudyRefused` for
    an entry that matches no name.
    """
    if not until:
        return tuple(names)
    deciding = dict[str, None]()
    for name in until:
        quantities_of_name = _means(name, names)
        if not quantities_of_name:
            raise StudyRefused(
                f"--until {name}: no output with numbers has this name; there are"
                f" {', '.join(names)}"
            )
        deciding |= dict.fromkeys(quantities_of_name)
    return tuple(name for name in names if name in deciding)


def _deciding(
    until: Sequence[str], varying: Sequence[str], constant: Sequence[str]
) -> tuple[str, ...]:
    """Return the numbers whose accuracy ends the study; raise `StudyRefused` for an output that
    depends on no input.
    """
    constants = [name for name in until if _means(name, constant) and not _means(name, varying)]
    if constants:
        raise StudyRefused(
            f"--until {constants[0]}: this output depends on no uncertain input, and does not vary"
        )
    return _chosen(until, varying)


def _means(name: str, quantities: Sequence[str]) -> list[str]:
    """Return the ``quantities`` that belong to an output ``name``, or the quantity of this name."""
    return [
        quantity
        for quantity in quantities
        if quantity == name or quantity.startswith((f"{name}.", f"{name}["))
    ]


@dataclass(frozen=True)
class _FirstRuns:
    """The numbers of the first runs, and those that decide when the study ends."""

    ends: list[Numbers]  #: all inputs at their medians, then each at its 5 % and its 95 % quantile
    deciding: tuple[str, ...]


def _first_runs(draws: OutputDraws, progress: Progress, rule: StopRule) -> _FirstRuns:
    """Report the inputs and what does not vary, and return the first runs."""
    inputs = draws.inputs
    _say_inputs(inputs, draws, rule.sequences, progress)
    end_runs = draws.numbers(_ends(inputs))
    if not end_runs[0]:
        raise StudyRefused(
            "the outputs are pictures only: add an output with numbers, such as restored_quality"
        )
    # run 0 has all inputs at their medians
    deciding = _deciding(rule.until, list(end_runs[0]), draws.is_constant)
    _say_constant(inputs, draws, end_runs, deciding, progress)
    return _FirstRuns(end_runs, deciding)


def _measure(
    draws: OutputDraws,
    allowed: AllowedDraws,
    progress: Progress,
    rule: StopRule,
    first_runs: _FirstRuns,
) -> UncertaintyResult:
    """Draw samples until the standard deviations in question are known accurately enough, and
    return the result.
    """
    inputs, deciding = draws.inputs, first_runs.deciding
    pictures = draws.pictures(allowed.values[:PICTURED])
    numbers = list[Numbers]()
    # at least one round
    while allowed.tried < allowed.available or not numbers:
        allowed.extend(rule.following(allowed.tried) if numbers else LEAST)
        # only the new draws: the results of earlier ones are kept
        numbers += draws.numbers(allowed.values[len(numbers) :])
        values = _by_quantity(numbers)
        scattered = {
            name: scatter(values_of_quantity, rule.sequences)
            for name, values_of_quantity in values.items()
        }
        least_known = worst_known({name: scattered[name] for name in deciding})
        error = scattered[least_known].error
        needed = rule.needed(len(numbers), error, allowed.available)
        progress(
            f"{len(numbers)} draws of about {needed}: {rule.text} to {error:.1%} ({least_known})"
        )
        if error <= rule.wanted:
            break
    swings = _swings(inputs, first_runs.ends, values, scattered)
    return UncertaintyResult(
        inputs=inputs,
        points=InputDraws(allowed.z, allowed.values),
        values=values,
        scatter=scattered,
        middle=first_runs.ends[0],
        swings=swings,
        shares={name: indices(inputs.shapes, allowed.z, values[name][:, 0]) for name in swings},
        pictures=pictures,
        is_constant=draws.is_constant,
        wanted=rule.wanted,
        sequences=rule.sequences,
        deciding=deciding,
        left_out=allowed.statement,
    )


# --- linear propagation ---------------------------------------------------------------------------


def _linear(
    draws: OutputDraws, allowed: AllowedDraws, first_runs: _FirstRuns, rule: StopRule
) -> LinearResult:
    """Return the linear estimate of each number, or why there is none."""
    inputs = draws.inputs
    far_values = _one_at_a_time(inputs, FAR)
    if reason := _without_linear(inputs, far_values):
        return LinearResult(inputs, first_runs.deciding, rule.wanted, reason)
    far_runs = _by_quantity(draws.numbers(far_values))
    checks = _by_quantity(draws.numbers(allowed.values[:CHECKS]))
    near_runs = _by_quantity(first_runs.ends)
    scattered = {name: scatter(np.concatenate([near_runs[name], checks[name]])) for name in checks}
    estimates = {}
    for name, near in near_runs.items():
        by_input = (len(inputs.names), 2, near.shape[1])
        runs = OutputRuns(
            near[0], near[1:].reshape(by_input), far_runs[name].reshape(by_input), checks[name]
        )
        # infinite values make the error infinite
        with np.errstate(invalid="ignore"):
            estimates[name] = propagate(inputs.shapes, allowed.z[:CHECKS], runs)
    return LinearResult(
        inputs,
        first_runs.deciding,
        rule.wanted,
        estimates=estimates,
        middle=first_runs.ends[0],
        swings=_swings(inputs, first_runs.ends, near_runs, scattered),
        runs=len(first_runs.ends) + len(far_values) + CHECKS,
        seconds_a_run=_seconds_a_draw(draws),
        is_constant=draws.is_constant,
    )


def _without_linear(inputs: Inputs, far_values: FloatArray) -> str:
    """Return why the inputs cannot be propagated linearly; empty if they can."""
    if inputs.has_table:
        return "some inputs are drawn as rows of a table, which has no derivative"
    if separate := without_distance(inputs.names, inputs.shapes):
        return f"{', '.join(separate)} has separate values, and no derivative"
    problems = [problem for problem in map(inputs.problem, far_values) if problem is not None]
    return f"a value far from its median is not allowed: {problems[0].message}" if problems else ""


def _linear_outcome(linear: LinearResult, draws: OutputDraws) -> StudyOutcome:
    """Return the numbers and the page of a study that linear propagation answers."""
    quantities = {
        name: {
            "error": estimate.error,
            "middle": list(linear.middle[name]),
            **{
                field: getattr(estimate, field).tolist()
                for field in ("mean", "error_of_mean", "sd", "bias", "second_order", "ends")
            },
            "missed": estimate.missed.tolist(),
            "shares": estimate.shares.tolist(),
        }
        for name, estimate in linear.estimates.items()
    }
    content = {
        "method": "linear",
        "draws": linear.runs,
        "computed": draws.computed,
        "seconds a draw": _seconds_a_draw(draws),
        "failed": 0,
        "error": linear.error,
        "wanted": linear.wanted,
        "decided by": list(linear.deciding),
        "inputs": linear.input_rows,
        "idle": list(linear.inputs.idle),
        "still": list(linear.is_constant),
        "cut off": dict(linear.inputs.notes),
        "quantities": quantities,
    }
    picture = tornado_of_linear(linear)
    report = StudyReport(
        f"{linear.inputs.recipe.name}: uncertainty",
        lead_of_linear(linear),
        sections_of_linear(linear, picture),
        {"tornado": picture} if picture else {},
        tables={"table.csv": (_LINEAR_COLUMNS, _rows_of_linear(linear))},
        shown=("command", "date", "seconds", "draws", "computed", "seconds a draw", "versions"),
    )
    return StudyOutcome(digest(quantities), content, report)


def _rows_of_linear(linear: LinearResult) -> list[Sequence[Any]]:
    """Return the rows of table.csv of a linear propagation: one for each element."""
    rows: list[Sequence[Any]] = []
    for name, estimate in linear.estimates.items():
        off = np.abs(estimate.second_order) + estimate.ends + estimate.missed
        columns = zip(
            linear.middle[name], estimate.mean, estimate.sd, estimate.bias, off, strict=True
        )
        rows += [
            (name, element if len(estimate.mean) > 1 else "", *row)
            for element, row in enumerate(columns)
        ]
    return rows


def _rung_of_draws(result: UncertaintyResult, draws: OutputDraws) -> Rung:
    """Return how accurate the draws are, and what they took."""
    kind = "Sobol points" if result.sequences else "draws"
    # the first runs, with the inputs at their ends, belong to every method
    runs = len(result.points.z) + 1 + 2 * len(result.inputs.names)
    return Rung(kind, runs, _seconds_a_draw(draws), result.error, result.error <= result.wanted)


def _seconds_a_draw(draws: OutputDraws) -> float | None:
    """Return the mean run time of a draw, s; None if none was computed."""
    return draws.seconds / draws.computed if draws.computed else None


# --- first runs -----------------------------------------------------------------------------------


def _say_inputs(inputs: Inputs, draws: OutputDraws, sequences: int, progress: Progress) -> None:
    """Report the inputs, the cut-off parts of their distributions, and the outputs that depend on
    no input.
    """
    progress(
        f"{len(inputs.names)} inputs: {', '.join(inputs.names)}; {len(draws.outputs)} outputs"
        " depend on them"
    )
    for name, note in inputs.notes.items():
        progress(f"{name} = {inputs.uncertain.said(name)}: {note}")
    if draws.is_constant:
        progress(
            f"outputs that depend on no input, and do not vary: {', '.join(draws.is_constant)}"
        )
    if inputs.has_table and sequences:
        progress(
            "a Sobol sequence draws from the columns of the table and their rank correlation, not"
            " its rows"
        )
    progress(f"steps that depend on no input: {draws.ready():.1f} s")


def _say_constant(
    inputs: Inputs,
    draws: OutputDraws,
    ends: Sequence[Numbers],
    deciding: Sequence[str],
    progress: Progress,
) -> None:
    """Report the numbers that do not vary in the first runs; raise `StudyRefused` if none of the
    deciding ones varies.
    """
    same_in_all = _constant(ends)
    if set(deciding) <= set(same_in_all):  # try the extreme ends of the distributions too
        ends = [*ends, *draws.numbers(_one_at_a_time(inputs, FAR))]
        same_in_all = _constant(ends)
    if same_in_all:
        progress(
            f"{', '.join(same_in_all)}: the same in the first {len(ends)} runs, one input after"
            " another at its ends"
        )
    if set(deciding) <= set(same_in_all):
        raise StudyRefused(
            f"nothing varies: {', '.join(deciding)} {'is' if len(deciding) == 1 else 'are'} the"
            f" same in {len(ends)} runs, with all inputs at their medians, and with each at its 5"
            " %, 95 %, 0.1 % and 99.9 % quantile. Name outputs that the inputs change, or write"
            " wider distributions"
        )


def _constant(runs: Sequence[Numbers]) -> list[str]:
    """Return the names of the quantities that are the same in all runs."""
    return [name for name, values in _by_quantity(runs).items() if scatter(values).is_constant]


def _by_quantity(runs: Sequence[Numbers]) -> dict[str, FloatArray]:
    """Return the values (run, element) of each quantity."""
    return {name: np.array([run[name] for run in runs]) for name in runs[0]}


def _swings(
    inputs: Inputs,
    ends: Sequence[Numbers],
    values: Mapping[str, FloatArray],
    scattered: Mapping[str, Scatter],
) -> dict[str, list[tuple[str, float, float]]]:
    """Return each output number with each input alone at its 5 % and 95 % quantile; skip numbers
    proportional to others.
    """
    swings: dict[str, list[tuple[str, float, float]]] = {}
    for name, values_of_number in values.items():
        is_finite = (
            np.isfinite(values_of_number).all()
            and np.isfinite([end_run[name] for end_run in ends]).all()
        )
        varies = is_finite and values_of_number.shape[1] == 1 and not scattered[name].is_constant
        if varies and not any(
            _proportional(values_of_number[:, 0], values[earlier_number][:, 0])
            for earlier_number in swings
        ):
            # run 0 is at the medians; then each input at its 5 % and its 95 % in turn
            pairs = zip(inputs.labels, ends[1::2], ends[2::2], strict=True)
            swings[name] = [
                (label, low_run[name][0], high_run[name][0]) for label, low_run, high_run in pairs
            ]
    return swings


def _proportional(x: FloatArray, y: FloatArray) -> bool:
    """Return True if ``x`` is ``y`` times a constant, by their ratio where ``y`` is largest."""
    index = int(np.abs(y).argmax())
    return y[index] != 0 and bool(np.allclose(x * y[index], y * x[index], rtol=1e-9, atol=0.0))


def _document(result: UncertaintyResult, draws: OutputDraws) -> dict[str, Any]:
    """Return the numbers of the study as JSON values."""
    return {
        "draws": len(result.points.z),
        "points": "sobol" if result.sequences else "draws",
        "computed": draws.computed,
        "seconds a draw": _seconds_a_draw(draws),
        "rungs": [asdict(rung) for rung in result.rungs],
        "failed": result.failed,
        "error": result.error,
        "wanted": result.wanted,
        "decided by": list(result.deciding),
        "inputs": result.input_rows,
        "posterior": standing_rows(result.inputs.uncertain.standings),
        "cut off": dict(result.inputs.notes),
        "left out": result.left_out,
        "idle": list(result.inputs.idle),
        "still": list(result.is_constant),
        "quantities": {name: _plain(result, name) for name in result.values},
        "sensitivity": {name: asdict(shares) for name, shares in result.shares.items()},
    }


def _plain(result: UncertaintyResult, name: str) -> dict[str, Any]:
    """Return the scatter of one quantity as JSON values."""
    scattered = result.scatter[name]
    arrays = {
        statistic: getattr(scattered, statistic).tolist()
        for statistic in ("mean", "sd", "low", "high")
    }
    return {"error": scattered.error, "middle": list(result.middle[name]), **arrays}


def _report(result: UncertaintyResult) -> StudyReport:
    """Return the page of the study, with its tables, draws and pictures."""
    pictures = draw_pictures(result)
    named_draws = zip(result.inputs.names, result.points.values.T, strict=True)
    files: dict[str, Content] = {"draws.npz": _npz({**dict(named_draws), **result.values})}
    if result.pictures:
        arrays = {}
        for name, moments in result.pictures.items():
            for statistic, moment in zip(_PICTURE_STATISTICS, moments, strict=True):
                arrays[f"{name} {statistic}"] = moment.numpy()
        files["pictures.npz"] = _npz(arrays)
    return StudyReport(
        f"{result.inputs.recipe.name}: uncertainty",
        lead(result),
        sections(result, pictures),
        pictures,
        tables={"table.csv": (_COLUMNS, _rows(result))},
        files=files,
        shown=("command", "date", "seconds", "draws", "computed", "seconds a draw", "versions"),
    )


def _rows(result: UncertaintyResult) -> list[Sequence[Any]]:
    """Return the rows of table.csv: one for each element of each quantity."""
    rows: list[Sequence[Any]] = []
    for name, scattered in result.scatter.items():
        columns = zip(
            result.middle[name],
            scattered.mean,
            scattered.sd,
            scattered.low,
            scattered.high,
            strict=True,
        )
        rows += [
            (name, element if len(scattered.mean) > 1 else "", *row)
            for element, row in enumerate(columns)
        ]
    return rows


def _npz(arrays: Mapping[str, Any]) -> bytes:
    """Return arrays as the bytes of an npz file."""
    buffer = io.BytesIO()
    np.savez(buffer, **arrays)
    return buffer.getvalue()
