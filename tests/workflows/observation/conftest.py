import os

import pytest

from neusee.workflows.observation import kernel_layer
from neusee.workflows.observation.observed_call import observed
from neusee.workflows.observation.taints import Covered


@pytest.fixture
def watched():
    """Whether the kernel watches steps here; a test that asks is skipped where it does not."""
    if kernel_layer.missing():
        pytest.skip(kernel_layer.missing())


@pytest.fixture
def unwatched(monkeypatch):
    """As if the kernel offered nothing: the audit hook alone sees what a step reaches."""
    monkeypatch.setattr(kernel_layer, "missing", lambda: "left out by a test")


@pytest.fixture(params=["kernel", "python"])
def layer(request):
    """Each of the two layers that see files, alone."""
    request.getfixturevalue("watched" if request.param == "kernel" else "unwatched")
    return request.param


@pytest.fixture
def taints(tmp_path):
    """What a function reaches that is not covered: pairs of a kind and a path, below the folder of
    the test if it is.

    The key follows all modules, and knows the files that are given.
    """

    def taints(function, *files, modules=lambda name: True):
        found = observed(function, Covered(frozenset(files), modules))[1]
        return [
            (
                each.kind,
                os.path.relpath(each.what, tmp_path) if _in(each.what, tmp_path) else each.what,
            )
            for each in found
        ]

    return taints


def _in(what, folder):
    return what.startswith(f"{folder}/") or what == str(folder)
