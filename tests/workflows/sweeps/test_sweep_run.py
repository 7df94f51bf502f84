"""A sweep checks everything first, shares what it can, goes on where it stopped and keeps what
failed.
"""

import csv
import gc
import importlib.util
import io
import logging
import os
import signal
import sys
from pathlib import Path

import pytest
import torch

from neusee.workflows import load
from neusee.workflows.cli.sweep_screen import SweepCommandOptions, run_sweep
from neusee.workflows.engine import local_executor
from neusee.workflows.graph.errors import RecipeError, RunError
from neusee.workflows.store.result_store import Store
from neusee.workflows.sweeps import sweep_points
from neusee.workflows.sweeps import sweep_run as sweep_files
from neusee.workflows.sweeps.sweep_run import SweepOptions, sweep
from tests.workflows.crate_rules import faults

RECIPE = """\
# A camera of three steps
sensor: {read_noise: 5 e-, most: 1e9}
light: {level: 2.0, colour: 500 nm}
steps:
  source: {node: swept.source, with: {level: "${light.level}"}}
  coloured: {node: swept.coloured, from: source, with: {wavelength: "${light.colour}"}}
  noted: {node: swept.noted, from: coloured, with: {read_noise: "${sensor.read_noise}", most: "${sensor.most}"}}
  quality: {node: swept.quality, from: noted}
outputs: [noted, quality]
"""
AXES = {
    "sensor.read_noise": ["1 e-", "2 e-", "3 e-"],
    "light.colour": "linspace(500 nm, 600 nm, 2)",
}
WORDS = ["sensor.read_noise=1 e-,2 e-,3 e-", "light.colour=linspace(500 nm, 600 nm, 2)"]


@pytest.fixture
def nodes(monkeypatch):
    """The family ``swept``, as if it were one of the package."""
    name = "neusee.nodes.swept"
    spec = importlib.util.spec_from_file_location(
        name, Path(__file__).parents[1] / "sweep_nodes.py"
    )
    module = importlib.util.module_from_spec(spec)
    monkeypatch.setitem(sys.modules, name, module)
    spec.loader.exec_module(module)
    return module


@pytest.fixture
def recipe(nodes, write):
    return str(write(RECIPE))


@pytest.fixture
def store(tmp_path):
    return Store(tmp_path / "cache")


@pytest.fixture
def command(recipe, store, tmp_path, capsys):
    """Run the command and give its exit code, its folder and what it printed."""

    def command(*words, **values):
        options = SweepCommandOptions(out=tmp_path / "runs", **values)
        code = run_sweep(recipe, words or WORDS, store, options)
        return code, tmp_path / "runs/sweeps/latest", capsys.readouterr().out

    return command


def read_table(folder):
    with (folder / "sweep.csv").open(encoding="utf-8", newline="") as file:
        return list(csv.DictReader(file))


def refused(call):
    with pytest.raises(RecipeError) as caught:
        call()
    return [f"{p.mark} | {p.path} | {p.message}" for p in caught.value.diagnostics]


# --- what it gives --------------------------------------------------------------------------------


def test_every_number_of_every_point_is_a_row(recipe, store):
    found = sweep(recipe, AXES, store=store)
    means = [row for row in found.rows if (row["step"], row["field"]) == ("quality", "mean")]
    assert [row["point"] for row in means] == [1, 2, 3, 4, 5, 6]
    assert [row["sensor.read_noise (e-)"] for row in means] == [1, 1, 2, 2, 3, 3]
    assert [row["light.colour (nm)"] for row in means] == [500, 600, 500, 600, 500, 600]
    assert [row["value"] for row in means] == pytest.approx([1001, 1201, 1002, 1202, 1003, 1203])
    assert [
        row["index"] for row in found.rows if row["point"] == 1 and row["field"] == "profile"
    ] == [0, 1, 2, 3]
    assert {row["status"] for row in found.rows} == {"ok"}


def test_what_points_share_is_made_once(recipe, store, nodes):
    found = sweep(recipe, AXES, store=store)
    assert {name: nodes.CALLS.count(name) for name in set(nodes.CALLS)} == {
        "source": 1,
        "coloured": 2,
        "noted": 6,
        "quality": 6,
    }
    assert found.sharing.distinct == {"source": 1, "coloured": 2, "noted": 6, "quality": 6}


def test_paired_axes(recipe, store):
    found = sweep(
        recipe,
        {"light.level": [1, 2], "light.colour": ["500 nm", "1 um"]},
        store=store,
        options=SweepOptions(paired=True),
    )
    means = [row for row in found.rows if row["field"] == "mean"]
    assert [row["light.level"] for row in means] == [1, 2]
    assert [row["light.colour (m)"] for row in means] == pytest.approx([500e-9, 1e-6])
    assert [row["value"] for row in means] == pytest.approx([505, 2005])


def test_groups_are_axes_and_fixed_changes_hold_at_every_point(nodes, write, store):
    path = str(
        write(
            "defaults: [light: red]\n" + RECIPE.replace("light: {level: 2.0, colour: 500 nm}\n", "")
        )
    )
    write("light: {level: 1.0, colour: 600 nm}", "light/red.yaml")
    write("light: {level: 1.0, colour: 500 nm}", "light/green.yaml")
    found = sweep(path, {"light": ["red", "green"]}, ["sensor.read_noise=0 e-"], store=store)
    means = {row["light"]: row["value"] for row in found.rows if row["field"] == "mean"}
    assert means == pytest.approx({"red": 600, "green": 500})


def test_points_that_are_stored_are_served(recipe, store, nodes):
    sweep(recipe, AXES, store=store)
    nodes.CALLS.clear()
    found = sweep(recipe, {**AXES, "sensor.read_noise": ["2 e-", "9 e-"]}, store=store)
    assert [(o.point.shown, o.state) for o in found.outcomes] == [
        ("sensor.read_noise=2 e-, light.colour=500 nm", "cached"),
        ("sensor.read_noise=2 e-, light.colour=600 nm", "cached"),
        ("sensor.read_noise=9 e-, light.colour=500 nm", "run"),
        ("sensor.read_noise=9 e-, light.colour=600 nm", "run"),
    ]
    assert sorted(nodes.CALLS) == ["noted", "noted", "quality", "quality"]


def test_a_table_to_read(recipe, store):
    found = sweep(recipe, {"sensor.read_noise": ["1 e-", "2 e-"]}, store=store)
    head, first, second = found.table().splitlines()
    assert head.split() == [
        "point",
        "sensor.read_noise",
        "(e-)",
        "quality.mean",
        "noted",
        "quality.profile",
        "state",
        "seconds",
    ]
    assert first.split()[:3] == ["1", "1", "1001"]
    assert second.split()[:3] == ["2", "2", "1002"]
    page = found._repr_html_()
    assert page.count("<tr>") == 3
    assert "<td>1002</td>" in page


# --- what is refused ------------------------------------------------------------------------------


def test_every_mistake_of_every_point_before_anything_runs(recipe, store, nodes):
    told = refused(
        lambda: run_sweep(
            recipe,
            ["sensor.read_noise=1 e-,2,3 nm", "light.colour=500 nm,5 nm", "x.y=1"],
            store,
        )
    )
    assert [line.partition(" | ")[0] for line in told] == [
        "argument 2",
        "argument 2",
        "argument 3",
        "argument 4",
    ]
    assert "sensor.read_noise = 2" in told[0]
    assert nodes.CALLS == []


def test_preflight_looks_at_every_point(recipe, store, nodes):
    told = refused(lambda: sweep(recipe, {"sensor.read_noise": ["1 e-", "2000 ke-"]}, store=store))
    assert told == [
        "argument sensor.read_noise | sensor.read_noise = 2000 ke- | is beyond every sensor"
    ]
    assert nodes.CALLS == []


def test_netcdf_without_its_packages_is_refused_before_anything_runs(
    recipe, store, nodes, monkeypatch
):
    monkeypatch.setattr(sweep_files, "_PACKAGES", ("xarray", "no_such_package"))
    told = refused(lambda: run_sweep(recipe, WORDS, store, SweepCommandOptions(netcdf=True)))
    assert told == ['--netcdf |  | needs no_such_package: pip install "neusee[xarray]"']
    assert nodes.CALLS == []


# --- what fails, and what goes on -----------------------------------------------------------------


def test_a_failing_point_stops_the_sweep_with_its_error(recipe, store):
    with pytest.raises(RunError, match="3 e- are too many") as caught:
        sweep(recipe, AXES, ["sensor.most=2"], store=store)
    assert caught.value.__notes__[0].startswith("at point ")
    assert "sensor.read_noise=3 e-" in caught.value.__notes__[0]


def test_a_failing_point_is_kept_and_the_others_go_on(recipe, store):
    found = sweep(
        recipe, AXES, ["sensor.most=1"], store=store, options=SweepOptions(on_error="continue")
    )
    assert [o.point.number for o in found.failed] == [3, 4, 5, 6]
    row = next(row for row in found.rows if row["point"] == 3)
    assert (row["status"], row["step"], row["value"]) == ("failed", "noted", "")
    assert "mine.yaml:7:" in row["message"]
    assert "ValueError: 2 e- are too many" in row["message"]


@pytest.mark.parametrize(
    ("on_error", "points", "state"), [("continue", 3, "complete"), ("stop", 2, "stopped")]
)
def test_the_command_says_which_point_failed_and_fails(command, on_error, points, state):
    words = ["sensor.read_noise=1 e-,2 e-,3 e-", "sensor.most=1.5"]
    code, folder, out = command(*words, on_error=on_error)
    rows = read_table(folder)
    assert code == 1
    assert len({row["point"] for row in rows}) == points
    assert {row["point"] for row in rows if row["status"] == "failed"} == {
        str(n) for n in range(2, points + 1)
    }
    assert "failed: point 2, sensor.read_noise=2 e-: " in out
    assert f"state: {state}\n" in (folder / "sweep.yaml").read_text()
    assert ("partial" in folder.resolve().name) == (state == "stopped")


def test_an_interrupted_sweep_leaves_a_valid_table_and_goes_on(command, nodes, recipe):
    nodes.INTERRUPT.add(2.0)
    code, folder, out = command()
    done = {row["point"] for row in read_table(folder)}
    assert code == 130
    assert 0 < len(done) < 6
    assert "_partial_" in folder.resolve().name
    assert "state: interrupted\n" in (folder / "sweep.yaml").read_text()
    again = (
        f"neusee sweep {recipe} 'sensor.read_noise=1 e-,2 e-,3 e-' 'light.colour=linspace(500 nm,"
        " 600 nm, 2)'"
    )
    assert f"to go on: {again}" in out
    nodes.CALLS.clear()
    code, folder, out = command()
    rows = read_table(folder)
    assert code == 0
    assert {row["point"] for row in rows} == set("123456")
    assert {row["point"] for row in rows if row["cached"] == "True"} == done
    assert nodes.CALLS.count("quality") == 6 - len(done)


# --- workers --------------------------------------------------------------------------------------


def of_numbers(found):
    return [
        {name: value for name, value in row.items() if name not in ("seconds", "cached")}
        for row in found.rows
    ]


def test_workers_give_the_same_rows_and_leave_nothing_in_the_store(recipe, tmp_path, nodes):
    alone = sweep(recipe, AXES, store=Store(tmp_path / "alone"))
    nodes.CALLS.clear()
    store = Store(tmp_path / "shared")
    found = sweep(recipe, AXES, store=store, options=SweepOptions(workers=3))
    assert nodes.CALLS == []
    assert of_numbers(found) == of_numbers(alone)
    assert [o.state for o in found.outcomes] == ["run"] * 6
    kept = {key: about.get("kept", True) for key, about in Store(tmp_path / "alone").entries()}
    assert {
        key: about.get("kept", True) for key, about in Store(tmp_path / "shared").entries()
    } == kept
    assert {path.name for path in (tmp_path / "shared/tmp").iterdir()} <= {".lock"}
    again = sweep(recipe, AXES, store=Store(tmp_path / "shared"), options=SweepOptions(workers=2))
    assert [o.state for o in again.outcomes] == ["cached"] * 6


def test_a_point_that_fails_in_a_worker_has_the_error_of_a_sweep_without_workers(recipe, store):
    with pytest.raises(RunError, match="3 e- are too many") as caught:
        sweep(recipe, AXES, ["sensor.most=2"], store=store, options=SweepOptions(workers=2))
    assert "sensor.read_noise=3 e-" in caught.value.__notes__[0]
    found = sweep(
        recipe,
        AXES,
        ["sensor.most=1"],
        store=store,
        options=SweepOptions(on_error="continue", workers=2),
    )
    alone = sweep(
        recipe, AXES, ["sensor.most=1"], store=store, options=SweepOptions(on_error="continue")
    )
    assert [o.point.number for o in found.failed] == [3, 4, 5, 6]
    assert of_numbers(found) == of_numbers(alone)


def test_points_of_a_killed_worker_are_run(recipe, store, nodes, monkeypatch):
    mine, whole = os.getpid(), torch.Tensor.sum
    wanted = of_numbers(sweep(recipe, AXES, store=Store(store.root.parent / "alone")))

    def deadly(tensor, *args, **how):
        if os.getpid() != mine and float(tensor[0, 0]) == 1002.0:  # the point with 2 e- and 500 nm
            os.kill(os.getpid(), signal.SIGKILL)
        return whole(tensor, *args, **how)

    monkeypatch.setattr(torch.Tensor, "sum", deadly)
    assert of_numbers(sweep(recipe, AXES, store=store, options=SweepOptions(workers=2))) == wanted


def test_workers_divide_the_memory_and_a_point_that_has_too_little_runs_here(
    recipe, store, nodes, monkeypatch
):
    asked = []
    monkeypatch.setattr(
        sweep_points, "memory_limit", lambda memory, workers: asked.append(workers) or 1.0
    )
    wanted = of_numbers(sweep(recipe, AXES, store=Store(store.root.parent / "alone")))
    assert asked == []
    nodes.CALLS.clear()
    assert of_numbers(sweep(recipe, AXES, store=store, options=SweepOptions(workers=2))) == wanted
    assert nodes.CALLS.count("noted") == 6  # one byte is too little for any step
    free = local_executor.free_memory()
    monkeypatch.setattr(local_executor, "free_memory", lambda: free)
    monkeypatch.setattr(local_executor, "process_memory", lambda: 0)
    assert local_executor.memory_limit(None, 2) == pytest.approx(
        local_executor.memory_limit(None) / 2
    )


def test_a_command_with_workers_that_is_interrupted_keeps_what_is_done(command, nodes):
    nodes.INTERRUPT.add(2.0)  # in this process too, where a point that fails in a worker runs again
    code, folder, _ = command(workers=2)
    done = {row["point"] for row in read_table(folder)}
    assert code == 130
    assert len(done) < 6
    nodes.INTERRUPT.clear()
    code, folder, _ = command(workers=2)
    rows = read_table(folder)
    assert code == 0
    assert {row["point"] for row in rows} == set("123456")
    assert done <= {row["point"] for row in rows if row["cached"] == "True"}


def test_a_cache_that_cannot_be_written_is_said_once_by_all_workers(recipe, tmp_path, capsys):
    (tmp_path / "cache").write_text("no folder")
    store = Store(tmp_path / "cache")
    options = SweepCommandOptions(out=tmp_path / "runs", workers=2)
    with pytest.warns(UserWarning, match="cannot be written") as told:
        code = run_sweep(recipe, WORDS, store, options)
    assert code == 0
    assert len({str(each.message) for each in told}) == 1
    assert "warning  the cache" in capsys.readouterr().out


# --- files ----------------------------------------------------------------------------------------


def test_the_table_is_read_back_as_it_was(command, recipe, store):
    code, folder, out = command()
    expected = sweep(recipe, AXES, store=store).rows
    rows = read_table(folder)
    assert code == 0
    assert len(rows) == len(expected) == 6 * (16 + 1 + 4)
    for row, told in zip(rows, expected, strict=True):
        assert list(row) == list(told)
        exact = (
            "point",
            "sensor.read_noise (e-)",
            "light.colour (nm)",
            "step",
            "field",
            "index",
            "value",
        )
        assert [row[name] for name in exact] == [str(told[name]) for name in exact]
    assert f"table    {folder.resolve() / 'sweep.csv'}" in out


def test_the_account_can_be_read_as_yaml_and_says_how_to_run_it_again(command):
    from ruamel.yaml import YAML

    _, folder, _ = command("sensor.read_noise=1 e-,2 e-", "light.level=1,2", "light.colour=600 nm")
    found = YAML(typ="safe").load(io.StringIO((folder / "sweep.yaml").read_text()))
    assert found["axes"] == {"sensor.read_noise": ["1 e-", "2 e-"], "light.level": [1, 2]}
    assert found["overrides"] == ["light.colour=600 nm"]
    assert found["order"] == [1, 2, 4, 3] or found["order"] == [1, 3, 4, 2]
    assert (found["state"], found["points"], found["done"], found["failed"]) == (
        "complete",
        4,
        4,
        [],
    )
    assert (
        " 'sensor.read_noise=1 e-,2 e-' light.level=1,2 'light.colour=600 nm' --out "
        in found["again"]
    )
    # the description of a wheel may leave out what follows the plus sign
    assert found["versions"]["torch"].partition("+")[0] == torch.__version__.partition("+")[0]
    assert list(faults(folder)) == []


def test_a_second_sweep_never_overwrites_the_first(command, tmp_path):
    command()
    command()
    assert len([p for p in (tmp_path / "runs/sweeps").iterdir() if not p.is_symlink()]) == 2


def test_quiet_says_where_the_table_is_and_nothing_else(command):
    _, folder, out = command(quiet=True)
    assert out == f"{folder.resolve() / 'sweep.csv'}\n"


def test_quiet_says_on_stderr_what_failed(recipe, store, tmp_path, capsys):
    words = ["sensor.read_noise=1 e-,2 e-", "sensor.most=1.5"]
    options = SweepCommandOptions(out=tmp_path / "runs", quiet=True)
    assert run_sweep(recipe, words, store, options) == 1
    found = capsys.readouterr()
    assert found.out.splitlines() == [
        str((tmp_path / "runs/sweeps/latest").resolve() / "sweep.csv")
    ]
    assert found.err.startswith("failed: point 2, sensor.read_noise=2 e-: ")
    assert "mine.yaml:7:" in found.err


def test_plain_lines_and_a_live_table_show_the_same_points(
    recipe, store, tmp_path, monkeypatch, capsys
):
    def shown(tty):
        monkeypatch.setattr(sys.stdout, "isatty", lambda: tty, raising=False)
        monkeypatch.setenv("COLUMNS", "200")
        words = ["sensor.read_noise=1 e-,2 e-"]
        run_sweep(recipe, words, store, SweepCommandOptions(out=tmp_path / "runs"))
        return capsys.readouterr().out

    for out in (shown(False), shown(True)):
        assert "checked  2 points (sensor.read_noise: 2), 8 steps: all right" in out
        assert "1/2" in out
        assert "2/2" in out
        assert "quality.mean 1002" in out


# --- xarray ---------------------------------------------------------------------------------------


def test_a_product_is_a_data_set_with_the_axes_as_dimensions(recipe, store):
    pytest.importorskip("xarray")
    pytest.importorskip("h5netcdf")
    pytest.importorskip("h5py")
    found = sweep(
        recipe,
        {**AXES, "sensor.most": [2.5]},
        store=store,
        options=SweepOptions(on_error="continue"),
    ).to_xarray()
    assert dict(found.sizes) == {
        "sensor.read_noise": 3,
        "light.colour": 2,
        "sensor.most": 1,
        "quality.profile index": 4,
        "noted index": 16,
    }
    assert found["light.colour"].values.tolist() == pytest.approx([500e-9, 600e-9])
    assert found["light.colour"].attrs["units"] == "m"
    assert "units" not in found["sensor.most"].attrs
    mean = found["quality.mean"].sel(
        {"sensor.read_noise": 2.0, "light.colour": 600e-9}, method="nearest"
    )
    assert mean.values.tolist() == pytest.approx([1202])
    assert found["ran"].values[:, 0, 0].tolist() == [True, True, False]
    assert bool(found["quality.mean"].isnull()[2].all())


def test_paired_axes_are_coordinates_of_the_points(recipe, store):
    pytest.importorskip("xarray")
    pytest.importorskip("h5netcdf")
    pytest.importorskip("h5py")
    found = sweep(
        recipe,
        {"light.level": [1, 2], "sensor.read_noise": ["1 e-", "2 e-"]},
        store=store,
        options=SweepOptions(paired=True),
    ).to_xarray()
    assert found["quality.mean"].dims == ("point",)
    assert found["sensor.read_noise"].dims == ("point",)
    assert found["quality.mean"].values.tolist() == pytest.approx([501, 1002])


def test_a_result_with_the_name_of_an_axis_has_another_name(nodes, write, store):
    pytest.importorskip("xarray")
    pytest.importorskip("h5netcdf")
    pytest.importorskip("h5py")
    text = """\
        source: {level: 1.0, count: 1}
        steps: {source: {node: swept.source, with: "${source}"}}
        outputs: [source]
        """
    path = str(write("".join(line.removeprefix("        ") for line in text.splitlines(True))))
    found = sweep(path, {"source": [{"level": 1.0}, {"level": 2.0}]}, store=store).to_xarray()
    assert found["source (result)"].values.tolist() == [1, 2]


def test_netcdf_is_read_back_as_it_was(command, recipe, store):
    xarray = pytest.importorskip("xarray")
    pytest.importorskip("h5netcdf")
    pytest.importorskip("h5py")
    code, folder, _ = command(netcdf=True)
    assert code == 0
    with xarray.open_dataset(folder / "sweep.nc", engine="h5netcdf") as found:
        wanted = sweep(recipe, AXES, store=store).to_xarray()
        assert found.drop_vars("seconds").identical(wanted.drop_vars("seconds"))


# --- many points ----------------------------------------------------------------------------------


@pytest.mark.slow
def test_fifty_sweeps_leave_nothing_behind(recipe, tmp_path):
    def once(level):
        store = Store(tmp_path / "cache")  # one of its own: a store remembers what it has seen
        axes = {"sensor.read_noise": ["1 e-", "2 e-"]}
        sweep(
            recipe,
            axes,
            [f"light.level={level}", "sensor.most=1.5"],
            store=store,
            options=SweepOptions(on_error="continue"),
        )

    def held():
        gc.collect()
        names = (None, *logging.root.manager.loggerDict)
        handlers = [handler for name in names for handler in logging.getLogger(name).handlers]
        objects = gc.get_objects()
        return sum(type(x) is torch.Tensor for x in objects), len(handlers), len(objects)

    for level in range(20):
        once(level)
    tensors, handlers, objects = held()
    for level in range(20, 70):
        once(level)
    after = held()
    assert after[0] <= tensors
    assert after[1] == handlers
    assert after[2] - objects < 50 * 4  # a single recipe is hundreds


def test_points_keep_what_differs_from_the_first(recipe, store):
    from neusee.workflows.sweeps.axes import points, read_axes
    from neusee.workflows.sweeps.sweep_points import plan_sweep

    found = plan_sweep(
        recipe,
        points(read_axes({"sensor.read_noise": [f"{n} e-" for n in range(9)]}, Path())),
        Path().absolute(),
        store,
    )
    for number, checked in enumerate(found.checked):
        assert set(checked.kept.values) == ({"sensor.read_noise"} if number else set())
        kept, alone = checked.kept.recipe, load(recipe, [f"sensor.read_noise={number} e-"])
        assert kept.config.values == alone.config.values
        assert list(kept.steps) == list(alone.steps)
        for name, step in alone.steps.items():
            assert (kept.steps[name].params, kept.steps[name].wires) == (step.params, step.wires)
        assert (kept.seed, kept.outputs, kept.tolerance) == (
            alone.seed,
            alone.outputs,
            alone.tolerance,
        )
    assert all(len(checked.kept.steps) < len(found.recipe.steps) / 2 for checked in found.checked)
    assert len({id(checked.job.sources) for checked in found.checked}) == 1
