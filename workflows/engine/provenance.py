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
    """Return the versions of Python and of the numerical libraries; no cache key depends on these versions."""
    libraries = ("neusee", "torch", "kornia", "colour-science", "OpenEXR")
    return {"python": platform.python_version(), **{name: version_of(name) or "none" for name in libraries}}


def version_of(package: str) -> str:
    """Return the version of an installed package, or an empty string if it or its description is not there."""
    try:
        return version(package) or ""
    except (PackageNotFoundError, FileNotFoundError):  # the second comes from the package importlib_metadata
        return ""


def machine() -> Sequence[str]:
    """Return the name and type of the machine, the number of threads and the versions of the libraries."""
    return [platform.node(), platform.machine(), str(torch.get_num_threads()), *versions().values()]


def timestamp() -> str:
    """Return the present time in UTC, to the second, in ISO format."""
    return datetime.now(UTC).isoformat(timespec="seconds")
