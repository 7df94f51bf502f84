"""A cache of a group: real users of one group store and load, and a user without rights harms
nothing.
"""

import json
import os

import pytest

from tests.workflows.store.other_users import FIRST, GROUP, SECOND, STRANGER, who

RUN = """
import json, sys, warnings
from pathlib import Path

from neusee.workflows import load
from neusee.workflows.engine.runner import run
from neusee.workflows.store.derived_files import DerivedFiles
from neusee.workflows.store.result_store import Store

small = ["optics.samples=64", "optics.pitch=120 um", "optics.window=[32, 32]", "optics.bands=3", "scene.shape=[32, 32]",
         "sensor.shape=[24, 24]", "restore=null", "steps.restored_quality=null", "outputs=[raw, lsr]", "expect={}"]
with warnings.catch_warnings(record=True) as caught:
    warnings.simplefilter("always")
    store = Store(sys.argv[1])
    result = run(load("first_light", [*small, *sys.argv[2:]]), store)
    DerivedFiles(store).keep(f"{len(sys.argv):032x}", ".txt", "a file", lambda path: path.write_text("words"))
states = {name: record.state for name, record in result.done.items()}
print(json.dumps({"states": states, "kept": [r.kept for r in result.done.values() if r.state == "run"],
                  "warnings": [str(each.message) for each in caught if "is not compiled" not in str(each.message)]}))
"""


@pytest.fixture
def as_user(users):
    """What a user's process says of a run with a cache; its own group is not that of the cache."""

    def as_user(user, cache, *words, groups=(GROUP,), umask=0o022):
        home = cache.parent / f"home-{user}"
        if not home.exists():
            home.mkdir()
            os.chown(home, user, user)
        environment = {**os.environ, "HOME": str(home), "OMP_NUM_THREADS": "1"}
        environment["CXX"] = "/bin/false"  # a new user has no compiled code
        environment.pop("NEUSEE_CACHE", None)
        rights = who(user, groups, umask)
        done = users(str(cache), *words, cwd=home, env=environment, code=RUN, user=rights)
        assert done.returncode == 0, done.stderr
        return json.loads(done.stdout)

    return as_user


def owners(cache):
    return {file.stat().st_uid for file in cache.rglob("*") if file.is_file()}


@pytest.mark.slow
@pytest.mark.parametrize(
    ("mode", "umask"),
    [(0o2775, 0o022), (0o775, 0o022), (0o2770, 0o077)],
    ids=["a group folder", "without the bit that hands the group on", "for the group alone"],
)
def test_two_users_of_a_group_store_and_load(as_user, cache, mode, umask):
    cache.chmod(mode)
    first = as_user(FIRST, cache, umask=umask)
    second = as_user(SECOND, cache, "sensor.read_noise=20 e-", umask=umask)
    assert first["warnings"] == second["warnings"] == []
    assert "cached" in second["states"].values(), "the second user loads what the first one stored"
    assert second["kept"], "one changed value is computed"
    assert {FIRST, SECOND} <= owners(cache), "the second user stores"
    results = [path for path in cache.rglob("*") if path.parent.name != "tmp"]
    assert {path.stat().st_gid for path in results} == {GROUP}
    again = as_user(FIRST, cache, "sensor.read_noise=20 e-", umask=umask)
    assert set(again["states"].values()) <= {"cached", "not needed", "left out"}
    assert again["warnings"] == []


@pytest.mark.slow
def test_a_user_without_rights_reads_and_harms_nothing(as_user, cache):
    cache.chmod(0o2775)
    as_user(FIRST, cache)
    before = {
        path: (path.stat().st_mtime_ns, path.stat().st_size)
        for path in cache.rglob("*")
        if path.is_file()
    }
    stranger = as_user(STRANGER, cache, groups=())
    assert set(stranger["states"].values()) <= {"cached", "not needed", "left out"}
    changed = as_user(STRANGER, cache, "sensor.read_noise=20 e-", groups=())
    assert "run" in changed["states"].values()
    assert {
        path: (path.stat().st_mtime_ns, path.stat().st_size)
        for path in cache.rglob("*")
        if path.is_file()
    } == before
    hidden = cache.parent / "hidden"
    hidden.mkdir(mode=0o700)
    assert "run" in as_user(STRANGER, hidden, groups=())["states"].values(), (
        "a cache that cannot be read stops no run"
    )


@pytest.mark.slow
def test_the_folder_of_the_cache_may_be_read_only_to_its_own_user(as_user, cache):
    cache.chmod(0o2775)
    as_user(FIRST, cache)
    cache.chmod(0o555)
    for folder in [cache, *(path for path in cache.rglob("*") if path.is_dir())]:
        folder.chmod(0o555)
    again = as_user(SECOND, cache)
    assert set(again["states"].values()) <= {"cached", "not needed", "left out"}
