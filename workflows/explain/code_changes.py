"""Changes of code: the functions, classes and constants that differ between two digests of code."""

from __future__ import annotations

import ast
from pathlib import Path

from neusee.workflows.keys.code_memo import read_parts
from neusee.workflows.keys.module_origin import source_file
from neusee.workflows.keys.usual_settings import USUAL

_STATE, _SETTINGS = "state of ", "settings"
_PROGRAM = "neusee.workflows"
_OTHER = frozenset({"Python", _SETTINGS, "closure", _PROGRAM})


def edits(root: Path, old: str, new: str) -> list[str]:
    """Return one text clause for each definition that differs between two versions of code; [] if no record exists."""
    before, after = read_parts(root, old), read_parts(root, new)
    if not before or not after:
        return []
    names = [name for name in after if name in before and _is_module(name)]
    inside = [text for name in names for text in _inside(name, before[name], after[name])]
    came = [f"{_file(name)} is imported now" for name in after if name not in before and _is_module(name)]
    gone = [f"{_file(name)} is no longer imported" for name in before if name not in after and _is_module(name)]
    source = sorted(inside, key=lambda text: text.startswith("the ")) + came + gone
    beside = [
        text
        for name in dict.fromkeys([*after, *before])
        if not _is_module(name) and not name.startswith(_STATE)
        for text in _beside(name, before.get(name, {}), after.get(name, {}))
    ]
    return source + beside or [
        f"a value that {_file(name.removeprefix(_STATE))} holds was changed while the program ran: a constant, "
        "a table, a default or a function"
        for name in after
        if name.startswith(_STATE) and before.get(name, after[name]) != after[name]
    ]


def _is_module(name: str) -> bool:
    return all(part.isidentifier() for part in name.split(".")) and name not in _OTHER


def _beside(name: str, old: dict[str, str], new: dict[str, str]) -> list[str]:
    """Return one text clause for each difference in versions, settings and declared dependencies."""
    labels = [label for label in dict.fromkeys([*new, *old]) if old.get(label) != new.get(label)]
    if not labels:
        return []
    if name == _SETTINGS:
        values = [(label, old.get(label, USUAL.get(label)), new.get(label, USUAL.get(label))) for label in labels]
        return [f"{label} {before} -> {after}, a setting of this process" for label, before, after in values]
    if name == "Python" or name.startswith("package "):
        before, after = old.get("version"), new.get("version")
        if not before or not after:
            return [f"{name} is {'used now' if after else 'no longer used'}"]
        if before == after:
            return [f"{name} has other files, under the same version: {after}"]
        return [f"{before} -> {after}{', an installed package' if name != 'Python' else ''}"]
    if name == "closure":
        return ["a value that the function of the node holds from the function around it changed"]
    if name == _PROGRAM:
        return ["the program itself changed, which the node imports (neusee/workflows)"]
    what = f"declared {name}" if name.startswith("file ") else name
    return [f"{what} changed" if old and new else f"{name} is declared {'now' if new else 'no more'}"]


def _inside(module: str, old: dict[str, str], new: dict[str, str]) -> list[str]:
    """Return one text clause for each changed, added or removed definition of a module."""
    file = _file(module)
    differ = [label for label in new if label in old and old[label] != new[label]]
    lines = _lines(module) if differ else {}
    at = {label: f" (line {lines[label]})" if label in lines else "" for label in differ}
    changed = [
        f"{'code of ' + label if label.endswith('()') else _named(label)} in {file} changed{at[label]}"
        for label in differ
    ]
    added = [f"{_named(label)} was added to {file}" for label in new if label not in old]
    removed = [f"{_named(label)} was removed from {file}" for label in old if label not in new]
    return changed + added + removed


def _lines(module: str) -> dict[str, int]:
    """Return the line of each function, hook, class and constant at the top of a module, as its file is now."""
    path = source_file(module)
    try:
        body = ast.parse(path.read_bytes()).body if path else []
    except (OSError, SyntaxError):
        return {}
    found = dict[str, int]()
    for item in body:
        if isinstance(item, ast.ClassDef):
            found[f"class {item.name}"] = item.lineno
        elif isinstance(item, ast.FunctionDef):
            hooks = [ast.unparse(each) for each in item.decorator_list] if item.name == "_" else []
            found |= {f"{name}()": item.lineno for name in hooks or [item.name]}
        elif isinstance(item, ast.Assign):
            found |= {f"constant {each.id}": item.lineno for each in item.targets if isinstance(each, ast.Name)}
    return found


def _named(label: str) -> str:
    """Return the name of a definition with its kind, such as ``function psf()`` or ``the imports``."""
    if label.endswith("()"):
        return f"function {label}"
    return label if label.startswith(("class ", "constant ")) else f"the {label}"


def _file(module: str) -> str:
    path = source_file(module)
    package = path is not None and path.name == "__init__.py"
    return module.replace(".", "/") + ("/__init__.py" if package else ".py")
