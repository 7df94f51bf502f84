"""A series of runs, such as those of the points of a sweep: what a run found that holds for the next run as well."""

from __future__ import annotations

from collections.abc import Iterable, Mapping
from dataclasses import dataclass, field

from neusee.nodes import TensorStats
from neusee.workflows.keys.cache_key import Key, is_private
from neusee.workflows.keys.code_digest import Code
from neusee.workflows.keys.known_keys import KnownKeys
from neusee.workflows.store.result_store import Store


@dataclass(eq=False)
class RunSeries:
    """What the runs of a series share: the code of nodes, keys of steps, and statistics of results.

    The key of a result decides its statistics, so that they hold whatever has become of the result in the store.
    """

    known_keys: KnownKeys
    facts: dict[Key, TensorStats] = field(default_factory=dict)  #: of the results of the newest run alone

    @classmethod
    def begun(cls, store: Store) -> RunSeries:
        """Return a series without a run, whose code is read now."""
        return cls(KnownKeys(Code(store.code_memo)))

    def read_code_again(self, store: Store) -> None:
        """Forget the digests of code and the keys that rest on them."""
        self.known_keys = KnownKeys(Code(store.code_memo))

    def keep(self, facts: Mapping[Key, TensorStats | None], keys: Iterable[Key]) -> None:
        """Keep the statistics of the results ``keys`` for the next run, in place of those of earlier runs.

        The next run computes private results again, which may differ then.
        """
        public = [key for key in keys if not is_private(key)]
        self.facts = {key: found for key in public if (found := facts.get(key)) is not None}
