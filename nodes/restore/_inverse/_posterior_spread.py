"""What a deconvolved picture does not know: the standard deviation of each pixel under the model of the filter."""

import math
from dataclasses import replace
from typing import Annotated, Any, Literal

import torch
from pydantic import Field
from torch import Generator, Tensor

from neusee.nodes import Check, node
from neusee.nodes._half_precision import single
from neusee.nodes.restore._inverse._frame_deviation import drawn_noise, drawn_scene, frame_deviation
from neusee.nodes.restore._inverse._grey_psf import effective_psf, grey_white
from neusee.nodes.restore._inverse._hidden_pixels import Inverses, most_likely
from neusee.nodes.restore._inverse._wiener import Border, Doubt, LeastDoubt, Scaled, Settings, known_and_light, posed
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
    balance: Annotated[float, Field(ge=1e-6, le=1e6)] = 1.0,
    doubt: Doubt = 0.0,
    least_doubt: LeastDoubt = 0.0,
    scatter: bool = False,
    border: Border = 1.0,
    draws: Draws = 8,
    law: Literal["filter", "frame"] = "frame",
    read_noise: Electrons,
    rng: Generator,
) -> Tensor:
    """Compute the standard deviation of each pixel that `restore.wiener` deconvolves, and `matrix` converts to colour.

    Each draw is a scene, or noise, that the filter restores; the variance is that of the errors. With `law` filter the
    scenes have the power spectrum of the prior, so that the errors of scene and noise are draws from the posterior.
    With `law` frame they have the spectrum A / f^b of the highest debiased Whittle likelihood for this frame, and the
    noise has a factor of the same fit, because a scene that is rougher than the prior is restored worse than the prior
    says. The frame itself is then one of the draws: where the restored frame has more details (differences from the
    mean over 5 x 5 pixels) than the restored draws have, errors are larger, and where it is even, errors of details
    are smaller, unless no details could be restored. Low frequencies of photographs vary about a power law: errors
    averaged over 11 x 11 pixels have twice the variance. Clipped pixels, and the ``border`` beyond the edge, are as
    unknown as in `restore.wiener`.

    With ``scatter`` the mean and the contrast of the scene are as doubtful as the glare leaves them, given that a
    camera is mostly exposed to a seventh of the fullest pixel, to a factor of three, and that the deviation of a scene
    is 0.8 of its mean, to a factor of 1.6; and scattered light has blotches of 16 pixels, with 0.4 of the deviation of
    its speckle.

    With ``restored``, the picture in colour, and ``shading``, by which the frame was divided, what is not known of the
    shading counts too: its relative deviation times the picture.

    Shapes: as `restore.wiener`, matrix (colour, channel) -> (colour, y, x).
    Units:  those of `restore.colour`; with the unit matrix e-.
    Error:  with `law` filter a relative standard deviation of 1 / sqrt(2 draws) in each pixel, independent of the
            picture; with `law` frame less, because variances are averaged over 7 x 7 pixels. The interval of 90 % is
            the deviation times the 95 % quantile of Student's t of four degrees of freedom for each draw. The deviation
            holds under the model of the filter: not for light that the filter is not told of, such as a laser, nor for
            a wrong PSF, and not for the colour of paints. The iteration adds what `restore.wiener` says. On 60
            photographs behind three masks, lasers of 0 to 1e6 found by the search, intervals of 90 % hold 92.6 % of the
            pixels; of a single frame 45 to 100 %, least behind a mask that spreads light over most of the frame.
            The result has a derivative with respect to ``matrix`` alone; draws and fitted power count as constants.
    Raises: ValueError as `restore.wiener`.
    Source: Papandreou and Yuille, Gaussian sampling by local perturbations, NIPS 23 (2010), algorithm 1; Sykulski,
            Olhede, Guillaumin, Lilly and Early, Biometrika 106, 251 (2019).
    """
    with torch.no_grad():
        fine, known, light = known_and_light(psf, responses, single(electrons), clipped, glare, nearby, ghosts)
        kernels = effective_psf(psf, illuminant, responses, bands, fine.dtype).to(fine)
        white = grey_white(illuminant, responses, bands).to(fine)
        settings = Settings(balance, read_noise, doubt, least_doubt, scatter, border)
        scaled = posed(fine, known, kernels, light, settings, white)
    drawn = drawn_deviation if law == "filter" else frame_deviation
    return with_shading(drawn(scaled, matrix, draws, rng).to(single(electrons)), restored, shading)


def with_shading(deviation: Tensor, restored: Tensor | None, shading: Shading | None) -> Tensor:
    """Return the deviation of a picture (colour, y, x) that includes what is not known of its shading."""
    if restored is None or shading is None:
        return deviation
    return torch.hypot(deviation, (restored * shading.spread).to(deviation).abs())


def drawn_deviation(scaled: Scaled, matrix: Tensor, draws: int, rng: Generator) -> Tensor:
    """Return the root mean square error (colour, y, x) of the filter over scenes and noise drawn from its prior."""
    problem, inverses = scaled.problem, Inverses()
    total = problem.picture.new_zeros(len(matrix), *problem.picture.shape[-2:])
    for _ in range(draws):
        with torch.no_grad():
            scene = drawn_scene(problem, problem.power, rng)
            picture = problem.blur(scene) + drawn_noise(problem, rng)
            error = scaled.pixels(scene - most_likely(replace(problem, picture=picture), inverses=inverses))
        total = total + torch.tensordot(matrix.to(error), error, 1).square()
    return (total / draws).sqrt()


@wiener_spread.check
def _(result: Tensor, *inputs: Any, **params: Any) -> list[Check]:
    least, most = float(result.min()), float(result.max())
    return [Check(f"deviation from {least:.2g} to {most:.2g}", math.isfinite(most) and least >= 0)]
