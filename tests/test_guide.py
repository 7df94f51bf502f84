"""The README and the guide: commands parse, recipes load, links resolve, Python names exist, the
glossary is whole.
"""

from __future__ import annotations

import ast
import builtins
import importlib
import re
import shlex
from pathlib import Path

import pytest
import typer
from typer.main import get_command

from neusee.workflows.cli import app, catalogue
from neusee.workflows.cli.command_frame import split
from neusee.workflows.evaluation.pipelines import (
    NamedRecipe,
    compose_pipelines,
    read_pipelines,
    read_settings,
)
from neusee.workflows.placement.machine_file import read_machines
from neusee.workflows.recipe.loading import load
from neusee.workflows.sweeps.axes import points, read_words
from tests.guide_commands import (
    GUIDE,
    PAGES,
    ROOT,
    WRITTEN,
    blocks,
    cases,
    forgotten_modules,
    import_or_skip,
    lines,
    write_reader_files,
)

README = ROOT / "README.md"

COMMANDS = get_command(app.app)
#: these commands take a recipe in words
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
}
TERM = re.compile(r"- \*\*(?P<term>[^*]+)\*\*(?: \([^)]*(?:\([^)]*\))?[^)]*\))?: .+\. [^.].*\.")

pytestmark = pytest.mark.filterwarnings("ignore::DeprecationWarning:typer")


@pytest.fixture(scope="module")
def folder(tmp_path_factory):
    """A working folder with every file that the pages speak of."""
    folder = tmp_path_factory.mktemp("guide")
    write_reader_files(folder)
    with forgotten_modules(folder):
        yield folder


def parsed(words: list[str]) -> tuple[str, dict]:
    """Return the path of a command and its values, parsed and not run."""
    context, command = (
        COMMANDS.make_context("neusee", list(words), resilient_parsing=False),
        COMMANDS,
    )
    path, rest = [], list(words)
    while hasattr(command, "resolve_command"):
        name, command, rest = command.resolve_command(context, rest)
        path.append(name)
        context = command.make_context(name, list(rest), parent=context)
    return " ".join(path), context.params


@pytest.mark.slow
def test_every_command_line_parses_and_its_recipe_loads(folder, monkeypatch):
    monkeypatch.chdir(folder)
    wrong = []
    for case in cases(lines):
        try:
            parse_and_load(*case.values, folder)
        except (Exception, SystemExit) as error:
            wrong.append(f"{case.id}, {case.values[0]}: {error!r}")
    assert not wrong, "\n".join(wrong)


def parse_and_load(words: str, folder: Path) -> None:
    """Parse a command line and load its recipe, as the command would."""
    command, values = parsed(shlex.split(words))
    if command.split()[0] not in {*LOADS, "sweep"}:
        return
    given = values["words"] or (["train_small"] if command == "train" else [])
    name, changes, first = split(given)
    if command == "calibrate" and (folder / name).is_dir():  # its recipe follows from the frames
        return
    if command == "sweep":
        for point in points(read_words(changes, folder, first), values["paired"]):
            load(name, point.overrides, folder)
        return
    recipe = load(name, changes, folder)
    if command == "why":
        assert any(
            step.partition("[")[0] == values["step"].partition("[")[0] for step in recipe.steps
        )
    if command == "plan" and values["devices"]:
        assert read_machines(values["devices"]).devices
    if command == "train":
        assert recipe.training or recipe.lifting
    if command == "evaluate":
        asked = values["pipelines"] or read_settings(NamedRecipe(name, changes, folder)).pipelines
        compose_pipelines(NamedRecipe(name, changes, folder), read_pipelines(asked, folder))


# --- what pages say -------------------------------------------------------------------------------


@pytest.mark.parametrize(
    ("page", "least"), [("README", 11), ("commands", 20), ("own_frames", 6), ("recipes", 6)]
)
def test_the_command_lines_are_found(page, least):
    assert len(next(lines(path) for path in WRITTEN if path.stem == page)) >= least


@pytest.mark.parametrize(
    "words", ["runn", "study accurracy", "run --bogus", "evaluate --scenes none"]
)
def test_a_wrong_command_line_does_not_parse(words):
    with pytest.raises(Exception, match=r"(?i)no such|should be a valid|is not a valid"):
        parsed(words.split())


def test_every_command_that_is_named_exists():
    context = typer.Context(COMMANDS)
    texts = "\n".join(page.read_text(encoding="utf-8") for page in WRITTEN)
    for spoken in re.findall(r"`neusee ([^`]*)`", texts):
        words = [
            word
            for word in shlex.split(spoken)
            if re.fullmatch("[a-z-]+", word) and not word.startswith("-")
        ]
        if words:
            command = COMMANDS.get_command(context, words[0])
            assert command is not None, spoken
            if hasattr(command, "get_command") and words[1:]:
                assert command.get_command(context, words[1]) is not None, spoken


def test_the_page_of_commands_has_every_command():
    text = (GUIDE / "commands.md").read_text(encoding="utf-8")
    assert re.findall(r"^\| `neusee (\w+)` \|", text, re.MULTILINE) == COMMANDS.list_commands(
        typer.Context(COMMANDS)
    )


def test_every_relative_link_resolves():
    links = [
        (page, link)
        for page in WRITTEN
        for link in re.findall(
            r"\]\((?!https?:|reference/)([^)#]+)", page.read_text(encoding="utf-8")
        )
    ]
    assert not [(page.name, link) for page, link in links if not (page.parent / link).is_file()]


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
        assert re.search(
            rf"^    neusee (run|train|safety|evaluate) {name}\b", section, re.MULTILINE
        ), name
        assert "<!-- picture " in section, name
        assert re.search(r"^Time: (\d+ s\b|half an hour|hours|days)", section, re.MULTILINE), name


def test_the_gallery_credits_each_picture_that_ships():
    credits = (GUIDE / "gallery.md").read_text(encoding="utf-8").partition("## Credits")[2]
    shown = {
        path.name
        for kind in ("jpg", "exr")
        for path in (ROOT / "recipes" / "samples").glob(f"*.{kind}")
    }
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


def imported(module, name):
    """Return what ``from module import name`` gives: an attribute, or else a module inside."""
    found = importlib.import_module(module)
    if not hasattr(found, name):
        return importlib.import_module(f"{module}.{name}")
    return getattr(found, name)


@pytest.mark.parametrize("code", cases(lambda page: blocks(page, "python")))
def test_every_python_block_compiles_and_its_names_exist(code):
    tree = ast.parse(code)
    import_or_skip(code)
    modules = {}
    for item in tree.body:
        if isinstance(item, ast.Import):
            for alias in item.names:
                modules[alias.asname or alias.name] = importlib.import_module(alias.name)
        elif isinstance(item, ast.ImportFrom):
            for alias in item.names:
                modules[alias.asname or alias.name] = imported(item.module, alias.name)
    for item in ast.walk(tree):
        if (
            isinstance(item, ast.Attribute)
            and isinstance(item.value, ast.Name)
            and item.value.id in modules
        ):
            assert hasattr(modules[item.value.id], item.attr), f"{item.value.id}.{item.attr}"
        if isinstance(item, ast.Name) and isinstance(item.ctx, ast.Load):
            assert item.id in modules or f"{item.id}" in assigned(tree), item.id


def assigned(tree: ast.Module) -> set[str]:
    """Return the names that a block gives values: by assignment, as a function or as an
    argument, and the built-ins.
    """
    names = {
        item.id
        for item in ast.walk(tree)
        if isinstance(item, ast.Name) and isinstance(item.ctx, ast.Store)
    }
    names |= {item.name for item in ast.walk(tree) if isinstance(item, ast.FunctionDef)}
    return (
        names
        | {item.arg for item in ast.walk(tree) if isinstance(item, ast.arg)}
        | set(dir(builtins))
    )


def test_the_glossary_has_one_whole_line_for_each_term():
    entries = [
        line
        for line in (GUIDE / "glossary.md").read_text(encoding="utf-8").splitlines()
        if line[:2] == "- "
    ]
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
