"""Values that are computed once: taken from the store under a key, or computed now and kept there."""

from __future__ import annotations

import time
from collections.abc import Callable
from contextlib import suppress
from dataclasses import asdict, is_dataclass
from datetime import UTC, datetime
from typing import Any, TypeVar

from neusee.workflows.store.metadata import Metadata
from neusee.workflows.store.result_store import Store

T = TypeVar("T")


def compute_once(
    store: Store, key: str, kind: type[T], compute: Callable[[], T], about: Metadata, *, small: bool = False
) -> T:
    """Return the value that ``store`` keeps under ``key``; where it keeps none, compute the value and keep it.

    Args: kind: the type of the value. A dataclass is kept as the dict of its fields. about: what the metadata says of
    the value, beside the date and the seconds that ``compute`` took. small: whether to keep the value without a file of
    its own, as `Store.put_small` does.
    """
    with suppress(KeyError):
        return _restored(kind, store.get(key))
    began = time.perf_counter()
    value = compute()
    spent: Metadata = {"seconds": time.perf_counter() - began, "date": datetime.now(UTC).isoformat(timespec="seconds")}
    keep = store.put_small if small else store.put
    keep(key, asdict(value) if is_dataclass(value) and not isinstance(value, type) else value, spent | about)
    return value


def _restored(kind: type[T], kept: Any) -> T:
    make: Callable[..., T] = kind
    return make(**kept) if is_dataclass(kind) else make(kept)
