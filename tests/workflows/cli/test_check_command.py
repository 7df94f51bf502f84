"""`neusee check` makes each call in other surroundings too, and ends with 3 where these decide a
result.
"""

import json
import sys

import pytest
from typer.testing import CliRunner

from neusee.workflows.cli.app import app
from neusee.workflows.cli.project_commands import KINDS

ZONE = """
import time

import torch
from torch import Tensor

from neusee.nodes import node


@node()
def zoned(x: Tensor) -> Tensor:
    \"\"\"Multiply by the hour.\"\"\"
    return x * (1 + time.localtime(0).tm_hour)


@zoned.example
def _():
    return {"x": torch.ones(3)}
"""


@pytest.fixture
def here(tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    monkeypatch.setattr(sys, "path", list(sys.path))
    monkeypatch.setenv("TZ", "UTC")
    return tmp_path


@pytest.mark.slow
def test_a_result_that_depends_on_the_time_zone_ends_a_check_with_three(here):
    (here / "zoned_check.py").write_text(ZONE)
    found = CliRunner().invoke(app, ["check", "zoned_check.py"])
    assert found.exit_code == 3
    [line] = [line for line in found.output.splitlines() if "elsewhere" in line]
    assert (
        line
        == "  FAIL  elsewhere    zoned_check.py:10: in another time zone (TZ) the result differs by"
        " 13 of its largest value: compute in UTC: calendar.timegm and time.gmtime, or datetime"
        " with tzinfo=timezone.utc"
    )


@pytest.mark.slow
@pytest.mark.parametrize(
    "kind", [kind for kind, (_, commands) in KINDS.items() if "neusee check NAME.py" in commands]
)
def test_what_neusee_new_writes_gives_the_same_bits_elsewhere(here, kind):
    name = f"new_{kind}_elsewhere"
    assert CliRunner().invoke(app, ["new", kind, name]).exit_code == 0
    found = CliRunner().invoke(app, ["check", f"{name}.py", "--json"])
    assert found.exit_code == 0, found.output
    [findings] = json.loads(found.output).values()
    [elsewhere] = [each for each in findings if each["rule"] == "elsewhere"]
    assert elsewhere["ok"] is True
    assert "changed surroundings: folder, " in elsewhere["text"]
    assert elsewhere["text"].endswith("the clock was not changed")


def test_a_place_without_nodes_ends_the_other_process_too(here):
    found = CliRunner().invoke(app, ["check", "nosuch.py"])
    assert found.exit_code == 2
    assert "there is no file" in found.output
