"""Provenance of a result: the machine, the versions of the libraries, and the time."""

from __future__ import annotations

import functools
import platform
from collections.abc import Sequence
from datetime import UTC, datetime
from importlib.metadata import PackageNotFoundError, version

import torch


@functools.cache
def versions() -> dict[str, str]:
    """Return the versions of Python and of the libraries that compute; no key depends on the versions."""
    found = {"python": platform.python_version()}
    for name in ("neusee", "torch", "kornia", "colour-science", "OpenEXR"):
        try:
            found[name] = version(name)
        except PackageNotFoundError:
            found[name] = "none"
    return found


def machine() -> Sequence[str]:
    """Return the machine, its number of threads and the versions of the libraries, on which a run time depends."""
    return [platform.node(), platform.machine(), str(torch.get_num_threads()), *versions().values()]


def timestamp() -> str:
    """Return the present time in UTC, to the second, in ISO format."""
    return datetime.now(UTC).isoformat(timespec="seconds")
