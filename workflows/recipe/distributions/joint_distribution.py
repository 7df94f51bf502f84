"""Joint distributions of several values, from files of samples or of a posterior."""

from __future__ import annotations

import csv
import re
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field, replace
from glob import glob
from pathlib import Path
from typing import Any
from zipfile import BadZipFile

import numpy as np

from neusee.nodes.file_headers import npy_needs, npz_needs
from neusee.nodes.input_files import head_of, lines_of, refuse_other_than_file
from neusee.nodes.units import read_any, read_written
from neusee.workflows.graph.errors import Location
from neusee.workflows.keys import sealed_files
from neusee.workflows.keys.sealed_files import NotRegular, text_of
from neusee.workflows.recipe.distributions.shapes import FloatArray, scores_between
from neusee.workflows.recipe.text.other_spellings import POSTERIOR_NAMES
from neusee.workflows.recipe.text.recipe_files import refuse_outside

# --- sample table ---------------------------------------------------------------------------------

# Files of samples: columns of numbers in .csv, .txt, .npy and .npz files, with names and units from
# their headings.


Line = tuple[int, list[str]]  #: number and cells of a line of a table

_CELLS = 24.0  #: bytes in memory for each byte of a table: all cells as texts, and their numbers
FEWEST = 30  #: smallest number of samples that can represent a distribution
_HEADING = re.compile(r"\s*(.*?)\s*\[([^\[\]]*)\]\s*")  #: ``gain [DN/e-]``
_SUFFIXES = (".csv", ".txt", ".npy", ".npz")


def read_columns(path: Path) -> dict[str, FloatArray]:
    """Return the columns of a table of samples by heading; a column without a heading is named "".

    A .csv or .txt file without headings, and a .npy file, must have one column.
    Raises ValueError for a file that is not a table of numbers.
    """
    suffix = path.suffix.lower()
    if suffix not in _SUFFIXES:
        raise ValueError(
            f"{path.name} is not a table of samples: give a file in .csv, .txt, .npy or .npz"
        )
    refuse_other_than_file(path)
    if not path.is_file():
        raise ValueError(f"there is no file {path}")
    try:
        if suffix == ".npz":
            return _arrays(path)
        if suffix == ".npy":
            npy_needs(path, 1.0, 8.0)
            return {"": _one_column(path, np.load(path, allow_pickle=False))}
        return _text_columns(path)
    except (OSError, EOFError, BadZipFile, UnicodeDecodeError) as error:
        raise ValueError(f"{path.name} cannot be read: {error}") from None


def _arrays(path: Path) -> dict[str, FloatArray]:
    """Return the arrays of an .npz file by name, each as one column."""
    # the first bytes of every zip file
    if head_of(path, 2) != b"PK":
        raise ValueError(f"{path.name} cannot be read: the file does not have the format .npz")
    npz_needs(path, 1.0, 8.0)
    with np.load(path, allow_pickle=False) as arrays:
        return {name: np.asarray(arrays[name], np.float64).reshape(-1) for name in arrays}


def _one_column(path: Path, array: FloatArray) -> FloatArray:
    """Return the array of an .npy file as a column.

    Raise ValueError unless it is a row of real numbers.
    """
    if array.ndim != 1 or array.dtype.kind not in "fiu":
        raise ValueError(
            f"{path.name} must contain one row of real numbers, not {array.dtype} of shape"
            f" {array.shape}"
        )
    return np.asarray(array, np.float64)


def _text_columns(path: Path) -> dict[str, FloatArray]:
    """Return the columns of a .csv or .txt file by heading.

    Raise ValueError for a cell without a number.
    """
    lines = csv.reader(lines_of(path, _CELLS))
    rows = [
        (line_number, row)
        for line_number, row in enumerate(lines, 1)
        if any(cell.strip() for cell in row)
    ]
    if not rows:
        raise ValueError(f"{path.name} is empty")
    headings, rows = _take_headings(path, rows)
    for line, row in rows:
        _refuse_line(path, line, row, len(headings))
    numbers = np.array([row for _, row in rows], np.float64).reshape(-1, len(headings))
    return {name: numbers[:, i] for i, name in enumerate(headings)}


def _take_headings(path: Path, rows: list[Line]) -> tuple[list[str], list[Line]]:
    """Return the headings of a table and the lines below; a table of one column may have no
    heading.
    """
    headings = [cell.strip() for cell in rows[0][1]]
    if not all(map(_is_number, headings)):
        return headings, rows[1:]
    if len(headings) > 1:
        raise ValueError(
            f"the first line of {path.name} must have a heading for each of its columns"
        )
    return [""], rows


def _refuse_line(path: Path, line: int, row: Sequence[str], count: int) -> None:
    """Raise ValueError for a line that does not have ``count`` numbers."""
    if len(row) != count:
        raise ValueError(f"line {line} of {path.name} must have {count} values like the first line")
    for cell in row:
        if not _is_number(cell):
            raise ValueError(
                f"line {line} of {path.name} must contain numbers, not {cell.strip()!r}"
            )


def _is_number(cell: str) -> bool:
    try:
        float(cell)
    except ValueError:
        return False
    return True


def with_units(columns: Mapping[str, FloatArray]) -> tuple[dict[str, FloatArray], dict[str, str]]:
    """Return the columns by name in SI units, and their units by name, from headings such as
    ``exposure [ms]``.

    Values in ``e-/DN`` stay as they are, with this unit. A unit that recipes do not use, such as
    that of a dark current ``e- in 1 s``, stays as text. Raises ValueError for two columns of one
    name.
    """
    values: dict[str, FloatArray] = {}
    units: dict[str, str] = {}
    for heading, column in columns.items():
        match = _HEADING.fullmatch(heading)
        name = match[1] if match else heading
        if name in values:
            raise ValueError(f"two columns have the name {name}")
        values[name] = column
        if match:
            scale, units[name] = si_unit(match[2].strip())
            values[name] = column * scale
    return values, units


def si_unit(unit: str) -> tuple[float, str]:
    """Return the factor from a unit to the SI unit, and the SI unit; ``e-/DN`` and unknown units
    are kept, with the factor 1.
    """
    try:
        scale, si_text, reciprocal = read_written(f"1 {unit}".strip())
    except ValueError:
        return 1.0, unit
    return scale, unit if reciprocal else si_text


def require_samples(samples: FloatArray, name: str) -> None:
    """Raise ValueError for samples that cannot represent a distribution: too few, not finite, or
    all equal.
    """
    if not np.isfinite(samples).all():
        row = int(np.argmin(np.isfinite(samples))) + 1
        raise ValueError(f"sample {row} of {name} is {samples[row - 1]}: remove this sample")
    if len(samples) < FEWEST:
        raise ValueError(
            f"{name} has {len(samples)} samples, which are too few: give {FEWEST} or more"
        )
    if np.ptp(samples) == 0:
        raise ValueError(f"all samples of {name} are equal: write the value itself")


# --- joint ----------------------------------------------------------------------------------------

# Joint distributions of several values, from samples or from mean and covariance, and a reader of
# posterior files.


GAIN_UNIT = "DN/e-"  #: unit of the system gain K of EMVA 1288
BARE_GAIN = (
    "name its draws 'gain [DN/e-]' or 'gain [e-/DN]', or write its mean and sd with DN/e-; "
    "the folder of `neusee calibrate` contains the unit"
)
#: standard deviations around the mean that contain 90 % of a normal distribution
Z_90 = 1.6448536269514722
_LARGEST = 4_000_000  #: bytes of a posterior in JSON or YAML, at most; the same as of a recipe
_JITTER = 1e-10  #: added to the diagonal of a correlation so that its Cholesky factor exists
_FILES = (
    "the folder of `neusee calibrate`, its posterior.json, draws in .npz or .csv, or a mean and sd"
    " in .json, .yaml"
)


@dataclass(frozen=True)
class Joint:
    """Joint distribution of several values, computed from independent standard normal numbers.

    The Cholesky factor of the correlation maps the numbers to the values. A distribution from draws
    has the marginal distributions of the draws and the correlation of their normal scores (a
    Gaussian copula).
    """

    names: tuple[str, ...]
    mean: FloatArray  #: (name,)
    sd: FloatArray  #: (name,)
    factor: FloatArray  #: (name, name), lower
    draws: FloatArray | None = None  #: (draw, name)
    #: (name, 2) normal scores at which each value is cut off; None for no bounds
    bounds: FloatArray | None = None

    @classmethod
    def of_draws(cls, names: Sequence[str], draws: FloatArray) -> Joint:
        """Return the joint distribution of random draws; raise ValueError for too few,
        non-finite or constant draws.
        """
        for name, column in zip(names, draws.T, strict=True):
            require_samples(column, name)
        correlation = np.atleast_2d(np.corrcoef(_scores(draws).T))
        return cls(tuple(names), draws.mean(0), draws.std(0, ddof=1), _factor(correlation), draws)

    @classmethod
    def of_normal(
        cls, names: Sequence[str], mean: FloatArray, sd: FloatArray, correlation: FloatArray
    ) -> Joint:
        """Return a joint normal distribution; raise ValueError for an invalid correlation or
        standard deviation.
        """
        count = len(names)
        if correlation.shape != (count, count) or not np.allclose(correlation, correlation.T):
            raise ValueError(
                f"the correlation matrix must be symmetric and have the size {count} x {count}"
            )
        if not (np.isfinite(sd) & (sd > 0)).all():
            raise ValueError("every standard deviation must be greater than 0")
        if not np.allclose(np.diag(correlation), 1.0) or np.linalg.eigvalsh(correlation)[0] < -1e-9:
            raise ValueError(
                "the correlation matrix must have ones on its diagonal and no negative"
                " eigenvalue, but its least eigenvalue is"
                f" {np.linalg.eigvalsh(correlation)[0]:.3g}, so no distribution has this matrix"
            )
        return cls(tuple(names), mean, sd, _factor(correlation))

    def at(self, z: FloatArray) -> FloatArray:
        """Transform standard normal numbers ``z`` to draws of the joint distribution; both have
        the shape (…, name).
        """
        scores = z @ self.factor.T
        if self.bounds is not None:
            columns = [
                scores_between(scores[..., i], lower_bound, upper_bound)
                for i, (lower_bound, upper_bound) in enumerate(self.bounds)
            ]
            scores = np.stack(columns, -1)
        if self.draws is None:
            return np.asarray(self.mean + self.sd * scores, np.float64)
        from scipy.special import ndtr

        # rank i of n draws stands for the probability i / (n + 1), as in `_scores`
        probabilities = np.arange(1, len(self.draws) + 1) / (len(self.draws) + 1)
        columns = [
            np.interp(ndtr(scores[..., i]), probabilities, np.sort(column))
            for i, column in enumerate(self.draws.T)
        ]
        return np.stack(columns, -1)

    def numbers(self) -> FloatArray:
        """Return the standard normal numbers (draw, name) from which `at` reproduces the draws
        of the distribution.
        """
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
            lower_end, upper_end = np.quantile(self.draws[:, i], [0.05, 0.95])
            return float(lower_end), float(upper_end)
        return float(self.mean[i] - Z_90 * self.sd[i]), float(self.mean[i] + Z_90 * self.sd[i])

    def only(self, names: Sequence[str]) -> Joint:
        """Return the joint distribution of the quantities ``names``, marginalised over all other
        quantities.
        """
        columns = [self.names.index(name) for name in names]
        if self.draws is not None:
            return Joint.of_draws(names, self.draws[:, columns])
        # the bounds may have changed the covariance: it is scaled back to a correlation
        covariance = self.factor @ self.factor.T
        scale = np.sqrt(np.diag(covariance))
        joint = Joint.of_normal(
            names,
            self.mean[columns],
            self.sd[columns],
            (covariance / scale / scale[:, None])[np.ix_(columns, columns)],
        )
        return joint if self.bounds is None else replace(joint, bounds=self.bounds[columns])


def _scores(draws: FloatArray) -> FloatArray:
    """Return the normal scores (draw, name) of random draws, computed from their ranks; equal
    draws share a rank.
    """
    from scipy.special import ndtri
    from scipy.stats import rankdata

    return np.asarray(ndtri(rankdata(draws, axis=0) / (len(draws) + 1)), np.float64)


def _factor(correlation: FloatArray) -> FloatArray:
    """Return the lower Cholesky factor of a correlation matrix; a small diagonal term guards
    against rounding errors.
    """
    return np.asarray(
        np.linalg.cholesky(correlation + _JITTER * np.eye(len(correlation))), np.float64
    )


@dataclass(frozen=True)
class Posterior:
    """Posterior read from a file: the joint distribution of the values, and the kind and the
    unit of each value.
    """

    joint: Joint
    #: of `neusee calibrate`: estimate, upper, lower, none
    kinds: Mapping[str, str] = field(default_factory=dict)
    #: as text, for the values whose unit the file gives
    units: Mapping[str, str] = field(default_factory=dict)
    #: parameters in the file without draws, because the frames do not determine them
    untold: tuple[str, ...] = ()


def read_posterior(path: Path, mark: Location | None = None) -> Posterior:
    """Return the posterior in a file or in the newest file of a glob pattern; raise ValueError for
    an invalid file.

    ``mark`` is the place at which a recipe names the file.
    """
    if any(sign in str(path) for sign in "*?["):
        path = max(
            map(Path, glob(str(path))),
            # the newest, and by name among equals
            key=lambda match: (match.stat().st_mtime, match),
            default=path,
        )
    if path.is_dir():
        path = path / "posterior.json"
    if mark is not None:
        refuse_outside(path, mark)
    sealed_files.refuse_other_than_file(path)
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
    """Return the posterior in a file of `neusee calibrate`, or in a file with means and standard
    deviations.
    """
    from ruamel.yaml import YAML
    from ruamel.yaml.error import YAMLError

    try:
        doc: Any = YAML(typ="safe", pure=True).load(text_of(path, max_bytes=_LARGEST))
    except YAMLError as error:
        raise ValueError(f"{path.name} cannot be read: {' '.join(str(error).split())}") from None
    if not isinstance(doc, dict):
        raise ValueError(f"{path.name} must contain a mapping of keys to values")
    return _calibrated(doc, path, mark) if "parameters" in doc else summary(doc)


def _calibrated(doc: Mapping[str, Any], path: Path, mark: Location | None) -> Posterior:
    """Return the posterior of a calibration, whose draws are in the file ``draws.npz``
    beside it.
    """
    _refuse_failed(doc)
    joint = read_posterior(path.with_name("draws.npz"), mark).joint
    assert joint.draws is not None
    parameter_rows = {
        POSTERIOR_NAMES.get(name, name): row for name, row in doc["parameters"].items()
    }
    columns = {
        POSTERIOR_NAMES.get(name, name): x
        for name, x in zip(joint.names, joint.draws.T, strict=True)
    }
    posterior = _drawn(columns, {name: str(row["unit"]) for name, row in parameter_rows.items()})
    untold = tuple(name for name in parameter_rows if name not in columns)
    kinds = {name: str(row["kind"]) for name, row in parameter_rows.items()}
    return replace(posterior, kinds=kinds, untold=untold)


def _refuse_failed(doc: Mapping[str, Any]) -> None:
    """Raise ValueError for a calibration with a failed check."""
    if not doc.get("failed"):
        return
    failed = [check["name"] for check in doc.get("checks", ()) if check["mark"] == "fail"]
    checks = "1 check fails" if doc["failed"] == 1 else f"{doc['failed']} checks fail"
    raise ValueError(f"the calibration cannot be used: {checks} ({'; '.join(failed)})")


def _drawn(columns: Mapping[str, FloatArray], units: Mapping[str, str]) -> Posterior:
    """Return the posterior that consists of the given draws; convert draws of a gain in e-/DN to
    DN/e-.
    """
    with np.errstate(divide="ignore"):
        draws = [
            1.0 / column if units.get(name) == "e-/DN" else column
            for name, column in columns.items()
        ]
    lengths = {len(column) for column in draws}
    if not lengths:
        raise ValueError("the file contains no draws")
    if len(lengths) > 1:
        raise ValueError("the values have different numbers of draws")
    joint = Joint.of_draws(tuple(columns), np.stack(draws, 1))
    return Posterior(
        joint, units={name: GAIN_UNIT if unit == "e-/DN" else unit for name, unit in units.items()}
    )


def summary(moments: Mapping[str, Any]) -> Posterior:
    """Return the normal posterior with the given means, and with standard deviations or a
    covariance matrix.
    """
    joint = _normal(moments)
    return Posterior(
        joint, units={str(name): read_any(x)[1] for name, x in moments["mean"].items()}
    )


def _normal(moments: Mapping[str, Any]) -> Joint:
    """Return the normal distribution with the means and the spread of a summary."""
    _refuse_other_moments(moments)
    names = [str(name) for name in moments["mean"]]
    mean = np.array([_si(x) for x in moments["mean"].values()])
    if "covariance" in moments:
        return _of_covariance(names, mean, _matrix(moments["covariance"]))
    if not isinstance(moments["sd"], dict) or set(map(str, moments["sd"])) != set(names):
        raise ValueError("sd must have a value for each name in mean, and no other names")
    sd = np.array([_si(moments["sd"][name]) for name in moments["mean"]])
    correlation = (
        _matrix(moments["correlation"]) if "correlation" in moments else np.eye(len(names))
    )
    return Joint.of_normal(names, mean, sd, correlation)


def _of_covariance(names: list[str], mean: FloatArray, covariance: FloatArray) -> Joint:
    """Return the normal distribution with means and a covariance matrix.

    Raise ValueError for one without variances.
    """
    sd = np.sqrt(np.diag(covariance).clip(0)) if covariance.ndim == 2 else np.zeros(0)
    if sd.shape != mean.shape or not (sd > 0).all():
        raise ValueError(
            f"the covariance must be a matrix of {len(names)} x {len(names)} with positive"
            " variances"
        )
    return Joint.of_normal(names, mean, sd, covariance / sd / sd[:, None])


def _refuse_other_moments(moments: Mapping[str, Any]) -> None:
    """Raise ValueError for a summary without means, or without exactly one of standard deviations
    and covariance.
    """
    if strange := sorted(set(moments) - {"mean", "sd", "correlation", "covariance"}):
        raise ValueError(
            f"unknown key {strange[0]}: write mean and sd, with correlation if you know it, or"
            " mean and covariance"
        )
    if not isinstance(moments.get("mean"), dict) or ("sd" in moments) == ("covariance" in moments):
        raise ValueError(
            "a summary needs mean: {name: value}, and sd: {name: value} or covariance: [[…], …]"
        )


def _si(text: Any) -> float:
    """Return a number in SI from a text with a unit; raise ValueError for a gain in e-/DN."""
    number, _, reciprocal = read_written(text)
    if reciprocal:
        raise ValueError(f"{text}: write the mean and the sd of a gain in DN/e-")
    return number


def _matrix(rows: Any) -> FloatArray:
    """Return rows of numbers as an array.

    Raise ValueError for rows of different lengths or other values.
    """
    try:
        return np.array(rows, np.float64)
    except (TypeError, ValueError):
        raise ValueError(
            "a matrix must be a list of rows of numbers, all of the same length"
        ) from None
