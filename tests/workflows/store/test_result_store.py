"""What the store gives back, and what it does when the disk does not."""

import errno
import json
import os
import signal
import subprocess
import sys
import tempfile
import time
import warnings
from contextlib import suppress
from itertools import product
from pathlib import Path

import pytest
import torch
import xxhash
from hypothesis import given
from hypothesis import strategies as st
from safetensors.torch import load_file

from neusee.nodes.values import Bands, Pupil
from neusee.workflows.keys.sealed_files import seal_record, unseal_record
from neusee.workflows.store import metadata, serialization
from neusee.workflows.store import payload as payload_module
from neusee.workflows.store.metadata import INLINE
from neusee.workflows.store.result_store import Store, default_root

KEY = "ab" + "0" * 30
SUM = xxhash.xxh3_128_hexdigest
BIG = torch.arange(5000, dtype=torch.float32)
DTYPES = [*serialization._DTYPES, torch.complex64, torch.complex128]
SHAPES = [(), (0,), (3, 0, 2), (1,), (3, 5), (INLINE + 3,)]


def bits(x):
    return bytes(x.resolve_conj().contiguous().reshape(-1).view(torch.uint8).numpy())


def same(a, b):
    """Equal to the last bit, in type, in shape and in kind of container."""
    assert type(a) is type(b)
    if isinstance(a, torch.Tensor):
        assert a.shape == b.shape
        assert a.dtype == b.dtype
        assert bits(a) == bits(b)
    elif isinstance(a, list | tuple):
        assert len(a) == len(b)
        for x, y in zip(a, b, strict=True):
            same(x, y)
    elif isinstance(a, dict):
        assert list(a) == list(b)
        for name in a:
            same(a[name], b[name])
    else:
        assert repr(a) == repr(b)


def keep(root, value, key=KEY):
    assert Store(root).put(key, value, {"step": "s"})
    return Store(root).get(key)


def test_every_type_and_shape_comes_back(tmp_path):
    wrong = []
    for number, (dtype, shape) in enumerate(product(DTYPES, SHAPES)):
        count = torch.Size(shape).numel() * torch.empty(0, dtype=dtype).element_size()
        raw = torch.randint(0, 2 if dtype == torch.bool else 255, (count,), dtype=torch.uint8)
        x = raw.view(dtype).reshape(shape) if count else torch.empty(shape, dtype=dtype)
        back = keep(tmp_path / str(number), x)
        if (type(back), back.dtype, back.shape, bits(back)) != (type(x), dtype, x.shape, bits(x)):
            wrong.append((dtype, shape))
    assert wrong == []


@pytest.mark.parametrize("n", [4, 100])
def test_views_come_back_as_what_they_show(tmp_path, n):
    x = torch.randn(n, n, dtype=torch.complex64)
    views = [
        x.T,
        x[::2, 1:],
        x.conj(),
        x.imag,
        x[0].expand(n, n),
        torch.view_as_real(x),
        x[1, 1],
        -x.conj().imag,
    ]
    same(keep(tmp_path, views), [v.resolve_conj().resolve_neg() for v in views])


@pytest.mark.parametrize("n", [2, 2000])
def test_collections_come_back(tmp_path, n):
    x = torch.rand(n, dtype=torch.float64)
    weights = {"layer.0.weight": x, "layer.0.bias": x[:1], "empty": torch.empty(0)}
    plain = [
        None,
        True,
        3,
        -0.0,
        float("nan"),
        float("inf"),
        5e-324,
        "µ",
        b"\x00\xff",
        b"",
        b"z" * n,
        [],
        {},
        (),
    ]
    value = [Bands(x, x, x), weights, plain, (x, [x]), {"a": {"b": [Bands(x, x + 1, x)]}}]
    same(keep(tmp_path, value), value)


def test_a_learnable_value_is_stored_without_its_history(tmp_path):
    x = torch.ones(3, requires_grad=True)
    assert not keep(tmp_path, 2 * x).requires_grad


@given(st.lists(st.integers(0, 300), max_size=6))
def test_each_stored_tensor_begins_where_a_fresh_one_would(tmp_path_factory, sizes):
    root = tmp_path_factory.mktemp("store")
    value = [torch.rand(2000), *(torch.rand(n) for n in sizes)]
    loaded = keep(root, value)
    same(loaded, value)
    assert all(x.data_ptr() % 64 == 0 for x in loaded if x.numel())


def test_shared_memory_is_stored_once(tmp_path):
    x = torch.rand(100, 100)
    loaded = keep(tmp_path, Pupil(x, x, x, x.clone(), x[0], x[0], x[0, 0]))
    assert loaded.aperture is loaded.amplitude
    assert sum(f.stat().st_size for f in tmp_path.rglob("*.safetensors")) < 2 * x.nbytes + 2000


def test_other_tools_can_read_a_payload(tmp_path):
    x = torch.rand(100, 100, dtype=torch.float64)
    keep(tmp_path, [x, x.bool(), x.bfloat16()])
    (path,) = tmp_path.rglob("*.safetensors")
    loaded = load_file(path)
    same([loaded["0"], loaded["1"], loaded["2"]], [x, x.bool(), x.bfloat16()])
    assert Store(tmp_path).about(KEY)["payload"]["xxh3"] == xxhash.xxh3_128_hexdigest(
        path.read_bytes()
    )


def test_a_loaded_value_may_be_written_to_without_touching_the_store(tmp_path):
    keep(tmp_path, BIG).zero_()
    same(Store(tmp_path).get(KEY), BIG)


class Own(tuple):
    _fields = ()


@pytest.mark.parametrize(
    "value", [object(), {1: 2}, Own(), {3}, torch.empty(2, dtype=torch.float8_e4m3fnuz)]
)
def test_what_cannot_be_stored_is_refused(tmp_path, value):
    with pytest.raises(TypeError, match=r"must return tensors|cannot be stored"):
        Store(tmp_path).put(KEY, [value], {})
    assert not Store(tmp_path).has(KEY)


def test_a_missing_result_is_missing(tmp_path):
    assert not Store(tmp_path / "none").has(KEY)
    with pytest.raises(KeyError):
        Store(tmp_path).get(KEY)


def test_entries_are_listed_without_reading_them(tmp_path, monkeypatch):
    store = Store(tmp_path)
    keys = [f"{i:02x}" + "1" * 30 for i in (200, 3, 77)]
    for key in keys:
        store.put(key, BIG, {"step": key[:2], "seconds": 1.5})
    monkeypatch.setattr(serialization, "read", lambda *a: pytest.fail("a payload was read"))
    found = dict(Store(tmp_path).entries())
    assert list(found) == sorted(keys)
    assert all(about["bytes"] == BIG.nbytes and about["seconds"] == 1.5 for about in found.values())


ACTS = [
    "put",
    "note",
    "get",
    "has",
    "gc",
    "evict",
    "pin",
    "unpin",
    "new",
    "claim",
    "check",
    "forget the journal",
]


@given(
    st.lists(st.tuples(st.sampled_from(ACTS), st.integers(0, 3), st.integers(0, 1)), max_size=40)
)
def test_whatever_two_users_do_no_value_is_wrong(tmp_path_factory, acts):
    """No act but an eviction loses a value, none serves another's, and none is taken for damage."""
    root, there = tmp_path_factory.mktemp("store"), set()
    users = [Store(root), Store(root)]
    for act, i, user in acts:
        store, key = users[user], f"{i:02x}" + "7" * 30
        value = torch.full((10 if i % 2 else 3000,), float(i))
        if act == "put":
            assert store.put(key, value, {"step": f"s{i}", "seconds": float(i)})
            there.add(key)
        elif act == "note":
            assert store.put_receipt(key, {"step": f"s{i}", "seconds": float(i)})
        elif act == "get" and key in there:
            same(store.get(key), value)
        elif act == "gc":
            assert store.gc().evicted == ()
        elif act == "evict":
            there -= set(store.gc(budget=5000).evicted)
        elif act == "pin":
            store.pin(key)
        elif act == "unpin":
            store.unpin(key)
        elif act == "new":
            users[user] = Store(root)
        elif act == "claim":
            store.claim(key).release()
        elif act == "check":
            assert {found.key for found in store.check() if found.about.get("kept")} == there
        elif act == "forget the journal":
            (root / "journal.jsonl").unlink(missing_ok=True)
        assert Store(root).has(key) == (key in there)
        assert {row["key"] for row in store.journal.rows()} == {
            key for key, _ in Store(root).entries()
        }


def payload(root: Path) -> Path:
    return root / "ab" / f"{KEY}.safetensors"


def sidecar(root: Path) -> Path:
    return root / "ab" / f"{KEY}.json"


def flip(path: Path, at: float) -> None:
    data = bytearray(path.read_bytes())
    data[int(at * (len(data) - 1))] ^= 1
    path.write_bytes(data)


def cut(path: Path) -> None:
    path.write_bytes(path.read_bytes()[: path.stat().st_size // 2])


DAMAGES = {
    "payload cut": lambda r: cut(payload(r)),
    "payload of no bytes": lambda r: payload(r).write_bytes(b""),
    "payload gone": lambda r: payload(r).unlink(),
    "payload longer": lambda r: payload(r).write_bytes(payload(r).read_bytes() + b"x"),
    "description cut": lambda r: cut(sidecar(r)),
    "description of no bytes": lambda r: sidecar(r).write_bytes(b""),
    "description is no text": lambda r: sidecar(r).write_bytes(b"\xff" * 100),
    "description is other JSON": lambda r: sidecar(r).write_text("{}"),
    "description was edited": lambda r: sidecar(r).write_text(
        sidecar(r).read_text().replace('"s"', '"t"')
    ),
    **{
        f"payload flipped at {at}": lambda r, at=at: flip(payload(r), at)
        for at in (0.0, 0.003, 0.5, 1.0)
    },
    **{
        f"description flipped at {at}": lambda r, at=at: flip(sidecar(r), at)
        for at in (0.0, 0.3, 0.9, 1.0)
    },
}


@pytest.mark.parametrize("damage", DAMAGES)
def test_a_damaged_entry_is_put_aside_with_one_warning(tmp_path, damage):
    keep(tmp_path, BIG)
    DAMAGES[damage](tmp_path)
    store = Store(tmp_path)
    with pytest.warns(UserWarning, match="is damaged") as seen, pytest.raises(KeyError):
        store.get(KEY)
    assert len(seen) == 1
    assert not store.has(KEY)
    assert not Store(tmp_path).has(KEY)
    assert list((tmp_path / "bad").iterdir())
    same(keep(tmp_path, BIG), BIG)


def test_an_entry_under_a_wrong_name_is_not_served(tmp_path):
    keep(tmp_path, BIG)
    other = "ab" + "1" * 30
    for suffix in ("json", "safetensors"):
        os.link(tmp_path / "ab" / f"{KEY}.{suffix}", tmp_path / "ab" / f"{other}.{suffix}")
    with pytest.warns(UserWarning, match=f"belong to the key {KEY}"):
        assert not Store(tmp_path).has(other)


@given(st.integers(0, 10**6), st.integers(0, 7))
def test_no_flipped_bit_of_a_small_result_goes_unseen(tmp_path_factory, place, bit):
    root = tmp_path_factory.mktemp("store")
    keep(root, [torch.rand(3), 1.5])
    data = bytearray(sidecar(root).read_bytes())
    data[place % len(data)] ^= 1 << bit
    sidecar(root).write_bytes(data)
    with pytest.warns(UserWarning, match="is damaged"):
        assert not Store(root).has(KEY)


def test_what_cannot_be_put_aside_is_still_not_served(tmp_path, monkeypatch):
    keep(tmp_path, BIG)
    flip(payload(tmp_path), 0.5)
    store = Store(tmp_path)
    monkeypatch.setattr(os, "replace", raiser(errno.EROFS))
    with pytest.warns(UserWarning, match="is damaged"), pytest.raises(KeyError):
        store.get(KEY)
    assert not store.has(KEY)
    monkeypatch.undo()
    assert store.put(KEY, BIG, {})
    same(store.get(KEY), BIG)


def raiser(number):
    def fail(*args, **options):
        raise OSError(number, os.strerror(number))

    return fail


@pytest.mark.parametrize(
    "where", ["os.fsync", "os.replace", "neusee.workflows.store.serialization.write"]
)
@pytest.mark.parametrize("number", [errno.ENOSPC, errno.EROFS, errno.EIO])
def test_a_disk_that_fails_costs_one_warning_and_leaves_nothing(
    tmp_path, monkeypatch, where, number
):
    store = Store(tmp_path)
    with monkeypatch.context() as broken:
        broken.setattr(where, raiser(number))
        with pytest.warns(UserWarning, match="cannot be written") as seen:
            kept = [store.put(key, BIG, {}) for key in (KEY, "cd" + "0" * 30)]
    assert kept == [False, False]
    assert len(seen) == 1
    assert not store.has(KEY)
    assert not [f for f in tmp_path.rglob("*") if f.is_file() and f.name != ".lock"]
    assert store.put(KEY, BIG, {})
    same(store.get(KEY), BIG)


def test_a_root_that_is_a_file_costs_one_warning(tmp_path):
    root = tmp_path / "file"
    root.write_text("in the way")
    store = Store(root)
    assert not store.has(KEY)
    with pytest.warns(UserWarning, match="cannot be written") as seen:
        kept = [store.put(KEY, value, {}) for value in (BIG, torch.zeros(1))]
    assert kept == [False, False]
    assert len(seen) == 1
    assert not list(store.entries())


def test_a_partial_write_has_no_name(tmp_path, monkeypatch):
    monkeypatch.setattr(os, "fsync", lambda fd: (_ for _ in ()).throw(KeyboardInterrupt))
    with pytest.raises(KeyboardInterrupt):
        Store(tmp_path).put(KEY, BIG, {})
    assert not list(tmp_path.rglob("*.safetensors"))
    assert not Store(tmp_path).has(KEY)
    assert [f.name for f in (tmp_path / "tmp").iterdir()] == []


def test_a_payload_without_a_description_is_no_result(tmp_path):
    keep(tmp_path, BIG)
    sidecar(tmp_path).unlink()
    assert not Store(tmp_path).has(KEY)
    same(keep(tmp_path, BIG + 1), BIG + 1)


def test_the_first_of_two_writers_stays(tmp_path):
    one, two = Store(tmp_path), Store(tmp_path)
    assert one.put(KEY, BIG, {"step": "one"})
    assert two.put(KEY, BIG + 1, {"step": "two"})
    for store in (one, two, Store(tmp_path)):
        same(store.get(KEY), BIG)
        assert store.about(KEY)["step"] == "one"


def test_what_killed_processes_left_is_swept_after_an_hour(tmp_path):
    folder = tmp_path / "tmp"
    folder.mkdir()
    for name, age in (("old", 3700), ("young", 3500)):
        (folder / name).write_text("half")
        os.utime(folder / name, (time.time() - age,) * 2)
    keep(tmp_path, BIG)
    assert {f.name for f in folder.iterdir()} == {"young", ".lock"}


WRITERS = """
import os, signal, sys
from pathlib import Path
import torch
from neusee.workflows.store.result_store import Store
torch.set_num_threads(1)

def write(root):
    for i in range(10_000):
        if i == 2:
            os.write(1, b"ready %d\\n" % os.getpid())
        key = f"{i % 40:02x}" + "5" * 30
        store = Store(root)
        if not store.has(key):
            store.put(key, torch.full((200_000,), float(i % 40)), {"step": "s"})
        elif i % 3 == 0:
            (root / key[:2] / f"{key}.json").unlink(missing_ok=True)

signal.signal(signal.SIGCHLD, signal.SIG_IGN)
for root in sys.stdin:
    if (pid := os.fork()) == 0:
        write(Path(root.rstrip()))
        os._exit(0)
    os.write(1, b"started %d\\n" % pid)
"""


class Writers:
    """Processes that write the same keys over and over, forked from one that has torch at hand."""

    def __init__(self) -> None:
        command = [sys.executable, "-c", WRITERS]
        self.server = subprocess.Popen(
            command, stdin=subprocess.PIPE, stdout=subprocess.PIPE, text=True
        )
        self.said: list[list[str]] = []

    def heard(self, word: str, pid: str = "") -> str:
        """Wait until a process says the word, and give its number."""
        while True:
            for line in self.said:
                if line[0] == word and pid in ("", line[1]):
                    self.said.remove(line)
                    return line[1]
            self.said.append(self.server.stdout.readline().split())

    def start(self, root: Path) -> str:
        self.server.stdin.write(f"{root}\n")
        self.server.stdin.flush()
        return self.heard("started")

    def kill(self, pid: str) -> None:
        """Kill a process, and wait until it has ended."""
        os.kill(int(pid), signal.SIGKILL)
        with suppress(ProcessLookupError):
            while True:
                os.kill(int(pid), 0)
                time.sleep(0.001)


@pytest.fixture(scope="module")
def writers():
    found = Writers()
    yield found
    found.server.communicate()


def killed_writers(writers: Writers, root: Path, delays: list[float]) -> None:
    """Three processes that write the same keys, each killed in the midst of it, none before its
    second.
    """
    started = [writers.start(root) for _ in delays]
    for pid, delay in zip(started, delays, strict=True):
        writers.heard("ready", pid)
        time.sleep(delay)
        writers.kill(pid)


def check_kept(root: Path) -> int:
    """Every entry that counts as there is whole and right."""
    store = Store(root)
    found = list(store.entries())
    for key, _ in found:
        same(store.get(key), torch.full((200_000,), float(int(key[:2], 16))))
    return len(found)


@pytest.mark.slow
def test_killed_writers_leave_no_wrong_entry(tmp_path, writers):
    killed_writers(writers, tmp_path, [0.03, 0.05, 0.08])
    assert check_kept(tmp_path) > 0


@pytest.mark.slow
def test_many_killed_writers_leave_no_wrong_entry(tmp_path, writers):
    for i in range(17):
        killed_writers(writers, tmp_path, [0.01 + 0.003 * i, 0.01 * (i % 3), 0.007 * (i % 5)])
        assert check_kept(tmp_path) > 0


# receipts


def test_a_receipt_is_all_that_is_known_and_no_value(tmp_path):
    store = Store(tmp_path)
    assert store.put_receipt(
        KEY, {"step": "s", "seconds": 2.0, "bytes": 10**9, "facts": {"max": 1}}
    )
    for found in (store, Store(tmp_path)):
        about = found.about(KEY)
        assert about == {
            "key": KEY,
            "step": "s",
            "seconds": 2.0,
            "bytes": 10**9,
            "facts": {"max": 1},
            "kept": False,
        }
        assert not found.has(KEY)
        assert dict(found.entries()) == {KEY: about}
        with pytest.raises(KeyError):
            found.get(KEY)
    assert not (tmp_path / "bad").exists()


def test_a_value_that_another_store_writes_is_seen_after_its_receipt(tmp_path):
    reader, writer = Store(tmp_path), Store(tmp_path)
    writer.put_receipt(KEY, {"step": "note", "seconds": 1.0})
    assert [reader.about(KEY)["kept"] for _ in range(3)] == [False] * 3
    assert writer.put(KEY, BIG, {"step": "value"})
    assert reader.about(KEY)["kept"]
    same(reader.get(KEY), BIG)


@pytest.mark.parametrize("value", [BIG, BIG[:10]], ids=["large", "small"])
def test_a_value_takes_the_place_of_a_receipt_and_never_the_reverse(tmp_path, value):
    reader = Store(tmp_path)
    Store(tmp_path).put_receipt(KEY, {"step": "note"})
    assert not reader.has(KEY)
    assert Store(tmp_path).put(KEY, value, {"step": "value"})
    assert reader.has(KEY)
    same(reader.get(KEY), value)
    for store in (reader, Store(tmp_path)):
        assert store.put_receipt(KEY, {"step": "late"})
        assert store.about(KEY)["step"] == "value"
        assert store.about(KEY)["kept"] is True
    same(Store(tmp_path).get(KEY), value)


def test_a_note_that_loses_the_race_leaves_the_value(tmp_path, monkeypatch):
    late = Store(tmp_path)
    monkeypatch.setattr(late, "about", lambda key: Store(tmp_path).put(key, BIG, {}) and None)
    assert late.put_receipt(KEY, {"step": "late"})
    same(Store(tmp_path).get(KEY), BIG)


def test_a_result_that_takes_its_name_while_one_looks_is_not_damaged(tmp_path, monkeypatch):
    writer, reader = Store(tmp_path), Store(tmp_path)
    looks = iter([True])

    def read(disk, key, read=metadata.read):
        if next(looks, False):
            with suppress(FileNotFoundError):
                read(disk, key)
            writer.put(key, BIG, {"step": "value"})
            raise FileNotFoundError(disk.path(key, "json"))
        return read(disk, key)

    monkeypatch.setattr(metadata, "read", read)
    assert reader.has(KEY)
    same(reader.get(KEY), BIG)
    assert not (tmp_path / "bad").exists()


def test_entries_from_before_there_were_receipts_are_values(tmp_path):
    keep(tmp_path, BIG)
    about = unseal_record("result", sidecar(tmp_path).read_bytes())
    del about["kept"], about["payload"]["stamp"]
    sidecar(tmp_path).write_bytes(seal_record("result", about))
    assert Store(tmp_path).has(KEY)
    for verify in ("always", "sampled", "never"):
        same(Store(tmp_path, verify=verify).get(KEY), BIG)


def test_a_damaged_receipt_is_put_aside(tmp_path):
    Store(tmp_path).put_receipt(KEY, {"step": "s"})
    flip(sidecar(tmp_path), 0.5)
    with pytest.warns(UserWarning, match="is damaged"):
        assert Store(tmp_path).about(KEY) is None
    assert Store(tmp_path).put_receipt(KEY, {"step": "s"})
    assert Store(tmp_path).about(KEY)["step"] == "s"


# how far a payload is trusted


def test_the_word_for_how_far_to_trust_is_checked(tmp_path, monkeypatch):
    assert Store(tmp_path).verify == "always"
    monkeypatch.setenv("NEUSEE_CACHE_VERIFY", "never")
    assert Store(tmp_path).verify == "never"
    assert Store(tmp_path, verify="sampled").verify == "sampled"
    with pytest.raises(ValueError, match="verify is 'often': write always, sampled or never"):
        Store(tmp_path, verify="often")
    monkeypatch.setenv("NEUSEE_CACHE_VERIFY", "Always")
    with pytest.raises(
        ValueError, match="NEUSEE_CACHE_VERIFY is 'Always': write always, sampled or never"
    ):
        Store(tmp_path)


def quietly_flipped(root):
    """A bit that changes without the file being touched, as a disk may do it; the file's stamp
    is put back.
    """
    stamp, path = payload(root).stat(), payload(root)
    flip(path, 0.9)
    about = unseal_record("result", sidecar(root).read_bytes())
    os.utime(path, ns=(stamp.st_atime_ns, stamp.st_mtime_ns))
    about["payload"]["stamp"] = payload_module.stamp_of(str(path))
    sidecar(root).write_bytes(seal_record("result", about))


def test_sampled_finds_what_was_written_to_at_once(tmp_path, monkeypatch):
    monkeypatch.setattr(payload_module._draw, "random", lambda: 0.999)
    keep(tmp_path, BIG)
    same(Store(tmp_path, verify="sampled").get(KEY), BIG)
    flip(payload(tmp_path), 0.9)
    with pytest.warns(UserWarning, match="is damaged"), pytest.raises(KeyError):
        Store(tmp_path, verify="sampled").get(KEY)


def test_sampled_finds_what_changed_by_itself_one_time_in_twenty(tmp_path, monkeypatch):
    keep(tmp_path, BIG)
    quietly_flipped(tmp_path)
    draws = [(i + 0.5) / 100 for i in reversed(range(100))]
    monkeypatch.setattr(payload_module._draw, "random", lambda: draws.pop(0))
    for _ in range(95):
        assert not torch.equal(Store(tmp_path, verify="sampled").get(KEY), BIG)
    with pytest.warns(UserWarning, match="is damaged"), pytest.raises(KeyError):
        Store(tmp_path, verify="sampled").get(KEY)


def test_never_reads_no_checksum_of_a_payload(tmp_path, monkeypatch):
    keep(tmp_path, BIG)
    monkeypatch.setattr(
        xxhash,
        "xxh3_128_hexdigest",
        lambda data: pytest.fail("it did") if len(data) > 9999 else SUM(data),
    )
    same(Store(tmp_path, verify="never").get(KEY), BIG)


@pytest.mark.parametrize("damage", [name for name in DAMAGES if "payload flipped" not in name])
def test_never_still_looks_at_sizes_and_descriptions(tmp_path, damage):
    keep(tmp_path, BIG)
    DAMAGES[damage](tmp_path)
    with pytest.warns(UserWarning, match="is damaged"), pytest.raises(KeyError):
        Store(tmp_path, verify="never").get(KEY)


def test_never_looks_at_the_size_when_it_loads(tmp_path):
    store = Store(tmp_path, verify="never")
    store.put(KEY, BIG, {})
    assert store.has(KEY)
    cut(payload(tmp_path))
    with pytest.warns(UserWarning, match="is damaged"), pytest.raises(KeyError):
        store.get(KEY)


# speeds


def test_speeds_are_learnt_from_large_transfers_and_remembered(tmp_path):
    store = Store(tmp_path)
    assert store.write_seconds(4e8) == pytest.approx(1.004)
    assert store.read_seconds(8e9) == pytest.approx(1.00005)
    for _ in range(40):
        store._speeds.learn("write", 10**8, 1.0)
        store._speeds.learn("read", 10**5, 1000.0)
    for found in (store, Store(tmp_path)):
        assert found.write_seconds(1e8) == pytest.approx(1.0, rel=0.3)
        assert found.read_seconds(8e9) == pytest.approx(1.00005)


def test_own_transfers_are_learnt_from(tmp_path):
    store, x = Store(tmp_path), torch.zeros(300_000)
    store.put(KEY, x, {})
    wrote = store.write_seconds(1e9)
    assert wrote != Store(tmp_path / "other").write_seconds(1e9)
    Store(tmp_path, verify="never").get(KEY)
    before = store.read_seconds(1e9)
    store.get(KEY)
    assert store.read_seconds(1e9) != before


@pytest.mark.parametrize(
    "text", ["", "{}", "null", '{"read": "fast", "write": 1}', '{"read": NaN, "write": 0}']
)
def test_speeds_that_make_no_sense_are_forgotten(tmp_path, text):
    (tmp_path / "speeds.json").write_text(text)
    assert Store(tmp_path).read_seconds(8e9) == pytest.approx(1.00005)
    store = Store(tmp_path)
    store._speeds.learn("read", 10**9, 100.0)
    assert Store(tmp_path).read_seconds(8e9) == store.read_seconds(8e9) > 1.1


# several users


@pytest.mark.parametrize("mode", [0o775, 0o2775, 0o777, 0o755])
def test_who_may_write_in_the_root_may_write_below_it(tmp_path, mode):
    root = tmp_path / "shared"
    root.mkdir()
    root.chmod(mode)
    before = os.umask(0o022)
    try:
        store = Store(root)
        store.put(KEY, BIG, {})
        store.put_receipt("cd" + "0" * 30, {})
        store.pin(KEY)
        store.claim(KEY).release()
        store.gc()
    finally:
        os.umask(before)
    for path in root.rglob("*"):
        found = path.stat().st_mode & 0o777
        if path.is_dir():
            assert found == mode & 0o777, path
        elif path.name in ("journal.jsonl", ".lock", "speeds.json"):
            assert found == mode & 0o666, path
        else:
            assert found == 0o644, path


@pytest.mark.filterwarnings("ignore:.*multi-threaded.*fork:DeprecationWarning")
def test_another_user_goes_on_where_the_first_one_stopped(tmp_path_factory):
    if os.geteuid() != 0:
        pytest.skip("only root can become somebody else")
    with tempfile.TemporaryDirectory() as folder:
        root = Path(folder)
        root.chmod(0o777)
        Store(root).put(KEY, BIG, {"seconds": 1.0})
        Store(root).put_receipt("cd" + "0" * 30, {})
        child = os.fork()
        if child == 0:
            failed = True
            with suppress(BaseException):
                os.setuid(65534)
                warnings.simplefilter("error")
                store = Store(root)
                same(store.get(KEY), BIG)
                assert store.put("ab" + "1" * 30, BIG, {})
                assert store.put("cd" + "0" * 30, BIG, {})
                assert len(store.journal.rows()) == 4
                assert set(store.gc(budget=0).evicted) == {KEY, "ab" + "1" * 30, "cd" + "0" * 30}
                failed = False
            os._exit(failed)
        assert os.waitpid(child, 0)[1] == 0
        assert not Store(root).has(KEY)
        assert Store(root).put(KEY, BIG, {})


def test_the_store_stands_where_one_expects_it(tmp_path, monkeypatch):
    monkeypatch.delenv("NEUSEE_CACHE", raising=False)
    monkeypatch.setattr(Path, "home", lambda: tmp_path / "home")
    (tmp_path / "work" / "deep").mkdir(parents=True)
    (tmp_path / "work" / "cache").mkdir()
    monkeypatch.chdir(tmp_path / "work" / "deep")
    assert default_root() == tmp_path / "home" / ".cache" / "neusee"
    (tmp_path / "work" / "pyproject.toml").write_text('[project]\nname = "other"\n')
    assert default_root() == tmp_path / "home" / ".cache" / "neusee"
    (tmp_path / "work" / "pyproject.toml").write_text('[project]\nname = "neusee"\n')
    assert default_root() == tmp_path / "work" / "cache"
    monkeypatch.setenv("NEUSEE_CACHE", str(tmp_path / "named"))
    assert default_root() == tmp_path / "named"


def test_a_url_is_no_folder(monkeypatch):
    monkeypatch.setenv("NEUSEE_CACHE", "s3://bucket/name")
    with pytest.raises(
        ValueError, match="'s3://bucket/name', which is not a folder: open a URL with `open_store`"
    ):
        Store()


def test_a_description_is_json_that_says_what_it_is(tmp_path):
    keep(tmp_path, BIG)
    about = json.loads(sidecar(tmp_path).read_text())
    assert about["key"] == KEY
    assert about["step"] == "s"
    assert about["layout"] == {"tensor": 0}
    assert about["payload"]["size"] == payload(tmp_path).stat().st_size


@pytest.mark.parametrize("written_first", [True, False])
def test_a_device_that_fails_is_told_once_whether_it_fails_to_write_or_to_read_first(
    written_first, tmp_path
):
    store = Store(tmp_path / "cache")
    error = OSError(5, "Input/output error")
    with warnings.catch_warnings(record=True) as told:
        warnings.simplefilter("always")
        if written_first:
            store.report_failure(error)
        store._put_aside("ab" * 16, error)
        store.report_failure(error)
    assert len(told) == 1, [str(one.message) for one in told]
    assert ("cannot be written" if written_first else "cannot be read") in str(told[0].message)
