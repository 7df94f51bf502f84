"""The commands of the engine: why, sweep, cache, and where a run computes."""

import json

import pytest

from neusee.workflows.cli import app

RECIPE = """
# A target through a small sensor.
sensor: {gain: 0.5 e-/DN, capacity: 200 e-}
seed: 3
tolerance: 0
outputs: [raw, saturated]
steps:
  scene: {node: scene.targets, with: {kind: siemens, shape: [16, 16]}}
  full: {node: sensor.full_well, from: {electrons: scene}, with: {capacity: "${sensor.capacity}"}}
  raw: {node: sensor.digitize, from: {electrons: full}, with: {gain: "${sensor.gain}"}}
  saturated: {node: sensor.crop, from: {image: raw}, with: {shape: [8, 8]}}
"""


@pytest.fixture
def here(tmp_path, monkeypatch):
    """A working folder with a recipe of its own and a cache of its own."""
    monkeypatch.chdir(tmp_path)
    monkeypatch.setenv("NEUSEE_CACHE", str(tmp_path / "cache"))
    (tmp_path / "mine.yaml").write_text(RECIPE)
    return tmp_path


@pytest.fixture
def neusee(here, capfd):
    """Call the command line; give the exit code, stdout and stderr."""

    def call(*words: str) -> tuple[int, str, str]:
        with pytest.raises(SystemExit) as end:
            app.main(list(words))
        return (end.value.code or 0, *capfd.readouterr())

    return call


def test_why_names_the_value_and_its_place(neusee):
    assert neusee("run", "mine.yaml", "--quiet")[0] == 0
    code, out, _ = neusee("why", "saturated", "mine.yaml", "sensor.gain=0.7 e-/DN")
    assert code == 0
    assert "saturated <- raw: sensor.gain 0.5 -> 0.7 e-/DN (argument 3)" in out


def test_why_of_no_step_names_the_nearest(neusee):
    code, _, err = neusee("why", "satturated", "mine.yaml")
    assert code == 2
    assert "did you mean saturated?" in err


def test_cache_commands_go_round(neusee, here):
    neusee("run", "mine.yaml", "--quiet")
    code, out, _ = neusee("cache", "ls")
    assert code == 0
    key = next(line.split()[-1] for line in out.splitlines() if "  raw " in line)
    assert "raw of mine" in neusee("cache", "why", key)[1]
    assert neusee("cache", "pin", key)[0] == 0
    assert "pinned" in neusee("cache", "ls")[1]
    assert neusee("cache", "unpin", key)[0] == 0
    assert neusee("cache", "verify")[0] == 0
    assert neusee("cache", "gc", "--budget", "1 kB", "--dry-run")[0] == 0
    assert "saturated" in neusee("cache", "ls")[1]


def test_a_damaged_result_fails_the_verification(neusee, here):
    neusee("run", "mine.yaml", "--quiet")
    path = next((here / "cache").glob("??/*.json"))
    data = bytearray(path.read_bytes())
    data[len(data) // 2] ^= 1
    path.write_bytes(data)
    code, out, _ = neusee("cache", "verify")
    assert code == 3
    assert path.stem[:8] in out


@pytest.mark.parametrize(
    ("words", "said"),
    [
        (("cache", "gc", "--budget", "much"), "--budget"),
        (("cache", "pin", "zzz"), "zzz"),
        (("cache", "why", "zzz"), "zzz"),
        (("run", "mine.yaml", "--executor", "ray"), "--executor ray: write local, dask"),
        (("run", "mine.yaml", "--device", "cpu,cpu"), "names a device twice"),
        (("run", "mine.yaml", "--device", "gpu"), "--device gpu"),
        (("run", "mine.yaml", "--memory", "lots"), "--memory"),
        (
            ("sweep", "mine.yaml", "sensor.gain=0.5 e-/DN,0.6 e-/DN", "--on-error", "ignore"),
            "--on-error ignore",
        ),
        (("sweep", "mine.yaml", "sensor.gian=0.5,0.6"), "did you mean sensor.gain?"),
        (("plan", "mine.yaml", "--devices", "nowhere.yaml"), "nowhere.yaml"),
    ],
    ids=lambda value: " ".join(value) if isinstance(value, tuple) else "",
)
def test_bad_arguments_are_refused_before_anything_runs(neusee, here, words, said):
    code, _, err = neusee(*words)
    assert code == 2
    assert said in err
    assert not list((here / "cache").glob("??/*.json"))


def test_a_store_that_is_no_url_is_refused(neusee, monkeypatch):
    monkeypatch.setenv("NEUSEE_CACHE", "nonsense://bucket")
    code, _, err = neusee("run", "mine.yaml")
    assert code == 2
    assert "nonsense" in err


def test_a_sweep_writes_one_table_and_a_second_one_computes_nothing(neusee, here):
    gains, wells = (
        "sensor.gain=0.5 e-/DN,0.6 e-/DN,0.7 e-/DN",
        "sensor.capacity=linspace(100 e-, 200 e-, 2)",
    )
    words = ("sweep", "mine.yaml", gains, wells)
    code, out, _ = neusee(*words)
    assert code == 0, out
    table = (here / "runs" / "sweeps" / "latest" / "sweep.csv").read_text()
    assert len({line.split(",")[0] for line in table.splitlines()[1:]}) == 6
    code, again, _ = neusee(*words)
    assert code == 0
    assert "6 cached" in again


def test_two_lanes_of_the_cpu_give_what_one_gives(neusee, here):
    one = json.loads(neusee("run", "mine.yaml", "--json")[1])
    (here / "cache").rename(here / "before")
    two = json.loads(neusee("run", "mine.yaml", "--json", "--device", "cpu:0,cpu:1")[1])
    assert [s["key"] for s in one["steps"]] == [s["key"] for s in two["steps"]]
    assert one["metrics"] == two["metrics"]


def test_a_plan_says_what_is_refused_and_a_run_refuses_it_first(neusee, here):
    big = ("mine.yaml", "steps.scene.with.shape=[2000, 2000]")
    assert neusee("run", *big, "--quiet")[0] == 0
    more = (*big, "sensor.gain=0.6 e-/DN", "sensor.capacity=150 e-", "--memory", "9 MB")
    code, out, _ = neusee("plan", *more)
    assert code == 1
    assert "refused" in out
    code, _, err = neusee("run", *more)
    assert code == 2
    assert "--memory" in err


@pytest.mark.parametrize(
    ("words", "step"),
    [
        (("--memory", "1 MB"), " needs "),
        (
            ("--memory", "12 GB", "scene=siemens", "scene.shape=[9000,9000]", "optics.pixel=zoh"),
            " needs ",
        ),
    ],
)
def test_what_cannot_fit_is_refused_on_an_empty_cache_before_any_work(neusee, here, words, step):
    code, _, err = neusee("run", "first_light", *words)
    assert code == 2
    assert err.startswith("--memory: ")
    assert step in err
    assert "the limit is" in err
    assert not (here / "runs").exists()
    assert not list((here / "cache").glob("**/journal.jsonl"))


@pytest.mark.parametrize(
    "words", [("--memory", "20 GB", "scene.shape=[40000,40000]"), ("optics.bands=100000000",)]
)
def test_what_no_machine_holds_is_refused_on_an_empty_cache_before_any_work(neusee, here, words):
    code, _, err = neusee("run", "first_light", *words)
    assert code == 2
    assert "nothing was run" in err
    assert not (here / "runs").exists()
    assert not list((here / "cache").glob("**/journal.jsonl"))


def test_a_plan_of_what_never_ran_has_numbers_and_names_the_guesses(neusee, here, monkeypatch):
    from neusee.workflows.engine import cost_model

    code, out, _ = neusee("plan", "first_light")
    assert code == 0
    # the whole time is a guess until a step ran here; no row of a step is one, for each has a law
    assert out.count("guess") == 1
    assert "a guess by laws, before a step ran on this processor" in " ".join(out.split())
    assert "?" not in out
    assert "while the steps run, of which the program itself holds" in out
    laws = {path: law for path, law in cost_model.shipped().items() if path != "restore.wiener"}
    monkeypatch.setattr("neusee.workflows.engine.cost_model.shipped", lambda: laws)
    line = next(
        line
        for line in neusee("plan", "first_light")[1].splitlines()
        if line.startswith("deconvolved")
    )
    assert line.count("guess <") == 2  # the bytes of the result are known from its shape
