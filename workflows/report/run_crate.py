"""The file ``ro-crate-metadata.json``, which makes a folder of results an RO-Crate."""

from __future__ import annotations

import json
import os
import re
from collections.abc import Iterable, Iterator, Mapping, Sequence
from datetime import UTC, datetime, timedelta
from functools import cache
from importlib.resources import files
from pathlib import Path
from typing import Any
from urllib.parse import quote

from neusee import __version__
from neusee.workflows.keys.cache_key import file_digest
from neusee.workflows.keys.sealed_files import text_of

# --- crate sources --------------------------------------------------------------------------------

# The entities of an RO-Crate that stand for software, input files, licences and people.


Entity = dict[str, Any]

#: name of the person who runs neusee, and in <> an address such as an ORCID
CREATOR = "NEUSEE_CREATOR"
LICENCE = "NEUSEE_LICENCE"  #: licence of the results: an address or a text

_BYTES = "application/octet-stream"
_FORMATS = {
    ".csv": "text/csv",
    ".exr": "image/x-exr",
    ".html": "text/html",
    ".json": "application/json",
    ".jsonl": "application/jsonl",
    ".md": "text/markdown",
    ".nc": "application/x-netcdf",
    ".png": "image/png",
    ".txt": "text/plain",
    ".yaml": "application/yaml",
}
_ADDRESS = re.compile(r"https?://\S+")
_PERSON = re.compile(r"(?P<name>[^<>]*[^<>\s])\s*<(?P<address>https?://[^<>\s]+)>")
_LINK = re.compile(r"\[(?P<name>[^]]+)]\((?P<address>[^)]+)\)")


def tools(said: Mapping[str, Any]) -> list[Entity]:
    """Return neusee and the libraries that it computed with; neusee is the first."""
    versions = dict(said.get("versions") or _of_facts(said.get("facts") or ()))
    libraries = [
        _library(*library)
        for library in versions.items()
        if library[0] != "neusee" and library[1] != "none"
    ]
    ours = {
        "@id": f"#neusee-{__version__}",
        "@type": "SoftwareApplication",
        "name": "neusee",
        "softwareVersion": __version__,
        "description": "A simulator of what a laser does to a camera.",
        **({"softwareRequirements": references(libraries)} if libraries else {}),
    }
    return [ours, *libraries]


def _library(name: str, version: str) -> Entity:
    """Return the entity of Python or of a package, whose address at the package index has no
    local version.
    """
    home = f"https://pypi.org/project/{name}/{version.partition('+')[0]}/"
    home = "https://www.python.org/" if name.lower() == "python" else home
    about = {
        "name": name.capitalize() if name == "python" else name,
        "softwareVersion": version,
        "url": home,
    }
    return {"@id": home, "@type": "SoftwareApplication", **about}


def _of_facts(facts: Iterable[Iterable[str]]) -> Iterator[tuple[str, str]]:
    """Yield name and version of each library in the table of facts of a run, which ends with the
    machine.
    """
    for name, value in facts:
        if name == "machine":
            return
        yield name, value


def inputs(rows: Iterable[Any]) -> tuple[list[Entity], list[Entity]]:
    """Return an entity for each input file, which is not a part of the folder, and one for each
    known licence.
    """
    entities: dict[str, Entity] = {}
    users: dict[str, list[str]] = {}
    licences: list[Entity] = []
    for row in rows:
        if not isinstance(row, Mapping) or not row.keys() >= {"file", "digest", "parameter"}:
            continue  # the inputs of a study of uncertainty are parameters
        name, entry = f"#input-{row['digest']}", _sample(row["file"], row["digest"])
        users.setdefault(name, []).append(row["parameter"])
        entities[name] = _input_file(name, row, users[name], entry)
        if entry:
            licences.append(
                {"@id": entry["address"], "@type": "CreativeWork", "name": entry["licence"]}
            )
    return list(entities.values()), licences


def _input_file(
    name: str, row: Mapping[str, str], users: Sequence[str], entry: Mapping[str, str] | None
) -> Entity:
    """Return the entity of an input file, with what is known of it if neusee ships it."""
    source = f": {entry['what']}; by {entry['author']}." if entry else "."
    return {
        "@id": name,
        "@type": "CreativeWork",
        "name": row["file"],
        "description": f"Input file, the value of {', '.join(users)}{source}",
        "identifier": f"xxh3_128:{row['digest']}",
        "encodingFormat": media_type(row["file"]),
        **({"license": {"@id": entry["address"]}} if entry else {}),
    }


def _sample(file: str, digest: str) -> dict[str, str] | None:
    """Return what is known of a file that neusee ships, or None for any other file."""
    row = _samples().get(file)
    try:
        return (
            row
            if row and file_digest(Path(str(files("neusee.recipes") / "samples" / file))) == digest
            else None
        )
    except OSError:
        return None


@cache
def _samples() -> dict[str, dict[str, str]]:
    """Return author and licence of each file that neusee ships, from the table in
    ``samples/LICENSE.md``.
    """
    text = (files("neusee.recipes") / "samples" / "LICENSE.md").read_text(encoding="utf-8")
    samples = {}
    for line in text.splitlines():
        cells = [cell.strip() for cell in line.strip("|").split(" | ")]
        if len(cells) == 5 and (link := _LINK.fullmatch(cells[3])):
            row = {
                "what": cells[1],
                "author": cells[2],
                "licence": link["name"],
                "address": link["address"],
            }
            samples.update({name: row for name in re.findall("`([^`]+)`", cells[0])})
    return samples


def person() -> Entity | None:
    """Return the person that the variable ``NEUSEE_CREATOR`` names, or None."""
    text = os.environ.get(CREATOR, "").strip()
    if not text:
        return None
    match = _PERSON.fullmatch(text)
    name, address = (match["name"], match["address"]) if match else (text, "#creator")
    return {"@id": address, "@type": "Person", "name": name}


def licence() -> Entity:
    """Return the licence of the results, from the variable ``NEUSEE_LICENCE``."""
    text = os.environ.get(LICENCE, "").strip()
    if _ADDRESS.fullmatch(text):
        return {"@id": text, "@type": "CreativeWork", "name": text}
    none = f"The owner of these results has stated no licence; set {LICENCE} to state one."
    return {
        "@id": "#licence",
        "@type": "CreativeWork",
        "name": text or "No licence stated",
        "description": text or none,
    }


def media_type(path: str) -> str:
    """Return the media type of a file from the suffix of its name."""
    return _FORMATS.get(Path(path).suffix.lower(), _BYTES)


def quoted(path: str) -> str:
    """Return a path as part of an address, in which a space is ``%20``."""
    return quote(path, safe="/")


def reference(entity: Entity) -> dict[str, str]:
    """Return the value of a property that refers to an entity."""
    return {"@id": entity["@id"]}


def references(entities: Iterable[Entity]) -> list[dict[str, str]]:
    """Return the value of a property that refers to several entities."""
    return [reference(entity) for entity in entities]


# --- run crate ------------------------------------------------------------------------------------

# The file ``ro-crate-metadata.json``, which makes a folder of results an RO-Crate that other
# programs can read.
#
# The crate lists every file of the folder, the recipe, the inputs, the software and the command
# with its times. It keeps RO-Crate 1.1 and the profile Process Run Crate 0.5. The crate is written
# last, so that it names only files that exist.


CRATE = "ro-crate-metadata.json"
_SPECIFICATION = "https://w3id.org/ro/crate/1.1"
_PROFILE = "https://w3id.org/ro/wfrun/process/0.5"
_COMPLETED, _FAILED = (
    "http://schema.org/CompletedActionStatus",
    "http://schema.org/FailedActionStatus",
)
_FILES = {
    "report.html": "The page with all results; it loads no other file.",
    "recipe.yaml": (
        "The recipe as it was run: every final value, with its source. It can be run again."
    ),
    "provenance.json": (
        "What was computed: versions, steps with cache keys and times, checks, inputs with digests."
    ),
    "metrics.csv": "The numbers of the run: step, field, index and value.",
    "timing.csv": "Time and memory of each step.",
    "code.json": (
        "Digests of the code of each step: its node, and each function of the modules that it uses."
    ),
    "data/outputs.safetensors": "The values of the outputs of the recipe, as tensors.",
    "sweep.csv": "The results of each point of the sweep.",
    "sweep.yaml": "The axes of the sweep, the state of its points, and the command.",
    "training.json": "The settings and the results of the training.",
    "training.html": "The page of the training; it loads no other file.",
    "losses.csv": "The losses of each iteration, and the numbers of held-out pictures.",
    "mask.json": "The figures of merit of the designed mask.",
}


def write_crate(
    folder: Path, name: str, said: Mapping[str, Any], ended: datetime | None = None
) -> None:
    """Write the crate of a complete folder of results; ``name`` is the final name of the folder.

    ``said`` is what the folder says of its command, such as the content of ``provenance.json``. The
    file appears by an atomic rename.
    """
    crate = {
        "@context": f"{_SPECIFICATION}/context",
        "@graph": _graph(folder, name, said, ended or datetime.now(UTC)),
    }
    _write(folder, crate)


def remove_crate(folder: Path) -> dict[str, Any] | None:
    """Remove the crate of a folder whose files are about to change, and return its content, or None
    without a crate.

    A crate that cannot be read is removed as well.
    """
    path = folder / CRATE
    try:
        crate = json.loads(text_of(path))
    except FileNotFoundError:
        return None
    except ValueError:
        crate = None
    path.unlink()
    return crate if isinstance(crate, dict) and isinstance(crate.get("@graph"), list) else None


def restore_crate(folder: Path, crate: Mapping[str, Any]) -> None:
    """Write a crate that `remove_crate` returned, with the present size of each file."""
    sizes = {quoted(name): str(size) for name, size in _sizes(folder)}
    for entity in crate["@graph"]:
        if entity.get("@id") in sizes and "contentSize" in entity:
            entity["contentSize"] = sizes[entity["@id"]]
    _write(folder, crate)


def _write(folder: Path, crate: Mapping[str, Any]) -> None:
    unfinished = folder / f".{CRATE}.part"
    graph = ",\n".join(json.dumps(entity, ensure_ascii=False) for entity in crate["@graph"])
    text = f'{{"@context": {json.dumps(crate["@context"])},\n"@graph": [\n{graph}\n]}}\n'
    unfinished.write_text(text, encoding="utf-8")
    unfinished.replace(folder / CRATE)


def _graph(folder: Path, name: str, said: Mapping[str, Any], ended: datetime) -> list[Entity]:
    titles = _titles(said)
    parts = [_file(path, size, titles.get(path, "")) for path, size in _sizes(folder)]
    input_files, licences = inputs(said.get("inputs") or ())
    software = tools(said)
    creator, terms = person(), licence()
    action = _command_entity(name, said, ended)
    action |= _of_command(parts, input_files, software, creator)
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
    entities = [*about, *software, *parts, *input_files, *licences]
    if creator:
        entities.append(creator)
    return list({entity["@id"]: entity for entity in entities}.values())


def _titles(said: Mapping[str, Any]) -> dict[str, str]:
    """Return the titles of files by path: those of figures, and of what each run writes."""
    figures = [row for row in said.get("figures") or () if isinstance(row, Mapping)]
    return {row["file"]: row["title"] for row in figures if "file" in row} | _FILES


def _descriptor() -> Entity:
    return {
        "@id": CRATE,
        "@type": "CreativeWork",
        "conformsTo": {"@id": _SPECIFICATION},
        "about": {"@id": "./"},
    }


def _profile() -> Entity:
    return {"@id": _PROFILE, "@type": "CreativeWork", "name": "Process Run Crate", "version": "0.5"}


def _command_entity(name: str, said: Mapping[str, Any], ended: datetime) -> Entity:
    """Return the entity of the command that wrote the folder, with its times and its state."""
    command = _command(said)
    stopped = said.get("state") in ("stopped", "interrupted")
    began = _began(said, ended)
    return {
        "@id": f"#{quoted(name)}",
        "@type": "CreateAction",
        "name": command or name,
        **({"description": f"Computed on {said['device']}."} if said.get("device") else {}),
        **({"startTime": _time(began)} if began else {}),
        "endTime": _time(ended),
        "actionStatus": _FAILED if stopped else _COMPLETED,
    }


def _of_command(
    parts: list[Entity],
    input_files: list[Entity],
    software: list[Entity],
    creator: Entity | None,
) -> Entity:
    """Return what a command ran, who gave it, what it read and what it wrote."""
    recipe = [file for file in parts if file["@id"] == "recipe.yaml"]
    objects = [*recipe, *input_files]
    return {
        "instrument": reference(software[0]),
        **({"agent": reference(creator)} if creator else {}),
        **({"object": references(objects)} if objects else {}),
        "result": references(file for file in parts if file not in recipe),
    }


def _command(said: Mapping[str, Any]) -> str:
    """Return the command line that a document names, which is a text, a list of words or
    missing.
    """
    command = said.get("command") or said.get("again") or ""
    return command if isinstance(command, str) else " ".join(map(str, command))


def _began(said: Mapping[str, Any], ended: datetime) -> datetime | None:
    """Return the time at which a command began, from the document or from the seconds that it
    took, if one is known.
    """
    if said.get("began"):
        return datetime.fromisoformat(said["began"])
    return ended - timedelta(seconds=said["seconds"]) if said.get("seconds") is not None else None


def _description(said: Mapping[str, Any]) -> str:
    kind = said.get("study") or said.get("stage")
    text = (
        str(said.get("title") or "").strip()
        or f"Results of the recipe {said.get('recipe') or 'of a run'}."
    )
    return f"{text} ({kind})" if kind else text


def _sizes(folder: Path) -> list[tuple[str, int]]:
    """Return the path and the size of each file of a folder, without hidden files and without
    the crate itself.
    """
    sizes, todo = [], [folder]
    while todo:
        with os.scandir(todo.pop()) as entries:
            for entry in entries:
                if entry.name.startswith(".") or entry.name.endswith(".part"):
                    continue
                if entry.is_dir():
                    todo.append(Path(entry.path))
                else:
                    sizes.append(
                        (Path(entry.path).relative_to(folder).as_posix(), entry.stat().st_size)
                    )
    return sorted((name, size) for name, size in sizes if name != CRATE)


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
