"""Estimates of spectra in 31 bands from linear RGB by the neural network MST++."""

from pathlib import Path
from typing import Any, Literal

import torch
from torch import Tensor, nn

from neusee.nodes import Check, ParameterError, node
from neusee.nodes.array_bytes import archive_needs, safetensors_need
from neusee.nodes.network_weights import empty, wrong_weights
from neusee.nodes.spectra._linear_lift import lift_checks, needs_rgb
from neusee.nodes.spectra._mst_plus_plus import BANDS, MSTPlusPlus
from neusee.nodes.units import DataFile
from neusee.nodes.values import Bands


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

    The picture is stretched to [0, 1], and the cube is scaled back to keep radiometry. The published checkpoint loads
    unchanged (.pth or .safetensors). Without weights the network consists of random orthogonal layers from `rng`: a
    recipe runs, but the spectra have no meaning.

    Shapes: rgb (3, y, x) -> (31, y, x).
    Units:  linear sRGB to the quantity of the training data, taken as reflectance; negative results are clipped.
    Error:  published: relative error 0.16, PSNR 34.3 dB (NTIRE 2022); one pass, without the eightfold self-ensemble.
    Raises: ParameterError before the run without weights, or where the weights do not fit the network; ValueError
            unless the bands are 31 from 400 to 700 nm.
    Source: Cai et al., MST++, CVPR Workshops 2022 (NTIRE spectral recovery).
    """
    needs_rgb(rgb)
    need_mst_plus_plus_bands(bands)
    network = _loaded(weights) if weights is not None else _untrained(untrained, rng)
    return torch.relu_(lift_pictures(network.to(rgb), rgb[None])[0])


@lift_mst_plus_plus.reference
def _(
    rgb: Tensor, bands: Bands, *, weights: Path | None = None, untrained: str = "refuse", rng: torch.Generator
) -> Tensor:
    result: Tensor = lift_mst_plus_plus.fn(rgb.double(), bands, weights=weights, untrained=untrained, rng=rng)
    return result


@lift_mst_plus_plus.preflight
def _(*, weights: Path | None = None, untrained: str = "refuse", **params: Any) -> list[str]:
    if weights is not None:
        _fitting(weights)
        return []
    if untrained == "refuse":
        text = (
            "MST++ has no weights: give a checkpoint file in weights, use spectra.lift_lmmse, or set untrained: allow"
        )
        raise ParameterError("weights", text)
    return ["MST++ is untrained: the spectra have no meaning"]


@lift_mst_plus_plus.check
def _(result: Tensor, rgb: Tensor, bands: Bands, *, weights: Path | None = None, **params: Any) -> list[Check]:
    noise = [] if weights is not None else [Check("MST++ is untrained: the spectra have no meaning", False)]
    return lift_checks(result, rgb, bands) + noise


def lift_pictures(network: nn.Module, rgb: Tensor) -> Tensor:
    """Reconstruct the spectra (n, 31, y, x) of pictures (n, 3, y, x) by the network MST++.

    Each picture is stretched to [0, 1], and the result is scaled back. Negative values are kept.
    """
    low, high = rgb.amin((1, 2, 3), keepdim=True), rgb.amax((1, 2, 3), keepdim=True)
    span = high - low
    cube: Tensor = network((rgb - low) / span.where(span > 0, 1.0))
    return cube * span + low


def start_mst_plus_plus(rng: torch.Generator, linear: Tensor | None = None) -> MSTPlusPlus:
    """Return an MST++ network for training, with random weights or with the weights of a linear estimate.

    ``linear`` is the matrix (31, 3) of the linear estimate of spectra from RGB. The skip connection around the body
    then has this matrix, and the last layer starts at 0. Training adds the corrections that image structure and a
    non-linear estimate allow.
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
            f"MST++ gives {BANDS} bands from 400 to 700 nm, not {len(centres)} from {float(centres[0]) * 1e9:.4g} to "
            f"{float(centres[-1]) * 1e9:.4g} nm: use these 31 bands, or another node such as spectra.lift_lmmse"
        )


def _empty() -> MSTPlusPlus:
    return empty(MSTPlusPlus).requires_grad_(False).eval()


def _loaded(weights: Path) -> nn.Module:
    network = _empty()
    network.load_state_dict(_fitting(weights), assign=True)
    return network


def _untrained(untrained: str, rng: torch.Generator) -> MSTPlusPlus:
    if untrained != "allow":
        raise ValueError("MST++ has no weights: give a checkpoint file in weights, or set untrained: allow")
    network = _empty().to_empty(device=rng.device)
    for name, tensor in network.named_parameters():
        if name.endswith(("rescale", "norm.weight")):
            nn.init.ones_(tensor)
        elif tensor.ndim == 1:
            nn.init.zeros_(tensor)
        else:
            nn.init.orthogonal_(tensor, generator=rng)
    return network


def _fitting(weights: Path) -> dict[str, Tensor]:
    """Read the tensors of a checkpoint file, and raise ParameterError unless they fit MST++ and are finite."""
    found = {name.removeprefix("module."): tensor for name, tensor in _read(weights).items()}
    network = _empty().state_dict()
    wrong = [name for name in network if name not in found or found[name].shape != network[name].shape]
    wrong += [name for name in found if name not in network]
    if wrong:
        text = f"{weights} holds {len(found)} tensors, and {len(wrong)} tensors do not fit MST++, such as {wrong[0]}"
        raise ParameterError("weights", text)
    if problem := next(filter(None, (wrong_weights(weights, name, each) for name, each in found.items())), ""):
        raise ParameterError("weights", problem)
    return {name: tensor.float() for name, tensor in found.items()}


def _read(weights: Path) -> dict[str, Tensor]:
    """Read the named tensors of a checkpoint file.

    The file is .safetensors or a pickle that holds only tensors, with or without the key `state_dict`.
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
    except Exception as why:  # each library raises its own errors for a broken file
        raise ParameterError("weights", f"{weights} holds no tensors that can be read safely: {why}") from None
    state = content.get("state_dict", content) if isinstance(content, dict) else content
    if not isinstance(state, dict) or not all(isinstance(v, Tensor) for v in state.values()):
        raise ParameterError("weights", f"{weights} is not a state dict: save the output of model.state_dict()")
    return state
