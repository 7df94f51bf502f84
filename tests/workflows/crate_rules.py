"""The rules of RO-Crate 1.1 and of its profile Process Run Crate 0.5, written from their texts,
for a folder.
"""

import json
import re
from datetime import datetime
from functools import cache
from pathlib import Path
from urllib.parse import unquote

CONTEXT = Path(__file__).parent / "report" / "ro_crate_1_1_context.json"
PROFILE = "https://w3id.org/ro/wfrun/process/0.5"
DAY = re.compile(r"\d{4}-\d\d-\d\dT\d\d:\d\d:\d\d(\.\d+)?(Z|[+-]\d\d:\d\d)")


@cache
def terms():
    return json.loads(CONTEXT.read_text())["@context"]


def references(value):
    """Yield the identifiers that a property refers to."""
    for each in value if isinstance(value, list) else [value]:
        if isinstance(each, dict):
            yield each.get("@id")


def faults(folder):
    """Yield what is wrong with the crate in a folder."""
    text = (Path(folder) / "ro-crate-metadata.json").read_text(encoding="utf-8")
    crate = json.loads(text)
    if crate.get("@context") != "https://w3id.org/ro/crate/1.1/context":
        yield f"the context is {crate.get('@context')}"
    ids = [entity.get("@id") for entity in crate["@graph"]]
    yield from (f"{each} stands there twice" for each in set(ids) if ids.count(each) > 1)
    graph = {entity["@id"]: entity for entity in crate["@graph"]}
    for entity in graph.values():
        yield from _terms(entity)
        for key, value in entity.items():
            yield from (
                f"{entity['@id']} {key}: nothing is {target}"
                for target in references(value)
                if target not in graph
                and not (key == "conformsTo" and target.startswith("https://w3id.org/"))
            )
    yield from _root(graph)
    yield from _files(graph, Path(folder))
    yield from _actions(graph)
    yield from (
        f"nothing leads to {each}"
        for each in graph.keys() - _reached(graph, "ro-crate-metadata.json")
    )


def _terms(entity):
    """Yield the words that the context does not define, and values that are neither text nor
    reference.
    """
    kinds = entity.get("@type")
    words = [
        *(key for key in entity if key[0] != "@"),
        *(kinds if isinstance(kinds, list) else [kinds]),
    ]
    yield from (
        f"{entity['@id']}: {word} is not in the context" for word in words if word not in terms()
    )
    for key, value in entity.items():
        for each in value if isinstance(value, list) else [value]:
            if not (isinstance(each, str) and each) and not (
                isinstance(each, dict) and each.keys() == {"@id"}
            ):
                yield f"{entity['@id']} {key}: {each!r} is neither a text nor a reference"


def _root(graph):
    descriptor, root = graph["ro-crate-metadata.json"], graph["./"]
    if descriptor["@type"] != "CreativeWork" or descriptor["about"] != {"@id": "./"}:
        yield "the descriptor is not about the root"
    if descriptor["conformsTo"] != {"@id": "https://w3id.org/ro/crate/1.1"}:
        yield "the descriptor names no specification"
    if root["@type"] != "Dataset":
        yield "the root is no data set"
    yield from (
        f"the root has no {key}"
        for key in ("name", "description", "datePublished", "license")
        if key not in root
    )
    if not DAY.fullmatch(root.get("datePublished", "")):
        yield "datePublished is no date"
    if (
        PROFILE not in references(root.get("conformsTo"))
        or graph[PROFILE]["@type"] != "CreativeWork"
    ):
        yield "the root does not name the profile"


def _files(graph, folder):
    there = {p.relative_to(folder).as_posix() for p in folder.rglob("*") if p.is_file()}
    there = {name for name in there if not any(part.startswith(".") for part in name.split("/"))}
    named = {unquote(key): e for key, e in graph.items() if e["@type"] == "File"}
    yield from (f"{name} is not in the folder" for name in named.keys() - there)
    yield from (
        f"{name} is not in the crate" for name in there - named.keys() - {"ro-crate-metadata.json"}
    )
    parts = {unquote(each) for each in references(graph["./"].get("hasPart", []))}
    yield from (f"{name} is no part of the root" for name in named.keys() ^ parts)
    for name in named.keys() & there:
        if named[name].get("contentSize") != str((folder / name).stat().st_size):
            yield f"{name} has another size than {named[name].get('contentSize')}"
        if not re.fullmatch(r"[a-z]+/[\w.+-]+", named[name].get("encodingFormat", "")):
            yield f"{name} has no format"


def _actions(graph):
    actions = [entity for entity in graph.values() if entity["@type"] == "CreateAction"]
    if not actions:
        yield "nothing says which command made the folder"
    for action in actions:
        if action["@id"] not in references(graph["./"].get("mentions")):
            yield "the root does not mention the action"
        (tool,) = references(action["instrument"])
        if graph[tool]["@type"] != "SoftwareApplication" or not graph[tool].keys() >= {
            "name",
            "softwareVersion",
        }:
            yield "the instrument is no software with a version"
        times = [action[key] for key in ("startTime", "endTime") if key in action]
        if not all(map(DAY.fullmatch, times)) or "endTime" not in action:
            yield f"the times are {times}"
        elif sorted(times, key=datetime.fromisoformat) != times:
            yield "the command ended before it began"
        results = list(references(action.get("result", [])))
        yield from (
            f"the result {each} is no file"
            for each in results
            if graph.get(each, {}).get("@type") != "File"
        )
        if "recipe.yaml" in graph and "recipe.yaml" not in references(action.get("object", [])):
            yield "the recipe is not what the command read"


def _reached(graph, start):
    found, todo = {start}, [start]
    while todo:
        for value in graph.get(todo.pop(), {}).values():
            new = {each for each in references(value)} - found
            found |= new
            todo += new
    return found
