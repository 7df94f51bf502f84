"""The files of a training: the state from which a training continues, the table of losses, and the trained weights."""

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

_FORMAT = 1  #: format of a state; a state of another format is refused
_NAMES = {"relief": "mask"}  #: new names of the parts of a state that version 0.1 wrote


def write_whole(path: Path, data: bytes) -> None:
    """Write a whole file, or leave the old file as it was."""
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
    """A file with the state of unfinished work; a killed process leaves either the old or the new state, complete."""

    path: Path

    def write(self, state: Mapping[str, Any]) -> None:
        """Write the state in place of the old state."""
        self.path.parent.mkdir(parents=True, exist_ok=True)
        memory = io.BytesIO()
        torch.save({"edition": _FORMAT, **state}, memory)
        write_whole(self.path, memory.getvalue())

    def read(self, device: str = "cpu", strict: bool = True) -> dict[str, Any]:
        """Return the state, which is empty if there is no file.

        Raises ValueError for a file that cannot be read; if not ``strict``, an unreadable file counts as absent.
        """
        if not self.path.exists():
            return {}
        try:
            state: dict[str, Any] = torch.load(self.path, map_location=device, weights_only=True)
            if state.get("edition", _FORMAT) != _FORMAT:
                raise ValueError(f"the state has format {state['edition']}, not {_FORMAT}")
            if "parts" in state:
                state["parts"] = {_NAMES.get(name, name): part for name, part in state["parts"].items()}
        except (RuntimeError, KeyError, EOFError, OSError, ValueError, TypeError, AttributeError) as error:
            if not strict:
                return {}
            raise ValueError(f"{self.path} cannot be read ({error}): remove its folder to begin anew") from error
        return state


class Rows:
    """The table ``losses.csv`` with a row for each iteration of a training."""

    def __init__(self, path: Path, columns: Sequence[str]) -> None:
        self._path, self._columns = path, columns
        self.rows: list[dict[str, str]] = []
        self._kept = 0

    def cut(self, stage: int, iteration: int, write: bool = True) -> None:
        """Read the table, and remove the rows from an iteration of a stage on."""
        if self._path.exists():
            with self._path.open(newline="", encoding="utf-8") as file:
                self.rows = [row for row in csv.DictReader(file) if _place(row) < (stage, iteration)]
        self._kept = 0
        if write:
            self.keep()

    def add(self, stage: int, iteration: int, losses: Mapping[str, float]) -> None:
        """Add the row of an iteration, which the next call of `keep` writes to disk."""
        row = {"stage": stage, "iteration": iteration, **{name: f"{x:.6g}" for name, x in losses.items()}}
        self.rows.append({name: str(row.get(name, "")) for name in self._columns})

    def keep(self) -> None:
        """Append the new rows to the file; the first call writes the whole file."""
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
    """Return the stage and iteration of a row; an incomplete row of a killed process comes after all others."""
    with suppress(ValueError, TypeError, KeyError):
        if None not in row.values():
            return int(row.get("stage") or 0), int(row["iteration"] or 0)
    return 1 << 62, 0


def export(folder: Path, name: str, tensors: Mapping[str, torch.Tensor], about: dict[str, str] | None = None) -> None:
    """Write tensors and their metadata to the safetensors file ``name`` of a folder."""
    from safetensors.torch import save

    whole = {key: x.detach().cpu().contiguous() for key, x in tensors.items()}
    write_whole(folder / f"{name}.safetensors", save(whole, about or None))
