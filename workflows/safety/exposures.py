"""Exposure at the lens and on the sensor over the distance, for nominal values and for draws of uncertain ones."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, replace
from typing import Any, Literal

import numpy as np
import torch

from neusee.nodes import ParameterError
from neusee.nodes.laser import Beam, air_transmittance, axis_density, heated_diameter, sensor_density
from neusee.workflows.graph.diagnostics import Diagnostic, RecipeError
from neusee.workflows.recipe.blocks.safety_block import BEAM, Safety
from neusee.workflows.recipe.distributions.scalar import FloatArray
from neusee.workflows.safety.distance_zones import sampled
from neusee.workflows.safety.uncertain_values import SettingDraws

Emission = Literal["continuous", "single pulse", "pulse train"]


@dataclass(frozen=True)
class Option:
    """One way to protect the sensor: what it changes between the lens and the sensor."""

    name: str
    diameter: float | None = None  #: m, of a smaller stop; None: that of the lens
    passing: float = 1.0  #: transmittance of a filter
    peak: float = 1.0  #: peak of the PSF over that of the clear lens
    masked: bool = False  #: whether the mask is in front of the lens


@dataclass(frozen=True)
class Exposures:
    """Shares of the laser's power per m2 over the distance; times power or pulse energy they are exposures."""

    distances: FloatArray  #: (distance,) m, at equal ratios; the distance of the recipe is one of them
    lens: FloatArray  #: (1 + draw, distance) on the axis at the lens; row 0 has the nominal values
    sensor: Mapping[str, FloatArray]  #: by option, (1 + draw, distance) at the peak on the sensor
    spot: Mapping[str, FloatArray]  #: m, by option, (1 + draw, distance) diameter of the spot that heats the sensor
    beams: tuple[Beam, ...]  #: of the nominal values and of each draw

    def at(self, distance: float) -> int:
        """Return the index of one of the distances."""
        return int(np.argmin(np.abs(self.distances - distance)))

    def emitted(self, quantity: Literal["irradiance", "fluence"]) -> FloatArray:
        """Return the mean power in W, or the energy of a pulse in J, of the nominal values and of each draw."""
        field = "power" if quantity == "irradiance" else "pulse_energy"
        return np.array([getattr(beam, field) for beam in self.beams], np.float64)[:, None]


def emission_of(beam: Beam) -> Emission:
    """Return how a laser emits its light."""
    if not beam.is_pulsed:
        return "continuous"
    return "single pulse" if beam.repetition_rate is None else "pulse train"


def compute_exposures(safety: Safety, draws: SettingDraws, options: tuple[Option, ...]) -> Exposures:
    """Return the exposures at the lens and behind each option; raise `RecipeError` for a draw that is no beam."""
    nearest, furthest = safety.settings.distances
    distance = safety.laser.distance
    at = sampled(min(nearest, distance), max(furthest, distance), (distance,))
    beams = tuple(_beams(safety, draws))
    beam, where = _stacked(beams), torch.from_numpy(at)
    air: Any = torch.from_numpy(_air(safety, draws, at))
    lens = _column(draws, "lens.transmittance", safety.settings.lens.transmittance)
    focal_length = _column(draws, "lens.focal_length", safety.settings.lens.focal_length)
    diameter = _column(draws, "lens.diameter", safety.settings.lens.diameter)
    sensor, spot = {}, {}
    for option in options:
        aperture: Any = diameter if option.diameter is None else torch.minimum(diameter, torch.tensor(option.diameter))
        share = sensor_density(beam, where, aperture, focal_length, lens * option.passing, air)
        sensor[option.name] = (share * option.peak).numpy()
        spot[option.name] = heated_diameter(beam, where, aperture, focal_length).numpy()
    return Exposures(at, axis_density(beam, where, air).numpy(), sensor, spot, beams)


def _beams(safety: Safety, draws: SettingDraws) -> list[Beam]:
    """Return the beam of the nominal values and of each draw."""
    drawn = {name: draws.values[f"laser.{name}"] for name in BEAM if f"laser.{name}" in draws.values}
    found = [safety.laser.beam()]
    try:
        for i in range(draws.count):
            found.append(safety.laser.beam({name: float(x[i]) for name, x in drawn.items()}) if drawn else found[0])
    except ParameterError as error:
        value = safety.values.get(f"laser.{error.parameter}", next(iter(safety.values.values())))
        raise RecipeError([Diagnostic(value.mark, value.name, f"the value is drawn, but {error}")]) from None
    return found


def _stacked(beams: tuple[Beam, ...]) -> Beam:
    """Return one beam whose quantities are columns (1 + draw, 1), with which the formulas of a beam compute as well."""
    fields = ("wavelength", "waist", "divergence")
    columns = {name: torch.tensor([getattr(beam, name) for beam in beams], dtype=torch.float64) for name in fields}
    return beams[0]._replace(**{name: column[:, None] for name, column in columns.items()})  # type: ignore[arg-type]


def _column(draws: SettingDraws, name: str, nominal: float) -> Any:
    """Return the nominal value and the draws of a setting as a column (1 + draw, 1)."""
    return torch.from_numpy(draws.column(name, nominal)[:, None])


def _air(safety: Safety, draws: SettingDraws, at: FloatArray) -> FloatArray:
    """Return the transmittance of the air (1 + draw, distance), from that of one metre: even air has equal metres."""
    laser = safety.laser
    if laser.air_transmittance is not None:
        whole = draws.column("laser.air_transmittance", laser.air_transmittance)[:, None]
        return np.asarray(np.power(whole, at / laser.distance), np.float64)
    if laser.visibility is None:
        return np.ones((1, 1))
    visible = _column(draws, "laser.visibility", laser.visibility)[:, 0].tolist()
    known = {v: air_transmittance(1.0, v, laser.wavelength, laser.haze) for v in set(visible)}
    return np.asarray(np.power(np.array([known[v] for v in visible])[:, None], at), np.float64)


def options_of(safety: Safety, mask: float | None) -> tuple[Option, ...]:
    """Return the plain lens and the protections that the settings name; ``mask`` is the peak behind the mask."""
    protection = safety.settings.protection
    found = [Option("plain lens")]
    if mask is not None:
        found.append(Option("mask", peak=mask, masked=True))
    if protection.filter is not None:
        found.append(Option(f"grey filter {protection.filter:g}", passing=protection.filter))
    if protection.stop is not None:
        found.append(Option(f"stop {protection.stop * 1e3:g} mm", diameter=protection.stop))
    if mask is not None and protection.filter is not None:
        found.append(replace(found[1], name="mask and grey filter", passing=protection.filter))
    return tuple(found)
