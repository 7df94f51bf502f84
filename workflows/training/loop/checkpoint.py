"""The files of a training: a state from which it goes on, a row for each iteration, and what was learnt."""

from __future__ import annotations

import csv
import io
import json
import os
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

import torch
from torch import nn

_FORMAT = 1  #: of a state; a state of another format is refused
_NAMES = {"relief": "mask"}  #: parts of a state that 0.1 calls otherwise


def write_whole(path: Path, data: bytes) -> None:
    """Write a file whole or not at all."""
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


class StateFile:
    """The state of unfinished work: one file, always whole: a killed process leaves the old one or the new."""

    def __init__(self, path: Path) -> None:
        self.path = path

    def write(self, state: Mapping[str, Any]) -> None:
        """Replace the file."""
        self.path.parent.mkdir(parents=True, exist_ok=True)
        memory = io.BytesIO()
        torch.save({"edition": _FORMAT, **state}, memory)
        write_whole(self.path, memory.getvalue())

    def read(self, device: str = "cpu", strict: bool = True) -> dict[str, Any]:
        """Return the state, or an empty one where there is no file.

        Raises ValueError for a file that cannot be read; without ``strict`` such a file counts as absent.
        """
        if not self.path.exists():
            return {}
        try:
            found: dict[str, Any] = torch.load(self.path, map_location=device, weights_only=True)
            if found.get("edition", _FORMAT) != _FORMAT:
                raise ValueError(f"edition {found['edition']}, not {_FORMAT}")
            if "parts" in found:
                found["parts"] = {_NAMES.get(name, name): part for name, part in found["parts"].items()}
        except (RuntimeError, KeyError, EOFError, OSError, ValueError, TypeError, AttributeError) as error:
            if not strict:
                return {}
            raise ValueError(
                f"{self.path} cannot be gone on from ({error}): remove its folder to begin anew"
            ) from error
        return found


class Rows:
    """The table ``losses.csv``, a row for each iteration; a training that goes on cuts rows after its state off."""

    def __init__(self, path: Path, columns: Sequence[str]) -> None:
        self._path, self._columns = path, columns
        self.rows: list[dict[str, str]] = []
        self._kept = 0

    def cut(self, stage: int, iteration: int, write: bool = True) -> None:
        """Keep the rows before an iteration of a stage."""
        if self._path.exists():
            with self._path.open(newline="", encoding="utf-8") as file:
                self.rows = [row for row in csv.DictReader(file) if _place(row) < (stage, iteration)]
        self._kept = 0
        if write:
            self.keep()

    def add(self, stage: int, iteration: int, found: Mapping[str, float]) -> None:
        """Add the row of an iteration, which the next `keep` writes to disk."""
        row = {"stage": stage, "iteration": iteration, **{name: f"{x:.6g}" for name, x in found.items()}}
        self.rows.append({name: str(row.get(name, "")) for name in self._columns})

    def keep(self) -> None:
        """Append the new rows; the first call writes all rows, whole or not at all."""
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
    try:
        if None in row.values():
            raise ValueError("not all of its columns")
        return int(row.get("stage") or 0), int(row["iteration"] or 0)
    except (ValueError, TypeError, KeyError):
        return (1 << 62, 0)  # half a row, of a process that was killed


def export(
    folder: Path, name: str, tensors: Mapping[str, torch.Tensor], about: Mapping[str, str] | None = None
) -> Path:
    """Write tensors with their metadata as a safetensors file, whole or not at all, and return its path."""
    from safetensors.torch import save

    path = folder / f"{name}.safetensors"
    whole = {key: x.detach().cpu().contiguous() for key, x in tensors.items()}
    write_whole(path, save(whole, dict(about) if about else None))
    return path


def weights_of(net: nn.Module) -> dict[str, torch.Tensor]:
    """Return the weights of a network, or of the network inside an average."""
    inner = net.module if isinstance(net, torch.optim.swa_utils.AveragedModel) else net
    return dict(inner.state_dict())


def write_json(path: Path, document: Mapping[str, Any]) -> None:
    """Write a document whole or not at all."""
    write_whole(path, (json.dumps(document, indent=1, ensure_ascii=False) + "\n").encode())


def loss_curve(rows: Sequence[Mapping[str, str]], stage: int, name: str) -> tuple[list[int], list[float]]:
    """Return the iterations of a stage that have a value in a column, and these values."""
    pairs = [(int(r["iteration"]), float(r[name])) for r in rows if int(r["stage"]) == stage and r[name]]
    return [i for i, _ in pairs], [x for _, x in pairs]
