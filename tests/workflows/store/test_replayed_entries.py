"""Signed files in other places: a right signature is believed for its own key, kind of file and
name alone.

A cache with a file of every kind is changed in one file at a time; whatever is then read was signed
for where it is read, or counts as missing.
"""

import json
import os
import random
import shutil
import warnings
from functools import cache
from pathlib import Path

import pytest

from neusee.workflows.keys import sealed_files as seal
from neusee.workflows.store.journal import row_of
from neusee.workflows.store.metadata import receipt
from neusee.workflows.store.remote_store import RemoteStore
from neusee.workflows.store.result_store import Store
from tests.workflows.store.whole_cache import (
    ABOUT,
    believed,
    bytes_in,
    fill,
    got,
    key_of,
    values_of,
)

SECRET = "ours"


@pytest.fixture
def signed(monkeypatch):
    monkeypatch.setenv("NEUSEE_CACHE_SECRET", SECRET)


@cache
def unchanged(root, numbers=(1, 2)):
    """What a cache says that nobody changes."""
    return believed(root, numbers)


def lies(root, right, numbers=(1, 2), accounts=()):
    """What a cache says that was never signed for its place; ``right`` are caches that nobody
    changed.

    ``accounts`` are caches of the same secret whose journals may be believed: a line of a journal
    says of its own key what a run has cost, and no result depends on it.
    """
    said, rows = believed(root, numbers)
    every = [unchanged(each, numbers) for each in right]
    known = frozenset().union(
        *(rows for _, rows in every),
        *(unchanged(each)[1] for each in accounts),
        (_as_row(s[n]) for s, _ in every for n in s if "about" in n),
    )
    wrong = [
        n
        for n in said
        if said[n] not in (None, "null", *(each[n] for each, _ in every), *_receipts(n, every))
    ]
    return wrong + [row for row in rows if row not in known]


def _receipts(name, every):
    """The receipts of results whose files are missing, as an eviction leaves them."""
    if "about small" not in name:
        return []
    return [json.dumps(receipt(json.loads(said[name]))) for said, _ in every]


def _as_row(about):
    about = json.loads(about)
    return json.dumps(about and row_of(about["key"], about))


def files_of(root):
    """The files of a cache, without those that no reader believes: temporary files and the badge
    of a process.
    """
    return sorted(
        p.relative_to(root)
        for p in root.rglob("*")
        if p.is_file() and p.relative_to(root).parts[0] != "tmp"
    )


def records(root):
    """All signed contents of a cache by where they are from: whole files, and single lines of
    the common files.
    """
    found = {str(name): (root / name).read_bytes() for name in files_of(root)}
    for name in ("journal.jsonl", "brief.jsonl"):
        lines = [
            line for line in (root / name).read_bytes().split(b"\n") if line.startswith(b'{"key"')
        ]
        found |= {f"{name} line {at}": line for at, line in enumerate(lines)}
    return found


def changed(root, to, name, raw, append=False):
    """Copy a cache with one file in which something else is."""
    shutil.rmtree(to, ignore_errors=True)
    shutil.copytree(root, to)
    raw = (to / name).read_bytes() + b"\n" + raw if append else raw
    (to / name).unlink()
    (to / name).write_bytes(raw)
    return to


def places(root):
    """Every place for a content: as a file, and as one more line of the common files."""
    return [(name, False) for name in files_of(root)] + [
        (Path(name), True) for name in ("journal.jsonl", "brief.jsonl")
    ]


def test_a_cache_that_nobody_changed_says_all(tmp_path, signed):
    root = fill(tmp_path / "cache")
    said, rows = believed(root)
    missing = [name for name, what in said.items() if what in (None, "null")]
    assert sorted(missing) == sorted(
        ["sources"]
        + [f"{name} {n}" for n in (1, 2) for name in ("value receipt",)]
        + [f"picture {n} .svg" for n in (1, 2)]
    )
    assert len(rows) == 10
    assert lies(root, [root]) == []
    kinds = {name.parts[0] for name in files_of(root)}
    assert kinds >= {
        "00",
        "brief.jsonl",
        "journal.jsonl",
        "speeds.json",
        "files",
        "checks.json",
        "code.json",
        "code",
        "answers",
    }


def assert_no_replay(tmp_path, root, others, chosen):
    """Put contents of some caches in the place of each file of a cache, for the contents that
    are ``chosen``.
    """
    sources = {
        f"{each.name}: {name}": raw for each in others for name, raw in records(each).items()
    }
    cases = [(source, place) for source in sources for place in places(root)]
    for source, (name, append) in chosen(cases):
        copy = changed(root, tmp_path / "copy", name, sources[source], append)
        assert lies(copy, [root], accounts=others) == [], (source, str(name), append)


def test_no_signed_file_is_believed_in_the_place_of_another(tmp_path, signed):
    """A drawn part of all pairs."""
    root = fill(tmp_path / "cache")
    assert_no_replay(tmp_path, root, [root], lambda cases: random.Random(1).sample(cases, 150))


@pytest.mark.slow
def test_no_signed_file_of_any_kind_is_believed_in_any_other_place(tmp_path, signed):
    """A third of all pairs, also with the files of another project that has the same secret and
    other keys.
    """
    root, other = fill(tmp_path / "cache"), fill(tmp_path / "other", (3,))
    assert_no_replay(tmp_path, root, [root, other], lambda cases: cases[::3])


@pytest.mark.long
def test_no_signed_file_is_believed_in_any_place_of_all(tmp_path, signed):
    """All pairs; `test_no_signed_file_of_any_kind_is_believed_in_any_other_place` has a third."""
    root, other = fill(tmp_path / "cache"), fill(tmp_path / "other", (3,))
    assert_no_replay(tmp_path, root, [root, other], lambda cases: cases)


def test_a_record_is_that_of_one_kind_of_file(tmp_path, signed):
    """The pairs with one key, whose records differ in the kind of file alone; each was believed
    before.
    """
    root = fill(tmp_path / "cache")
    row = next(row for row in Store(root).journal.rows() if row["key"] == key_of("receipt", 1))
    name = Path(key_of("receipt", 1)[:2]) / f"{key_of('receipt', 1)}.json"
    copy = changed(root, tmp_path / "copy", name, seal.seal_record("journal", row))
    assert lies(copy, [root]) == []
    for kind in ("result", "result at a URL", "journal"):
        about = json.loads(believed(root)[0]["about small 1"])
        raw = seal.seal_record(kind, about | {"recipe": "another"})
        copy = changed(root, tmp_path / "copy", Path("brief.jsonl"), raw, append=True)
        assert lies(copy, [root]) == []
        with pytest.raises(seal.Unsigned):
            seal.unseal_record("small result", raw)


def test_a_picture_under_another_suffix_is_none(tmp_path, signed):
    root = fill(tmp_path / "cache")
    copy = shutil.copytree(root, tmp_path / "copy")
    folder = copy / "files" / key_of("picture", 1)[:2]
    shutil.copy(folder / f"{key_of('picture', 1)}.png", folder / f"{key_of('picture', 1)}.svg")
    assert lies(copy, [root]) == []


@pytest.mark.slow
def test_an_older_signed_version_is_believed_whole_or_not_at_all(tmp_path, signed):
    """A rollback does no harm: the key covers all that decides a result, so that the older one is
    as good.

    A mixture of two versions of one value is never read.
    """
    new, old = fill(tmp_path / "new", version=1), fill(tmp_path / "old", version=0)
    for name in files_of(old):
        copy = changed(new, tmp_path / "copy", name, (old / name).read_bytes())
        assert lies(copy, [old, new]) == [], str(name)


SPOILT = {
    "cut by one byte": lambda raw: raw[:-1],
    "cut in half": lambda raw: raw[: len(raw) // 2],
    "empty": lambda raw: b"",
    "longer by a byte": lambda raw: raw + b"\0",
    "longer by a line": lambda raw: raw + b"\n",
    "twice": lambda raw: raw + raw,
    "after a byte": lambda raw: b"\0" + raw,
    "with a second seal": lambda raw: (
        raw[:-2] + raw[raw.find(b',"seal"') :] if b',"seal"' in raw else raw[:-2]
    ),
}


def test_a_signed_file_that_is_shorter_or_longer_is_not_believed(tmp_path, signed):
    root, wrong = fill(tmp_path / "cache"), []
    for how, spoil in SPOILT.items():
        for name in files_of(root):
            copy = changed(root, tmp_path / "copy", name, spoil((root / name).read_bytes()))
            wrong += [(how, str(name), lie) for lie in lies(copy, [root])]
    assert wrong == []


def test_a_secret_of_others_signs_nothing_here(tmp_path, monkeypatch):
    monkeypatch.setenv("NEUSEE_CACHE_SECRET", "theirs")
    theirs = fill(tmp_path / "theirs", version=1)
    monkeypatch.setenv("NEUSEE_CACHE_SECRET", SECRET)
    root = fill(tmp_path / "cache")
    for name in files_of(theirs):
        copy = changed(root, tmp_path / "copy", name, (theirs / name).read_bytes())
        assert lies(copy, [root]) == [], str(name)


# --- at a URL -------------------------------------------------------------------------------------


def said_there(url, local):
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")
        store = RemoteStore(url, local)
        keys = [
            key_of(kind, number) for number in (1, 2) for kind in ("payload", "inline", "receipt")
        ]
        return {
            key: (bytes_in(got(store, key)), bool((store.about(key) or {}).get("kept")))
            for key in keys
        }


def fill_url(url, local, version=0):
    store = RemoteStore(url, local)
    for number in (1, 2):
        for kind, value in values_of(number, version).items():
            store.put(key_of(kind, number), value, ABOUT)
        store.put_receipt(key_of("receipt", number), ABOUT)


def test_no_file_at_a_url_is_believed_in_the_place_of_another(tmp_path, signed):
    pytest.importorskip("fsspec")
    there = tmp_path / "there"
    fill_url(f"file://{there}", tmp_path / "here")
    right = said_there(f"file://{there}", tmp_path / "fresh")
    assert sum(value is not None for value, _ in right.values()) == 4
    sources = {**records_of(there), **records_of(tmp_path / "here")}
    cases = [(source, name) for source in sources for name in files_of(there)]
    for at, (source, name) in enumerate(random.Random(2).sample(cases, 60)):
        copy = changed(there, tmp_path / "copy", name, sources[source])
        said = said_there(f"file://{copy}", tmp_path / f"fresh{at}")
        assert all(said[key][0] in (None, right[key][0]) for key in right), (source, str(name))
        shutil.rmtree(tmp_path / f"fresh{at}", ignore_errors=True)


def records_of(root):
    return {str(root / name): (root / name).read_bytes() for name in files_of(root)}


def test_a_receipt_is_no_value_at_a_url(tmp_path, signed):
    """The note of a receipt in the place of a value hides it, and the next run computes it; its
    kind is another one.
    """
    pytest.importorskip("fsspec")
    fill_url(f"file://{tmp_path / 'there'}", tmp_path / "here")
    note = tmp_path / "there" / key_of("receipt", 1)[:2] / f"{key_of('receipt', 1)}.note.json"
    with pytest.raises(seal.Unsigned):
        seal.unseal_record("result at a URL", note.read_bytes())


# --- after the check ------------------------------------------------------------------------------


def test_what_another_user_changes_after_the_check_changes_no_value(tmp_path, signed, monkeypatch):
    """A file of another user is copied and not mapped; its owner can write into it at any time."""
    root = fill(tmp_path / "cache")
    right = bytes_in(got(Store(root), key_of("payload", 1)))
    another = os.geteuid() + 1
    monkeypatch.setattr(seal.os, "geteuid", lambda: another)
    value = got(Store(root), key_of("payload", 1))
    for name in root.glob(f"{key_of('payload', 1)[:2]}/*.safetensors"):
        name.chmod(0o644)
        with name.open("r+b") as file:
            file.seek(200)
            file.write(b"\1" * 4000)
    assert bytes_in(value) == right
