"""Caches with obstacles in the place of files: no user waits for one, reads something wrong or
changes what is not its.

Real users read a read-only cache beside their own one, a folder of their group, and a folder at a
URL.
"""

import json
import os
import shutil
import socket
from pathlib import Path

import pytest

from neusee.workflows.store.remote_store import RemoteStore
from tests.workflows.store.other_users import FIRST, GROUP, SECOND, STRANGER, who
from tests.workflows.store.whole_cache import ABOUT, fill, key_of, values_of

PATIENCE = 300  #: s until a process that waits counts as blocked

TRY = """
import json, signal, sys, warnings
from pathlib import Path

from neusee.workflows.store import lease
from neusee.workflows.store.remote_store import RemoteStore
from neusee.workflows.store.result_store import Store
from tests.workflows.store.whole_cache import ABOUT, KINDS, believed, bytes_in, fill, got, key_of, values_of

how, home, patience, *folders = sys.argv[1:]
lease.WINDOW = 0.0

def of_folder(folder, own):
    said = believed(folder, (1,))[0]
    store = Store(folder)
    while store.claim(key_of("payload", 1)) is None:
        pass
    fill(folder, (1,))
    again = believed(folder, (1,))[0]
    return {n: [said[n], again[n]] for n in said if n.startswith(("value", "picture", "answer", "definitions"))}

def of_url(folder, own):
    store = RemoteStore(f"file://{folder}", own)
    keys = {f"value {kind} 1": key_of(kind, 1) for kind in ("payload", "inline")}
    said = {name: bytes_in(got(store, key)) for name, key in keys.items()}
    list(store.entries())
    for kind, value in values_of(1, 0).items():
        store.put(key_of(kind, 1), value, ABOUT)
        store.put(key_of(kind, 2), value, ABOUT)
    store.put_receipt(key_of("receipt", 2), ABOUT)
    here = Store(own)
    return {name: [said[name], bytes_in(got(here, key))] for name, key in keys.items()}

for number, folder in enumerate(folders):
    signal.alarm(int(patience))
    print(folder, end=" ", flush=True)
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")
        said = {"folder": of_folder, "url": of_url}[how](Path(folder), Path(home) / f"own{number}")
    print(json.dumps({n: [repr(each) for each in pair] for n, pair in said.items()}), flush=True)
"""


@pytest.fixture
def tried(users):
    """What a user's process says of caches, by folder: before and after it stored the values
    itself.
    """

    def tried(user, how, folders, groups=(GROUP,)):
        home = folders[0].parents[1] / f"home-{user}"
        home.mkdir(exist_ok=True)
        os.chown(home, user, user)
        environment = {**os.environ, "HOME": str(home), "OMP_NUM_THREADS": "1"}
        words = [how, str(home), str(PATIENCE), *map(str, folders)]
        done = users(*words, cwd=home, env=environment, code=TRY, user=who(user, groups))
        lines = done.stdout.splitlines()
        assert done.returncode == 0, f"{lines[-1:]}: {done.stderr[-2000:]}"
        return {Path(line.partition(" ")[0]): json.loads(line.partition(" ")[2]) for line in lines}

    return tried


def socket_at(path):
    """Leave a socket in the place of a file; the name is short, because that of a socket must
    be.
    """
    before = Path.cwd()
    os.chdir(path.parent)
    try:
        with socket.socket(socket.AF_UNIX) as made:
            made.bind(path.name[:50])
            Path(path.name[:50]).rename(path.name)
    finally:
        os.chdir(before)


def device_at(path):
    os.mknod(path, 0o666 | 0o020000, os.makedev(1, 5))  # that of /dev/zero, which never ends


OBSTACLES = {
    "pipe": os.mkfifo,
    "socket": socket_at,
    "folder": os.mkdir,
    "link in a circle": lambda path: path.symlink_to(path.name),
    "link to a device": lambda path: path.symlink_to("/dev/zero"),
    "device": device_at,
}


def owned(root, user=FIRST):
    """Give a cache to a user and a group, with the permissions that such a cache has."""
    for path in (root, *root.rglob("*")):
        os.chown(path, user, GROUP, follow_symlinks=False)
        if path.is_dir():
            path.chmod(0o2775)


def places(root, more=()):
    """Every path of the layout of a cache, the folders among them, and some that only other
    processes make.
    """
    found = [
        path.relative_to(root) for path in root.rglob("*") if not path.name.startswith("badge")
    ]
    return sorted({*found, *map(Path, more)})


MORE = (
    "tmp/.lock",
    f"tmp/{key_of('payload', 1)}.lease",
    "pins",
    "bad",
    f"pins/{key_of('payload', 1)}",
    "posterior",
)


def obstructed(right, folder, name, make):
    """A copy of a cache with something else in the place of one file or folder; None if it
    cannot be made.
    """
    shutil.copytree(right, folder)
    path = folder / name
    path.parent.mkdir(parents=True, exist_ok=True)
    if path.is_dir() and not path.is_symlink():
        shutil.rmtree(path)
    path.unlink(missing_ok=True)
    try:
        make(path)
    except PermissionError:
        shutil.rmtree(folder)  # a device in a container
        return None
    owned(folder)
    return folder


@pytest.fixture
def cases(cache):
    """Returns the folders of caches, each with one obstacle, after the cache was written by
    ``write``.
    """

    def cases(write, kind, more=()):
        right = cache.parent / "right"
        write(right)
        owned(right)
        names = places(right, more)
        folders = [
            obstructed(right, cache.parent / "cases" / str(n), name, OBSTACLES[kind])
            for n, name in enumerate(names)
        ]
        if None in folders:
            pytest.skip("a device cannot be made here")
        return right, folders

    return cases


def seen(folder):
    """What lies below a folder: kind, size and time of change of each path."""
    found = {path: path.lstat() for path in [folder, *folder.rglob("*")]}
    return {
        path: (about.st_mode, about.st_size, about.st_mtime_ns, about.st_ino)
        for path, about in found.items()
    }


def wrong(said, right):
    """The names for which a cache gave something else than the value that was stored, or
    nothing.
    """
    return [
        (str(folder), n)
        for folder, pairs in said.items()
        for n, pair in pairs.items()
        if pair[0] not in right[n]
    ]


def of_number_one(root):
    fill(root, (1,))


@pytest.mark.slow
@pytest.mark.parametrize("kind", OBSTACLES)
def test_a_member_of_the_group_waits_for_no_obstacle_and_reads_nothing_wrong(cases, tried, kind):
    right, folders = cases(of_number_one, kind, MORE)
    known = {
        n: ("None", "'null'", *pair)
        for n, pair in tried(SECOND, "folder", [right, *folders[:0]])[right].items()
    }
    said = tried(SECOND, "folder", folders)
    assert len(said) == len(folders) > 25
    assert wrong(said, known) == []


@pytest.mark.slow
@pytest.mark.parametrize("kind", OBSTACLES)
def test_a_user_who_may_only_read_waits_for_no_obstacle_and_changes_nothing(cases, tried, kind):
    right, folders = cases(of_number_one, kind, MORE)
    known = {
        n: ("None", "'null'", *pair)
        for n, pair in tried(STRANGER, "folder", [right], ())[right].items()
    }
    before = [seen(folder) for folder in folders]
    said = tried(STRANGER, "folder", folders, ())
    assert wrong(said, known) == []
    assert [seen(folder) for folder in folders] == before


def there(root):
    """Write a cache at a URL."""
    store = RemoteStore(f"file://{root}", root.parent / "layer")
    for kind, value in values_of(1, 0).items():
        store.put(key_of(kind, 1), value, ABOUT)
    store.put_receipt(key_of("receipt", 1), ABOUT)


@pytest.mark.slow
@pytest.mark.parametrize("kind", OBSTACLES)
@pytest.mark.parametrize("user", [SECOND, STRANGER], ids=["of the group", "who may only read"])
def test_a_folder_at_a_url_is_read_beside_an_own_one(cases, tried, kind, user):
    """What is loaded there and what is computed is stored in the own folder, whatever lies in
    the other one.
    """
    pytest.importorskip("fsspec")
    groups = (GROUP,) if user == SECOND else ()
    right, folders = cases(there, kind)
    before = [seen(folder) for folder in [right, *folders]]
    said = tried(user, "url", [right, *folders], groups)
    known = {n: ("None", *pair) for n, pair in said[right].items()}
    assert "None" not in {pair[0] for pair in said[right].values()}, (
        "what is stored there is loaded"
    )
    assert wrong(said, known) == []
    assert all(
        pair[1] == said[right][n][1] != "None"
        for pairs in said.values()
        for n, pair in pairs.items()
    )
    if user == STRANGER:
        assert [seen(folder) for folder in [right, *folders]] == before
    else:
        kept = {path.stat().st_uid for path in right.rglob("*") if path.is_file()}
        assert kept == {FIRST, SECOND}, "a member of the group stores there too"
        assert {path.stat().st_gid for path in right.rglob("*") if path.is_file()} == {GROUP}
