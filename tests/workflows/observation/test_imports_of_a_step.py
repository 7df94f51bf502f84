"""Imports in a step: installed packages read what they like, and modules of the user do not."""

import importlib
import sys

import pytest

from neusee.workflows.observation.observed_call import observed_import
from neusee.workflows.observation.taints import Covered


@pytest.fixture
def folder(tmp_path, monkeypatch):
    """A folder of modules of the user."""
    monkeypatch.syspath_prepend(tmp_path)
    known = set(sys.modules)
    yield tmp_path
    for name in set(sys.modules) - known:
        if str(getattr(sys.modules[name], "__file__", "")).startswith(str(tmp_path)):
            del sys.modules[name]


def written(folder, name, text):
    (folder / f"{name}.py").write_text(text)
    importlib.invalidate_caches()


#: modules that few other tests import; the first draws and starts programs
PACKAGES = ("uuid", "multiprocessing.managers", "xml.dom.minidom", "scipy.cluster.hierarchy")


@pytest.mark.parametrize("module", PACKAGES)
def test_an_installed_package_that_is_imported_late_is_none(module, taints, layer, monkeypatch):
    for name in [name for name in sys.modules if name.partition(".")[0] == "uuid"]:
        monkeypatch.delitem(sys.modules, name)
    assert taints(lambda: importlib.import_module(module)) == []


@pytest.fixture
def configured(tmp_path, monkeypatch):
    """An installed library that reads its settings, a cache and a table of its own while it is
    imported.
    """
    site, settings, cache = (
        tmp_path / "site",
        tmp_path / "settings.cfg",
        tmp_path / "cache" / "fonts.json",
    )
    (site / "configured_library-1.0.dist-info").mkdir(parents=True)
    (site / "own_table.txt").write_text("1")
    cache.parent.mkdir()
    cache.write_text("2")
    code = (
        "import pathlib\nhere = pathlib.Path(__file__)\ntable = (here.parent /"
        " 'own_table.txt').read_text()\n"
    )
    code += (
        f"fonts = pathlib.Path({str(cache)!r}).read_text()\nsettings ="
        f" pathlib.Path({str(settings)!r})\n"
    )
    code += "gain = settings.read_text() if settings.exists() else '0'\n"
    (site / "configured_library.py").write_text(code)
    monkeypatch.syspath_prepend(site)
    monkeypatch.setenv("XDG_CACHE_HOME", str(tmp_path / "cache"))
    yield settings
    sys.modules.pop("configured_library", None)


def test_settings_that_a_library_reads_when_it_is_imported_are_found(configured, taints, layer):
    # there are none
    assert taints(lambda: importlib.import_module("configured_library").gain) == []
    del sys.modules["configured_library"]
    configured.write_text("# gain: 5\n\n  # no more\n")
    assert taints(lambda: importlib.import_module("configured_library").gain) == []
    del sys.modules["configured_library"]
    configured.write_text("# gain\n5")
    assert taints(lambda: importlib.import_module("configured_library").gain) == [
        ("file", "settings.cfg")
    ]


def test_declared_settings_of_a_library_are_none(configured, taints, layer):
    configured.write_text("5")
    found = taints(lambda: importlib.import_module("configured_library").gain, configured)
    assert found == []


def test_a_package_that_is_not_installed_is_none(taints, layer):
    def step():
        with pytest.raises(ModuleNotFoundError):
            import no_such_package  # noqa: F401

    assert taints(step) == []


def test_a_module_of_the_user_that_the_key_follows_is_none(folder, taints, layer):
    written(folder, "followed", "import json, followed_too\nx = followed_too.x")
    written(folder, "followed_too", "x = 3")
    assert taints(lambda: importlib.import_module("followed").x) == []
    del sys.modules["followed"]
    assert taints(lambda: importlib.import_module("followed").x) == []  # now from its byte code


def test_a_module_that_the_key_does_not_follow_is_found(folder, taints, layer):
    written(folder, "unknown", "x = 3")
    found = taints(
        lambda: importlib.import_module("unknown"), modules=lambda name: name != "unknown"
    )
    assert ("import", "unknown") in found


def test_what_a_module_of_the_user_reads_when_it_is_imported_is_found(folder, taints, layer):
    (folder / "gain.csv").write_text("2")
    written(folder, "reading", f"import fractions\nx = open({str(folder / 'gain.csv')!r}).close()")
    assert taints(lambda: importlib.import_module("reading")) == [("file", "gain.csv")]


def test_what_a_module_of_the_user_draws_when_it_is_imported_is_found(folder, layer):
    written(folder, "drawing", "import numpy as np\nx = np.random.default_rng().normal()")
    module, taints = observed_import(
        lambda: importlib.import_module("drawing"), Covered(frozenset(), lambda name: True)
    )
    assert module.__name__ == "drawing"
    assert [each.kind for each in taints] == ["random"]


def test_a_search_for_files_beside_the_import_is_found(folder, taints, layer):
    written(folder, "listing", "import os\nx = os.listdir(os.path.dirname(__file__))")
    assert taints(lambda: importlib.import_module("listing")) == [("folder", ".")]


def test_an_import_that_fails_says_why(folder, taints):
    written(folder, "failing", "import json\n1 / 0")
    with pytest.raises(ZeroDivisionError):
        taints(lambda: importlib.import_module("failing"))
    assert taints(lambda: None) == []


def test_the_functions_of_python_are_what_they_were(taints, layer):
    import os
    import random
    import threading

    def functions():
        bootstrap = importlib._bootstrap
        return (
            bootstrap._find_and_load,
            bootstrap._call_with_frames_removed,
            os.urandom,
            random._urandom,
            random.Random.seed,
            threading.Thread.start,
        )

    before = functions()
    assert taints(lambda: functions() == before) == []
    assert functions() == before
