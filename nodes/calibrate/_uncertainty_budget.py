"""The uncertainty budget of a quantity: contributions, combined and expanded uncertainty (GUM).

Some contributions come from a laboratory's statements on its light and temperature.
"""

from __future__ import annotations

import math
import re
from collections.abc import Iterable, Iterator, Mapping
from dataclasses import dataclass, field
from typing import Annotated, Any, Literal

from pydantic import BeforeValidator, Field

from neusee.nodes.parameters import ParameterModel
from neusee.nodes.units import Linewidth, Wavelength, read_quantity

COVERAGE = 0.95  #: coverage probability of the expanded uncertainty
NOT_STATED, NOT_INVOLVED = "not stated", "does not enter"


@dataclass(frozen=True)
class Contribution:
    """The contribution of one source of uncertainty: a line of the budget of a quantity.

    If ``uncertainty`` is None, ``reason`` says why: the source is not stated, or does not affect
    the quantity.
    """

    source: str
    #: type A, evaluated from a series of observations, or type B, by other means
    kind: Literal["A", "B"]
    distribution: str = "normal"
    uncertainty: float | None = None  #: u(x), standard uncertainty of the input
    unit: str = ""  #: of the input
    sensitivity: float = 1.0  #: c = dy/dx, unit of the quantity per unit of the input
    freedom: float = math.inf  #: nu, degrees of freedom of u(x)
    reason: str = ""

    @property
    def share(self) -> float | None:
        """Return u(y) = |c| u(x) in the unit of the quantity, or None for a source without an
        uncertainty.
        """
        return None if self.uncertainty is None else abs(self.sensitivity) * self.uncertainty


@dataclass(frozen=True)
class Budget:
    """The uncertainty budget of a quantity, whose sources are independent of each other."""

    key: str
    name: str
    symbol: str
    unit: str
    value: float
    contributions: tuple[Contribution, ...] = field(default_factory=tuple)

    @property
    def combined(self) -> float:
        """Return the combined standard uncertainty u_c(y) (GUM, equation 10)."""
        return math.hypot(*_shares(self.contributions), 0.0)

    @property
    def freedom(self) -> float:
        """Return the effective degrees of freedom of the combined uncertainty (GUM, equation
        G.2b).
        """
        return welch_satterthwaite(self.contributions)

    @property
    def factor(self) -> float:
        """Return the coverage factor k of Student's t distribution for `COVERAGE` (GUM, G.3)."""
        return coverage_factor(self.freedom)

    @property
    def expanded(self) -> float:
        """Return the expanded uncertainty U = k u_c(y)."""
        return self.factor * self.combined

    @property
    def missing(self) -> tuple[str, ...]:
        """Return the sources that are not stated and therefore missing from the combined
        uncertainty.
        """
        return tuple(
            c.source
            for c in self.contributions
            if c.uncertainty is None and c.reason != NOT_INVOLVED
        )


def welch_satterthwaite(contributions: Iterable[Contribution]) -> float:
    """Return the effective degrees of freedom of a sum of independent contributions; infinite if
    all are infinite.

    Shapes: scalars.
    Units:  those of the quantity.
    Source: JCGM 100:2008 (GUM), equation G.2b.
    """
    shares = [(c.share, c.freedom) for c in contributions if c.share]
    total = math.hypot(*(share for share, _ in shares), 0.0)
    quotient = math.fsum((share / total) ** 4 / freedom for share, freedom in shares)
    return 1.0 / quotient if quotient > 0 else math.inf


def coverage_factor(freedom: float, probability: float = COVERAGE) -> float:
    """Return the coverage factor k: the interval of +-k standard uncertainties has the given
    coverage probability.

    Shapes: scalars.
    Units:  none.
    Source: JCGM 100:2008 (GUM), G.3 and G.6.4: whole degrees of freedom, rounded down.
    """
    from scipy.stats import norm, t

    quantile = (1 + probability) / 2
    if not math.isfinite(freedom):
        return float(norm.ppf(quantile))
    return float(t.ppf(quantile, max(1, math.floor(freedom))))


def _shares(contributions: Iterable[Contribution]) -> list[float]:
    return [c.share for c in contributions if c.share is not None]


# --- traceability ---------------------------------------------------------------------------------

# A laboratory's statements on its light and its temperature, which make its values traceable to a
# standard.


_CELSIUS = re.compile(r"([-+]?\d+(?:\.\d+)?)\s*(°C|C|degC)?")
_ZERO_CELSIUS = 273.15  #: K

Relative = Annotated[float, Field(gt=0, lt=1)]  #: a standard uncertainty over its value
Finite = Annotated[float, Field(ge=-100, le=100)]
Text = Annotated[str, BeforeValidator(lambda value: str(value).strip()), Field(min_length=1)]


def _temperature(value: Any) -> float:
    """Return a temperature such as ``25 °C`` or ``298 K`` in kelvin."""
    match = _CELSIUS.fullmatch(str(value).strip())
    # refuse a number without a unit
    if match and not match[2]:
        raise ValueError(f"needs a unit: write {value} °C or {value} K")
    kelvin = float(match[1]) + _ZERO_CELSIUS if match else read_quantity(value, "K")
    if not 0 < kelvin < math.inf:
        raise ValueError(f"{value} is not a temperature: write it as 25 °C or 298 K")
    return kelvin


class Statement(ParameterModel):
    """Base class of a laboratory's statements; an unknown key is an error."""


class Photometry(Statement):
    """Calibration of the light: uncertainty of the numbers of photons, certificate and
    laboratory.
    """

    #: relative: known only up to a factor, so that no quantum efficiency follows
    known: Literal["absolute", "relative"] = "absolute"
    #: standard uncertainty of the photons over their number
    relative_uncertainty: Relative | None = None
    distribution: Literal["normal", "rectangular"] = "normal"
    degrees_of_freedom: Annotated[float, Field(ge=1, le=math.inf, allow_inf_nan=True)] = math.inf
    certificate: Text | None = None  #: number of the certificate
    date: Text | None = None
    laboratory: Text | None = None
    instrument: Text | None = None


class Lamp(Statement):
    """The lamp: its spectrum, and the possible drift of its light since calibration."""

    spectrum: Text | None = None  #: in words, or the name of a file
    centroid: Wavelength | None = None
    centroid_uncertainty: Linewidth | None = None  #: standard uncertainty
    fwhm: Linewidth | None = None
    efficiency_per_nm: Finite | None = None  #: relative change of the quantum efficiency per nm
    #: relative standard uncertainty, from the calibration of the light to the frames
    drift: Relative | None = None


class SensorTemperature(Statement):
    """The temperature of the sensor, and the temperature coefficients of its parameters."""

    value: (
        Annotated[
            float, Field(gt=0, le=1e4), BeforeValidator(_temperature, json_schema_input_type=str)
        ]
        | None
    ) = None  #: K
    uncertainty: (
        Annotated[float, Field(gt=0, le=1e6), BeforeValidator(lambda x: read_quantity(x, "K"))]
        | None
    ) = None
    coefficients: Mapping[str, Finite] = Field(default_factory=dict)  #: 1/K, by parameter

    @property
    def text(self) -> str | None:
        """Return the temperature as text, such as ``25 °C``, or None."""
        return None if self.value is None else f"{self.value - _ZERO_CELSIUS:.4g} °C"


class Traceability(Statement):
    """A laboratory's statements on its photons, its lamp and its temperature: the recipe key
    ``traceability``.
    """

    photons: Photometry = Photometry()
    lamp: Lamp = Lamp()
    temperature: SensorTemperature = SensorTemperature()


# --- laboratory -----------------------------------------------------------------------------------

# A laboratory's statements as contributions to the uncertainty of a quantity.


PHOTOMETRY = "photometric calibration of the light"
LAMP_DRIFT = "drift of the lamp since its calibration"
WAVELENGTH = "centroid wavelength of the lamp"
TEMPERATURE = "temperature"


@dataclass(frozen=True)
class Laboratory:
    """Relative standard uncertainties of the light, and the uncertainty of the temperature; None
    for a value that is not stated.
    """

    photons: float | None = None  #: relative, of the number of photons
    photons_distribution: str = "normal"
    photons_freedom: float = math.inf
    drift: float | None = None  #: relative, of the lamp between its calibration and the frames
    wavelength: float | None = None  #: nm, standard uncertainty of the centroid
    slope: float | None = None  #: relative change of the quantum efficiency per nm
    temperature: float | None = None  #: K, standard uncertainty
    #: relative change per K, by quantity
    coefficients: Mapping[str, float] = field(default_factory=dict)

    @property
    def light(self) -> list[tuple[str, float]]:
        """Return distribution and relative standard uncertainty of each stated source that affects
        the quantum efficiency.
        """
        sources = [(self.photons_distribution, self.photons), ("normal", self.drift)]
        if self.wavelength is not None and self.slope is not None:
            sources.append(("normal", abs(self.slope) * self.wavelength))
        return [(law, u) for law, u in sources if u]


def laboratory_contributions(
    name: str, value: float, photons: float, laboratory: Laboratory
) -> Iterator[Contribution]:
    """Yield the contributions of light and temperature to the uncertainty of the quantity ``name``.

    ``photons`` is dy/ds for a common relative change s of the numbers of photons; 0 if the light
    does not affect the quantity. A change of the quantum efficiency with the wavelength acts like
    the opposite change of the photons.

    Shapes: scalars.
    Units:  ``value`` and ``photons`` those of the quantity.
    Source: JCGM 100:2008 (GUM), sections 4.3 and 5.1.
    """
    yield _of_light(
        PHOTOMETRY,
        laboratory.photons,
        photons,
        laboratory.photons_distribution,
        laboratory.photons_freedom,
    )
    yield _of_light(LAMP_DRIFT, laboratory.drift, photons)
    slope = laboratory.slope
    if not photons:
        yield Contribution(WAVELENGTH, "B", reason=NOT_INVOLVED)
    elif laboratory.wavelength is None or slope is None:
        lacking = "" if laboratory.wavelength is None else ": no change of the efficiency per nm"
        yield Contribution(WAVELENGTH, "B", reason=NOT_STATED + lacking)
    else:
        yield Contribution(WAVELENGTH, "B", "normal", laboratory.wavelength, "nm", -slope * photons)
    yield _of_temperature(name, value, laboratory)


def _of_light(
    source: str,
    stated: float | None,
    sensitivity: float,
    law: str = "normal",
    freedom: float = math.inf,
) -> Contribution:
    """Return the contribution of a source of uncertainty of the light: ``stated`` is its relative
    standard uncertainty (None if not stated), ``sensitivity`` is dy/ds for a relative change s of
    the light.
    """
    if not sensitivity:
        return Contribution(source, "B", reason=NOT_INVOLVED)
    if stated is None:
        return Contribution(source, "B", reason=NOT_STATED)
    return Contribution(source, "B", law, stated, "relative", sensitivity, freedom)


def _of_temperature(name: str, value: float, laboratory: Laboratory) -> Contribution:
    """Return the contribution of the temperature's uncertainty to the quantity ``name``, by its
    temperature coefficient in 1/K.
    """
    coefficient = laboratory.coefficients.get(name)
    if laboratory.temperature is None:
        return Contribution(TEMPERATURE, "B", reason=NOT_STATED)
    if coefficient is None:
        return Contribution(
            TEMPERATURE, "B", reason=f"{NOT_STATED}: no coefficient of this quantity"
        )
    return Contribution(
        TEMPERATURE, "B", "normal", laboratory.temperature, "K", coefficient * value
    )
