"""Limits that one draw of noise exceeds in one of 10 000 draws: counts of rare events, sums of squares of noise."""

import math

import torch

SURE = math.log(1e4)  #: negative logarithm of the probability that a draw exceeds its limit


def rare_events(mean: float, sure: float = SURE) -> int:
    """Return the count that a Poisson number of this mean exceeds with a probability of at most exp(-``sure``).

    The count is exact: the smallest with this property. A sum of independent events of unequal probabilities exceeds it
    no more often if the count is at least the mean + 1.

    Source: quantile of the Poisson distribution, whose sum of probabilities is the incomplete gamma function; sums of
    unequal events: Anderson and Samuels, Proc. 5th Berkeley Symp. 1, 1 (1967).
    """
    low, high = -1, max(8, math.ceil(mean + sure + 2.0 * math.sqrt(mean * sure)))
    while high - low > 1:
        middle = (low + high) // 2
        above = torch.special.gammainc(
            torch.tensor(middle + 1.0, dtype=torch.float64), torch.tensor(mean, dtype=torch.float64)
        )
        low, high = (middle, high) if float(above) > math.exp(-sure) else (low, middle)
    return high


def poisson_rms(mean: float, pixels: int) -> float:
    """Return what the rms of Poisson numbers in ``pixels`` exceeds in one of 10 000 draws at most.

    Half of the probability is for a pixel above ``most``, half for the sum of squares of the others, whose variance is
    at most the fourth moment of the distribution.

    Source: Bernstein's inequality: Boucheron, Lugosi and Massart, Concentration Inequalities, section 2.8 (2013).
    """
    if mean == 0:
        return 0.0
    sure = SURE + math.log(2.0)
    most = rare_events(mean, sure + math.log(pixels))
    fourth = mean + 7 * mean**2 + 6 * mean**3 + mean**4
    third = most**2 * sure / 3
    excess = third + math.sqrt(third**2 + 2 * pixels * fourth * sure)
    return min(float(most), math.sqrt((pixels * (mean + mean**2) + excess) / pixels))


def chi_square_limit(weights: float, largest: float, sure: float = SURE) -> float:
    """Return the limit that a weighted sum of squared normal numbers exceeds with a probability of exp(-``sure``).

    ``weights`` is the sum of the weights, ``largest`` the largest weight.

    Source: Laurent and Massart, Ann. Stat. 28, 1302 (2000), lemma 1, with the sum of squared weights at most
    ``weights`` x ``largest``.
    """
    return weights + 2.0 * math.sqrt(weights * largest * sure) + 2.0 * largest * sure


def amplitude_error_drawn(drawn: float, darkest: float, pixels: int) -> float:
    """Return a bound of the rms change of one draw of the noise, if its mean changes by the rms ``drawn``.

    The change of a pixel is a normal number times the root of a weight w, which is at most the change of the mean e,
    and e**2 / ``darkest``. The weights are summed for the worst distribution of the error over the pixels.
    """
    squares = pixels * drawn**2
    largest = math.sqrt(squares)
    weights = math.sqrt(pixels) * largest
    if darkest > 0:
        largest, weights = min(largest, squares / darkest), min(weights, squares / darkest)
    return math.sqrt(chi_square_limit(weights, largest) / pixels)


def amplitude_error(drawn: float, darkest: float) -> float:
    """Return a bound of the rms change of all draws of the noise, if its mean changes by the rms ``drawn``."""
    return math.sqrt(drawn) if darkest <= drawn else drawn / math.sqrt(darkest)
