"""The values that a run must compute, since the store has no copy of them.

A stored value that is asked for is loaded. What a missing value needs is loaded if it is stored,
and else computed in the same way.
"""

from __future__ import annotations

from collections import Counter
from collections.abc import Callable, Iterable, Sequence

from neusee.workflows.graph.recipe_graph import in_order
from neusee.workflows.keys.cache_key import Key


class Upstream(dict[Key, list[Key]]):
    """Dictionary from the key of a value to the keys of its inputs; the list is empty if the
    value is known.
    """

    def __init__(
        self, is_known: Callable[[Key], bool], sources: Callable[[Key], list[Key]]
    ) -> None:
        self._known, self._sources = is_known, sources
        self.missing = set[Key]()

    def __missing__(self, key: Key) -> list[Key]:
        if self._known(key):
            self[key] = []
        else:
            self.missing.add(key)
            self[key] = self._sources(key)
        return self[key]

    def knows(self, key: Key) -> bool:
        """Return True if a value is known; a value that was asked for before is not asked for
        again.
        """
        return key not in self.missing if key in self else self._known(key)


def uses_of(
    plan: Iterable[Key],
    targets: Sequence[Key],
    is_known: Callable[[Key], bool],
    sources: Callable[[Key], list[Key]],
) -> Counter[Key]:
    """Return how often each value is read while the values with the keys ``plan`` and
    ``targets`` are computed.
    """
    upstream, uses = Upstream(is_known, sources), Counter(targets)
    # the walk notes the missing values
    in_order(upstream, targets)
    for key in upstream.missing.union(plan):
        uses.update(sources(key))
    return uses
