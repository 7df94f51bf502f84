"""The weights with which the network of a new training begins: those of an earlier training, in place of drawn ones."""

from __future__ import annotations

import hashlib
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from neusee.nodes import ParameterError
from neusee.nodes.array_bytes import safetensors_need
from neusee.nodes.input_size import bytes_of
from neusee.nodes.network_weights import fits
from neusee.nodes.restore import Restorer
from neusee.workflows.graph.recipe_graph import Recipe
from neusee.workflows.recipe.blocks.train_block import KEY, Training

_FILES = ("best.safetensors", "network.safetensors")  #: of a folder of results, the first that is there


@dataclass(frozen=True)
class WarmStart:
    """A file of weights, and the digest of its content."""

    file: Path
    digest: str
    source: str  #: place in the recipe that names the file

    @classmethod
    def of(cls, recipe: Recipe, settings: Training) -> WarmStart | None:
        """Return the file of weights that ``train.start`` names, or None; raise ValueError if there is no such file."""
        if settings.start is None:
            return None
        given = recipe.config.settings.get(f"{KEY}.start")
        source = given.source if given else recipe.name
        file = settings.start
        if file.is_dir():
            file = next((file / name for name in _FILES if (file / name).is_file()), file / _FILES[-1])
        if file.suffix != ".safetensors" or not file.is_file():
            text = f"{file} is no file of weights: give a .safetensors file, or the folder of a training that ended"
            raise ValueError(f"{source}   {KEY}.start   {text}")
        return cls(file, hashlib.sha256(bytes_of(file, parameter="train.start")).hexdigest(), source)

    def load_into(self, net: Restorer) -> None:
        """Give the weights to a network; raise ValueError with the name of the first layer that does not fit."""
        from safetensors.torch import load_file

        safetensors_need(self.file, 2.0, "train.start")
        options: Any = getattr(net, "options", {})
        try:
            fits(net.stored, self.file, "the network of this training", options)
        except ParameterError as error:
            raise ValueError(f"{self.source}   {KEY}.start   {error}") from error
        net.stored.load_state_dict(load_file(self.file))

    @property
    def facts(self) -> dict[str, str]:
        """Return what `training.json` says of the start."""
        return {"file": str(self.file), "sha256": self.digest}
