"""`neusee compare` prints what differs and ends with 3 only beyond a limit that was asked for."""

import json

import pytest

from neusee.workflows.cli import app
from neusee.workflows.report.run_folder import new_run

FACTS = {
    "recipe": "mine",
    "version": "0.1.0",
    "started": "2026-01-31 12:00:00 UTC",
    "device": "cpu",
    "table": {"columns": [], "rows": []},
    "facts": [["torch", "2.13.0"], ["engine", "1.000 s"]],
}


@pytest.fixture
def runs(tmp_path):
    """A folder with two small folders of runs, and the names of both."""
    names = []
    for noise, psnr, source in (("10 e-", 30.0, "mine.yaml:7:77"), ("20 e-", 24.0, "argument 1")):
        steps = [{"step": "raw", "node": "sensor.raw", "state": "run", "key": noise}]
        command, metrics = (
            f"neusee run {noise}",
            [["quality", "psnr", "", psnr], ["lsr", "", 0, 0.5]],
        )
        with new_run(tmp_path, "mine", noise) as folder:
            document = FACTS | {"steps": steps, "command": command, "metrics": metrics}
            folder.write("provenance.json", json.dumps(document))
            folder.write("recipe.yaml", f"sensor:\n  read_noise: {noise}  # {source}\n")
        names.append(folder.path.name)
    return tmp_path, *names


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
    assert "sensor.read_noise: 10 e- (mine.yaml:7:77) -> 20 e- (argument 1)" in out
    page = out.splitlines()[-1].removeprefix("page   ")
    assert page.startswith(f"{root}/comparisons/")
    assert (root / "latest").resolve().name == last


def test_json_is_one_object_and_quiet_is_the_page(neusee, runs):
    root, first, last = runs
    code, out, _ = neusee("compare", first, last, "--out", str(root), "--json")
    found = json.loads(out)
    assert code == 0
    assert found["recipe"][0]["right"] == "20 e-"
    assert [(n["name"], n["difference"], n["relative"]) for n in found["numbers"]] == [
        ("quality.psnr", -6.0, 0.2),
        ("lsr", 0.0, 0.0),
    ]
    assert found["largest"] == 0.2
    assert neusee("compare", first, last, "--out", str(root), "--quiet")[1].endswith(
        "report.html\n"
    )


def test_a_limit_decides_the_exit_code(neusee, runs):
    root, first, last = runs
    assert neusee("compare", first, first, "--out", str(root), "--fail-above", "0")[0] == 0
    assert neusee("compare", first, last, "--out", str(root), "--fail-above", "0.2")[0] == 0
    code, _, err = neusee("compare", first, last, "--out", str(root), "--fail-above", "0.1")
    assert code == 3
    assert err == "quality.psnr differs by 0.2 relatively, more than 0.1\n"


@pytest.mark.parametrize("words", [("nothing", "latest"), ("latest", "nothing")])
def test_a_run_that_is_not_there_is_refused(words, neusee, runs):
    code, out, err = neusee("compare", *words, "--out", str(runs[0]))
    assert (code, out) == (2, "")
    assert (
        err == f"no run at nothing: give the name of a folder in {runs[0]}, a path, or `latest`\n"
    )
