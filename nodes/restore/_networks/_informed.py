"""A network that goes on from the answer of the Wiener filter, and sees what the filter knows."""

from functools import partial
from pathlib import Path
from typing import Annotated, Any

import torch
from pydantic import Field
from torch import Tensor

from neusee.nodes import Check, node
from neusee.nodes._half_precision import single
from neusee.nodes._mirror_padding import mirrored
from neusee.nodes.bicubic_resize import resize
from neusee.nodes.exact_convolution import exact_convolutions
from neusee.nodes.network_weights import loaded, same_layout
from neusee.nodes.restore._inverse._filter_facts import MAPS, facts
from neusee.nodes.restore._inverse._wiener import Doubt, LeastDoubt, Settings, pose
from neusee.nodes.restore._networks._nafnet import NAFNet
from neusee.nodes.restore._networks._restorer import Restorer
from neusee.nodes.units import DataFile, Electrons, Layers
from neusee.nodes.values import Bands, Psf


class Informed(Restorer):
    """A NAFNet that changes the answer of the Wiener filter, given the maps of `restore.filter_facts`."""

    def __init__(self, width: int = 16) -> None:
        super().__init__()
        self.body = NAFNet(width, (1, 1, 1), 1, inputs=MAPS, outputs=9)
        self.multiple = self.body.multiple

    def begin(self) -> None:
        self.body.last.weight.zero_()

    def pyramid(self, picture: Tensor, *given: Any) -> tuple[Tensor, Tensor]:
        """Return the restored picture at half and at full size: ``picture`` (n, 3, y, x) and what the network changes.

        ``picture`` is what the filter restores; ``given`` are its `FilterFacts`, and the matrix (3, channel) from
        electrons to colours, of a single picture or of n pictures along a first axis.
        """
        value, matrix = given
        change = self.change(value.answer, value.deviation, value.maps) * value.scale
        fine = picture + torch.einsum("...oc,...cyx->...oyx", matrix.to(change), change).to(picture)
        return resize(fine, -(-picture.shape[-2] // 2), -(-picture.shape[-1] // 2)), fine

    def change(self, answer: Tensor, deviation: Tensor, maps: Tensor) -> Tensor:
        """Return what the network adds to the answer of the filter (3, y, x), or to n of them, in units of its scale.

        It is the sum of three parts, each with a map of the network for each channel: a change, multiplied by the root
        of the predicted error, so that what is certain hardly changes; a share of the answer, which draws it to the
        mean of the scene; and a share of the mean of its channels, which draws it to grey.
        """
        rows, columns = maps.shape[-2:]
        each = maps.to(self.body.last.weight).reshape(-1, *maps.shape[-3:])
        whole = mirrored(each, -rows % self.multiple, -columns % self.multiple)
        told: Tensor = self.body.change(whole)[..., :rows, :columns].to(answer)
        free, share, grey = torch.tensor_split(told.reshape(*answer.shape[:-3], -1, rows, columns), 3, -3)
        result: Tensor = free * deviation.sqrt() + share * answer + grey * answer.mean(-3, keepdim=True)
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
    scatter: bool = False,
    read_noise: Electrons,
) -> Tensor:
    """Deconvolve a picture by `restore.wiener`, and correct the answer by a network that sees what the filter knows.

    A small NAFNet sees the maps of `restore.filter_facts`: the answer and its brightness, the residual, which pixels
    are clipped and how certain they are, the glare and what is not known of it, and what the frame tells of each pixel
    and each octave of frequency. So one network serves several masks, lasers and noises. Without ``weights`` the
    restorer is the filter. ``scatter`` as `restore.wiener`; the weights that ship were trained without it.

    Shapes: as `restore.wiener`, of three channels -> (channel, y, x).
    Units:  as `restore.wiener`.
    Error:  the filter's own; the network is float32, 1e-5. The weights receive no gradients. Of the restoration, the
            error that the training reached: a network may invent what the frame does not tell.
    Raises: ParameterError before the run where the weights do not fit; ValueError as `restore.wiener`, and for a
            sensor without three channels.
    Source: Chen et al., Simple Baselines for Image Restoration, ECCV 2022 (NAFNet), with fewer blocks; the maps are
            ours.
    """
    electrons, light = single(electrons), (glare, nearby, ghosts)
    if len(electrons) != 3:
        raise ValueError(f"electrons {tuple(electrons.shape)} have {len(electrons)} channels, and the network needs 3")
    settings = Settings(balance, read_noise, doubt, least_doubt, scatter)
    found = facts(pose(electrons, psf, illuminant, responses, bands, clipped, *light, settings))
    result = found.answer * found.scale
    if weights is not None:
        net = loaded(partial(Informed, width), weights).requires_grad_(False).eval().to(electrons.device)
        with exact_convolutions(electrons, deterministic=True), torch.autocast(electrons.device.type, enabled=False):
            result = result + net.change(found.answer, found.deviation, found.maps) * found.scale
    return (result + found.mean).to(electrons)


@informed.preflight
def _(*, weights: Path | None = None, width: int = 16, **others: Any) -> list[str]:
    """Raise ParameterError if the file of weights belongs to another network; say where there is none."""
    if weights is None:
        return ["without weights the informed restorer is the Wiener filter: train them, and give restore.weights"]
    same_layout(partial(Informed, width), weights, width)
    return []


@informed.check
def _(result: Tensor, electrons: Tensor, *inputs: Any, **params: Any) -> list[Check]:
    share = float(inputs[4].any(-3).double().mean())
    ratio = float(result.mean() / electrons.mean())
    finite = bool(torch.isfinite(result).all())
    return [Check(f"{share:.2%} of pixels clipped, restored mean {ratio:.2f} of raw mean", finite)]
