"""What a deconvolved picture does not know: the standard deviation of each pixel under the model of the filter."""

import math
from typing import Annotated, Any, Literal

import torch
from pydantic import Field
from torch import Generator, Tensor

from neusee.nodes import Check, node
from neusee.nodes._half_precision import single
from neusee.nodes.restore._inverse._frame_spectrum import fitted_power
from neusee.nodes.restore._inverse._hidden_pixels import Inverses, most_likely
from neusee.nodes.restore._inverse._masked_blur import Blurred, blurred, mixed
from neusee.nodes.restore._inverse._wiener import (
    Doubt,
    LeastDoubt,
    Scaled,
    effective_psf,
    known_and_light,
    posed,
    wrapped,
)
from neusee.nodes.units import Electrons
from neusee.nodes.values import Bands, Psf, Shading

Draws = Annotated[int, Field(ge=2, le=4096)]


@node()
def wiener_spread(
    electrons: Tensor,
    psf: Psf,
    illuminant: Tensor,
    responses: Tensor,
    bands: Bands,
    clipped: Tensor,
    matrix: Tensor,
    glare: list[Tensor] | None = None,
    nearby: list[Tensor] | None = None,
    ghosts: list[Tensor] | None = None,
    restored: Tensor | None = None,
    shading: Shading | None = None,
    *,
    balance: Annotated[float, Field(gt=0, allow_inf_nan=False)] = 1.0,
    doubt: Doubt = 0.0,
    least_doubt: LeastDoubt = 0.0,
    draws: Draws = 8,
    law: Literal["filter", "frame"] = "frame",
    read_noise: Electrons,
    rng: Generator,
) -> Tensor:
    """Compute the standard deviation of each pixel that `restore.wiener` deconvolves, and `matrix` converts to colour.

    Each draw is a scene and a picture of this scene with the noise of the filter; the result is the root mean square of
    the errors of the filter on these pictures. Scenes have a power spectrum: with `law` filter that of the prior, so
    that the errors are draws from the posterior; with `law` frame the law A / f^b of the highest Whittle likelihood for
    this frame, because a scene that is rougher than the prior is restored worse than the prior says. Clipped pixels and
    pixels beyond the edge are as unknown as in `restore.wiener`.

    With ``restored``, the picture in colour, and ``shading``, by which the frame was divided, what is not known of the
    shading counts too: its relative deviation times the picture.

    Shapes: as `restore.wiener`, matrix (colour, channel) -> (colour, y, x).
    Units:  those of `restore.colour`; with the unit matrix e-.
    Error:  relative standard deviation 1 / sqrt(2 draws) in each pixel, independent of the picture; the interval of
            90 % is the deviation times the 95 % quantile of Student's t of as many degrees of freedom as draws. The
            deviation holds under the model of the filter: not for light that the filter is not told of, such as a
            laser, not for a wrong PSF, and not for the colour of paints. The iteration adds what `restore.wiener` says.
            Nine frames of 44 pixels a side: intervals of 90 % hold 87 % of the pixels, 72 to 97 % in a single frame.
            The result has a derivative with respect to ``matrix`` alone; draws and fitted power count as constants.
    Raises: ValueError as `restore.wiener`.
    Source: Papandreou and Yuille, Gaussian sampling by local perturbations, NIPS 23 (2010), algorithm 1; Whittle, Arkiv
            for Matematik 2, 423 (1953).
    """
    with torch.no_grad():
        fine, known, light = known_and_light(psf, responses, single(electrons), clipped, glare, nearby, ghosts)
        kernels = effective_psf(psf, illuminant, responses, bands, fine.dtype).to(fine)
        scaled = posed(fine, known, kernels, light, (balance, read_noise, doubt, least_doubt))
        power = scaled.problem.power
        if law == "frame":
            power = fitted_power(scaled.problem, wrapped(kernels / scaled.share, (fine.shape[-2], fine.shape[-1])))
    return with_shading(drawn_deviation(scaled, power, matrix, draws, rng).to(single(electrons)), restored, shading)


def with_shading(deviation: Tensor, restored: Tensor | None, shading: Shading | None) -> Tensor:
    """Return the deviation of a picture (colour, y, x) that includes what is not known of its shading."""
    if restored is None or shading is None:
        return deviation
    return torch.hypot(deviation, (restored * shading.spread).to(deviation).abs())


def drawn_deviation(
    scaled: Scaled, power: Tensor, matrix: Tensor, draws: int, rng: Generator, kernels: Tensor | None = None
) -> Tensor:
    """Return the root mean square error (colour, y, x) of the filter over drawn scenes and noise.

    ``kernels`` (any, channel, y, x) are PSFs that blur these scenes in turn, in place of the PSF of the filter.
    """
    total = scaled.problem.picture.new_zeros(len(matrix), *scaled.problem.picture.shape[-2:])
    inverses = Inverses()
    for number in range(draws):
        with torch.no_grad():
            true = scaled.problem.transfer
            if kernels is not None:
                other = kernels[number % len(kernels)].to(scaled.share) / scaled.share
                true = torch.fft.rfft2(wrapped(other, scaled.problem.torus))
            spectrum, problem = _drawn(scaled.problem, power, rng, true)
            error = scaled.pixels(spectrum - most_likely(problem, inverses=inverses))
        total = total + torch.tensordot(matrix.to(error), error, 1).square()
    return (total / draws).sqrt()


@wiener_spread.check
def _(result: Tensor, *inputs: Any, **params: Any) -> list[Check]:
    least, most = float(result.min()), float(result.max())
    return [Check(f"deviation from {least:.2g} to {most:.2g}", math.isfinite(most) and least >= 0)]


def _drawn(problem: Blurred, power: Tensor, rng: Generator, true: Tensor) -> tuple[Tensor, Blurred]:
    """Return the spectrum of a drawn scene, and the deconvolution of a picture of it through the ``true`` transfer."""
    white = _normal((len(problem.picture), *problem.torus), problem.picture, rng)
    own, shared = _root_of_colour(len(white), problem.grey)
    spectrum = mixed(torch.fft.rfft2(white), own, shared) * power.clamp_min(0.0).sqrt()
    noise = _normal(problem.picture.shape, problem.picture, rng)
    seen = problem.weight > 0
    y, x = problem.picture.shape[-2:]
    picture = blurred(true, spectrum, problem.torus, (y, x)) + torch.where(
        seen, noise / problem.weight.where(seen, 1.0).sqrt(), 0.0
    )
    for pattern in problem.glare[len(problem.glare) - problem.bounded :]:
        picture = picture + _normal((), picture, rng) * pattern
    return spectrum, Blurred(
        picture, problem.weight, problem.transfer, problem.power, problem.torus, problem.grey, problem.glare,
        bounded=problem.bounded,
    )  # fmt: skip


def _root_of_colour(channels: int, grey: float) -> tuple[float, float]:
    """Return (own, shared) such that  own I + shared  is the root of the correlation  (1 - grey) I + grey."""
    own = math.sqrt(1.0 - grey)
    return own, (math.sqrt(1.0 - grey + channels * grey) - own) / channels


def _normal(shape: tuple[int, ...], like: Tensor, rng: Generator) -> Tensor:
    drawn = torch.randn(shape, generator=rng, device=rng.device, dtype=like.dtype)
    return drawn.to(like)
