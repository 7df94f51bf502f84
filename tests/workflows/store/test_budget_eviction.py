"""Room: what goes first, what never goes, and what two users do who make room at once."""

import errno
import os
import subprocess
import sys
import time

import pytest
import torch
from hypothesis import given
from hypothesis import strategies as st

from neusee.workflows.store import eviction as budget_eviction
from neusee.workflows.store import shared_folder
from neusee.workflows.store.cache_settings import parse_size
from neusee.workflows.store.derived_files import DerivedFiles
from neusee.workflows.store.eviction import Candidate, chosen
from neusee.workflows.store.result_store import Store

N = 5000  #: numbers in a value: 20 kB
SIZE = 4 * N


def key_of(i):
    return f"{i % 256:02x}{i:030x}"


def put(store, i, seconds=1.0, n=N):
    return store.put(
        key_of(i),
        torch.full((n,), float(i)),
        {"step": f"s{i}", "seconds": seconds, "facts": {"max": i}},
    )


def used(root, i, ago):
    """Say when a value was last of use."""
    path = root / key_of(i)[:2] / f"{key_of(i)}.json"
    os.utime(path, (time.time() - ago,) * 2)


def kept(root):
    store = Store(root)
    return {int(key[2:], 16) for key, about in store.entries() if about.get("kept", True)}


def payloads(root):
    return {int(path.stem[2:], 16) for path in root.glob("[0-9a-f][0-9a-f]/*.safetensors")}


@pytest.mark.parametrize(
    ("text", "size"),
    [
        ("0", 0),
        ("5000", 5000),
        ("20 GB", 20 * 10**9),
        ("1.5TB", 15 * 10**11),
        ("3 kb", 3000),
        ("2 MiB", 2 * 2**20),
        (" 7g ", 7 * 10**9),
        ("10 B", 10),
    ],
)
def test_sizes_are_read_as_people_write_them(text, size, monkeypatch, tmp_path):
    assert parse_size(text) == size
    monkeypatch.setenv("NEUSEE_CACHE_BUDGET", text)
    assert Store(tmp_path).budget == size
    assert Store(tmp_path, budget=7).budget == 7


@pytest.mark.parametrize("text", ["much", "-1 GB", "20 XB", "1e9", "GB", "20 iB", "1 G B", "nan"])
def test_what_is_no_size_is_refused_with_the_fix(text, monkeypatch, tmp_path):
    monkeypatch.setenv("NEUSEE_CACHE_BUDGET", text)
    with pytest.raises(
        ValueError,
        match=r"NEUSEE_CACHE_BUDGET: .* is not a size: write a number of bytes, such as 20 GB",
    ):
        Store(tmp_path)


CANDIDATES = st.lists(
    st.builds(
        Candidate,
        st.uuids().map(lambda u: u.hex),
        st.integers(0, 1000),
        st.floats(-1, 1e4),
        st.floats(0, 1e8),
    ),
    unique_by=lambda c: c.key,
    max_size=30,
)


@given(CANDIDATES, st.floats(0, 20_000))
def test_enough_goes_and_none_without_need(candidates, excess):
    going = chosen(candidates, excess)
    freed = sum(c.size for c in going)
    assert freed >= min(excess, sum(c.size for c in candidates))
    assert all(freed - c.size < excess for c in going)
    assert len({c.key for c in going}) == len(going)


@given(CANDIDATES, st.floats(0, 20_000), st.floats(-1e9, 1e9))
def test_the_date_of_today_does_not_matter(candidates, excess, jump):
    moved = [Candidate(c.key, c.size, c.seconds, round(c.used) + round(jump)) for c in candidates]
    whole = [Candidate(c.key, c.size, c.seconds, round(c.used)) for c in candidates]
    assert {c.key for c in chosen(moved, excess)} == {c.key for c in chosen(whole, excess)}


def test_the_fewest_seconds_a_byte_go_first_and_count_half_a_week_later():
    week = 7 * 86400.0
    cheap, dear = Candidate("cheap", 100, 1.0, 0.0), Candidate("dear", 100, 3.0, 0.0)
    large = Candidate("large", 1000, 3.0, 0.0)
    assert [c.key for c in chosen([dear, cheap], 1)] == ["cheap"]
    assert [c.key for c in chosen([dear, large], 1)] == ["large"]
    assert [c.key for c in chosen([Candidate("dear", 100, 3.0, -2 * week), cheap], 1)] == ["dear"]
    assert [c.key for c in chosen([Candidate("dear", 100, 3.0, -1.5 * week), cheap], 1)] == [
        "cheap"
    ]


def test_a_value_stays_where_those_that_go_make_just_enough_room_without_it():
    small, large = Candidate("small", 10, 0.0, 0.0), Candidate("large", 30, 1.0, 0.0)
    assert [c.key for c in chosen([small, large], 30)] == ["large"]
    assert [c.key for c in chosen([small, large], 31)] == ["small", "large"]


def test_a_budget_is_kept_while_writing(tmp_path):
    store = Store(tmp_path, budget=10 * SIZE)
    for i in range(40):
        assert put(store, i, seconds=float(i + 1))
        assert len(payloads(tmp_path)) <= 10
        assert budget_eviction.total(store.disk) <= 11 * SIZE
    assert len(kept(tmp_path)) >= 7
    assert min(kept(tmp_path)) > 25
    for found in (store, Store(tmp_path)):
        for i in range(40):
            about = found.about(key_of(i))
            assert about["facts"] == {"max": i}
            assert about["seconds"] == i + 1
            assert about["bytes"] == SIZE
            assert found.has(key_of(i)) == (i in kept(tmp_path))
    assert {row["key"]: row["kept"] for row in store.journal.rows()} == {
        key_of(i): i in kept(tmp_path) for i in range(40)
    }


def test_what_went_may_come_back(tmp_path):
    store = Store(tmp_path, budget=3 * SIZE)
    for i in range(6):
        put(store, i, seconds=float(i))
    with pytest.raises(KeyError):
        store.get(key_of(0))
    assert put(Store(tmp_path), 0)
    assert Store(tmp_path).get(key_of(0)).sum() == 0
    assert Store(tmp_path).has(key_of(0))


def test_a_value_beyond_the_budget_leaves_a_receipt_at_once(tmp_path, recwarn):
    store = Store(tmp_path, budget=3 * SIZE)
    put(store, 1, n=N // 2)
    assert not put(store, 2, n=10 * N)
    assert kept(tmp_path) == {1}
    assert store.about(key_of(2))["bytes"] == 10 * SIZE
    assert not recwarn.list


def test_what_was_used_lately_stays(tmp_path):
    store = Store(tmp_path)
    for i in range(4):
        put(store, i)
        used(tmp_path, i, 30 * 86400.0)
    Store(tmp_path).get(key_of(2))
    assert Store(tmp_path).gc(budget=SIZE + 5000).evicted == tuple(key_of(i) for i in (0, 1, 3))
    assert Store(tmp_path).get(key_of(2))[0] == 2


def test_pinned_values_stay(tmp_path):
    store = Store(tmp_path)
    for i in range(4):
        put(store, i, seconds=float(i))
    store.pin(key_of(0))
    store.pin(key_of(1))
    assert Store(tmp_path).pinned() == {key_of(0), key_of(1)}
    swept = Store(tmp_path).gc(budget=0)
    assert kept(tmp_path) == {0, 1}
    assert set(swept.evicted) == {key_of(2), key_of(3)}
    store.unpin(key_of(0))
    store.unpin(key_of(0))
    Store(tmp_path).gc(budget=0)
    assert kept(tmp_path) == {1}
    assert Store(tmp_path).pinned() == {key_of(1)}


def test_a_dry_run_says_what_would_go_and_touches_nothing(tmp_path):
    store = Store(tmp_path)
    for i in range(5):
        put(store, i, seconds=float(i))
    (tmp_path / "00" / f"{'0' * 31}f.safetensors").write_bytes(b"x" * 1000)
    before = {path: path.stat().st_mtime_ns for path in tmp_path.rglob("*")}
    said = store.gc(budget=2 * SIZE + 5000, dry=True)
    assert {path: path.stat().st_mtime_ns for path in tmp_path.rglob("*")} == before
    done = store.gc(budget=2 * SIZE + 5000)
    assert said.evicted == done.evicted == tuple(map(key_of, range(3)))
    assert said.orphans == done.orphans == 1
    assert abs(said.freed - done.freed) < 3000
    assert kept(tmp_path) == {3, 4}
    assert done.left == budget_eviction.total(store.disk)


def test_a_reader_keeps_what_it_has_mapped(tmp_path):
    put(Store(tmp_path), 3)
    value = Store(tmp_path).get(key_of(3))
    Store(tmp_path).gc(budget=0)
    assert payloads(tmp_path) == set()
    assert float(value.sum()) == 3.0 * N


def test_who_counted_on_a_value_that_went_is_told_without_alarm(tmp_path, recwarn):
    put(Store(tmp_path), 3)
    store = Store(tmp_path)
    assert store.has(key_of(3))
    Store(tmp_path).gc(budget=0)
    with pytest.raises(KeyError):
        store.get(key_of(3))
    assert not store.has(key_of(3))
    assert store.about(key_of(3))["kept"] is False
    put(Store(tmp_path), 3)
    assert store.get(key_of(3))[0] == 3
    assert not recwarn.list
    assert not (tmp_path / "bad").exists()


def test_a_value_that_came_back_otherwise_is_served_as_it_is_now(tmp_path, recwarn):
    put(Store(tmp_path), 3)
    store = Store(tmp_path)
    assert store.has(key_of(3))
    Store(tmp_path).gc(budget=0)
    Store(tmp_path).put(key_of(3), torch.ones(2 * N), {})
    assert store.get(key_of(3)).sum() == 2 * N
    assert not recwarn.list


def test_small_values_go_too(tmp_path):
    store = Store(tmp_path)
    for i in range(4):
        store.put(key_of(i), torch.full((800,), float(i)), {"seconds": float(i)})
    freed = store.gc(budget=0)
    assert len(freed.evicted) == 4
    assert freed.left < 2000
    assert not store.has(key_of(0))


def test_on_a_full_disk_not_even_receipts_are_written(tmp_path, monkeypatch):
    put(Store(tmp_path), 1)
    rename = shared_folder.Disk.rename

    def full(self, part, path):
        if path.endswith(".json"):
            raise OSError(errno.ENOSPC, os.strerror(errno.ENOSPC))
        rename(self, part, path)

    monkeypatch.setattr(shared_folder.Disk, "rename", full)
    assert Store(tmp_path).gc(budget=0).evicted == (key_of(1),)
    assert not [path for path in tmp_path.rglob("*") if key_of(1) in path.name]


@pytest.mark.parametrize("number", [errno.EACCES, errno.EROFS, errno.EPERM])
def test_what_is_not_ours_to_remove_is_passed_over(tmp_path, monkeypatch, number):
    for i in range(3):
        put(Store(tmp_path), i, seconds=float(i))
    rename = shared_folder.Disk.rename

    def mine(self, part, path):
        if key_of(0) in path:
            raise OSError(number, os.strerror(number))
        rename(self, part, path)

    monkeypatch.setattr(shared_folder.Disk, "rename", mine)
    swept = Store(tmp_path).gc(budget=2 * SIZE)
    assert swept.refused == (key_of(0),)
    assert key_of(1) in swept.evicted
    assert kept(tmp_path) == {0, 2} - {int(key[2:], 16) for key in swept.evicted}
    assert Store(tmp_path).get(key_of(0))[0] == 0


def test_a_budget_that_cannot_be_kept_is_not_counted_at_each_write(tmp_path, monkeypatch):
    store, counted = Store(tmp_path, budget=50 * SIZE), []
    total = budget_eviction.total
    monkeypatch.setattr(budget_eviction, "total", lambda disk: counted.append(1) or total(disk))
    monkeypatch.setattr(budget_eviction, "drop", lambda disk, key: False)
    for i in range(100):
        put(store, i)
    assert len(kept(tmp_path)) == 100
    assert len(counted) < 45


EVICTOR = """
import sys, warnings
from pathlib import Path
import torch
from neusee.workflows.store.result_store import Store
warnings.simplefilter("error")
torch.set_num_threads(1)
root, budget, first = Path(sys.argv[1]), int(sys.argv[2]), int(sys.argv[3])
for i in range(40):
    store = Store(root, budget=budget)
    n = (first + 7 * i) % 24
    key = f"{n % 256:02x}{n:030x}"
    if store.has(key):
        try:
            assert float(store.get(key)[0]) == n
        except KeyError:
            pass
    else:
        store.put(key, torch.full((5000,), float(n)), {"step": "s", "seconds": float(n)})
    store.gc()
"""


@pytest.mark.slow
def test_users_who_make_room_at_once_do_no_harm(tmp_path):
    command = [sys.executable, "-c", EVICTOR, str(tmp_path), str(8 * SIZE)]
    users = [
        subprocess.Popen([*command, str(5 * i)], stderr=subprocess.PIPE, text=True)
        for i in range(2)
    ]
    for user in users:
        assert user.communicate()[1] == ""
        assert user.returncode == 0
    store = Store(tmp_path)
    assert kept(tmp_path) == payloads(tmp_path)
    assert 0 < len(kept(tmp_path)) <= 8
    for n in kept(tmp_path):
        assert store.get(key_of(n)).tolist() == [float(n)] * N
    assert not (tmp_path / "bad").exists()
    assert {key for key, _ in store.entries()} == set(map(key_of, range(24)))


# what belongs to no result


def test_band_files_of_an_earlier_version_count_for_no_budget_and_go_after_a_week(
    tmp_path, monkeypatch
):
    """Results that name them are of another version: they are not read, and computed again."""
    put(Store(tmp_path), 1)
    size_before = budget_eviction.total(Store(tmp_path).disk)
    band = tmp_path / "bands" / "ab" / "ab.0"
    band.parent.mkdir(parents=True)
    band.write_bytes(b"x" * 5000)
    assert budget_eviction.total(Store(tmp_path).disk) == size_before
    assert Store(tmp_path).gc().orphans == 0
    monkeypatch.setattr(budget_eviction, "_WEEK", -1.0)
    swept = Store(tmp_path).gc()
    assert (swept.orphans, swept.freed) == (1, 5000)
    assert not band.exists()
    assert payloads(tmp_path) == {1}


def test_what_belongs_to_no_result_goes(tmp_path):
    store = Store(tmp_path)
    for i in range(3):
        put(store, i)
    (tmp_path / "00" / f"{key_of(0)}.json").unlink()
    swept = Store(tmp_path).gc()
    assert swept.orphans == 1
    assert swept.freed > SIZE
    assert payloads(tmp_path) == {1, 2}
    assert Store(tmp_path).gc().orphans == 0


def test_damaged_entries_go_after_a_week(tmp_path, monkeypatch):
    put(Store(tmp_path), 1)
    (tmp_path / "01" / f"{key_of(1)}.safetensors").write_bytes(b"x")
    with pytest.warns(UserWarning, match="is damaged"):
        assert not Store(tmp_path).has(key_of(1))
    assert Store(tmp_path).gc().orphans == 0
    now = time.time()
    monkeypatch.setattr(time, "time", lambda: now + 6.9 * 86400)
    assert Store(tmp_path).gc().orphans == 0
    monkeypatch.setattr(time, "time", lambda: now + 7.1 * 86400)
    assert Store(tmp_path).gc().orphans == 2
    assert not list((tmp_path / "bad").iterdir())


def test_pictures_go_with_their_entry_and_count(tmp_path, monkeypatch):
    store = Store(tmp_path)
    path = DerivedFiles(store).keep(
        key_of(1), ".png", "picture", lambda path: path.write_bytes(b"x" * 50_000)
    )
    stray = path.with_name(f"{key_of(257)}.png")
    stray.write_bytes(b"y")
    half = path.with_name(f".{key_of(257)}.77.png")
    half.write_bytes(b"y")
    put(store, 5)
    assert store.gc(budget=70_000).evicted == (key_of(1),)
    assert not path.exists()
    assert stray.exists()
    now = time.time()
    monkeypatch.setattr(time, "time", lambda: now + 3700)
    assert store.gc().orphans == 2
    assert not stray.exists()
    assert not half.exists()
    assert kept(tmp_path) == {5}


def test_an_entry_that_cannot_be_read_keeps_its_payload(tmp_path):
    put(Store(tmp_path), 1)
    path = tmp_path / "01" / f"{key_of(1)}.json"
    path.write_bytes(path.read_bytes()[:-5])
    assert Store(tmp_path).gc(budget=10**9).orphans == 0
    assert payloads(tmp_path) == {1}


def test_nothing_is_swept_where_there_is_nothing(tmp_path):
    swept = Store(tmp_path / "none").gc(budget=0)
    assert swept == type(swept)((), (), 0, 0, 0)
    assert not (tmp_path / "none").exists()


# --- borders --------------------------------------------------------------------------------------


class Folder:
    """A store of which only the number of bytes is known."""

    def __init__(self, monkeypatch, stored):
        self.stored, self.counted = stored, 0
        monkeypatch.setattr(budget_eviction, "total", self.total)

    def total(self, _):
        self.counted += 1
        return self.stored


@pytest.mark.parametrize(
    ("stored", "excess"), [(999, 0.0), (1000, 0.0), (1001, 101.0), (5000, 4100.0)]
)
def test_beyond_the_budget_a_tenth_of_it_is_freed_too(monkeypatch, stored, excess):
    """Nine tenths of the budget remain, so that the next write evicts nothing."""
    folder = Folder(monkeypatch, stored)
    assert budget_eviction.CacheBudget(folder, 1000).excess(1) == excess
    assert folder.counted == 1


def test_bytes_are_counted_again_after_a_twentieth_of_the_budget(monkeypatch):
    folder = Folder(monkeypatch, 100)
    budget = budget_eviction.CacheBudget(folder, 1000)
    counted = []
    for _ in range(11):
        assert budget.excess(10) == 0.0
        counted.append(folder.counted)
    assert counted == [1, 1, 1, 1, 1, 2, 2, 2, 2, 2, 3]


def test_near_the_budget_bytes_are_counted_as_soon_as_it_may_be_passed(monkeypatch):
    folder = Folder(monkeypatch, 980)
    budget = budget_eviction.CacheBudget(folder, 1000)
    assert budget.excess(1) == 0.0
    assert budget.excess(19) == 0.0
    assert folder.counted == 1
    folder.stored = 1002
    assert budget.excess(2) == pytest.approx(102.0)
    assert folder.counted == 2


def test_the_weight_halves_in_a_week_since_the_newest_use():
    week = 7 * 86400.0
    old = Candidate("old", 10, 20.0, 0.0)  # 1 s a byte, where all is of use now
    for seconds, first in ((10.1, "old"), (9.9, "new")):
        assert [c.key for c in chosen([old, Candidate("new", 10, seconds, week)], 1)] == [first]


def test_of_equal_weight_the_longest_unused_goes_first_and_then_the_key_decides():
    nothing = [
        Candidate("b", 10, 0.0, 5.0),
        Candidate("a", 10, -3.0, 5.0),
        Candidate("c", 10, 0.0, 1.0),
    ]
    assert [c.key for c in chosen(nothing, 25)] == ["c", "a", "b"]
    assert chosen(nothing, 0) == []
    assert chosen([Candidate("empty", 0, 0.0, 0.0)], 10) == []


def test_of_values_that_together_free_too_much_the_dearest_stays():
    first, second, third = (
        Candidate(name, size, 1.0 + i * size, 0.0)
        for i, (name, size) in enumerate((("first", 10), ("second", 10), ("third", 20)))
    )
    assert [c.key for c in chosen([first, second, third], 30)] == ["first", "third"]


def test_a_value_saves_its_time_without_that_of_reading_it(tmp_path):
    store = Store(tmp_path)
    put(store, 1, seconds=2.0)
    (one,) = budget_eviction.candidates(store.disk, (), lambda size: size / SIZE / 4)
    assert one.seconds == pytest.approx(2.0 - 0.25)
    assert SIZE <= one.size < SIZE + 1000


def test_all_bytes_but_receipts_are_those_of_the_values(tmp_path):
    store = Store(tmp_path)
    store.put(key_of(1), torch.rand(3, 2000), {"seconds": 5.0})
    store.put(key_of(2), torch.rand(2, 2000), {"seconds": 1.0})
    records = sum(path.stat().st_size for path in tmp_path.glob("[0-9a-f][0-9a-f]/*.json"))
    sizes = {c.key: c.size for c in budget_eviction.candidates(store.disk, (), lambda size: 0.0)}
    assert sum(sizes.values()) == pytest.approx(budget_eviction.total(store.disk) - records, abs=2)
    assert sizes[key_of(1)] == pytest.approx(3 / 5 * sum(sizes.values()), rel=0.05)


def test_a_value_that_this_program_does_not_read_saves_no_time_and_frees_its_record_too(
    tmp_path, monkeypatch
):
    put(Store(tmp_path), 1, seconds=100.0)
    monkeypatch.setenv("NEUSEE_CACHE_SECRET", "one")  # the record has no signature
    store = Store(tmp_path)
    (one,) = budget_eviction.candidates(store.disk, (), lambda size: 7.0)
    assert one.seconds == 0.0
    assert one.size == budget_eviction.total(store.disk)


def test_eviction_goes_on_until_enough_is_freed(tmp_path):
    store = Store(tmp_path)
    for i in range(4):
        put(store, i, seconds=float(i + 1))
    among = list(budget_eviction.candidates(store.disk, (), lambda size: 0.0))
    gone, refused = budget_eviction.evict(store.disk, among, 1.5 * SIZE, dry=True)
    assert (len(gone), refused) == (2, [])
    assert payloads(tmp_path) == {0, 1, 2, 3}
