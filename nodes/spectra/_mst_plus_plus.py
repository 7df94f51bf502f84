"""Estimates of 31 bands from RGB by the neural network MST++."""

from collections.abc import Iterable, Mapping
from pathlib import Path
from typing import Any, Literal, cast

import torch
import torch.nn.functional as F
from torch import Tensor, nn

from neusee.nodes import Check, ParameterError, node
from neusee.nodes.file_headers import archive_needs, safetensors_need
from neusee.nodes.network_weights import empty, wrong_weights
from neusee.nodes.resampling import mirrored
from neusee.nodes.spectra._linear_lift import lift_checks, needs_rgb
from neusee.nodes.units import DataFile
from neusee.nodes.values import Bands

# --- mst plus plus --------------------------------------------------------------------------------

# MST++, a network that reconstructs 31 bands from RGB in three stages of spectral attention.
#
# The modules have the names of the published network, so that the published checkpoint loads
# unchanged: 1 619 625 parameters in 227 tensors. Architecture: Cai et al., CVPRW 2022; reference
# code caiyuanhao1998/MST-plus-plus (MIT).


BANDS = 31


class MSTPlusPlus(nn.Module):
    """The network MST++ from RGB pictures (n, 3, y, x) in [0, 1], of any size, to 31 bands (n,
    31, y, x).
    """

    def __init__(self) -> None:
        super().__init__()
        self.conv_in = _conv(3, BANDS)
        self.body = nn.Sequential(*(Stage(BANDS) for _ in range(3)))
        self.conv_out = _conv(BANDS, BANDS)

    def forward(self, rgb: Tensor) -> Tensor:
        height, width = rgb.shape[-2:]
        first = self.conv_in(mirrored(rgb, -height % 8, -width % 8))
        result: Tensor = self.conv_out(self.body(first)) + first
        return result[..., :height, :width]


class Stage(nn.Module):
    """A stage of MST++: a U-Net with spectral attention, two downsampling steps and a residual
    connection.
    """

    def __init__(self, dim: int) -> None:
        """Build a stage for ``dim`` channels, which each of two halvings of the size doubles."""
        super().__init__()
        self.embedding = _conv(dim, dim)
        self.encoder_layers = nn.ModuleList(
            nn.ModuleList([Blocks(d), nn.Conv2d(d, 2 * d, 4, 2, 1, bias=False)])
            for d in (dim, 2 * dim)
        )
        self.bottleneck = Blocks(4 * dim)
        self.decoder_layers = nn.ModuleList(
            nn.ModuleList(
                [nn.ConvTranspose2d(2 * d, d, 2, 2), nn.Conv2d(2 * d, d, 1, bias=False), Blocks(d)]
            )
            for d in (2 * dim, dim)
        )
        self.mapping = _conv(dim, dim)

    def forward(self, x: Tensor) -> Tensor:
        features, skips = self.embedding(x), []
        for attend, shrink in _parts(self.encoder_layers):
            skips.append(attend(features))
            features = shrink(skips[-1])
        features = self.bottleneck(features)
        for (grow, fuse, attend), skip in zip(
            _parts(self.decoder_layers), reversed(skips), strict=True
        ):
            features = attend(fuse(torch.cat([grow(features), skip], 1)))
        result: Tensor = self.mapping(features) + x
        return result


class Blocks(nn.Module):
    """A transformer block: spectral attention and a feed-forward network, each with a residual
    connection.
    """

    def __init__(self, dim: int) -> None:
        super().__init__()
        self.blocks = nn.ModuleList([nn.ModuleList([SpectralAttention(dim), Normed(dim)])])

    def forward(self, x: Tensor) -> Tensor:
        for attend, feed in _parts(self.blocks):
            x = attend(x) + x
            x = feed(x) + x
        return x


class SpectralAttention(nn.Module):
    """Self-attention between bands: 31 x 31 weights per head, at a cost that is linear in the
    number of pixels.
    """

    def __init__(self, dim: int) -> None:
        """Build the attention of ``dim`` channels, as one head for each 31 of them."""
        super().__init__()
        self.heads = dim // BANDS
        self.to_q, self.to_k, self.to_v = (nn.Linear(dim, dim, bias=False) for _ in range(3))
        self.rescale = nn.Parameter(torch.ones(self.heads, 1, 1))
        self.proj = nn.Linear(dim, dim)
        self.pos_emb = nn.Sequential(_depthwise(dim), nn.GELU(), _depthwise(dim))

    def forward(self, x: Tensor) -> Tensor:
        shape = x.shape
        pixels = x.flatten(2).transpose(1, 2)
        value = self.to_v(pixels).transpose(1, 2)
        query, key, value_heads = (
            t.unflatten(1, (self.heads, -1)) for t in (*self._across(pixels), value)
        )
        scores = (key @ query.transpose(-1, -2)) * self.rescale
        attended = (scores.softmax(-1) @ value_heads).flatten(1, 2).transpose(1, 2)
        result: Tensor = self.proj(attended).transpose(1, 2).reshape(shape) + self.pos_emb(
            value.reshape(shape)
        )
        return result

    def _across(self, pixels: Tensor) -> tuple[Tensor, Tensor]:
        """Return the queries and keys of the attention, with each band normalised to unit length
        over all pixels.
        """
        query, key = (
            F.normalize(projection(pixels).transpose(1, 2), dim=-1)
            for projection in (self.to_q, self.to_k)
        )
        return query, key


class Normed(nn.Module):
    """A layer norm over the bands, followed by a feed-forward network."""

    def __init__(self, dim: int) -> None:
        super().__init__()
        self.fn = FeedForward(dim)
        self.norm = nn.LayerNorm(dim)

    def forward(self, x: Tensor) -> Tensor:
        result: Tensor = self.fn(self.norm(x.movedim(1, -1)).movedim(-1, 1))
        return result


class FeedForward(nn.Module):
    """A feed-forward network with four times as many hidden channels and a depthwise 3 x 3
    convolution.
    """

    def __init__(self, dim: int) -> None:
        """Build the network for ``dim`` channels."""
        super().__init__()
        widening, narrowing = (
            nn.Conv2d(dim, 4 * dim, 1, bias=False),
            nn.Conv2d(4 * dim, dim, 1, bias=False),
        )
        self.net = nn.Sequential(widening, nn.GELU(), _depthwise(4 * dim), nn.GELU(), narrowing)

    def forward(self, x: Tensor) -> Tensor:
        result: Tensor = self.net(x)
        return result


def _parts(layers: nn.ModuleList) -> Iterable[Iterable[nn.Module]]:
    return cast(Iterable[Iterable[nn.Module]], layers)


def _conv(inputs: int, outputs: int) -> nn.Conv2d:
    return nn.Conv2d(inputs, outputs, 3, padding=1, bias=False)


def _depthwise(dim: int) -> nn.Conv2d:
    return nn.Conv2d(dim, dim, 3, padding=1, groups=dim, bias=False)


# --- mst lift node --------------------------------------------------------------------------------

# Estimates of spectra in 31 bands from linear RGB by the neural network MST++.


@node(rtol=1e-3)
def lift_mst_plus_plus(
    rgb: Tensor,
    bands: Bands,
    *,
    weights: DataFile | None = None,
    untrained: Literal["refuse", "allow"] = "refuse",
    rng: torch.Generator,
) -> Tensor:
    """Reconstruct the spectrum of each pixel from RGB by the network MST++.

    The picture is stretched to [0, 1], and the cube is scaled back to keep radiometry. The
    published checkpoint loads unchanged (.pth or .safetensors). Without weights the network
    consists of random orthogonal layers from `rng`: a recipe runs, but the spectra have no meaning.

    Shapes: rgb (3, y, x) -> (31, y, x).
    Units:  linear sRGB to the quantity of the training data, taken as reflectance; negative results
            are clipped.
    Error:  published: relative error 0.16, PSNR 34.3 dB (NTIRE 2022); one pass, without the
            eightfold self-ensemble.
    Raises: ParameterError before the run without weights, or where the weights do not fit the
            network; ValueError unless the bands are 31 from 400 to 700 nm.
    Source: Cai et al., MST++, CVPR Workshops 2022 (NTIRE spectral recovery).
    """
    needs_rgb(rgb)
    need_mst_plus_plus_bands(bands)
    network = _loaded(weights) if weights is not None else _untrained(untrained, rng)
    return torch.relu_(lift_pictures(network.to(rgb), rgb[None])[0])


@lift_mst_plus_plus.reference
def _(
    rgb: Tensor,
    bands: Bands,
    *,
    weights: Path | None = None,
    untrained: str = "refuse",
    rng: torch.Generator,
) -> Tensor:
    result: Tensor = lift_mst_plus_plus.fn(
        rgb.double(), bands, weights=weights, untrained=untrained, rng=rng
    )
    return result


@lift_mst_plus_plus.preflight
def _(*, weights: Path | None = None, untrained: str = "refuse", **params: Any) -> list[str]:
    if weights is not None:
        _fitting(weights)
        return []
    if untrained == "refuse":
        text = (
            "MST++ has no weights: give a checkpoint file in weights, use spectra.lift_lmmse, or"
            " set untrained: allow"
        )
        raise ParameterError("weights", text)
    return ["MST++ is untrained: the spectra have no meaning"]


@lift_mst_plus_plus.check
def _(
    result: Tensor, rgb: Tensor, bands: Bands, *, weights: Path | None = None, **params: Any
) -> list[Check]:
    noise = (
        []
        if weights is not None
        else [Check("MST++ is untrained: the spectra have no meaning", False)]
    )
    return lift_checks(result, rgb, bands) + noise


def lift_pictures(network: nn.Module, rgb: Tensor) -> Tensor:
    """Reconstruct the spectra (n, 31, y, x) of pictures (n, 3, y, x) by the network MST++.

    Each picture is stretched to [0, 1], and the result is scaled back. Negative values are kept.
    """
    darkest, brightest = rgb.amin((1, 2, 3), keepdim=True), rgb.amax((1, 2, 3), keepdim=True)
    span = brightest - darkest
    cube: Tensor = network((rgb - darkest) / span.where(span > 0, 1.0))
    return cube * span + darkest


def start_mst_plus_plus(rng: torch.Generator, linear: Tensor | None = None) -> MSTPlusPlus:
    """Return an MST++ network for training, with random weights or with the weights of a linear
    estimate.

    ``linear`` is the matrix (31, 3) of the linear estimate of spectra from RGB. The skip connection
    around the body then has this matrix, and the last layer starts at 0. Training adds the
    corrections that image structure and a non-linear estimate allow.
    """
    network = _untrained("allow", rng).requires_grad_(True).train()
    if linear is not None:
        with torch.no_grad():
            network.conv_in.weight.zero_()[:, :, 1, 1] = linear.to(network.conv_in.weight)
            network.conv_out.weight.zero_()
    return network


def need_mst_plus_plus_bands(bands: Bands) -> None:
    """Raise ValueError unless the bands are the 31 bands of MST++, from 400 to 700 nm."""
    centres = bands.centres.cpu().double()
    published = torch.linspace(400e-9, 700e-9, BANDS, dtype=torch.float64)
    if len(centres) != BANDS or float((centres - published).abs().max()) > 0.5e-9:
        raise ValueError(
            f"MST++ gives {BANDS} bands from 400 to 700 nm, not {len(centres)} from"
            f" {float(centres[0]) * 1e9:.4g} to {float(centres[-1]) * 1e9:.4g} nm: use these 31"
            " bands, or another node such as spectra.lift_lmmse"
        )


def _empty() -> MSTPlusPlus:
    return empty(MSTPlusPlus).requires_grad_(False).eval()


def _loaded(weights: Path) -> nn.Module:
    network = _empty()
    network.load_state_dict(_fitting(weights), assign=True)
    return network


def _untrained(untrained: str, rng: torch.Generator) -> MSTPlusPlus:
    """Return an MST++ network with random orthogonal weights; raise ValueError unless that is
    allowed.
    """
    if untrained != "allow":
        raise ValueError(
            "MST++ has no weights: give a checkpoint file in weights, or set untrained: allow"
        )
    network = _empty().to_empty(device=rng.device)
    for name, tensor in network.named_parameters():
        # scales begin at 1, biases at 0
        if name.endswith(("rescale", "norm.weight")):
            nn.init.ones_(tensor)
        elif tensor.ndim == 1:
            nn.init.zeros_(tensor)
        else:
            nn.init.orthogonal_(tensor, generator=rng)
    return network


def _fitting(weights: Path) -> dict[str, Tensor]:
    """Read the tensors of a checkpoint file, and raise ParameterError unless they fit MST++ and
    are finite.
    """
    tensors = {name.removeprefix("module."): tensor for name, tensor in _read(weights).items()}
    wrong = _not_fitting(tensors)
    if wrong:
        text = (
            f"{weights} holds {len(tensors)} tensors, and {len(wrong)} tensors do not fit MST++,"
            f" such as {wrong[0]}"
        )
        raise ParameterError("weights", text)
    for name, values in tensors.items():
        if problem := wrong_weights(weights, name, values):
            raise ParameterError("weights", problem)
    return {name: tensor.float() for name, tensor in tensors.items()}


def _not_fitting(tensors: Mapping[str, Tensor]) -> list[str]:
    """Return the names of tensors that MST++ needs in another shape, or does not have."""
    expected = _empty().state_dict()
    shapes = {name: tensor.shape for name, tensor in tensors.items()}
    wrong_shape = [name for name in expected if shapes.get(name) != expected[name].shape]
    return wrong_shape + [name for name in tensors if name not in expected]


def _read(weights: Path) -> dict[str, Tensor]:
    """Read the named tensors of a checkpoint file.

    The file is .safetensors or a pickle that holds only tensors, with or without the key
    `state_dict`.
    """
    is_plain = weights.suffix == ".safetensors"
    if is_plain:
        safetensors_need(weights, parameter="weights")
    else:
        archive_needs(weights, 2.0, "weights")
    try:
        if is_plain:
            from safetensors.torch import load_file

            return load_file(weights)
        content = torch.load(weights, map_location="cpu", weights_only=True)
    except Exception as read_error:  # each library raises its own errors for a broken file
        raise ParameterError(
            "weights", f"{weights} holds no tensors that can be read safely: {read_error}"
        ) from None
    state = content.get("state_dict", content) if isinstance(content, dict) else content
    if not isinstance(state, dict) or not all(isinstance(v, Tensor) for v in state.values()):
        raise ParameterError(
            "weights", f"{weights} is not a state dict: save the output of model.state_dict()"
        )
    return state
