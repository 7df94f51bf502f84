"""`neusee compare` prints what differs and ends with 3 only beyond a limit that was asked for."""

import json

import pytest

from neusee.workflows.cli import app
from neusee.workflows.recipe.loading import load
from neusee.workflows.simulation.simulate_recipe import simulate
from neusee.workflows.store.result_store import Store
from tests.workflows.comparison.test_compare_runs import RECIPE


@pytest.fixture(scope="module")
def runs(tmp_path_factory):
    root = tmp_path_factory.mktemp("compare")
    (root / "mine.yaml").write_text(RECIPE)
    names = []
    for change in ([], ["steps.full.with.capacity=0.125 e-"]):
        recipe = load(root / "mine.yaml", change, root)
        names.append(simulate(recipe, Store(root / "cache"), root / "runs", ["neusee", "run"]).folder.name)
    return root / "runs", *names


@pytest.fixture
def neusee(capfd):
    def call(*words):
        with pytest.raises(SystemExit) as end:
            app.main(list(words))
        return (end.value.code or 0, *capfd.readouterr())

    return call


def test_the_terminal_has_the_tables_and_the_page(neusee, runs):
    root, first, last = runs
    code, out, err = neusee("compare", first, "latest", "--out", str(root))
    assert (code, err) == (0, "")
    assert f"left   {root.resolve() / first}\nright  {root.resolve() / last}\n" in out
    assert "steps.full.with.capacity: 0.25 e- (mine.yaml:7:77) -> 0.125 e- (argument 1)" in out
    page = out.splitlines()[-1].removeprefix("page   ")
    assert page.startswith(f"{root}/comparisons/")
    assert (root / "latest").resolve().name == last


def test_json_is_one_object_and_quiet_is_the_page(neusee, runs):
    root, first, last = runs
    code, out, _ = neusee("compare", first, last, "--out", str(root), "--json")
    found = json.loads(out)
    assert code == 0
    assert found["recipe"][0]["right"] == "0.125 e-"
    assert found["largest"] == max(number["relative"] for number in found["numbers"])
    assert neusee("compare", first, last, "--out", str(root), "--quiet")[1].endswith("report.html\n")


def test_a_limit_decides_the_exit_code(neusee, runs):
    root, first, last = runs
    assert neusee("compare", first, first, "--out", str(root), "--fail-above", "0")[0] == 0
    assert neusee("compare", first, last, "--out", str(root), "--fail-above", "2")[0] == 0
    code, _, err = neusee("compare", first, last, "--out", str(root), "--fail-above", "1e-9")
    assert code == 3
    assert "relatively, more than 1e-09" in err


@pytest.mark.parametrize("words", [("nothing", "latest"), ("latest", "nothing")])
def test_a_run_that_is_not_there_is_refused(words, neusee, runs):
    code, out, err = neusee("compare", *words, "--out", str(runs[0]))
    assert (code, out) == (2, "")
    assert err == f"no run at nothing: give the name of a folder in {runs[0]}, a path, or `latest`\n"
