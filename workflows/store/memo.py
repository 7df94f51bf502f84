"""Values that are computed only once: a value is read from the store, or computed and then stored."""

from __future__ import annotations

import time
from collections.abc import Callable
from contextlib import suppress
from dataclasses import asdict, is_dataclass
from datetime import UTC, datetime
from typing import TypeVar

from neusee.workflows.store.metadata import Metadata
from neusee.workflows.store.result_store import Store

T = TypeVar("T")


def compute_once(
    store: Store, key: str, kind: type[T], compute: Callable[[], T], about: Metadata, *, small: bool = False
) -> T:
    """Return the value that ``store`` has under ``key``, or compute and store the value if it is missing.

    Args: kind: the type of the value. A dataclass is stored as the dict of its fields. about: metadata of the value,
    which get the date and the seconds that ``compute`` took. small: whether to store the value with `Store.put_small`.
    """
    with suppress(KeyError):
        kept = store.get(key, dict if is_dataclass(kind) else kind)
        make: Callable[..., T] = kind
        try:
            return make(**kept) if is_dataclass(kind) else make(kept)
        except (TypeError, ValueError) as error:  # a value with other fields
            store.put_aside(key, error)
    began = time.perf_counter()
    value = compute()
    spent: Metadata = {"seconds": time.perf_counter() - began, "date": datetime.now(UTC).isoformat(timespec="seconds")}
    keep = store.put_small if small else store.put
    keep(key, asdict(value) if is_dataclass(value) and not isinstance(value, type) else value, spent | about)
    return value
