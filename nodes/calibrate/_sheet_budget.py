"""Uncertainty budgets of the quantities of the EMVA 1288 sheet, with their sources of
uncertainty.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Iterator, Mapping
from dataclasses import dataclass, replace
from functools import cached_property
from typing import Any

import numpy as np
import torch
from torch import Tensor

from neusee.nodes.calibrate._camera_likelihood import (
    CAMERA_PARAMETERS,
    CameraValues,
    camera_signal,
    levels_to_fit,
)
from neusee.nodes.calibrate._emva_quantities import FITTED_SHARE, Quantity, lit_order
from neusee.nodes.calibrate._emva_sheet import EmvaSheet, emva_sheet, without_histograms
from neusee.nodes.calibrate._nonuniformity import chance_of_variances
from neusee.nodes.calibrate._uncertainty_budget import (
    NOT_INVOLVED,
    NOT_STATED,
    Budget,
    Contribution,
    Laboratory,
    laboratory_contributions,
    welch_satterthwaite,
)
from neusee.nodes.values import Levels

# --- camera sources -------------------------------------------------------------------------------

# Sources of the scatter of a real camera's levels: statistics of the frames, lamp, dark signal, and
# excess scatter of the variances.


STATISTICS = "statistics of the frames"
LAMP = "lamp, from level to level"
DRIFT = "dark signal, from level to level"
SCATTER = "variances, beyond sampling"
SOURCES = (STATISTICS, LAMP, DRIFT, SCATTER)


def camera_sources(levels: Levels, params: Mapping[str, Any]) -> dict[str, Tensor]:
    """Return the share of each source of scatter in the variance of each row of
    `Likelihood.scaled`, as `camera` computes these rows.

    ``params`` are the parameters of `camera` at the posterior mode.

    Shapes: levels (level,) -> (row,) by source; the shares of a row add up to 1.
    Units:  none.
    Error:  exact for the model of `camera`.
    Source: the variance of a mean and of a log variance in `camera`, term by term.
    """
    fitted_index, largest_signal, _ = levels_to_fit(levels, params["share"])
    fitted_levels = without_histograms(levels, fitted_index)
    camera = CameraValues(
        *(torch.as_tensor(params[name], dtype=torch.float64) for name in CAMERA_PARAMETERS)
    )
    signal = camera_signal(fitted_levels.mean - camera.signal, largest_signal, camera)
    lamp_error = camera.lamp * camera.efficiency * fitted_levels.photons * signal.slope
    chance_variance, drift_variance = (
        fitted_levels.variance / fitted_levels.pixels,
        camera.drift.square() * torch.ones_like(lamp_error),
    )
    means = {STATISTICS: chance_variance, LAMP: lamp_error.square(), DRIFT: drift_variance}
    variances = {
        STATISTICS: 2.0 / fitted_levels.degrees_of_freedom,
        SCATTER: camera.scatter.square() * torch.ones_like(lamp_error),
    }
    row_shares = [_shares(squares) for squares in (variances, means)]
    no_share = torch.zeros_like(lamp_error)
    rows = {source: [shares.get(source, no_share) for shares in row_shares] for source in SOURCES}
    # the rows of `camera`: residual and width of each log variance, then of each mean
    return {source: torch.cat([a, a, b, b]) for source, (a, b) in rows.items()}


def source_freedom(
    levels: Levels, params: Mapping[str, Any], free: tuple[str, ...]
) -> dict[str, float]:
    """Return the degrees of freedom of each source: the observations that it scatters, less the
    ``free`` parameters fitted to them.

    Shapes: scalars by source.
    Units:  none.
    Source: JCGM 100:2008 (GUM), section 4.2.6 and G.3.3.
    """
    fitted, _, _ = levels_to_fit(levels, params["share"])
    lit_count = int((levels.photons[fitted] > 0).sum())
    response_is_free = [name in free for name in ("quantum_efficiency", "bend", "twist")]
    dark_is_free = [name in free for name in ("dark_signal", "dark_current")]
    noise_is_free = [name in free for name in ("gain", "temporal_dark_noise")]
    return {
        STATISTICS: float(levels.degrees_of_freedom[fitted].sum()),
        LAMP: float(max(1, lit_count - sum(response_is_free))),
        DRIFT: float(max(1, len(fitted) - lit_count - sum(dark_is_free))),
        SCATTER: float(max(1, len(fitted) - sum(noise_is_free))),
    }


def variance_shares(
    slopes: Tensor, sources: Mapping[str, Tensor], along: Tensor
) -> dict[str, float]:
    """Return the share of each source, and of the prior, in the variance of a function of the
    parameters.

    To first order the estimate is linear in the rows, so that its covariance is a sum over sources:
    C J^T F J C for a source with the shares F of the row variances, and C C for the prior, with C =
    (J^T J + 1)^-1.

    Shapes: slopes (row, free) derivatives per standard deviation of the prior; sources (row,)
            shares; along (free,) derivative of the function per standard deviation of the prior ->
            shares that add up to 1.
    Units:  none.
    Source: JCGM 100:2008 (GUM), section 5.1, for a least-squares estimate with a prior.
    """
    free = slopes.shape[1]
    # J^T J + 1: the prior has the standard deviation 1 in these units
    cholesky = torch.linalg.cholesky(slopes.T @ slopes + torch.eye(free, dtype=slopes.dtype))
    # C times the derivative of the function
    gradient = torch.cholesky_solve(along[:, None], cholesky)[:, 0]
    response = slopes @ gradient
    variance_of_source = {
        name: float((share * response.square()).sum()) for name, share in sources.items()
    }
    variance_of_source["prior"] = float(gradient @ gradient)
    total = math.fsum(variance_of_source.values())
    return {name: variance / total for name, variance in variance_of_source.items()}


def _shares(parts: Mapping[str, Tensor]) -> dict[str, Tensor]:
    """Return each variance divided by the sum of all, element by element."""
    total = torch.stack(list(parts.values())).sum(0)
    return {name: variance / total for name, variance in parts.items()}


# --- sheet budget ---------------------------------------------------------------------------------

# The uncertainty budgets of the quantities of an EMVA 1288 sheet, by the law of propagation of
# uncertainty.


MODEL = "model of the response"
SPACING = "spacing of the light levels"
#: half the step of a numerical derivative, in standard uncertainties of the input
_INPUT_STEP = 0.1
_PHOTON_STEP = 1e-4  #: half the relative step of a numerical derivative with respect to the photons
_ROUNDING_SHARE = 1e-6  #: a smaller relative change counts as rounding error
#: upper end of the alternative line fits, as a share of saturation
_SECOND_RANGE = 0.5 * FITTED_SHARE
#: ratio of two changes of a slope that is linear in the upper end of the fit: from 70 to 0 % of
#: saturation over from 70 to 35 %
_CHANGE_TO_NO_LIGHT = 2.0
#: by key of the sheet: the `camera` parameter whose temperature coefficient applies, and its sign
_COEFFICIENTS = {
    "K": ("gain", 1.0),
    "inverse_K": ("gain", -1.0),
    "eta": ("quantum_efficiency", 1.0),
    "sigma_d": ("temporal_dark_noise", 1.0),
    "mu_y_dark": ("dark_signal", 1.0),
    "mu_I_mean": ("dark_current", 1.0),
    "mu_I_var": ("dark_current", 1.0),
}

#: by key: (dy/ds) / y for a relative change s of the saturation; for logarithmic quantities dy/ds
_SATURATION_EXPONENTS = {"mu_p_sat": 1.0, "mu_e_sat": 1.0, "SNR_max": 0.5, "DR": 1.0}
_LOGARITHM_SLOPES = {
    "SNR_max_dB": 10 / math.log(10),
    "SNR_max_bit": 0.5 / math.log(2),
    "DR_dB": 20 / math.log(10),
    "DR_bit": 1 / math.log(2),
    "SNR_max_general": 10 / math.log(10),
    "DR_general": 20 / math.log(10),
}

Values = dict[str, float]


@dataclass(frozen=True)
class _Propagation:
    """Sensitivities of all quantities of a sheet to its levels, to the light of each level, to all
    photons together and to the model.
    """

    levels: Levels
    sheet: EmvaSheet
    photons_told: bool  #: True if the photons are known

    def values(self, levels: Levels) -> Values:
        """Return the values, by key, of the quantities that follow from levels alone, without
        series of frames.
        """
        quantities = emva_sheet(levels, None, photons_told=self.photons_told).quantities
        return {q.key: q.value for q in quantities if q.value is not None}

    @cached_property
    def statistics(self) -> dict[str, list[Contribution]]:
        """Return the contributions of the mean and of the variance of each level, by key."""
        levels = self.levels
        contributions: dict[str, list[Contribution]] = {}
        for name, error, freedom in (
            ("mean", (levels.variance / levels.pixels).sqrt(), levels.pixels - 1),
            (
                "variance",
                levels.variance * (2 / levels.degrees_of_freedom).sqrt(),
                levels.degrees_of_freedom,
            ),
        ):
            for i, (uncertainty, degrees_of_freedom) in enumerate(
                zip(error.tolist(), freedom.tolist(), strict=True)
            ):
                if uncertainty > 0:
                    for key, slope in self._slopes(
                        self._field_step(name, i), _INPUT_STEP * uncertainty
                    ).items():
                        contributions.setdefault(key, []).append(
                            # text fields stay empty: these terms are combined into one contribution
                            # later
                            Contribution("", "A", "", uncertainty, "", slope, degrees_of_freedom)
                        )
        return contributions

    @cached_property
    def light(self) -> Values:
        """Return, by key, the root sum of squares of dy/de over the lit levels, where e is the
        relative change of the light of one level.
        """
        sums_of_squares: Values = {}
        for i in (self.levels.photons > 0).nonzero().squeeze(1).tolist():
            for key, slope in self._slopes(self._lit_step(i), _PHOTON_STEP).items():
                sums_of_squares[key] = sums_of_squares.get(key, 0.0) + slope**2
        return {key: math.sqrt(x) for key, x in sums_of_squares.items()}

    @cached_property
    def photons(self) -> Values:
        """Return dy/ds, by key, for a common relative change s of all numbers of photons."""
        return self._slopes(
            lambda s: self.levels._replace(photons=self.levels.photons * (1 + s)), _PHOTON_STEP
        )

    @cached_property
    def other_model(self) -> Values:
        """Return the values, by key, with lines fitted only up to 35 % of saturation."""
        levels, transfer = self.levels, self.sheet.transfer
        saturation_signal = float(transfer.signal[transfer.saturation])
        darkest = float(transfer.mean_dark.min())
        signal = levels.mean - darkest
        # levels up to 35 % of saturation, and those above 70 %, which determine the saturation
        used_levels = (
            (levels.photons == 0)
            | (signal <= _SECOND_RANGE * saturation_signal)
            | (signal > FITTED_SHARE * saturation_signal)
        )
        try:
            return self.values(without_histograms(levels, used_levels))
        except ValueError:
            return {}

    @cached_property
    def lamp(self) -> tuple[float, float]:
        """Return the relative scatter of the light from level to level beyond chance, and its
        degrees of freedom.
        """
        transfer, line = self.sheet.transfer, self.sheet.linearity
        if line is None:
            return math.nan, math.nan
        linear_levels = transfer.linear
        # in the order of the levels of `PhotonTransfer`
        order = lit_order(self.levels.photons.numpy(), self.levels.exposure.numpy())
        chance_variance = (self.levels.variance / self.levels.pixels).numpy()[order][
            linear_levels
        ] / transfer.signal[linear_levels] ** 2
        freedom = len(line.deviation) - 2
        # variance about the line, less the variance by noise; a line has two fitted parameters
        excess_variance = float(((line.deviation / 100) ** 2).sum()) / freedom - float(
            chance_variance.mean()
        )
        return math.sqrt(max(excess_variance, 0.0)), float(freedom)

    @cached_property
    def spacing(self) -> float:
        """Return the relative standard uncertainty of the saturation by the spacing of the levels.

        The true saturation lies between the neighbouring levels, with a rectangular distribution.
        """
        photons, saturation = self.sheet.transfer.photons, self.sheet.transfer.saturation
        neighbours = photons[[max(0, saturation - 1), min(len(photons) - 1, saturation + 1)]]
        # the half-width of a rectangular distribution over sqrt(3)
        return float(
            np.abs(neighbours - photons[saturation]).max() / photons[saturation] / math.sqrt(3)
        )

    def _slopes(self, levels_at: Callable[[float], Levels], step: float) -> Values:
        """Return the derivative of each quantity by central differences; ``levels_at(step)``
        returns the levels with an input changed by ``step``.
        """
        values_above, values_below = self.values(levels_at(step)), self.values(levels_at(-step))
        return {
            key: (values_above[key] - values_below[key]) / (2 * step)
            for key in values_above.keys() & values_below.keys()
        }

    def _field_step(self, name: str, i: int) -> Callable[[float], Levels]:
        """Return a function of a step that adds it to the field ``name`` of level ``i`` and returns
        the levels.
        """

        def at(step: float) -> Levels:
            return self.levels._replace(**{name: _added(getattr(self.levels, name), i, step)})

        return at

    def _lit_step(self, i: int) -> Callable[[float], Levels]:
        """Return a function of a relative change of the light of level ``i``, which changes its
        mean and variance, and returns the levels.
        """
        levels, is_dark = self.levels, self.levels.photons == 0
        nearest_dark = torch.where(
            is_dark, (levels.exposure - levels.exposure[i]).abs(), torch.inf
        ).argmin()
        signal, excess = (float(x[i] - x[nearest_dark]) for x in (levels.mean, levels.variance))

        def at(step: float) -> Levels:
            mean, variance = (
                _added(levels.mean, i, step * signal),
                _added(levels.variance, i, step * excess),
            )
            return levels._replace(mean=mean, variance=variance)

        return at


def sheet_budgets(
    levels: Levels, sheet: EmvaSheet, laboratory: Laboratory, photons_told: bool = True
) -> list[Budget]:
    """Return the uncertainty budget of each quantity of a sheet that has a value and is not only a
    limit.

    Derivatives are central differences of the whole sheet. The sources are the statistics of means
    and variances; the scatter of the light from level to level, estimated from the deviations from
    the line of linearity; the spacing of the levels; the model of the response; and the
    uncertainties that ``laboratory`` states. For the model, the lines are also fitted up to 35 % of
    saturation. A slope that is linear in the upper end of the fit would change twice as much down
    to no light, and the quantity may lie anywhere within that change.

    Shapes: levels (level,).
    Units:  those of each quantity.
    Error:  first order in the uncertainties.
    Source: JCGM 100:2008 (GUM), equation 10; EMVA Standard 1288, release 4.0 Linear.
    """
    without_cells = without_histograms(levels, torch.arange(len(levels.mean)))
    propagation = _Propagation(without_cells, sheet, photons_told)
    measured_quantities = [q for q in sheet.quantities if q.value is not None and not q.bound]
    gain = sheet["K"]
    of_measurement = {}
    for q in measured_quantities:
        if _is_of_series(q):
            of_measurement[q.key] = list(_of_series(q, sheet, propagation))
        else:
            of_measurement[q.key] = list(_of_levels(q, propagation))
    return [
        _budget(q, of_measurement[q.key], propagation, laboratory, gain)
        for q in measured_quantities
    ]


def _budget(
    q: Quantity,
    own: list[Contribution],
    moves: _Propagation,
    laboratory: Laboratory,
    gain: Quantity,
) -> Budget:
    """Return the budget of a quantity from its ``own`` contributions, those of the measurement, and
    from those of the laboratory.
    """
    assert q.value is not None
    parameter, sign = _COEFFICIENTS.get(q.key, (q.key, 1.0))
    # a temperature coefficient of the quantity itself takes precedence over that of its parameter
    key = q.key if q.key in laboratory.coefficients else parameter
    photon_slope = moves.photons.get(q.key, 0.0)
    photon_slope = photon_slope if abs(photon_slope) > _ROUNDING_SHARE * abs(q.value) else 0.0
    laboratory_terms = laboratory_contributions(key, sign * q.value, photon_slope, laboratory)
    return Budget(q.key, q.name, q.symbol, q.unit, q.value, (*own, *laboratory_terms))


def _of_levels(q: Quantity, moves: _Propagation) -> Iterator[Contribution]:
    """Yield the measurement's contributions to a quantity that follows from levels: statistics,
    lamp, spacing of the levels, and model of the response.
    """
    assert q.value is not None
    contributions = moves.statistics.get(q.key, [])
    uncertainty = math.hypot(*(c.share or 0.0 for c in contributions), 0.0)
    freedom = welch_satterthwaite(contributions)
    if uncertainty > _ROUNDING_SHARE * abs(q.value):
        yield Contribution(STATISTICS, "A", "normal", uncertainty, q.unit, 1.0, freedom)
    else:
        yield Contribution(STATISTICS, "A", reason=NOT_INVOLVED)
    yield _of_lamp(moves.light.get(q.key, 0.0), q.value, moves)
    if sensitivity := _LOGARITHM_SLOPES.get(q.key, _SATURATION_EXPONENTS.get(q.key, 0.0) * q.value):
        yield Contribution(SPACING, "B", "rectangular", moves.spacing, "relative", sensitivity)
    other_value = moves.other_model.get(q.key)
    if other_value is None:
        yield Contribution(
            MODEL, "B", reason=f"{NOT_STATED}: too few levels up to 35 % of saturation"
        )
    elif abs(other_value - q.value) <= _ROUNDING_SHARE * abs(q.value):
        yield Contribution(MODEL, "B", reason=NOT_INVOLVED)
    else:
        yield Contribution(
            MODEL,
            "B",
            "rectangular",
            _CHANGE_TO_NO_LIGHT * abs(other_value - q.value) / math.sqrt(3),
            q.unit,
        )


def _of_lamp(sensitivity: float, value: float, moves: _Propagation) -> Contribution:
    """Return the contribution of the lamp; ``sensitivity`` is the derivative of the quantity with
    respect to the relative light of a level, and ``value`` its value.
    """
    scatter, freedom = moves.lamp
    if sensitivity <= _ROUNDING_SHARE * abs(value):
        return Contribution(LAMP, "A", reason=NOT_INVOLVED)
    if not math.isfinite(scatter):
        return Contribution(LAMP, "A", reason=f"{NOT_STATED}: fewer than three levels on the line")
    return Contribution(LAMP, "A", "normal", scatter, "relative", sensitivity, freedom)


def _is_of_series(q: Quantity) -> bool:
    """Return True for a quantity that is computed from series of frames, not from levels."""
    return q.key.startswith(("DSNU1288", "PRNU1288"))


def _chance_of_pattern(q: Quantity, sheet: EmvaSheet) -> float:
    """Return the standard error of the square of a quantity from series of frames, a spatial
    variance.
    """
    lit, dark = sheet.spatial.lit, sheet.spatial.dark
    pattern = q.key.removesuffix("_DN").partition("_")[2]
    # index of the field of `SpatialVariances`; the key of a total has no suffix
    index = ("", "row", "column", "pixel").index(pattern)
    is_response = q.key.startswith("PRNU")
    series = (dark, lit) if is_response else (dark,)
    standard_error = math.hypot(
        *(chance_of_variances(frames)[index] for frames in series if frames)
    )
    if is_response and lit is not None and dark is not None:
        # PRNU is in percent of the signal
        return standard_error * (100 / float(lit.average.mean() - dark.average.mean())) ** 2
    return standard_error


def _of_series(q: Quantity, sheet: EmvaSheet, moves: _Propagation) -> Iterator[Contribution]:
    """Yield the contributions to a quantity from series of frames; a quantity in electrons also has
    those of the gain.
    """
    assert q.value is not None
    gain = sheet["K"].value if q.unit == "e-" else None
    # u(x) = u(x^2) / (2 x), in electrons over the gain squared
    own_uncertainty = _chance_of_pattern(q, sheet) / (2 * q.value) / (gain or 1.0) ** 2
    dark = sheet.spatial.dark
    degrees_of_freedom = float(dark.total.size if dark else 1) - 1
    if not gain:
        yield Contribution(
            STATISTICS, "A", "normal", own_uncertainty, q.unit, 1.0, degrees_of_freedom
        )
        yield Contribution(LAMP, "A", reason=NOT_INVOLVED)
        yield Contribution(MODEL, "B", reason=NOT_INVOLVED)
        return
    chance, lamp, model = _of_levels(sheet["K"], moves)
    # a relative change of the gain changes the quantity by the same share
    ratio = q.value / gain
    contributions = [
        Contribution("", "A", "", own_uncertainty, "", 1.0, degrees_of_freedom),
        _scaled(chance, ratio),
    ]
    uncertainty = math.hypot(*(c.share or 0.0 for c in contributions))
    yield Contribution(
        STATISTICS, "A", "normal", uncertainty, q.unit, 1.0, welch_satterthwaite(contributions)
    )
    yield _scaled(lamp, ratio)
    yield _scaled(model, ratio)


def _scaled(c: Contribution, by: float) -> Contribution:
    """Return a contribution with its sensitivity multiplied by ``by``."""
    return replace(c, sensitivity=c.sensitivity * by)


def _added(values: Tensor, i: int, step: float) -> Tensor:
    """Return a copy of ``values`` with ``step`` added to element ``i``."""
    changed = values.clone()
    changed[i] += step
    return changed
