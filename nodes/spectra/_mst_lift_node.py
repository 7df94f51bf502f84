"""The paper's lift: MST++ from linear RGB to 31 bands."""

import functools
from pathlib import Path
from typing import Any, Literal

import torch
from torch import Tensor, nn

from neusee.nodes import Check, ParameterError, node
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
    """Lift all pixels together by MST++; its per-image stretch to [0, 1] is undone, so that radiometry survives.

    Takes the published checkpoint as it is (.pth or .safetensors). Without weights the network is orthogonal noise
    from `rng`: good for trying a recipe, not for looking at it.

    Shapes: rgb (3, y, x) -> (31, y, x).
    Units:  linear sRGB to what the weights were trained on, taken as reflectance; negative results are clipped.
    Error:  published: relative error 0.16, PSNR 34.3 dB (NTIRE 2022); one pass, without the eightfold self-ensemble.
    Raises: ParameterError before the run without weights, or where they do not fit; ValueError unless the bands are
            31 from 400 to 700 nm.
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
        raise ParameterError(
            "weights",
            "MST++ has no weights: give the file of its checkpoint, choose another lift, or set untrained: allow",
        )
    return ["MST++ is untrained: its spectra are noise"]


@lift_mst_plus_plus.check
def _(result: Tensor, rgb: Tensor, bands: Bands, *, weights: Path | None = None, **params: Any) -> list[Check]:
    noise = [] if weights is not None else [Check("MST++ untrained: these spectra mean nothing", False)]
    return lift_checks(result, rgb, bands) + noise


def lift_pictures(network: nn.Module, rgb: Tensor) -> Tensor:
    """Run pictures (n, 3, y, x) through MST++, each stretched to [0, 1] and back: (n, 31, y, x), not yet clipped."""
    low, high = rgb.amin((1, 2, 3), keepdim=True), rgb.amax((1, 2, 3), keepdim=True)
    span = high - low
    cube: Tensor = network((rgb - low) / span.where(span > 0, 1.0))
    return cube * span + low


def start_mst_plus_plus(rng: torch.Generator, linear: Tensor | None = None) -> MSTPlusPlus:
    """A network to train, its layers orthogonal; given W (31, 3), its first estimate is W times each pixel's colour.

    The linear estimate stands in the long skip around the body, whose last layer is 0: what is learnt is what the
    shapes in a picture and a curved estimate know better.
    """
    network = _untrained("allow", rng).requires_grad_(True).train()
    if linear is not None:
        with torch.no_grad():
            network.conv_in.weight.zero_()[:, :, 1, 1] = linear.to(network.conv_in.weight)
            network.conv_out.weight.zero_()
    return network


def need_mst_plus_plus_bands(bands: Bands) -> None:
    """Refuse bands that MST++ does not give."""
    centres = bands.centres.cpu().double()
    wanted = torch.linspace(400e-9, 700e-9, BANDS, dtype=torch.float64)
    if len(centres) != BANDS or float((centres - wanted).abs().max()) > 0.5e-9:
        raise ValueError(
            f"MST++ gives {BANDS} bands from 400 to 700 nm, not {len(centres)} from {float(centres[0]) * 1e9:.4g} to "
            f"{float(centres[-1]) * 1e9:.4g} nm: set the bands so, or choose another lift"
        )


def _empty() -> MSTPlusPlus:
    """The network without memory, and without a draw from the global random stream."""
    with torch.device("meta"):
        return MSTPlusPlus().requires_grad_(False).eval()


def _loaded(weights: Path) -> nn.Module:
    network = _empty()
    network.load_state_dict(_fitting(weights), assign=True)
    return network


def _untrained(untrained: str, rng: torch.Generator) -> MSTPlusPlus:
    if untrained != "allow":
        raise ValueError("MST++ has no weights: give the file of its checkpoint, or set untrained: allow")
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
    """The tensors of a checkpoint, under the names of the network; refused unless names and shapes are its own."""
    found = {name.removeprefix("module."): tensor for name, tensor in _read(weights).items()}
    wanted = _shapes()
    wrong = [name for name in wanted if name not in found or found[name].shape != wanted[name]]
    wrong += [name for name in found if name not in wanted]
    if wrong:
        raise ParameterError(
            "weights",
            f"{weights} holds {len(found)} tensors and does not fit MST++ at {len(wrong)}, such as {wrong[0]}",
        )
    return {name: tensor.float() for name, tensor in found.items()}


@functools.cache
def _shapes() -> dict[str, torch.Size]:
    return {name: tensor.shape for name, tensor in _empty().state_dict().items()}


def _read(weights: Path) -> dict[str, Tensor]:
    """A file of tensors: .safetensors, or a pickle of tensors alone, bare or under `state_dict`."""
    try:
        if weights.suffix == ".safetensors":
            from safetensors.torch import load_file

            return load_file(weights)
        held = torch.load(weights, map_location="cpu", weights_only=True)
    except Exception as why:  # a broken file fails in as many ways as there are libraries
        raise ParameterError("weights", f"{weights} holds no tensors that can be read safely ({why})") from None
    state = held.get("state_dict", held) if isinstance(held, dict) else held
    if not isinstance(state, dict) or not all(isinstance(v, Tensor) for v in state.values()):
        raise ParameterError("weights", f"{weights} is no state dict: save model.state_dict()")
    return state
