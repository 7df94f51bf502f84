"""The TensorBoard log of a training: the losses over the iterations, and the pictures."""

from __future__ import annotations

import importlib
import io
from collections.abc import Mapping
from pathlib import Path
from typing import Any


class TensorBoardLog:
    """Events in the folder ``tensorboard/``; the second stage follows the first."""

    def __init__(self, folder: Path, first: int) -> None:
        """Begin at iteration ``first`` of all stages; later events of an earlier process are not shown.

        Raises ValueError where TensorBoard is not installed.
        """
        try:
            there = importlib.import_module("torch.utils.tensorboard")
        except ImportError as error:
            text = f'TensorBoard is not here ({error}): pip install -e ".[tensorboard]", or leave it false'
            raise ValueError(f"train.tensorboard: {text}") from error
        self._writer: Any = there.SummaryWriter(str(folder / "tensorboard"), purge_step=first)

    def row(self, iteration: int, found: Mapping[str, float]) -> None:
        """Log the losses of an iteration."""
        for name, value in found.items():
            self._writer.add_scalar(name, value, iteration)

    def picture(self, iteration: int, stage: int, shown: bytes) -> None:
        """Log a picture, given as a PNG."""
        import numpy as np
        from PIL import Image

        with Image.open(io.BytesIO(shown)) as image:
            self._writer.add_image(f"stage {stage}", np.asarray(image), iteration, dataformats="HWC")

    def keep(self) -> None:
        """Write the log to disk."""
        self._writer.flush()

    def close(self) -> None:
        """Close the file."""
        self._writer.close()
