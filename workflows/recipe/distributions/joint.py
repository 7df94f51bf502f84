"""Joint distributions of several values, from samples or from mean and covariance, and a reader of posterior files."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field, replace
from glob import glob
from pathlib import Path
from typing import Any

import numpy as np

from neusee.nodes.units import read_any, read_written
from neusee.workflows.graph.diagnostics import Location
from neusee.workflows.keys.regular_file import NotRegular, refuse_other_than_file, text_of
from neusee.workflows.recipe.distributions.sample_table import read_columns, require_samples, with_units
from neusee.workflows.recipe.distributions.shapes import FloatArray, scores_between
from neusee.workflows.recipe.text.named_files import refuse_outside
from neusee.workflows.recipe.text.renamed_keys import POSTERIOR_NAMES

GAIN_UNIT = "DN/e-"  #: unit of the system gain K of EMVA 1288
BARE_GAIN = (
    "name its draws 'gain [DN/e-]' or 'gain [e-/DN]', or write its mean and sd with DN/e-; "
    "the folder of `neusee calibrate` contains the unit"
)
Z_90 = 1.6448536269514722  #: standard deviations around the mean that contain 90 % of a normal distribution
_LARGEST = 4_000_000  #: bytes of a posterior that is a document, as of a recipe
_JITTER = 1e-10  #: added to the diagonal of a correlation so that its Cholesky factor exists
_FILES = "the folder of `neusee calibrate`, its posterior.json, draws in .npz or .csv, or a mean and sd in .json, .yaml"


@dataclass(frozen=True)
class Joint:
    """Joint distribution of several values, computed from independent standard normal numbers.

    The Cholesky factor of the correlation maps the numbers to the values. A distribution from draws has the marginal
    distributions of the draws and the correlation of their normal scores (a Gaussian copula).
    """

    names: tuple[str, ...]
    mean: FloatArray  #: (name,)
    sd: FloatArray  #: (name,)
    factor: FloatArray  #: (name, name), lower
    draws: FloatArray | None = None  #: (draw, name)
    bounds: FloatArray | None = None  #: (name, 2) normal scores at which each value is cut off; None for no bounds

    @classmethod
    def of_draws(cls, names: Sequence[str], draws: FloatArray) -> Joint:
        """Return the joint distribution of random draws; raise ValueError for too few, non-finite or constant draws."""
        for name, column in zip(names, draws.T, strict=True):
            require_samples(column, name)
        correlation = np.atleast_2d(np.corrcoef(_scores(draws).T))
        return cls(tuple(names), draws.mean(0), draws.std(0, ddof=1), _factor(correlation), draws)

    @classmethod
    def of_normal(cls, names: Sequence[str], mean: FloatArray, sd: FloatArray, correlation: FloatArray) -> Joint:
        """Return a joint normal distribution; raise ValueError for an invalid correlation or standard deviation."""
        count = len(names)
        if correlation.shape != (count, count) or not np.allclose(correlation, correlation.T):
            raise ValueError(f"the correlation matrix must be symmetric and have the size {count} x {count}")
        if not (np.isfinite(sd) & (sd > 0)).all():
            raise ValueError("every standard deviation must be greater than 0")
        if not np.allclose(np.diag(correlation), 1.0) or np.linalg.eigvalsh(correlation)[0] < -1e-9:
            raise ValueError(
                "the correlation matrix must have ones on its diagonal and no negative eigenvalue; the least "
                f"eigenvalue is {np.linalg.eigvalsh(correlation)[0]:.3g}, so that no distribution has this matrix"
            )
        return cls(tuple(names), mean, sd, _factor(correlation))

    def at(self, z: FloatArray) -> FloatArray:
        """Transform standard normal numbers ``z`` to draws of the joint distribution; both have the shape (…, name)."""
        score = z @ self.factor.T
        if self.bounds is not None:
            columns = [scores_between(score[..., i], low, high) for i, (low, high) in enumerate(self.bounds)]
            score = np.stack(columns, -1)
        if self.draws is None:
            return np.asarray(self.mean + self.sd * score, np.float64)
        from scipy.special import ndtr

        share = np.arange(1, len(self.draws) + 1) / (len(self.draws) + 1)
        columns = [np.interp(ndtr(score[..., i]), share, np.sort(x)) for i, x in enumerate(self.draws.T)]
        return np.stack(columns, -1)

    def numbers(self) -> FloatArray:
        """Return the standard normal numbers (draw, name) from which `at` reproduces the draws of the distribution."""
        assert self.draws is not None
        return np.asarray(np.linalg.solve(self.factor, _scores(self.draws).T).T, np.float64)

    def below(self, name: str, value: float) -> float:
        """Return the probability that the quantity ``name`` is less than ``value``."""
        i = self.names.index(name)
        if self.draws is not None:
            return float((self.draws[:, i] < value).mean())
        from scipy.special import ndtr

        return float(ndtr((value - self.mean[i]) / self.sd[i]))

    def interval(self, name: str) -> tuple[float, float]:
        """Return the 5 % and the 95 % quantile of the quantity ``name``."""
        i = self.names.index(name)
        if self.draws is not None:
            low, high = np.quantile(self.draws[:, i], [0.05, 0.95])
            return float(low), float(high)
        return float(self.mean[i] - Z_90 * self.sd[i]), float(self.mean[i] + Z_90 * self.sd[i])

    def only(self, names: Sequence[str]) -> Joint:
        """Return the joint distribution of the quantities ``names``, marginalised over all other quantities."""
        at = [self.names.index(name) for name in names]
        if self.draws is not None:
            return Joint.of_draws(names, self.draws[:, at])
        whole = self.factor @ self.factor.T
        scale = np.sqrt(np.diag(whole))
        joint = Joint.of_normal(names, self.mean[at], self.sd[at], (whole / scale / scale[:, None])[np.ix_(at, at)])
        return joint if self.bounds is None else replace(joint, bounds=self.bounds[at])


def _scores(draws: FloatArray) -> FloatArray:
    """Return the normal scores (draw, name) of random draws, computed from their ranks; equal draws share a rank."""
    from scipy.special import ndtri
    from scipy.stats import rankdata

    return np.asarray(ndtri(rankdata(draws, axis=0) / (len(draws) + 1)), np.float64)


def _factor(correlation: FloatArray) -> FloatArray:
    return np.asarray(np.linalg.cholesky(correlation + _JITTER * np.eye(len(correlation))), np.float64)


@dataclass(frozen=True)
class Posterior:
    """Posterior read from a file: the joint distribution of the values, and the kind and the unit of each value."""

    joint: Joint
    kinds: Mapping[str, str] = field(default_factory=dict)  #: of `neusee calibrate`: estimate, upper, lower, none
    units: Mapping[str, str] = field(default_factory=dict)  #: as text, for the values whose unit the file gives
    untold: tuple[str, ...] = ()  #: names that the file has without draws, because no frame tells them


def read_posterior(path: Path, mark: Location | None = None) -> Posterior:
    """Return the posterior in a file or in the newest file of a glob pattern; raise ValueError for an invalid file.

    ``mark`` is the place at which a recipe names the file.
    """
    if any(sign in str(path) for sign in "*?["):
        path = max(map(Path, glob(str(path))), key=lambda each: (each.stat().st_mtime, each), default=path)
    if path.is_dir():
        path = path / "posterior.json"
    if mark is not None:
        refuse_outside(path, mark)
    refuse_other_than_file(path)
    if not path.is_file():
        raise ValueError(f"there is no posterior file {path}: give {_FILES}")
    try:
        if path.suffix in (".npz", ".csv"):
            return _drawn(*with_units(read_columns(path)))
        if path.suffix in (".json", ".yaml", ".yml"):
            return _document(path, mark)
    except NotRegular:
        raise
    except (OSError, KeyError, TypeError, UnicodeDecodeError) as error:
        raise ValueError(f"{path.name} cannot be read as a posterior: {error!r}") from None
    raise ValueError(f"{path.name} is not a posterior file: give {_FILES}")


def _document(path: Path, mark: Location | None) -> Posterior:
    """Return the posterior in a file of `neusee calibrate`, or in a file with means and standard deviations."""
    from ruamel.yaml import YAML
    from ruamel.yaml.error import YAMLError

    try:
        doc: Any = YAML(typ="safe", pure=True).load(text_of(path, most=_LARGEST))
    except YAMLError as error:
        raise ValueError(f"{path.name} cannot be read: {' '.join(str(error).split())}") from None
    if not isinstance(doc, dict):
        raise ValueError(f"{path.name} must contain a mapping of keys to values")
    if "parameters" not in doc:
        return summary(doc)
    if doc.get("failed"):
        failed = [check["name"] for check in doc.get("checks", ()) if check["mark"] == "fail"]
        checks = "1 check fails" if doc["failed"] == 1 else f"{doc['failed']} checks fail"
        raise ValueError(f"the calibration cannot be used: {checks} ({'; '.join(failed)})")
    joint = read_posterior(path.with_name("draws.npz"), mark).joint
    assert joint.draws is not None
    rows = {POSTERIOR_NAMES.get(name, name): row for name, row in doc["parameters"].items()}
    columns = {POSTERIOR_NAMES.get(name, name): x for name, x in zip(joint.names, joint.draws.T, strict=True)}
    posterior = _drawn(columns, {name: str(row["unit"]) for name, row in rows.items()})
    untold = tuple(name for name in rows if name not in columns)
    return replace(posterior, kinds={name: str(row["kind"]) for name, row in rows.items()}, untold=untold)


def _drawn(columns: Mapping[str, FloatArray], units: Mapping[str, str]) -> Posterior:
    """Return the posterior that consists of the given draws; convert draws of a gain in e-/DN to DN/e-."""
    with np.errstate(divide="ignore"):
        draws = [1.0 / x if units.get(name) == "e-/DN" else x for name, x in columns.items()]
    lengths = {len(x) for x in draws}
    if len(lengths) != 1:
        raise ValueError("the values have different numbers of draws" if lengths else "the file contains no draws")
    joint = Joint.of_draws(tuple(columns), np.stack(draws, 1))
    return Posterior(joint, units={name: GAIN_UNIT if unit == "e-/DN" else unit for name, unit in units.items()})


def summary(given: Mapping[str, Any]) -> Posterior:
    """Return the normal posterior with the given means, and with standard deviations or a covariance matrix."""
    joint = _normal(given)
    return Posterior(joint, units={str(name): read_any(x)[1] for name, x in given["mean"].items()})


def _normal(given: Mapping[str, Any]) -> Joint:
    if strange := sorted(set(given) - {"mean", "sd", "correlation", "covariance"}):
        raise ValueError(f"unknown key {strange[0]}: give mean, sd and perhaps correlation, or mean and covariance")
    if not isinstance(given.get("mean"), dict) or ("sd" in given) == ("covariance" in given):
        raise ValueError("a summary needs mean: {name: value}, and either sd: {name: value} or covariance: [[…], …]")
    names = [str(name) for name in given["mean"]]
    mean = np.array([_si(x) for x in given["mean"].values()])
    if "covariance" in given:
        covariance = _matrix(given["covariance"])
        sd = np.sqrt(np.diag(covariance).clip(0)) if covariance.ndim == 2 else np.zeros(0)
        if sd.shape != mean.shape or not (sd > 0).all():
            raise ValueError(f"the covariance must be a matrix of {len(names)} x {len(names)} with positive variances")
        return Joint.of_normal(names, mean, sd, covariance / sd / sd[:, None])
    if not isinstance(given["sd"], dict) or set(map(str, given["sd"])) != set(names):
        raise ValueError("sd must have a value for each name in mean, and no other names")
    sd = np.array([_si(given["sd"][name]) for name in given["mean"]])
    correlation = _matrix(given["correlation"]) if "correlation" in given else np.eye(len(names))
    return Joint.of_normal(names, mean, sd, correlation)


def _si(text: Any) -> float:
    number, _, reciprocal = read_written(text)
    if reciprocal:
        raise ValueError(f"{text}: write the mean and the sd of a gain in DN/e-")
    return number


def _matrix(given: Any) -> FloatArray:
    try:
        return np.array(given, np.float64)
    except (TypeError, ValueError):
        raise ValueError("a matrix must be a list of rows of numbers, all of the same length") from None
