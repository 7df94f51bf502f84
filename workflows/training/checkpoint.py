"""What a training leaves on disk: one state to go on from, a row for each iteration, and what was learnt."""

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

_EDITION = 1
_NAMES = {"relief": "mask"}  #: parts of a state that 0.1 calls otherwise
COLUMNS = ("stage", "iteration", "LSR", "BSR", "L1", "reconstruction", "adversarial", "critics", "penalty", "slope",
           "rate", "seconds")  # fmt: skip


def replaced(path: Path, data: bytes) -> None:
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


def packed(parts: Mapping[str, Any], **about: Any) -> bytes:
    """Weights, moments and place of all parts."""
    memory = io.BytesIO()
    torch.save({"edition": _EDITION, **about, "parts": {name: x.state_dict() for name, x in parts.items()}}, memory)
    return memory.getvalue()


def unpacked(path: Path, device: str) -> dict[str, Any]:
    """Read a state; raises ValueError for what is none."""
    try:
        found: dict[str, Any] = torch.load(path, map_location=device, weights_only=True)
        if found["edition"] != _EDITION:
            raise ValueError(f"edition {found['edition']}, not {_EDITION}")
        found["parts"] = {_NAMES.get(name, name): part for name, part in found["parts"].items()}
    except (RuntimeError, KeyError, EOFError, OSError, ValueError, TypeError, AttributeError) as error:
        raise ValueError(f"{path} cannot be gone on from ({error}): remove its folder to begin anew") from error
    return found


def restore(parts: Mapping[str, Any], found: Mapping[str, Any]) -> None:
    """Put a state back into its parts."""
    for name, part in parts.items():
        part.load_state_dict(found["parts"][name])


class Rows:
    """``losses.csv``: a row for each iteration; those after the state that is gone on from are cut off."""

    def __init__(self, path: Path, columns: Sequence[str] = COLUMNS) -> None:
        self._path, self._columns = path, columns
        self.rows: list[dict[str, str]] = []
        self._kept = 0

    def cut(self, stage: int, iteration: int, write: bool = True) -> None:
        """Keep what came before an iteration of a stage."""
        if self._path.exists():
            with self._path.open(newline="", encoding="utf-8") as file:
                self.rows = [row for row in csv.DictReader(file) if _place(row) < (stage, iteration)]
        self._kept = 0
        if write:
            self.keep()

    def add(self, stage: int, iteration: int, found: Mapping[str, float]) -> None:
        """Note an iteration; it is on disk with the next `keep`."""
        row = {"stage": stage, "iteration": iteration, **{name: f"{x:.6g}" for name, x in found.items()}}
        self.rows.append({name: str(row.get(name, "")) for name in self._columns})

    def keep(self) -> None:
        """Write what is new; at first all of it, whole or not at all."""
        text = io.StringIO(newline="")
        writer = csv.DictWriter(text, self._columns)
        if self._kept == 0:
            writer.writeheader()
        writer.writerows(self.rows[self._kept :])
        if self._kept == 0:
            replaced(self._path, text.getvalue().encode())
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
        return (1 << 62, 0)  # half a row of a process that was killed


def export(
    folder: Path, name: str, tensors: Mapping[str, torch.Tensor], about: Mapping[str, str] | None = None
) -> Path:
    """Tensors as a safetensors file, with what is told about them, whole or not at all."""
    from safetensors.torch import save

    path = folder / f"{name}.safetensors"
    whole = {key: x.detach().cpu().contiguous() for key, x in tensors.items()}
    replaced(path, save(whole, dict(about) if about else None))
    return path


def weights_of(net: nn.Module) -> dict[str, torch.Tensor]:
    """The weights of a network; of an average, those that it averages."""
    inner = net.module if isinstance(net, torch.optim.swa_utils.AveragedModel) else net
    return dict(inner.state_dict())


def write_json(path: Path, document: Mapping[str, Any]) -> None:
    """Write a document whole or not at all."""
    replaced(path, (json.dumps(document, indent=1, ensure_ascii=False) + "\n").encode())


def columns(rows: Sequence[Mapping[str, str]], stage: int, name: str) -> tuple[list[int], list[float]]:
    """Iterations of a stage and what a column has there."""
    pairs = [(int(r["iteration"]), float(r[name])) for r in rows if int(r["stage"]) == stage and r[name]]
    return [i for i, _ in pairs], [x for _, x in pairs]
