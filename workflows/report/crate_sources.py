"""The entities of an RO-Crate that stand for software, input files, licences and people."""

from __future__ import annotations

import os
import re
from collections.abc import Iterable, Iterator, Mapping
from functools import cache
from importlib.resources import files
from pathlib import Path
from typing import Any
from urllib.parse import quote

from neusee import __version__

Entity = dict[str, Any]

CREATOR = "NEUSEE_CREATOR"  #: name of the person who runs neusee, and in <> an address such as an ORCID
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
    known = dict(said.get("versions") or _of_facts(said.get("facts") or ()))
    rest = [_library(*each) for each in known.items() if each[0] != "neusee" and each[1] != "none"]
    ours = {
        "@id": f"#neusee-{__version__}",
        "@type": "SoftwareApplication",
        "name": "neusee",
        "softwareVersion": __version__,
        "description": "A simulator of what a laser does to a camera.",
        **({"softwareRequirements": references(rest)} if rest else {}),
    }
    return [ours, *rest]


def _library(name: str, version: str) -> Entity:
    """Return the entity of Python or of a package, whose address at the package index has no local version."""
    home = f"https://pypi.org/project/{name}/{version.partition('+')[0]}/"
    home = "https://www.python.org/" if name.lower() == "python" else home
    about = {"name": name.capitalize() if name == "python" else name, "softwareVersion": version, "url": home}
    return {"@id": home, "@type": "SoftwareApplication", **about}


def _of_facts(facts: Iterable[Iterable[str]]) -> Iterator[tuple[str, str]]:
    """Yield name and version of each library in the table of facts of a run, which ends with the machine."""
    for name, value in facts:
        if name == "machine":
            return
        yield name, value


def inputs(rows: Iterable[Any]) -> tuple[list[Entity], list[Entity]]:
    """Return an entity for each input file, which is not a part of the folder, and one for each known licence."""
    found: dict[str, Entity] = {}
    licences: list[Entity] = []
    for row in rows:
        if not isinstance(row, Mapping) or not row.keys() >= {"file", "digest", "parameter"}:
            continue  # the inputs of a study of uncertainty are parameters
        name, entry = f"#input-{row['digest']}", _sample(row["file"], row["digest"])
        users = [*found[name]["_users"], row["parameter"]] if name in found else [row["parameter"]]
        found[name] = {
            "@id": name,
            "@type": "CreativeWork",
            "name": row["file"],
            "description": f"Input file, the value of {', '.join(users)}"
            + (f": {entry['what']}; by {entry['author']}." if entry else "."),
            "identifier": f"xxh3_128:{row['digest']}",
            "encodingFormat": media_type(row["file"]),
            **({"license": {"@id": entry["address"]}} if entry else {}),
            "_users": users,
        }
        if entry:
            licences.append({"@id": entry["address"], "@type": "CreativeWork", "name": entry["licence"]})
    return [{key: value for key, value in entity.items() if key != "_users"} for entity in found.values()], licences


def _sample(file: str, digest: str) -> dict[str, str] | None:
    """Return what is known of a file that neusee ships, or None for any other file."""
    from neusee.workflows.keys.input_file_digest import file_digest

    row = _samples().get(file)
    try:
        return row if row and file_digest(Path(str(files("neusee.recipes") / "samples" / file))) == digest else None
    except OSError:
        return None


@cache
def _samples() -> dict[str, dict[str, str]]:
    """Return author and licence of each file that neusee ships, from the table in ``samples/LICENSE.md``."""
    text = (files("neusee.recipes") / "samples" / "LICENSE.md").read_text(encoding="utf-8")
    found = {}
    for line in text.splitlines():
        cells = [cell.strip() for cell in line.strip("|").split(" | ")]
        if len(cells) == 5 and (link := _LINK.fullmatch(cells[3])):
            row = {"what": cells[1], "author": cells[2], "licence": link["name"], "address": link["address"]}
            found.update({name: row for name in re.findall("`([^`]+)`", cells[0])})
    return found


def person() -> Entity | None:
    """Return the person that the variable ``NEUSEE_CREATOR`` names, or None."""
    text = os.environ.get(CREATOR, "").strip()
    if not text:
        return None
    found = _PERSON.fullmatch(text)
    name, address = (found["name"], found["address"]) if found else (text, "#creator")
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
