"""What `neusee cache` prints."""

import re

import pytest
import torch

from neusee.workflows.answers.stored_answer import Answer, write_answer
from neusee.workflows.answers.witnesses import Witnesses
from neusee.workflows.cli import cache_commands
from neusee.workflows.store.cache_settings import format_size
from neusee.workflows.store.derived_files import DerivedFiles
from neusee.workflows.store.result_store import Store

KEYS = ["ab" + "0" * 30, "ab" + "1" * 30, "cd" + "0" * 30]


@pytest.fixture
def store(tmp_path):
    found = Store(tmp_path)
    for i, key in enumerate(KEYS[:2]):
        value = torch.full((5000,), float(i))
        found.put(
            key,
            value,
            {
                "step": f"s{i}",
                "recipe": "r",
                "seconds": i + 0.5,
                "date": f"2026-01-0{i + 1}T00:00:00",
            },
        )
    found.put_receipt(
        KEYS[2],
        {"step": "n", "recipe": "r", "seconds": 0.1, "bytes": 7, "date": "2026-01-03T00:00:00"},
    )
    return found


def test_results_are_listed_the_newest_last(store):
    store.pin(KEYS[0])
    assert list(cache_commands.ls_lines(store)) == [
        "date                 bytes  seconds  step  recipe  key",
        "2026-01-01 00:00:00  20 kB  0.500    s0    r       ab000000  pinned",
        "2026-01-02 00:00:00  20 kB  1.500    s1    r       ab111111",
        "2026-01-03 00:00:00  7 B    0.100    n     r       cd000000  receipt",
        f"2 results, 40 kB, in {store.root}; of 1 more result the receipt alone",
    ]


def test_an_empty_store_is_listed(tmp_path):
    assert list(cache_commands.ls_lines(Store(tmp_path / "none", budget=10**9))) == [
        f"0 results, 0 B, in {tmp_path / 'none'}; the budget is 1 GB"
    ]


def test_a_sound_store_is_verified(store):
    DerivedFiles(store).keep(
        "ef" * 16, ".png", "picture", lambda path: path.write_bytes(b"x" * 980_000)
    )
    assert cache_commands.verify_lines(store) == (["3 results, 1.02 MB, as written"], 0)


@pytest.mark.parametrize("mode", ["always", "never"])
def test_what_is_damaged_is_named_and_put_aside(store, mode):
    picture = DerivedFiles(store).keep(
        "ef" * 16, ".png", "picture", lambda path: path.write_bytes(b"x" * 1000)
    )
    picture.chmod(0o644)
    picture.write_bytes(b"y" * 1000)
    for key, suffix, at in ((KEYS[0], "safetensors", -1), (KEYS[2], "json", 20)):
        path = store.root / key[:2] / f"{key}.{suffix}"
        data = bytearray(path.read_bytes())
        data[at] ^= 1
        path.write_bytes(data)
    lines, bad = cache_commands.verify_lines(Store(store.root, verify=mode))
    assert bad == 3
    assert lines[:3] == [
        f"{KEYS[0]}  s0  checksum mismatch: the stored bytes have changed since they were written",
        f"{KEYS[2]}  ?  checksum mismatch: the metadata have changed since they were written",
        f"{'ef' * 16}  picture  its file {picture.name} is not what was written",
    ]
    assert lines[3].startswith("1 result, 20 kB, as written; 3 damaged, put aside in ")
    assert {path.stem for path in (store.root / "bad").iterdir()} == {KEYS[0], KEYS[2], "ef" * 16}
    assert cache_commands.verify_lines(Store(store.root)) == (["1 result, 20 kB, as written"], 0)


def test_room_is_made(store):
    dry = cache_commands.gc_lines(store, "30 kB", dry=True)
    assert dry[0] == "20 kB  0.500  s0  ab000000"
    assert dry[1].startswith("1 value and 0 files that belonged to no result would go: 2")
    assert store.has(KEYS[0])
    done = cache_commands.gc_lines(store, "30 kB")
    assert done[0] == dry[0]
    assert done[1].startswith("1 value and 0 files that belonged to no result went: 2")
    assert done[1].endswith(f" stay in {store.root}")
    assert not store.has(KEYS[0])
    assert store.has(KEYS[1])
    assert cache_commands.gc_lines(store)[0].startswith("0 values and 0 files")
    with pytest.raises(ValueError, match="'a lot' is not a size"):
        cache_commands.gc_lines(store, "a lot")


def test_a_value_is_pinned_by_the_beginning_of_its_key(store):
    assert cache_commands.pin_lines(store, "AB0") == [f"pinned: {KEYS[0]}  s0"]
    assert store.pinned() == {KEYS[0]}
    with pytest.raises(
        ValueError, match="'ab' must be the start of the key of one value: it matches ab000"
    ):
        cache_commands.pin_lines(store, "ab")
    with pytest.raises(
        ValueError, match="'cd' must be the start of the key of one value: it matches no key"
    ):
        cache_commands.pin_lines(store, "cd")
    with pytest.raises(ValueError, match="'ab1' must be the start of the key of one pinned value"):
        cache_commands.pin_lines(store, "ab1", pin=False)
    assert cache_commands.pin_lines(store, "ab0", pin=False) == [f"no longer pinned: {KEYS[0]}  s0"]
    assert store.pinned() == set()


def test_the_answers_of_commands_are_listed_verified_and_removed(store):
    for name in ("ab" + "0" * 30, "cd" + "0" * 30):
        write_answer(
            store.disk,
            name,
            Answer("s", Witnesses({}, [], {}, {}), "x" * 20_000, False, "o", "l", "k", {}),
        )
    sizes = [each.stat().st_size for each in (store.root / "answers").rglob("*.answer")]
    words = f"2 answers of commands of {format_size(sum(sizes))}"
    assert list(cache_commands.ls_lines(store))[-1].startswith(f"2 results, 40 kB, in {store.root}")
    assert words in list(cache_commands.ls_lines(store))[-1]
    assert cache_commands.verify_lines(store) == ([f"2 results, 40 kB, {words}, as written"], 0)
    path = next((store.root / "answers").rglob("cd*.answer"))
    path.write_bytes(path.read_bytes()[:-1])
    lines, bad = cache_commands.verify_lines(store)
    assert (bad, lines[0]) == (
        1,
        f"{'cd' + '0' * 30}  the answer of a command, which is not what was written",
    )
    assert cache_commands.gc_lines(store)[0].startswith("0 values and 0 files")
    assert len(list((store.root / "answers").rglob("*.answer"))) == 1, (
        "one that was used this week stays"
    )
    assert cache_commands.gc_lines(store, "1 MB")[-1].startswith("0 values")
    assert re.fullmatch(
        "1 answer of commands of 20.* kB would go",
        cache_commands.gc_lines(store, "60 kB", dry=True)[0],
    )
    assert re.fullmatch(
        "1 answer of commands of 20.* kB went", cache_commands.gc_lines(store, "60 kB")[0]
    )
    assert not list((store.root / "answers").rglob("*.answer"))


def test_a_long_list_shows_its_newest_page_and_says_how_to_see_all(tmp_path, monkeypatch):
    """The journal tells number and bytes; a result that is gone since is not shown."""
    store = Store(tmp_path)
    for i in range(60):
        store.put(
            f"{i:032x}",
            torch.full((2000,), float(i)),
            {"step": f"s{i}", "date": f"2026-01-01T00:00:{i:02d}"},
        )
    short = list(cache_commands.ls_lines(store))
    monkeypatch.setattr("neusee.workflows.store.journal._LATEST", 17_000)
    again = Store(tmp_path)
    assert again.journal.is_long()
    assert 50 < len(again.journal.latest()) < 60  # a part
    long = list(cache_commands.ls_lines(again))
    assert long[:-1] == short[:-1]
    assert long[-2:] == [
        "the newest 50; `neusee cache ls --all` lists all",
        f"60 results, 480 kB by the journal, in {store.root}",
    ]
    assert len(list(cache_commands.ls_lines(again, every=True))) == 62
    for suffix in ("json", "safetensors"):
        (tmp_path / "00" / f"{59:032x}.{suffix}").unlink()
    assert not any("s59" in line for line in cache_commands.ls_lines(Store(tmp_path)))
