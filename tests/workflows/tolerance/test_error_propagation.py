"""A tolerance is shared, spent along the graph, and proved to hold; where it is not, less is
left out.
"""

import math
from dataclasses import replace

import pytest
import torch

from neusee.nodes import ErrorBound, TensorStats, node
from neusee.workflows.engine import runner
from neusee.workflows.engine.runner import run
from neusee.workflows.graph.errors import Location
from neusee.workflows.graph.recipe_graph import Recipe, Step, StepRecord, Substitution
from neusee.workflows.store.result_store import Store
from neusee.workflows.tolerance.error_norm import largest_error
from neusee.workflows.tolerance.error_propagation import proof
from neusee.workflows.tolerance.skip_decision import ErrorBudget

MARK = Location("recipe.yaml", 1, 1)


@node()
def light(*, top: float = 100.0):
    return torch.linspace(0.0, top, 101)


@node()
def glow(x, *, amount: float = 0.0):
    """Add a constant."""
    return x + amount


@glow.skip_bound
def _(x, *, amount):
    return abs(amount) / (x.max + amount)


@glow.propagate_error
def _(x, *, result, amount):
    return x.rms


@node()
def power(x, *, factor: float = 1.0):
    return x * factor


@power.propagate_error
def _(x, *, result, factor):
    return factor * x.rms


@node()
def corner(x):
    """Keep the darkest few."""
    return x[:3]


@corner.propagate_error
def _(x, *, result):
    return x.rms * math.sqrt(x.stats.shape[0] / 3)


@node()
def mixed(x, y=None, z=()):
    return x + (0 if y is None else y) + sum(z or ())


@mixed.propagate_error
def _(x, y, z, *, result):
    return x.rms + (y.rms if y else 0) + sum(d.rms for d in z or ())


@node()
def opaque(x):
    return x.sin()


@node()
def rough(x, *, digits: int = 2):
    """A cheaper form: rounded."""
    return (x, torch.tensor(0.5 * 10.0**-digits / float(x.max())))


@rough.approximation_error
def _(result):
    return float(result[1]), float(result[1])


@node()
def reshaped(x, *, digits: int = 2):
    """A cheaper form that also tells how errors of its input pass through."""
    return (x, torch.tensor(0.5 * 10.0**-digits / float(x.max())))


reshaped.approximation_error(rough.hooks.approximation_error)


@reshaped.propagate_error
def _(x, *, result, digits):
    return ErrorBound(x.rms, peak=x.share)


@node()
def first(pair):
    return pair[0]


@first.propagate_error
def _(pair, *, result):
    return pair.share * result.max


@node()
def magnified(x, *, times: float = 1.0):
    return x + 0


@magnified.propagate_error
def _(x, *, result, times):
    return x.rms * times


def step(name, node, params=None, **wires):
    read = {i: wires.get(i) for i in node.inputs}
    values = {k: v.default for k, v in node.params.model_fields.items()} | (params or {})
    return Step(name, node, values, read, MARK, {})


def recipe(*steps, outputs="out", tolerance=1e-2, **more):
    return Recipe(
        "test", "", 7, tolerance, tuple(outputs.split()), {s.name: s for s in steps}, **more
    )


def chain(*amounts, last=None):
    steps = [step("l", light)]
    for i, amount in enumerate(amounts):
        steps.append(step(f"g{i}", glow, {"amount": amount}, x=steps[-1].name))
    return [*steps, last or step("out", power, x=steps[-1].name)]


@pytest.fixture
def store(tmp_path):
    return Store(tmp_path)


def states(result):
    return [result.done[name].state for name in result.done if name.startswith("g")]


# --- the ledger -----------------------------------------------------------------------------------


def test_what_is_left_out_upstream_leaves_less_for_what_follows(store):
    result = run(recipe(*chain(0.6, 0.6, 0.3)), store)
    assert states(result) == ["left out", "run", "left out"]
    assert (
        largest_error(result["out"], run(recipe(*chain(0.6, 0.6, 0.3), exact=True), store)["out"])
        <= 1e-2
    )


def test_branches_that_meet_add_up_and_those_that_do_not_have_each_the_whole(store):
    a = [
        step("l", light),
        step("ga", glow, {"amount": 0.6}, x="l"),
        step("gb", glow, {"amount": 0.6}, x="l"),
    ]
    apart = recipe(*a, step("o1", power, x="ga"), step("o2", power, x="gb"), outputs="o1 o2")
    assert states(run(apart, store)) == ["left out", "left out"]
    both = step("s", mixed, x="ga", y="gb")
    after = recipe(*a, both, step("gc", glow, {"amount": 0.1}, x="s"), step("out", power, x="gc"))
    assert states(run(after, store)) == ["left out", "left out", "run"]


def test_with_keep_all_nothing_is_left_out(store):
    assert states(run(recipe(*chain(0.0, 0.1), exact=True), store)) == ["run", "run"]


def test_what_changes_nothing_is_left_out_where_nothing_is_allowed():
    facts = TensorStats((2,), "float32", 0.0, 100.0, 100.0, 1, True)
    for amount in (0.0, 1e-300):
        glowing = step("g", glow, {"amount": amount}, x="l")
        ledger = ErrorBudget(recipe(step("l", light), glowing, outputs="g", tolerance=0.0))
        assert ledger.verdict(glowing, glowing.params, lambda name: facts).left_out == (amount == 0)


def test_of_the_tolerance_of_a_recipe_with_economies_half_is_theirs():
    facts = TensorStats((2,), "float32", 0.0, 100.0, 100.0, 1, True)
    glowing = step("g", glow, {"amount": 0.6}, x="l")
    plain = recipe(step("l", light), glowing)
    thrifty = replace(plain, substitutions=(Substitution("a", "b", 1e-3, ""),))
    assert ErrorBudget(plain).verdict(glowing, glowing.params, lambda name: facts).left_out
    assert not ErrorBudget(thrifty).verdict(glowing, glowing.params, lambda name: facts).left_out


def test_a_long_chain_shares_one_account():
    steps = chain(0.1, *[50.0] * 2000)
    ledger = ErrorBudget(recipe(*steps))
    facts = TensorStats((2,), "float32", 0.0, 100.0, 100.0, 1, True)
    for each in steps[1:-1]:
        ledger.verdict(each, each.params, lambda name: facts)
    assert len({id(spent) for spent in ledger._spent.values()}) == 1


# --- the proof ------------------------------------------------------------------------------------


def test_an_exact_run_proves_nothing_and_asks_for_nothing(store):
    result = run(recipe(*chain(), exact=True), store)
    assert result.proof.shares == {}
    assert result.proof.worst == 0.0
    assert result.proof.of("out") == 0.0


def test_the_bound_holds_and_is_carried(store):
    steps = chain(0.5, 0.2, last=step("out", power, {"factor": 3.0}, x="g1"))
    result, full = run(recipe(*steps), store), run(recipe(*steps, exact=True), store)
    measured = largest_error(result["out"], full["out"])
    assert 0 < measured <= result.proof.of("out") <= 1.1 * measured


@pytest.mark.parametrize("amount", [1.0, 50.0, 75.0])
def test_the_bound_is_a_share_of_what_is_left_and_not_of_what_was_left_out(store, amount):
    """A share of the full result is a greater share of the result without: 75 of 175, and 75 of
    100.
    """
    steps = chain(amount)
    result = run(recipe(*steps, tolerance=0.8), store)
    full = run(recipe(*steps, exact=True), store)["out"]
    assert states(result) == ["left out"]
    off = float((full - result["out"]).square().mean().sqrt() / result["out"].max())
    assert result.proof.of("out") == pytest.approx(off, rel=1e-6)


def test_where_the_bound_grows_on_the_way_less_is_left_out(store):
    """What was 0.5 % of all the light is 25 % of what the window keeps."""
    steps = chain(0.5, last=step("out", corner, x="g0"))
    result = run(recipe(*steps), store)
    assert states(result) == ["run"]
    assert result.recipe.tolerance_scale < 1
    assert torch.equal(result["out"], run(recipe(*steps, exact=True), store)["out"])
    again = run(recipe(*steps), store)
    assert states(again) != ["left out"]
    assert torch.equal(again["out"], result["out"])


def test_behind_a_node_that_does_not_tell_its_inputs_are_held(store):
    steps = [*chain(0.05), step("end", opaque, x="out")]
    result = run(recipe(*steps, outputs="end"), store)
    assert states(result) == ["left out"]
    assert result.proof.of("end") is None
    assert list(result.proof.held) == ["out"]
    assert 0 < result.proof.worst <= 1e-3


def test_what_the_proof_made_and_the_rest_needs_is_not_made_again(store, monkeypatch):
    """Nothing can be read from the store; what the rest takes is held from before the proof."""
    monkeypatch.setattr(Store, "put", lambda self, key, value, about: False)
    steps = [step("l", light), step("r", rough, {"digits": 3}, x="l"), step("f", first, pair="r")]
    steps += [step("end", opaque, x="f"), step("out", mixed, x="end", y="l")]
    events = []
    result = run(recipe(*steps), store, watch=events.append)
    assert list(result.proof.held) == ["f"]
    assert [e.step for e in events if e.done is None] == ["l", "r", "f", "end", "out"]


def test_where_nothing_is_allowed_a_cheaper_form_is_over(store):
    steps = [step("l", light), step("r", rough, {"digits": 0}, x="l"), step("out", first, pair="r")]
    result = run(replace(recipe(*steps), tolerance=0.0), store)
    assert result.recipe.exact
    assert result.proof.over(result.recipe) == math.inf


def test_behind_a_node_that_does_not_tell_a_large_tolerance_is_not_spent(store):
    steps = [*chain(0.5), step("end", opaque, x="out")]  # 5e-3, and 1e-2 is allowed
    assert states(run(recipe(*steps, outputs="end"), store)) == ["run"]
    assert states(run(recipe(*steps, outputs="out"), store)) == ["left out"]


def test_a_cheaper_form_tells_its_own_error(store):
    steps = [step("l", light), step("r", rough, {"digits": 0}, x="l"), step("out", first, pair="r")]
    result = run(recipe(*steps), store)
    assert result.done["r"].error == pytest.approx((0.005, 0.005))
    assert result.proof.of("out") == pytest.approx(0.005, rel=0.01)
    again = run(recipe(*steps), Store(store.root))
    assert again.done["out"].state == "cached"
    assert again.proof.of("out") == pytest.approx(0.005, rel=0.01)


def test_an_approximation_does_not_count_what_was_left_out_before(store):
    """The cheaper form knows of its own error alone: 0.005 of 0.01 were stated where 0.5 of 100
    were left out too.
    """
    steps = chain(0.5, last=step("r", rough, {"digits": 1}, x="g0"))
    steps.append(step("out", first, pair="r"))
    result = run(recipe(*steps), store)
    assert states(result) == ["left out"]
    assert result.proof.of("out") is None
    assert result.proof.kind_of("out") == "unknown"
    assert list(result.proof.held) == ["g0"]


def test_an_approximation_that_carries_errors_adds_its_own(store):
    steps = chain(0.5, last=step("r", reshaped, {"digits": 1}, x="g0"))
    steps.append(step("out", first, pair="r"))
    result, full = run(recipe(*steps), store), run(recipe(*steps, exact=True), store)
    assert states(result) == ["left out"]
    assert largest_error(result["out"], full["out"]) <= result.proof.of("out")
    assert result.proof.of("out") == pytest.approx(0.5 / 100 + 0.05 / 100, rel=0.01)
    assert result.proof.kind_of("out") == "proved"


def test_a_bound_of_all_of_the_light_is_no_bound():
    """A share of 1 or more of the full result gives no bound of its size, and a result of 0 has
    no share.
    """
    facts = {"l": TensorStats((4,), "float32", 0.0, 0.0, 0.0, 0, True)}
    facts |= {name: facts["l"] for name in ("g0", "out")}
    steps = chain(0.5)
    for share, top in ((1.0, 100.0), (2.0, 100.0), (0.5, 0.0)):
        facts["g0"] = replace(facts["g0"], max=top)
        records = {each.name: StepRecord(each.name, "run", "", 0.0, "") for each in steps}
        records["g0"] = StepRecord("g0", "left out", "", 0.0, "", bound=share)
        found = proof(
            recipe(*steps), [each.name for each in steps], ["out"], records.__getitem__, facts.get
        )
        assert found.of("out") is None


@node()
def grain(x, *, size: float = 1.0, rng):
    return x + size * torch.randn(x.shape, generator=rng)


@grain.skip_bound
def _(x, *, size):
    return size / (x.max + size)


@grain.skip_draw
def _(x, *, size):
    return 1.5


@node()
def mixer(x):
    return x - x.flip(0)


@mixer.propagate_error
def _(x, *, result):
    return x.rms


@mixer.propagate_scattered
def _(x, *, result):
    return 4.0 * x.rms


mixer.hooks.estimated = True


def test_noise_passes_as_noise_and_light_as_light(store):
    light_only = [*chain(0.5, last=step("out", mixer, x="g0"))]
    noise_only = [
        step("l", light),
        step("n", grain, {"size": 0.2}, x="l"),
        step("out", mixer, x="n"),
    ]
    found = run(recipe(*light_only), store).proof
    assert found.shares["out"] * 100 == pytest.approx(0.5, rel=0.01)
    noisy = run(recipe(*noise_only), store).proof
    assert noisy.shares["out"] * 100 == pytest.approx(4 * 0.2, rel=0.01)
    assert noisy.stated["out"] == pytest.approx(1.5 * noisy.held["out"], rel=1e-9)
    assert (noisy.kind_of("n"), noisy.kind_of("out")) == ("proved", "estimated")
    assert noisy.worst_stated(["l", "out"]) == noisy.stated["out"]


@node()
def counted(x):
    return x.round()


@counted.propagate_error
def _(x, *, result):
    return x.rms


@counted.rounding_error
def _(rms, *, result):
    return math.hypot(rms, 0.3)


def test_rounding_is_noise_that_is_estimated(store):
    steps = chain(0.4, last=step("c", counted, x="g0"))
    result = run(recipe(*steps, step("out", mixer, x="c"), outputs="c out"), store)
    assert result.proof.held["c"] * 100 == pytest.approx(0.4, rel=0.01)
    assert result.proof.stated["c"] * 100 == pytest.approx(0.4 + 0.3, rel=0.01)
    assert result.proof.stated["out"] * 100 == pytest.approx(0.4 + 4 * 0.3, rel=0.01)
    assert (result.proof.kind_of("g0"), result.proof.kind_of("c")) == ("proved", "estimated")


@node()
def guess(x, *, amount: float = 0.5):
    return x + amount


@guess.skip_bound
def _(x, *, amount):
    return amount / (x.max + amount)


@guess.propagate_error
def _(x, *, result, amount):
    return x.rms


guess.hooks.skip_estimated = True


def test_what_is_omitted_by_an_estimate_is_estimated_and_may_be_forbidden(store):
    steps = [step("l", light), step("g", guess, x="l"), step("out", power, x="g")]
    found = run(recipe(*steps), store)
    assert states(found) == ["left out"]
    assert found.proof.kind_of("out") == "estimated"
    assert states(run(recipe(*steps, estimates=False), store)) == ["run"]
    nothing = [
        step("l", light),
        step("g", guess, {"amount": 0.0}, x="l"),
        step("out", power, x="g"),
    ]
    none = run(recipe(*nothing, estimates=False), store)
    assert states(none) == ["left out"]
    assert none.proof.kind_of("out") == "exact"


def test_nothing_is_left_out_in_the_end_where_no_share_is_small_enough(store):
    steps = [
        step("l", light),
        step("r", rough, {"digits": -1}, x="l"),
        step("out", first, pair="r"),
    ]
    result = run(recipe(*steps), store)
    assert result.recipe.exact
    assert result.done["r"].error[0] > 1e-2


NONE = [(0.0, None, 0.0), (1.0, None, math.inf), (1.0, (0.0, 0.0), math.inf)]


@pytest.mark.parametrize(("bound", "facts", "share"), NONE)
def test_a_share_of_nothing_is_infinite(bound, facts, share):
    known = facts and TensorStats((1,), "float32", *facts, 0.0, 0, True)
    assert ErrorBound(bound, known).share == share


def test_lists_and_absent_inputs_are_told_apart(store):
    a = [
        step("l", light),
        step("ga", glow, {"amount": 0.2}, x="l"),
        step("gb", glow, {"amount": 0.1}, x="l"),
    ]
    result = run(
        recipe(*a, Step("out", mixed, {}, {"x": "l", "y": None, "z": ("ga", "gb")}, MARK, {})),
        store,
    )
    assert result.proof.of("out") == pytest.approx(0.3 / 300, rel=0.02)
    unknown = proof(
        result.recipe, list(result.done), ["out"], result.done.__getitem__, lambda name: None
    )
    assert unknown.worst == 0.0


@pytest.mark.parametrize(("times", "attempts"), [(1e4, 2), (10.0, 3)])
def test_a_second_attempt_is_made_only_where_smaller_limits_can_help(
    store, monkeypatch, times, attempts
):
    """Rounding leaves 1.4e-6 of an error: 1e4 times this is above the tolerance of 1e-2,
    whatever the limits are.
    """
    made, execution = [], runner.Execution

    def counted(*args, **named):
        made.append(args[0])
        return execution(*args, **named)

    monkeypatch.setattr(runner, "Execution", counted)
    steps = [step("l", light), step("r", rough, {"digits": 0}, x="l"), step("f", first, pair="r")]
    steps += [step("out", magnified, {"times": times}, x="f")]
    result = run(recipe(*steps), store)
    assert result.recipe.exact
    assert len(made) == attempts
    assert torch.equal(result["out"], run(recipe(*steps, exact=True), store)["out"])
