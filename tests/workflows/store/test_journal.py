"""The journal: what was, at a glance; torn, lost or replaced, it is advice and never an error."""

import errno
import json
import os
import subprocess
import sys
from concurrent.futures import ThreadPoolExecutor

import pytest
import torch
from hypothesis import given
from hypothesis import strategies as st

from neusee.workflows.keys.sealed_files import seal_record
from neusee.workflows.store import journal
from neusee.workflows.store.result_store import Store


def key_of(i):
    return f"{i % 256:02x}{i:030x}"


def about(i, step="s", node="a.b"):
    return {
        "step": step,
        "recipe": "r",
        "origin": {"node": node, "params": {"k": i}},
        "seconds": float(i),
        "device": "cpu",
        "date": f"2026-01-01T00:{i // 60 % 60:02d}:{i % 60:02d}+00:00",
    }


def filled(root, count=5):
    store = Store(root)
    for i in range(count):
        store.put(key_of(i), torch.zeros(2), about(i))
    return store


def keys(store):
    return [row["key"] for row in store.journal.rows()]


def path_of(root):
    return root / "journal.jsonl"


def test_a_line_for_each_result_and_each_receipt(tmp_path):
    store = Store(tmp_path)
    store.put(key_of(0), torch.zeros(2), about(0))
    store.put_receipt(key_of(1), {**about(1), "bytes": 4000, "peak": 77})
    expected = [
        {
            "key": key_of(0),
            "step": "s",
            "recipe": "r",
            "seconds": 0.0,
            "bytes": 8,
            "device": "cpu",
            "peak": None,
        },
        {
            "key": key_of(1),
            "step": "s",
            "recipe": "r",
            "seconds": 1.0,
            "bytes": 4000,
            "device": "cpu",
            "peak": 77,
        },
    ]
    for i, row in enumerate(expected):
        row |= {"date": about(i)["date"], "node": "a.b", "kept": i == 0, "size": None}
        row |= dict.fromkeys(("processor_seconds", "processor", "threads"))
    assert store.journal.rows() == expected
    assert Store(tmp_path).journal.rows() == expected


def test_lines_are_found_by_step_and_by_node(tmp_path):
    store = Store(tmp_path)
    for i in range(6):
        store.put_receipt(key_of(i), about(i, "even" if i % 2 == 0 else "odd", f"n.{i // 3}"))
    for found in (store.journal, Store(tmp_path).journal):
        assert [row["seconds"] for row in found.of_step("odd")] == [1.0, 3.0, 5.0]
        assert [row["seconds"] for row in found.rows() if row["node"] == "n.1"] == [3.0, 4.0, 5.0]
        assert found.of_step("none") == []
        assert not [row for row in found.rows() if row["node"] == "none"]


def test_what_others_add_is_seen_and_nothing_is_read_twice(tmp_path):
    one, two = filled(tmp_path), Store(tmp_path)
    assert keys(two) == keys(one) == [key_of(i) for i in range(5)]
    one.put_receipt(key_of(7), about(7))
    assert keys(two) == [*map(key_of, range(5)), key_of(7)]
    assert [row["seconds"] for row in two.journal.of_step("s")] == [0.0, 1.0, 2.0, 3.0, 4.0, 7.0]


def test_an_empty_store_has_no_lines_and_gets_no_file(tmp_path):
    assert Store(tmp_path / "none").journal.rows() == []
    assert not (tmp_path / "none").exists()


def test_a_lost_journal_is_made_anew_from_the_results(tmp_path):
    store = filled(tmp_path)
    rows = store.journal.rows()
    path_of(tmp_path).unlink()
    assert Store(tmp_path).journal.rows() == rows
    assert path_of(tmp_path).exists()
    path_of(tmp_path).unlink()
    store.put(key_of(9), torch.zeros(2), about(9))
    assert keys(Store(tmp_path)) == [*map(key_of, range(5)), key_of(9)]


@pytest.mark.parametrize(
    "damage", [b"", b"\0" * 700, b"{}\n" * 30, b'{"journal":"x"', b"\xff" * 50]
)
def test_a_journal_that_is_none_is_made_anew(tmp_path, damage):
    rows = filled(tmp_path).journal.rows()
    path_of(tmp_path).write_bytes(damage)
    store = Store(tmp_path)
    assert store.journal.rows() == rows
    store.put_receipt(key_of(6), about(6))
    assert keys(Store(tmp_path))[-1] == key_of(6)


def test_torn_lines_are_skipped(tmp_path):
    store = filled(tmp_path)
    with path_of(tmp_path).open("ab") as file:
        file.write(b'\n{"key":"' + b"f" * 32)
    store.put_receipt(key_of(8), about(8))
    with path_of(tmp_path).open("ab") as file:
        file.write(
            b'\nnull\n[]\n7\n{"key":3}\n{"key":"a","step":[],"node":"n","seconds":1,"bytes":1,"kept":true}'
        )
    assert keys(Store(tmp_path)) == keys(store) == [*map(key_of, range(5)), key_of(8)]


@given(st.floats(0, 1), st.integers(0, 7))
def test_a_flipped_bit_costs_a_line_at_most(tmp_path_factory, at, bit):
    root = tmp_path_factory.mktemp("store")
    rows = filled(root).journal.rows()
    raw = bytearray(path_of(root).read_bytes())
    raw[int(at * (len(raw) - 1))] ^= 1 << bit
    path_of(root).write_bytes(raw)
    found = Store(root).journal.rows()
    assert len(rows) - 2 <= len(found) <= len(rows)
    assert sum(a in rows for a in found) >= len(rows) - 2


def test_a_row_knows_its_kept_value_after_compaction(tmp_path):
    store = Store(tmp_path)
    for again in range(3):
        for i in range(4):
            store.put_receipt(key_of(i), {**about(i), "seconds": again + i / 10})
    store.put(key_of(2), torch.zeros(3), about(2))
    store.put(key_of(5), torch.zeros(3), about(5))
    assert len(store.journal.rows()) == 14
    (tmp_path / key_of(1)[:2] / f"{key_of(1)}.json").unlink()
    other = Store(tmp_path)
    assert len(other.journal.rows()) == 14
    store.journal.compact()
    for found in (store, Store(tmp_path), other):
        rows = found.journal.rows()
        assert [(row["key"], row["kept"]) for row in rows] == [
            (key_of(0), False),
            (key_of(3), False),
            (key_of(2), True),
            (key_of(5), True),
        ]
        assert rows[0]["seconds"] == 2.0
    other.put_receipt(key_of(6), about(6))
    assert keys(store)[-1] == key_of(6)


def test_many_superseded_lines_go_by_themselves(tmp_path, monkeypatch):
    monkeypatch.setattr(journal, "_SPARE", 50)
    store = Store(tmp_path)
    for i in range(60):
        store.put_receipt(key_of(i % 4), {**about(i % 4), "seconds": float(i)})
    rows = Store(tmp_path).journal.rows()
    assert [row["seconds"] for row in rows] == [56.0, 57.0, 58.0, 59.0]
    assert len(path_of(tmp_path).read_bytes().splitlines()) == 5


@pytest.mark.parametrize("number", [errno.ENOSPC, errno.EROFS, errno.EACCES])
def test_where_it_cannot_be_written_it_is_still_read(tmp_path, monkeypatch, number):
    rows = filled(tmp_path).journal.rows()
    path_of(tmp_path).unlink()

    def fail(*args):
        raise OSError(number, os.strerror(number))

    monkeypatch.setattr(os, "replace", fail)
    store = Store(tmp_path)
    assert store.journal.rows() == rows
    monkeypatch.setattr(
        journal.metadata, "each", lambda disk: pytest.fail("all results were read twice")
    )
    assert store.journal.of_step("s") == rows


WRITER = """
import sys
from pathlib import Path
from neusee.workflows.store.result_store import Store
store = Store(Path(sys.argv[1]))
for i in range(200):
    store.journal.append(f"{i:02x}" + sys.argv[2] * 30, {"step": "s" * (i % 50), "seconds": 1.0})
"""


def test_lines_of_many_writers_do_not_mix(tmp_path):
    filled(tmp_path, 1)
    writers = [
        subprocess.Popen([sys.executable, "-c", WRITER, str(tmp_path), name]) for name in "abc"
    ]
    assert [writer.wait() for writer in writers] == [0, 0, 0]
    found = keys(Store(tmp_path))
    assert found[0] == key_of(0)
    for name in "abc":
        assert [key for key in found[1:] if key.endswith(name * 30)] == [
            f"{i:02x}" + name * 30 for i in range(200)
        ]
    assert all(json.loads(line) for line in path_of(tmp_path).read_bytes().splitlines())


def test_threads_may_write_and_read_at_once(tmp_path):
    store = filled(tmp_path, 1)
    with ThreadPoolExecutor(4) as pool:
        list(pool.map(lambda i: store.put_receipt(key_of(i), about(i)), range(1, 80)))
    assert sorted(keys(Store(tmp_path))) == sorted(map(key_of, range(80)))


def test_the_newest_lines_of_a_long_journal_are_read_alone(tmp_path, monkeypatch):
    """What others add is seen, all lines are still there for who asks, and changes of the file
    lose none.
    """
    monkeypatch.setattr(journal, "_LATEST", 5000)
    writer = Store(tmp_path)
    for i in range(60):
        writer.put(f"{i:032x}", float(i), {"step": f"s{i}", "recipe": "r"})
    found = journal.Journal(writer.disk)
    assert found.is_long()
    newest = [row["step"] for row in found.latest()]
    assert 5 < len(newest) < 30
    assert newest == [f"s{i}" for i in range(60 - len(newest), 60)]
    writer.put("ab" * 16, 1.0, {"step": "last", "recipe": "r"})
    assert [row["step"] for row in found.latest()] == [*newest, "last"]
    found.mark_evicted({"ab" * 16})
    assert len(found.rows()) == 61
    assert journal.Journal(writer.disk).totals()[::2] == (60, 1)
    assert len(found.latest()) == 61  # all are read by now


def test_a_line_of_an_earlier_version_without_a_processor_is_read(tmp_path):
    store = Store(tmp_path)
    store.put(key_of(0), 1.0, about(0))
    path = tmp_path / "journal.jsonl"
    row = {k: v for k, v in store.journal.rows()[0].items() if not k.startswith(("proc", "thr"))}
    head = path.read_bytes().split(b"\n")[0]
    path.write_bytes(head + b"\n" + seal_record("journal", row))
    assert Store(tmp_path).journal.rows() == [row]
