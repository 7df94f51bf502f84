"""Statistical checks of a posterior: chains, mode, and goodness of fit of the model."""

from __future__ import annotations

import math
import warnings
from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from typing import TYPE_CHECKING, Any, Literal, NamedTuple

import numpy as np

from neusee.nodes.calibrate import Likelihood, Rings
from neusee.nodes.values import Levels
from neusee.workflows.calibration.identifiability import Identifiability
from neusee.workflows.calibration.importance_sampling import Guide, draw_guide
from neusee.workflows.calibration.log_posterior import LaplaceFit, SensorPosterior
from neusee.workflows.calibration.posterior_mixture import normalised

if TYPE_CHECKING:
    from numpy.typing import NDArray

    from neusee.workflows.calibration.emcee_sampler import Chains
    from neusee.workflows.calibration.log_posterior import FloatArray


# --- level misfit ---------------------------------------------------------------------------------

# Tests of how the levels of a real camera deviate from its model. The fitted widths would absorb a
# misfit, so that the deviance alone does not show it.


ALARM = 1e-3  #: p-value below which a test fails
_DRAWS = 500  #: draws of the posterior that predict a level left out
_SLOW = 6  #: number of slowest cosine components over the levels
_LEAST_LIT_LEVELS = 10  #: least number of lit levels; with fewer their order tells too little
#: largest relative standard deviations of the light and of the variances for which the model is
#: accepted
BOUNDS = {"lamp": 0.1, "scatter": 0.05}


class Deviations(NamedTuple):
    """The deviation of each measured level from its prediction by the other levels, in standard
    deviations.
    """

    variance: FloatArray  #: (level,), only levels that the fit uses, in rising order of the mean
    mean: FloatArray  #: (level,) as `variance`
    photons: FloatArray  #: (level,)
    exposure: FloatArray  #: (level,) s

    @property
    def lit(self) -> NDArray[np.bool_]:
        """Return (level,) True for a level with light."""
        return self.photons > 0


class Misfit(NamedTuple):
    """The result of one test of the levels: what was found, the criterion, and whether it
    is met.
    """

    name: str
    found: str
    bar: str
    good: bool


def is_camera(problem: SensorPosterior) -> bool:
    """Return True if the likelihood is that of a real camera, whose noise widths are fitted to the
    levels.
    """
    return problem.recipe.steps[problem.step].node.path == "calibrate.camera"


def misfits(
    problem: SensorPosterior, samples: FloatArray, weights: FloatArray, theta: FloatArray
) -> Iterator[Misfit]:
    """Test the levels of a real camera against posterior ``samples`` (draw, free) with ``weights``.

    ``theta`` (free,) is the mode. The fitted widths grow until the deviance is as expected, so that
    the deviance cannot show a misfit. Three things can: a pattern of the deviations along the
    levels, a level that the others do not predict, and widths larger than those of any lamp or
    electronics.
    """
    deviations = left_out(problem, samples, weights)
    yield _prediction(deviations)
    if deviations.lit.sum() >= _LEAST_LIT_LEVELS:
        for name, deviation in (
            ("variances", deviations.variance[deviations.lit]),
            ("means", deviations.mean[deviations.lit]),
        ):
            # Bonferroni correction for two tests: twice the smaller probability
            p_value = min(1.0, 2 * min(runs(deviation), waves(deviation)))
            text = (
                f"{_signs(deviation)} runs of sign over {len(deviation)} levels, slow waves of"
                f" strength {_strength(deviation):.1f}; p = {p_value:.2g}"
            )
            yield Misfit(
                f"the {name} deviate without a trend",
                text,
                f"a p-value above {ALARM}",
                p_value >= ALARM,
            )
    yield from _widths(problem, theta)


def _prediction(deviations: Deviations) -> Misfit:
    """Return the test result for the level that deviates most from its prediction by the others."""
    # Bonferroni correction for two quantities per level, each with two sides
    largest_allowed = _limit(ALARM / (4 * len(deviations.variance)))
    quantity, worst_deviations = max(
        (("variance", deviations.variance), ("mean", deviations.mean)),
        key=lambda pair: np.abs(pair[1]).max(),
    )
    level_number = int(np.abs(worst_deviations).argmax())
    light = (
        f"of {deviations.photons[level_number]:.5g} photons"
        if deviations.photons[level_number]
        else "without light"
    )
    text = (
        f"the {quantity} of the level {light} and {deviations.exposure[level_number]:.4g} s"
        f" deviates by {worst_deviations[level_number]:+.1f} sd from its "
    )
    text, is_good = (
        f"{text}prediction by the other levels",
        abs(worst_deviations[level_number]) <= largest_allowed,
    )
    if not is_good:
        why = (
            "its light or exposure may differ from the stated value"
            if quantity == "mean"
            else "its frames may be disturbed"
        )
        text += f": {why}; measure this level again, or remove it"
    return Misfit(
        "each level is predicted by the others", text, f"at most {largest_allowed:.1f} sd", is_good
    )


def _widths(problem: SensorPosterior, theta: FloatArray) -> Iterator[Misfit]:
    """Yield a test of each fitted width: a larger width would hide a misfit as scatter."""
    params = problem.recipe.steps[problem.step].params
    values = {**params, **{name: float(x) for name, x in problem.parameters(theta).items()}}
    words = {
        "lamp": "the light varies from level to level",
        "scatter": "the variances vary more than chance explains",
    }
    for name, bound in BOUNDS.items():
        text = f"{words[name]} by {values[name]:.2%}"
        yield Misfit(
            f"the {name} is as small as in a laboratory",
            text,
            f"at most {bound:.0%}",
            values[name] <= bound,
        )


def left_out(problem: SensorPosterior, samples: FloatArray, weights: FloatArray) -> Deviations:
    """Return the deviation of each level from its prediction by all other levels.

    Draws of the posterior are weighted by the inverse likelihood of the level. The weighted
    probability of a smaller value than measured is converted to standard deviations of a normal
    distribution.
    """
    from scipy.special import ndtr, ndtri

    rng = np.random.default_rng(3)
    draws = samples[rng.choice(len(samples), _DRAWS, p=weights)]
    prediction = problem.likelihood(draws)
    # (draw, level)
    variance_residual, log_variance_sd, mean_residual, log_mean_sd = np.split(
        prediction.scaled.numpy(), 4, axis=-1
    )
    log_likelihood = (
        -0.5 * (variance_residual**2 + mean_residual**2) - log_variance_sd - log_mean_sd
    )
    # weighting by the inverse likelihood of a level removes this level from the posterior
    inverse_weight = np.exp(-(log_likelihood - log_likelihood.min(0)))
    # truncated importance sampling
    inverse_weight = np.minimum(
        inverse_weight, inverse_weight.mean(0) * math.sqrt(len(inverse_weight))
    )
    inverse_weight /= inverse_weight.sum(0)
    tiny = 1e-12
    # probability of a smaller value than measured, converted to standard deviations
    normal_scores = [
        ndtri(np.clip((inverse_weight * ndtr(x)).sum(0), tiny, 1 - tiny))
        for x in (variance_residual, mean_residual)
    ]
    levels = problem.levels
    assert isinstance(levels, Levels)
    is_fitted = prediction.degrees_of_freedom.numpy() > 0
    by_mean = np.argsort(levels.mean.numpy()[is_fitted])
    return Deviations(
        *(
            x[by_mean]
            for x in (
                *normal_scores,
                levels.photons.numpy()[is_fitted],
                levels.exposure.numpy()[is_fitted],
            )
        )
    )


def runs(z: FloatArray) -> float:
    """Return the probability that chance gives so few runs of equal sign or fewer (Wald and
    Wolfowitz 1940).
    """
    from scipy.special import ndtr

    above_count, below_count = int((z > 0).sum()), int((z <= 0).sum())
    if not above_count or not below_count:
        # all signs equal: probability 1/2 for each level, for either sign
        return float(2.0 ** (1 - len(z)))
    expected_runs = 1 + 2 * above_count * below_count / len(z)
    variance = (expected_runs - 1) * (expected_runs - 2) / (len(z) - 1)
    # continuity correction of half a run
    return float(ndtr((_signs(z) + 0.5 - expected_runs) / math.sqrt(max(variance, 1e-12))))


def _signs(z: FloatArray) -> int:
    """Return the number of runs of equal sign in ``z``."""
    return 1 + int((np.diff(z > 0)).sum())


def _strength(z: FloatArray) -> float:
    """Return the sum of squares of the slowest cosine components of ``z``, which is scaled down if
    its mean square exceeds 1.
    """
    from scipy.fft import dct

    scale = max(1.0, float(np.square(z).mean()))
    # the cosine transform has its slowest components first
    return float((dct(z, norm="ortho")[:_SLOW] ** 2).sum() / scale)


def waves(z: FloatArray) -> float:
    """Return the probability that chance alone gives slow waves over the levels at least this
    strong.
    """
    # for white noise, the share of k of n components has a beta distribution
    from scipy.special import betainc

    square_sum = float(np.square(z).sum())
    slow_share = (
        min(1.0, _strength(z) * max(1.0, float(np.square(z).mean())) / square_sum)
        if square_sum
        else 0.0
    )
    return float(1 - betainc(_SLOW / 2, (len(z) - _SLOW) / 2, slow_share))


def _limit(probability: float) -> float:
    from scipy.special import ndtri

    return float(-ndtri(probability))


# --- posterior checks -----------------------------------------------------------------------------

# Statistical checks of a posterior: chains, mode, importance sampling, and goodness of fit of the
# model.


Mark = Literal["pass", "warn", "fail"]
MISFIT = 1e-3  #: p-value below which chance does not explain a deviance
_IMPOSSIBLE_LOG_WEIGHT = -1e6  #: log weight of an impossible sample
# largest R-hat; least effective sample size; range of the share of accepted moves
_RHAT, _INDEPENDENT, _ACCEPTED = 1.01, 1000.0, (0.1, 0.7)
# k-hat below which a disagreement is a failure; largest relative difference of widths; largest
# difference of means in sd; largest distance of the best draw from the mode in log posterior
_TAIL, _SD, _MEAN, _BELOW = 0.5, 0.05, 0.1, 2.0
_WEIGHTED = 0.1  #: least effective sample size of weighted draws, as a share of their number
#: number of slowest cosine components over the rings, and the p-value below which chance does not
#: explain them
_SLOW_MIXING, SLOW_P_VALUE = 8, 5e-3
#: largest distance of a mean from the middle of its prior, in standard deviations of the prior
LARGEST_SURPRISE = 3.5
_LUCK = 4.0  #: standard errors by which the widths of two samples may differ by chance


@dataclass(frozen=True)
class Check:
    """The result of one check of a posterior."""

    name: str
    found: str
    bar: str  #: the criterion that must be met
    mark: Mark


@dataclass(frozen=True)
class GoodnessOfFit:
    """The deviance of all light levels, and the probability of a deviance at least this large by
    chance.
    """

    deviance: float
    freedom: float  #: degrees of freedom
    p: float

    @property
    def good(self) -> bool:
        """Return True if chance alone can explain the deviance."""
        return self.p >= MISFIT


@dataclass(frozen=True)
class ImportanceSamples:
    """Importance samples of the posterior, with Pareto-smoothed weights."""

    samples: FloatArray  #: (draw, free)
    weights: FloatArray  #: (draw,) sum 1
    tail: float  #: Pareto k-hat; above 0.7 the weights are unreliable
    guide: Guide  #: the density from which the samples were drawn

    def mean(self) -> FloatArray:
        """Return the weighted mean (free,) of the samples."""
        mean: FloatArray = self.weights @ self.samples
        return mean

    def sd(self) -> FloatArray:
        """Return the weighted standard deviation (free,) of the samples."""
        sd: FloatArray = np.sqrt(self.weights @ (self.samples - self.mean()) ** 2)
        return sd

    def doubt(self, like: FloatArray) -> FloatArray:
        """Return the relative standard error of each standard deviation; the kurtosis is that of
        the draws ``like``.
        """
        z = (like - like.mean(0)) / like.std(0)
        error: FloatArray = np.sqrt(((z**4).mean(0) - 1) * (self.weights**2).sum() / 4)
        return error


def arviz() -> Any:
    """Import and return ArviZ; raise `ImportError` with the command to install it if that fails."""
    try:
        with warnings.catch_warnings():
            warnings.simplefilter("ignore")  # ArviZ warns of its next version
            import arviz as library
    except ImportError:
        raise ImportError(
            'calibration needs arviz and h5py: pip install "neusee[calibrate]"'
        ) from None
    return library


def importance_samples(problem: SensorPosterior, mode: LaplaceFit, seed: int) -> ImportanceSamples:
    """Draw importance samples from the posterior, and return them with Pareto-smoothed weights."""
    guide = draw_guide(problem, mode, np.random.default_rng(seed))
    log_weights = guide.log
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")
        smoothed, tail = arviz().psislw(
            np.where(
                np.isfinite(log_weights), log_weights - log_weights.max(), _IMPOSSIBLE_LOG_WEIGHT
            )
        )
    return ImportanceSamples(guide.samples, normalised(smoothed), float(tail), guide)


def checks(
    problem: SensorPosterior,
    mode: LaplaceFit,
    identifiability: Identifiability,
    chains: Chains,
    law: ImportanceSamples,
) -> list[Check]:
    """Return the results of all checks of a posterior; if one fails, the posterior is not fit for
    use.
    """
    return [
        *_of_chains(chains),
        *_of_peak(problem, mode, identifiability, chains, law),
        *data_checks(problem, mode, identifiability, law),
    ]


def _of_chains(chains: Chains) -> Iterator[Check]:
    """Yield the checks of the chains: length, agreement, effective size, acceptance and stranded
    walkers.

    They are of length, agreement, effective size, acceptance and stranded walkers.
    """
    from neusee.workflows.calibration import emcee_sampler

    length_in_tau = chains.steps / chains.tau
    yield Check(
        "chains are long enough",
        f"the chains are {length_in_tau:.0f} autocorrelation times long",
        "at least 50 autocorrelation times, with a stable estimate",
        _mark(chains.long),
    )
    coordinates = np.moveaxis(chains.draws, -1, 0)
    rhat = max(map(_rhat, coordinates))
    yield Check("ensembles agree", f"R-hat {rhat:.4f}", f"at most {_RHAT}", _mark(rhat <= _RHAT))
    bulk_size, tail_size = (
        min(_effective_sample_size(draws, method) for draws in coordinates)
        for method in ("bulk", "tail")
    )
    yield Check(
        "draws are numerous enough",
        f"effective sample size {bulk_size:.0f}, {tail_size:.0f} in the tails",
        f"each at least {_INDEPENDENT:.0f} draws",
        _mark(min(bulk_size, tail_size) >= _INDEPENDENT),
    )
    least_accepted, largest = _ACCEPTED
    is_accepted = least_accepted <= chains.accepted <= largest
    yield Check(
        "moves are accepted",
        f"{chains.accepted:.0%} of the proposed moves are accepted",
        f"{least_accepted:.0%} to {largest:.0%}",
        _mark(is_accepted, "warn"),
    )
    # R-hat does not show stranded walkers if all ensembles have them
    stranded_walkers = emcee_sampler.stranded(chains.log)
    text = (
        f"{stranded_walkers} walkers lie {chains.log.shape[0] * chains.log.shape[2]} nats below"
        " the rest"
    )
    yield Check("no walker is stranded", text, "none", _mark(stranded_walkers == 0))


def _of_peak(
    problem: SensorPosterior,
    mode: LaplaceFit,
    identifiability: Identifiability,
    chains: Chains,
    law: ImportanceSamples,
) -> Iterator[Check]:
    """Yield checks that search, chains and importance sampling found the same peak of the
    posterior.
    """
    search_text = "settled" if mode.settled else "the search stopped"
    yield Check("the search found the mode", search_text, "settled", _mark(mode.settled))
    nats_below = mode.log - float(chains.log.max())
    distance = f"{abs(nats_below):.2g} nats {'below' if nats_below > 0 else 'above'} the mode"
    yield Check(
        "the best draw is near the mode",
        distance,
        f"within {_BELOW:.0f} nats",
        _mark(abs(nats_below) <= _BELOW),
    )
    bent = problem.coordinates.bent
    columns = [
        i
        for i, name in enumerate(problem.names)
        if bent or identifiability.kinds[name] == "estimate"
    ]
    if not columns:
        return
    if bent:
        yield _of_weights(law)
    yield _of_agreement(chains, law, columns)


def _of_weights(law: ImportanceSamples) -> Check:
    """Return the check of the effective sample size of the weighted draws.

    It is 1 over the sum of the squared weights, which sum to 1.
    """
    count = len(law.weights)
    effective_draws = 1 / float((law.weights**2).sum())
    return Check(
        "weighted draws are numerous enough",
        f"effective sample size {effective_draws:.0f} of {count}",
        f"at least {_WEIGHTED * count:.0f}",
        _mark(effective_draws >= _WEIGHTED * count, "warn"),
    )


def _of_agreement(chains: Chains, law: ImportanceSamples, columns: list[int]) -> Check:
    """Return the check that chains and importance sampling give the same widths and means."""
    sd, mean = law.sd()[columns], law.mean()[columns]
    chain_draws = chains.flat[:, columns]
    width_difference = np.abs(chain_draws.std(0) / sd - 1)
    mean_difference = np.max(np.abs(chain_draws.mean(0) - mean) / sd)
    # chance alone explains a few standard errors of a width
    allowed_difference = np.maximum(_SD, _LUCK * law.doubt(chain_draws))
    worst_column = int(np.argmax(width_difference / allowed_difference))
    text = (
        f"widths within {width_difference[worst_column]:.1%}, means {mean_difference:.2f} sd;"
        f" k-hat {law.tail:.2f}"
    )
    bar = f"{allowed_difference[worst_column]:.0%} and {_MEAN} sd, where k-hat is below {_TAIL}"
    agrees = bool((width_difference <= allowed_difference).all()) and mean_difference <= _MEAN
    # weights with a heavy tail prove nothing
    failure: Mark = "fail" if law.tail < _TAIL else "warn"
    return Check("importance sampling agrees with the chains", text, bar, _mark(agrees, failure))


def data_checks(
    problem: SensorPosterior,
    mode: LaplaceFit,
    identifiability: Identifiability,
    law: ImportanceSamples,
) -> Iterator[Check]:
    """Yield checks that the model describes the data and that the data determine the parameters.

    The model must describe them, and they must determine the parameters.
    """
    mode_likelihood = problem.likelihood(mode.theta[None])
    # without a degree of freedom there is nothing to test
    if float(mode_likelihood.degrees_of_freedom.sum()) > len(identifiability.estimated):
        fit = goodness_of_fit(mode_likelihood, len(identifiability.estimated))
        text = (
            f"deviance {fit.deviance:.1f} of {fit.freedom:.0f} degrees of freedom, p = {fit.p:.2g}"
        )
        yield Check(
            "the model of the sensor fits the levels",
            text,
            f"a p-value above {MISFIT}",
            _mark(fit.good),
        )
    if is_camera(problem):
        for misfit in misfits(problem, law.samples, law.weights, mode.theta):
            yield Check(misfit.name, misfit.found, misfit.bar, _mark(misfit.good))
    if isinstance(problem.levels, Rings):
        yield from _of_rings(problem, law, law.guide)
    count = len(identifiability.directions)
    weak_text = f"{count} of {len(identifiability.strengths)} directions are not determined"
    text = weak_text if count else "all parameters are determined"
    yield Check(
        "the levels determine the parameters",
        text,
        "all combinations of parameters determined",
        _mark(not count, "warn"),
    )


def _of_rings(problem: SensorPosterior, law: ImportanceSamples, guide: Guide) -> Iterator[Check]:
    """Yield the checks of a lens: the rings deviate without a trend, and priors and picture agree.

    The rings must have no trend, and priors and picture must agree.
    """
    best_sample = guide.samples[[int(problem.log_posterior(guide.samples).argmax())]]
    prediction = problem.likelihood(best_sample)
    deviation = problem.levels.mean.numpy() - prediction.mean.numpy().reshape(-1)
    strength, p = slow_waves(deviation / np.sqrt(prediction.variance.numpy().reshape(-1)))
    yield Check(
        "the rings deviate from the model without a trend",
        f"slow waves of the deviations over the radius: {strength:.1f}, p = {p:.2g}",
        f"a p-value above {SLOW_P_VALUE}; else one surface does not describe this lens",
        _mark(p >= SLOW_P_VALUE, "warn"),
    )
    prior_distance = law.weights @ problem.whitened(guide.samples)
    worst_column = int(np.abs(prior_distance).argmax())
    text = (
        f"{problem.names[worst_column].replace('_', ' ')} {prior_distance[worst_column]:+.1f}"
        " sd of its prior from the middle"
    )
    surprised = abs(float(prior_distance[worst_column])) > LARGEST_SURPRISE
    bar = f"each mean within {LARGEST_SURPRISE} sd; else prior and picture contradict each other"
    yield Check("the priors agree with the picture", text, bar, _mark(not surprised, "warn"))


def slow_waves(deviation: FloatArray) -> tuple[float, float]:
    """Return the strength of slow waves in the deviations of rings, and the probability of at least
    this strength by chance.

    ``deviation`` (ring,) is in standard deviations. A wrong model deviates in one direction over
    many rings, even if the free scatter of the rings absorbs the size of the misfit. The strength
    is the sum of squares of the slowest components of a cosine transform.
    """
    from scipy.fft import dct
    from scipy.special import chdtrc

    strength = float((dct(deviation, norm="ortho")[:_SLOW_MIXING] ** 2).sum())
    return strength, float(chdtrc(_SLOW_MIXING, strength))


def goodness_of_fit(likelihood: Likelihood, free: int = 0) -> GoodnessOfFit:
    """Return the goodness of fit of one sensor; ``free`` is the number of parameters fitted to the
    same light levels.

    Raises: `ValueError` for a likelihood without deviances, for several sensors, and for no degree
            of freedom.
    """
    from scipy.special import chdtrc

    if not len(likelihood.degrees_of_freedom):
        raise ValueError(
            "the likelihood has no deviances: set told: true in the step of the likelihood"
        )
    if likelihood.deviance.numel() != len(likelihood.degrees_of_freedom):
        shape = tuple(likelihood.deviance.shape)
        raise ValueError(
            f"deviances of shape {shape} belong to several sensors: compute the likelihood of one"
            " sensor"
        )
    deviance = float(likelihood.deviance.sum())
    freedom = float(likelihood.degrees_of_freedom.sum()) - free
    if freedom <= 0:
        raise ValueError(
            f"{freedom + free:.0f} measured numbers cannot test {free} free parameters: give more"
            " levels"
        )
    return GoodnessOfFit(deviance, freedom, float(chdtrc(freedom, deviance)))


def _mark(good: bool, else_: Mark = "fail") -> Mark:
    """Return the mark of a check: `pass` if it holds, else ``else_``."""
    return "pass" if good else else_


def _rhat(draws: FloatArray) -> float:
    """Return R-hat of draws (ensemble, step, walker); an ensemble counts as one chain, because its
    walkers are correlated.
    """
    return float(arviz().rhat(draws.reshape(len(draws), -1)))


def _effective_sample_size(draws: FloatArray, method: str) -> float:
    """Return the effective sample size of draws (ensemble, step, walker) by ``method``, ``bulk`` or
    ``tail``.
    """
    # each walker is a chain of its own here
    chains = draws.transpose(0, 2, 1).reshape(-1, draws.shape[1])
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")  # short chains fail by their effective sample size
        return float(arviz().ess(chains, method=method))


def count_failures(checks: Sequence[Check]) -> int:
    """Return the number of checks that fail."""
    return sum(check.mark == "fail" for check in checks)
