"""The README and the guide: commands parse, recipes load, links resolve, Python names exist, the glossary is whole."""

from __future__ import annotations

import ast
import builtins
import importlib
import re
import shlex
import shutil
import zlib
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import torch
import typer
from safetensors.torch import save_file
from typer.main import get_command

from neusee.nodes.restore._networks._nafnet import NAFNet
from neusee.nodes.restore._networks._restorer import start_network
from neusee.workflows.cli import app, catalogue
from neusee.workflows.cli.command_frame import split
from neusee.workflows.evaluation.pipelines import compose_pipelines, read_pipelines
from neusee.workflows.placement.machine_file import read_machines
from neusee.workflows.recipe.loading import load
from neusee.workflows.store.result_store import Store
from neusee.workflows.sweeps.axes import points, read_words

ROOT = Path(__file__).parents[1]
GUIDE = ROOT / "recipes" / "guide"
README = ROOT / "README.md"
CONTRIBUTING = ROOT / "CONTRIBUTING.md"
PAGES = sorted(GUIDE.glob("*.md"))
WRITTEN = [README, CONTRIBUTING, *PAGES]
COMMANDS = get_command(app.app)
LOADS = {
    "run",
    "validate",
    "plan",
    "why",
    "config",
    "train",
    "calibrate",
    "evaluate",
    "study",
    "safety",
}  #: a recipe in words
SPOKEN = re.compile(r"(?:torchrun .* --no-python )?neusee (?P<words>[^#\n]*)")
TERM = re.compile(r"- \*\*(?P<term>[^*]+)\*\*(?: \([^)]*(?:\([^)]*\))?[^)]*\))?: .+\. [^.].*\.")

pytestmark = pytest.mark.filterwarnings("ignore::DeprecationWarning:typer")


def lines(page: Path) -> list[str]:
    """Return the commands of a page's indented lines."""
    text = re.sub(r"```.*?```", "", page.read_text(encoding="utf-8"), flags=re.DOTALL)
    indented = re.findall(r"^    (.*)$", text, re.MULTILINE)
    found = [match["words"].strip() for line in indented if (match := SPOKEN.search(line))]
    return [words for words in found if "[RECIPE]" not in words]


def blocks(page: Path, language: str) -> list[str]:
    """Return the fenced blocks of a language."""
    return re.findall(rf"^```{language}\n(.*?)^```", page.read_text(encoding="utf-8"), re.MULTILINE | re.DOTALL)


def cases(found):
    """Return one test case for each thing that is found on a page; what stands on several pages is one case."""
    places = {x: f"{page.stem}-{n}" for page in reversed(WRITTEN) for n, x in reversed(list(enumerate(found(page))))}
    return [pytest.param(x, id=place) for x, place in places.items()]


@pytest.fixture(scope="module")
def folder(tmp_path_factory):
    """A working folder with every file that the pages speak of: their own recipes, frames, photographs, weights."""
    folder = tmp_path_factory.mktemp("guide")
    for text in (block for page in PAGES for block in blocks(page, "yaml")):
        path = folder / re.match(r"# (my/[\w/]+\.yaml): .*\.\n", text)[1]
        path.parent.mkdir(parents=True, exist_ok=True)
        path.write_text(text, encoding="utf-8")
    for text in (block for page in PAGES for block in blocks(page, "csv")):
        path = folder / re.match(r"# (my/[\w/]+\.csv): .*\.\n", text)[1]
        path.parent.mkdir(parents=True, exist_ok=True)
        path.write_text(text, encoding="utf-8")
    for text in (block for page in PAGES for block in blocks(page, "python")):
        if named := re.match(r"# (my/\w+\.py)\n", text):
            (folder / named[1]).write_text(text, encoding="utf-8")
    draw = np.random.default_rng(1)
    for level, photons in {"dark": 0, "dim": 1000, "half": 2000, "bright": 4000, "full": 9000}.items():
        (folder / "my" / level).mkdir()
        frames = 100 + 0.5 * draw.poisson(0.56 * photons + 100, (2, 64, 64))  # 0.5 DN/e-, and noise in the dark
        np.save(folder / "my" / level / "frames.npy", frames.round().astype(np.uint16))
    (folder / "my" / "set").mkdir()
    shutil.copy(folder / "my" / "dark" / "frames.npy", folder / "my" / "set" / "dark.npy")
    (folder / "my" / "set" / "EMVA1288_descriptor.txt").write_text("v 4.0\nn 12 64 64\nd 1000 0\n" + 2 * "i dark.npy\n")
    shutil.copy(ROOT / "recipes" / "samples" / "camera_levels.csv", folder / "my.csv")
    (folder / "camera.csv").write_text("wavelength,red,green,blue\n400,0,0,1\n550,0,1,0\n700,1,0,0\n")
    network = start_network(partial(NAFNet, width=16), torch.Generator().manual_seed(0))
    save_file(network.state_dict(), folder / "net.safetensors")
    page = (GUIDE / "own_networks.md").read_text(encoding="utf-8")
    names: dict[str, Any] = {}
    exec(re.search(r"^```python\n(# my/smallnet.py\n.*?)^```", page, re.MULTILINE | re.DOTALL)[1], names)
    save_file(names["SmallUNet"](16).state_dict(), folder / "smallnet.safetensors")
    np.save(folder / "mask.npy", np.zeros((540, 540)))
    (folder / "my_photographs").mkdir()
    for name in ("holiday.jpg", "my_photographs/one.jpg"):
        shutil.copy(ROOT / "recipes" / "samples" / "china.jpg", folder / name)
    shutil.copy(ROOT / "recipes" / "samples" / "night.exr", folder / "street.exr")
    return folder


def parsed(words: list[str]) -> tuple[str, dict]:
    """Return the path of a command and its values, parsed and not run."""
    context, command = COMMANDS.make_context("neusee", list(words), resilient_parsing=False), COMMANDS
    path, rest = [], list(words)
    while hasattr(command, "resolve_command"):
        name, command, rest = command.resolve_command(context, rest)
        path.append(name)
        context = command.make_context(name, list(rest), parent=context)
    return " ".join(path), context.params


@pytest.mark.parametrize("words", cases(lines))
def test_every_command_line_parses_and_its_recipe_loads(words, folder, monkeypatch):
    monkeypatch.chdir(folder)
    command, values = parsed(shlex.split(words))
    if command.split()[0] not in {*LOADS, "sweep"}:
        return
    given = values["words"] or (["train_small"] if command == "train" else [])
    name, changes, first = split(given)
    if command == "sweep":
        for point in points(read_words(changes, folder, first), values["paired"]):
            load(name, point.overrides, folder)
        return
    recipe = load(name, changes, folder)
    if command == "why":
        assert any(step.partition("[")[0] == values["step"].partition("[")[0] for step in recipe.steps)
    if command == "plan" and values["devices"]:
        assert read_machines(values["devices"]).devices
    if command == "train":
        assert recipe.training or recipe.lifting
    if command == "evaluate":
        compose_pipelines(name, changes, read_pipelines(values["pipelines"], folder), folder)


# --- the commands run -------------------------------------------------------------------------------------------------

#: commands that compute little or nothing, and run as they are written
QUICK = ("validate", "plan", "why", "config", "recipes", "nodes", "new", "check", "schema", "cache")
#: pages whose runs are computed with the camera of `small_camera`; the packaged recipes have tests of their own
RUN_HERE = ("tutorial", "recipes", "own_camera", "own_mask", "own_nodes", "own_photograph", "own_frames")
SMALL = {
    "optics/small": "optics: {samples: 128, pitch: 63.12 um, window: [64, 64]}",
    "sensor/small": "sensor: {shape: [48, 48]}",
    **{f"scene/{name}": "scene: {shape: [64, 64]}" for name in ("china", "siemens", "night")},
}


@pytest.fixture
def small_camera(folder, tmp_path, monkeypatch):
    """A stand-in for the packaged camera: options of the same names, with fewer samples and pixels, in its place."""
    for name, text in SMALL.items():
        path = tmp_path / "recipes" / f"{name}.yaml"
        path.parent.mkdir(parents=True, exist_ok=True)
        path.write_text(f"# A small stand-in.\ndefaults: [{path.stem}]\n{text}\n", encoding="utf-8")
    monkeypatch.setenv("NEUSEE_RECIPES", str(tmp_path / "recipes"))
    monkeypatch.chdir(folder)


@pytest.fixture(scope="module")
def kept(tmp_path_factory):
    return Store(tmp_path_factory.mktemp("store"))


def quick(page):
    """Return the commands of a page that run in no time, without those on keys and packages of the reader."""
    mine = ("KEY", "mylab", "bloom.py")
    return [words for words in lines(page) if words.split()[0] in QUICK and not any(each in words for each in mine)]


def computed(page):
    """Return the runs of a page that the small camera computes: without a cluster, and at no size of their own."""
    sized = ("--", "[512,512]", "mask.npy", "demonstration", "camera.csv", "descriptor")
    found = [words for words in lines(page) if words.split()[0] == "run" and page.stem in RUN_HERE]
    return [words for words in found if not any(word in words for word in sized)]


@pytest.mark.slow
@pytest.mark.parametrize("words", cases(quick))
def test_every_command_that_computes_little_runs(words, folder, tmp_path, monkeypatch, capsys):
    monkeypatch.chdir(folder)
    monkeypatch.setenv("NEUSEE_CACHE", str(tmp_path / "cache"))
    place = ["--in", str(tmp_path)] if words.startswith("new") else []
    with pytest.raises(SystemExit) as end:
        app.main([*shlex.split(words), *place])
    assert end.value.code == 0
    assert capsys.readouterr().out


@pytest.mark.slow
@pytest.mark.parametrize("words", cases(computed))
def test_every_run_of_the_tutorial_and_the_how_tos_computes_its_outputs(words, small_camera, folder, kept):
    name, changes, _ = split(shlex.split(words)[1:])
    result = load(name, changes, folder).run(kept)
    assert result.recipe.outputs
    assert all(result[output] is not None for output in result.recipe.outputs)


@pytest.mark.slow
@pytest.mark.parametrize("code", cases(lambda page: blocks(page, "python")))
def test_every_python_block_runs_with_the_small_camera(code, small_camera, kept, tmp_path, monkeypatch):
    monkeypatch.setenv("NEUSEE_CACHE", str(kept.root))
    monkeypatch.chdir(tmp_path)
    path = tmp_path / f"block_{zlib.crc32(code.encode()):x}.py"
    path.write_text(code, encoding="utf-8")
    monkeypatch.syspath_prepend(str(tmp_path))
    importlib.import_module(path.stem)


def repeated(page):
    """Return the sweeps of a page, and its studies of uncertainty."""
    return [words for words in lines(page) if words.split()[0] == "sweep" or words.startswith("study uncertainty")]


@pytest.mark.long
@pytest.mark.parametrize("words", cases(repeated))
def test_every_sweep_and_study_of_uncertainty_runs_with_the_small_camera(words, small_camera, tmp_path, monkeypatch):
    monkeypatch.setenv("NEUSEE_CACHE", str(tmp_path / "cache"))
    with pytest.raises(SystemExit) as end:
        app.main([*shlex.split(words), "--out", str(tmp_path / "runs")])
    assert end.value.code == 0


# --- what pages say ---------------------------------------------------------------------------------------------------


@pytest.mark.parametrize(("page", "least"), [("README", 11), ("commands", 20), ("own_frames", 6), ("recipes", 6)])
def test_the_command_lines_are_found(page, least):
    assert len(next(lines(path) for path in WRITTEN if path.stem == page)) >= least


@pytest.mark.parametrize("words", ["runn", "study accurracy", "run --bogus", "evaluate --scenes none"])
def test_a_wrong_command_line_does_not_parse(words):
    with pytest.raises(Exception, match=r"(?i)no such|should be a valid|is not a valid"):
        parsed(words.split())


@pytest.mark.parametrize("page", WRITTEN, ids=lambda page: page.stem)
def test_every_command_that_is_named_exists(page):
    context = typer.Context(COMMANDS)
    for spoken in re.findall(r"`neusee ([^`]*)`", page.read_text(encoding="utf-8")):
        words = [word for word in shlex.split(spoken) if re.fullmatch("[a-z-]+", word) and not word.startswith("-")]
        if words:
            command = COMMANDS.get_command(context, words[0])
            assert command is not None, spoken
            if hasattr(command, "get_command") and words[1:]:
                assert command.get_command(context, words[1]) is not None, spoken


def test_the_page_of_commands_has_every_command():
    text = (GUIDE / "commands.md").read_text(encoding="utf-8")
    assert re.findall(r"^\| `neusee (\w+)` \|", text, re.MULTILINE) == COMMANDS.list_commands(typer.Context(COMMANDS))


@pytest.mark.parametrize("page", WRITTEN, ids=lambda page: page.stem)
def test_every_relative_link_resolves(page):
    links = re.findall(r"\]\((?!https?:|reference/)([^)#]+)", page.read_text(encoding="utf-8"))
    assert not [link for link in links if not (page.parent / link).is_file()]


def test_the_index_has_one_line_for_each_page():
    text = (GUIDE / "index.md").read_text(encoding="utf-8")
    assert sorted(re.findall(r"^- \[[\w ]+\]\((\w+)\.md\): .+\.$", text, re.MULTILINE)) == sorted(
        page.stem for page in PAGES if page.stem != "index"
    )


def test_the_gallery_has_a_section_with_command_picture_and_time_for_each_recipe():
    text = (GUIDE / "gallery.md").read_text(encoding="utf-8")
    sections = dict(re.findall(r"^## `(\w+)`\n(.*?)(?=^## )", text, re.MULTILINE | re.DOTALL))
    assert sorted(sections) == sorted(path.stem for path in (ROOT / "recipes").glob("*.yaml"))
    for name, section in sections.items():
        assert re.search(rf"^    neusee (run|train|safety) {name}\b", section, re.MULTILINE), name
        assert "<!-- picture " in section, name
        assert re.search(r"^Time: (\d+ s\b|half an hour|hours|days)", section, re.MULTILINE), name


def test_the_gallery_credits_each_picture_that_ships():
    credits = (GUIDE / "gallery.md").read_text(encoding="utf-8").partition("## Credits")[2]
    shown = {path.name for kind in ("jpg", "exr") for path in (ROOT / "recipes" / "samples").glob(f"*.{kind}")}
    assert shown
    assert not [name for name in shown if f"`{name}`" not in credits]


def test_the_readme_is_short_and_its_picture_small():
    text = README.read_text(encoding="utf-8")
    assert len(text.splitlines()) <= 100
    (picture,) = re.findall(r"!\[[^\]]+\]\(([^)]+)\)", text)
    assert (ROOT / picture).stat().st_size <= 100_000


def test_the_readme_says_the_two_commands_that_are_tested():
    tested = (ROOT / ".ci" / "run").read_text(encoding="utf-8")
    for command in ("pip install -e . && neusee run", 'pip install -e ".[test]" && pytest'):
        assert f"\n    {command}\n" in README.read_text(encoding="utf-8")
        assert f'say "README: {command.replace(chr(34), chr(92) + chr(34))}"' in tested


@pytest.mark.parametrize("code", cases(lambda page: blocks(page, "python")))
def test_every_python_block_compiles_and_its_names_exist(code):
    tree = ast.parse(code)
    modules = {}
    for item in (item for item in tree.body if isinstance(item, ast.ImportFrom | ast.Import)):
        for alias in item.names:
            module = importlib.import_module(item.module if isinstance(item, ast.ImportFrom) else alias.name)
            modules[alias.asname or alias.name] = getattr(module, alias.name) if hasattr(item, "module") else module
    for item in ast.walk(tree):
        if isinstance(item, ast.Attribute) and isinstance(item.value, ast.Name) and item.value.id in modules:
            assert hasattr(modules[item.value.id], item.attr), f"{item.value.id}.{item.attr}"
        if isinstance(item, ast.Name) and isinstance(item.ctx, ast.Load):
            assert item.id in modules or f"{item.id}" in assigned(tree), item.id


def assigned(tree: ast.Module) -> set[str]:
    """Return the names that a block gives values: by assignment, as a function or as an argument, and the built-ins."""
    names = {item.id for item in ast.walk(tree) if isinstance(item, ast.Name) and isinstance(item.ctx, ast.Store)}
    names |= {item.name for item in ast.walk(tree) if isinstance(item, ast.FunctionDef)}
    return names | {item.arg for item in ast.walk(tree) if isinstance(item, ast.arg)} | set(dir(builtins))


def test_the_glossary_has_one_whole_line_for_each_term():
    entries = [line for line in (GUIDE / "glossary.md").read_text(encoding="utf-8").splitlines() if line[:2] == "- "]
    assert not [line for line in entries if not TERM.fullmatch(line)]
    terms = [TERM.fullmatch(line)["term"].lower() for line in entries]
    assert 35 <= len(terms) <= 60
    assert len(set(terms)) == len(terms)


def test_neusee_nodes_glossary_prints_the_terms(capfd):
    with pytest.raises(SystemExit) as end:
        app.main(["nodes", "glossary"])
    out = capfd.readouterr().out
    assert not end.value.code
    assert "system gain (K, DN/e-): digital numbers" in out
    assert len(out.splitlines()) == len(catalogue.glossary_lines()) >= 35
    assert "*" not in out
