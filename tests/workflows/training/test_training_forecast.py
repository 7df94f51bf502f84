"""What a training is expected to take, before and after its first iterations."""

import pytest

from neusee.workflows import Store, load
from neusee.workflows.engine import cost_model
from neusee.workflows.training import training_forecast as forecasts
from neusee.workflows.training.training_forecast import IterationTimes, forecast_training

STAGES = ["train.stages.1.iterations=30", "train.stages.2.iterations=50"]


def test_a_training_is_forecast_with_both_stages_and_is_a_guess_before_an_iteration(tmp_path):
    recipe = load("train_small", STAGES)
    found = forecast_training(recipe, Store(tmp_path))
    assert [stage["iterations"] for stage in found.steps] == [30, 50]
    assert found.totals["iterations"] == 80
    assert found.totals["guess"]
    assert "a guess: from laws of the camera's steps and of the network" in " ".join(found.lines)
    seconds, memory = found.totals["seconds"], found.totals["memory"]
    assert 0 < seconds["least"] < seconds["expected"] < seconds["most"]
    # gradients and two moments of Adam
    assert memory["gradients_and_optimiser"] <= 3 * memory["parameters"]
    assert memory["activations"] > 2 * 64 * 64 * 12
    assert all(len(line) <= 80 for line in found.lines)


def test_measured_iterations_replace_the_guess_for_as_many_iterations_as_there_are(tmp_path):
    store, recipe = Store(tmp_path), load("train_small", STAGES)
    times = IterationTimes(recipe, recipe.training, store)
    for i in range(9):
        times.add(1, i, 2.0 + i / 10)
        times.add(2, i, 0.5)
    times.keep()
    found = forecast_training(load("train_small", STAGES), Store(tmp_path))
    assert not found.totals["guess"]
    assert found.totals["seconds"]["expected"] == pytest.approx(30 * 2.4 + 50 * 0.5)
    # another size of the network is another iteration
    wider = load("train_small", [*STAGES, "train.network.width=24"])
    assert forecast_training(wider, Store(tmp_path)).totals["guess"]


def test_times_of_another_processor_are_not_those_of_here(tmp_path, monkeypatch):
    store, recipe = Store(tmp_path), load("train_small", STAGES)
    there = cost_model.processor()._replace(name="another processor")
    with monkeypatch.context() as elsewhere:
        elsewhere.setattr(forecasts, "processor", lambda: there)
        times = IterationTimes(recipe, recipe.training, store)
        times.add(1, 0, 1e4)
        times.keep()
    found = forecast_training(recipe, Store(tmp_path))
    assert found.totals["guess"]
    assert found.totals["seconds"]["expected"] < 1e4


def test_a_pool_is_simulated_once(tmp_path):
    recipe = load("train_unrolled", ["train.stages.2.iterations=1000"])
    settings = recipe.training
    assert forecasts.simulates(settings, 2, settings.pool // 2 - 1)
    assert not forecasts.simulates(settings, 2, settings.pool // 2)


def test_the_training_of_a_lift_has_a_forecast(tmp_path):
    found = forecast_training(load("train_lift", ["train_lift.iterations=70"]), Store(tmp_path))
    assert found.totals["iterations"] == 70
    assert found.totals["guess"]
