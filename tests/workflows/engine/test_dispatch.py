"""Work is handed out when its inputs are ready, to the lane it was meant for or an idle one of
its kind.
"""

import pytest

from neusee.nodes import node
from neusee.workflows.engine.dispatch import Loop, chains_of
from neusee.workflows.engine.step_job import Lane, Outcome, StepJob
from neusee.workflows.graph.errors import Location
from neusee.workflows.graph.recipe_graph import Step


@node()
def any_step(x=None):
    return x


def work(key, *sources, lane="a", wanted=False):
    step = Step(key, any_step, {}, {}, Location("t.yaml", 1, 1), {})
    return StepJob(step, key, {}, (tuple(sources),), 0, "t", "cpu", lane, wanted)


class Fake:
    """An executor that writes down what it is given and ends it in the order that ``rank`` says."""

    shares = True

    def __init__(self, lanes, rank=None, held=()):
        self.lanes = {name: Lane(device, 1e9) for name, device in lanes.items()}
        self.rank, self.held = rank or (lambda key: key), list(held)
        self.running, self.given, self.most = [], [], 0

    def submit(self, chain):
        self.running.append(tuple(chain))
        self.given.append((chain[0].lane, "".join(w.key for w in chain)))
        self.most = max(self.most, len(self.running))

    def wait(self, seconds=None):
        if not self.running:
            return []
        chain = min(self.running, key=lambda c: self.rank(c[0].key))
        self.running.remove(chain)
        if chain[0].key in self.held:
            self.held.remove(chain[0].key)
            return [Outcome(chain[0], held=True)]
        return [Outcome(w, value=1) for w in chain]

    def cancel(self):
        self.running = []


def ran(works, executor, fused=False, room=lambda work, running: True):
    loop = Loop(chains_of(works, fused), executor, lambda w: w, room)
    return [o.work.key for o in loop.outcomes()]


DIAMOND = [work("a"), work("b", "a"), work("c", "a"), work("d", "b", "c")]


def test_one_lane_goes_in_the_order_of_the_plan():
    assert ran(DIAMOND, Fake({"a": "cpu"})) == ["a", "b", "c", "d"]


def test_branches_run_side_by_side_where_there_are_two_lanes():
    executor = Fake({"a": "cpu", "b": "cpu"})
    assert ran(DIAMOND, executor) == ["a", "b", "c", "d"]
    assert executor.most == 2


def test_an_idle_lane_of_another_kind_takes_nothing_that_was_not_meant_for_it():
    executor = Fake({"a": "cpu", "g": "cuda:0"})
    ran(DIAMOND, executor)
    assert executor.most == 1
    assert {lane for lane, _ in executor.given} == {"a"}


def test_no_second_step_begins_without_room():
    executor = Fake({"a": "cpu", "b": "cpu"})
    ran(DIAMOND, executor, room=lambda work, running: False)
    assert executor.most == 1


@pytest.mark.parametrize("lanes", [{"a": "cpu"}, {"a": "cpu", "b": "cpu"}])
def test_what_another_process_holds_is_looked_at_again_while_the_rest_goes_on(lanes):
    executor = Fake(lanes, held=["b", "b"])
    keys = ran(DIAMOND, executor)
    assert sorted(keys) == ["a", "b", "c", "d"]
    assert keys.index("c") < keys.index("b") < keys.index("d")
    assert [chain for _, chain in executor.given].count("b") == 3


def test_steps_that_only_feed_one_another_are_one_chain():
    works = [work("a"), work("b", "a"), work("c", "b"), work("d", "a"), work("e", "c", "d")]
    assert [[w.key for w in chain] for chain in chains_of(works, True)] == [
        ["a"],
        ["b", "c"],
        ["d"],
        ["e"],
    ]
    assert ran(works, Fake({"a": "cpu"}), True) == ["a", "b", "c", "d", "e"]


def test_a_result_that_is_asked_for_ends_its_chain():
    works = [work("a", wanted=True), work("b", "a")]
    assert [[w.key for w in chain] for chain in chains_of(works, True)] == [["a"], ["b"]]


def test_a_chain_whose_middle_is_held_goes_on_from_there():
    executor = Fake({"a": "cpu"})
    works = [work("a"), work("b", "a"), work("c", "b")]
    waits = executor.wait
    first = [True]

    def wait(seconds=None):
        done = waits(seconds)
        if first and done:
            first.clear()
            return [done[0], Outcome(done[1].work, held=True)]
        return done

    executor.wait = wait
    assert ran(works, executor, True) == ["a", "b", "c"]
    assert [chain for _, chain in executor.given] == ["abc", "bc"]


def test_ten_thousand_steps_need_no_recursion():
    works = [work("0")] + [work(str(i), str(i - 1)) for i in range(1, 10_000)]
    assert len(ran(works, Fake({"a": "cpu"}))) == 10_000
    assert len(chains_of(works, True)) == 1


def test_work_of_a_lane_that_is_gone_goes_to_another_of_its_kind():
    works = [work("a", lane="dead"), work("b", "a", lane="dead")]
    executor = Fake({"a": "cpu"})
    assert ran(works, executor) == ["a", "b"]
    assert {lane for lane, _ in executor.given} == {"a"}


def test_work_that_no_lane_can_take_is_an_error_and_no_wait_for_ever():
    with pytest.raises(RuntimeError, match="no device or worker is left to compute a"):
        ran([work("a", lane="dead")], Fake({"g": "cuda:0"}))
