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


def tools(document: Mapping[str, Any]) -> list[Entity]:
    """Return the entities of neusee and of the libraries that it used; neusee is the first."""
    versions = dict(document.get("versions") or _of_facts(document.get("facts") or ()))
    libraries = [
        _library(*name_and_version)
        for name_and_version in versions.items()
        if name_and_version[0] != "neusee" and name_and_version[1] != "none"
    ]
    own_entity = {
        "@id": f"#neusee-{__version__}",
        "@type": "SoftwareApplication",
        "name": "neusee",
        "softwareVersion": __version__,
        "description": "A simulator of what a laser does to a camera.",
        **({"softwareRequirements": references(libraries)} if libraries else {}),
    }
    return [own_entity, *libraries]


def _library(name: str, version: str) -> Entity:
    """Return the entity of Python or of a package, whose address at the package index has no
    local version.
    """
    home_page = f"https://pypi.org/project/{name}/{version.partition('+')[0]}/"
    home_page = "https://www.python.org/" if name.lower() == "python" else home_page
    properties = {
        "name": name.capitalize() if name == "python" else name,
        "softwareVersion": version,
        "url": home_page,
    }
    return {"@id": home_page, "@type": "SoftwareApplication", **properties}


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
    parameters_of_file: dict[str, list[str]] = {}
    licences: list[Entity] = []
    for row in rows:
        if not isinstance(row, Mapping) or not row.keys() >= {"file", "digest", "parameter"}:
            continue  # the inputs of a study of uncertainty are parameters
        entity_id, known_sample = f"#input-{row['digest']}", _sample(row["file"], row["digest"])
        # one entity for equal files, whatever parameters they have
        parameters_of_file.setdefault(entity_id, []).append(row["parameter"])
        entities[entity_id] = _input_file(
            entity_id, row, parameters_of_file[entity_id], known_sample
        )
        if known_sample:
            licences.append(
                {
                    "@id": known_sample["address"],
                    "@type": "CreativeWork",
                    "name": known_sample["licence"],
                }
            )
    return list(entities.values()), licences


def _input_file(
    name: str, row: Mapping[str, str], users: Sequence[str], entry: Mapping[str, str] | None
) -> Entity:
    """Return the entity of an input file, with author and licence if neusee ships the file."""
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
    """Return the description, author and licence of a file that neusee ships, or None for any other
    file.
    """
    known_row = _samples().get(file)
    try:
        return (
            known_row
            if known_row
            and file_digest(Path(str(files("neusee.recipes") / "samples" / file))) == digest
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
        # a row of the table: files, what, author, licence with its link
        if len(cells) == 5 and (link := _LINK.fullmatch(cells[3])):
            sample = {
                "what": cells[1],
                "author": cells[2],
                "licence": link["name"],
                "address": link["address"],
            }
            samples.update({name: sample for name in re.findall("`([^`]+)`", cells[0])})
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
    no_licence_text = (
        f"The owner of these results has stated no licence; set {LICENCE} to state one."
    )
    return {
        "@id": "#licence",
        "@type": "CreativeWork",
        "name": text or "No licence stated",
        "description": text or no_licence_text,
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
    folder: Path, name: str, document: Mapping[str, Any], ended: datetime | None = None
) -> None:
    """Write the crate of a complete folder of results; ``name`` is the final name of the folder.

    ``document`` describes the command of the folder, such as the content of ``provenance.json``.
    The file appears by an atomic rename.
    """
    crate = {
        "@context": f"{_SPECIFICATION}/context",
        "@graph": _graph(folder, name, document, ended or datetime.now(UTC)),
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
        # only files have a size
        if entity.get("@id") in sizes and "contentSize" in entity:
            entity["contentSize"] = sizes[entity["@id"]]
    _write(folder, crate)


def _write(folder: Path, crate: Mapping[str, Any]) -> None:
    """Write a crate, one entity a line, by an atomic rename."""
    unfinished = folder / f".{CRATE}.part"
    graph = ",\n".join(json.dumps(entity, ensure_ascii=False) for entity in crate["@graph"])
    text = f'{{"@context": {json.dumps(crate["@context"])},\n"@graph": [\n{graph}\n]}}\n'
    unfinished.write_text(text, encoding="utf-8")
    unfinished.replace(folder / CRATE)


def _graph(folder: Path, name: str, document: Mapping[str, Any], ended: datetime) -> list[Entity]:
    """Return the entities of a crate: the folder, its command, software, files and people.

    ``document`` describes the command of the folder, and ``ended`` is the time at which it ended.
    """
    title_of_path = _titles(document)
    parts = [_file(path, size, title_of_path.get(path, "")) for path, size in _sizes(folder)]
    input_files, licences = inputs(document.get("inputs") or ())
    software = tools(document)
    creator, licence_entity = person(), licence()
    action = _command_entity(name, document, ended)
    action |= _of_command(parts, input_files, software, creator)
    root = {
        "@id": "./",
        "@type": "Dataset",
        "name": name,
        "description": _description(document),
        "datePublished": _time(ended),
        "license": reference(licence_entity),
        "conformsTo": {"@id": _PROFILE},
        "hasPart": references(parts),
        "mentions": reference(action),
        **({"author": reference(creator)} if creator else {}),
    }
    about_the_crate = [_descriptor(), root, _profile(), action, licence_entity]
    entities = [*about_the_crate, *software, *parts, *input_files, *licences]
    if creator:
        entities.append(creator)
    # one entity for each address, also for a licence of several inputs
    return list({entity["@id"]: entity for entity in entities}.values())


def _titles(document: Mapping[str, Any]) -> dict[str, str]:
    """Return the titles of files by path: of the figures, and of the files that every
    run writes.
    """
    figures = [row for row in document.get("figures") or () if isinstance(row, Mapping)]
    return {row["file"]: row["title"] for row in figures if "file" in row} | _FILES


def _descriptor() -> Entity:
    """Return the entity of the crate's own file."""
    return {
        "@id": CRATE,
        "@type": "CreativeWork",
        "conformsTo": {"@id": _SPECIFICATION},
        "about": {"@id": "./"},
    }


def _profile() -> Entity:
    return {"@id": _PROFILE, "@type": "CreativeWork", "name": "Process Run Crate", "version": "0.5"}


def _command_entity(name: str, document: Mapping[str, Any], ended: datetime) -> Entity:
    """Return the entity of the command that wrote the folder, with its times and its state."""
    command = _command(document)
    is_stopped = document.get("state") in ("stopped", "interrupted")
    began = _began(document, ended)
    return {
        "@id": f"#{quoted(name)}",
        "@type": "CreateAction",
        "name": command or name,
        **({"description": f"Computed on {document['device']}."} if document.get("device") else {}),
        **({"startTime": _time(began)} if began else {}),
        "endTime": _time(ended),
        "actionStatus": _FAILED if is_stopped else _COMPLETED,
    }


def _of_command(
    parts: list[Entity],
    input_files: list[Entity],
    software: list[Entity],
    creator: Entity | None,
) -> Entity:
    """Return what a command ran, who gave it, what it read and what it wrote."""
    recipe = [file for file in parts if file["@id"] == "recipe.yaml"]
    inputs_of_command = [*recipe, *input_files]
    return {
        "instrument": reference(software[0]),
        **({"agent": reference(creator)} if creator else {}),
        **({"object": references(inputs_of_command)} if inputs_of_command else {}),
        "result": references(file for file in parts if file not in recipe),
    }


def _command(document: Mapping[str, Any]) -> str:
    """Return the command line that a document names, which is a text, a list of words or
    missing.
    """
    command = document.get("command") or document.get("again") or ""
    return command if isinstance(command, str) else " ".join(map(str, command))


def _began(document: Mapping[str, Any], ended: datetime) -> datetime | None:
    """Return the time at which a command began, from the document or from the seconds that it
    took, if one is known.
    """
    if document.get("began"):
        return datetime.fromisoformat(document["began"])
    if document.get("seconds") is None:
        return None
    return ended - timedelta(seconds=document["seconds"])


def _description(document: Mapping[str, Any]) -> str:
    """Return the description of the folder: the title of the recipe, and the kind of study."""
    kind_of_study = document.get("study") or document.get("stage")
    text = (
        str(document.get("title") or "").strip()
        or f"Results of the recipe {document.get('recipe') or 'of a run'}."
    )
    return f"{text} ({kind_of_study})" if kind_of_study else text


def _sizes(folder: Path) -> list[tuple[str, int]]:
    """Return the path and the size of each file of a folder, without hidden files and without
    the crate itself.
    """
    sizes, folders = [], [folder]
    while folders:
        with os.scandir(folders.pop()) as entries:
            for entry in entries:
                if entry.name.startswith(".") or entry.name.endswith(".part"):
                    continue
                if entry.is_dir():
                    folders.append(Path(entry.path))
                else:
                    sizes.append(
                        (Path(entry.path).relative_to(folder).as_posix(), entry.stat().st_size)
                    )
    return sorted((name, size) for name, size in sizes if name != CRATE)


def _file(path: str, size: int, text: str) -> Entity:
    """Return the entity of a file; ``text`` describes its content."""
    return {
        "@id": quoted(path),
        "@type": "File",
        "name": path,
        **({"description": text} if text else {}),
        "encodingFormat": media_type(path),
        "contentSize": str(size),
    }


def _time(moment: datetime) -> str:
    """Return a time as text in UTC, to the millisecond."""
    return moment.astimezone(UTC).isoformat(timespec="milliseconds")
