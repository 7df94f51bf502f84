"""Priors of sensor and camera parameters, the coordinates of the sampler, and its start values."""

from __future__ import annotations

import inspect
import math
from collections.abc import Mapping
from dataclasses import dataclass
from functools import cached_property
from typing import Annotated, Any, ClassVar, Literal, NamedTuple, Self

import torch
from pydantic import Field
from torch import Tensor

from neusee.nodes import Check, node
from neusee.nodes.calibrate._emva_sheet import least_squares, without_histograms
from neusee.nodes.calibrate._sensor_likelihood import ROUNDED, Sufficient
from neusee.nodes.sensor._saturation import Well
from neusee.nodes.units import Efficiency, Electrons, Gain, Real
from neusee.nodes.values import Levels

# --- free parameters ------------------------------------------------------------------------------

# The priors of free parameters, and the base class of sampler coordinates.


#: geometric standard deviation: exp(standard deviation of the logarithm)
Factor = Annotated[float, Field(gt=1, le=1e6)]
Positive = Annotated[float, Field(ge=1e-12, le=1e12)]
Pair = tuple[float, float]
Known = Literal["unknown", "none"]  #: prior knowledge of a fault of the frames
#: faults that may remain hidden in frames; each multiplies the measured variance by a factor
FAULTS = ("mixing", "lag", "pattern")


class Ridge(NamedTuple):
    """A point far from a fit that may fit the same data as well, and the limits that remain if it
    does.
    """

    place: Tensor  #: (free,) sampler coordinates
    #: by parameter: "upper" or "lower", the only limit that the data then give
    kinds: Mapping[str, str]
    text: str  #: sentence for the report


class Prior(NamedTuple):
    """Independent normal distributions, one for each parameter; NaN marks a fixed parameter."""

    #: (parameter,) float64, mean of the logarithm, or of the value of a linear parameter
    centre: Tensor
    width: Tensor  #: (parameter,) float64, standard deviation of the same quantity
    #: 1 for each of `FAULTS` that may be hidden in the frames, else 0
    hidden: Tensor = torch.ones(len(FAULTS), dtype=torch.float64)

    @property
    def may_hide(self) -> tuple[str, ...]:
        """Return the names of the faults that may be hidden in the frames."""
        return tuple(fault for fault, may in zip(FAULTS, self.hidden.tolist(), strict=True) if may)


def prior_of_pairs(
    pairs: Mapping[str, Pair | None], linear: frozenset[str], **faults_known: Known
) -> Prior:
    """Build a prior from a pair of numbers for each free parameter and None for each fixed
    parameter.

    The pair is median and geometric standard deviation, or mean and standard deviation for a
    parameter in ``linear``. ``faults_known`` is "none" for each fault that the frames are known not
    to have.
    """
    centre_and_width = [_normal(name, pair, name in linear) for name, pair in pairs.items()]
    if all(math.isnan(width) for _, width in centre_and_width):
        raise ValueError(
            f"no parameter is free: give a prior of at least one of {', '.join(pairs)}"
        )
    centre, width = torch.tensor(centre_and_width, dtype=torch.float64).unbind(1)
    hidden = [float(faults_known.get(fault, "unknown") == "unknown") for fault in FAULTS]
    return Prior(centre, width, torch.tensor(hidden, dtype=torch.float64))


def free_names(names: tuple[str, ...], prior: Prior) -> tuple[str, ...]:
    """Return the names of the free parameters, which have a prior; ``names`` are those of all
    parameters.
    """
    return tuple(
        name
        for name, width in zip(names, prior.width.tolist(), strict=True)
        if not math.isnan(width)
    )


def _normal(name: str, pair: Pair | None, linear: bool) -> Pair:
    """Return mean and standard deviation of the normal prior of the logarithm of a parameter, or of
    its value if it is ``linear``; NaN twice for a parameter without a prior.

    Raises ValueError for a median or a width that is not positive.
    """
    if pair is None:
        return math.nan, math.nan
    if not pair[1] > 0 or not (linear or pair[0] > 0):
        raise ValueError(
            f"{name}: [{pair[0]:g}, {pair[1]:g}] is not a prior: median and width must be positive"
        )
    return pair if linear else (math.log(pair[0]), math.log(pair[1]))


@dataclass(frozen=True)
class Free:
    """Free parameters and their prior; each subclass defines the sampler coordinates."""

    every: ClassVar[tuple[str, ...]]  #: names of all parameters, free or fixed
    linear: ClassVar[frozenset[str]]  #: parameters that may be 0 or negative
    #: parameters that are standard deviations of the scatter of the levels
    widths: ClassVar[frozenset[str]] = frozenset()
    #: parameters whose likelihood has edges, because numbers are rounded; the last row of
    #: `Likelihood.scaled` describes the free one of these
    edged: ClassVar[frozenset[str]] = frozenset()

    #: True if the posterior may be elongated, curved or multimodal
    bent: ClassVar[bool] = False

    names: tuple[str, ...]  #: names of the free parameters
    prior: Prior
    held: Mapping[str, float]  #: values of the fixed parameters

    @classmethod
    def of(cls, prior: Prior, nominal: Mapping[str, float]) -> Self:
        """Build sampler coordinates for the free parameters of a prior; the others are fixed at
        ``nominal``.
        """
        free = free_names(cls.every, prior)
        return cls(
            free, prior, {name: float(nominal[name]) for name in cls.every if name not in free}
        )

    def draw(self, count: int, rng: torch.Generator) -> dict[str, Tensor]:
        """Draw ``count`` values of each free parameter from the prior."""
        return self.from_whitened(
            torch.randn(count, len(self.names), generator=rng, dtype=torch.float64)
        )

    def whitened(self, parameters: Mapping[str, Tensor]) -> Tensor:
        """Convert parameters to distances from the mean of the prior, in its standard
        deviations.
        """
        return (self.scaled(parameters) - self._normals.centre) / self._normals.width

    def from_whitened(self, z: Tensor) -> dict[str, Tensor]:
        """Convert distances from the mean of the prior, in its standard deviations, to
        parameters.
        """
        return self.unscaled(self._normals.centre + self._normals.width * z)

    def scaled(self, parameters: Mapping[str, Tensor]) -> Tensor:
        """Return the logarithm of each free parameter, or the value of a linear parameter (...,
        free).
        """
        values = ((name, parameters[name]) for name in self.names)
        return torch.stack([x if name in self.linear else x.log() for name, x in values], -1)

    def unscaled(self, values: Tensor) -> dict[str, Tensor]:
        """Return the free parameters from their logarithms or values: the inverse of `scaled`."""
        pairs = zip(self.names, values.unbind(-1), strict=True)
        return {name: x if name in self.linear else x.exp() for name, x in pairs}

    def ridges(self, place: Tensor) -> list[Ridge]:
        """Return points far from ``place`` (free,) that some data cannot distinguish from it; by
        default none.
        """
        return []

    @cached_property
    def _normals(self) -> Prior:
        """Return the prior of the free parameters only."""
        free = self.prior.width.isfinite()
        return Prior(self.prior.centre[free], self.prior.width[free], self.prior.hidden)


# --- sensor prior ---------------------------------------------------------------------------------

# The prior of a sensor's parameters, and sampler coordinates that are nearly uncorrelated.


_OFFSET = "offset"  #: the only linear parameter; it may be 0 or negative


@node()
def prior(
    *,
    gain: tuple[Gain, Factor] | None = None,
    offset: tuple[Electrons, Electrons] | None = None,
    read_noise: tuple[Electrons, Factor] | None = None,
    dark_current: tuple[Electrons, Factor] | None = None,
    full_well: tuple[Well, Factor] | None = None,
    quantum_efficiency: tuple[Efficiency, Factor] | None = None,
    spread: tuple[Positive, Factor] | None = None,
    mixing: Known = "unknown",
    lag: Known = "unknown",
    pattern: Known = "unknown",
) -> Prior:
    """Collect the priors of the free parameters of a sensor; a parameter without a prior is held at
    a fixed value.

    A prior is a median and a factor: [0.37, 2] means half to twice the median with a probability of
    two thirds. The prior of the offset is a mean and a standard deviation. Mixing of neighbouring
    pixels, lag between frames and patterns of unequal pixels are `none` for a sensor that is known
    to have none of it, such as a simulated one; else intervals include what may hide in the frames.

    Shapes: -> (7,).
    Units:  those of `density`.
    Error:  exact.
    Raises: ValueError where no parameter is free, or where a median or width is not positive.
    Source: log-normal and normal distributions.
    """
    pairs = (gain, offset, read_noise, dark_current, full_well, quantum_efficiency, spread)
    return prior_of_pairs(
        dict(zip(NAMES, pairs, strict=True)),
        frozenset({_OFFSET}),
        mixing=mixing,
        lag=lag,
        pattern=pattern,
    )


#: the parameters of `density` that may be free
NAMES = tuple(n for n in inspect.signature(prior.fn).parameters if n not in FAULTS)


@prior.check
def _(result: Prior, **params: object) -> list[Check]:
    free = free_names(NAMES, result)
    return [Check(f"{len(free)} free: {', '.join(free)}")]


@dataclass(frozen=True)
class Coordinates(Free):
    """Sampler coordinates of a sensor, in units of digital numbers, in which the posterior is
    nearly uncorrelated.

    Frames determine the slope of the photon-transfer curve, the offset in DN, the dark variance,
    the response and the saturation level independently of each other. Gain, offset in electrons,
    read noise and full well in electrons would be correlated by 1 - 1e-3. All coordinates except
    the offset in DN are logarithms.
    """

    every: ClassVar[tuple[str, ...]] = NAMES
    linear: ClassVar[frozenset[str]] = frozenset({_OFFSET})
    edged: ClassVar[frozenset[str]] = frozenset({"full_well"})

    @property
    def labels(self) -> tuple[str, ...]:
        """Return a readable name of each sampler coordinate."""
        label_of = {
            "gain": "ln slope of the photon-transfer curve",
            "offset": "offset, DN",
            "spread": "ln spread",
        }
        return tuple(
            label_of.get(name, f"ln {name.replace('_', ' ')} in numbers") for name in self.names
        )

    def place(self, parameters: Mapping[str, float | Tensor]) -> Tensor:
        """Convert sensor parameters to sampler coordinates (..., free parameter)."""
        all_parameters = {
            name: torch.as_tensor(parameters.get(name, self.held.get(name)), dtype=torch.float64)
            for name in NAMES
        }
        log_gain = all_parameters["gain"].log()
        return torch.stack(
            [self._coordinate(name, all_parameters, log_gain) for name in self.names], -1
        )

    def parameters(self, place: Tensor) -> dict[str, Tensor]:
        """Convert sampler coordinates (..., free parameter) to sensor parameters."""
        coordinates = dict(zip(self.names, place.unbind(-1), strict=True))
        held = {name: math.log(self.held[name]) for name in ("gain", "spread") if name in self.held}
        log_values = {
            name: torch.tensor(coordinate, dtype=torch.float64) for name, coordinate in held.items()
        } | coordinates
        # the coordinate of a free gain is ln(gain x spread^2), the log slope of the photon-transfer
        # curve
        log_gain = (
            log_values["gain"] - 2.0 * log_values["spread"]
            if "gain" in coordinates
            else log_values["gain"]
        )
        parameters = {}
        for name, coordinate in coordinates.items():
            if name == "gain":
                parameters[name] = log_gain.exp()
            elif name == _OFFSET:
                # convert the offset from DN to electrons
                parameters[name] = coordinate * (-log_gain).exp()
            else:
                # the coordinates of all others except the spread are ln(value x gain)
                parameters[name] = (coordinate if name == "spread" else coordinate - log_gain).exp()
        return parameters

    def log_prior(self, parameters: Mapping[str, Tensor]) -> Tensor:
        """Return the log prior density per unit of the sampler coordinates, up to a constant."""
        log_density = -0.5 * self.whitened(parameters).square().sum(-1)
        if _OFFSET in self.names and "gain" in self.names:
            # Jacobian of the change from offset in DN to offset in electrons
            log_density = log_density - parameters["gain"].log()
        return log_density

    def _coordinate(self, name: str, full: Mapping[str, Tensor], slope: Tensor) -> Tensor:
        """Return the sampler coordinate of the parameter ``name``; ``full`` maps names to all
        parameters, and ``slope`` is the logarithm of the gain.
        """
        if name == "gain":
            return slope + 2.0 * full["spread"].log()
        if name == _OFFSET:
            return full[name] * slope.exp()
        return full[name].log() + (0.0 if name == "spread" else slope)


# --- camera prior ---------------------------------------------------------------------------------

# The prior of a real camera's parameters, and its sampler coordinates.


_LINEAR_CAMERA_NAMES = frozenset({"dark_signal", "bend", "twist"})


@node()
def camera_prior(
    *,
    gain: tuple[Gain, Factor] | None = None,
    quantum_efficiency: tuple[Efficiency, Factor] | None = None,
    dark_signal: tuple[Real, Positive] | None = None,
    temporal_dark_noise: tuple[Electrons, Factor] | None = None,
    dark_current: tuple[Electrons, Factor] | None = None,
    scatter: tuple[Positive, Factor] | None = None,
    lamp: tuple[Positive, Factor] | None = None,
    drift: tuple[Positive, Factor] | None = None,
    bend: tuple[Real, Positive] | None = None,
    twist: tuple[Real, Positive] | None = None,
    mixing: Known = "unknown",
    lag: Known = "unknown",
) -> Prior:
    """Collect the priors of the free parameters of a camera; a parameter without a prior is held at
    a fixed value.

    A prior is a median and a factor: [0.37, 2] means half to twice the median with a probability of
    two thirds. The priors of the dark signal and of the two terms of the response are a mean and a
    standard deviation. Mixing of neighbouring pixels and lag between frames are `none` for a camera
    that is known to have neither; else intervals include what of both may hide in the frames.

    Shapes: -> (10,).
    Units:  those of `camera`.
    Error:  exact.
    Raises: ValueError where no parameter is free, or where a median or width is not positive.
    Source: log-normal and normal distributions.
    """
    dark = (dark_signal, temporal_dark_noise, dark_current)
    pairs = (gain, quantum_efficiency, *dark, scatter, lamp, drift, bend, twist)
    return prior_of_pairs(
        dict(zip(CAMERA_NAMES, pairs, strict=True)), _LINEAR_CAMERA_NAMES, mixing=mixing, lag=lag
    )


#: the parameters of `camera` that may be free
CAMERA_NAMES = tuple(n for n in inspect.signature(camera_prior.fn).parameters if n not in FAULTS)


@camera_prior.check
def _(result: Prior, **params: object) -> list[Check]:
    free = free_names(CAMERA_NAMES, result)
    return [Check(f"{len(free)} free: {', '.join(free)}")]


@dataclass(frozen=True)
class CameraCoordinates(Free):
    """Sampler coordinates of a camera: logarithms, or the values of parameters that may be 0 or
    negative.
    """

    every: ClassVar[tuple[str, ...]] = CAMERA_NAMES
    linear: ClassVar[frozenset[str]] = _LINEAR_CAMERA_NAMES
    widths: ClassVar[frozenset[str]] = frozenset({"scatter", "lamp", "drift"})

    @property
    def labels(self) -> tuple[str, ...]:
        """Return a readable name of each sampler coordinate."""
        return tuple(
            ("" if name in self.linear else "ln ") + name.replace("_", " ") for name in self.names
        )

    def place(self, parameters: Mapping[str, float | Tensor]) -> Tensor:
        """Convert camera parameters to sampler coordinates (..., free parameter)."""
        return self.scaled(
            {name: torch.as_tensor(parameters[name], dtype=torch.float64) for name in self.names}
        )

    def parameters(self, place: Tensor) -> dict[str, Tensor]:
        """Convert sampler coordinates (..., free parameter) to camera parameters."""
        return self.unscaled(place)

    def log_prior(self, parameters: Mapping[str, Tensor]) -> Tensor:
        """Return the log prior density per unit of the sampler coordinates, up to a constant."""
        return -0.5 * self.whitened(parameters).square().sum(-1)


# --- first guess ----------------------------------------------------------------------------------

# Start values of the parameters of a sensor or camera, from measured light levels.


#: ratio of the assumed full well to the brightest value, where no level reaches the full well
_WELL_FACTOR = 1.3
_LEAST_SHARE = 1e-3  #: lower limit of dark current and read noise, relative to the nominal value


def guess(
    levels: Sufficient, believed: Mapping[str, float], params: Mapping[str, Any]
) -> dict[str, float]:
    """Return the start value of each sensor parameter: a least-squares estimate, or the nominal
    value ``believed`` if there is none.

    ``params`` are the fixed parameters of `density`.

    Shapes: levels (level,); numbers by name, with the names of ``believed``.
    Units:  those of `density`.
    Error:  a start for a search, not an estimate.
    Source: EMVA Standard 1288, release 4.0 Linear, sections 6.6 to 6.8.
    """
    values = dict(believed)
    try:
        # only the levels that have a mean and a variance
        estimate = least_squares(without_histograms(Levels(*levels), levels.pixels > 0))
    except ValueError:
        return values | {"full_well": _guessed_well(levels, values, params)}
    gain = float(estimate.gain)
    # electrons in `dark_exposure`, the exposure for which the parameter is defined
    dark_electrons = float(estimate.dark_current) * params["dark_exposure"]
    shortest_dark = levels.exposure[levels.photons == 0].min()
    # dark electrons in the shortest dark level; its mean also contains the offset
    dark_of_shortest = (
        float(shortest_dark)
        / params["dark_exposure"]
        * (dark_electrons if dark_electrons > 0 else 0.0)
    )
    values |= {
        "gain": gain,
        "quantum_efficiency": float(estimate.efficiency),
        # index 0 of `ROUNDED` is the shift of the mean by rounding, DN
        "offset": (float(estimate.dark_signal) - ROUNDED[params["rounding"]][0]) / gain
        - dark_of_shortest,
        "read_noise": max(
            float(estimate.temporal_dark_noise), _LEAST_SHARE * believed["read_noise"]
        ),
        "dark_current": dark_electrons
        if dark_electrons > 0
        else _LEAST_SHARE * believed["dark_current"],
    }
    return values | {"full_well": _guessed_well(levels, values, params)}


def guess_camera(
    levels: Levels, believed: Mapping[str, float], params: Mapping[str, Any]
) -> dict[str, float]:
    """Return the start value of each camera parameter: a least-squares estimate, or the nominal
    value ``believed`` if there is none.

    ``params`` are the fixed parameters of `camera`.

    Shapes: levels (level,); numbers by name, with the names of ``believed``.
    Units:  those of `camera`.
    Error:  a start for a search, not an estimate.
    Raises: ValueError where `least_squares` raises ValueError.
    Source: EMVA Standard 1288, release 4.0 Linear, sections 6.6 to 6.8.
    """
    estimate = least_squares(levels, share=params["share"])
    gain = float(estimate.gain)
    values = {
        "gain": gain,
        "quantum_efficiency": float(estimate.efficiency),
        "dark_signal": float(estimate.dark_signal),
        "temporal_dark_noise": float(estimate.temporal_dark_noise),
        # electrons in one `dark_exposure`, as the parameter is defined
        "dark_current": float(estimate.dark_current) * params["dark_exposure"],
    }
    # only the dark signal may be 0 or negative
    usable_values = {
        name: x
        for name, x in values.items()
        if math.isfinite(x) and (x > 0 or name == "dark_signal")
    }
    return {**believed, **usable_values}


def _guessed_well(
    levels: Sufficient, values: Mapping[str, float], params: Mapping[str, Any]
) -> float:
    """Return a start value of the full well in electrons: where pixel values pile up below the
    range of the converter, or, if they do not, above every value.
    """
    largest_number, rounding_shift, gain = (
        2 ** params["bits"] - 1,
        ROUNDED[params["rounding"]][0],
        float(values["gain"]),
    )
    means = levels.mean[levels.pixels > 0]
    brightest = max([*means.tolist(), *levels.cell_value.tolist()], default=0.0)
    top_cells = levels.cell_value >= brightest - 2
    # a pile: the three brightest values together have over half the count of the most frequent
    # value
    has_pile = bool(top_cells.any()) and float(levels.cell_count[top_cells].sum()) > 0.5 * float(
        levels.cell_count.max()
    )
    if has_pile and brightest < largest_number:
        counts = levels.cell_count[top_cells]
        return (
            float((levels.cell_value[top_cells] * counts).sum() / counts.sum() - rounding_shift)
            / gain
        )
    # a full well above the brightest value does not change the likelihood
    return max(values["full_well"], _WELL_FACTOR * min(brightest + 1, torch.inf) / gain)
