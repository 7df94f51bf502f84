"""What a laboratory states of its light and its temperature, as contributions to the uncertainty of a quantity."""

from __future__ import annotations

import math
from collections.abc import Iterator, Mapping
from dataclasses import dataclass, field

from neusee.nodes.calibrate._budget._uncertainty_budget import NOT_INVOLVED, NOT_STATED, Contribution

PHOTOMETRY = "photometric calibration of the light"
LAMP_DRIFT = "drift of the lamp since its calibration"
WAVELENGTH = "centroid wavelength of the lamp"
TEMPERATURE = "temperature"


@dataclass(frozen=True)
class Laboratory:
    """Relative standard uncertainties of the light, and the uncertain temperature; None for what is not stated."""

    photons: float | None = None  #: relative, of the number of photons
    photons_distribution: str = "normal"
    photons_freedom: float = math.inf
    drift: float | None = None  #: relative, of the lamp between its calibration and the frames
    wavelength: float | None = None  #: nm, standard uncertainty of the centroid
    slope: float | None = None  #: relative change of the quantum efficiency per nm
    temperature: float | None = None  #: K, standard uncertainty
    coefficients: Mapping[str, float] = field(default_factory=dict)  #: relative change per K, by quantity

    @property
    def light(self) -> list[tuple[str, float]]:
        """Return distribution and relative standard uncertainty of each stated source of the quantum efficiency."""
        found = [(self.photons_distribution, self.photons), ("normal", self.drift)]
        if self.wavelength is not None and self.slope is not None:
            found.append(("normal", abs(self.slope) * self.wavelength))
        return [(law, u) for law, u in found if u]


def laboratory_contributions(name: str, value: float, photons: float, laboratory: Laboratory) -> Iterator[Contribution]:
    """Yield what light and temperature add to the uncertainty of the quantity ``name``.

    ``photons`` is dy/ds for a common relative change s of the numbers of photons, 0 where the light does not enter. A
    change of the quantum efficiency with the wavelength acts as the opposite change of the photons.

    Shapes: scalars.
    Units:  ``value`` and ``photons`` those of the quantity.
    Source: JCGM 100:2008 (GUM), sections 4.3 and 5.1.
    """
    yield _of_light(PHOTOMETRY, laboratory.photons, photons, laboratory.photons_distribution,
                    laboratory.photons_freedom)  # fmt: skip
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
    source: str, stated: float | None, sensitivity: float, law: str = "normal", freedom: float = math.inf
) -> Contribution:
    if not sensitivity:
        return Contribution(source, "B", reason=NOT_INVOLVED)
    if stated is None:
        return Contribution(source, "B", reason=NOT_STATED)
    return Contribution(source, "B", law, stated, "relative", sensitivity, freedom)


def _of_temperature(name: str, value: float, laboratory: Laboratory) -> Contribution:
    coefficient = laboratory.coefficients.get(name)
    if laboratory.temperature is None:
        return Contribution(TEMPERATURE, "B", reason=NOT_STATED)
    if coefficient is None:
        return Contribution(TEMPERATURE, "B", reason=f"{NOT_STATED}: no coefficient of this quantity")
    return Contribution(TEMPERATURE, "B", "normal", laboratory.temperature, "K", coefficient * value)
