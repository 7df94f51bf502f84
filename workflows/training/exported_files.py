"""The trained network as a file that other programs run, beside its weights."""

from __future__ import annotations

import copy
from pathlib import Path

from neusee.nodes import ParameterError
from neusee.nodes.array_bytes import safetensors_need
from neusee.nodes.restore import Restorer, export_network, require_exportable
from neusee.workflows.recipe.blocks.train_block import KEY, Training


def require_exports(net: Restorer, settings: Training) -> None:
    """Raise ValueError before a training whose network cannot be exported as ``train.export`` asks."""
    for kind in settings.export:
        try:
            require_exportable(net, f".{kind}")
        except ParameterError as error:
            raise ValueError(f"{KEY}.export: {error}") from error


def write_exports(folder: Path, net: Restorer, settings: Training) -> None:
    """Write the best network of a training, or the last one if no state is the best, as ``train.export`` asks."""
    if not settings.export:
        return
    from safetensors.torch import load_file

    name = "best" if (folder / "best.safetensors").is_file() else "network"
    file = folder / f"{name}.safetensors"
    safetensors_need(file, 2.0)
    whole = copy.deepcopy(net).cpu().float()
    whole.stored.load_state_dict(load_file(file))
    for kind in settings.export:
        export_network(whole, folder / f"{name}.{kind}")
