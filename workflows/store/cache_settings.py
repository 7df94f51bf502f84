"""Settings of a store from environment variables, with sizes such as 20 GB."""

from __future__ import annotations

import os
import re
from pathlib import Path
from typing import Literal, cast, get_args

import neusee

# --- byte sizes -----------------------------------------------------------------------------------

# Conversion between numbers of bytes and texts such as ``20 GB``.


UNITS = {
    "B": 1,
    "kB": 10**3,
    "MB": 10**6,
    "GB": 10**9,
    "TB": 10**12,
    "MiB": 2**20,
    "GiB": 2**30,
    "TiB": 2**40,
}
_ANY_CASE = {"b": 1, "kib": 2**10, **{unit.lower(): scale for unit, scale in UNITS.items()}}
_SIZE = re.compile(r"\s*(\d+(?:\.\d+)?)\s*((?:[kmgt]i?)?b?)\s*", re.IGNORECASE)


def parse_size(text: str) -> int:
    """Return the number of bytes in a text such as ``20 GB`` or ``1.5 TiB``; raise `ValueError`
    for an invalid text.
    """
    match = _SIZE.fullmatch(text)
    if not match:
        raise ValueError(f"{text!r} is not a size: write a number of bytes, such as 20 GB")
    # "20 G", "20 GB" and "20 gb" mean the same
    unit = match[2].lower().removesuffix("b") + "b"
    return int(float(match[1]) * _ANY_CASE[unit])


def format_size(count: float) -> str:
    """Return a number of bytes as text with three significant digits and a suitable unit, such
    as ``20 GB``.
    """
    unit = next((unit for unit in ("B", "kB", "MB", "GB") if count < 1000 * UNITS[unit]), "TB")
    return f"{count / UNITS[unit]:.3g} {unit}"


# --- environment ----------------------------------------------------------------------------------

# Settings of a store from environment variables: the folder, the mode of checksum comparison and
# the budget.


Verify = Literal["always", "sampled", "never"]


def default_root() -> Path:
    """Return the default folder of a store: ``$NEUSEE_CACHE``, ``cache/`` of the checkout or
    ``~/.cache/neusee``.

    The first of these folders that is set or exists is used. Raises `ValueError` if the variable
    contains a URL.
    """
    if value := os.environ.get("NEUSEE_CACHE"):
        if "://" in value:
            raise ValueError(
                f"NEUSEE_CACHE is {value!r}, which is not a folder: open a URL with `open_store`"
            )
        return Path(value)
    working_folder = Path.cwd()
    for folder in (working_folder, *working_folder.parents):
        if (folder / "cache").is_dir() and _is_checkout(folder):
            return folder / "cache"
    return Path.home() / ".cache" / "neusee"


def _is_checkout(folder: Path) -> bool:
    """Return True for a checkout of neusee. With ``--no-code``, a folder that looks like a checkout
    counts only if it contains the running program.
    """
    project = folder / "pyproject.toml"
    if not project.is_file() or 'name = "neusee"' not in project.read_text("utf-8"):
        return False
    return not os.environ.get("NEUSEE_NO_CODE") or folder in Path(neusee.__file__).resolve().parents


def verify_mode(mode: str | None) -> Verify:
    """Return the mode of checksum comparison: ``mode`` if given, else ``$NEUSEE_CACHE_VERIFY``,
    else ``always``.

    Raises `ValueError` for an unknown mode.
    """
    name = "verify" if mode else "NEUSEE_CACHE_VERIFY"
    mode = mode or os.environ.get("NEUSEE_CACHE_VERIFY") or "always"
    if mode not in get_args(Verify):
        raise ValueError(f"{name} is {mode!r}: write always, sampled or never")
    return cast(Verify, mode)


def budget_bytes(budget: int | None) -> int | None:
    """Return the budget of a store in bytes: ``budget`` if given, else ``$NEUSEE_CACHE_BUDGET``,
    else None.

    Raises `ValueError` for an invalid size.
    """
    text = os.environ.get("NEUSEE_CACHE_BUDGET")
    if budget is not None or not text:
        return budget
    try:
        return parse_size(text)
    except ValueError as error:
        raise ValueError(f"NEUSEE_CACHE_BUDGET: {error}") from None
