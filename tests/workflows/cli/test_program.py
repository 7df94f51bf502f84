"""The program as a whole: its version, help of every command, and completion in a shell."""

import os
import subprocess
import sys

import pytest
import typer

import neusee
from neusee.workflows.cli import app


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
    assert [name for option in found.params for name in option.opts if name.startswith("--") and name not in text] == []


def test_the_list_of_commands_is_whole(said):
    text = said("--help")
    assert said("-h") == text
    assert "--version" in text
    listed = [line.split()[0] for line in text.partition("Commands:")[2].strip().partition("\n\n")[0].splitlines()]
    assert listed == list(WHOLE.commands)


def test_the_version_is_that_of_the_package(said):
    assert said("--version") == f"neusee {neusee.__version__}\n"


@pytest.mark.parametrize("module", ["neusee", "neusee.workflows.cli"])
def test_python_runs_it_as_a_module(module):
    done = subprocess.run([sys.executable, "-m", module, "--version"], capture_output=True, text=True, check=True)
    assert done.stdout == f"neusee {neusee.__version__}\n"


@pytest.mark.parametrize(
    ("line", "offered"),
    [("neusee ru", {"run"}), ("neusee study le", {"leave-out"}), ("neusee run --exa", {"--exact"})],
)
def test_a_shell_completes_commands_and_options(line, offered):
    asked = {"_NEUSEE_COMPLETE": "complete_bash", "COMP_WORDS": line, "COMP_CWORD": str(line.count(" "))}
    program = [sys.executable, "-m", "neusee"]
    done = subprocess.run(program, env={**os.environ, **asked}, capture_output=True, text=True, check=False)
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
