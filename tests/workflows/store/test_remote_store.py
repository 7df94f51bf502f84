"""A store at a URL: the same results for all, and the local layer whenever the remote fails."""

from __future__ import annotations

import importlib.util
import os
import sys
import threading
import time
from contextlib import suppress
from pathlib import Path
from typing import ClassVar

import fsspec
import pytest
import torch
from fsspec.implementations.memory import MemoryFileSystem

from neusee.workflows.store import remote_store as remote_files
from neusee.workflows.store.remote_store import RemoteStore, local_layer, open_store
from neusee.workflows.store.result_store import Store

SPEC = importlib.util.spec_from_file_location("forks", Path(__file__).parents[1] / "forks.py")
forks = importlib.util.module_from_spec(SPEC)
SPEC.loader.exec_module(forks)

KEY = "ab" + "0" * 30
BIG = torch.arange(5000, dtype=torch.float32)
SMALL = torch.arange(5, dtype=torch.float64)
ABOUT = {
    "step": "s",
    "seconds": 2.0,
    "date": "2026-01-01",
    "origin": {"node": "a.b"},
    "facts": None,
    "checks": [],
}


class Clock:
    """The time by which transfers are measured: no time passes but that of transfers."""

    now = 1000.0
    time = staticmethod(time.time)

    def monotonic(self):
        return self.now

    perf_counter = monotonic


class Weather(MemoryFileSystem):
    """A file system in memory that counts what is asked of it, and may be slow, down or
    read-only.
    """

    protocol = "weather"
    asked: ClassVar[list[str]] = []
    threads: ClassVar[set[int]] = set()
    latency, down, read_only = 0.0, False, False
    #: who asks waits for as many others that ask
    company: ClassVar[threading.Barrier | None] = None
    clock: ClassVar[Clock | None] = None

    def _ask(self, what, writes=False):
        if Weather.company is not None:
            with suppress(threading.BrokenBarrierError):
                Weather.company.wait(300)
                Weather.company.abort()  # the first have met; nobody waits again
        if Weather.clock is None:
            time.sleep(Weather.latency)
        else:
            Weather.clock.now += Weather.latency
        Weather.asked.append(what)
        Weather.threads.add(threading.get_ident())
        if Weather.down:
            raise ConnectionError("the network is down")
        if writes and Weather.read_only:
            raise PermissionError("you may only read")

    def ls(self, path, detail=True, **options):
        self._ask("ls")
        return super().ls(path, detail, **options)

    def cat_file(self, path, start=None, end=None, **options):
        self._ask("cat")
        return super().cat_file(path, start, end, **options)

    def get_file(self, rpath, lpath, *rest, **options):
        self._ask("get")
        return super().get_file(rpath, lpath, *rest, **options)

    def put_file(self, lpath, rpath, *rest, **options):
        self._ask("put", writes=True)
        return super().put_file(lpath, rpath, *rest, **options)

    def pipe_file(self, path, value, mode="overwrite", **options):
        self._ask("pipe", writes=True)
        return super().pipe_file(path, value, mode=mode, **options)


@pytest.fixture(autouse=True)
def weather(monkeypatch):
    fsspec.register_implementation("weather", Weather, clobber=True)
    monkeypatch.setattr(MemoryFileSystem, "store", {})
    monkeypatch.setattr(MemoryFileSystem, "pseudo_dirs", [""])
    monkeypatch.setattr(Weather, "asked", [])
    monkeypatch.setattr(Weather, "threads", set())
    monkeypatch.setattr(remote_files, "time", Clock())
    for name in ("latency", "down", "read_only", "clock"):
        monkeypatch.setattr(Weather, name, getattr(Weather, name))
    return Weather


@pytest.fixture(params=["weather", "file", "memory"])
def url(request, tmp_path):
    return f"{request.param}://{tmp_path / 'there'}"


@pytest.fixture
def store(url, tmp_path):
    """A store of another machine at each call: with a local layer of its own."""
    return lambda name="one": RemoteStore(url, tmp_path / name)


@pytest.fixture
def bad(tmp_path):
    """The same, at the file system with weather."""
    return lambda name="one": RemoteStore("weather://there", tmp_path / name)


def there(url):
    """What lies at the remote: names of files, by path."""
    fs, root = fsspec.core.url_to_fs(url)
    return {path: path.rpartition("/")[2] for path in fs.find(root)}


@pytest.mark.parametrize("value", [BIG, SMALL], ids=["payload", "inline"])
def test_what_one_machine_keeps_another_finds(store, value):
    assert store("one").put(KEY, value, ABOUT)
    other = store("two")
    assert other.has(KEY)
    assert other.about(KEY)["step"] == "s"
    assert not Store(other.root).has(KEY)  # its payload was not fetched for that
    assert torch.equal(other.get(KEY), value)
    assert torch.equal(Store(other.root).get(KEY), value)
    assert [row["key"] for row in Store(other.root).journal.rows()] == [KEY]


def test_what_is_here_is_not_asked_for_there(bad):
    bad().put(KEY, BIG, ABOUT)
    Weather.asked.clear()
    again = bad()
    assert again.has(KEY)
    assert torch.equal(again.get(KEY), BIG)
    assert Weather.asked == []


def test_a_value_is_fetched_once(bad):
    bad("one").put(KEY, BIG, ABOUT)
    for _ in range(3):
        bad("two").get(KEY)
    assert Weather.asked.count("get") == 1


def test_what_is_nowhere_is_missing(store):
    assert not store().has(KEY)
    assert store().about(KEY) is None
    with pytest.raises(KeyError):
        store().get(KEY)


def test_a_receipt_travels_and_gives_way_to_the_value(store):
    store("one").put_receipt(KEY, ABOUT)
    two = store("two")
    assert two.about(KEY)["seconds"] == 2.0
    assert not two.has(KEY)
    with pytest.raises(KeyError):
        two.get(KEY)
    store("three").put(KEY, BIG, ABOUT)
    assert store("four").has(KEY)
    store("five").put_receipt(KEY, ABOUT)
    assert torch.equal(store("four").get(KEY), BIG)


def test_everything_is_listed_once(store):
    keys = [f"{i:02x}" + "1" * 30 for i in range(6)]
    store("one").put(keys[0], BIG, ABOUT)
    two = store("two")
    two.put(keys[1], BIG, ABOUT)
    two.put_receipt(keys[2], ABOUT)
    assert [key for key, _ in two.entries()] == [keys[1], keys[2], keys[0]]
    assert sorted(key for key, _ in store("three").entries()) == keys[:3]


def test_a_result_of_another_machine_is_found_though_its_folder_was_listed_before(store):
    """A worker is told a key that did not exist a moment ago."""
    one, two = store("one"), store("two")
    assert not two.has(KEY)
    one.put(KEY, BIG, ABOUT)
    assert torch.equal(two.get(KEY), BIG)


def test_a_listing_grows_old(bad, monkeypatch):
    one, two = bad("one"), bad("two")
    assert not two.has(KEY)
    one.put(KEY, BIG, ABOUT)
    monkeypatch.setattr(remote_files, "_LISTING_VALID_SECONDS", 0.0)
    assert two.has(KEY)


def test_the_first_of_two_writers_stays(store):
    one, two = store("one"), store("two")
    assert not one.has(KEY)
    assert not two.has(KEY)
    one.put(KEY, BIG, ABOUT)
    two.put(KEY, BIG + 1, ABOUT)
    assert torch.equal(store("three").get(KEY), BIG)


def test_writers_at_once_leave_one_whole_value(store, url):
    """Each machine has computed another value; what the others then read is one of them."""
    stores = [store(str(i)) for i in range(8)]
    threads = [
        threading.Thread(target=s.put, args=(KEY, BIG + i, ABOUT)) for i, s in enumerate(stores)
    ]
    for thread in threads:
        thread.start()
    for thread in threads:
        thread.join()
    first = store("reader").get(KEY)
    assert float(first[0]) in range(8)
    assert torch.equal(first - first[0], BIG)
    assert [name for name in there(url).values() if name.endswith(".json")] == [f"{KEY}.json"]
    assert not [path for path in there(url) if "/there/tmp/" in path]


# faults


@pytest.mark.parametrize("suffix", [".json", ".safetensors"])
@pytest.mark.parametrize(
    "damage", [lambda raw: raw[:-3], lambda raw: b"", lambda raw: raw[:40] + b"\xff" + raw[41:]]
)
def test_damage_there_is_seen_and_mended(store, url, suffix, damage):
    store("one").put(KEY, BIG, ABOUT)
    fs, _ = fsspec.core.url_to_fs(url)
    (path,) = (path for path in there(url) if path.endswith(suffix))
    fs.pipe_file(path, damage(fs.cat_file(path)))
    two = store("two")
    with pytest.warns(UserWarning, match="is damaged") as seen, pytest.raises(KeyError):
        two.get(KEY)
    assert len(seen) == 1
    assert not two.has(KEY)
    assert two.put(KEY, BIG, ABOUT)
    assert torch.equal(store("three").get(KEY), BIG)


def test_a_payload_that_has_gone_is_a_miss_and_is_mended(store, url):
    store("one").put(KEY, BIG, ABOUT)
    fs, _ = fsspec.core.url_to_fs(url)
    (path,) = (path for path in there(url) if path.endswith(".safetensors"))
    fs.rm_file(path)
    two = store("two")
    assert two.has(KEY)
    with pytest.raises(KeyError):
        two.get(KEY)
    assert not two.has(KEY)
    two.put(KEY, BIG, ABOUT)
    assert torch.equal(store("three").get(KEY), BIG)


def test_a_damaged_copy_here_is_fetched_again(store):
    store("one").put(KEY, BIG, ABOUT)
    two = store("two")
    two.get(KEY)
    payload = two.root / "ab" / f"{KEY}.safetensors"
    payload.write_bytes(payload.read_bytes()[:-4] + b"\0\0\0\1")
    again = store("two")
    with pytest.warns(UserWarning, match="is damaged"), pytest.raises(KeyError):
        again.get(KEY)
    assert torch.equal(again.get(KEY), BIG)


def test_an_entry_under_a_wrong_name_is_not_served(store, url):
    store("one").put(KEY, SMALL, ABOUT)
    fs, _ = fsspec.core.url_to_fs(url)
    (path,) = there(url)
    fs.pipe_file(path.replace(KEY, "ab" + "1" * 30), fs.cat_file(path))
    with pytest.warns(UserWarning, match=f"belong to the key {KEY}"):
        assert not store("two").has("ab" + "1" * 30)


def test_a_remote_that_is_down_costs_one_warning(bad):
    Weather.down = True
    store = bad()

    def work():
        for i in range(20):
            key = f"{i:02x}" + "0" * 30
            assert not store.has(key)
            assert store.put(key, BIG + i, ABOUT)
            assert torch.equal(store.get(key), BIG + i)

    with pytest.warns(UserWarning, match=r"cannot be read .*the network is down") as seen:
        work()
    assert len(seen) == 1
    assert len(Weather.asked) <= 2
    Weather.down = False
    assert torch.equal(bad().get("00" + "0" * 30), BIG)


def test_a_remote_that_goes_down_half_way_costs_one_warning(bad):
    bad("one").put(KEY, BIG, ABOUT)
    two = bad("two")
    assert two.has(KEY)
    Weather.down = True
    with pytest.warns(UserWarning, match="cannot be read"), pytest.raises(KeyError):
        two.get(KEY)
    assert not two.has(KEY)  # a second warning would be an error
    assert two.put(KEY, BIG, ABOUT)
    assert torch.equal(two.get(KEY), BIG)


def test_a_remote_that_comes_back_is_used_again(bad):
    Weather.down = True
    store = bad()
    with pytest.warns(UserWarning, match="the network is down"):
        store.put(KEY, BIG, ABOUT)
    Weather.down = False
    remote_files.time.now += 100
    other = "ab" + "2" * 30
    store.put(other, BIG, ABOUT)
    assert bad("two").has(other)


def test_a_remote_that_may_only_be_read_is_read(bad):
    bad("one").put(KEY, BIG, ABOUT)
    Weather.read_only = True
    two, other = bad("two"), "ab" + "2" * 30
    with pytest.warns(UserWarning, match=r"cannot be written .*you may only read"):
        assert two.put(other, BIG + 1, ABOUT)
    assert two.put_receipt("ab" + "3" * 30, ABOUT)
    assert torch.equal(two.get(KEY), BIG)
    assert torch.equal(two.get(other), BIG + 1)


def test_a_local_layer_that_takes_nothing_costs_one_warning(bad, tmp_path):
    bad("one").put(KEY, BIG, ABOUT)
    bad("one").put("cd" + KEY[2:], BIG, ABOUT)
    (tmp_path / "two").write_text("a file where a folder should be")
    two = bad("two")
    with pytest.warns(UserWarning, match="set NEUSEE_CACHE_LOCAL"), pytest.raises(KeyError):
        two.get(KEY)
    with pytest.raises(KeyError):
        two.get("cd" + KEY[2:])
    assert not two.has(KEY)
    assert not two.has("cd" + KEY[2:])


def test_a_killed_upload_leaves_nothing_for_long(tmp_path):
    url = f"file://{tmp_path / 'there'}"
    (tmp_path / "there" / "tmp").mkdir(parents=True)
    for name, age in (("old", 90_000), ("young", 80_000)):
        path = tmp_path / "there" / "tmp" / name
        path.write_text("half")
        os.utime(path, (time.time() - age,) * 2)
    RemoteStore(url, tmp_path / "here").put(KEY, BIG, ABOUT)
    assert [path.name for path in (tmp_path / "there" / "tmp").iterdir()] == ["young"]


# what it costs


def test_a_thousand_misses_are_not_a_thousand_questions(bad, monkeypatch):
    store = bad()
    for i in range(1000):
        # from here on all folders are listed, and the first five questions wait for each other
        if i == 3:
            monkeypatch.setattr(Weather, "company", threading.Barrier(5))
        assert not store.has(f"{i * 37 % 256:02x}" + f"{i:030x}")
    assert len(Weather.asked) <= 256
    assert len(Weather.threads) > 4  # side by side, else the first would still wait


def test_a_few_misses_do_not_list_everything(bad):
    store = bad()
    for i in range(3):
        store.has(f"{i:02x}" + "0" * 30)
    assert len(Weather.asked) == 3


def test_a_transfer_is_priced_by_those_before_it(bad):
    x, prices = torch.zeros(2_500_000), {}
    Weather.clock = remote_files.time
    for latency in (0.0, 0.1):
        Weather.latency = latency
        writer, reader = bad(f"writer{latency}"), bad(f"reader{latency}")
        for i in range(4):
            key = f"{i:02x}" + f"{int(latency * 10):030x}"
            writer.put(key, x, ABOUT)
            reader.get(key)
        local = Store.write_seconds(writer, x.nbytes), Store.read_seconds(reader, x.nbytes)
        here = writer.write_seconds(x.nbytes), reader.read_seconds(x.nbytes)
        prices[latency] = [
            with_transfer - without for with_transfer, without in zip(here, local, strict=True)
        ]
        assert min(prices[latency]) > 0
    assert all(slow > fast + 0.1 for slow, fast in zip(prices[0.1], prices[0.0], strict=True))


# how one gets there


def test_a_path_gives_a_local_store(tmp_path, monkeypatch):
    assert type(open_store(tmp_path)) is type(open_store(str(tmp_path))) is Store
    monkeypatch.setenv("NEUSEE_CACHE", str(tmp_path / "named"))
    assert open_store().root == tmp_path / "named"
    monkeypatch.delenv("NEUSEE_CACHE")
    assert open_store().root == Store().root


def test_a_url_gives_a_remote_store_also_from_the_environment(tmp_path, monkeypatch):
    monkeypatch.setenv("NEUSEE_CACHE_LOCAL", str(tmp_path / "here"))
    monkeypatch.setenv("NEUSEE_CACHE", "memory://there")
    found = open_store()
    assert isinstance(found, RemoteStore)
    assert (found.url, found.root) == ("memory://there", tmp_path / "here")


def test_each_url_has_a_local_layer_of_its_own(monkeypatch):
    monkeypatch.delenv("NEUSEE_CACHE_LOCAL", raising=False)
    assert local_layer("s3://a/b") == local_layer("s3://a/b/") != local_layer("s3://a/c")
    assert local_layer("s3://a/b").parent == Path.home() / ".cache" / "neusee"


def test_a_wrong_scheme_is_named_with_the_right_one():
    with pytest.raises(
        ValueError, match=r"no file system has the scheme fiel:// of fiel:///x; did you mean file\?"
    ):
        open_store("fiel:///x")


def test_a_missing_package_is_named(monkeypatch):
    monkeypatch.setitem(sys.modules, "fsspec", None)
    with pytest.raises(ModuleNotFoundError, match=r'pip install "neusee\[distributed\]"'):
        open_store("s3://bucket/name")


def test_a_missing_package_for_a_scheme_is_named(monkeypatch):
    monkeypatch.setitem(sys.modules, "s3fs", None)
    with pytest.raises(
        ModuleNotFoundError, match=r"s3://bucket/name needs one more package: .*s3fs"
    ):
        open_store("s3://bucket/name")


def test_nothing_is_imported_for_a_path(tmp_path):
    code = (
        "import sys; from neusee.workflows.store.remote_store import open_store;"
        f" open_store({str(tmp_path)!r})\n"
    )
    code += "assert not {'fsspec', 'torch'} & set(sys.modules), sys.modules.keys()"
    assert os.spawnl(os.P_WAIT, sys.executable, sys.executable, "-c", code) == 0
