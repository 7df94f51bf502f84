"""A stored answer that is damaged, forged, of another format or half written is a missing answer
and nothing else.
"""

import errno
import json
import os
import random
import signal
import subprocess
import sys
import textwrap
from pathlib import Path

import pytest

from neusee.workflows.answers import stored_answer
from neusee.workflows.answers import stored_answer as answer_upkeep
from neusee.workflows.answers.stored_answer import (
    Answer,
    packed,
    read_answer,
    unpacked,
    write_answer,
)
from neusee.workflows.answers.witnesses import Witnesses
from neusee.workflows.keys import sealed_files as seal
from neusee.workflows.keys.sealed_files import NotRead, OtherFormat, Unsigned, seal_file
from neusee.workflows.store.shared_folder import Disk

NAME, OTHER = "ab" + "0" * 30, "ab" + "1" * 30
FILES = {"report.html": b"<p>\n\0", "figures/a.png": b"", "limits.csv": b"1,2\n"}
ANSWER = Answer(
    "s",
    Witnesses({"/a": "1"}, ["/b"], {"/c": "2"}, {}),
    "text",
    False,
    "runs",
    "mine_safety",
    "8" * 8,
    FILES,
)


@pytest.fixture
def disk(tmp_path, monkeypatch):
    monkeypatch.delenv("NEUSEE_CACHE_SECRET", raising=False)
    return Disk(tmp_path / "cache")


@pytest.fixture
def stored(disk):
    assert write_answer(disk, NAME, ANSWER)
    return Path(stored_answer.answer_path(disk, NAME))


def sealed(name=NAME, **changed):
    """The bytes of an answer with another field, under a seal that is right."""
    head, _, rest = packed(NAME, ANSWER).partition(b"\n")[2].partition(b"\n")
    content = json.dumps(json.loads(head) | changed).encode() + b"\n" + rest
    return seal_file("answer", f"answers/{name}", content) + b"\n" + content


def test_an_answer_is_read_as_it_was_written(disk, stored):
    assert read_answer(disk, NAME) == ANSWER
    assert os.listdir(disk.root / "tmp") == []


def test_every_damaged_byte_and_every_shorter_file_is_a_missing_answer():
    raw, drawn = packed(NAME, ANSWER), random.Random(3)
    spoilt = [raw[:length] for length in range(len(raw))]
    for at in range(len(raw)):
        wrong = bytearray(raw)
        wrong[at] ^= 1 << drawn.randrange(8)
        spoilt.append(bytes(wrong))
    for each in spoilt:
        with pytest.raises((ValueError, KeyError, TypeError)):
            unpacked(NAME, each)


@pytest.mark.parametrize(
    "raw", [b"", b"\n\n", b"{}\n{}\n", b"\x80PK" * 99, sealed()[:-1], sealed() + b"x"]
)
def test_a_damaged_answer_is_missing_and_moved_aside(disk, stored, raw):
    stored.write_bytes(raw)
    assert read_answer(disk, NAME) is None
    assert not stored.exists()
    assert (disk.root / "bad" / stored.name).read_bytes() == raw
    assert write_answer(disk, NAME, ANSWER)
    assert read_answer(disk, NAME) == ANSWER


@pytest.mark.parametrize(
    "changed",
    [
        {"files": [["../../evil", 5], ["b", 0], ["c", 4]]},
        {"files": [["/etc/evil", 5], ["b", 0], ["c", 4]]},
        {"files": [["a/../../evil", 5], ["b", 0], ["c", 4]]},
        {"files": [[".hidden", 5], ["b", 0], ["c", 4]]},
        {"files": [["a\n", 5], ["b", 0], ["c", 4]]},
        {"files": [["a", 999]]},
        {"files": [["a", -1], ["b", 10]]},
        {"files": {"a": 1}},
        {"files": None},
        {"label": "../evil"},
        {"label": ""},
        {"key": "a/b"},
        {"key": 3},
        {"witnesses": {}},
        {"witnesses": None},
        {"evil": 1},
        {"text": 1},
        {"out": None},
        {"witnesses": {"files": [], "absent": [], "recipes": {}, "listed": {}}},
        {"witnesses": {"files": {}, "absent": "ab", "recipes": {}, "listed": {}}},
        {"witnesses": {"files": {}, "absent": [1], "recipes": {}, "listed": {}}},
        {"witnesses": {"files": {"/a": 1}, "absent": [], "recipes": {}, "listed": {}}},
        {"kind": 1},
        {"memory": "0"},
        {"stored": None},
        {"stored": {"evil": {}}},
        {"stored": {"results": {"../../evil": ""}}},
        {"stored": {"results": {"ab/../cd": ""}}},
        {"stored": {"results": {"ab12": 1}}},
        {"stored": {"results": ["ab12"]}},
        {"stored": {"results": {}, "loaded": ["ab12"]}},
        {"stored": {"results": {"ab12": ""}, "loaded": 3}},
        {"stored": {"files": {"/etc/passwd": "0"}}},
        {"stored": {"files": {"files/ab/../../../evil": "0"}}},
        {"stored": {"files": {"files/ab/.hidden": "0"}}},
        {"stored": {"files": {"files/ab/x.png": 0}}},
        {"stored": {"files": {}, "taken": {"figures/a.png": "files/ab/x.png"}}},
        {"stored": {"files": {"files/ab/x.png": "0"}, "taken": {"../evil.png": "files/ab/x.png"}}},
        {
            "stored": {
                "files": {"files/ab/x.png": "0"},
                "taken": {"/tmp/evil.png": "files/ab/x.png"},
            }
        },
        {"stored": {"files": {"files/ab/x.png": "0"}, "taken": {"a/../../evil": "files/ab/x.png"}}},
    ],
    ids=str,
)
def test_an_answer_that_names_a_place_outside_of_its_folder_is_missing(disk, stored, changed):
    stored.write_bytes(sealed(**changed))
    assert read_answer(disk, NAME) is None


def test_the_answer_of_another_command_is_missing(disk, stored):
    other = Path(stored_answer.answer_path(disk, OTHER))
    stored.rename(other)
    assert read_answer(disk, OTHER) is None


def test_an_answer_of_another_format_is_left_alone(disk, stored, monkeypatch):
    monkeypatch.setattr(seal, "FORMAT", seal.FORMAT + 1)
    assert read_answer(disk, NAME) is None
    assert stored.exists()
    with pytest.raises(OtherFormat):
        unpacked(NAME, stored.read_bytes())


def test_with_a_secret_only_a_signed_answer_is_read(disk, stored, monkeypatch):
    monkeypatch.setenv("NEUSEE_CACHE_SECRET", "ours")
    assert read_answer(disk, NAME) is None
    assert stored.exists(), "another user without the secret still reads it"
    write_answer(disk, NAME, ANSWER)
    assert read_answer(disk, NAME) == ANSWER
    monkeypatch.setenv("NEUSEE_CACHE_SECRET", "new, ours")
    assert read_answer(disk, NAME) == ANSWER
    monkeypatch.setenv("NEUSEE_CACHE_SECRET", "theirs")
    assert read_answer(disk, NAME) is None
    forged = sealed(text="you are safe")
    monkeypatch.setenv("NEUSEE_CACHE_SECRET", "ours")
    stored.write_bytes(forged)
    assert read_answer(disk, NAME) is None
    with pytest.raises(Unsigned):
        unpacked(NAME, forged)


def test_a_signature_does_not_pass_to_another_content(disk, monkeypatch):
    monkeypatch.setenv("NEUSEE_CACHE_SECRET", "ours")
    signed = packed(NAME, ANSWER).partition(b"\n")[0]
    monkeypatch.delenv("NEUSEE_CACHE_SECRET")
    forged = sealed(text="you are safe").partition(b"\n")[2]
    monkeypatch.setenv("NEUSEE_CACHE_SECRET", "ours")
    with pytest.raises(ValueError, match="is not what was sealed") as refused:
        unpacked(NAME, signed + b"\n" + forged)
    assert not isinstance(refused.value, NotRead)


@pytest.mark.parametrize("kind", ["folder", "pipe", "link to a pipe", "link to nothing", "large"])
def test_what_is_no_file_in_place_of_an_answer_is_missing(disk, stored, kind, monkeypatch):
    stored.unlink()
    if kind == "folder":
        stored.mkdir()
    elif kind == "large":
        monkeypatch.setattr(stored_answer, "MOST_BYTES", 10)
        stored.write_bytes(bytes(20))
    else:
        pipe = stored.with_name("pipe")
        if kind != "link to nothing":
            os.mkfifo(pipe)
        pipe.rename(stored) if kind == "pipe" else stored.symlink_to(pipe)
    assert read_answer(disk, NAME) is None


def test_a_link_in_place_of_an_answer_is_replaced_and_not_followed(disk, stored, tmp_path):
    (target := tmp_path / "precious").write_text("mine")
    stored.unlink()
    stored.symlink_to(target)
    assert write_answer(disk, NAME, ANSWER)
    assert target.read_text() == "mine"
    assert not stored.is_symlink()


def test_an_answer_that_is_too_large_is_not_kept(disk, monkeypatch):
    monkeypatch.setattr(stored_answer, "MOST_BYTES", 100)
    assert not write_answer(disk, NAME, ANSWER)
    assert not (disk.root / "answers").exists()


# --- writing that fails ---------------------------------------------------------------------------


@pytest.mark.parametrize("fault", ["full", "refused", "no folder"])
def test_a_cache_that_cannot_be_written_costs_nothing_but_the_answer(place, monkeypatch, fault):
    def fail(*_, **__):
        raise OSError(errno.ENOSPC, "No space left on device")

    place.words.append("another=1")
    if fault == "full":
        monkeypatch.setattr(Disk, "share", fail)
    elif fault == "refused":
        monkeypatch.setattr(Disk, "rename", fail)
    else:
        (place.root / "cache" / "answers").rename(place.root / "gone")
        (place.root / "cache" / "answers").write_text("a file")
    assert place.again()
    assert place.again()
    assert not list((place.root / "cache" / "tmp").glob("*.answer*"))


WRITER = """
    import os, signal, sys
    from neusee.workflows.answers.stored_answer import Answer, write_answer
    from neusee.workflows.answers.witnesses import Witnesses
    from neusee.workflows.store.shared_folder import Disk

    if sys.argv[2] == "killed":
        Disk.rename = lambda *_: os.kill(os.getpid(), signal.SIGKILL)
    text = sys.argv[2] * 20_000
    answer = Answer("s", Witnesses({}, [], {}, {}), text, False, "o", "l", "k", {})
    for _ in range(40):
        write_answer(Disk(sys.argv[1]), "ab" + "0" * 30, answer)
    assert "torch" not in sys.modules
"""


def writer(disk, text):
    code = textwrap.dedent(WRITER).replace(
        "Disk(sys.argv[1])", "Disk(__import__('pathlib').Path(sys.argv[1]))"
    )
    return subprocess.Popen([sys.executable, "-c", code, str(disk.root), text])


def test_a_process_that_is_killed_while_it_writes_leaves_the_answer_as_it_was(disk, stored):
    assert writer(disk, "killed").wait() == -signal.SIGKILL
    assert read_answer(disk, NAME) == ANSWER
    assert len(os.listdir(disk.root / "tmp")) == 1
    assert write_answer(Disk(disk.root), OTHER, ANSWER)
    assert os.listdir(disk.root / "tmp") == [], "the next writer removes what a dead process left"


def test_two_processes_at_once_leave_a_whole_answer_at_any_time(disk, stored):
    writers = [writer(disk, text) for text in ("a", "b")]
    seen = set()
    while any(process.poll() is None for process in writers):
        found = read_answer(disk, NAME)
        assert found is not None
        seen.add(found.text[:4])
    assert [process.wait() for process in writers] == [0, 0]
    assert read_answer(disk, NAME).text in ("a" * 20_000, "b" * 20_000)
    assert seen <= {"text", "aaaa", "bbbb"}


# --- upkeep ---------------------------------------------------------------------------------------


def many(disk, count):
    for i in range(count):
        name = f"{i:02x}" + "0" * 30
        write_answer(disk, name, ANSWER)
        os.utime(stored_answer.answer_path(disk, name), (10**9 + i, 10**9 + i))


def names(disk):
    return [int(each.name[:2], 16) for each in answer_upkeep.answers(disk)]


def test_the_answers_that_were_not_used_for_longest_make_room(disk, monkeypatch):
    many(disk, 6)
    size = answer_upkeep.answers(disk)[0].size
    monkeypatch.setattr(answer_upkeep, "COUNT", 5)
    stored_answer.used(disk, "00" + "0" * 30)
    answer_upkeep.make_room(disk)
    assert names(disk) == [0, 5, 4, 3, 2]
    monkeypatch.setattr(answer_upkeep, "BYTES", 3 * size)
    answer_upkeep.make_room(disk)
    assert names(disk) == [0, 5, 4]
    answer_upkeep.make_room(disk, budget=40 * size)
    assert names(disk) == [0, 5]


def test_a_week_without_use_ends_an_answer(disk):
    many(disk, 3)
    stored_answer.used(disk, "01" + "0" * 30)
    assert len(answer_upkeep.sweep(disk, dry=True)) == 2
    assert len(names(disk)) == 3
    assert len(answer_upkeep.sweep(disk)) == 2
    assert names(disk) == [1]
    assert len(answer_upkeep.sweep(disk, everything=True)) == 1
    assert names(disk) == []


def test_the_check_of_all_answers_finds_the_damaged_one(disk, monkeypatch):
    many(disk, 3)
    path = Path(stored_answer.answer_path(disk, "01" + "0" * 30))
    path.write_bytes(path.read_bytes()[:-1])
    whole, damaged = answer_upkeep.check(disk)
    assert [len(whole), [each.name[:2] for each in damaged]] == [2, ["01"]]
    assert answer_upkeep.check(disk)[1] == []


def test_a_link_in_the_folder_of_answers_leads_nowhere(disk, tmp_path):
    (away := tmp_path / "away").mkdir()
    (away / f"{NAME}.answer").write_text("precious")
    os.utime(away / f"{NAME}.answer", (0, 0))
    disk.prepare()
    (disk.root / "answers").mkdir()
    (disk.root / "answers" / "ab").symlink_to(away)
    assert answer_upkeep.sweep(disk, everything=True) == []
    assert (away / f"{NAME}.answer").exists()
