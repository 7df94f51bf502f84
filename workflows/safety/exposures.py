"""Exposure at the lens and on the sensor over the distance, for nominal values and for draws of uncertain ones."""

from __future__ import annotations

import math
from collections.abc import Mapping
from dataclasses import dataclass, field, replace
from typing import Any, Literal

import numpy as np
import torch

from neusee.nodes import ParameterError
from neusee.nodes.laser import (
    Beam,
    air_transmittance,
    axis_density,
    beam_radius,
    defocus_at,
    density_in_spot,
    heated_diameter,
    heated_in_spot,
    scintillation,
    sensor_density,
    share_through,
    stopped_share,
    widest_heated_diameter,
)
from neusee.workflows.graph.diagnostics import Diagnostic, RecipeError
from neusee.workflows.recipe.blocks.safety_block import BEAM, Lens, Safety
from neusee.workflows.recipe.distributions.shapes import FloatArray
from neusee.workflows.safety.distance_ladder import as_wide, interpolated, miss_between
from neusee.workflows.safety.distance_zones import sampled
from neusee.workflows.safety.uncertain_values import SettingDraws

Emission = Literal["continuous", "single pulse", "pulse train"]
WITHIN = 0.01  #: relative change of the defocus over which the largest peak counts: that of half a step of distance
_ROUNDED = 1e-9  #: rounding of the logarithm of a distance
_DEFOCUS = 550e-9  #: m; the wavelength in which waves of defocus are counted


@dataclass(frozen=True)
class Option:
    """One way to protect the sensor: what it changes between the lens and the sensor."""

    name: str
    diameter: float | None = None  #: m, of a smaller stop; None: that of the lens
    passing: float = 1.0  #: transmittance of a filter
    peak: float = 1.0  #: peak of the PSF over that of the clear lens, at the distance of the recipe
    masked: bool = False  #: whether the mask is in front of the lens
    heated: float | None = None  #: diameter of the heated spot over that of the clear lens; None: not known
    scene: float | None = None  #: share of the scene's light that a filter passes; None: as much as of the laser's

    def scene_share(self, diameter: float) -> float:
        """Return the share of the scene's light that reaches the sensor, for a lens of ``diameter`` m."""
        filtered = self.passing if self.scene is None else self.scene
        return filtered * stopped_share(diameter, self.diameter or diameter)

    peaks: tuple[tuple[float, float], ...] = ()  #: distance in m, and the peak there over that of the lens in focus
    misses: tuple[float, ...] = ()  #: of the logarithm of the peak between two of these distances, counted upward


@dataclass(frozen=True)
class Exposures:
    """Shares of the laser's power per m2 over the distance; times power or pulse energy they are exposures.

    Every array is (1 + draw or 1, distance), and row 0 has the nominal values.
    """

    distances: FloatArray  #: (distance,) m, at equal ratios; the distance of the recipe is one of them
    lens: FloatArray  #: on the axis at the lens
    sensor: Mapping[str, FloatArray]  #: by option, at the peak on the sensor
    spot: Mapping[str, FloatArray]  #: m, by option, diameter of the spot that heats the sensor
    beams: tuple[Beam, ...]  #: of the nominal values and of each draw
    through: Mapping[str, FloatArray]  #: by option, share of the power that reaches the sensor
    fill: Mapping[str, FloatArray]  #: by option, (D / (2 w))^2
    waves: Mapping[str, FloatArray]  #: by option, defocus at the rim of the lens
    tables: dict[Any, Any] = field(default_factory=dict, compare=False, repr=False)  #: of `Area`, made when asked

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


def compute_exposures(
    safety: Safety, draws: SettingDraws, options: tuple[Option, ...], distances: FloatArray | None = None
) -> Exposures:
    """Return the exposures at the lens and behind each option; raise `RecipeError` for a draw that is no beam.

    Without ``distances`` they are those of the settings and of the recipe.
    """
    at = asked_distances(safety) if distances is None else np.asarray(distances, np.float64)
    beams = tuple(_beams(safety, draws))
    beam, where = _stacked(beams), torch.from_numpy(at)
    air: Any = torch.from_numpy(_air(safety, draws, at) * _uneven(safety, draws, at))
    lens = _column(draws, "lens.transmittance", safety.settings.lens.transmittance)
    focal_length = _column(draws, "lens.focal_length", safety.settings.lens.focal_length)
    diameter = _column(draws, "lens.diameter", safety.settings.lens.diameter)
    columns: dict[str, dict[str, FloatArray]] = {name: {} for name in ("sensor", "spot", "through", "fill", "waves")}
    for option in options:
        aperture: Any = diameter if option.diameter is None else torch.minimum(diameter, torch.tensor(option.diameter))
        waves = _waves(safety.settings.lens, beam, where, aperture)
        passing = lens * option.passing * air
        focused: Any = sensor_density(beam, where, aperture, focal_length, 1.0)
        density = focused * _at_width(option, beams[0], beam_radius(beam, where)) if option.masked else (
            density_in_spot(beam, where, aperture, focal_length, waves, WITHIN)
        )  # fmt: skip
        columns["sensor"][option.name] = (density * passing).numpy()
        heated: Any = (
            heated_diameter(beam, where, aperture, focal_length) * _widened(option, density / focused)
            if option.masked
            else heated_in_spot(beam, where, aperture, focal_length, waves, density)
        )
        columns["spot"][option.name] = heated.numpy()
        columns["through"][option.name] = (share_through(beam, where, aperture) * passing).numpy()
        columns["fill"][option.name] = (aperture**2 / (4 * beam_radius(beam, where) ** 2)).numpy()
        columns["waves"][option.name] = waves.numpy()
    at_lens = axis_density(beam, where, air).numpy()
    return Exposures(
        at,
        at_lens,
        columns["sensor"],
        columns["spot"],
        beams,
        columns["through"],
        columns["fill"],
        columns["waves"],
    )


def _widened(option: Option, peak: Any) -> Any:
    """Return the heated spot over that of the clear lens in focus, an upper bound, from the peak over that lens's.

    The width behind a mask at the distance of the recipe is `Option.heated`, so that the rest counts here alone.
    """
    defocused = (peak / option.peak).clamp_max(1.0)
    widest = widest_heated_diameter(torch.ones_like(defocused), defocused)
    return widest.where(defocused < 1 - 1e-9, 1.0)


def asked_distances(safety: Safety) -> FloatArray:
    """Return the distances of the settings at equal ratios, and that of the recipe among them."""
    nearest, furthest = safety.settings.distances
    return sampled(nearest, furthest, (safety.laser.distance,))


def _waves(lens: Lens, beam: Beam, where: Any, aperture: Any) -> Any:
    """Return the waves of defocus at the rim of the aperture over draws and distances."""
    if lens.focus == "laser":
        return torch.zeros(1, 1, dtype=torch.float64)
    focus = math.inf if isinstance(lens.focus, str) else lens.focus
    stopped = (aperture / lens.diameter) ** 2 if lens.defocus else 1.0
    return defocus_at(beam, where, aperture, focus, lens.defocus * _DEFOCUS * stopped)


def _at_width(option: Option, nominal: Beam, radius: Any) -> Any:
    """Return the peak behind a mask over that of the clear lens in focus, for beams of a 1/e2 radius at the lens.

    A beam that is drawn has the peak of the nominal beam at the distance where the nominal beam is as wide. Nearer than
    the first peak the ratio is 1, which no mask exceeds.
    """
    if not option.peaks:
        return option.peak
    at, ratio = np.log(np.array(option.peaks)).T
    place = np.log(as_wide(nominal, np.asarray(radius, np.float64)))
    inside = np.clip(place, at[0], at[-1])
    between = np.exp(interpolated(at, ratio, inside) + miss_between(at, option.misses, inside))
    return torch.from_numpy(np.where(place < at[0] - _ROUNDED, 1.0, np.minimum(between, 1.0)))


def _uneven(safety: Safety, draws: SettingDraws, at: FloatArray) -> FloatArray:
    """Return the factor (1 + draw or 1, distance) of hot spots and of turbulent air on every irradiance."""
    beam = safety.settings.beam
    factor = draws.column("beam.hot_spots", beam.hot_spots)[:, None]
    if not np.ptp(factor):
        factor = factor[:1]
    if beam.cn2 is None:
        return factor
    turbulence = torch.from_numpy(draws.column("beam.cn2", beam.cn2)[:, None])
    moments: Any = scintillation(safety.laser.wavelength, torch.from_numpy(at), turbulence, beam.worst)
    return np.asarray(factor * moments.numpy(), np.float64)


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
    """Return one beam whose quantities are columns (1 + draw, 1), with which the formulas of a beam compute as well.

    A column of equal values has one row.
    """
    fields = ("wavelength", "waist", "divergence")
    columns = {name: _short(np.array([getattr(beam, name) for beam in beams])) for name in fields}
    return beams[0]._replace(**columns)


def _short(values: FloatArray) -> Any:
    """Return values as a column (1 + draw, 1), or as one row if all are equal."""
    return torch.from_numpy((values if np.ptp(values) else values[:1])[:, None])


def _column(draws: SettingDraws, name: str, nominal: float) -> Any:
    """Return the nominal value and the draws of a setting as a column (1 + draw, 1), or as one row if all are equal."""
    return _short(draws.column(name, nominal))


def _air(safety: Safety, draws: SettingDraws, at: FloatArray) -> FloatArray:
    """Return the transmittance of the air (1 + draw, distance), from that of one metre: even air has equal metres."""
    laser = safety.laser
    if laser.air_transmittance is not None:
        whole = draws.column("laser.air_transmittance", laser.air_transmittance)[:, None]
        return np.asarray(np.power(whole, at / laser.distance), np.float64)
    if laser.visibility is None:
        return np.ones((1, 1))
    visible = draws.column("laser.visibility", laser.visibility).tolist()
    known = {v: air_transmittance(1.0, v, laser.wavelength, laser.haze) for v in set(visible)}
    return np.asarray(np.power(np.array([known[v] for v in visible])[:, None], at), np.float64)


def options_of(
    safety: Safety,
    mask: float | None,
    peaks: tuple[tuple[float, float], ...] = (),
    misses: tuple[float, ...] = (),
) -> tuple[Option, ...]:
    """Return the plain lens and the protections that the settings name.

    ``mask`` is the peak behind the mask at the distance of the recipe, ``peaks`` are those over the distance, and
    ``misses`` how much the logarithm of a peak between two distances may be higher than interpolated.
    """
    protection = safety.settings.protection
    found = [Option("plain lens")]
    if mask is not None:
        found.append(Option("mask", peak=mask, masked=True, peaks=peaks, misses=misses))
    if protection.filter is not None:
        found.append(Option(f"grey filter {protection.filter:g}", passing=protection.filter))
    if protection.stop is not None:
        found.append(Option(f"stop {protection.stop * 1e3:g} mm", diameter=protection.stop))
    if mask is not None and protection.filter is not None:
        found.append(replace(found[1], name="mask and grey filter", passing=protection.filter))
    return tuple(found)
