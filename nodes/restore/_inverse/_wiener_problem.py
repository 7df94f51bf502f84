"""The problem that the Wiener filter solves, as a value: for the training of restorers that begin with its answer."""

from typing import Annotated, Any

import torch
from pydantic import Field
from torch import Tensor

from neusee.nodes import Check, node
from neusee.nodes._half_precision import single
from neusee.nodes.restore._inverse._fft_grid import torus
from neusee.nodes.restore._inverse._hidden_pixels import most_likely
from neusee.nodes.restore._inverse._masked_blur import Blurred
from neusee.nodes.restore._inverse._picture_scale import fall
from neusee.nodes.restore._inverse._psf_on_grid import edge, wrapped
from neusee.nodes.restore._inverse._wiener import GREY, Doubt, LeastDoubt, Scaled, Settings, pose
from neusee.nodes.units import Electrons
from neusee.nodes.values import Bands, Psf, WienerProblem


@node(rtol=1e-5, additive_inputs=[("glare", "nearby"), ("ghosts",)])
def wiener_problem(
    electrons: Tensor,
    psf: Psf,
    illuminant: Tensor,
    responses: Tensor,
    bands: Bands,
    clipped: Tensor,
    glare: list[Tensor] | None = None,
    nearby: list[Tensor] | None = None,
    ghosts: list[Tensor] | None = None,
    *,
    balance: Annotated[float, Field(ge=1e-6, le=1e6)] = 1.0,
    doubt: Doubt = 0.0,
    least_doubt: LeastDoubt = 0.0,
    read_noise: Electrons,
) -> WienerProblem:
    """Pose the deconvolution of `restore.wiener` as a linear problem, and solve it: the answer is that of the filter.

    A training of `restore.unrolled` poses the problem of each picture once, and uses it at each of its iterations.

    Shapes: as `restore.wiener`; those of the result as `WienerProblem` says.
    Units:  e-; the fields of the result as `WienerProblem` says.
    Error:  as `restore.wiener`.
    Raises: ValueError as `restore.wiener`.
    Source: as `restore.wiener`.
    """
    electrons, light = single(electrons), (glare, nearby, ghosts)
    settings = Settings(balance, read_noise, doubt, least_doubt)
    return packed(pose(electrons, psf, illuminant, responses, bands, clipped, *light, settings))


@wiener_problem.check
def _(result: WienerProblem, *inputs: Any, **params: Any) -> list[Check]:
    largest = float(result.answer.abs().max())
    return [Check(f"contrast of the answer up to {largest:.3g} of its scale", largest < float("inf"))]


def packed(scaled: Scaled) -> WienerProblem:
    """Return a posed deconvolution and its answer as a value."""
    problem = scaled.problem
    free = len(problem.glare) - problem.bounded
    none = problem.picture.new_zeros(0, *problem.picture.shape)
    parts = [torch.stack(some) if some else none for some in (problem.glare[:free], problem.glare[free:])]
    spectrum = most_likely(problem)
    scale = scaled.scale / scaled.share
    answer = (problem.first(spectrum), problem.blur(spectrum))
    return WienerProblem._make((problem.picture, problem.weight, scaled.kernels, *parts, *answer, scale, scaled.mean))


def unpacked(value: WienerProblem) -> Blurred:
    """Return the linear problem of a value."""
    frame = (value.picture.shape[-2], value.picture.shape[-1])
    size = torus(frame, edge(value.psf, frame))
    transfer, power = torch.fft.rfft2(wrapped(value.psf, size)), fall(size).to(value.psf)
    glare = (*value.glare, *value.doubts)
    return Blurred(value.picture, value.weight, transfer, power, size, GREY, glare, bounded=len(value.doubts))
