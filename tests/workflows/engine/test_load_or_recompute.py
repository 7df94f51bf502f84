"""Load or recompute: the choice is the cheapest there is, by trying all of them."""

import itertools

from hypothesis import given, settings
from hypothesis import strategies as st

from neusee.workflows.engine.load_or_recompute import cheaper_to_recompute, worth_solving

INF = float("inf")


@st.composite
def graphs(draw):
    """A few values, each with its sources, the price to load it (inf: not stored) and to compute
    it.
    """
    n = draw(st.integers(1, 6))
    sources = {
        i: tuple(draw(st.sets(st.integers(0, i - 1), max_size=3)) if i else ()) for i in range(n)
    }
    prices = st.floats(0.001, 10.0)
    load = {i: draw(st.one_of(st.just(INF), prices)) for i in range(n)}
    compute = {i: draw(prices) for i in range(n)}
    targets = draw(st.lists(st.integers(0, n - 1), min_size=1, max_size=2, unique=True))
    return targets, sources, load, compute


def price(targets, sources, load, compute, computed):
    """What it costs to compute ``computed`` and to load what else is needed; inf where that
    cannot be.
    """
    need = set(targets).union(*(sources[i] for i in computed))
    return sum(compute[i] for i in computed) + sum(load[i] for i in need - computed)


def walked(targets, sources, load, again):
    """What a run computes that loads all that is stored but ``again``."""
    computed, todo = set(), list(targets)
    while todo:
        i = todo.pop()
        if i not in computed and (load[i] == INF or i in again):
            computed.add(i)
            todo += sources[i]
    return computed


@given(graphs())
@settings(max_examples=300, deadline=None)
def test_the_choice_is_the_cheapest_of_all(graph):
    targets, sources, load, compute = graph
    again = cheaper_to_recompute(
        targets, sources.__getitem__, load.__getitem__, compute.__getitem__
    )
    ours = price(targets, sources, load, compute, walked(targets, sources, load, again))
    subsets = itertools.chain.from_iterable(
        itertools.combinations(sources, k) for k in range(len(sources) + 1)
    )
    best = min(price(targets, sources, load, compute, set(s)) for s in subsets)
    assert ours <= best * (1 + 1e-6) + 1e-6


def test_what_is_not_stored_is_never_named():
    again = cheaper_to_recompute(
        [1], {0: (), 1: (0,)}.__getitem__, {0: INF, 1: 5.0}.__getitem__, lambda i: 1.0
    )
    assert again == {1}


def test_a_long_chain_is_no_recursion():
    n = 5000
    found = cheaper_to_recompute(
        [n - 1], lambda i: (i - 1,) if i else (), lambda i: 9e9 if i % 2 else INF, lambda i: 1.0
    )
    assert found == {i for i in range(n) if i % 2}


def test_a_millisecond_is_not_worth_a_look():
    assert not worth_solving(0.0015, 0.001)
    assert worth_solving(0.5, 0.001)
