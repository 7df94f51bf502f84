"""The power spectrum of a scene, fitted to a blurred and noisy frame of it: how fast it falls, and how strong it is."""

import torch
from torch import Tensor

from neusee.nodes.restore._inverse._masked_blur import Blurred, Size

_SLOPES = (1.5, 4.5, 13)  #: first, last and number of the exponents that are tried
_POWERS = (-4.0, 4.0, 49)  #: of e, times the variance of the frame
_MOST = 20_000  #: frequencies that count, at most
_LOWEST = 3.0  #: cycles in the picture, below which the window mixes frequencies


def fitted_power(problem: Blurred, kernels: Tensor) -> Tensor:
    """Return the power spectrum of the scene, half a spectrum of the torus, of the highest Whittle likelihood.

    The law is A (f^2 + 1 / pixels)^(-b / 2), as the prior of the filter, whose b is 3. Unseen pixels count as the mean.
    """
    y, x = problem.picture.shape[-2:]
    window = (torch.hann_window(y)[:, None] * torch.hann_window(x)).to(problem.picture)
    seen = problem.picture.detach() * (problem.weight > 0)
    found = torch.fft.rfft2(seen * window).abs().square() / window.square().sum()
    through = torch.fft.rfft2(kernels.detach()).abs().square()
    squared = _squared((y, x)).to(found)
    noise = _noise(problem)
    far = (squared > (_LOWEST / min(y, x)) ** 2).expand_as(found)
    step = max(1, int(far.sum()) // _MOST)
    frequency, power, passed, level = (
        part.expand_as(found)[far][::step].double()
        for part in (squared + 1.0 / (y * x), found, through, noise[:, None, None])
    )
    least, slope, strength = float("inf"), 3.0, 0.0
    for exponent in torch.linspace(*_SLOPES[:2], int(_SLOPES[2])).tolist():
        law = frequency ** (-exponent / 2) * passed
        unit = float(seen.square().mean()) / float((frequency ** (-exponent / 2)).mean())
        for log in torch.linspace(*_POWERS[:2], int(_POWERS[2])).tolist():
            expected = unit * 2.718281828459045**log * law + level
            loss = float((expected.log() + power / expected).mean())
            if loss < least:
                least, slope, strength = loss, exponent, unit * 2.718281828459045**log
    whole: Tensor = strength * (_squared(problem.torus).to(found) + 1.0 / (y * x)) ** (-slope / 2)
    return whole


def _noise(problem: Blurred) -> Tensor:
    """Return the mean variance of the noise in the seen pixels of each channel."""
    seen = problem.weight > 0
    variance = torch.where(seen, 1.0 / problem.weight.where(seen, 1.0), 0.0).detach()
    total: Tensor = variance.sum((-2, -1)) / seen.sum((-2, -1)).clamp_min(1)
    return total


def _squared(size: Size) -> Tensor:
    """Return the squared frequencies in cycles per pixel, half a spectrum."""
    fy, fx = torch.fft.fftfreq(size[0]), torch.fft.rfftfreq(size[1])
    squared: Tensor = fy[:, None].square() + fx.square()
    return squared
