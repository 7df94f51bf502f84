"""The dazzled area behind each protection as a function of distance: for a clear round lens by an
integral over its pupil, for a mask from its PSFs.
"""

from __future__ import annotations

import itertools
import math
from collections.abc import Callable, Sequence
from dataclasses import dataclass

import numpy as np
import torch

from neusee.nodes.laser import Beam, BrightPixels, defocus_at, round_pixels
from neusee.workflows.recipe.blocks.safety_block import Safety
from neusee.workflows.recipe.distributions.shapes import FloatArray
from neusee.workflows.safety.exposures import (
    FOLLOWED_WAVES,
    Exposures,
    Option,
    SettingDraws,
    as_wide,
    fill_at,
    focus_of,
    ladder,
)
from neusee.workflows.safety.laser_spots import Grid, Levels, Ranked, Veil, levels_of, veil_of

_RANKS = 80  #: how many ranks (numbers of pixels) have a computed level
#: steps of the distances for a clear round lens: relative, and in waves of defocus
_STEP, _WAVES = 0.3, 0.25
_MIDDLE_PIXELS = 16.0  #: so many pixels turn bright and dark together at the centre of a wide spot
_IN_FOCUS_WAVES = 0.1  #: waves below which a change of the defocus does not change the spot
_DEFOCUS = 550e-9  #: m; the wavelength in which waves of defocus are counted


@dataclass(frozen=True)
class Area:
    """The dazzled area of a laser behind one protection."""

    option: Option
    safety: Safety
    ranked: Ranked | None  #: None: a clear round lens

    @property
    def ranks(self) -> FloatArray:
        """Return the ranks (numbers of pixels) at which levels are computed; `asked` is one of
        them.
        """
        rows, columns = self.safety.settings.sensor.shape
        return np.unique(np.append(np.geomspace(1, rows * columns, _RANKS), self.asked))

    @property
    def asked(self) -> float:
        """Return the number of pixels that may be lost."""
        dazzle, (rows, columns) = self.safety.settings.dazzle, self.safety.settings.sensor.shape
        return max(1.0, (dazzle.share if dazzle else 1.0) * rows * columns)

    def level(self, exposures: Exposures, draws: SettingDraws, veiled: bool) -> FloatArray:
        """Return the light (1 + draw or 1, distance) in the faintest of the N brightest pixels,
        where N pixels may be lost.

        It is a share of the light that passes the lens.
        """
        levels, log_distance, grid_values = self._table(exposures, draws, veiled)
        # only the level at the rank `asked`
        rank_index = int(np.searchsorted(self.ranks, self.asked))
        faintest_share: FloatArray = np.exp(
            levels.at(log_distance, grid_values, slice(rank_index, rank_index + 1))[..., 0]
        )
        return faintest_share

    def beyond(self, exposures: Exposures, draws: SettingDraws) -> float:
        """Return the share of the lost pixels that lie outside the window of a PSF, the maximum
        over draws and distances.
        """
        table, _, _ = self._table(exposures, draws, veiled=False)
        return float(table.beyond[..., int(np.searchsorted(self.ranks, self.asked))].max())

    def saturated(
        self, exposures: Exposures, draws: SettingDraws, index: int, light: FloatArray
    ) -> FloatArray:
        """Return the number of pixels at one distance whose light is at least ``light``.

        ``light`` (1 + draw or 1, any) is the share of the light that passes the lens.
        """
        levels, log_distance, grid_values = self._table(exposures, draws, veiled=False)
        columns = [log_distance, *grid_values]
        columns = [
            column[:, index : index + 1] if column.shape[1] > 1 else column for column in columns
        ]
        # column 0: one distance
        levels_of_draws = levels.at(columns[0], columns[1:], slice(None))[:, 0]
        levels_of_draws = np.broadcast_to(
            levels_of_draws, (max(len(levels_of_draws), len(light)), levels_of_draws.shape[1])
        )
        light = np.broadcast_to(light, (len(levels_of_draws), light.shape[1]))
        ranks = self.ranks
        rows = [
            _number(row, ranks, needed) for row, needed in zip(levels_of_draws, light, strict=True)
        ]
        return np.stack(rows)

    def _table(
        self, exposures: Exposures, draws: SettingDraws, veiled: bool
    ) -> tuple[Levels, FloatArray, list[FloatArray]]:
        """Return the levels, and the coordinates of draws and distances in their grids; both are
        cached in the exposures.

        The second is the logarithm of the distance at which the nominal beam is as wide, the third
        are the values along the grids of the levels; all are (1 + draw or 1, distance).
        """
        key = self._diameter, self.ranked.arm if self.ranked else "", veiled
        if key not in exposures.tables:
            # one veil for all areas
            if "veil" not in exposures.tables:
                exposures.tables["veil"] = veil_of(self.safety, draws)
            veil = exposures.tables["veil"]
            log_share = np.log(veil.share)[:, None] if veil else np.zeros((1, 1))
            if self.ranked is None:
                spots = self._round_spots(exposures, draws)
                levels, log_distance = _of_clear(self, spots, veil, log_share, veiled), spots.place
                grid_values = [*spots.others, log_share]
            else:
                # the beam's radius at the lens: fill = (D / (2 w))^2
                beam_radii = self.safety.settings.lens.diameter / (
                    2 * np.sqrt(exposures.fill[self.option.name])
                )
                log_distance = np.log(as_wide(exposures.beams[0], beam_radii))
                levels, grid_values = _of_spots(self, veil, log_share, veiled), [log_share]
            exposures.tables[key] = levels, log_distance, grid_values
        table: tuple[Levels, FloatArray, list[FloatArray]] = exposures.tables[key]
        return table

    @property
    def _diameter(self) -> float:
        """Return the diameter in m of the lens, limited by its stop."""
        return min(self.option.diameter or math.inf, self.safety.settings.lens.diameter)

    def _round_spots(self, exposures: Exposures, draws: SettingDraws) -> _RoundSpots:
        """Return the spots of a clear round lens, cached in the exposures by diameter."""
        key = "round spots", self._diameter
        if key not in exposures.tables:
            exposures.tables[key] = _round_spots(self, exposures, draws)
        spots: _RoundSpots = exposures.tables[key]
        return spots


@dataclass(frozen=True)
class _RoundSpots:
    """The spots of a clear round lens on a grid of distance, defocus and size, and the coordinates
    of draws and distances on that grid.
    """

    rungs: FloatArray  #: (rung,) m
    #: grids of the difference from the nominal defocus (as asinh), and of the logarithm of the size
    #: in pixels
    grids: tuple[Grid, Grid]
    #: spots at each rung and each grid point (the last grid runs fastest): of one phase, or of
    #: several
    groups: tuple[tuple[BrightPixels, ...], ...]
    #: (1 + draw or 1, distance) logarithm of the distance at which the nominal beam is as wide
    place: FloatArray
    #: the defocus and the size there, in the scales of the grids
    others: tuple[FloatArray, FloatArray]


def _round_spots(area: Area, exposures: Exposures, draws: SettingDraws) -> _RoundSpots:
    """Return the spots of a clear round lens, by the integral over its pupil, at each rung and each
    grid point.
    """
    lens, sensor, dazzle = (
        area.safety.settings.lens,
        area.safety.settings.sensor,
        area.safety.settings.dazzle,
    )
    option_name, diameter = area.option.name, area._diameter
    beam_radii = diameter / (2 * np.sqrt(exposures.fill[option_name]))
    # a waist no wider than any drawn beam, so that every radius is reached at some distance
    waist = min(*(beam.waist for beam in exposures.beams), float(beam_radii.min()))
    beam = exposures.beams[0]._replace(waist=waist)
    log_distance = np.log(as_wide(beam, beam_radii))
    nominal_defocus = _defocus(area.safety, beam, diameter)
    # asinh(defocus / soft): linear near focus and logarithmic far from it
    bend_offset = np.arcsinh(exposures.waves[option_name] / _IN_FOCUS_WAVES) - np.arcsinh(
        nominal_defocus(np.exp(log_distance)) / _IN_FOCUS_WAVES
    )
    log_spread = np.log(_spreads(area.safety, draws, diameter))
    # points for each unit of asinh and of the logarithm
    bend_grid, spread_grid = Grid.through_zero(bend_offset, 1.5), Grid.around(log_spread, 4)
    distance_range = float(np.exp(log_distance.min())), float(np.exp(log_distance.max()))
    rungs = ladder(beam, lens, diameter, distance_range, _STEP, _WAVES)
    groups = []
    for distance in rungs.tolist():
        fill = fill_at(beam, diameter, distance)
        nominal_bend = math.asinh(float(nominal_defocus(np.array([distance]))[0]) / _IN_FOCUS_WAVES)
        for bend_of_point, log_size in itertools.product(
            bend_grid.points.tolist(), spread_grid.points.tolist()
        ):
            waves = _IN_FOCUS_WAVES * math.sinh(nominal_bend + bend_of_point)
            feature = dazzle.feature if dazzle else 1.0
            phases = [
                round_pixels(fill, phase_waves, math.exp(log_size), sensor.shape, feature)
                for phase_waves in _phases(waves)
            ]
            groups.append(tuple(phases))
    return _RoundSpots(
        rungs, (bend_grid, spread_grid), tuple(groups), log_distance, (bend_offset, log_spread)
    )


def _phases(waves: float) -> list[float]:
    """Return the defoci (in waves) to evaluate: the given one, or four within one wave where the
    centre of the spot oscillates.

    With each wave of defocus the middle of a wide spot turns from bright to dark, faster than the
    rungs follow.
    """
    if abs(waves) <= FOLLOWED_WAVES:
        return [waves]
    return [waves + quarter / 4 for quarter in range(4)]


def _number(levels: FloatArray, ranks: FloatArray, light: FloatArray) -> FloatArray:
    """Return the number of pixels whose light is at least each value of ``light``; ``levels`` are
    logarithms, falling with rank.
    """
    log_light = np.log(np.maximum(light, 1e-300))
    pixel_number = np.exp(np.interp(log_light, levels[::-1], np.log(ranks)[::-1]))
    return np.where(log_light > levels[0], 0.0, pixel_number)


def _defocus(safety: Safety, beam: Beam, diameter: float) -> Callable[[FloatArray], FloatArray]:
    """Return a function of distance that gives the waves of defocus of the nominal beam behind an
    aperture.
    """
    lens = safety.settings.lens
    if lens.focus == "laser":
        return np.zeros_like
    path = lens.defocus * _DEFOCUS * (diameter / lens.diameter) ** 2

    def waves(distance: FloatArray) -> FloatArray:
        distances: torch.Tensor = torch.from_numpy(distance)
        return np.asarray(
            defocus_at(beam, distances, torch.tensor(diameter), focus_of(lens), path), np.float64
        )

    return waves


def _spreads(safety: Safety, draws: SettingDraws, diameter: float) -> FloatArray:
    """Return wavelength times f-number over pixel pitch (1 + draw or 1, 1), nominal and of each
    draw.
    """
    lens, laser, pitch = safety.settings.lens, safety.laser, safety.settings.sensor.pixel_pitch
    aperture = np.minimum(draws.column("lens.diameter", lens.diameter), diameter)
    focal_length = draws.column("lens.focal_length", lens.focal_length)
    wavelength = draws.column("laser.wavelength", laser.wavelength)
    spread = wavelength * focal_length / aperture / draws.column("sensor.pixel_pitch", pitch)
    # one row where all draws are alike
    return (spread if np.ptp(spread) else spread[:1])[:, None]


def _of_clear(
    area: Area, spots: _RoundSpots, veil: Veil | None, share: FloatArray, veiled: bool
) -> Levels:
    """Return the levels behind a clear round lens, from its spots."""
    share_grid, shape = Grid.around(share, 2), area.safety.settings.sensor.shape

    def brightest(phases: Sequence[BrightPixels]) -> tuple[FloatArray, FloatArray]:
        phase_levels = [
            levels_of(groups, shape, area.ranks, veil, np.exp(share_grid.points), veiled)
            for groups in phases
        ]
        values, beyond = phase_levels[0]
        return (
            # the few brightest pixels change with the phase of the defocus: take the brightest of
            # all phases
            np.where(
                area.ranks <= _MIDDLE_PIXELS,
                np.max([value for value, _ in phase_levels], axis=0),
                values,
            ),
            beyond,
        )

    levels_at_points = list(map(brightest, spots.groups))
    grid_sizes = [len(grid.points) for grid in (*spots.grids, share_grid)]
    values, beyond = (
        np.stack(arrays).reshape(len(spots.rungs), *grid_sizes, len(area.ranks))
        for arrays in zip(*levels_at_points, strict=True)
    )
    return Levels(np.log(spots.rungs), (*spots.grids, share_grid), values, beyond)


def _of_spots(area: Area, veil: Veil | None, share: FloatArray, veiled: bool) -> Levels:
    """Return the levels behind lens or mask, from the pixels of their PSFs at several distances."""
    assert area.ranked is not None
    share_grid, shape = Grid.around(share, 3), area.safety.settings.sensor.shape
    spot_levels = [
        levels_of(groups, shape, area.ranks, veil, np.exp(share_grid.points), veiled)
        for groups in area.ranked.groups
    ]
    values, beyond = (np.stack(arrays) for arrays in zip(*spot_levels, strict=True))
    rungs = np.log(np.array(area.ranked.distances))
    misses = area.ranked.misses
    return Levels(
        rungs, (share_grid,), values, beyond, most=-np.log(area.ranks), misses=misses
    )  # nearer than the first rung: N pixels share at most all the light


def area_of(safety: Safety, option: Option, ranked: Sequence[Ranked]) -> Area | str:
    """Return the dazzled area behind an option, or a text that says why the area is not known."""
    arms = {spot.arm: spot for spot in ranked}
    if option.masked:
        if "mask" not in arms:
            return (
                "the recipe does not compute the dazzled area. Add `- safety: masked_dazzle` to"
                " its defaults, or name a step of laser.bright_pixels in"
                " safety.protection.pixels.mask"
            )
        if not math.isfinite(arms["mask"].error):
            return (
                "the pupil of safety.protection.pixels.mask has no wavefront, so its spot belongs"
                " to a single distance"
            )
        return Area(option, safety, arms["mask"])
    plain_spots = arms.get("plain") if option.diameter is None else None
    if plain_spots is not None and not math.isfinite(plain_spots.error):
        return (
            "the pupil of safety.protection.pixels.plain has no wavefront, so its spot belongs to"
            " a single distance"
        )
    return Area(option, safety, plain_spots)
