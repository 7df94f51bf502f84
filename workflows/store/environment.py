"""Where the store lies, how far it trusts its files and how large it may grow, as the environment says."""

from __future__ import annotations

import os
from pathlib import Path
from typing import Literal, cast, get_args

from neusee.workflows.store.budget_eviction import bytes_of

Verify = Literal["always", "sampled", "never"]


def default_root() -> Path:
    """``$NEUSEE_CACHE``, else ``cache/`` of the checkout around us, else ``~/.cache/neusee``.

    Raises `ValueError` where a URL is named.
    """
    if named := os.environ.get("NEUSEE_CACHE"):
        if "://" in named:
            raise ValueError(f"NEUSEE_CACHE is {named!r}, which is no folder: `open_store` takes URLs too")
        return Path(named)
    here = Path.cwd()
    for folder in (here, *here.parents):
        project = folder / "pyproject.toml"
        if (folder / "cache").is_dir() and project.is_file() and 'name = "neusee"' in project.read_text("utf-8"):
            return folder / "cache"
    return Path.home() / ".cache" / "neusee"


def verify_mode(wanted: str | None) -> Verify:
    """``wanted``, else ``$NEUSEE_CACHE_VERIFY``, else ``always``; a `ValueError` where it is no such word."""
    name = "verify" if wanted else "NEUSEE_CACHE_VERIFY"
    found = wanted or os.environ.get("NEUSEE_CACHE_VERIFY") or "always"
    if found not in get_args(Verify):
        raise ValueError(f"{name} is {found!r}: write always, sampled or never")
    return cast(Verify, found)


def budget_bytes(wanted: int | None) -> int | None:
    """``wanted``, else ``$NEUSEE_CACHE_BUDGET`` such as ``20 GB``, else none; a `ValueError` where it is no size."""
    named = os.environ.get("NEUSEE_CACHE_BUDGET")
    if wanted is not None or not named:
        return wanted
    try:
        return bytes_of(named)
    except ValueError as error:
        raise ValueError(f"NEUSEE_CACHE_BUDGET: {error}") from None
