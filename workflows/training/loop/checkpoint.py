"""The files of a training: its checkpoint, its table of losses, and its trained weights."""

from __future__ import annotations

import csv
import io
import os
from collections.abc import Mapping, Sequence
from contextlib import suppress
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import torch

from neusee.nodes.array_bytes import archive_needs
from neusee.nodes.input_size import lines_of

_FORMAT = 1  #: format of a state; a state of another format is refused
_CELLS = 24.0  #: bytes in memory for each byte of a table of losses
_NAMES = {"relief": "mask"}  #: names in a state of version 0.1, with the present names


def write_whole(path: Path, data: bytes) -> None:
    """Replace a file atomically: an interrupted write leaves the old file unchanged."""
    part = path.with_name(f".{path.name}.{os.getpid()}.part")
    try:
        with part.open("wb") as file:
            file.write(data)
            file.flush()
            os.fsync(file.fileno())
        part.replace(path)
    except BaseException:
        part.unlink(missing_ok=True)
        raise


@dataclass(frozen=True)
class StateFile:
    """The checkpoint file of a training, which is always complete because it is replaced atomically."""

    path: Path

    def write(self, state: Mapping[str, Any]) -> None:
        """Write a training state to the checkpoint file, in place of the old state."""
        self.path.parent.mkdir(parents=True, exist_ok=True)
        memory = io.BytesIO()
        torch.save({"edition": _FORMAT, **state}, memory)
        write_whole(self.path, memory.getvalue())

    def read(self, device: str = "cpu", strict: bool = True) -> dict[str, Any]:
        """Return the training state from the checkpoint file, or an empty dictionary if there is no file.

        Raises ValueError for a file that cannot be read, or that needs more memory than is left; if not ``strict``,
        an unreadable file counts as absent.
        """
        if not self.path.exists():
            return {}
        archive_needs(self.path, 1.0)  # a state without room in memory is not absent
        try:
            state: dict[str, Any] = torch.load(self.path, map_location=device, weights_only=True)
            if state.get("edition", _FORMAT) != _FORMAT:
                raise ValueError(f"the training state has format {state['edition']}, not {_FORMAT}")
            if "parts" in state:
                state["parts"] = {_NAMES.get(name, name): part for name, part in state["parts"].items()}
        except (RuntimeError, KeyError, EOFError, OSError, ValueError, TypeError, AttributeError) as error:
            if not strict:
                return {}
            raise ValueError(f"{self.path} cannot be read ({error}): remove its folder to start again") from error
        return state


class Rows:
    """The table ``losses.csv`` of a training, with one row for each iteration."""

    def __init__(self, path: Path, columns: Sequence[str]) -> None:
        self._path, self._columns = path, columns
        self.rows: list[dict[str, str]] = []
        self._kept = 0

    def cut(self, stage: int, iteration: int, write: bool = True) -> None:
        """Read the loss table from its file, and discard the rows of the given iteration and of later iterations."""
        if self._path.exists():
            lines = csv.DictReader(lines_of(self._path, _CELLS))
            self.rows = [row for row in lines if _place(row) < (stage, iteration)]
        self._kept = 0
        if write:
            self.keep()

    def add(self, stage: int, iteration: int, losses: Mapping[str, float]) -> None:
        """Append the losses of an iteration to the loss table in memory; the method `keep` writes the table to disk."""
        row = {"stage": stage, "iteration": iteration, **{name: f"{x:.6g}" for name, x in losses.items()}}
        self.rows.append({name: str(row.get(name, "")) for name in self._columns})

    def keep(self) -> None:
        """Append the new rows of the loss table to its file; the first call writes the whole file."""
        text = io.StringIO(newline="")
        writer = csv.DictWriter(text, self._columns)
        if self._kept == 0:
            writer.writeheader()
        writer.writerows(self.rows[self._kept :])
        if self._kept == 0:
            write_whole(self._path, text.getvalue().encode())
        else:
            with self._path.open("ab") as file:
                file.write(text.getvalue().encode())
        self._kept = len(self.rows)


def _place(row: Mapping[str, str | None]) -> tuple[int, int]:
    """Return stage and iteration of a row of the loss table for sorting; an incomplete row comes last."""
    with suppress(ValueError, TypeError, KeyError):
        if None not in row.values():
            return int(row.get("stage") or 0), int(row["iteration"] or 0)
    return 1 << 62, 0


def export(folder: Path, name: str, tensors: Mapping[str, torch.Tensor], about: dict[str, str] | None = None) -> None:
    """Write tensors and metadata to the file ``<name>.safetensors`` in a folder."""
    from safetensors.torch import save

    whole = {key: x.detach().cpu().contiguous().clone() for key, x in tensors.items()}
    write_whole(folder / f"{name}.safetensors", save(whole, about or None))
