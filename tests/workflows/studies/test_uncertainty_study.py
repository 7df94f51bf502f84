"""The study of uncertainty: draws are runs, deviations are those of closed forms, and what was
stopped goes on.
"""

import json
import math

import numpy as np
import pytest
import torch
from hypothesis import given, settings
from hypothesis import strategies as st
from scipy import stats
from typer.testing import CliRunner

from neusee.workflows import load
from neusee.workflows.cli.app import app
from neusee.workflows.engine.node_call import call
from neusee.workflows.engine.runner import run
from neusee.workflows.graph.errors import RecipeError
from neusee.workflows.graph.recipe_graph import needed
from neusee.workflows.recipe.loading import recipe_at
from neusee.workflows.recipe.uncertain_inputs import SCRAMBLES, Inputs
from neusee.workflows.simulation.simulate_recipe import simulate
from neusee.workflows.store.result_store import Store
from neusee.workflows.studies.output_draws import (
    AllowedDraws,
    OutputDraws,
    quantities,
    refuse_combinations,
    scatter,
)
from neusee.workflows.studies.reused_choices import serves
from neusee.workflows.studies.run_study import StudyRefused, count_failures, study_recipe
from neusee.workflows.tolerance.cheaper_steps import with_substitutions

SMALL = ["optics.samples=96", "optics.pitch=84.15 um", "optics.bands=7", "optics.window=[24, 24]"]
SMALL += ["scene.shape=[32, 32]", "sensor.shape=[24, 24]", "lasers.green.strength=1e6"]
LAWS = ["sensor.read_noise=normal(10.5 e-, 0.5 e-)", "sensor.gain=lognormal(0.37 e-/DN, 1.02)"]
#: which moves the dark noise of a curve and nothing of an LSR
NOISE = ["outputs=[transfer, lsr]", *SMALL, LAWS[0]]


@pytest.fixture(scope="module")
def store(tmp_path_factory):
    """What no draw reaches is computed once."""
    return Store(tmp_path_factory.mktemp("uncertainty"))


def small(outputs, *more):
    return load("first_light", [f"outputs=[{outputs}]", *SMALL, *more])


# --- inputs ---------------------------------------------------------------------------------------


def test_what_a_draw_changes_is_what_a_recipe_with_its_values_says():
    inputs = Inputs.of(
        small("raw, restored_quality", *LAWS, "lasers.green.angle.0=normal(0.1 deg, 0.01 deg)")
    )
    assert set(inputs.names) == {"sensor.read_noise", "sensor.gain", "lasers.green.angle.0"}
    for row in inputs.independent(5, 1).values:
        values = dict(zip(inputs.names, map(float, row), strict=True))
        said = recipe_at(inputs.uncertain, values)
        for reader, value in inputs.theta(values).items():
            step, _, param = reader.rpartition(".")
            assert value == said.steps[step].params[param], reader
        changed = set()
        for step in needed(said, said.outputs):
            before = inputs.recipe.steps[step].params
            changed |= {
                f"{step}.{p}" for p, value in said.steps[step].params.items() if value != before[p]
            }
        assert changed == set(inputs.readers)


def test_what_reaches_no_output_is_not_drawn():
    inputs = Inputs.of(small("lsr, saturated", *LAWS, "mask.wrap_at=normal(500 nm, 1 nm)"))
    assert "sensor.gain" in inputs.names
    with pytest.raises(ValueError, match=r"no output depends on sensor\.read_noise"):
        Inputs.of(small("lsr", LAWS[0]))


def test_a_recipe_that_is_sure_of_all_has_nothing_to_draw():
    with pytest.raises(ValueError, match="no value is uncertain: write a distribution"):
        Inputs.of(small("raw"))


def test_a_law_beyond_a_limit_is_refused_before_anything_runs(tmp_path):
    """The share is that of the normal law, and the refusal names the law to write."""
    recipe = small("transfer", "sensor.read_noise=normal(1 e-, 1 e-)")
    told = (
        r"argument 9 +sensor\.read_noise = normal\(1 e-, 1 e-\) +15\.87% of this distribution lies"
        r" outside the allowed "
        r"values \(must be greater than or equal to 0\): write truncated\(normal\(1 e-, 1 e-\), 0"
        r" e-, inf\)"
    )
    with pytest.raises(RecipeError, match=told):
        study_recipe("uncertainty", recipe, Store(tmp_path / "store"), tmp_path / "runs")
    assert not (tmp_path / "runs").exists()
    Inputs.of(small("transfer", "sensor.read_noise=truncated(normal(1 e-, 1 e-), 0 e-, inf)"))


def test_a_value_that_is_no_number_cannot_be_drawn():
    with pytest.raises(ValueError, match=r"optics\.samples|whole number"):
        Inputs.of(small("lsr", "optics.samples=uniform(90, 100)"))


@given(st.integers(0, 2**31), st.integers(3, 6))
@settings(max_examples=10, deadline=None)
def test_more_draws_begin_with_the_same(seed, power):
    inputs = Inputs.of(_CHEAP)
    few, many = inputs.independent(20, seed), inputs.independent(50, seed)
    assert (few.values == many.values[:20]).all()
    some = SCRAMBLES * 2**power
    assert (inputs.sobol(some, seed).values == inputs.sobol(2 * some, seed).values[:some]).all()


def test_points_of_sobol_are_even():
    """Means of 2**7 points in each of 8 sequences are far closer to the law's than those of
    draws.
    """
    inputs = Inputs.of(_CHEAP)
    z = inputs.sobol(1024, 1).z
    assert np.abs(z.mean(0)).max() < 2e-3
    assert z.std(0) == pytest.approx(1.0, abs=5e-3)
    for n in range(SCRAMBLES):
        each = z[n::SCRAMBLES]
        assert ((each > 0).sum(0) == len(each) // 2).all()


_CHEAP = load("first_light", NOISE)


def test_joint_draws_are_taken_whole(tmp_path):
    rng = np.random.default_rng(1)
    draws = {
        "gain [e-/DN]": 0.37 + 0.01 * rng.standard_normal(200),
        "read_noise": 10 + rng.standard_normal(200),
    }
    np.savez(tmp_path / "draws.npz", **draws)
    inputs = Inputs.of(
        small(
            "transfer", f"posterior={tmp_path / 'draws.npz'}", "sensor.offset=normal(390 e-, 1 e-)"
        )
    )
    assert inputs.most_draws == 200
    found = inputs.independent(200, 3).values[:, 1:]
    rows = np.stack([1 / draws["gain [e-/DN]"], draws["read_noise"]], 1)
    assert (found[np.argsort(found[:, 0])] == rows[np.argsort(rows[:, 0])]).all()


# --- draws ----------------------------------------------------------------------------------------


def test_a_draw_is_a_run_with_its_values_to_the_last_bit(store):
    recipe = small("raw, saturated, developed_quality, transfer", *LAWS)
    inputs = Inputs.of(recipe)
    draws = OutputDraws(inputs, store)
    row = inputs.independent(3, 1).values[2]
    found = draws.numbers(row[None])[0]
    said = recipe_at(inputs.uncertain, dict(zip(inputs.names, map(float, row), strict=True)))
    assert found == quantities(run(said, store).values)
    assert found["saturated[mask].pixels"][0] > 0


@pytest.mark.slow
def test_draws_at_once_are_those_one_after_another(store, tmp_path):
    inputs = Inputs.of(
        small(
            "developed_quality, transfer, lsr", *LAWS, "optics.defocus=normal(0.3 waves, 0.1 waves)"
        )
    )
    values = inputs.independent(6, 1).values
    one = OutputDraws(inputs, Store(tmp_path / "one"), workers=1).numbers(values)
    assert OutputDraws(inputs, Store(tmp_path / "many"), workers=3).numbers(values) == one


def test_a_key_hangs_on_all_that_decides_a_draw(tmp_path):
    recipe = small("transfer", *LAWS)
    inputs = Inputs.of(recipe)
    row = inputs.independent(1, 1).values[0]
    keys = {
        OutputDraws(inputs, Store(tmp_path)).key(row),
        OutputDraws(inputs, Store(tmp_path)).key(row * (1 + 1e-15)),
    }
    for other in (small("transfer", *LAWS, "sensor.bits=12"), small("transfer", *LAWS, "seed=8")):
        keys.add(OutputDraws(Inputs.of(other), Store(tmp_path)).key(row))
    assert len(keys) == 4


@pytest.mark.slow
def test_pictures_have_the_mean_and_deviation_of_all_draws(store):
    inputs = Inputs.of(small("raw", *LAWS))
    values = inputs.independent(5, 1).values
    mean, sd = OutputDraws(inputs, store).pictures(values)["raw[mask]"]
    names = inputs.names
    each = [
        run(recipe_at(inputs.uncertain, dict(zip(names, map(float, v), strict=True))), store)[
            "raw[mask]"
        ]
        for v in values
    ]
    whole = torch.stack(each).double()
    assert torch.allclose(mean.double(), whole.mean(0), rtol=1e-5)
    assert torch.allclose(sd.double(), whole.std(0), rtol=1e-4, atol=1e-2)


# --- statistics -----------------------------------------------------------------------------------


@pytest.mark.parametrize(
    ("law", "kurtosis"), [("normal", 3.0), ("uniform", 1.8), ("exponential", 9.0)]
)
def test_the_error_of_a_deviation_is_that_of_the_closed_form(law, kurtosis):
    """sqrt((kurtosis - 1) / 4n), and what repetitions show."""
    rng = np.random.default_rng(1)
    draws = getattr(rng, law)(size=(400, 2000))
    shown = draws.std(0, ddof=1)
    said = np.array([scatter(x[:, None]).error for x in draws.T[:300]])
    assert np.median(said) == pytest.approx(math.sqrt((kurtosis - 1) / 1600), rel=0.15)
    assert np.median(said) == pytest.approx(shown.std() / shown.mean(), rel=0.15)


@pytest.mark.parametrize("count", [3, 5, 64])
def test_the_error_of_a_deviation_is_that_of_leaving_out_one_draw_after_another(count):
    """Efron's jackknife, each deviation worked out anew."""
    x = np.random.default_rng(2).exponential(size=count)
    each = np.array([np.delete(x, i).std(ddof=1) for i in range(count)])
    wanted = math.sqrt((count - 1) / count * ((each - each.mean()) ** 2).sum()) / x.std(ddof=1)
    assert scatter(x[:, None]).error == pytest.approx(wanted, rel=1e-9)


def test_the_error_of_sequences_is_what_repetitions_show():
    inputs = Inputs.of(small("transfer", *LAWS))
    deviations, said = [], []
    for seed in range(60):
        z = inputs.sobol(256, seed).z
        y = (np.exp(0.4 * z[:, 0]) + 0.2 * z[:, 1])[:, None]
        deviations.append(float(y.std(ddof=1)))
        said.append(scatter(y, SCRAMBLES).error)
    shown = np.std(deviations) / np.mean(deviations)
    assert np.sqrt(np.mean(np.square(said))) == pytest.approx(shown, rel=0.35)
    plain = [
        float(np.exp(0.4 * np.random.default_rng(s).standard_normal(256)).std()) for s in range(60)
    ]
    assert shown < 0.6 * np.std(plain) / np.mean(plain)


def test_what_does_not_vary_has_no_deviation_and_no_error():
    found = scatter(np.full((100, 2), 0.1 + 0.2))
    assert found.is_constant
    assert found.error == 0.0


def test_what_is_infinite_in_a_draw_is_no_error_of_the_study():
    x = np.array([[1.0, 2.0], [math.inf, 4.0], [3.0, 6.0]])
    assert scatter(x).sd[1] == 2.0
    assert scatter(x).mean[0] == math.inf


# --- the study ------------------------------------------------------------------------------------


@pytest.mark.slow
def test_deviations_are_those_of_the_closed_form(tmp_path, store):
    """Dark noise K**2 (sigma**2 + dark) + 1/12 with sigma of 10.5 ± 0.5: variance K**4 (4 m**2
    s**2 + 2 s**4).
    """
    folder = study_recipe("uncertainty", load("first_light", NOISE), store, tmp_path, most=400)
    doc = json.loads((folder / "provenance.json").read_text())
    floor = 2  # the dark level's prediction
    found, error = (
        doc["quantities"]["transfer"]["sd"][floor],
        doc["quantities"]["transfer"]["error"],
    )
    wanted = math.sqrt(4 * 10.5**2 * 0.5**2 + 2 * 0.5**4) / 0.37**2
    assert abs(found / wanted - 1) < 3 * error
    assert error <= 0.05
    assert doc["failed"] == count_failures(folder) == 0
    assert doc["still"] == ["lsr[plain]", "lsr[mask]"]


@pytest.mark.slow
def test_points_of_sobol_find_the_same_with_fewer(tmp_path, store):
    folder = study_recipe(
        "uncertainty",
        load("first_light", NOISE),
        store,
        tmp_path,
        most=512,
        points="sobol",
        error=0.04,
    )
    doc = json.loads((folder / "provenance.json").read_text())
    wanted = math.sqrt(4 * 10.5**2 * 0.5**2 + 2 * 0.5**4) / 0.37**2
    assert doc["quantities"]["transfer"]["sd"][2] == pytest.approx(wanted, rel=0.06)
    assert doc["draws"] <= 128


@pytest.mark.slow
def test_what_was_stopped_goes_on_with_the_same(tmp_path, store, monkeypatch):
    recipe = small("developed_quality, saturated, raw", *LAWS)
    whole = study_recipe("uncertainty", recipe, Store(tmp_path / "whole"), tmp_path / "a", most=80)
    real, calls = OutputDraws._result, []

    def stops(self, row):
        calls.append(row)
        if len(calls) > 70:
            raise KeyboardInterrupt
        return real(self, row)

    monkeypatch.setattr(OutputDraws, "_result", stops)
    with pytest.raises(KeyboardInterrupt):
        study_recipe("uncertainty", recipe, Store(tmp_path / "store"), tmp_path / "b", most=80)
    monkeypatch.setattr(OutputDraws, "_result", real)
    again = study_recipe("uncertainty", recipe, Store(tmp_path / "store"), tmp_path / "b", most=80)
    one, other = (json.loads((folder / "provenance.json").read_text()) for folder in (whole, again))
    assert one["quantities"] == other["quantities"]
    assert 0 < other["computed"] < one["computed"] - 60
    last = study_recipe("uncertainty", recipe, Store(tmp_path / "store"), tmp_path / "c", most=80)
    assert json.loads((last / "provenance.json").read_text())["computed"] == 0
    with np.load(again / "pictures.npz") as a, np.load(last / "pictures.npz") as b:
        assert all((a[name] == b[name]).all() for name in a)


@pytest.mark.slow
def test_the_command_writes_a_page_and_fails_where_too_few_draws_were_allowed(
    tmp_path, store, monkeypatch
):
    monkeypatch.chdir(tmp_path)
    monkeypatch.setenv("NEUSEE_CACHE", str(store.root))
    words = [
        "developed_quality, transfer, raw, lsr",
        *SMALL,
        *LAWS,
        "optics.defocus=normal(0.3 waves, 0.1 waves)",
    ]
    words = [f"outputs=[{words[0]}]", *words[1:]]
    done = CliRunner().invoke(
        app, ["study", "uncertainty", "first_light", *words, "--most", "64", "--error", "0.02"]
    )
    assert done.exit_code == 1
    assert "1 do not hold" in done.output
    folder = tmp_path / "runs" / "latest"
    text = (folder / "report.html").read_text()
    for said in (
        "Influence of the inputs",
        "What does not vary",
        "sensor.gain",
        "is known to",
        "Photon-transfer curve",
    ):
        assert (said in text) == (said != "What does not vary"), said
    assert {p.stem for p in (folder / "figures").iterdir()} == {
        "bands",
        "numbers",
        "pictures",
        "tornado",
        "transfer",
    }
    with np.load(folder / "draws.npz") as draws:
        assert draws["sensor.gain"].shape == (64,)
        assert draws["lsr[mask]"].shape == (64, 7)
    assert (folder / "table.csv").read_text().startswith("quantity,element,at the medians")


@pytest.mark.parametrize(
    ("option", "said"),
    [
        (["--device", "gpu9"], "--device gpu9"),
        (["--points", "grid"], "grid"),
        (["--most", "3"], "64"),
    ],
)
def test_an_option_that_cannot_be_is_refused(option, said):
    done = CliRunner().invoke(app, ["study", "uncertainty", "first_light", LAWS[0], *option])
    assert done.exit_code == 2
    assert said in done.output


def test_pictures_alone_are_no_numbers(tmp_path, store):
    with pytest.raises(ValueError, match="pictures only"):
        study_recipe("uncertainty", small("raw", *LAWS), store, tmp_path)


def test_a_run_with_a_posterior_says_where_the_recipe_lies(tmp_path, store):
    said = {"mean": {"gain": "2.63 DN/e-"}, "sd": {"gain": "0.014 DN/e-"}}
    recipe = load("first_light", ["outputs=[transfer]", *SMALL], posterior=said)
    done = simulate(recipe, store, tmp_path, ["neusee"])
    (row,) = done.document["posterior"]
    assert (row["path"], row["own"], row["used"], row["far"]) == (
        "sensor.gain",
        "2.7027 DN/e-",
        "2.63 DN/e-",
        True,
    )
    text = done.page.read_text()
    assert "The sensor beside its posterior" in text
    assert "sensor.gain = 2.7027 DN/e- is far from its posterior, 2.63 ± 0.014 DN/e-" in text
    assert "gain: 2.63 DN/e-" in (done.folder / "recipe.yaml").read_text()


@pytest.mark.slow
def test_what_is_not_finite_fails_and_is_said(tmp_path, store, monkeypatch):
    real = OutputDraws.numbers

    def broken(self, values):
        found = real(self, values)
        return [{**numbers, "developed_quality[mask].psnr": [math.nan]} for numbers in found]

    monkeypatch.setattr(OutputDraws, "numbers", broken)
    folder = study_recipe(
        "uncertainty", small("developed_quality", *LAWS), store, tmp_path, most=64, error=1.0
    )
    assert count_failures(folder) == 1
    assert (
        "NaN or infinite in some draw: developed_quality[mask].psnr"
        in (folder / "report.html").read_text()
    )
    table = (folder / "table.csv").read_text()
    assert "developed_quality[mask].psnr,,nan,nan" in table


# --- what decides when to stop --------------------------------------------------------------------


@pytest.mark.slow
def test_only_what_is_named_decides_when_to_stop(store, tmp_path):
    recipe = small("peak, saturated", "lasers.green.strength=lognormal(1e3, 3)")
    whole = study_recipe("uncertainty", recipe, store, tmp_path / "a", most=96, error=0.01)
    every = json.loads((whole / "provenance.json").read_text())
    varying = [name for name, found in every["quantities"].items() if found["error"] > 0]
    least = min(varying, key=lambda name: every["quantities"][name]["error"])
    enough = every["quantities"][least]["error"] * 2
    folder = study_recipe(
        "uncertainty", recipe, store, tmp_path / "b", most=96, error=enough, until=(least,)
    )
    found = json.loads((folder / "provenance.json").read_text())
    assert found["decided by"] == [least]
    assert found["draws"] == 64
    assert found["failed"] == 0
    assert every["draws"] == 96
    assert every["failed"] == 1
    assert "others did not decide" in (folder / "report.html").read_text()


@pytest.mark.parametrize("name", ["raw", "peak.none", "pea"])
def test_a_name_that_nothing_has_is_told_with_the_names_there_are(store, tmp_path, name):
    recipe = small("peak, saturated", LAWS[0], "lasers.green.strength=normal(1e3, 10)")
    told = (
        rf"--until {name.split('.')[0]}.*: no output with numbers has this name; there are"
        r" peak\[plain\]"
    )
    with pytest.raises(ValueError, match=told):
        study_recipe("uncertainty", recipe, store, tmp_path, most=64, until=(name,))


# --- what does not vary, and values that are not allowed ------------------------------------------


def told_of(recipe, store, tmp_path, **options):
    """Return the lines of progress of a study, and its folder."""
    lines = []
    folder = study_recipe("uncertainty", recipe, store, tmp_path, progress=lines.append, **options)
    return lines, folder


def test_numbers_that_do_not_vary_are_named_before_any_draw(store, tmp_path):
    """The count of electrons above an irradiance is 0 everywhere; it was once "known to 0.0 %"."""
    recipe = small(
        "peak, lsr",
        "lasers.green.strength=lognormal(1e3, 1.1)",
        "sensor.read_noise=normal(10 e-, 1 e-)",
    )
    lines, folder = told_of(recipe, store, tmp_path, most=64, error=1.0)
    first = next(line for line in lines if "the same in the first" in line)
    assert first.startswith("peak[plain].above")
    assert lines.index(first) < lines.index(
        next(line for line in lines if "draws of about" in line)
    )
    assert "outputs that depend on no input, and do not vary: lsr[plain], lsr[mask]" in lines
    text = (folder / "report.html").read_text()
    assert "does not vary" in text
    assert ">0.0%<" not in text


def test_a_study_of_which_nothing_varies_is_refused_after_a_few_runs(store, tmp_path, monkeypatch):
    runs = []
    real = OutputDraws._result
    monkeypatch.setattr(OutputDraws, "_result", lambda self, row: runs.append(1) or real(self, row))
    recipe = small("peak", "lasers.green.strength=lognormal(1e3, 1.1)")
    with pytest.raises(
        StudyRefused, match=r"nothing varies: peak\[plain\]\.above is the same in 5 runs"
    ):
        study_recipe(
            "uncertainty", recipe, store, tmp_path, most=64, workers=1, until=("peak[plain].above",)
        )
    assert len(runs) <= 5


@pytest.mark.parametrize(
    ("words", "told"),
    [
        (
            ["sensor.read_noise=normal(2 e-, 1 e-)", "outputs=[peak,transfer]"],
            "2.28% of this distribution",
        ),
        (["sensor.quantum_efficiency=normal(0.9, 0.1)", "outputs=[peak]"], "-inf, 1)"),
        (["lsr"], "no value is uncertain"),
        (
            ["sensor.read_noise=normal(20 e-, 1 e-)", "outputs=[lsr]"],
            "no output depends on sensor.read_noise",
        ),
        (
            ["sensor.read_noise=normal(20 e-, 1 e-)", "outputs=[raw]", "--until", "pea"],
            "--until pea: no output",
        ),
    ],
)
def test_a_study_that_cannot_be_ends_with_2_before_it_runs(words, told):
    words = [word for word in words if "=" in word or word.startswith("-") or word == "pea"]
    done = CliRunner().invoke(app, ["study", "uncertainty", "first_light", *words])
    assert done.exit_code == 2, done.output
    assert told in done.output


@pytest.mark.slow
def test_a_negligible_part_outside_is_cut_off_and_told(store, tmp_path):
    """Of normal(10 e-, 3.1 e-) 6e-4 are below 0: no draw is negative, and the page says what was
    cut off.
    """
    recipe = small("transfer", "sensor.read_noise=normal(10 e-, 3.1 e-)")
    lines, folder = told_of(recipe, store, tmp_path, most=64, error=1.0)
    share = 0.5 * math.erfc(10 / 3.1 / math.sqrt(2))
    statement = (
        f"{share:.2g} of it lies outside the allowed values (must be greater than or equal to 0)"
        " and is cut off"
    )
    assert any(statement in line for line in lines)
    assert statement in (folder / "report.html").read_text()
    doc = json.loads((folder / "provenance.json").read_text())
    assert statement in doc["cut off"]["sensor.read_noise"]


def test_what_is_cut_off_leaves_the_conditional_law():
    inputs = Inputs.of(
        small("transfer", "sensor.read_noise=normal(10 e-, 3.1 e-)"), negligible=1e-3
    )
    drawn = inputs.at(np.linspace(-8, 8, 2001)[:, None])[:, 0]
    assert drawn.min() >= 0.0
    law = stats.truncnorm(-10 / 3.1, math.inf, 10, 3.1)
    assert inputs.at(np.array([[-2.0], [0.0], [2.0]]))[:, 0] == pytest.approx(
        law.ppf(stats.norm.cdf([-2, 0, 2]))
    )


def test_a_training_or_an_evaluation_cuts_nothing_that_matters():
    with pytest.raises(RecipeError, match="write truncated"):
        Inputs.of(small("transfer", "sensor.read_noise=normal(10 e-, 3.1 e-)"))


def test_rows_of_a_table_outside_the_allowed_values_are_refused_or_left_out(tmp_path):
    rng = np.random.default_rng(1)
    rows = np.stack([10 + rng.standard_normal(2000), 0.5 + 0.01 * rng.standard_normal(2000)], 1)
    rows[7, 0] = -1.0
    np.savez(tmp_path / "one.npz", **{"read_noise": rows[:, 0], "quantum_efficiency": rows[:, 1]})
    inputs = Inputs.of(small("transfer", f"posterior={tmp_path / 'one.npz'}"), negligible=1e-3)
    assert inputs.most_draws == 1999
    assert "1 of its 2000 rows lie outside" in inputs.notes["sensor.read_noise"]
    rows[:20, 0] = -1.0
    np.savez(tmp_path / "many.npz", **{"read_noise": rows[:, 0], "quantum_efficiency": rows[:, 1]})
    with pytest.raises(
        RecipeError, match=r"1\.00% of this distribution .* remove these rows of the table"
    ):
        Inputs.of(small("transfer", f"posterior={tmp_path / 'many.npz'}"), negligible=1e-3)


def test_a_joint_normal_law_is_refused_or_cut_off():
    def inputs(sd):
        said = {"mean": {"sensor.read_noise": "10 e-"}, "sd": {"sensor.read_noise": f"{sd} e-"}}
        return Inputs.of(
            load("first_light", ["outputs=[transfer]", *SMALL], posterior=said), negligible=1e-3
        )

    cut = inputs(3.1)
    assert "is cut off" in cut.notes["sensor.read_noise"]
    drawn = cut.at(np.linspace(-8, 8, 401)[:, None])[:, 0]
    assert drawn.min() >= 0.0
    assert (np.diff(drawn) > 0).all()
    with pytest.raises(
        RecipeError, match=r"2\.28% of this distribution .* smaller standard deviation"
    ):
        inputs(5)


@pytest.mark.slow
def test_values_that_exclude_each_other_are_left_out_and_told(tmp_path):
    """One value of 64 is enough to refuse before the run; later ones are left out, whole blocks
    of a Sobol sequence.
    """
    inputs = Inputs.of(small("transfer", *LAWS))
    points = inputs.independent(128, 1)
    points.values[100, 0] = -5.0
    few, all_draws = AllowedDraws(inputs, points, 0), AllowedDraws(inputs, points, SCRAMBLES)
    few.extend(64)
    refuse_combinations(inputs, points.values[:2], few)
    few.extend(128)
    all_draws.extend(128)
    assert (few.left_out, len(few.z)) == (1, 127)
    assert (all_draws.left_out, len(all_draws.z)) == (8, 120)
    assert "greater than" in few.reason
    with pytest.raises(
        RecipeError, match="1 of the first 128 draws have values that are not allowed together"
    ):
        refuse_combinations(inputs, points.values[:2], few)


# --- choices that are made once -------------------------------------------------------------------

#: the lens of the recipe, whose image needs the PSFs of a few bands only
WIDE = ["scene.shape=[64, 64]", "sensor.shape=[64, 64]"]
EFFICIENCY = "sensor.quantum_efficiency=lognormal(0.56, 1.02)"


@pytest.mark.slow
def test_a_draw_with_a_choice_made_before_is_a_run_to_the_last_bit(store, monkeypatch):
    """A quantum efficiency multiplies all responses: bands are chosen once, and draws are runs."""
    computed, chosen = [], []

    def noted(step, *values):
        result = call(step, *values)
        computed.append(step.node.path)
        chosen.extend([len(result.used)] if step.node.path == "optics.few_bands" else [])
        return result

    monkeypatch.setattr("neusee.workflows.studies.reused_choices.call", noted)
    outputs = "outputs=[saturated, developed_quality]"
    inputs = Inputs.of(load("first_light", [outputs, *WIDE, EFFICIENCY, LAWS[0]]))
    values = inputs.independent(3, 1).values
    found = OutputDraws(inputs, store, workers=1).numbers(values)
    # one for the plain lens and one for the mask, and fewer than all 31 bands for at least one
    assert len(chosen) <= 2
    assert min(chosen) < 31
    assert computed.count("sensor.digitize") == 6
    row = dict(zip(inputs.names, map(float, values[2]), strict=True))
    assert found[2] == quantities(run(recipe_at(inputs.uncertain, row), store).values)


def test_a_choice_is_made_anew_where_the_responses_change_their_shape():
    recipe = with_substitutions(small("saturated"), ["saturated[mask]", "saturated[plain]"])
    step = next(x for x in recipe.steps.values() if x.node.path == "optics.few_bands")
    pupil, radiance, rows = object(), object(), torch.tensor([[1.0, 2.0], [3.0, 0.0]])
    assert serves(step, [pupil, radiance, rows], [pupil, radiance, 1.7 * rows])
    tilted = rows * torch.tensor([1.0, 1.001])
    for others in (
        [pupil, radiance, tilted],
        [pupil, radiance, -rows],
        [pupil, radiance, 0 * rows],
        [object(), radiance, rows],
        [pupil, object(), rows],
    ):
        assert not serves(step, [pupil, radiance, rows], others)


# --- linear propagation ---------------------------------------------------------------------------


def test_linear_propagation_answers_where_its_error_is_small(store, tmp_path):
    """Dark noise K**2 (sigma**2 + dark) + 1/12 in sigma of 10.5 ± 1, with 13 runs."""
    recipe = small("transfer", "sensor.read_noise=normal(10.5 e-, 1 e-)")
    lines, folder = told_of(recipe, store, tmp_path, method="linear", until=("transfer",))
    doc = json.loads((folder / "provenance.json").read_text())
    floor = doc["quantities"]["transfer"]
    assert doc["method"] == "linear"
    assert doc["draws"] == 13
    assert floor["sd"][2] == pytest.approx(2 * 10.5 * 1.0 / 0.37**2, rel=1e-3)
    assert floor["bias"][2] == pytest.approx(1.0**2 / 0.37**2, rel=1e-2)
    assert doc["error"] <= 0.05
    assert any("is known to" in line for line in lines)
    text = (folder / "report.html").read_text()
    assert "Error against run time" in text
    assert (folder / "table.csv").read_text().startswith("quantity,element,at the medians,mean,sd")


def test_draws_go_on_where_linear_propagation_is_too_wrong(store, tmp_path):
    """The count of saturated pixels is a step function of the strength."""
    recipe = small("peak, saturated", "lasers.green.strength=lognormal(1e3, 3)")
    lines, folder = told_of(recipe, store, tmp_path, method="linear", most=64, error=0.3)
    told = next(line for line in lines if "of a linear propagation" in line)
    assert told.endswith("; draws go on")
    doc = json.loads((folder / "provenance.json").read_text())
    assert [rung["name"] for rung in doc["rungs"]] == ["linear", "draws"]
    assert not doc["rungs"][0]["holds"]
    plain = study_recipe("uncertainty", recipe, store, tmp_path / "plain", most=64, error=0.3)
    other = json.loads((plain / "provenance.json").read_text())
    assert other["quantities"] == doc["quantities"]
    assert [rung["name"] for rung in other["rungs"]] == ["draws"]
    assert ">linear<" in (folder / "report.html").read_text()


def test_inputs_without_a_derivative_are_told_and_drawn(store, tmp_path):
    law = "sensor.read_noise=discrete(10 e- weight 0.5, 12 e- weight 0.5)"
    lines, folder = told_of(
        small("transfer", law), store, tmp_path, method="linear", most=64, error=1.0
    )
    assert (
        "no linear propagation: sensor.read_noise has separate values, and no derivative; draws go"
        " on" in lines
    )
    assert json.loads((folder / "provenance.json").read_text())["draws"] == 64
