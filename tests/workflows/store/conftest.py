"""The folder of a cache that several real users share."""

import os
import shutil
import tempfile
from pathlib import Path

import pytest

from tests.workflows.store.other_users import FIRST, GROUP, STRANGER, forks_of_users, who


@pytest.fixture
def place():
    """A folder that every user may enter."""
    folder = Path(tempfile.mkdtemp(prefix="neusee-users-"))
    folder.chmod(0o755)
    yield folder
    shutil.rmtree(folder)


@pytest.fixture(scope="module")
def users():
    """A server of commands of several users."""
    if not hasattr(os, "geteuid") or os.geteuid() != 0:
        pytest.skip("only root can start processes of other users")
    if not shutil.which("unshare"):
        pytest.skip("there is no unshare of util-linux")
    folder = tempfile.mkdtemp(prefix="neusee-users-")
    os.chmod(folder, 0o755)
    forks = forks_of_users(folder)
    code = (
        "import neusee, os, torch, PIL\n[os.listdir(m.__path__[0]) for m in (neusee, torch, PIL)]"
    )
    try:
        tried = forks(cwd="/", env=os.environ, code=code, user=who(STRANGER, ()))
        assert tried.returncode == 0, tried.stderr[-200:]
    except (AssertionError, OSError, ValueError) as error:
        pytest.skip(f"other users cannot read this Python, and mounts are not allowed: {error}")
    yield forks
    forks.close()
    shutil.rmtree(folder)


@pytest.fixture
def cache(place, users):
    folder = place / "cache"
    folder.mkdir()
    os.chown(folder, FIRST, GROUP)
    return folder
