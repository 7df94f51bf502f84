"""Identifiability of a sensor's parameters: the parameters that the measured light levels
determine.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import TYPE_CHECKING

import numpy as np
import torch

from neusee.nodes.calibrate import Ridge
from neusee.workflows.calibration.log_posterior import LaplaceFit, SensorPosterior

if TYPE_CHECKING:
    from neusee.workflows.calibration.log_posterior import FloatArray

#: singular value (prior standard deviation over that from the levels) below which the prior
#: constrains a direction more than the levels do
WEAK = 3.0
_LEAST_COMPONENT = (
    0.1  #: component from which a parameter counts as part of a direction of length 1
)
_ALONE = 0.97  #: component from which a direction counts as that of a single parameter
#: a parameter is determined if twice as wide priors widen its posterior by at most this factor
_MOST_WIDENING = 1.25
#: distance from the prior's middle, in standard deviations, at which the likelihood is compared
_FAR_PRIOR_SD = 3.0
#: distance in prior standard deviations by which a limit must lie inside the limit of the prior
#: alone
_TELLS = 0.5
_ENDS = (0.05, 0.95)
_ALONE_DRAWS = 20_000  #: draws of the prior
_FALLS = 4.0  #: decrease of the log likelihood at this distance that sets a limit

KINDS = {
    "estimate": "",
    "upper": "only an upper limit",
    "lower": "only a lower limit",
    "between": "only limits on both sides",
    "none": "not from these frames",
}
#: reason by parameter and kind why the frames set only a limit, or none
_REASONS = {
    ("full_well", "lower"): ": no frame is saturated by the well",
    ("dark_current", "upper"): ": no dark was exposed for long enough",
    ("dark_current", "none"): ": no dark was exposed for long enough",
    ("read_noise", "upper"): ": the converter is too coarse for it",
}
#: parameters in electrons; without a known gain, frames give no value of them
_ELECTRONS = ("offset", "read_noise", "temporal_dark_noise", "dark_current", "full_well")


@dataclass(frozen=True)
class Identifiability:
    """The parameters and combinations that the measured light levels determine, and those that
    depend on the prior.
    """

    kinds: dict[str, str]  #: one of `KINDS` for each parameter
    directions: Sequence[str]  #: a sentence for each direction that the levels do not determine
    strengths: Sequence[float]  #: singular values, the largest first, one for each free parameter
    refused: str  #: the reason why sampling is not useful; empty if sampling is useful

    @property
    def estimated(self) -> tuple[str, ...]:
        """Return the names of the parameters whose values the light levels determine."""
        return tuple(name for name, kind in self.kinds.items() if kind == "estimate")

    @property
    def told(self) -> tuple[str, ...]:
        """Return the names of the parameters for which the light levels give a value or a limit."""
        return tuple(name for name, kind in self.kinds.items() if kind != "none")


def identify(problem: SensorPosterior, mode: LaplaceFit) -> Identifiability:
    """Find the parameters that the light levels determine, from the singular values of the levels'
    derivatives.
    """
    _, singular_values, directions = np.linalg.svd(mode.scaled_slopes)
    # fewer rows than parameters: the missing singular values are 0
    singular_values = np.concatenate(
        [singular_values, np.zeros(len(directions) - len(singular_values))]
    )
    # a parameter in a weak direction is determined by the prior, not by the levels
    kinds = {
        name: "estimate" if is_own else "none"
        for name, is_own in zip(problem.names, _own(singular_values, directions), strict=True)
    }
    weak = _sorted_out(directions[singular_values < WEAK])
    sentences = [_weak_direction(problem, mode, row, kinds) for row in weak]
    for ridge in problem.coordinates.ridges(torch.from_numpy(mode.theta)):
        if _as_good(problem, mode, ridge):
            kinds |= ridge.kinds
            sentences.append(ridge.text)
    sentences = withheld_electrons(kinds, sentences)
    weak_count = (
        f"{len(weak)} of {len(problem.names)} parameters cannot be determined from these frames"
    )
    # more than half of the parameters are not determined
    refused = f"{weak_count}: {'; '.join(sentences)}" if 2 * len(weak) > len(problem.names) else ""
    return Identifiability(kinds, sentences, singular_values.tolist(), refused)


def _weak_direction(
    problem: SensorPosterior, mode: LaplaceFit, direction: FloatArray, kinds: dict[str, str]
) -> str:
    """Return a sentence on a direction that the light levels do not determine; if it is nearly that
    of one parameter, set this parameter's kind in ``kinds``.
    """
    large_components = [
        (parameter, component)
        for parameter, component in zip(problem.names, direction, strict=True)
        if abs(component) >= _LEAST_COMPONENT
    ]
    if (
        len(large_components) > 1
        and max(abs(component) for _, component in large_components) <= _ALONE
    ):
        return _together(large_components)
    largest_parameter = max(large_components, key=lambda pair: abs(pair[1]))[0]
    kinds[largest_parameter] = _limit(problem, mode, largest_parameter)
    reason = _REASONS.get((largest_parameter, kinds[largest_parameter]), "")
    return f"{words_of(largest_parameter)}: {KINDS[kinds[largest_parameter]]}{reason}"


def identify_from_draws(
    problem: SensorPosterior,
    mode: LaplaceFit,
    about_mode: Identifiability,
    samples: FloatArray,
    weight: FloatArray,
) -> Identifiability:
    """Find the parameters that the data determine from weighted draws, for a posterior that is not
    normal around its mode.

    A parameter has a value if its posterior is less than a third as wide as its prior. Otherwise it
    has a limit on each side where the posterior ends clearly inside the prior, of which only
    possible draws count. Along a ridge where distant parameters fit equally well, the limits are
    those of the ridge.
    """
    prior_units, prior_draws = problem.whitened(samples), _possible(problem)
    kinds = {}
    for index, name in enumerate(problem.names):
        kinds[name] = _kind_from_draws(prior_units[:, index], prior_draws[:, index], weight)
    sentences, ridge_names = [], set()
    for ridge in problem.coordinates.ridges(torch.from_numpy(mode.theta)):
        estimated = "estimate" in [kinds.get(name) for name in ridge.kinds]
        if ridge.text in about_mode.directions and not estimated:
            # without priors the data give no limit along the ridge
            kinds |= ridge.kinds
            sentences.append(ridge.text)
            ridge_names |= set(ridge.kinds)
    undetermined = [
        name for name, kind in kinds.items() if kind != "estimate" and name not in ridge_names
    ]
    sentences += [f"{words_of(name)}: {KINDS[kinds[name]]}" for name in undetermined]
    sentences = withheld_electrons(kinds, sentences)
    return replace(about_mode, kinds=kinds, directions=sentences)


def _kind_from_draws(z: FloatArray, alone: FloatArray, weight: FloatArray) -> str:
    """Return whether the data give a value of a parameter, or on which sides they give a limit.

    ``z`` are its weighted draws and ``alone`` draws of its prior, both in standard deviations of
    the prior.
    """
    # narrower than a third of the prior
    if float(np.sqrt(weight @ (z - weight @ z) ** 2)) < 1 / WEAK:
        return "estimate"
    low_end, high_end = weighted_quantiles(z, weight, _ENDS)
    prior_low, prior_high = np.quantile(alone, _ENDS)
    inside_prior = bool(low_end > prior_low + _TELLS), bool(high_end < prior_high - _TELLS)
    limits = {(True, False): "lower", (False, True): "upper", (True, True): "between"}
    return limits.get(inside_prior, "none")


def withheld_electrons(kinds: dict[str, str], sentences: Sequence[str]) -> list[str]:
    """Set the kind of each parameter in electrons to ``none`` if that of the gain is ``none``, and
    return the sentences that then apply.

    The frames are in digital numbers: without a measured gain, a value in electrons would come from
    the prior of the gain.
    """
    withheld = [
        name
        for name in _ELECTRONS
        if kinds.get("gain") == "none" and kinds.get(name, "none") != "none"
    ]
    kinds |= dict.fromkeys(withheld, "none")
    subjects = tuple(f"{words_of(name)}: " for name in withheld)
    other_sentences = [text for text in sentences if not text.startswith(subjects)]
    return [
        *(
            f"{words_of(name)}: {KINDS['none']}: no value in electrons without the gain"
            for name in withheld
        ),
        *other_sentences,
    ]


def weighted_quantiles(
    values: FloatArray, weight: FloatArray, shares: Sequence[float]
) -> FloatArray:
    """Return the quantiles of weighted ``values`` at the given ``shares``."""
    order = np.argsort(values)
    position = np.searchsorted(np.cumsum(weight[order]), shares).clip(0, len(values) - 1)
    quantiles: FloatArray = values[order][position]
    return quantiles


def _possible(problem: SensorPosterior) -> FloatArray:
    """Return draws of the prior (draw, free) at which the posterior is not zero.

    They are in standard deviations of the prior from its middle.
    """
    prior_draws = np.random.default_rng(0).standard_normal((_ALONE_DRAWS, len(problem.names)))
    coordinates = problem.theta(problem.coordinates.from_whitened(torch.from_numpy(prior_draws)))
    is_finite = np.flatnonzero(np.isfinite(coordinates).all(1))
    possible_draws: FloatArray = prior_draws[
        is_finite[np.isfinite(problem.log_posterior(coordinates[is_finite]))]
    ]
    return possible_draws


def _as_good(problem: SensorPosterior, mode: LaplaceFit, ridge: Ridge) -> bool:
    """Return True if the point ``ridge``, far from the mode, fits about as well as the mode; the
    priors of the limited parameters are ignored.
    """
    ridge_and_mode = np.stack([ridge.place.numpy(), mode.theta])
    limited_columns = [problem.names.index(name) for name in ridge.kinds]
    # remove the normal prior of the limited parameters
    log_without_prior = problem.log_posterior(ridge_and_mode) + 0.5 * (
        problem.whitened(ridge_and_mode)[:, limited_columns] ** 2
    ).sum(1)
    return bool(log_without_prior[1] - log_without_prior[0] < _FALLS)


def _own(s: FloatArray, v: FloatArray) -> FloatArray:
    """Return True (free,) for each parameter that the light levels determine more than the priors
    do.

    The posterior of such a parameter is less than a third as wide as its prior, and hardly widens
    with doubled priors.
    """
    # normal posterior: in each direction the levels have the precision s², the prior 1/width²
    posterior_sd, sd_of_doubled = (
        (v.T**2 / (s**2 + prior_width**-2)).sum(1) ** 0.5 for prior_width in (1.0, 2.0)
    )
    is_determined: FloatArray = (posterior_sd < 1 / WEAK) & (
        sd_of_doubled < _MOST_WIDENING * posterior_sd
    )
    return is_determined


def _sorted_out(weak: FloatArray) -> Sequence[FloatArray]:
    """Return orthogonal undetermined directions: single parameters first, then combinations.

    Any combination of weak directions is weak as well, so that a convenient basis may be chosen.
    """
    # parameters whose axes lie almost entirely in the weak subspace
    single_columns = np.flatnonzero((weak**2).sum(0) > _ALONE**2)
    unit_directions = np.eye(weak.shape[1])[single_columns]
    _, _, combinations = np.linalg.svd(weak - (weak @ unit_directions.T) @ unit_directions)
    return [*unit_directions, *combinations[: len(weak) - len(single_columns)]]


def _limit(problem: SensorPosterior, mode: LaplaceFit, name: str) -> str:
    """Return the limit that the light levels set on a parameter: ``upper``, ``lower`` or ``none``.

    All other parameters stay at the mode.
    """
    index = problem.names.index(name)
    whitened_points = np.repeat(problem.whitened(mode.theta)[None], 2, 0)
    # row 0 far above the middle of the prior, row 1 far below it
    whitened_points[:, index] = _FAR_PRIOR_SD, -_FAR_PRIOR_SD
    samples = problem.theta(problem.coordinates.from_whitened(torch.from_numpy(whitened_points)))
    likelihood = problem.likelihood(np.concatenate([samples, mode.theta[None]]))
    log_above, log_below, log_mode = likelihood.log.nan_to_num(nan=-np.inf, neginf=-np.inf).tolist()
    falls_to = log_mode - log_above > _FALLS, log_mode - log_below > _FALLS
    return {(True, False): "upper", (False, True): "lower"}.get(falls_to, "none")


def _together(parts: Sequence[tuple[str, float]]) -> str:
    """Return a sentence on parameters that the light levels determine only in combination."""
    largest = max(parts, key=lambda pair: abs(pair[1]))
    # which parameters rise with the largest one along the direction
    other_changes = [(name, bool(x * largest[1] > 0)) for name, x in parts if name != largest[0]]
    raised = [words_of(name) for name, rises in other_changes if rises]
    lowered = [words_of(name) for name, rises in other_changes if not rises]
    changes: list[str] = []
    if raised:
        changes.append(f"more {_listed(raised)}")
    if lowered:
        changes.append(f"less {_listed(lowered)}")
    names = _listed([words_of(name) for name, _ in parts])
    return f"{names} only together: more {words_of(largest[0])} with {_listed(changes)}"


def words_of(name: str) -> str:
    """Return the name of a parameter as words."""
    return name.replace("_", " ")


def _listed(words: Sequence[str]) -> str:
    """Return words as a list in a sentence: `a, b and c`."""
    if len(words) < 2:
        return "".join(words)
    return f"{', '.join(words[:-1])} and {words[-1]}"
