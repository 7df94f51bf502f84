"""What tests of families of nodes share."""

import sys

import pytest

import neusee.nodes.own_modules as own_modules
from neusee.workflows.recipe import node_families
from tests.workflows.recipe.both_ways import checked_both_ways as checked_both_ways


@pytest.fixture
def forget():
    """Forget what a test imports, so that another test may give the same name to another file."""
    before, path = set(sys.modules), list(sys.path)
    yield
    for name in set(sys.modules) - before:
        if not name.startswith(("neusee", "torch", "numpy")):
            del sys.modules[name]
    sys.path[:] = path
    own_modules._files.clear()
    node_families._family_of.clear()
    node_families._installed.cache_clear()
