"""Uncertain inputs of a recipe: the allowed range of their values, and random draws from it."""

from __future__ import annotations

import math
from collections.abc import Callable, Collection, Iterator, Mapping, Sequence
from dataclasses import dataclass, field, replace
from functools import partial
from itertools import chain
from typing import Any

import numpy as np

from neusee.nodes.units import read_any
from neusee.workflows.graph.errors import Diagnostic, Location, RecipeError
from neusee.workflows.graph.recipe_graph import Recipe, needed
from neusee.workflows.recipe.distributions.joint_distribution import Joint
from neusee.workflows.recipe.distributions.nominal_values import Uncertain
from neusee.workflows.recipe.distributions.shapes import (
    Discrete,
    FloatArray,
    Law,
    Normal,
    Shape,
    share_between,
    written,
)
from neusee.workflows.recipe.loading import recipe_at

# --- allowed range --------------------------------------------------------------------------------

# The part of a probability distribution inside the range that a recipe allows, such as a read noise
# of 0 or more.
#
# A distribution with more than a negligible part outside is refused before anything runs. A
# negligible part is cut off, with a statement: the draws then have the distribution under the
# condition that the value is allowed.


#: probability that a study cuts off; it changes the sd of a normal distribution by at most 0.6 %
NEGLIGIBLE = 1e-3
RARE = 1e-6  #: probability that is cut off if no user reads a statement, as in a training
#: standard deviations up to which values are tried; 1e-9 of a distribution lies beyond each end
_FAR = 6.0
_HALVINGS = 48  #: bisections of the interval that contains the end of the allowed values
_CLOSE = 1e-9  #: share of a standard deviation by which a bound may be rounded to a short number

Reason = str  #: why a value is not allowed; empty for an allowed value


@dataclass(frozen=True)
class AllowedPart:
    """Range of normal scores at which the values of a distribution are allowed, and why values
    outside are refused.
    """

    low: float  #: -inf if no value below is refused
    high: float
    reason: Reason

    @property
    def outside(self) -> float:
        """Return the probability of the values that are not allowed."""
        return share_between(-math.inf, self.low) + share_between(self.high, math.inf)


def within_allowed(uncertain: Uncertain, negligible: float) -> tuple[Uncertain, dict[str, str]]:
    """Return uncertain values with distributions that are restricted to allowed values, and a
    statement for each that was cut.

    Raises `RecipeError` for each distribution of which more than the share ``negligible`` is not
    allowed.
    """
    laws, notes = dict(uncertain.laws), dict[str, str]()
    problems: list[Diagnostic] = []
    for name, law in uncertain.laws.items():
        allowed = _allowed_part(uncertain, name, partial(_law_value, law))
        if not allowed.reason:
            continue
        low_bound, high_bound = _bound(law, allowed.low), _bound(law, allowed.high)
        if allowed.outside > negligible or _is_single(law, low_bound, high_bound):
            problems.append(
                _refusal(uncertain, name, law.text, allowed, _advice(law, low_bound, high_bound))
            )
            continue
        laws[name] = law.truncated(low_bound, high_bound)
        notes[name] = _statement(law, laws[name], allowed)
    joint = uncertain.joint
    if joint is not None:
        joint, joint_notes = _joint_within(uncertain, joint, negligible, problems)
        notes |= joint_notes
    if problems:
        raise RecipeError(problems)
    return replace(uncertain, laws=laws, joint=joint), notes


def _allowed_part(uncertain: Uncertain, name: str, value: Callable[[float], float]) -> AllowedPart:
    """Return the allowed range of normal scores around 0, where ``value`` is the value at a
    normal score.
    """
    reason_at = {
        end_score: _reason(uncertain, name, value(end_score)) for end_score in (-_FAR, _FAR)
    }
    low_score = _edge(uncertain, name, value, -_FAR) if reason_at[-_FAR] else -math.inf
    high_score = _edge(uncertain, name, value, _FAR) if reason_at[_FAR] else math.inf
    return AllowedPart(low_score, high_score, reason_at[-_FAR] or reason_at[_FAR])


def _edge(
    uncertain: Uncertain, name: str, value: Callable[[float], float], refused: float
) -> float:
    """Return the last normal score between 0 and a ``refused`` score at which the recipe allows
    the value.
    """
    allowed = 0.0
    for _ in range(_HALVINGS):
        middle_score = (allowed + refused) / 2
        if _reason(uncertain, name, value(middle_score)):
            refused = middle_score
        else:
            allowed = middle_score
    return allowed


def _reason(uncertain: Uncertain, name: str, value: float) -> Reason:
    """Return why the recipe does not allow a value, or an empty text."""
    if not math.isfinite(value):
        return "must be finite"
    try:
        recipe_at(uncertain, {name: value})
    except RecipeError as error:
        return error.diagnostics[0].message
    return ""


def _bound(law: Law, score: float) -> float:
    """Return the bound of the allowed values at a normal score, as the number is written, in SI."""
    if math.isinf(score):
        return score
    value = float(law.shape.at(np.array(score)))
    if isinstance(law.shape, Discrete):
        return value
    one_sd = float(law.shape.at(np.array(1.0)) - law.shape.at(np.array(-1.0))) / 2
    return _short(value, _CLOSE * one_sd)


def _short(number: float, within: float) -> float:
    """Return the number with the fewest digits that differs from ``number`` by at most
    ``within``.
    """
    if abs(number) <= within:
        return 0.0
    candidates = (float(f"{number:.{digits}g}") for digits in range(1, 17))
    return next(
        (candidate for candidate in candidates if abs(candidate - number) <= within), number
    )


def _is_single(law: Law, low: float, high: float) -> bool:
    """Return True if only one of several separate values is allowed."""
    if not isinstance(law.shape, Discrete):
        return False
    is_allowed = (law.shape.values >= low) & (law.shape.values <= high)
    return int(is_allowed.sum()) < 2


def _advice(law: Law, low: float, high: float) -> str:
    """Return the advice for a distribution with too much probability outside the allowed values."""
    if law.kind == "truncated":
        return "set tighter bounds"
    if isinstance(law.shape, Discrete):
        return "remove these values"
    unit = "e-/DN" if law.reciprocal else law.unit
    return f"write truncated({law.text}, {_bound_text(low, unit)}, {_bound_text(high, unit)})"


def _bound_text(bound: float, unit: str) -> str:
    return f"{bound:g}" if math.isinf(bound) else f"{bound:.15g} {unit}".rstrip()


def _refusal(
    uncertain: Uncertain, name: str, text: str, allowed: AllowedPart, advice: str
) -> Diagnostic:
    """Return the diagnostic for a distribution with too much probability outside the allowed
    values.
    """
    share_text = f"{allowed.outside:.2g}" if allowed.outside < 1e-3 else f"{allowed.outside:.2%}"
    message = (
        f"{share_text} of this distribution lies outside the allowed values"
        f" ({allowed.reason}): {advice}"
    )
    return Diagnostic(_mark(uncertain, name), f"{name} = {text}", message)


def _mark(uncertain: Uncertain, name: str) -> Location:
    value = uncertain.composed.root.below(name.split("."))
    assert value is not None
    return value.mark


def _statement(law: Law, cut: Law, allowed: AllowedPart) -> str:
    """Return what was cut off a distribution, and how far its mean and standard deviation moved."""
    (mean, sd), (new_mean, new_sd) = law.shape.moments(), cut.shape.moments()
    change_text = (
        f"its mean moves by {(new_mean - mean) / sd:+.2g} sd, and its sd by {new_sd / sd - 1:+.2%}"
    )
    return (
        f"{allowed.outside:.2g} of it lies outside the allowed values ({allowed.reason}) and is"
        f" cut off; {change_text}"
    )


def _joint_within(
    uncertain: Uncertain, joint: Joint, negligible: float, problems: list[Diagnostic]
) -> tuple[Joint, dict[str, str]]:
    """Return a joint distribution with allowed values only, with statements; add a problem for
    each refused value.
    """
    if joint.draws is None:
        return _normal_within(uncertain, joint, negligible, problems)
    row_is_allowed = np.ones(len(joint.draws), bool)
    notes = dict[str, str]()
    for i, name in enumerate(joint.names):
        sorted_draws = np.sort(joint.draws[:, i])
        limits = _allowed_part(uncertain, name, partial(_sample, sorted_draws))
        if not limits.reason:
            continue
        lowest, highest = (_sample(sorted_draws, score) for score in (limits.low, limits.high))
        is_inside = (joint.draws[:, i] >= lowest) & (joint.draws[:, i] <= highest)
        outside = 1.0 - float(is_inside.mean())
        if outside > negligible:
            # `_refusal` states the probability outside: all of it is put on one side
            excess = replace(limits, low=-math.inf, high=-_score(outside))
            problems.append(
                _refusal(
                    uncertain, name, uncertain.said(name), excess, "remove these rows of the table"
                )
            )
            continue
        row_is_allowed &= is_inside
        notes[name] = (
            f"{int((~is_inside).sum())} of its {len(is_inside)} rows lie outside the allowed values"
            f" ({limits.reason}) and are left out"
        )
    return (
        joint if row_is_allowed.all() else Joint.of_draws(joint.names, joint.draws[row_is_allowed])
    ), notes


def _law_value(law: Law, score: float) -> float:
    return float(law.at(np.array(score)))


def _sample(column: FloatArray, score: float) -> float:
    """Return the sample of a sorted column at a normal score."""
    return float(column[_rank(score, len(column))])


def _normal_value(mean: float, sd: float, score: float) -> float:
    return mean + sd * score


def _rank(score: float, count: int) -> int:
    """Return the index of the sample at a normal score among ``count`` sorted samples; scores of -6
    and 6 or beyond give the first and the last one.
    """
    if abs(score) >= _FAR:
        return 0 if score < 0 else count - 1
    return min(count - 1, int(count * share_between(-math.inf, score)))


def _score(share: float) -> float:
    from scipy.special import ndtri

    return float(ndtri(share))


def _normal_within(
    uncertain: Uncertain, joint: Joint, negligible: float, problems: list[Diagnostic]
) -> tuple[Joint, dict[str, str]]:
    """Return a joint normal distribution cut off at allowed values, with statements.

    Add a problem for each value of which more than the share `negligible` is not allowed.
    """
    bounds = np.array([[-math.inf, math.inf]] * len(joint.names))
    notes = dict[str, str]()
    for i, name in enumerate(joint.names):
        mean, sd = float(joint.mean[i]), float(joint.sd[i])
        allowed = _allowed_part(uncertain, name, partial(_normal_value, mean, sd))
        if not allowed.reason:
            continue
        if allowed.outside > negligible:
            advice = (
                "give a smaller standard deviation, or draws in a file with allowed values only"
            )
            text = (
                f"normal({written(mean, uncertain.units[name])},"
                f" {written(sd, uncertain.units[name])})"
            )
            problems.append(_refusal(uncertain, name, text, allowed, advice))
            continue
        bounds[i] = allowed.low, allowed.high
        notes[name] = (
            f"{allowed.outside:.2g} of it lies outside the allowed values ({allowed.reason}) and is"
            " cut off"
        )
    return (joint if not notes else replace(joint, bounds=bounds)), notes


# --- uncertain inputs -----------------------------------------------------------------------------

# Uncertain inputs of a recipe: random draws of their values, and the step parameters that use these
# values.


SCRAMBLES = 8  #: number of independently scrambled Sobol sequences, whose scatter gives the error
#: standard deviations by which a value of a joint distribution is changed to find its readers
_PROBE = 0.3
_NORMAL = Normal()
_CORRELATED = 0.1  #: smallest correlation of two values that count as correlated
_EDGE = 1e-12  #: smallest distance of the probability of a point from 0 and 1

Index = tuple[int | str, ...]  #: path of a number in a parameter; empty for the parameter itself


class NothingDrawn(ValueError):
    """Error for a recipe whose outputs depend on no uncertain value."""


@dataclass(frozen=True)
class InputDraws:
    """Random draws of all uncertain inputs of a recipe."""

    z: FloatArray  #: (draw, input) independent standard normal numbers
    values: FloatArray  #: (draw, input) in SI


@dataclass(frozen=True)
class Inputs:
    """The uncertain inputs of a recipe that affect its outputs, in the order of `names`."""

    recipe: Recipe
    uncertain: Uncertain
    names: tuple[str, ...]  #: paths of the recipe that affect an output
    idle: tuple[str, ...]  #: paths that affect no output
    #: indices and inputs by ``step.parameter``
    readers: Mapping[str, tuple[tuple[Index, str], ...]]
    #: by name, what was cut off because it is not allowed
    notes: Mapping[str, str] = field(default_factory=dict)

    @classmethod
    def of(
        cls, recipe: Recipe, outputs: Sequence[str] | None = None, negligible: float | None = RARE
    ) -> Inputs:
        """Return the uncertain inputs of a recipe that affect ``outputs``, by default the recipe's
        own outputs.

        A part of a distribution outside the allowed values is cut off, with a note, if its
        probability is at most ``negligible``; None leaves all distributions as they are.
        Raises `NothingDrawn` for a recipe without uncertain values, and if no output depends on an
        uncertain value; `RecipeError` for a distribution with more probability outside than
        ``negligible``; ValueError for a value that cannot be sampled.
        """
        outputs = recipe.outputs if outputs is None else outputs
        uncertain = recipe.uncertain
        if uncertain is None or not uncertain.names:
            raise NothingDrawn(
                "no value is uncertain: write a distribution in place of a value, such as "
                'sensor.read_noise="normal(10.5 e-, 0.5 e-)", or posterior: PATH'
            )
        uncertain, notes = (
            (uncertain, {}) if negligible is None else within_allowed(uncertain, negligible)
        )
        readers = _all_readers(recipe, uncertain, outputs)
        with_effect = {name for _, name in chain.from_iterable(readers.values())}
        if not with_effect:
            raise NothingDrawn(f"no output depends on {', '.join(uncertain.names)}")
        idle = tuple(name for name in uncertain.names if name not in with_effect)
        drawn_values = only_values(uncertain, with_effect)
        return cls(recipe, drawn_values, drawn_values.names, idle, readers, notes)

    @property
    def labels(self) -> list[str]:
        """Return the label of each uncertain input; the label shows whether the input is
        correlated with others.
        """
        return [_label(self.uncertain, name) for name in self.names]

    @property
    def shapes(self) -> list[Shape]:
        """Return the distribution of each column of normal numbers; values of a joint
        distribution are normal.
        """
        return [
            self.uncertain.laws[name].shape if name in self.uncertain.laws else _NORMAL
            for name in self.names
        ]

    @property
    def has_table(self) -> bool:
        """Return True if some inputs are drawn as whole rows of a table of samples."""
        return self.most_draws is not None

    @property
    def most_draws(self) -> int | None:
        """Return the largest possible number of independent draws of the inputs, or None if
        there is no limit.
        """
        joint = self.uncertain.joint
        return None if joint is None or joint.draws is None else len(joint.draws)

    def theta(self, values: Mapping[str, float]) -> dict[str, Any]:
        """Return the parameters that use uncertain inputs, by ``step.parameter``, for given
        values of the inputs.
        """
        parameters = {}
        for reader, inputs in self.readers.items():
            step, _, param = reader.rpartition(".")
            parameters[reader] = self.recipe.steps[step].params[param]
            for index, name in inputs:
                parameters[reader] = put_at(parameters[reader], index, values[name])
        return parameters

    def at(self, z: FloatArray) -> FloatArray:
        """Transform standard normal numbers ``z`` to values of uncertain inputs; both have the
        shape (draw, input).
        """
        columns = [law.at(z[:, i]) for i, law in enumerate(self.uncertain.laws.values())]
        joint = self.uncertain.joint
        # the columns of the laws come first, then those of the joint distribution
        return np.stack([*columns, *(joint.at(z[:, len(columns) :]).T if joint else ())], 1)

    def independent(self, count: int, seed: int) -> InputDraws:
        """Return independent random draws of the uncertain inputs; a larger ``count`` begins
        with the same draws.
        """
        z = np.random.default_rng([seed, 1]).standard_normal((count, len(self.names)))
        values, joint = self.at(z), self.uncertain.joint
        if joint is None or joint.draws is None:
            return InputDraws(z, values)
        # without repetition: each row of the table at most once
        # whole rows of the table, so that the values of a draw belong together
        rows = np.random.default_rng([seed, 2]).permutation(len(joint.draws))[:count]
        joint_start = len(self.uncertain.laws)
        z = np.concatenate([z[: len(rows), :joint_start], joint.numbers()[rows]], 1)
        return InputDraws(
            z, np.concatenate([values[: len(rows), :joint_start], joint.draws[rows]], 1)
        )

    def sobol(self, count: int, seed: int) -> InputDraws:
        """Return input draws from `SCRAMBLES` scrambled Sobol sequences; draw i belongs to
        sequence i % SCRAMBLES.
        """
        from scipy.special import ndtri
        from scipy.stats import qmc

        # rounded up
        per_sequence = -(-count // SCRAMBLES)
        streams = [np.random.default_rng([seed, 3, n]) for n in range(SCRAMBLES)]
        sequences = [
            # Sobol sequences are balanced only at powers of 2
            qmc.Sobol(len(self.names), seed=rng).random_base2((per_sequence - 1).bit_length())
            for rng in streams
        ]
        # draw by draw from one sequence after the other
        probabilities = np.stack([sequence[:per_sequence] for sequence in sequences], 1).reshape(
            -1, len(self.names)
        )[:count]
        z = np.asarray(ndtri(probabilities.clip(_EDGE, 1 - _EDGE)), np.float64)
        return InputDraws(z, self.at(z))

    def checked(self, values: FloatArray) -> None:
        """Check the smallest and the largest draw of each uncertain input; raise `RecipeError`
        for an invalid value.
        """
        for name, column in zip(self.names, values.T, strict=True):
            for value in (float(column.min()), float(column.max())):
                try:
                    recipe_at(self.uncertain, {name: value})
                except RecipeError as error:
                    explained = [
                        replace(
                            diagnostic, message=f"the value is sampled, but {diagnostic.message}"
                        )
                        for diagnostic in error.diagnostics
                    ]
                    raise RecipeError(explained) from None

    def problem(self, row: FloatArray) -> Diagnostic | None:
        """Return why the recipe does not allow the values of a draw together, or None."""
        try:
            recipe_at(self.uncertain, dict(zip(self.names, map(float, row), strict=True)))
        except RecipeError as error:
            return error.diagnostics[0]
        return None


def only_values(uncertain: Uncertain, names: Collection[str]) -> Uncertain:
    """Return those uncertain values of a recipe whose paths are in ``names``."""
    laws = {name: law for name, law in uncertain.laws.items() if name in names}
    joint = uncertain.joint
    remaining = [name for name in joint.names if name in names] if joint else []
    remaining_joint = joint.only(remaining) if joint and remaining else None
    return replace(uncertain, laws=laws, joint=remaining_joint)


def _all_readers(
    recipe: Recipe, uncertain: Uncertain, outputs: Sequence[str]
) -> dict[str, tuple[tuple[Index, str], ...]]:
    """Return the indices and the names of the uncertain values in each ``step.parameter`` that
    uses some.
    """
    readers: dict[str, tuple[tuple[Index, str], ...]] = {}
    for name in uncertain.names:
        for reader, index in _readers(recipe, uncertain, name, outputs):
            readers[reader] = (*readers.get(reader, ()), (index, name))
    return readers


def _readers(
    recipe: Recipe, uncertain: Uncertain, name: str, outputs: Sequence[str]
) -> Iterator[tuple[str, Index]]:
    """Yield each ``step.parameter`` that uses the recipe value ``name``, and the value's index
    in the parameter.
    """
    probe = _probe(uncertain, name)
    # the parameters that change with the value are those that read it
    changed_recipe = recipe_at(uncertain, {name: probe})
    if (
        changed_recipe.steps.keys() != recipe.steps.keys()
        or changed_recipe.outputs != recipe.outputs
    ):
        raise ValueError(
            f"the value {name} changes the list of steps and therefore cannot be sampled"
        )
    for step in needed(recipe, outputs):
        old_step, new_step = recipe.steps[step], changed_recipe.steps[step]
        for param, value in new_step.params.items():
            for index, new_number in _changed(old_step.params[param], value):
                _refuse_changed(new_number, probe, f"{step}.{param}", name)
                yield f"{step}.{param}", index


def _probe(uncertain: Uncertain, name: str) -> float:
    """Return a value of an uncertain input that differs from the value in the recipe."""
    if name in uncertain.laws:
        value = uncertain.composed.root.below(name.split("."))
        assert value is not None
        return uncertain.laws[name].other_than(read_any(value.data)[0])
    assert uncertain.joint is not None
    i = uncertain.joint.names.index(name)
    return float(uncertain.joint.mean[i] + _PROBE * uncertain.joint.sd[i])


def _refuse_changed(new: Any, probe: float, reader: str, name: str) -> None:
    """Raise ValueError if a parameter has another number than the value of the recipe that it
    reads.
    """
    if isinstance(new, int):
        raise ValueError(
            f"{name} is a whole number and cannot be sampled: compare its values by `neusee sweep`"
        )
    if not isinstance(new, float) or abs(new - probe) > 1e-9 * abs(probe):
        raise ValueError(f"{reader} does not use {name} unchanged, so {name} cannot be sampled")


def _changed(before: Any, after: Any) -> Iterator[tuple[Index, Any]]:
    """Yield the index of each element in which two values of a parameter differ, and the new
    element.
    """
    pairs = _paired(before, after)
    if pairs is not None:
        for index, (earlier, later) in pairs.items():
            yield from (
                ((index, *inner), new_element) for inner, new_element in _changed(earlier, later)
            )
    elif before != after:
        yield (), after


def _paired(before: Any, after: Any) -> dict[Any, tuple[Any, Any]] | None:
    """Return the elements of two lists or mappings by index, or None if they have no common
    indices.
    """
    are_lists = isinstance(before, list | tuple) and isinstance(after, list | tuple)
    if are_lists and len(after) == len(before):
        return dict(enumerate(zip(before, after, strict=True)))
    are_mappings = isinstance(before, Mapping) and isinstance(after, Mapping)
    if are_mappings and after.keys() == before.keys():
        return {key: (before[key], value) for key, value in after.items()}
    return None


def put_at(value: Any, index: Index, new: float) -> Any:
    """Return a parameter with ``new`` in place of the number at an index; the index is empty for
    the parameter itself.
    """
    if not index:
        return new
    if isinstance(value, Mapping):
        return {**value, index[0]: put_at(value[index[0]], index[1:], new)}
    return type(value)(
        put_at(element, index[1:], new) if i == index[0] else element
        for i, element in enumerate(value)
    )


def _label(uncertain: Uncertain, name: str) -> str:
    """Return the label of an input: its name, with a remark if it is correlated with other inputs.

    Correlated values are drawn one after another, so that a later normal number describes only the
    variation that the earlier ones leave open.
    """
    joint = uncertain.joint
    if joint is None or name not in joint.names:
        return name
    i = joint.names.index(name)
    covariance: FloatArray = joint.factor @ joint.factor.T
    correlated = np.abs(covariance[i]) > _CORRELATED
    if correlated[:i].any():
        return f"rest of {name}"
    return f"{name} and correlated values" if correlated[i + 1 :].any() else name
