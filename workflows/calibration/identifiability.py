"""Identifiability of a sensor: which parameters the levels determine, in words, before anything is drawn."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import TYPE_CHECKING

import numpy as np

from neusee.workflows.calibration.log_posterior import SensorPosterior
from neusee.workflows.calibration.posterior_mode import LaplaceFit

if TYPE_CHECKING:
    from neusee.workflows.calibration.log_posterior import FloatArray

WEAK = 3.0  #: standard deviations of the prior by one of the levels: below, the prior says more than the frames
_PART = 0.1  #: of a direction's length, from which a parameter counts as part of it
_ALONE = 0.97
_WIDER = 1.25  #: by which priors twice as wide may widen a parameter that the levels determine
_FAR = 3.0  #: standard deviations of the prior at which a limit is looked for
_FALLS = 4.0  #: nats by which the levels must contradict a value for a limit

KINDS = {"estimate": "", "upper": "only an upper limit", "lower": "only a lower limit", "none": "not from these frames"}


@dataclass(frozen=True)
class Identifiability:
    """What the levels determine of the parameters."""

    kinds: dict[str, str]  #: one of `KINDS` for each parameter
    directions: Sequence[str]  #: what the levels do not determine, a sentence each
    strengths: Sequence[float]  #: singular values, the largest first, one for each free parameter
    refused: str  #: why nothing can be sampled from; empty where it can

    @property
    def estimated(self) -> tuple[str, ...]:
        """Return the parameters whose value the levels determine."""
        return tuple(name for name, kind in self.kinds.items() if kind == "estimate")


def identify(problem: SensorPosterior, mode: LaplaceFit) -> Identifiability:
    """Return what the levels determine, by singular values of their slopes per standard deviation of the prior."""
    _, s, v = np.linalg.svd(mode.scaled_slopes)
    s = np.concatenate([s, np.zeros(len(v) - len(s))])
    kinds = {n: "estimate" if own else "none" for n, own in zip(problem.names, _own(s, v), strict=True)}
    weak = _sorted_out(v[s < WEAK])
    said = []
    for row in weak:
        parts = [(n, x) for n, x in zip(problem.names, row, strict=True) if abs(x) >= _PART]
        if len(parts) == 1 or max(abs(x) for _, x in parts) > _ALONE:
            name = max(parts, key=lambda part: abs(part[1]))[0]
            kinds[name] = _limit(problem, mode, name)
            said.append(f"{_plain(name)}: {KINDS[kinds[name]]}{_reason(name, kinds[name])}")
        else:
            said.append(_together(parts))
    refused = ""
    if 2 * len(weak) > len(problem.names):
        refused = (
            f"{len(weak)} of {len(problem.names)} parameters cannot be determined from these frames: {'; '.join(said)}"
        )
    return Identifiability(kinds, said, s.tolist(), refused)


def _own(s: FloatArray, v: FloatArray) -> FloatArray:
    """Return for each parameter (free,) whether the levels determine it, and not the prior.

    Neither its own prior nor all of them together decide: priors twice as wide leave its width as it is.
    """
    sd, wide = ((v.T**2 / (s**2 + width**-2)).sum(1) ** 0.5 for width in (1.0, 2.0))
    own: FloatArray = (sd < 1 / WEAK) & (wide < _WIDER * sd)
    return own


def _sorted_out(weak: FloatArray) -> Sequence[FloatArray]:
    """Return the same directions, those of one parameter alone first: any mixture of two is as weak as they are."""
    alone = np.flatnonzero((weak**2).sum(0) > _ALONE**2)
    units = np.eye(weak.shape[1])[alone]
    _, _, v = np.linalg.svd(weak - (weak @ units.T) @ units)
    return [*units, *v[: len(weak) - len(alone)]]


def _limit(problem: SensorPosterior, mode: LaplaceFit, name: str) -> str:
    """Return the side on which the levels contradict a parameter, with all others left where they are."""
    at = problem.names.index(name)
    z = np.repeat(problem.whitened(mode.theta)[None], 2, 0)
    z[:, at] = _FAR, -_FAR
    import torch

    samples = problem.theta(problem.coordinates.from_whitened(torch.from_numpy(z)))
    log = (
        problem.likelihood(np.concatenate([samples, mode.theta[None]]))
        .log.nan_to_num(nan=-np.inf, neginf=-np.inf)
        .tolist()
    )
    falls = [log[2] - one > _FALLS for one in log[:2]]
    return {(True, False): "upper", (False, True): "lower"}.get((falls[0], falls[1]), "none")


def _together(parts: Sequence[tuple[str, float]]) -> str:
    """Return a sentence about parameters that only the prior distinguishes."""
    first = max(parts, key=lambda part: abs(part[1]))
    rest = [(name, bool(x * first[1] > 0)) for name, x in parts if name != first[0]]
    more, less = ([_plain(name) for name, same in rest if same is up] for up in (True, False))
    said = [f"more {_listed(more)}"] * bool(more) + [f"less {_listed(less)}"] * bool(less)
    return f"{_listed([_plain(name) for name, _ in parts])} only together: more {_plain(first[0])} with {_listed(said)}"


def _reason(name: str, kind: str) -> str:
    """Return which frames are missing."""
    helps = {
        ("full_well", "lower"): ": no frame is saturated by the well",
        ("dark_current", "upper"): ": no dark was exposed for long enough",
        ("dark_current", "none"): ": no dark was exposed for long enough",
        ("read_noise", "upper"): ": the converter is too coarse for it",
    }
    return helps.get((name, kind), "")


def _plain(name: str) -> str:
    return name.replace("_", " ")


def _listed(words: Sequence[str]) -> str:
    return " and ".join([", ".join(words[:-1]), words[-1]] if len(words) > 1 else words)
