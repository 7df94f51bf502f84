"""The folder of a cache that several real users share."""

import os
import shutil
import subprocess
import tempfile
from pathlib import Path

import pytest

from tests.workflows.store.other_users import FIRST, GROUP, STRANGER, command_of


@pytest.fixture
def place():
    """A folder that every user may enter."""
    folder = Path(tempfile.mkdtemp(prefix="neusee-users-"))
    folder.chmod(0o755)
    yield folder
    shutil.rmtree(folder)


@pytest.fixture
def cache(place):
    if not hasattr(os, "geteuid") or os.geteuid() != 0:
        pytest.skip("only root can start processes of other users")
    if not (shutil.which("unshare") and shutil.which("setpriv")):
        pytest.skip("there is no unshare and setpriv of util-linux")
    tried = subprocess.run(
        command_of(place, STRANGER, "", 0o022, "import neusee"), capture_output=True, text=True, cwd="/"
    )
    if tried.returncode:
        pytest.skip(f"other users cannot read this Python, and mounts are not allowed: {tried.stderr[-200:]}")
    folder = place / "cache"
    folder.mkdir()
    os.chown(folder, FIRST, GROUP)
    return folder
