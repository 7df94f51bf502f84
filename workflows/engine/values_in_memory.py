"""The values of a run that are in memory, each until no later step of the run needs it."""

from __future__ import annotations

from collections import Counter
from collections.abc import Iterable
from typing import Any

from neusee.workflows.engine.step_job import Outcome
from neusee.workflows.engine.write_behind import WriteBehind
from neusee.workflows.keys.cache_key import Key
from neusee.workflows.store.result_store import Store


class ValuesInMemory(dict[Key, Any]):
    """Values by cache key, with what this run knows of their copies in the store.

    ``later`` has the values that are being written in the background.
    """

    def __init__(self, store: Store, later: WriteBehind) -> None:
        super().__init__()
        self._store, self._later = store, later
        self._unsure = dict[Key, bool]()  # values that the store may lack; True after a write in the background

    def add(self, outcome: Outcome) -> None:
        """Add the value of a step that was computed."""
        key = outcome.work.key
        self[key] = outcome.value
        self._unsure.pop(key, None)
        if outcome.waits or not outcome.kept:
            self._unsure[key] = outcome.waits

    def free(self, keys: Iterable[Key], uses: Counter[Key], keep: bool) -> None:
        """Delete the values that no later step needs; with ``keep``, only those of which the store has a copy."""
        for key in keys:
            unused = uses[key] <= 0 and key in self and key not in self._later
            if unused and not (keep and self._is_only_here(key)):
                del self[key]

    def _is_only_here(self, key: Key) -> bool:
        """Return True if the store has no copy of a value; a write in the background may have failed."""
        return key in self._unsure and (not self._unsure[key] or not self._store.has(key))
