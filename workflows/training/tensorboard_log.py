"""The TensorBoard log of a training, with its losses and pictures by iteration."""

from __future__ import annotations

import importlib
from pathlib import Path
from typing import Any


def open_board(folder: Path, first: int) -> Any:
    """Return a TensorBoard writer for a training, which hides older events from iteration ``first`` on.

    Raises ValueError if TensorBoard is not installed.
    """
    try:
        module = importlib.import_module("torch.utils.tensorboard")
    except ImportError as error:
        text = f'TensorBoard is not installed ({error}): pip install -e ".[tensorboard]", or leave tensorboard false'
        raise ValueError(f"train.tensorboard: {text}") from error
    return module.SummaryWriter(str(folder / "tensorboard"), purge_step=first)
