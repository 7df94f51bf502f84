"""The program as a whole: its version, help of every command, and completion in a shell."""

import gc
import importlib
import inspect
import os
import subprocess
import sys
from pathlib import Path

import pytest
import typer

import neusee
from neusee.workflows.cli import app, commands_and_exit_codes, program_options


def commands(group, *before):
    """Yield the words of every command and group of commands."""
    for name, found in group.commands.items():
        yield (*before, name)
        if hasattr(found, "commands"):
            yield from commands(found, *before, name)


WHOLE = typer.main.get_command(app.app)
COMMANDS = list(commands(WHOLE))


@pytest.fixture
def said(capsys):
    """Call the program and return what it prints; it must end well."""

    def said(*words):
        with pytest.raises(SystemExit) as end:
            app.main(list(words))
        assert end.value.code == 0
        return capsys.readouterr().out

    return said


def test_the_walk_finds_commands_and_those_of_groups():
    assert {("run",), ("sweep",), ("cache", "gc"), ("study", "uncertainty")} <= set(COMMANDS)


@pytest.mark.parametrize("words", COMMANDS, ids=" ".join)
def test_every_command_has_both_words_for_help(words, said):
    assert said(*words, "-h") == said(*words, "--help")


@pytest.mark.parametrize("words", COMMANDS, ids=" ".join)
def test_help_names_every_option_of_the_command_although_others_are_not_read(words, said):
    found = WHOLE
    for word in words:
        found = found.commands[word]
    text = said(*words, "-h")
    assert f"Usage: neusee {' '.join(words)} " in text
    assert " ".join(found.help.split("\n\n")[0].split()) in " ".join(text.split())
    assert [
        name
        for option in found.params
        for name in option.opts
        if name.startswith("--") and name not in text
    ] == []


def test_the_list_of_commands_is_whole(said):
    text = said("--help")
    assert said("-h") == text
    assert "--version" in text
    listed = [
        line.split()[0]
        for line in text.partition("Commands:")[2].strip().partition("\n\n")[0].splitlines()
    ]
    assert listed == list(WHOLE.commands)


@pytest.mark.parametrize("name", commands_and_exit_codes.COMMANDS)
def test_the_list_has_the_first_line_of_the_help_of_a_command(name):
    module, text = commands_and_exit_codes.COMMANDS[name]
    command = getattr(importlib.import_module(f"neusee.workflows.cli.{module}"), name)
    own = command.info.help if isinstance(command, typer.Typer) else inspect.getdoc(command)
    assert own.partition("\n")[0] == text


@pytest.mark.parametrize("columns", ["80", "81", "200"])
def test_the_page_of_help_is_that_of_typer_to_the_letter(columns, said, capsys, monkeypatch):
    monkeypatch.setenv("COLUMNS", columns)
    assert program_options.run_program(["--help"], False) == 0
    page = capsys.readouterr().out
    assert said("--help") == page == f"{commands_and_exit_codes.help_page()}\n"


@pytest.mark.parametrize("columns", ["79", "60", "20"])
def test_a_narrow_terminal_gets_the_page_from_typer(columns, said, monkeypatch):
    monkeypatch.setenv("COLUMNS", columns)
    text = said("--help")
    assert text != f"{commands_and_exit_codes.help_page()}\n"
    assert max(map(len, text.splitlines())) <= max(50, int(columns) - 2)


def test_the_page_of_help_needs_nothing_but_the_standard_library():
    path = str(Path(neusee.__file__).parents[1])  # -S keeps away the installed packages
    done = subprocess.run(
        [sys.executable, "-S", "-m", "neusee", "--help"],
        env={"PYTHONPATH": path},
        capture_output=True,
        text=True,
    )
    assert (done.stdout, done.stderr) == (f"{commands_and_exit_codes.help_page()}\n", "")


@pytest.mark.parametrize("name", ["run", "nodes", "study", "cache"])
def test_the_help_of_a_command_imports_no_other_command(name):
    own = commands_and_exit_codes.COMMANDS[name][0]
    others = {
        f"neusee.workflows.cli.{module}"
        for module, _ in commands_and_exit_codes.COMMANDS.values()
        if module != own
    }
    code = (
        "import sys\nfrom neusee.workflows.cli.app import main\n"
        f"try: main({[name, '--help']!r})\nexcept SystemExit: pass\n"
        f"assert not {others | {'torch', 'rich'}!r} & set(sys.modules)"
    )
    done = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=False)
    assert done.returncode == 0, done.stderr


def test_a_name_that_the_program_lacks_is_an_attribute_error():
    with pytest.raises(AttributeError, match="has no attribute 'ap'"):
        _ = app.ap


def test_the_version_is_that_of_the_package(said):
    assert said("--version") == f"neusee {neusee.__version__}\n"


@pytest.mark.parametrize("module", ["neusee", "neusee.workflows.cli"])
def test_python_runs_it_as_a_module(module):
    done = subprocess.run(
        [sys.executable, "-m", module, "--version"], capture_output=True, text=True, check=True
    )
    assert done.stdout == f"neusee {neusee.__version__}\n"


@pytest.mark.parametrize(
    ("line", "offered"),
    [("neusee ru", {"run"}), ("neusee study le", {"leave-out"}), ("neusee run --exa", {"--exact"})],
)
def test_a_shell_completes_commands_and_options(line, offered):
    asked = {
        "_NEUSEE_COMPLETE": "complete_bash",
        "COMP_WORDS": line,
        "COMP_CWORD": str(line.count(" ")),
    }
    program = [sys.executable, "-m", "neusee"]
    done = subprocess.run(
        program, env={**os.environ, **asked}, capture_output=True, text=True, check=False
    )
    assert set(done.stdout.split()) == offered
    assert done.stderr == ""


@pytest.mark.parametrize("shell", ["bash", "zsh", "fish"])
def test_the_script_of_a_shell_asks_this_program(shell, tmp_path):
    """The name of the shell is given, as it is where it cannot be read from the processes above."""
    env = {**os.environ, "_TYPER_COMPLETE_TEST_DISABLE_SHELL_DETECTION": "1"}
    done = subprocess.run(
        [sys.executable, "-m", "neusee", "--show-completion", shell],
        env=env,
        capture_output=True,
        text=True,
        check=True,
    )
    assert "_NEUSEE_COMPLETE" in done.stdout
    assert f"complete_{shell}" in done.stdout


def test_a_call_from_python_leaves_its_search_for_garbage(said):
    assert gc.isenabled()
    said("run", "--help")
    assert gc.isenabled()
