"""Symbolic links in a cache: whatever is removed or moved lies in the cache."""

import os
import time
import warnings

import pytest
import torch

from neusee.workflows.store import eviction as budget_eviction
from neusee.workflows.store import eviction as garbage_files
from neusee.workflows.store import shared_folder
from neusee.workflows.store.result_store import Store

KEY = "ab" + "0" * 30
BIG = torch.arange(3000, dtype=torch.float64)
YEAR = 365 * 86400


@pytest.fixture
def outside(tmp_path):
    """A folder of somebody else, with old files whose names are those of a cache."""
    folder = tmp_path / "outside"
    for name in ("ab", "cd"):
        (folder / name).mkdir(parents=True)
        (folder / name / f"{name}{'0' * 30}.safetensors").write_bytes(b"x" * 999)
        (folder / name / f"{name}{'0' * 30}.json").write_bytes(b"{}")
        (folder / name / f"{name}.0").write_bytes(b"band")
    for name in ("note.1", "precious", "badge.x", "letter.lease"):
        (folder / name).write_bytes(b"x")
        os.utime(folder / name, (1, 1))
    for path in folder.rglob("*"):
        os.utime(path, (time.time() - YEAR,) * 2)
    return folder


def seen(folder):
    return {str(path): path.read_bytes() if path.is_file() else None for path in folder.rglob("*")}


LINKS = ["ab", "tmp", "bands", "files", "bad", "pins", "bands/ab", "files/ab", "bands/bad", "code"]


@pytest.mark.parametrize("link", LINKS)
def test_a_folder_that_is_a_link_is_not_followed(tmp_path, outside, link, monkeypatch):
    before = seen(outside)
    root = tmp_path / "cache"
    (root / link).parent.mkdir(parents=True)
    (root / link).symlink_to(outside / "ab" if link in ("ab", "bands/ab", "files/ab") else outside)
    monkeypatch.setattr(garbage_files, "_WEEK", -1.0)
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")
        for store in (Store(root), Store(root, budget=1)):
            store.disk.sweep(patience=0.0)
            store.gc(budget=0)
            store.put("ef" + "0" * 30, BIG, {})
            store.gc(budget=0)
            store.unpin("precious")
            store.has(KEY)
            list(store.entries())
            list(store.check())
    after = seen(outside)
    assert {path: raw for path, raw in after.items() if path in before} == before


@pytest.mark.parametrize("target", ["file", "folder", "loop"])
def test_a_file_that_is_a_link_loses_the_link_alone(tmp_path, outside, target):
    root = tmp_path / "cache"
    Store(root).put("ef" + "0" * 30, BIG, {})
    to = {"file": outside / "precious", "folder": outside, "loop": root / "tmp" / "x.1"}[target]
    places = [
        root / "tmp" / "x.1",
        root / "tmp" / ".lock",
        root / "journal.jsonl",
        root / "brief.jsonl",
    ]
    for path in places:
        path.unlink(missing_ok=True)
        path.symlink_to(to)
        os.utime(path, (1, 1), follow_symlinks=False)
    before = seen(outside)
    store = Store(root)
    store.put_small("01" + "0" * 30, BIG[:3], {})
    store.put(KEY, BIG, {})
    store.gc()
    assert seen(outside) == before
    assert not any(path.is_symlink() for path in places)
    assert torch.equal(Store(root).get("01" + "0" * 30), BIG[:3])
    assert torch.equal(Store(root).get(KEY), BIG)


def test_a_folder_that_becomes_a_link_in_the_middle_is_not_followed(tmp_path, outside, monkeypatch):
    """The other process renames the folder and puts a link there, after the list was made and
    before the removal.
    """
    root = tmp_path / "cache"
    (root / "ab").mkdir(parents=True)
    (root / "ab" / f"{KEY}.safetensors").write_bytes(b"orphan")
    before, found = seen(outside), garbage_files._payloads

    def raced(disk):
        entries = list(found(disk))
        if not (root / "ab").is_symlink():
            (root / "ab").rename(root / "old")
            (root / "ab").symlink_to(outside / "ab")
            raced.entries = entries
        return iter(raced.entries)

    monkeypatch.setattr(garbage_files, "_payloads", raced)
    Store(root).gc()
    assert raced.entries
    assert seen(outside) == before


def test_what_is_removed_is_below_the_root(tmp_path):
    disk = shared_folder.Disk(tmp_path / "cache")
    (tmp_path / "cache").mkdir()
    (tmp_path / "precious").write_bytes(b"x")
    for path in (
        f"{disk.folder}/../precious",
        f"{tmp_path}/precious",
        f"{disk.folder}/./x",
        f"{disk.folder}/",
    ):
        with pytest.raises(OSError, match=r"not below|Is a directory|No such file|Not a directory"):
            disk.unlink(path)
    assert (tmp_path / "precious").exists()


def test_an_eviction_removes_the_file_that_the_metadata_name_only_in_the_cache(tmp_path, outside):
    store = Store(tmp_path / "cache")
    store.put(KEY, BIG[:3], {"file": f"{KEY}.png", "file_bytes": 5})
    (tmp_path / "cache" / "files").mkdir()
    (tmp_path / "cache" / "files" / "ab").symlink_to(outside / "ab")
    (outside / "ab" / f"{KEY}.png").write_bytes(b"x")
    budget_eviction.drop(store.disk, KEY)
    assert (outside / "ab" / f"{KEY}.png").exists()
