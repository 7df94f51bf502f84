"""Choice between loading and computing each value of a run: a minimum cut of a graph gives the
lowest total time.

To load a value costs the time of reading. To compute a value costs the time of its step and
requires its inputs. The cheapest choice for a whole graph is a minimum cut (Xin et al., Helix,
PVLDB 12(4), 2018, section 5): ``have v`` and ``compute v`` are two nodes, loading is the edge
between the two, computing is the edge to the sink, and a required input is an edge that is never
cut.
"""

from __future__ import annotations

from collections import Counter
from collections.abc import Callable, Iterable, Sequence

from neusee.workflows.graph.recipe_graph import in_order
from neusee.workflows.keys.cache_key import Key

_GAIN = 1e-3  #: s that recomputing a value must save before the cut is solved
#: the sum of all finite prices as integer capacity, less than an edge that is never cut
_SCALE = 1 << 30

Price = Callable[[Key], float]


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
    below, uses = Upstream(is_known, sources), Counter(targets)
    in_order(below, targets)
    for key in below.missing.union(plan):
        uses.update(sources(key))
    return uses


def worth_solving(load: float, compute: float) -> bool:
    """Return True if computing a value takes clearly less time than loading the value; both
    times are in s.
    """
    return load > compute + _GAIN


def cheaper_to_recompute(
    targets: Sequence[Key], sources: Callable[[Key], Sequence[Key]], load: Price, compute: Price
) -> set[Key]:
    """Return the keys of the stored values that are cheaper to compute than to load.

    ``load`` returns inf for a value that is not stored, and 0 for a value in memory.
    """
    reach = in_order(Upstream(lambda key: False, lambda key: list(sources(key))), targets)
    computed = _smallest_cut(targets, reach, sources, load, compute)
    return {key for key in computed if load(key) < float("inf")}


def _smallest_cut(
    targets: Sequence[Key],
    keys: Sequence[Key],
    sources: Callable[[Key], Sequence[Key]],
    load: Price,
    compute: Price,
) -> set[Key]:
    """Return the keys of the values to compute, which are on the source side of a minimum cut of
    the graph.
    """
    import numpy as np
    from scipy.sparse import csr_array
    from scipy.sparse.csgraph import breadth_first_order, maximum_flow

    number = {key: i for i, key in enumerate(keys)}
    source, sink, never = 2 * len(keys), 2 * len(keys) + 1, 2**31 - 1
    edges = [(source, 2 * number[key], never) for key in dict.fromkeys(targets)]
    prices = [price(key) for key in keys for price in (load, compute)]
    # s in one unit of capacity
    unit = max(sum(price for price in prices if price < float("inf")), 1e-9) / _SCALE
    for key in keys:
        have, make = 2 * number[key], 2 * number[key] + 1
        edges.append((have, make, _whole(load(key), unit)))
        edges.append((make, sink, max(1, _whole(compute(key), unit))))
        edges += [(make, 2 * number[below], never) for below in dict.fromkeys(sources(key))]
    rows, columns, capacities = (
        np.array(column, dtype=np.int32) for column in zip(*edges, strict=True)
    )
    graph = csr_array((capacities, (rows, columns)), shape=(sink + 1, sink + 1))
    residual = graph - maximum_flow(graph, source, sink).flow
    residual.data = np.where(residual.data > 0, residual.data, 0)
    residual.eliminate_zeros()
    reached = set(breadth_first_order(residual, source, return_predecessors=False).tolist())
    return {key for key in keys if 2 * number[key] + 1 in reached}


def _whole(seconds: float, unit: float) -> int:
    return 2**31 - 1 if seconds == float("inf") else int(seconds / unit)
