"""What `neusee.workflows` offers, and that offering it costs no import."""

import subprocess
import sys

import pytest

import neusee.workflows


@pytest.mark.parametrize("name", neusee.workflows.__all__)
def test_every_public_name_is_there(name):
    assert getattr(neusee.workflows, name).__name__ == name
    assert name in dir(neusee.workflows)


def test_an_unknown_name_is_an_attribute_error():
    with pytest.raises(AttributeError, match="no attribute 'sweeep'"):
        _ = neusee.workflows.sweeep


def test_importing_it_loads_no_torch():
    code = "import sys, neusee.workflows; raise SystemExit('torch' in sys.modules)"
    assert subprocess.run([sys.executable, "-c", code], check=False).returncode == 0
