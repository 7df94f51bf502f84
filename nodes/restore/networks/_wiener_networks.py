"""Networks that improve the answer of the Wiener filter, or alternate with the filter."""

from functools import partial
from pathlib import Path
from typing import Annotated, Any

import torch
from pydantic import Field
from torch import Tensor, nn

from neusee.nodes import Check, node
from neusee.nodes.network_weights import loaded, same_layout
from neusee.nodes.precision import exact_convolutions, single
from neusee.nodes.resampling import mirrored, resize
from neusee.nodes.restore.inverse._hidden_pixels import PULLED_STEPS, most_likely, pulled
from neusee.nodes.restore.inverse._masked_blur import Blurred
from neusee.nodes.restore.inverse._wiener import (
    MAPS,
    Doubt,
    LaserLight,
    LeastDoubt,
    Settings,
    View,
    facts,
    pose,
    unpacked,
)
from neusee.nodes.restore.networks._convolutional_networks import NAFNet
from neusee.nodes.restore.networks._restorer import Restorer
from neusee.nodes.units import Count, DataFile, Electrons, Layers
from neusee.nodes.values import Bands, Psf

# --- informed -------------------------------------------------------------------------------------

# A network that improves the answer of the Wiener filter; its inputs are the maps of the filter.


class Informed(Restorer):
    """A NAFNet that corrects the answer of the Wiener filter; its inputs are the maps of
    `restore.filter_facts`.
    """

    def __init__(self, width: int = 16) -> None:
        super().__init__()
        self.body = NAFNet(width, (1, 1, 1), 1, inputs=MAPS, outputs=9)
        self.multiple = self.body.multiple

    def begin(self) -> None:
        self.body.last.weight.zero_()

    def pyramid(self, picture: Tensor, *conditions: Any) -> tuple[Tensor, Tensor]:
        """Return the restored picture at half and at full size: ``picture`` (n, 3, y, x) plus the
        correction of the network.

        ``picture`` is the result of the filter. ``conditions`` are its `FilterFacts` and the matrix
        (3, channel) from electrons to colours, for a single picture, or for n pictures along the
        first axis.
        """
        value, matrix = conditions
        change = self.change(value.answer, value.deviation, value.maps) * value.scale
        fine = picture + torch.einsum("...oc,...cyx->...oyx", matrix.to(change), change).to(picture)
        return resize(fine, -(-picture.shape[-2] // 2), -(-picture.shape[-1] // 2)), fine

    def change(self, answer: Tensor, deviation: Tensor, maps: Tensor) -> Tensor:
        """Return the correction of the answer of the filter ((3, y, x), or n of them), in units of
        the scale of the answer.

        It is the sum of three terms. Each has one output map of the network for each channel: a
        change times the square root of the predicted error, so that certain pixels hardly change; a
        share of the answer, which draws it to the mean of the scene; and a share of the mean of its
        channels, which draws it to grey.
        """
        rows, columns = maps.shape[-2:]
        batch = maps.to(self.body.last.weight).reshape(-1, *maps.shape[-3:])
        padded = mirrored(batch, -rows % self.multiple, -columns % self.multiple)
        network_output: Tensor = self.body.change(padded)[..., :rows, :columns].to(answer)
        # three maps of each channel: factors of sqrt(deviation), of the answer, of its grey
        change_in_deviations, change_in_answer, change_in_grey = torch.tensor_split(
            network_output.reshape(*answer.shape[:-3], -1, rows, columns), 3, -3
        )
        result: Tensor = (
            change_in_deviations * deviation.sqrt()
            + change_in_answer * answer
            + change_in_grey * answer.mean(-3, keepdim=True)
        )
        return result


@node(rtol=1e-5, additive_inputs=[("glare", "nearby"), ("ghosts",)])
def informed(
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
    weights: DataFile | None = None,
    width: Layers = 16,
    balance: Annotated[float, Field(ge=1e-6, le=1e6)] = 1.0,
    doubt: Doubt = 0.0,
    least_doubt: LeastDoubt = 0.0,
    read_noise: Electrons,
) -> Tensor:
    """Deconvolve a picture by `restore.wiener`, and correct the answer by a network that sees what
    the filter knows.

    A small NAFNet sees the maps of `restore.filter_facts`: the answer and its brightness, the
    residual, which pixels are clipped and how certain they are, the glare and what is not known of
    it, and what the frame tells of each pixel and each octave of frequency. So one network serves
    several masks, lasers and noises. Without ``weights`` the restorer is the filter.

    Shapes: as `restore.wiener`, of three channels -> (channel, y, x).
    Units:  as `restore.wiener`.
    Error:  the filter's own; the network is float32, 1e-5. The weights receive no gradients. Of the
            restoration, the error that the training reached: a network may invent what the frame
            does not tell.
    Raises: ParameterError before the run where the weights do not fit; ValueError as
            `restore.wiener`, and for a sensor without three channels.
    Source: Chen et al., Simple Baselines for Image Restoration, ECCV 2022 (NAFNet), with fewer
            blocks; the maps are ours.
    """
    electrons, light = single(electrons), LaserLight(glare, nearby, ghosts)
    if len(electrons) != 3:
        raise ValueError(
            f"electrons {tuple(electrons.shape)} have {len(electrons)} channels, and the network"
            " needs 3"
        )
    view = View(psf, illuminant, responses, bands)
    settings = Settings(balance, read_noise, doubt, least_doubt)
    filtered = facts(pose(electrons, clipped, view, light, settings))
    result = filtered.answer * filtered.scale
    if weights is not None:
        net = (
            loaded(partial(Informed, width), weights)
            .requires_grad_(False)
            .eval()
            .to(electrons.device)
        )
        with (
            exact_convolutions(electrons, deterministic=True),
            torch.autocast(electrons.device.type, enabled=False),
        ):
            result = (
                result
                + net.change(filtered.answer, filtered.deviation, filtered.maps) * filtered.scale
            )
    return (result + filtered.mean).to(electrons)


@informed.preflight
def _(*, weights: Path | None = None, width: int = 16, **others: Any) -> list[str]:
    """Raise ParameterError if the file of weights belongs to another network; say where there is
    none.
    """
    if weights is None:
        return [
            "without weights the informed restorer is the Wiener filter: train them, and give"
            " restore.weights"
        ]
    same_layout(partial(Informed, width), weights, width)
    return []


@informed.check
def _(result: Tensor, electrons: Tensor, *inputs: Any, **params: Any) -> list[Check]:
    # inputs[4] is `clipped`, after psf, illuminant, responses and bands
    share = float(inputs[4].any(-3).double().mean())
    ratio = float(result.mean() / electrons.mean())
    finite = bool(torch.isfinite(result).all())
    return [Check(f"{share:.2%} of pixels clipped, restored mean {ratio:.2f} of raw mean", finite)]


# --- unrolled -------------------------------------------------------------------------------------

# The unrolled Wiener filter: steps that alternate a learned prior and the filter, and the node that
# runs them.


Steps = Annotated[Count, Field(le=16)]
_MAPS_OF_PRIOR = 15  #: number of input maps of a prior: five for each of three channels
#: initial precision of a learned prior, and the half range of its logarithm
_PRECISION, _PRECISION_REACH = 10.0, 5.0
_GLARE_GAIN = 1e3  #: factor of a glare pattern of maximum 1, so that its outer rings are visible


class Unrolled(Restorer):
    """Steps of the Wiener filter, each with a second prior that a network computes from the picture
    of the previous step.

    In each step a network estimates the picture c and the precision of this estimate. The step
    returns the most likely picture given the frame, the prior of the filter, and the estimate c.
    With precision 0 the result is the answer of the filter.
    """

    def __init__(self, width: int = 16, steps: int = 2) -> None:
        """Build ``steps`` networks of ``width`` channels at full size, one for each step."""
        super().__init__()
        self.priors = nn.ModuleList(
            NAFNet(width, (1, 1, 1), 1, inputs=_MAPS_OF_PRIOR, outputs=6) for _ in range(steps)
        )
        self.multiple = 8

    def begin(self) -> None:
        for prior in self.priors:
            assert isinstance(prior, NAFNet)
            prior.last.weight.zero_()

    def pyramid(self, picture: Tensor, *conditions: Any) -> tuple[Tensor, Tensor]:
        """Return the restored picture at half and at full size: ``picture`` (1, 3, y, x) plus the
        correction of the steps.

        ``picture`` is the result of the filter. ``conditions`` are its `WienerProblem` and the
        matrix (3, channel) from electrons to colours.
        """
        value, matrix = conditions
        change = self.change(unpacked(value), value.answer, value.seen) * value.scale
        fine = picture + torch.tensordot(matrix.to(change), change, 1).to(picture)
        return resize(fine, -(-picture.shape[-2] // 2), -(-picture.shape[-1] // 2)), fine

    def change(self, problem: Blurred, answer: Tensor, blurred: Tensor) -> Tensor:
        """Return the sum of the corrections of all steps to the filter's answer (3, y, x);
        ``blurred`` is the answer after the blur of the camera.
        """
        change = blurred_change = torch.zeros_like(answer)
        for prior in self.priors:
            pull, precision = _prior_of(prior, problem, answer + change, blurred + blurred_change)
            change, blurred_change = pulled(problem, change + pull, precision, PULLED_STEPS)
        return change


def _prior_of(
    prior: nn.Module, problem: Blurred, x: Tensor, blurred: Tensor
) -> tuple[Tensor, Tensor]:
    """Return the estimated change (channel, y, x) of the picture of the previous step, and the
    precision (channel, y, x) of this estimate.
    """
    rows, columns = problem.picture.shape[-2:]
    weight = next(prior.parameters())
    maps = mirrored(_maps(problem, x, blurred).to(weight)[None], -rows % 8, -columns % 8)
    change, precision_logarithm = prior.change(maps)[0, :, :rows, :columns].to(x).split(3)  # type: ignore[operator]
    return change, _PRECISION * torch.exp(
        # one precision for each channel: the initial one times exp(-5) to exp(5)
        _PRECISION_REACH * torch.tanh(precision_logarithm.mean((-2, -1), keepdim=True))
    ).expand_as(change)


def _maps(problem: Blurred, x: Tensor, blurred: Tensor) -> Tensor:
    """Return the input maps (15, y, x) of a prior: picture, residual over its noise, certainty,
    unclipped pixels, and glare.
    """
    unclipped = problem.weight > 0
    inverse_deviation = (
        torch.where(unclipped, problem.weight, 1.0).sqrt() * unclipped
    )  # `where` before `sqrt`, whose derivative is infinite at 0
    residual = inverse_deviation * (problem.picture - blurred)
    glare = sum(problem.glare, torch.zeros_like(residual))
    brightest = glare.detach().amax().clamp_min(1e-30)
    # 0 for a clipped pixel, 1 for a noise of 0.7 % of the contrast of the scene
    certainty = problem.weight.log1p() / 10.0
    return torch.cat(
        [
            x,
            residual.asinh(),
            certainty,
            unclipped.to(residual),
            (_GLARE_GAIN / brightest * glare).asinh(),
        ]
    )


@node(rtol=1e-5, additive_inputs=[("glare", "nearby"), ("ghosts",)])
def unrolled(
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
    weights: DataFile | None = None,
    width: Layers = 16,
    steps: Steps = 2,
    balance: Annotated[float, Field(ge=1e-6, le=1e6)] = 1.0,
    doubt: Doubt = 0.0,
    least_doubt: LeastDoubt = 0.0,
    read_noise: Electrons,
) -> Tensor:
    """Deconvolve a picture by `restore.wiener` with a learned prior: the filter and a network take
    turns.

    Each of the ``steps`` asks a small NAFNet of its own what the picture is, c, and how precisely
    it knows this (one precision R for each channel), and gives the most likely picture under the
    frame, the prior of the filter and a Gaussian prior of mean c and precision R in the frame.
    Beyond the frame the precision is 0. The network sees the picture of the step before, the
    residual y - B x over its noise, how certain each pixel is, which pixels are not clipped, and
    the glare. Without ``weights`` the restorer is the filter, and so it is where the network's
    precision is 0.

    Shapes: as `restore.wiener`, of three channels -> (channel, y, x).
    Units:  as `restore.wiener`.
    Error:  the filter's own; in each step conjugate gradients leave 2e-3 to 4e-3 of what the
            network adds (64 pixels a side, behind a half-ring and five half-rings); the network is
            float32, 1e-5. Gradients of first order only; the weights receive none. Of the
            restoration, the error that the training reached: a network may invent what the frame
            does not tell.
    Raises: ParameterError before the run where the weights do not fit; ValueError as
            `restore.wiener`, and for a sensor without three channels.
    Source: unrolling with a data term in each step: Aggarwal et al., MoDL, IEEE Trans. Med. Imaging
            38, 394 (2019); Chen et al., Simple Baselines for Image Restoration, ECCV 2022 (NAFNet);
            the maps are ours.
    """
    electrons, light = single(electrons), LaserLight(glare, nearby, ghosts)
    if len(electrons) != 3:
        raise ValueError(
            f"electrons {tuple(electrons.shape)} have {len(electrons)} channels, and the network"
            " needs 3"
        )
    view = View(psf, illuminant, responses, bands)
    settings = Settings(balance, read_noise, doubt, least_doubt)
    scaled = pose(electrons, clipped, view, light, settings)
    problem, spectrum = scaled.problem, most_likely(scaled.problem)
    result = scaled.pixels(spectrum)
    if weights is not None:
        net = (
            loaded(partial(Unrolled, width, steps), weights)
            .requires_grad_(False)
            .eval()
            .to(electrons.device)
        )
        with (
            exact_convolutions(electrons, deterministic=True),
            torch.autocast(electrons.device.type, enabled=False),
        ):
            change = net.change(problem, problem.first(spectrum), problem.blur(spectrum))
        result = result + change * scaled.scale / scaled.share
    return (result + scaled.mean).to(electrons)


@unrolled.preflight
def _(*, weights: Path | None = None, width: int = 16, steps: int = 2, **others: Any) -> list[str]:
    """Raise ParameterError if the file of weights belongs to another network; say where there is
    none.
    """
    if weights is None:
        return [
            "without weights the unrolled restorer is the Wiener filter: train them, and give"
            " restore.weights"
        ]
    same_layout(partial(Unrolled, width, steps), weights, width)
    return []


@unrolled.check
def _(result: Tensor, electrons: Tensor, *inputs: Any, **params: Any) -> list[Check]:
    # inputs[4] is `clipped`, after psf, illuminant, responses and bands
    share = float(inputs[4].any(-3).double().mean())
    ratio = float(result.mean() / electrons.mean())
    finite = bool(torch.isfinite(result).all())
    return [Check(f"{share:.2%} of pixels clipped, restored mean {ratio:.2f} of raw mean", finite)]
