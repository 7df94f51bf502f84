"""The part of a probability distribution that lies in the values that a recipe allows, as a read noise from 0.

A distribution with more than a negligible part outside is refused before anything runs. A negligible part is cut off,
with a statement: the draws then have the distribution under the condition that the value is allowed.
"""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import dataclass, replace
from functools import partial

import numpy as np

from neusee.workflows.graph.diagnostics import Diagnostic, Location, RecipeError
from neusee.workflows.recipe.distributions.joint import Joint
from neusee.workflows.recipe.distributions.nominal_values import Uncertain
from neusee.workflows.recipe.distributions.scalar import Law, written
from neusee.workflows.recipe.distributions.shapes import Discrete, FloatArray, share_between

NEGLIGIBLE = 1e-3  #: probability that a study cuts off; it changes the sd of a normal distribution by at most 0.6 %
RARE = 1e-6  #: probability that is cut off where nobody reads a statement, as in a training
_FAR = 6.0  #: standard deviations up to which values are tried; 1e-9 of a distribution lies beyond each end
_HALVINGS = 48  #: of the interval that contains the end of the allowed values
_CLOSE = 1e-9  #: share of a standard deviation by which a bound may be rounded to a short number

Reason = str  #: why a value is not allowed; empty for an allowed value


@dataclass(frozen=True)
class AllowedPart:
    """Range of normal scores at which the values of a distribution are allowed, and what lies outside."""

    low: float  #: -inf if no value below is refused
    high: float
    reason: Reason

    @property
    def outside(self) -> float:
        """Return the probability of the values that are not allowed."""
        return share_between(-math.inf, self.low) + share_between(self.high, math.inf)


def within_allowed(uncertain: Uncertain, negligible: float) -> tuple[Uncertain, dict[str, str]]:
    """Return uncertain values whose distributions have allowed values only, and a statement for each that was cut.

    Raises `RecipeError` for each distribution of which more than the share ``negligible`` is not allowed.
    """
    laws, notes = dict(uncertain.laws), dict[str, str]()
    problems: list[Diagnostic] = []
    for name, law in uncertain.laws.items():
        part = _allowed_part(uncertain, name, partial(_law_value, law))
        if not part.reason:
            continue
        low, high = _bound(law, part.low), _bound(law, part.high)
        if part.outside > negligible or _is_single(law, low, high):
            problems.append(_refusal(uncertain, name, law.text, part, _advice(law, low, high)))
            continue
        laws[name] = law.truncated(low, high)
        notes[name] = _statement(law, laws[name], part)
    joint = uncertain.joint
    if joint is not None:
        joint, found = _joint_within(uncertain, joint, negligible, problems)
        notes |= found
    if problems:
        raise RecipeError(problems)
    return replace(uncertain, laws=laws, joint=joint), notes


def _allowed_part(uncertain: Uncertain, name: str, value: Callable[[float], float]) -> AllowedPart:
    """Return the allowed range of normal scores around 0, where ``value`` is the value at a normal score."""
    reasons = {end: _reason(uncertain, name, value(end)) for end in (-_FAR, _FAR)}
    low = _edge(uncertain, name, value, -_FAR) if reasons[-_FAR] else -math.inf
    high = _edge(uncertain, name, value, _FAR) if reasons[_FAR] else math.inf
    return AllowedPart(low, high, reasons[-_FAR] or reasons[_FAR])


def _edge(uncertain: Uncertain, name: str, value: Callable[[float], float], refused: float) -> float:
    """Return the last normal score between 0 and a ``refused`` score at which the recipe allows the value."""
    allowed = 0.0
    for _ in range(_HALVINGS):
        middle = (allowed + refused) / 2
        if _reason(uncertain, name, value(middle)):
            refused = middle
        else:
            allowed = middle
    return allowed


def _reason(uncertain: Uncertain, name: str, value: float) -> Reason:
    """Return why the recipe does not allow a value, or an empty text."""
    if not math.isfinite(value):
        return "must be finite"
    try:
        uncertain.at({name: value})
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
    step = float(law.shape.at(np.array(1.0)) - law.shape.at(np.array(-1.0))) / 2
    return _short(value, _CLOSE * step)


def _short(number: float, within: float) -> float:
    """Return the number with the fewest digits that differs from ``number`` by at most ``within``."""
    if abs(number) <= within:
        return 0.0
    candidates = (float(f"{number:.{digits}g}") for digits in range(1, 17))
    return next((candidate for candidate in candidates if abs(candidate - number) <= within), number)


def _is_single(law: Law, low: float, high: float) -> bool:
    """Return True if only one of several separate values is allowed."""
    if not isinstance(law.shape, Discrete):
        return False
    inside = (law.shape.values >= low) & (law.shape.values <= high)
    return int(inside.sum()) < 2


def _advice(law: Law, low: float, high: float) -> str:
    if law.kind == "truncated":
        return "give it tighter bounds"
    if isinstance(law.shape, Discrete):
        return "remove these values"
    unit = "e-/DN" if law.reciprocal else law.unit
    return f"write truncated({law.text}, {_bound_text(low, unit)}, {_bound_text(high, unit)})"


def _bound_text(bound: float, unit: str) -> str:
    return f"{bound:g}" if math.isinf(bound) else f"{bound:.15g} {unit}".rstrip()


def _refusal(uncertain: Uncertain, name: str, text: str, part: AllowedPart, advice: str) -> Diagnostic:
    share = f"{part.outside:.2g}" if part.outside < 1e-3 else f"{part.outside:.2%}"
    message = f"{share} of this distribution lies outside the allowed values ({part.reason}): {advice}"
    return Diagnostic(_mark(uncertain, name), f"{name} = {text}", message)


def _mark(uncertain: Uncertain, name: str) -> Location:
    value = uncertain.composed.root.below(name.split("."))
    assert value is not None
    return value.mark


def _statement(law: Law, cut: Law, part: AllowedPart) -> str:
    """Return what was cut off a distribution, and how far its mean and standard deviation moved."""
    (mean, sd), (new_mean, new_sd) = law.shape.moments(), cut.shape.moments()
    moved = f"its mean moves by {(new_mean - mean) / sd:+.2g} sd, and its sd by {new_sd / sd - 1:+.2%}"
    return f"{part.outside:.2g} of it lies outside the allowed values ({part.reason}) and is cut off; {moved}"


def _joint_within(
    uncertain: Uncertain, joint: Joint, negligible: float, problems: list[Diagnostic]
) -> tuple[Joint, dict[str, str]]:
    """Return a joint distribution with allowed values only, with statements; add a problem for each refused value."""
    if joint.draws is None:
        return _normal_within(uncertain, joint, negligible, problems)
    allowed = np.ones(len(joint.draws), bool)
    notes = dict[str, str]()
    for i, name in enumerate(joint.names):
        column = np.sort(joint.draws[:, i])
        part = _allowed_part(uncertain, name, partial(_sample, column))
        if not part.reason:
            continue
        low, high = (_sample(column, score) for score in (part.low, part.high))
        inside = (joint.draws[:, i] >= low) & (joint.draws[:, i] <= high)
        outside = 1.0 - float(inside.mean())
        if outside > negligible:
            found = replace(part, low=-math.inf, high=-_score(outside))
            problems.append(_refusal(uncertain, name, uncertain.said(name), found, "remove these rows of the table"))
            continue
        allowed &= inside
        notes[name] = (
            f"{int((~inside).sum())} of its {len(inside)} rows lie outside the allowed values ({part.reason}) and are "
            "left out"
        )
    return (joint if allowed.all() else Joint.of_draws(joint.names, joint.draws[allowed])), notes


def _law_value(law: Law, score: float) -> float:
    return float(law.at(np.array(score)))


def _sample(column: FloatArray, score: float) -> float:
    """Return the sample of a sorted column at a normal score."""
    return float(column[_rank(score, len(column))])


def _normal_value(mean: float, sd: float, score: float) -> float:
    return mean + sd * score


def _rank(score: float, count: int) -> int:
    """Return the index of the sample at a normal score among ``count`` sorted samples, with both ends at 6."""
    if abs(score) >= _FAR:
        return 0 if score < 0 else count - 1
    return min(count - 1, int(count * share_between(-math.inf, score)))


def _score(share: float) -> float:
    from scipy.special import ndtri

    return float(ndtri(share))


def _normal_within(
    uncertain: Uncertain, joint: Joint, negligible: float, problems: list[Diagnostic]
) -> tuple[Joint, dict[str, str]]:
    bounds = np.array([[-math.inf, math.inf]] * len(joint.names))
    notes = dict[str, str]()
    for i, name in enumerate(joint.names):
        mean, sd = float(joint.mean[i]), float(joint.sd[i])
        part = _allowed_part(uncertain, name, partial(_normal_value, mean, sd))
        if not part.reason:
            continue
        if part.outside > negligible:
            advice = "give a smaller standard deviation, or draws in a file with allowed values only"
            text = f"normal({written(mean, uncertain.units[name])}, {written(sd, uncertain.units[name])})"
            problems.append(_refusal(uncertain, name, text, part, advice))
            continue
        bounds[i] = part.low, part.high
        notes[name] = f"{part.outside:.2g} of it lies outside the allowed values ({part.reason}) and is cut off"
    return (joint if not notes else replace(joint, bounds=bounds)), notes
