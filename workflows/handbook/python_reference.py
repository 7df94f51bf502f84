"""The page of the handbook on Python, written from the signatures and docstrings of the public names."""

from __future__ import annotations

import inspect
import re
from collections.abc import Iterator
from typing import Any

import neusee
from neusee.workflows.handbook.plain_markdown import prose


def python_page() -> str:
    """Return the page on every public name of the package ``neusee``."""
    found = {name: getattr(neusee, name) for name in neusee.__all__ if not name.startswith("_")}
    functions = [line for name, value in found.items() if not inspect.isclass(value) for line in _section(name, value)]
    errors = {name for name, value in found.items() if inspect.isclass(value) and issubclass(value, Exception)}
    classes = [
        line
        for name, value in found.items()
        if inspect.isclass(value) and name not in errors
        for line in _class(name, value)
    ]
    raised = [line for name in sorted(errors) for line in _section(name, found[name])]
    opening = [
        "# Public names",
        "",
        "These names are `neusee.load`, `neusee.run` and so on. The page [from Python](../python.md) has examples, and",
        "[exceptions](../exceptions.md) says who raises what. The text below is that of the program itself.",
        "",
        *prose(inspect.getdoc(neusee) or ""),
    ]
    parts = [opening, ["## Functions"], functions, ["## Classes"], classes, ["## Errors"], raised]
    return "\n".join(line for part in parts for line in (*part, "")) + "\n"


def _section(name: str, value: Any, level: str = "###") -> Iterator[str]:
    """Yield the heading, the signature and the docstring of a function or a class."""
    yield from (f"{level} {name}", "")
    is_error = inspect.isclass(value) and issubclass(value, Exception)
    if callable(value) and not is_error:
        yield from ("```python", f"{name}{_signature(value)}", "```", "")
    yield from (*prose(inspect.getdoc(value) or ""), "")


def _class(name: str, value: type) -> Iterator[str]:
    """Yield the section of a class and of each public method."""
    yield from _section(name, value)
    for method, function in vars(value).items():
        inner = function.fget if isinstance(function, property) else function
        if not method.startswith("_") and (inspect.isfunction(inner) or isinstance(function, classmethod)):
            yield from _section(f"{name}.{method}", getattr(inner, "__func__", inner), "####")


def _signature(value: Any) -> str:
    """Return the arguments and the result of a function, without the argument ``self``."""
    try:
        found = inspect.signature(value)
    except (TypeError, ValueError):
        return "()"
    shown = str(found.replace(parameters=[each for name, each in found.parameters.items() if name != "self"]))
    return re.sub(r"<(?:function|class) '?([\w.]*\.)?(\w+)'?(?: at 0x[0-9a-f]+)?>", r"\2", shown)  # no address
