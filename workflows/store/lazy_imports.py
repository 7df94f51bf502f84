"""Modules of the store that import torch, loaded when a value is first read or written: metadata,
leases and the list of a cache do not need them, and the import of torch takes a second.

    from neusee.workflows.store import lazy_imports as lazy
    lazy.serialization.pack(value)
"""

from __future__ import annotations

import importlib
from typing import TYPE_CHECKING, Any

if TYPE_CHECKING:
    from neusee.workflows.store import serialization as serialization

#: modules below neusee
_MODULES = ("workflows.store.serialization",)
_BY_NAME = {module.rpartition(".")[2]: module for module in _MODULES}


def __getattr__(name: str) -> Any:
    """Import a module when it is first used."""
    if name not in _BY_NAME:
        raise AttributeError(f"module {__name__!r} has no attribute {name!r}")
    return importlib.import_module(f"neusee.{_BY_NAME[name]}")
