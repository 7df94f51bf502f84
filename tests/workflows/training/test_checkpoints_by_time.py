"""A training that is killed at any moment loses two minutes, or one iteration that takes longer."""

import types

import numpy as np
import pytest
import torch

from neusee.workflows import Store, load
from neusee.workflows.recipe.blocks.train_block import LiftTraining
from neusee.workflows.training import resumable_loop
from neusee.workflows.training.resumable_loop import ResumableLoop, TrainingSession
from neusee.workflows.training.run_training import train

MINUTES_LOST = 2.0
NEVER = 10**6  #: iterations between checkpoints: none is due by number


class Clock:
    """A clock that only the test moves."""

    def __init__(self):
        self.now = 0.0

    def monotonic(self):
        return self.now

    perf_counter = monotonic


@pytest.fixture
def clock(monkeypatch):
    stopped_clock = Clock()
    monkeypatch.setattr(
        resumable_loop,
        "time",
        types.SimpleNamespace(
            monotonic=stopped_clock.monotonic, perf_counter=stopped_clock.perf_counter
        ),
    )
    return stopped_clock


class Counter:
    """A learner whose state is a sum, and whose iterations take the given seconds."""

    def __init__(self):
        self.sum = torch.nn.Parameter(torch.zeros(()))

    def parts(self):
        return {"sum": torch.nn.ParameterList([self.sum])}


class CountingLoop(ResumableLoop):
    def __init__(self, folder, clock, durations, long_iterations=()):
        settings = LiftTraining(iterations=NEVER, keep=NEVER, show=NEVER)
        session = TrainingSession(Store(folder / "store"), folder, lambda line: None)
        super().__init__(folder, settings, Counter(), ["iteration", "seconds"], session)
        self.fake_clock, self.durations = clock, durations
        self.long_iterations, self.kept_at, self.lost = long_iterations, [clock.now], []
        self.resume()

    @property
    def validates_next(self):
        return self.iteration in self.long_iterations

    def iterate(self):
        self.fake_clock.now += self.durations[self.iteration]
        # what a kill at the very end of this iteration would lose
        self.lost.append(self.fake_clock.now - self.kept_at[-1])
        with torch.no_grad():
            self.learner.sum += self.iteration
        return {}

    def show(self):
        pass

    def keep(self):
        super().keep()
        self.kept_at.append(self.fake_clock.now)


def run_whole(folder, clock, durations, long_iterations=()):
    folder.mkdir(exist_ok=True)
    loop = CountingLoop(folder, clock, durations, long_iterations)
    loop.run(len(durations), 1)
    return loop


@pytest.mark.parametrize(
    "durations",
    [
        pytest.param([0.5] * 2000, id="short"),
        pytest.param([59.0] * 20, id="just below a minute"),
        pytest.param([70.0] * 20, id="above a minute"),
        pytest.param([125.0] * 20, id="above two minutes"),
        pytest.param(list(np.random.default_rng(1).uniform(0, 60, 200)), id="mixed"),
    ],
)
def test_a_kill_loses_two_minutes_or_one_iteration(tmp_path, clock, durations):
    loop = run_whole(tmp_path, clock, durations)
    limits = [max(60 * MINUTES_LOST, duration) for duration in durations]
    assert all(lost <= limit for lost, limit in zip(loop.lost, limits, strict=True))
    # and no more checkpoints than this needs: one a minute, or one an iteration that is longer
    assert len(loop.kept_at) - 1 <= min(len(durations), sum(durations) / 60) + 1


def test_a_long_validation_loses_no_more_than_itself(tmp_path, clock):
    durations = [0.5] * 50 + [600.0] + [0.5] * 50
    loop = run_whole(tmp_path, clock, durations, long_iterations=(50,))
    assert max(loop.lost) == 600.0
    # the validation is not lost afterwards
    assert max(loop.lost[51:]) <= 60 * MINUTES_LOST


def test_a_training_that_goes_on_counts_from_its_start(tmp_path, clock):
    durations = [50.0] * 12
    whole = run_whole(tmp_path / "whole", clock, durations)
    (tmp_path / "killed").mkdir()
    killed = CountingLoop(tmp_path / "killed", clock, durations)
    killed.run(7, 1)  # ends without a last checkpoint, as a killed one does
    clock.now += 10_000
    again = CountingLoop(tmp_path / "killed", clock, durations)
    assert 7 - again.iteration <= 2
    again.run(len(durations), 1)
    assert again.learner.sum.item() == whole.learner.sum.item()
    assert [row["iteration"] for row in again.rows.rows] == [str(i) for i in range(12)]
    assert max(again.lost) <= 60 * MINUTES_LOST


TINY = [
    "optics.samples=64", "optics.pitch=126.2 um", "optics.bands=5", "optics.window=[48, 48]", "scene.shape=[48, 48]",
    "sensor.shape=[32, 32]", "doe.grid=32", "train.network.kind=unet", "train.network.width=4", "train.critics.width=4",
    "train.stages.1.iterations=4", "train.stages.2.iterations=4", f"train.keep={NEVER}",
]  # fmt: skip


@pytest.mark.usefixtures("one_thread")
@pytest.mark.parametrize("moment", [(1, 3), (2, 3)])
def test_the_weights_are_the_same_bits_after_a_kill(tmp_path, clock, moment):
    lines = []

    def trained(folder, watch=None):
        session = TrainingSession(
            Store(tmp_path / "store"), tmp_path / folder, lines.append, watch=watch
        )
        return train(load("train_small", TINY), session)

    def a_minute_an_iteration(stage, done, losses):
        clock.now += 61

    def until_the_kill(stage, done, losses):
        a_minute_an_iteration(stage, done, losses)
        if (stage, done) == moment:
            raise KeyboardInterrupt

    whole = trained("whole", a_minute_an_iteration)
    with pytest.raises(KeyboardInterrupt):
        trained("killed", until_the_kill)
    again = trained("killed", a_minute_an_iteration)
    assert f"continues in stage {moment[0]} after {moment[1] - 1} iterations" in lines
    for name in ("mask.safetensors", "network.safetensors"):
        assert (again / name).read_bytes() == (whole / name).read_bytes(), name
