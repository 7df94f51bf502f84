"""Small results in one file: what is lost of it is computed again, and nothing wrong is ever
served.
"""

import os
import subprocess
import sys

import pytest
import torch
from hypothesis import given, settings
from hypothesis import strategies as st

from neusee.workflows.store import payload as small_results
from neusee.workflows.store.metadata import INLINE
from neusee.workflows.store.payload import SmallResults
from neusee.workflows.store.result_store import Store
from neusee.workflows.store.shared_folder import Disk


def key(i):
    return f"{i:032x}"


def jotted(root, count, start=0):
    store = Store(root)
    for i in range(start, start + count):
        assert store.put_small(
            key(i), torch.full((3,), float(i)), {"step": f"s{i}", "seconds": 1e-4}
        )
    return store


def test_a_small_value_comes_back_in_the_next_process_without_a_file_of_its_own(tmp_path):
    jotted(tmp_path, 3)
    store = Store(tmp_path)
    assert [float(store.get(key(i))[0]) for i in range(3)] == [0.0, 1.0, 2.0]
    assert store.about(key(2))["step"] == "s2"
    assert not list(tmp_path.glob("??/*.json"))
    assert [k for k, _ in store.entries()] == [key(i) for i in range(3)]
    assert {row["step"] for row in store.journal.rows()} == {"s0", "s1", "s2"}


def test_of_a_large_value_there_is_a_receipt_until_it_is_kept(tmp_path):
    store, large = Store(tmp_path), torch.rand(INLINE)
    assert not store.put_small(key(1), large, {"step": "s", "seconds": 1e-4})
    fresh = Store(tmp_path)
    assert not fresh.has(key(1))
    assert fresh.about(key(1))["bytes"] == large.nbytes
    assert fresh.put(key(1), large, {"step": "s", "seconds": 1e-4})
    assert torch.equal(Store(tmp_path).get(key(1)), large)


def test_what_another_process_adds_is_found(tmp_path):
    one, two = jotted(tmp_path, 2), Store(tmp_path)
    assert not two.has(key(5))
    jotted(tmp_path, 1, 5)
    assert float(two.get(key(5))[0]) == 5.0
    assert one.has(key(5))


@settings(deadline=None, max_examples=60)
@given(place=st.floats(0, 1), bit=st.integers(0, 7))
def test_no_flipped_bit_gives_a_wrong_value(tmp_path_factory, place, bit):
    root = tmp_path_factory.mktemp("store")
    jotted(root, 3)
    data = bytearray((root / "brief.jsonl").read_bytes())
    data[int(place * (len(data) - 1))] ^= 1 << bit
    (root / "brief.jsonl").write_bytes(data)
    store = Store(root)
    found = [i for i in range(3) if store.has(key(i))]
    assert len(found) >= 1
    assert all(torch.equal(store.get(key(i)), torch.full((3,), float(i))) for i in found)
    jotted(root, 3)
    assert all(Store(root).has(key(i)) for i in range(3))


@pytest.mark.parametrize("left", [1, 10, 100, 0])
def test_a_torn_line_spoils_no_other(tmp_path, left):
    jotted(tmp_path, 2)
    path = tmp_path / "brief.jsonl"
    data = path.read_bytes()
    path.write_bytes(data[: data.rindex(b"\n") + left])
    jotted(tmp_path, 1, 7)
    store = Store(tmp_path)
    assert [store.has(key(i)) for i in (0, 1, 7)] == [True, False, True]


def test_where_no_line_can_be_written_there_is_one_warning(tmp_path, monkeypatch):
    store = Store(tmp_path)

    def full(*args):
        raise OSError(28, "No space left on device")

    monkeypatch.setattr(os, "write", full)
    with pytest.warns(UserWarning, match="cannot be written") as seen:
        assert [store.put_small(key(i), torch.zeros(2), {"step": "s"}) for i in range(3)] == [
            False
        ] * 3
    assert len(seen) == 1


def test_the_older_half_goes_when_there_is_too_much(tmp_path, monkeypatch):
    monkeypatch.setattr(small_results, "MOST_BYTES", 4000)
    jotted(tmp_path, 40)
    Store(tmp_path).has(key(99))
    brief = SmallResults(Disk(tmp_path))
    there = [i for i in range(40) if brief.find(key(i)) is not None]
    assert there
    assert there == list(range(40 - len(there), 40))
    assert (tmp_path / "brief.jsonl").stat().st_size <= 2000


WRITER = """
import sys, torch
from pathlib import Path
from neusee.workflows.store.result_store import Store
store, first = Store(Path(sys.argv[1])), int(sys.argv[2])
for i in range(first, first + 120):
    store.put_small(f"{i:032x}", torch.full((3,), float(i)), {"step": "s", "seconds": 0.0})
"""


@pytest.mark.slow
def test_two_processes_that_write_at_once_lose_nothing(tmp_path):
    words = [sys.executable, "-c", WRITER, str(tmp_path)]
    both = [subprocess.Popen([*words, str(start)]) for start in (0, 120)]
    assert [process.wait(120) for process in both] == [0, 0]
    store = Store(tmp_path)
    assert all(float(store.get(key(i))[0]) == i for i in range(240))
