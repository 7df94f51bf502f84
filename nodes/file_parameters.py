"""Parameters of nodes that are files: which they are, and the paths that a caller in Python writes as texts."""

from __future__ import annotations

from pathlib import Path
from typing import Any, Literal, get_args, get_origin

from neusee.nodes.units import IsFile, files_of


def is_file(hint: Any) -> bool:
    """Return True if a parameter's type annotation contains `IsFile` at any depth, so that the parameter is a path."""
    extras = getattr(hint, "__metadata__", ())
    return any(isinstance(extra, IsFile) for extra in extras) or any(map(is_file, get_args(hint)))


def texts_of(hint: Any) -> list[Any]:
    """Return the texts that a parameter takes beside a path, such as the names of known cameras."""
    if get_origin(hint) is Literal:
        return list(get_args(hint))
    return [text for part in get_args(hint) for text in texts_of(part)]


def as_paths(hint: Any, value: Any) -> Any:
    """Return a path or paths for a text or a list of texts, and every other value as it is.

    Args: hint: the annotation of a parameter that `is_file`; a text that the annotation names stays a text.
    """
    if isinstance(value, str) and value in texts_of(hint):
        return value
    if _is_several(hint):
        return tuple(files_of(value)) if isinstance(value, str | list) else value
    return Path(value) if isinstance(value, str) else value


def _is_several(hint: Any) -> bool:
    """Return True if a parameter takes a tuple of paths."""
    return get_origin(hint) is tuple or any(map(_is_several, get_args(hint)))
