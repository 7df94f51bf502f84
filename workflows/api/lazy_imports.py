"""Modules of single verbs, imported when a verb is first used: each takes 0.1 s in addition to
torch.

from neusee.workflows.api import lazy_imports as lazy
lazy.run_training.train(recipe, store, ...)
"""

from __future__ import annotations

import importlib
from typing import TYPE_CHECKING, Any

if TYPE_CHECKING:
    from neusee.workflows.calibration import run_calibration as run_calibration
    from neusee.workflows.evaluation import run_evaluation as run_evaluation
    from neusee.workflows.training import lift_training as lift_training
    from neusee.workflows.training import process_mesh as process_mesh
    from neusee.workflows.training import resumable_loop as resumable_loop
    from neusee.workflows.training import run_training as run_training

#: modules below neusee
_MODULES = (
    "workflows.calibration.run_calibration",
    "workflows.evaluation.run_evaluation",
    "workflows.training.lift_training",
    "workflows.training.process_mesh",
    "workflows.training.resumable_loop",
    "workflows.training.run_training",
)
_BY_NAME = {module.rpartition(".")[2]: module for module in _MODULES}


def __getattr__(name: str) -> Any:
    """Import a module when it is first used."""
    if name not in _BY_NAME:
        raise AttributeError(f"module {__name__!r} has no attribute {name!r}")
    return importlib.import_module(f"neusee.{_BY_NAME[name]}")
