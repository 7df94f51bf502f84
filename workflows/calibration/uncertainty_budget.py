"""The uncertainty budget of each parameter: its sources, tables and picture.

Some sources are statements of the laboratory on its light and temperature, in the recipe.
"""

from __future__ import annotations

import itertools
import math
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import asdict, replace
from typing import TYPE_CHECKING, Any, Literal, NamedTuple

import numpy as np
import torch

from neusee.nodes.calibrate import (
    COVERAGE,
    MODEL,
    NOT_INVOLVED,
    NOT_STATED,
    STATISTICS,
    Budget,
    Contribution,
    Laboratory,
    Traceability,
    camera_sources,
    laboratory_contributions,
    source_freedom,
    variance_shares,
)
from neusee.nodes.values import Levels
from neusee.workflows.calibration.frame_validity import (
    TERMS,
    ModelSpread,
    errors_of_parameters,
    wider,
    width_of_mean,
)
from neusee.workflows.calibration.identifiability import Identifiability
from neusee.workflows.calibration.log_posterior import SensorPosterior
from neusee.workflows.graph.errors import nearest
from neusee.workflows.graph.recipe_graph import Recipe
from neusee.workflows.recipe.distributions.joint_distribution import Z_90
from neusee.workflows.report.figures.style import (
    BLACK,
    BLUE,
    GREEN,
    ORANGE,
    VERMILION,
    canvas,
    drawn,
)
from neusee.workflows.report.study_report import Marked, Section, with_uncertainty

if TYPE_CHECKING:
    from neusee.workflows.calibration.calibration_page import CalibrationResult, ParameterEstimate
    from neusee.workflows.calibration.emcee_sampler import Chains
    from neusee.workflows.calibration.log_posterior import FloatArray

# --- laboratory -----------------------------------------------------------------------------------

# Statements of the laboratory on its light and temperature, and their effect on draws and
# intervals.


EFFICIENCY = "quantum_efficiency"
RELATIVE = "quantum efficiency: not from these frames: the photons are known up to a factor only"
#: quantities that may have a temperature coefficient: positive ones, for which a relative change
#: makes sense
WITH_COEFFICIENT = frozenset(
    {
        "gain",
        EFFICIENCY,
        "dark_signal",
        "temporal_dark_noise",
        "dark_current",
        "offset",
        "read_noise",
        "full_well",
    }
)
_STREAM = 9  #: stream of random numbers, separate from those of other draws


def stated(recipe: Recipe) -> Traceability:
    """Return the statements of a recipe on light and temperature; an empty one for a recipe without
    the block.
    """
    return recipe.traceability or Traceability()


def laboratory_of(recipe: Recipe) -> Laboratory:
    """Return the uncertainties stated in a recipe; raise ValueError for a coefficient of an unknown
    quantity.
    """
    statements = stated(recipe)
    stated_names = statements.temperature.coefficients
    unknown_names = [name for name in stated_names if name not in WITH_COEFFICIENT]
    if unknown_names:
        hint = nearest(unknown_names[0], WITH_COEFFICIENT)
        raise ValueError(
            f"traceability.temperature.coefficients: {unknown_names[0]} has no coefficient; {hint}"
        )
    width_in_m = statements.lamp.centroid_uncertainty
    width_in_nm = None if width_in_m is None else 1e9 * width_in_m
    return Laboratory(
        photons=statements.photons.relative_uncertainty,
        photons_distribution=statements.photons.distribution,
        photons_freedom=statements.photons.degrees_of_freedom,
        drift=statements.lamp.drift,
        wavelength=width_in_nm,
        slope=statements.lamp.efficiency_per_nm,
        temperature=statements.temperature.uncertainty,
        coefficients=statements.temperature.coefficients,
    )


def is_relative(recipe: Recipe) -> bool:
    """Return True if the recipe states that its photon numbers are known only up to a factor."""
    return stated(recipe).photons.known == "relative"


def without_efficiency(identifiability: Identifiability) -> Identifiability:
    """Return the identifiability for photon numbers known only up to a factor: the quantum
    efficiency is undetermined.
    """
    if EFFICIENCY not in identifiability.kinds:
        return identifiability
    return replace(
        identifiability,
        kinds={**identifiability.kinds, EFFICIENCY: "none"},
        directions=[*identifiability.directions, RELATIVE],
    )


def with_laboratory(
    problem: SensorPosterior, chains: Chains, laboratory: Laboratory, seed: int
) -> Chains:
    """Return the draws of a posterior, widened by the uncertainty of light and temperature.

    Errors of the light change only the quantum efficiency, independently of all other parameters;
    an error of the temperature changes all parameters with a coefficient together.
    """
    values = problem.parameters(chains.draws)
    factors = _factors(laboratory, list(values), chains.log.shape, seed)
    if not factors:
        return chains
    values |= {name: values[name] * torch.from_numpy(factor) for name, factor in factors.items()}
    return replace(chains, draws=problem.theta(values))


def _factors(
    laboratory: Laboratory, names: Sequence[str], shape: tuple[int, ...], seed: int
) -> dict[str, FloatArray]:
    """Return, by parameter name, a factor for each draw of each parameter that light or temperature
    affect.
    """
    rng = np.random.default_rng([seed, _STREAM])
    factors: dict[str, FloatArray] = {}
    if EFFICIENCY in names:
        for distribution, width in laboratory.light:
            relative_error = _drawn(rng, distribution, width, shape)
            factors[EFFICIENCY] = factors.get(EFFICIENCY, np.ones(shape)) * (1 + relative_error)
    if laboratory.temperature is not None:
        # one error of the temperature moves all parameters together
        kelvin_error = _drawn(rng, "normal", laboratory.temperature, shape)
        for name, coefficient in laboratory.coefficients.items():
            if name in names:
                factors[name] = factors.get(name, np.ones(shape)) * (1 + coefficient * kelvin_error)
    return factors


def _drawn(rng: np.random.Generator, law: str, width: float, shape: tuple[int, ...]) -> FloatArray:
    """Return draws with mean 0 and standard deviation ``width`` from a ``law``: rectangular or
    normal.
    """
    if law == "rectangular":
        # a rectangle of this half width has the standard deviation `width`
        half_width = math.sqrt(3) * width
        return rng.uniform(-half_width, half_width, shape)
    return width * rng.standard_normal(shape)


def relative_widths(laboratory: Laboratory, names: Sequence[str]) -> Mapping[str, float]:
    """Return the relative standard uncertainty that light and temperature add to each parameter, by
    name.
    """
    kelvin_error = laboratory.temperature or 0.0
    light_error = math.hypot(*(uncertainty for _, uncertainty in laboratory.light), 0.0)
    return {
        name: math.hypot(
            light_error * (name == EFFICIENCY),
            kelvin_error * laboratory.coefficients.get(name, 0.0),
        )
        for name in names
    }


def with_laboratory_models(
    models: Sequence[ModelSpread], laboratory: Laboratory
) -> list[ModelSpread]:
    """Return the models with their reported intervals widened by the uncertainty of light and
    temperature.
    """
    widths = relative_widths(laboratory, [model.name for model in models])
    return [replace(model, stated=wider(model.stated, widths[model.name])) for model in models]


# --- budget page ----------------------------------------------------------------------------------

# The uncertainty budget as sections of a page, as a table, as JSON and as a picture.


COLUMNS = (
    "quantity",
    "symbol",
    "unit",
    "value",
    "source",
    "type",
    "distribution",
    "u(x)",
    "unit of x",
    "c",
    "nu",
    "u(y)",
    "reason",
)
_COLOURS = (
    BLUE,
    ORANGE,
    GREEN,
    VERMILION,
    "#CC79A7",
    "#56B4E9",
    "#F0E442",
    BLACK,
    "#999999",
    "#882255",
    "#44AA99",
)
#: keys of the EMVA quantities whose budget the page shows
BUDGETED = (
    "eta",
    "K",
    "sigma_d",
    "mu_p_min",
    "mu_p_sat",
    "mu_e_sat",
    "SNR_max",
    "DR",
    "DSNU1288",
    "PRNU1288",
)
_LEAST_DRAWN_SHARE = 1e-4  #: share of a variance below which a source is not drawn
_TEXT = f"""By the Guide to the expression of uncertainty in measurement (JCGM 100). The combined
    standard uncertainty u_c has all sources that are stated. The expanded uncertainty U is k u_c
    and holds the value with {COVERAGE:.0%}; the coverage factor k is that of Student's t
    distribution with ν_eff degrees of freedom (Welch and Satterthwaite). A source that is not
    stated is missing in u_c: it is not 0."""
_LINES = """Each source with its type (A: from a series of observations; B: by other means), its
    distribution, the standard uncertainty u(x) of the input, the sensitivity c = dy/dx, the degrees
    of freedom ν, the contribution u(y) = c u(x), and its share in the variance of the quantity.
    Sources that do not enter a quantity have no line."""


def budget_sections(
    budgets: Sequence[Budget], traceability: Traceability, picture: bytes | None, note: str = ""
) -> list[Section]:
    """Return the page sections with the budgets, their sources, and the statements of the
    laboratory.

    ``note`` is a sentence on where other budgets are.
    """
    if not budgets:
        return [
            Section("Uncertainty budget", "No quantity has a value, so that none has a budget."),
            *_traced(traceability),
        ]
    columns = (
        "quantity",
        "value",
        "unit",
        "u_c",
        "u_c / value",
        "ν_eff",
        "k",
        f"U ({COVERAGE:.0%})",
        "not stated",
    )
    rows = [_row(budget) for budget in budgets]
    return [
        Section("Uncertainty budget", _TEXT + note, columns, rows, picture),
        Section(
            "Sources of uncertainty",
            _LINES,
            _LINE_COLUMNS,
            list(itertools.chain(*map(_lines, budgets))),
        ),
        *_traced(traceability),
    ]


_LINE_COLUMNS = (
    "quantity",
    "source",
    "type",
    "distribution",
    "u(x)",
    "unit of x",
    "c",
    "ν",
    "u(y)",
    "share",
)


def _row(budget: Budget) -> tuple[Any, ...]:
    """Return the cells of a quantity in the table of budgets, in the order of its columns.

    Value and error are rounded together, so that both end at the same digit.
    """
    value_text, _, error_text = with_uncertainty(budget.value, budget.combined).partition(" ± ")
    relative_text = f"{budget.combined / abs(budget.value):.2%}" if budget.value else "–"
    return (
        _named(budget),
        value_text,
        budget.unit,
        error_text,
        relative_text,
        _freedom(budget.freedom),
        f"{budget.factor:.2f}",
        budget.expanded,
        Marked(", ".join(budget.missing), "warn") if budget.missing else "–",
    )


def _lines(budget: Budget) -> Iterator[tuple[Any, ...]]:
    """Yield a line of the table of sources for each source that enters the quantity.

    A source that is not stated has its reason in place of a distribution, and no numbers.
    """
    name = budget.symbol or budget.name
    for c in budget.contributions:
        if c.reason == NOT_INVOLVED:
            continue
        if c.share is None:
            yield name, c.source, c.kind, c.reason, None, "", None, "", None, ""
        else:
            variance_share = (c.share / budget.combined) ** 2 if budget.combined else 0.0
            yield (
                name,
                c.source,
                c.kind,
                c.distribution,
                c.uncertainty,
                c.unit,
                c.sensitivity,
                _freedom(c.freedom),
                c.share,
                f"{variance_share:.1%}",
            )


def _named(budget: Budget) -> str:
    return f"{budget.symbol}, {budget.name}" if budget.symbol else budget.name


def _freedom(freedom: float) -> str:
    if freedom < 1e4:
        return f"{freedom:.3g}"
    return "∞" if math.isinf(freedom) else f"{freedom:.0e}"


def _traced(traceability: Traceability) -> list[Section]:
    """Return the section on the statements in the block `traceability`, as a list of one."""
    text = """What the block `traceability` of the recipe states of the light and of the
        temperature, so that a value can be traced to a standard."""
    warning = Marked("not stated", "warn")
    rows = [
        (name, warning if value in (None, "not stated") else value)
        for name, value in statements(traceability)
    ]
    return [Section("Traceability", text, ("statement", "value"), rows)]


def statements(traceability: Traceability) -> list[tuple[str, str | None]]:
    """Return the statements of a laboratory as pairs of name and value; None for one that is not
    stated.
    """
    photons, lamp, temperature = traceability.photons, traceability.lamp, traceability.temperature
    relative = photons.relative_uncertainty
    coefficients = "; ".join(f"{name} {x:g} /K" for name, x in temperature.coefficients.items())
    return [
        ("photons", "known up to a factor only" if photons.known == "relative" else "absolute"),
        (
            "relative standard uncertainty of the photons",
            None if relative is None else f"{relative:.3%}",
        ),
        ("certificate of the photometric calibration", photons.certificate),
        ("date of the calibration", photons.date),
        ("laboratory", photons.laboratory),
        ("instrument", photons.instrument),
        ("spectrum of the lamp", lamp.spectrum),
        ("centroid wavelength", _nm(lamp.centroid, lamp.centroid_uncertainty)),
        ("width of the spectrum (FWHM)", _nm(lamp.fwhm)),
        (
            "drift of the lamp since its calibration",
            None if lamp.drift is None else f"{lamp.drift:.3%}",
        ),
        ("temperature of the sensor", _kelvin(temperature.text, temperature.uncertainty)),
        ("temperature coefficients", coefficients or None),
    ]


def of_traceability(traceability: Traceability) -> dict[str, str | None]:
    """Return the statements of a laboratory on the operating point, by the keys of an
    EMVA sheet.
    """
    photons, lamp, temperature = traceability.photons, traceability.lamp, traceability.temperature
    return {
        "wavelength": _nm(lamp.centroid, lamp.centroid_uncertainty),
        "bandwidth": _nm(lamp.fwhm),
        "spectrum": lamp.spectrum,
        "photometer": ", ".join(filter(None, (photons.instrument, photons.certificate))) or None,
        "temperature": _kelvin(temperature.text, temperature.uncertainty),
        "laboratory": ", ".join(filter(None, (photons.laboratory, photons.date))) or None,
    }


def _nm(length: float | None, width: float | None = None) -> str | None:
    """Return a length in m as text in nm, with its uncertainty if stated; None for no length."""
    return (
        None
        if length is None
        else f"{1e9 * length:g}" + f" ± {1e9 * (width or 0):g}" * bool(width) + " nm"
    )


def _kelvin(text: str | None, width: float | None) -> str | None:
    return None if text is None else text + f" ± {width or 0:g} K" * bool(width)


def budget_rows(budgets: Sequence[Budget]) -> Iterator[tuple[Any, ...]]:
    """Yield the rows of ``budget.csv``: one for each source of each quantity."""
    for b in budgets:
        for c in b.contributions:
            numbers = [c.uncertainty, c.unit, c.sensitivity, c.freedom, c.share]
            if c.share is None:
                # a source that is not stated has only its reason
                numbers = [""] * 5
            yield (
                b.key,
                b.symbol,
                b.unit,
                b.value,
                c.source,
                c.kind,
                c.distribution,
                *numbers,
                c.reason,
            )


def budget_document(budgets: Sequence[Budget], traceability: Traceability) -> dict[str, Any]:
    """Return the content of ``budget.json``; infinite degrees of freedom become the text
    ``infinite``.
    """
    return {
        "guide": "JCGM 100:2008 (GUM)",
        "coverage probability": COVERAGE,
        "traceability": {
            name: "not stated" if value is None else value
            for name, value in statements(traceability)
        },
        "quantities": {b.key: _budget(b) for b in budgets},
    }


def _budget(b: Budget) -> dict[str, Any]:
    """Return a budget as a mapping for JSON, with its sources."""
    return {
        "name": b.name,
        "symbol": b.symbol,
        "unit": b.unit,
        "value": b.value,
        "combined standard uncertainty": b.combined,
        "effective degrees of freedom": _finite(b.freedom),
        "coverage factor": b.factor,
        "expanded uncertainty": b.expanded,
        "not stated": list(b.missing),
        "sources": [_contribution(c) for c in b.contributions],
    }


def _contribution(c: Contribution) -> dict[str, Any]:
    """Return a source as a mapping for JSON; a source that is not stated has only its reason."""
    if c.share is None:
        return {"source": c.source, "kind": c.kind, "reason": c.reason}
    values = {name: value for name, value in asdict(c).items() if name != "reason"}
    return {**values, "freedom": _finite(c.freedom), "contribution": c.share}


def _finite(freedom: float) -> float | str:
    return freedom if math.isfinite(freedom) else "infinite"


def two_digits(uncertainty: float) -> str:
    """Return an uncertainty as text with two significant digits and no exponent for large numbers,
    such as 1000 or 710.
    """
    return f"{float(f'{uncertainty:.2g}'):.6g}"


def budget_figure(budgets: Sequence[Budget]) -> Any:
    """Draw the share of each source in the variance of each quantity, as bars that add up
    to 100 %.
    """
    sources = _shown_sources(budgets)
    colours = {source: _COLOURS[i % len(_COLOURS)] for i, source in enumerate(sources)}
    figure, axes = canvas(9.0, 1.5 + 0.36 * len(budgets) + 0.24 * len(sources))
    ax, labelled = axes[0, 0], set[str]()
    for i, budget in enumerate(budgets):
        bar_start = 0.0
        for source, percent in _percentages(budget):
            # each source once in the legend
            label = None if source in labelled else source
            labelled.add(source)
            ax.barh(i, percent, left=bar_start, color=colours[source], label=label, height=0.7)
            bar_start += percent
        text = f"U = {two_digits(budget.expanded)} {budget.unit}".rstrip()
        ax.text(101, i, text, va="center", fontsize=9)
    ax.set_yticks(range(len(budgets)), [b.symbol or b.name for b in budgets])
    ax.set(xlim=(0, 100), xlabel="share of the variance (%)", title="Sources of uncertainty")
    ax.invert_yaxis()
    ax.grid(axis="y", visible=False)
    figure.legend(*ax.get_legend_handles_labels(), loc="outside lower center", ncols=2)
    return figure


def _shown_sources(budgets: Sequence[Budget]) -> list[str]:
    """Return the sources that contribute to any budget, without repetition."""
    sources = dict[str, None]()
    for budget in budgets:
        sources |= dict.fromkeys(c.source for c in budget.contributions if c.share)
    return list(sources)


def _percentages(budget: Budget) -> Iterator[tuple[str, float]]:
    """Yield each source with a share large enough to draw, and its share of the variance in %."""
    for c in budget.contributions:
        percent = 100 * ((c.share or 0.0) / budget.combined) ** 2 if budget.combined else 0.0
        if percent > 100 * _LEAST_DRAWN_SHARE:
            yield c.source, percent


#: function from budgets to the PNG bytes of the picture
budget_picture = drawn(budget_figure)


# --- calibration budget ---------------------------------------------------------------------------

# The uncertainty budget of each parameter of a calibration; its sources add up to the stated
# uncertainty.


_TESTS = "what the tests of the frames leave open"
_PRIOR = "prior of the recipe"
_STEP = 1e-4  #: step of a numerical derivative, in standard deviations of the prior


class _Estimate(NamedTuple):
    """The stated value of a parameter, with the standard uncertainties from its posterior and from
    the choice of model.
    """

    value: float
    posterior: float  #: standard deviation of the mean of two models, before any widening
    #: half the difference between two models of the response; None with only one model
    model: float | None


def budgets(result: CalibrationResult, laboratory: Laboratory) -> list[Budget]:
    """Return the uncertainty budget of each parameter for which the calibration states a value.

    The variance of the posterior is divided among the sources of scatter of the levels by linear
    propagation.
    """
    rows = [row for row in result.rows() if row.kind == "estimate"]
    shares = _shares(result)
    freedom = _calibration_freedom(result)
    return [_calibration_budget(result, row, shares[row.name], freedom, laboratory) for row in rows]


def _calibration_budget(
    result: CalibrationResult,
    row: ParameterEstimate,
    shares: Mapping[str, float],
    freedom: Mapping[str, float],
    laboratory: Laboratory,
) -> Budget:
    """Return the budget of one estimated parameter.

    ``shares`` are the shares of the sources in the variance of its posterior, ``freedom`` their
    degrees of freedom.
    """
    estimate = _estimate(result, row)
    # the efficiency is inverse to the photons, so that a relative error changes its sign
    photon_sensitivity = -estimate.value if row.name == EFFICIENCY else 0.0
    contributions = (
        *_of_posterior(estimate, row.unit, shares, freedom),
        _of_model(row.name, estimate, row.unit),
        _of_tests(result, row, estimate.value),
        *laboratory_contributions(row.name, estimate.value, photon_sensitivity, laboratory),
    )
    return Budget(row.name, row.name.replace("_", " "), "", row.unit, estimate.value, contributions)


def _of_posterior(
    estimate: _Estimate, unit: str, shares: Mapping[str, float], freedom: Mapping[str, float]
) -> Iterator[Contribution]:
    """Yield one contribution for each source of scatter of the levels, and one for the prior."""
    for source, share in shares.items():
        kind: Literal["A", "B"] = "B" if source == _PRIOR else "A"
        degrees_of_freedom = math.inf if source == _PRIOR else freedom.get(source, math.inf)
        standard_uncertainty = estimate.posterior * math.sqrt(share)
        yield Contribution(
            source, kind, "normal", standard_uncertainty, unit, 1.0, degrees_of_freedom
        )


def _of_model(name: str, estimate: _Estimate, unit: str) -> Contribution:
    """Return the contribution of the choice of model; a term of the response itself gets none."""
    if name in TERMS:
        return Contribution(MODEL, "B", reason=NOT_INVOLVED)
    if estimate.model is None:
        return Contribution(MODEL, "B", reason=f"{NOT_STATED}: one model only")
    return Contribution(MODEL, "B", "two points", estimate.model, unit)


def _of_tests(result: CalibrationResult, row: ParameterEstimate, value: float) -> Contribution:
    """Return the contribution of the errors that the tests of the frames cannot exclude."""
    if len(result.frames) < 2:
        return Contribution(_TESTS, "B", reason=f"{NOT_STATED}: only moments are given")
    errors = errors_of_parameters(result.frames, result.problem.coordinates.prior.may_hide)
    relative_error = errors.get(row.name, 0.0)
    if not relative_error:
        return Contribution(_TESTS, "B", reason=NOT_INVOLVED)
    return Contribution(_TESTS, "B", "normal", relative_error, "relative", value)


def _estimate(result: CalibrationResult, row: ParameterEstimate) -> _Estimate:
    """Return the value and the standard uncertainties of a parameter.

    Where the response has several models, they are from the two models with the most terms.
    """
    models = {model.name: model for model in result.models}
    if row.name not in models:
        return _Estimate(row.mean, result.unwidened[row.name], None)
    model = models[row.name]
    is_linear = row.name in result.problem.coordinates.linear
    means_and_sds = [
        _centre_and_width(variant.value, variant.low, variant.high, is_linear)
        for variant in model.models[-2:]
    ]
    (fewer_mean, fewer_sd), (richer_mean, richer_sd) = means_and_sds[0], means_and_sds[-1]
    # a coordinate that is not linear is a logarithm: its width is relative
    scale = 1.0 if is_linear else model.stated.value
    half_distance = abs(fewer_mean - richer_mean) / 2
    return _Estimate(
        model.stated.value, scale * width_of_mean(fewer_sd, richer_sd), scale * half_distance
    )


def _centre_and_width(value: float, low: float, high: float, linear: bool) -> tuple[float, float]:
    """Return mean and standard deviation of a coordinate from a value and its 90 % interval.

    A coordinate that is not linear is the logarithm of its parameter.
    """
    if linear:
        return value, (high - low) / (2 * Z_90)
    return math.log(value), math.log(high / low) / (2 * Z_90)


def _shares(result: CalibrationResult) -> dict[str, dict[str, float]]:
    """Return the share of each source in the variance of the posterior of each parameter."""
    problem, mode = result.problem, result.mode
    slopes = torch.from_numpy(mode.scaled_slopes)
    sources = {STATISTICS: torch.ones(len(slopes), dtype=torch.float64)}
    if isinstance(problem.levels, Levels):
        values = {name: float(x) for name, x in problem.parameters(mode.theta).items()}
        sources = camera_sources(problem.levels, {**result.params, **values})
    whitened_mode = torch.from_numpy(problem.whitened(mode.theta))
    shares: dict[str, dict[str, float]] = {}
    for name, derivative in _derivatives(result, whitened_mode.numpy()).items():
        source_shares = variance_shares(slopes, sources, torch.from_numpy(derivative))
        shares[name] = {
            _PRIOR if source == "prior" else source: share
            for source, share in source_shares.items()
        }
    return shares


def _derivatives(result: CalibrationResult, z: FloatArray) -> dict[str, FloatArray]:
    """Return the derivative (free,) of each parameter per standard deviation of each prior, at
    the mode.
    """
    coordinates = result.problem.coordinates
    offsets = _STEP * np.eye(len(z))
    upper, lower = (
        coordinates.from_whitened(torch.from_numpy(z + sign * offsets)) for sign in (1, -1)
    )
    return {name: ((upper[name] - lower[name]) / (2 * _STEP)).numpy() for name in upper}


def _calibration_freedom(result: CalibrationResult) -> dict[str, float]:
    """Return the degrees of freedom of each source of scatter of the levels; empty for rings."""
    levels = result.problem.levels
    if isinstance(levels, Levels):
        return source_freedom(levels, dict(result.params), result.problem.names)
    return {}
