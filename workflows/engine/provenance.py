"""The machine, the versions of the libraries and the time at which a result was made."""

from __future__ import annotations

import functools
import platform
from collections.abc import Sequence
from datetime import UTC, datetime
from importlib.metadata import PackageNotFoundError, version

import torch


@functools.cache
def versions() -> dict[str, str]:
    """Return the versions of Python and of the libraries that compute; they stand beside a result, not in its key."""
    found = {"python": platform.python_version()}
    for name in ("neusee", "torch", "kornia", "colour-science", "OpenEXR"):
        try:
            found[name] = version(name)
        except PackageNotFoundError:
            found[name] = "none"
    return found


def machine() -> Sequence[str]:
    """Return what a measured time depends on: the machine, its threads and the versions of the libraries."""
    return [platform.node(), platform.machine(), str(torch.get_num_threads()), *versions().values()]


def timestamp() -> str:
    """Return the time now, in UTC, to the second."""
    return datetime.now(UTC).isoformat(timespec="seconds")
