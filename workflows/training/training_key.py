"""The key of a training, which is a part of the name of its folder: another key is another training."""

from __future__ import annotations

import hashlib
from pathlib import Path
from typing import Any

from neusee.nodes.scene import Photographs
from neusee.workflows.graph.recipe_graph import Recipe
from neusee.workflows.keys.cache_key import digest
from neusee.workflows.keys.code_digest import Code
from neusee.workflows.recipe.blocks.mask_design_block import MaskSettings
from neusee.workflows.recipe.blocks.train_block import KEY, Augment, Network, Training
from neusee.workflows.recipe.own_families import KEY as OWN_NODES
from neusee.workflows.training.held_out import Split
from neusee.workflows.training.warm_start import WarmStart

_WITHOUT_EFFECT = {"tensorboard", "keep_pool", "export"}  #: settings that change no weight


def key_of_training(
    recipe: Recipe, settings: Training, photographs: Photographs, parts: Split, start: WarmStart | None, code: Code
) -> str:
    """Return a digest of all settings that can change a trained network or mask, as a part of the folder name."""
    values = _camera(recipe)
    defaults = {
        "mask": MaskSettings(),
        "clip": 10.0,
        "reduction": "mean",
        "augment": Augment(),
        "mismatch": None,
        "cameras": (),
    }
    usual = {name for name, x in defaults.items() if getattr(settings, name) == x}  # so that older trainings continue
    if not parts.held_out:
        usual |= {"held_out", "held_out_pictures", "validate_every", "patience"}
    without = {*_WITHOUT_EFFECT, "start", *usual}
    block = settings.model_copy(update={"keep": 1, "show": 1}).model_dump(mode="json", exclude=without)
    for stage in block["stages"].values():
        if not stage["decibels"]:
            del stage["decibels"]
    block["network"] = _identity(settings.network, code)
    if recipe.cameras:
        block["cameras"] = [[_camera(each), _files(each)] for each in recipe.cameras]
    names = [path.name for path in photographs.paths]
    away = [[path.name for path in parts.held_out]] if parts.held_out else []
    begun = [{"start": start.digest}] if start else []
    return digest("training", values, block, names, *away, *begun)[:8]


def _camera(recipe: Recipe) -> dict[str, str]:
    """Return all values of a recipe but those of the training, as text by name."""
    items, left_out = recipe.config.settings.items(), (f"{KEY}.", OWN_NODES)
    return {name: str(setting.value) for name, setting in items if not name.startswith(left_out)}


def _files(recipe: Recipe) -> list[str]:
    """Return the digests of the files that the steps of a recipe read, such as the height map of a mask."""
    files = {x for step in recipe.steps.values() for x in step.params.values() if isinstance(x, Path) and x.is_file()}
    return sorted(hashlib.sha256(file.read_bytes()).hexdigest() for file in files)


def _identity(network: Network, code: Code) -> dict[str, Any]:
    """Return what identifies the network of a training; a class of the user counts with its code."""
    if network.architecture is None:
        return {"kind": network.kind, "width": network.width, **network.options}
    made = code.digest(network.architecture.network.__module__)
    return {"class": str(network.architecture), "code": made, **network.model_dump(include={"parameters", "multiple"})}
