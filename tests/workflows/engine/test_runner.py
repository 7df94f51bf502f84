"""A run computes what is needed, reads what is known, and accounts for both."""

import errno
import gc
import os
import time
import weakref
from dataclasses import replace

import pytest
import torch

from neusee.nodes import Check, node
from neusee.nodes.values import Bands
from neusee.workflows.engine import execution
from neusee.workflows.engine.runner import run
from neusee.workflows.graph.errors import Location, RunError
from neusee.workflows.graph.recipe_graph import Recipe, Step
from neusee.workflows.store import payload as small_results
from neusee.workflows.store import serialization
from neusee.workflows.store.result_store import Store

CALLS: list[str] = []
ALIVE: list[weakref.ref] = []
BIG = 40_000  #: numbers in a value that has a payload


@node()
def source(*, value: float = 1.0, count: int = 4):
    CALLS.append("source")
    return torch.full((count,), value) + torch.arange(count)


@node()
def add(x, *, k: float = 1.0):
    CALLS.append("add")
    return x + k


@node()
def total(xs, other=None):
    CALLS.append("total")
    return sum(x.sum(dtype=torch.float64) for x in xs) + (0 if other is None else other)


@node()
def noise(x, *, sigma: float = 1.0, rng: torch.Generator):
    return x + sigma * torch.randn(x.shape, generator=rng)


@noise.skip_bound
def _(x, *, sigma):
    return sigma / x.max if sigma else 0.0


@node()
def turned(x):
    return x.reshape(-1, 100).T


@node()
def reduced(x):
    return (x * 1.0001).sum(0)


@node()
def checked(x, *, top: float = 100.0):
    return x


@checked.check
def _(result, x, *, top):
    CALLS.append("check")
    return [
        Check(f"at most {top:g}", bool(result.max() <= top)),
        Check("sum", bool(result.sum() == x.sum())),
    ]


@node()
def broken_check(x):
    return x


@broken_check.check
def _(result, x):
    raise ZeroDivisionError("of all things")


@node()
def fails(x, *, how: str = "value"):
    if how == "interrupt":
        raise KeyboardInterrupt
    raise ValueError(f"{x.shape[0]} samples are too few: give at least 1000")


@node()
def spoils(x):
    return x.mul_(2)


@node()
def strange(x):
    return {1: x}


@node()
def traced(x=None):
    """Remember how many results of this node are alive while it runs."""
    CALLS.append(sum(r() is not None for r in ALIVE))
    result = torch.zeros(BIG) if x is None else x + 1
    ALIVE.append(weakref.ref(result))
    return result


@node()
def bands(*, n: int):
    c = torch.linspace(4e-7, 7e-7, n, dtype=torch.float64)
    return Bands(c, c, c)


@node()
def centre(bands):
    return bands.centres.mean()


@node()
def graded():
    return torch.ones(2, requires_grad=torch.is_grad_enabled())


@pytest.fixture(autouse=True)
def _fresh():
    CALLS.clear()
    ALIVE.clear()


@pytest.fixture
def store(tmp_path):
    return Store(tmp_path / "cache")


def again(store):
    """The same folder, as the next process sees it."""
    return Store(store.root)


def recipe(outputs, tolerance=0.0, seed=7, **steps):
    """Steps, given as ``name=(node, {input: step}, {param: value})``."""

    def step(name, what, wires=None, params=None):
        return Step(
            name,
            what,
            dict(what.params(**params or {})),
            wires or {},
            Location("test.yaml", 3, 5),
            {},
        )

    made = {name: step(name, *rest) for name, rest in steps.items()}
    return Recipe("test", "", seed, tolerance, tuple(outputs.split()), made)


def diamond(k=1.0, count=4, outputs="top"):
    return recipe(
        outputs,
        head=(source, {}, {"value": 2.0, "count": count}),
        left=(add, {"x": "head"}, {"k": k}),
        right=(add, {"x": "head"}, {"k": 10.0}),
        top=(total, {"xs": ("left", "right"), "other": None}),
    )


def states(result):
    return {name: done.state for name, done in result.done.items()}


def test_a_run_computes_in_order_and_a_second_one_reads(store):
    first = run(diamond(), store)
    assert first.values["top"] == 4 * 4.0 + 2 * 6 + 44 == 72
    assert CALLS == ["source", "add", "add", "total"]
    assert list(first.done) == ["head", "left", "right", "top"]
    assert set(states(first).values()) == {"run"}
    second = run(diamond(), again(store))
    assert torch.equal(second.values["top"], first.values["top"])
    assert states(second) == {
        "head": "not needed",
        "left": "not needed",
        "right": "not needed",
        "top": "cached",
    }
    assert second.keys == first.keys
    assert len(CALLS) == 4


def test_only_what_a_change_reaches_runs_again(store):
    run(diamond(), store)
    CALLS.clear()
    changed = run(diamond(k=5.0), again(store))
    assert CALLS == ["add", "total"]
    assert states(changed) == {"head": "cached", "left": "run", "right": "cached", "top": "run"}


def test_a_cached_tail_reads_nothing_of_its_head(store, monkeypatch):
    run(diamond(count=BIG), store)
    monkeypatch.setattr(serialization, "read", lambda *a: pytest.fail("a payload was read"))
    result = run(diamond(count=BIG), again(store))
    assert result.values["top"].ndim == 0
    assert states(result)["head"] == "not needed"


def test_an_input_is_read_once_and_only_for_a_step_that_runs(store, monkeypatch):
    run(diamond(count=BIG, outputs="top left right head"), store)
    read, loads = serialization.read, []
    monkeypatch.setattr(
        serialization, "read", lambda path, *rest: loads.append(path) or read(path, *rest)
    )
    run(diamond(k=5.0, count=BIG), again(store))
    assert len(loads) == len(set(loads)) == 2


def test_only_what_is_asked_for_runs(store):
    result = run(diamond(), store, outputs=("left",))
    assert list(result.values) == ["left"]
    assert CALLS == ["source", "add"]
    assert result.value("top") == 72
    assert result.value("left") is result.values["left"]
    assert CALLS == ["source", "add", "add", "total"]


def test_unknown_outputs_are_named(store):
    with pytest.raises(ValueError, match="no step 'rihgt'; did you mean right"):
        run(diamond(), store, outputs=("rihgt",))


def test_steps_that_are_the_same_computation_run_once(store):
    twins = recipe(
        "a b c", s=(source,), a=(add, {"x": "s"}), b=(add, {"x": "s"}), c=(add, {"x": "b"})
    )
    result = run(twins, store)
    assert CALLS == ["source", "add", "add"]
    assert states(result) == {"s": "run", "a": "run", "b": "cached", "c": "run"}
    assert result.done["b"].why == "the same key as a"
    assert torch.equal(result.values["b"], result.values["a"])


@pytest.mark.parametrize("count", [4, BIG])
def test_a_cached_run_gives_the_same_bits_and_the_same_layout(store, count):
    steps = {
        "s": (source, {}, {"count": count * 100}),
        "n": (noise, {"x": "s"}),
        "t": (turned, {"x": "n"}),
        "r": (reduced, {"x": "t"}),
    }
    whole = run(recipe("r t n", **steps), store)
    for outputs in ("t", "n", "r"):
        assert torch.equal(
            run(recipe(outputs, **steps), again(store)).values[outputs], whole.value(outputs)
        )
    for entry in [key for name, key in whole.keys.items() if name == "r"]:
        (store.root / entry[:2] / f"{entry}.json").unlink()
    after = run(recipe("r", **steps), again(store))
    assert states(after) == {"s": "not needed", "n": "not needed", "t": "cached", "r": "run"}
    assert torch.equal(after.values["r"], whole.values["r"])
    assert whole.value("t").is_contiguous()


def test_noise_does_not_depend_on_what_else_ran(store, tmp_path):
    steps = {"s": (source,), "a": (noise, {"x": "s"}), "b": (noise, {"x": "s"})}
    both = run(recipe("a b", **steps), store)
    alone = run(recipe("b", **steps), Store(tmp_path / "other"))
    assert torch.equal(both.values["b"], alone.values["b"])
    assert not torch.equal(both.values["a"], both.values["b"])
    other = run(recipe("b", seed=8, **steps), again(store))
    assert not torch.equal(other.values["b"], both.values["b"])


def test_global_random_state_is_left_alone(store):
    torch.manual_seed(3)
    expected = torch.rand(4)
    torch.manual_seed(3)
    run(recipe("a", s=(source,), a=(noise, {"x": "s"})), store)
    assert torch.equal(torch.rand(4), expected)


def ladder(tolerance, sigma, outputs="z"):
    return recipe(
        outputs,
        tolerance,
        s=(source, {}, {"value": 100.0, "count": BIG}),
        n=(noise, {"x": "s"}, {"sigma": sigma}),
        m=(noise, {"x": "n"}, {"sigma": 0.0}),
        z=(add, {"x": "m"}),
    )


def test_a_step_within_the_tolerance_is_left_out_and_hands_on_its_input(store):
    result = run(ladder(1e-3, 1.0), store)
    assert states(result) == {"s": "run", "n": "left out", "m": "left out", "z": "run"}
    assert result.keys["m"] == result.keys["n"] == result.keys["s"]
    assert result.done["n"].bound == pytest.approx(1 / (99 + BIG))
    assert "tolerance 0.001" in result.done["n"].why
    assert torch.equal(result.value("n"), result.value("s"))


def test_a_step_beyond_the_tolerance_runs_and_says_so(store):
    result = run(ladder(1e-6, 1.0), store)
    assert states(result) == {"s": "run", "n": "run", "m": "left out", "z": "run"}
    assert result.done["n"].bound == pytest.approx(1 / (99 + BIG))
    assert "tolerance 1e-06" in result.done["n"].why


def test_a_verdict_on_a_cached_run_reads_no_payload(store, monkeypatch):
    first = run(ladder(1e-3, 1.0), store)
    monkeypatch.setattr(serialization, "read", lambda *a: pytest.fail("a payload was read"))
    with pytest.raises(pytest.fail.Exception):
        run(ladder(1e-3, 1.0), again(store))
    monkeypatch.undo()
    assert run(ladder(1e-3, 1.0), again(store)).keys == first.keys
    assert states(run(ladder(1e-3, 1.0), again(store))) == {
        "s": "not needed",
        "n": "left out",
        "m": "left out",
        "z": "cached",
    }


def test_an_input_runs_for_a_verdict_only_if_the_bound_asks_for_its_facts(store):
    without = recipe("n", 1e-3, s=(source,), n=(noise, {"x": "s"}, {"sigma": 0.0}))
    events = []
    run(without, store, watch=events.append)
    assert [e.step for e in events][:1] == ["n"]
    assert events[0].done.state == "left out"
    asks = recipe("n", 1e-3, s=(source, {}, {"value": 2.0}), n=(noise, {"x": "s"}, {"sigma": 1e-9}))
    events.clear()
    run(asks, store, watch=events.append)
    assert [e.step for e in events] == ["s", "s", "n"]


@node()
def endless(*, kind: str = "inf"):
    return torch.full((4,), float(kind))


@pytest.mark.parametrize("kind", ["inf", "nan"])
def test_nothing_is_left_out_after_a_value_that_is_not_finite(store, kind):
    steps = recipe("n", 1.0, s=(endless, {}, {"kind": kind}), n=(noise, {"x": "s"}))
    assert states(run(steps, store)) == {"s": "run", "n": "run"}


def test_a_bound_that_fails_names_its_step(store):
    with pytest.raises(RunError, match=r"test.yaml:3:5   n .*ZeroDivision"):
        run(recipe("n", 1.0, s=(source, {}, {"value": -3.0}), n=(noise, {"x": "s"})), store)


def test_checks_run_once_and_stay_with_the_result(store):
    steps = recipe("c", s=(source,), c=(checked, {"x": "s"}, {"top": 2.0}))
    expected = (Check("at most 2", False), Check("sum", True))
    assert run(steps, store).done["c"].checks == expected
    assert run(steps, again(store)).done["c"].checks == expected
    assert CALLS.count("check") == 1


def test_a_check_that_fails_to_run_is_a_failed_check(store):
    (check,) = run(recipe("c", s=(source,), c=(broken_check, {"x": "s"})), store).done["c"].checks
    assert not check.ok
    assert "of all things" in check.text


def test_the_account_says_what_it_cost(store):
    began = time.perf_counter()
    done = run(diamond(count=BIG, outputs="top left head"), store).done["left"]
    whole_run = time.perf_counter() - began
    assert done.bytes == 4 * BIG
    assert done.facts.max == 2.0 + BIG
    assert 0 < done.seconds < whole_run
    cached = run(diamond(count=BIG), again(store), outputs=("left",)).done["left"]
    assert (cached.bytes, cached.facts, cached.key) == (done.bytes, done.facts, done.key)
    assert cached.why.startswith("computed 20")
    about = again(store).about(done.key)
    assert about["origin"]["params"] == {"k": 1.0}
    assert about["origin"]["inputs"] == [run(diamond(count=BIG), again(store)).keys["head"]]
    assert {"python", "torch", "neusee"} <= about["versions"].keys()


def test_events_tell_what_starts_and_what_has_ended(store):
    events = []
    run(diamond(), store, watch=events.append)
    names = [name for name in ("head", "left", "right", "top") for _ in range(2)]
    assert [e.step for e in events] == names
    assert [e.done is None for e in events] == [True, False] * 4
    events.clear()
    run(diamond(), again(store), watch=events.append)
    assert {e.step: e.done.state for e in events}["top"] == "cached"


def test_an_error_names_the_step_and_what_it_was_given(store):
    steps = recipe(
        "f a", s=(source, {}, {"count": BIG}), a=(add, {"x": "s"}), f=(fails, {"x": "a"})
    )
    with pytest.raises(RunError) as caught:
        run(steps, store)
    text = str(caught.value)
    assert text.startswith("test.yaml:3:5   f (")
    assert "fails): ValueError: 40000 samples are too few: give at least 1000" in text
    assert text.endswith("inputs: x (40000,) float32")
    assert isinstance(caught.value.__cause__, ValueError)
    assert caught.value.step == "f"
    assert states(run(steps, again(store), outputs=("a",))) == {"s": "not needed", "a": "cached"}


def test_an_interrupt_keeps_what_was_finished(store):
    steps = recipe(
        "f s", s=(source, {}, {"count": BIG}), f=(fails, {"x": "s"}, {"how": "interrupt"})
    )
    with pytest.raises(KeyboardInterrupt):
        run(steps, store)
    assert states(run(steps, again(store), outputs=("s",))) == {"s": "cached"}
    left = [f.name for f in (store.root / "tmp").iterdir()]
    assert [name for name in left if name != ".lock" and not name.startswith("badge.")] == []


def test_a_node_that_changes_its_input_is_refused(store):
    with pytest.raises(RunError, match="changed its input in place"):
        run(recipe("f", s=(source,), f=(spoils, {"x": "s"})), store)


@pytest.mark.parametrize("what", [None, (), 3.0])
def test_a_result_of_another_type_than_annotated_ends_the_run_at_its_step(store, what):
    @node()
    def forgets(x) -> torch.Tensor:
        return what

    recipe_ = recipe("g", s=(source,), f=(forgets, {"x": "s"}), g=(noise, {"x": "f"}))
    text = (
        rf"f \(.*forgets\): TypeError: the node returned a value of the type {type(what).__name__}"
    )
    with pytest.raises(RunError, match=text + ", but its annotation says Tensor"):
        run(replace(recipe_, tolerance=1e-3), store)


def test_a_result_that_cannot_be_kept_is_refused(store):
    with pytest.raises(RunError, match=r"f \(.*must return tensors"):
        run(recipe("f", s=(source,), f=(strange, {"x": "s"})), store)


@pytest.mark.parametrize("victim", ["top", "left", "head"])
@pytest.mark.parametrize("suffix", ["json", "safetensors"])
@pytest.mark.parametrize("how", ["flip", "cut", "gone"])
def test_damage_is_computed_again_and_never_served(store, victim, suffix, how):
    first = run(diamond(count=BIG, outputs="top left head"), store)
    key = first.keys[victim]
    path = store.root / key[:2] / f"{key}.{suffix}"
    if not path.exists():
        path = path.with_suffix(".json")
    data = bytearray(path.read_bytes())
    data[len(data) // 2] ^= 64
    path.unlink() if how == "gone" else path.write_bytes(
        data if how == "flip" else data[: len(data) // 2]
    )
    hidden = how == "gone" and path.suffix == ".json"
    with warnings_of("is damaged", 0 if hidden else 1):
        second = run(diamond(count=BIG, outputs="top left head"), again(store))
    assert all(torch.equal(second.values[name], first.values[name]) for name in first.values)
    assert states(second)[victim] == "run"
    assert set(states(run(diamond(count=BIG, outputs="top left head"), again(store))).values()) <= {
        "cached",
        "not needed",
    }


class warnings_of:
    """Exactly ``count`` warnings that say ``text``, and no other."""

    def __init__(self, text, count):
        self.text, self.count = text, count

    def __enter__(self):
        import warnings

        self.catch = warnings.catch_warnings(record=True)
        self.seen = self.catch.__enter__()
        warnings.simplefilter("always")

    def __exit__(self, *error):
        self.catch.__exit__(*error)
        assert [self.text in str(w.message) for w in self.seen] == [True] * self.count


def test_all_of_a_store_damaged_at_once_is_computed_again(store, monkeypatch):
    # each has a file of its own, however quick it was
    monkeypatch.setattr(execution, "_UNLOCKED_SECONDS", 0.0)
    first = run(diamond(count=BIG), store)
    for path in [*store.root.rglob("*.safetensors"), *store.root.glob("??/*.json")]:
        data = bytearray(path.read_bytes())
        data[-60] ^= 1
        path.write_bytes(data)
    with warnings_of("is damaged", 4):
        second = run(diamond(count=BIG), again(store))
    assert torch.equal(second.values["top"], first.values["top"])


@pytest.mark.parametrize("outputs", ["top", "top left head"])
def test_a_full_disk_costs_one_warning_and_no_second_computation(store, monkeypatch, outputs):
    def full(*args):
        raise OSError(errno.ENOSPC, os.strerror(errno.ENOSPC))

    monkeypatch.setattr(os, "replace", full)
    monkeypatch.setattr(os, "link", full)
    # where a result goes that is computed faster than written
    monkeypatch.setattr(small_results, "append", full)
    with warnings_of("cannot be written", 1):
        result = run(diamond(outputs=outputs), store)
    assert result.values["top"] == 72
    assert CALLS == ["source", "add", "add", "total"]
    monkeypatch.undo()
    assert set(states(run(diamond(outputs=outputs), again(store))).values()) == {"run"}


def test_without_a_store_the_ladder_computes_nothing_twice(tmp_path):
    (tmp_path / "file").write_text("in the way")
    with warnings_of("cannot be written", 1):
        result = run(ladder(1e-6, 1.0), Store(tmp_path / "file"))
    assert CALLS == ["source", "add"]
    assert states(result) == {"s": "run", "n": "run", "m": "left out", "z": "run"}


def test_values_are_let_go_at_their_last_use_without_the_garbage_collector(store):
    steps = {"t0": (traced,), **{f"t{i}": (traced, {"x": f"t{i - 1}"}) for i in range(1, 8)}}
    gc.collect()
    gc.disable()
    try:
        run(recipe("t7", **steps), store)
    finally:
        gc.enable()
    assert CALLS == [0, 1, 1, 1, 1, 1, 1, 1]
    assert [r() for r in ALIVE] == [None] * 8


def test_a_slice_does_not_hold_what_it_was_cut_from(store):
    @node()
    def first(x):
        return x[:1000]

    result = run(recipe("f", s=(source, {}, {"count": BIG}), f=(first, {"x": "s"})), store)
    assert result.values["f"].untyped_storage().nbytes() == 4000


def test_named_tuples_travel_through_the_store(store):
    steps = recipe("c", b=(bands, {}, {"n": 1000}), c=(centre, {"bands": "b"}))
    assert run(steps, store).values["c"] == pytest.approx(5.5e-7)
    value = run(steps, again(store), outputs=("b",)).values["b"]
    assert type(value) is Bands
    assert value.widths is value.centres


def test_a_cached_run_keeps_no_history_for_gradients(store):
    assert not run(recipe("g", g=(graded,)), store).values["g"].requires_grad


def test_the_tolerance_is_no_part_of_a_key(store):
    assert run(replace(diamond(), tolerance=0.5), store).keys == run(diamond(), again(store)).keys


def chain(n):
    return recipe(
        f"s{n}",
        s0=(source,),
        **{f"s{i}": (add, {"x": f"s{i - 1}"}, {"k": 1.0}) for i in range(1, n + 1)},
    )


@pytest.mark.slow
def test_a_chain_of_five_thousand_steps_runs_and_its_work_grows_with_its_length(store):
    """Five times as deep as Python may call."""
    work = {}
    for length in (500, 5000):
        steps = chain(length)
        assert run(steps, store).values[f"s{length}"][0] == length + 1
        began = time.process_time()
        assert run(steps, again(store)).values[f"s{length}"][0] == length + 1
        work[length] = time.process_time() - began
    # ten times, and 100 times if each step looked at all others
    assert work[5000] < 30 * work[500]


def test_the_result_says_how_much_memory_and_time(store):
    result = run(diamond(), store)
    assert result.seconds > 0
    assert result.peak_memory > 50e6
