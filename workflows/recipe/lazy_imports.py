"""Modules that are imported only for a recipe that needs them: the blocks of settings, and modules
that import torch, which takes a second.

    from neusee.workflows.recipe import lazy_imports as lazy
    lazy.train_block.read_training(composed, context)
"""

from __future__ import annotations

import importlib
from typing import TYPE_CHECKING, Any

if TYPE_CHECKING:
    from neusee.nodes import calibrate as calibrate
    from neusee.workflows.observation import observed_call as observed_call
    from neusee.workflows.recipe.blocks import safety_block as safety_block
    from neusee.workflows.recipe.blocks import settings_block as settings_block
    from neusee.workflows.recipe.blocks import train_block as train_block

#: modules below neusee
_MODULES = (
    "nodes.calibrate",
    "workflows.observation.observed_call",
    "workflows.recipe.blocks.safety_block",
    "workflows.recipe.blocks.settings_block",
    "workflows.recipe.blocks.train_block",
)
_BY_NAME = {module.rpartition(".")[2]: module for module in _MODULES}


def __getattr__(name: str) -> Any:
    """Import a module when it is first used."""
    if name not in _BY_NAME:
        raise AttributeError(f"module {__name__!r} has no attribute {name!r}")
    return importlib.import_module(f"neusee.{_BY_NAME[name]}")
