"""Settings of a store from environment variables: the folder, the mode of checksum comparison and the budget."""

from __future__ import annotations

import os
from pathlib import Path
from typing import Literal, cast, get_args

import neusee
from neusee.workflows.store.byte_sizes import parse_size

Verify = Literal["always", "sampled", "never"]


def default_root() -> Path:
    """Return the default folder of a store: ``$NEUSEE_CACHE``, ``cache/`` of the checkout or ``~/.cache/neusee``.

    The first of these folders that is set or exists is used. Raises `ValueError` if the variable contains a URL.
    """
    if value := os.environ.get("NEUSEE_CACHE"):
        if "://" in value:
            raise ValueError(f"NEUSEE_CACHE is {value!r}, which is not a folder: open a URL with `open_store`")
        return Path(value)
    here = Path.cwd()
    for folder in (here, *here.parents):
        if (folder / "cache").is_dir() and _is_checkout(folder):
            return folder / "cache"
    return Path.home() / ".cache" / "neusee"


def _is_checkout(folder: Path) -> bool:
    """Return True for a checkout of neusee; with ``--no-code``, a stranger's folder that looks like one is none."""
    project = folder / "pyproject.toml"
    if not project.is_file() or 'name = "neusee"' not in project.read_text("utf-8"):
        return False
    return not os.environ.get("NEUSEE_NO_CODE") or folder in Path(neusee.__file__).resolve().parents


def verify_mode(mode: str | None) -> Verify:
    """Return the mode of checksum comparison: ``mode`` if given, else ``$NEUSEE_CACHE_VERIFY``, else ``always``.

    Raises `ValueError` for an unknown mode.
    """
    name = "verify" if mode else "NEUSEE_CACHE_VERIFY"
    mode = mode or os.environ.get("NEUSEE_CACHE_VERIFY") or "always"
    if mode not in get_args(Verify):
        raise ValueError(f"{name} is {mode!r}: write always, sampled or never")
    return cast(Verify, mode)


def budget_bytes(budget: int | None) -> int | None:
    """Return the budget of a store in bytes: ``budget`` if given, else ``$NEUSEE_CACHE_BUDGET``, else None.

    Raises `ValueError` for an invalid size.
    """
    text = os.environ.get("NEUSEE_CACHE_BUDGET")
    if budget is not None or not text:
        return budget
    try:
        return parse_size(text)
    except ValueError as error:
        raise ValueError(f"NEUSEE_CACHE_BUDGET: {error}") from None
