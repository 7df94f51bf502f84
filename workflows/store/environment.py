"""Settings of the store from the environment: its folder, its verify mode and its budget."""

from __future__ import annotations

import os
from pathlib import Path
from typing import Literal, cast, get_args

from neusee.workflows.store.budget_eviction import bytes_of

Verify = Literal["always", "sampled", "never"]


def default_root() -> Path:
    """Return ``$NEUSEE_CACHE``, else ``cache/`` of the surrounding checkout, else ``~/.cache/neusee``.

    Raises `ValueError` where the variable names a URL.
    """
    if named := os.environ.get("NEUSEE_CACHE"):
        if "://" in named:
            raise ValueError(f"NEUSEE_CACHE is {named!r}, which is not a folder: `open_store` takes URLs too")
        return Path(named)
    here = Path.cwd()
    for folder in (here, *here.parents):
        project = folder / "pyproject.toml"
        if (folder / "cache").is_dir() and project.is_file() and 'name = "neusee"' in project.read_text("utf-8"):
            return folder / "cache"
    return Path.home() / ".cache" / "neusee"


def verify_mode(wanted: str | None) -> Verify:
    """Return ``wanted``, else ``$NEUSEE_CACHE_VERIFY``, else ``always``; raise `ValueError` for any other word."""
    name = "verify" if wanted else "NEUSEE_CACHE_VERIFY"
    found = wanted or os.environ.get("NEUSEE_CACHE_VERIFY") or "always"
    if found not in get_args(Verify):
        raise ValueError(f"{name} is {found!r}: write always, sampled or never")
    return cast(Verify, found)


def budget_bytes(wanted: int | None) -> int | None:
    """Return ``wanted``, else ``$NEUSEE_CACHE_BUDGET`` such as ``20 GB``, else None; raise `ValueError` for no size."""
    named = os.environ.get("NEUSEE_CACHE_BUDGET")
    if wanted is not None or not named:
        return wanted
    try:
        return bytes_of(named)
    except ValueError as error:
        raise ValueError(f"NEUSEE_CACHE_BUDGET: {error}") from None
