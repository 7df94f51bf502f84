"""The file ``ro-crate-metadata.json``, which makes a folder of results an RO-Crate that other programs can read.

The crate lists every file of the folder, the recipe, the inputs, the software and the command with its times. It keeps
RO-Crate 1.1 and the profile Process Run Crate 0.5. The crate is written last, so that it names only files that exist.
"""

from __future__ import annotations

import json
import os
from collections.abc import Mapping
from datetime import UTC, datetime, timedelta
from pathlib import Path
from typing import Any

from neusee.workflows.keys.regular_file import text_of
from neusee.workflows.report.crate_sources import (
    Entity,
    inputs,
    licence,
    media_type,
    person,
    quoted,
    reference,
    references,
    tools,
)

CRATE = "ro-crate-metadata.json"
_SPECIFICATION = "https://w3id.org/ro/crate/1.1"
_PROFILE = "https://w3id.org/ro/wfrun/process/0.5"
_COMPLETED, _FAILED = "http://schema.org/CompletedActionStatus", "http://schema.org/FailedActionStatus"
_FILES = {
    "report.html": "The page with all results; it loads no other file.",
    "recipe.yaml": "The recipe as it was run: every final value, with its source. It can be run again.",
    "provenance.json": "What was computed: versions, steps with cache keys and times, checks, inputs with digests.",
    "metrics.csv": "The numbers of the run: step, field, index and value.",
    "timing.csv": "Time and memory of each step.",
    "code.json": "Digests of the code of each step: its node, and each function of the modules that it uses.",
    "data/outputs.safetensors": "The values of the outputs of the recipe, as tensors.",
    "sweep.csv": "The results of each point of the sweep.",
    "sweep.yaml": "The axes of the sweep, the state of its points, and the command.",
    "training.json": "The settings and the results of the training.",
    "training.html": "The page of the training; it loads no other file.",
    "losses.csv": "The losses of each iteration, and the numbers of held-out pictures.",
    "mask.json": "The figures of merit of the designed mask.",
}


def write_crate(folder: Path, name: str, said: Mapping[str, Any], ended: datetime | None = None) -> None:
    """Write the crate of a complete folder of results; ``name`` is the final name of the folder.

    ``said`` is what the folder says of its command, such as the content of ``provenance.json``. The file appears by an
    atomic rename.
    """
    crate = {"@context": f"{_SPECIFICATION}/context", "@graph": _graph(folder, name, said, ended or datetime.now(UTC))}
    _write(folder, crate)


def remove_crate(folder: Path) -> dict[str, Any] | None:
    """Remove the crate of a folder whose files are about to change, and return its content, or None without a crate.

    A crate that cannot be read is removed as well.
    """
    path = folder / CRATE
    try:
        found = json.loads(text_of(path))
    except FileNotFoundError:
        return None
    except ValueError:
        found = None
    path.unlink()
    return found if isinstance(found, dict) and isinstance(found.get("@graph"), list) else None


def restore_crate(folder: Path, crate: Mapping[str, Any]) -> None:
    """Write a crate that `remove_crate` returned, with the present size of each file."""
    sizes = {quoted(name): str(size) for name, size in _sizes(folder)}
    for entity in crate["@graph"]:
        if entity.get("@id") in sizes and "contentSize" in entity:
            entity["contentSize"] = sizes[entity["@id"]]
    _write(folder, crate)


def _write(folder: Path, crate: Mapping[str, Any]) -> None:
    part = folder / f".{CRATE}.part"
    graph = ",\n".join(json.dumps(entity, ensure_ascii=False) for entity in crate["@graph"])
    text = f'{{"@context": {json.dumps(crate["@context"])},\n"@graph": [\n{graph}\n]}}\n'
    part.write_text(text, encoding="utf-8")
    part.replace(folder / CRATE)


def _graph(folder: Path, name: str, said: Mapping[str, Any], ended: datetime) -> list[Entity]:
    figures = [row for row in said.get("figures") or () if isinstance(row, Mapping)]
    texts = {row["file"]: row["title"] for row in figures if "file" in row} | _FILES
    parts = [_file(path, size, texts.get(path, "")) for path, size in _sizes(folder)]
    given, licences = inputs(said.get("inputs") or ())
    software = tools(said)
    creator, terms = person(), licence()
    action = _action(name, said, ended, parts, given, software, creator)
    root = {
        "@id": "./",
        "@type": "Dataset",
        "name": name,
        "description": _description(said),
        "datePublished": _time(ended),
        "license": reference(terms),
        "conformsTo": {"@id": _PROFILE},
        "hasPart": references(parts),
        "mentions": reference(action),
        **({"author": reference(creator)} if creator else {}),
    }
    about = [_descriptor(), root, _profile(), action, terms]
    found = [*about, *software, *parts, *given, *licences, *([creator] if creator else [])]
    return list({entity["@id"]: entity for entity in found}.values())


def _descriptor() -> Entity:
    return {"@id": CRATE, "@type": "CreativeWork", "conformsTo": {"@id": _SPECIFICATION}, "about": {"@id": "./"}}


def _profile() -> Entity:
    return {"@id": _PROFILE, "@type": "CreativeWork", "name": "Process Run Crate", "version": "0.5"}


def _action(
    name: str,
    said: Mapping[str, Any],
    ended: datetime,
    parts: list[Entity],
    given: list[Entity],
    software: list[Entity],
    creator: Entity | None,
) -> Entity:
    """Return the entity of the command that wrote the folder."""
    command = _command(said)
    recipe = [part for part in parts if part["@id"] == "recipe.yaml"]
    began = _began(said, ended)
    return {
        "@id": f"#{quoted(name)}",
        "@type": "CreateAction",
        "name": command or name,
        **({"description": f"Computed on {said['device']}."} if said.get("device") else {}),
        **({"startTime": _time(began)} if began else {}),
        "endTime": _time(ended),
        "actionStatus": _FAILED if said.get("state") in ("stopped", "interrupted") else _COMPLETED,
        "instrument": reference(software[0]),
        **({"agent": reference(creator)} if creator else {}),
        **({"object": references([*recipe, *given])} if recipe or given else {}),
        "result": references(part for part in parts if part not in recipe),
    }


def _command(said: Mapping[str, Any]) -> str:
    """Return the command line that a document names, which is a text, a list of words or missing."""
    found = said.get("command") or said.get("again") or ""
    return found if isinstance(found, str) else " ".join(map(str, found))


def _began(said: Mapping[str, Any], ended: datetime) -> datetime | None:
    """Return the time at which a command began, from the document or from the seconds that it took, if one is known."""
    if said.get("began"):
        return datetime.fromisoformat(said["began"])
    return ended - timedelta(seconds=said["seconds"]) if said.get("seconds") is not None else None


def _description(said: Mapping[str, Any]) -> str:
    kind = said.get("study") or said.get("stage")
    text = str(said.get("title") or "").strip() or f"Results of the recipe {said.get('recipe') or 'of a run'}."
    return f"{text} ({kind})" if kind else text


def _sizes(folder: Path) -> list[tuple[str, int]]:
    """Return the path and the size of each file of a folder, without hidden files and without the crate itself."""
    found, todo = [], [folder]
    while todo:
        with os.scandir(todo.pop()) as entries:
            for entry in entries:
                if entry.name.startswith(".") or entry.name.endswith(".part"):
                    continue
                if entry.is_dir():
                    todo.append(Path(entry.path))
                else:
                    found.append((Path(entry.path).relative_to(folder).as_posix(), entry.stat().st_size))
    return sorted((name, size) for name, size in found if name != CRATE)


def _file(path: str, size: int, text: str) -> Entity:
    return {
        "@id": quoted(path),
        "@type": "File",
        "name": path,
        **({"description": text} if text else {}),
        "encodingFormat": media_type(path),
        "contentSize": str(size),
    }


def _time(moment: datetime) -> str:
    return moment.astimezone(UTC).isoformat(timespec="milliseconds")
