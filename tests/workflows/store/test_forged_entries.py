"""A cache that somebody else wrote: nothing of it is run, nothing wrong is returned, and the
next run heals it.
"""

import json
import os
import random
import subprocess
import sys
import types
import warnings
from pathlib import Path
from typing import NamedTuple, get_args

import pytest
import torch
import xxhash
from typer.testing import CliRunner

from neusee.nodes import node
from neusee.nodes.values import Psf, Stop
from neusee.workflows.cli import cache_commands
from neusee.workflows.engine.cost_model import Costs
from neusee.workflows.keys.sealed_files import seal_record, unseal_record
from neusee.workflows.recipe.node_families import all_nodes, find_node
from neusee.workflows.store import eviction as garbage_files
from neusee.workflows.store.payload import SmallResults
from neusee.workflows.store.remote_store import RemoteStore
from neusee.workflows.store.result_store import Store
from neusee.workflows.store.serialization import stored_type

KEY, OTHER = "ab" + "0" * 30, "cd" + "1" * 30
BIG = torch.arange(3000, dtype=torch.float64)
ABOUT = {
    "step": "s",
    "seconds": 2.0,
    "bytes": 1,
    "date": "2026-01-01",
    "checks": [["fine", True]],
    "device": "cpu",
}
ORIGIN = {"node": "optics.psf", "code": "c", "params": {}, "inputs": []}
STOP = Stop(torch.tensor(5), torch.tensor(1e-4).double(), torch.tensor(1e-2).double())
PSF = Psf(torch.rand(3, 8, 8), torch.rand(3).double())
VALUES = {
    "payload": BIG,
    "inline": STOP,
}
CANARY = "CANARY"  #: file that a forged entry would make
TOUCH = f"touch {CANARY}"


@pytest.fixture(autouse=True)
def _canary(tmp_path, monkeypatch):
    """Fails if any forgery made a file in the working folder."""
    (folder := tmp_path / "work").mkdir()
    monkeypatch.chdir(folder)
    yield
    assert not list(folder.iterdir()), "a forged entry was run"


def equal(one, other):
    if isinstance(one, torch.Tensor) and isinstance(other, torch.Tensor):
        return one.dtype == other.dtype and torch.equal(one, other)
    return type(one) is type(other) and len(one) == len(other) and all(map(equal, one, other))


def sidecar(root, key=KEY):
    return root / key[:2] / f"{key}.json"


def forge(root, change, key=KEY, kind="result"):
    """Change the metadata of an entry, and seal what came out, as anybody can who knows the
    format.
    """
    path = sidecar(root, key)
    about = unseal_record(kind, path.read_bytes())
    path.write_bytes(seal_record(kind, change(about) or about))


def found(root, kind=Stop | torch.Tensor):
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")
        try:
            return Store(root).get(KEY, kind)
        except KeyError:
            return None


def heals(root, value):
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")
        store = Store(root)
        if found(root) is None:
            with pytest.raises(KeyError):
                store.get(KEY)
            assert store.put(KEY, value, ABOUT)
        return equal(Store(root).get(KEY), value) and equal(store.get(KEY), value)


# --- types ----------------------------------------------------------------------------------------

FORGED_TYPES = [
    "neusee.nodes._node:_imported",
    "neusee.nodes._node:_arguments",
    "neusee.nodes._node:importlib.import_module",
    "neusee.nodes.values:torch.hub.load",
    "neusee.nodes.values:Tensor",
    "neusee.nodes.network_weights:Path",
    "neusee.nodes.evil:Evil",
    "os:system",
    "builtins:eval",
    "subprocess:Popen",
    "posix:system",
    "neusee.workflows.store.result_store:Store",
    "collections:OrderedDict",
    "",
    ":",
    "values:Psf",
    "neusee.nodes.values:Psf.__new__",
    "neusee.nodes.optics._psf:_Camera",
]


def called(name):
    arguments = ["os", "system"] if "_node" in name else [TOUCH]
    return {"class": name, "items": [{"value": each} for each in arguments]}


def faults_of_type(root, layout):
    """What is wrong with the reading of an entry with a layout."""
    Store(root).put(KEY, STOP, ABOUT)
    forge(root, lambda about: {**about, "layout": layout})
    modules = set(sys.modules)
    with warnings.catch_warnings(record=True) as said:
        warnings.simplefilter("always")
        try:
            Store(root).get(KEY)
        except KeyError:
            pass
        else:
            yield "it is no miss"
    if not any("is damaged" in str(each.message) for each in said):
        yield "nothing is said"
    if set(sys.modules) != modules:
        yield "a name in an entry imported a module"
    if not heals(root, STOP):
        yield "it does not heal"


def test_a_forged_type_is_a_miss_and_runs_nothing(tmp_path):
    wrong = []
    for number, name in enumerate(FORGED_TYPES):
        nested = {"list": [{"dict": {"a": called(name)}}]}
        for kind, layout in {"alone": called(name), "nested": nested}.items():
            faults = faults_of_type(tmp_path / f"{kind}{number}", layout)
            wrong += [(name, kind, fault) for fault in faults]
    assert wrong == []


@pytest.mark.parametrize("layout", [called("os:system"), called("neusee.nodes._node:_imported")])
def test_the_maintenance_of_a_cache_runs_nothing_either(tmp_path, monkeypatch, layout):
    """Each command on an entry that would, when called, write a file."""
    monkeypatch.setenv("NEUSEE_CACHE", str(tmp_path / "cache"))
    Store(tmp_path / "cache").put(KEY, STOP, ABOUT | {"origin": ORIGIN})
    forge(tmp_path / "cache", lambda about: {**about, "layout": layout, "tensors": []})
    for command in (
        ["ls"],
        ["verify"],
        ["why", KEY[:4]],
        ["gc"],
        ["pin", KEY[:4]],
        ["gc", "--budget", "1 B"],
    ):
        done = CliRunner().invoke(cache_commands.cache, command)
        assert done.exit_code == 0, (command, done.output)


@pytest.mark.slow
def test_a_check_of_all_results_needs_no_type_of_theirs(tmp_path):
    """In a process that has not imported the node; which imports the type, and nothing else
    does.
    """
    quality = find_node("metrics.quality").hints["return"]
    value = quality(*[torch.zeros(()) for _ in quality._fields])
    Store(tmp_path).put(KEY, value, ABOUT)
    assert equal(Store(tmp_path).get(KEY), value)
    code = f"""
import sys
from neusee.workflows.store.result_store import Store
from neusee.workflows.recipe.node_families import find_node
assert [entry.problem for entry in Store(sys.argv[1]).check()] == [""]
assert "neusee.nodes.metrics" not in sys.modules, "a node was imported"
find_node("metrics.quality")
assert type(Store(sys.argv[1]).get("{KEY}")).__name__ == "{quality.__name__}"
"""
    assert subprocess.run([sys.executable, "-c", code, str(tmp_path)]).returncode == 0


def test_the_types_of_all_nodes_are_known():
    """Each named tuple that a shipped node returns or reads, found by walking through the
    annotations.
    """
    for name, each in all_nodes():
        for kind in (each.hints[argument] for argument in (*each.inputs, "return")):
            for one in (kind, *get_args(kind)):
                if hasattr(one, "_fields"):
                    assert stored_type(f"{one.__module__}:{one.__qualname__}") is one, name


def test_the_type_of_a_user_s_node_can_be_stored(tmp_path, monkeypatch):
    module = types.ModuleType("neusee.nodes.mine")
    monkeypatch.setitem(sys.modules, "neusee.nodes.mine", module)

    class Inner(NamedTuple):
        x: torch.Tensor
        n: float = 1.0

    class Bloom(NamedTuple):
        inner: Inner
        shape: tuple[int, ...] = ()

    for each in (Inner, Bloom):
        each.__module__, each.__qualname__ = module.__name__, each.__name__
    value = Bloom(Inner(BIG, 2.0), (3, 4))
    with pytest.raises(
        TypeError, match=r"mine\.Inner cannot be stored: annotate the node's result with it"
    ):
        Store(tmp_path).put(KEY, value, ABOUT)

    def bloom(x): ...

    bloom.__annotations__ = {"x": torch.Tensor, "return": Bloom}
    node()(bloom)
    assert Store(tmp_path).put(KEY, value, ABOUT)
    back = Store(tmp_path).get(KEY)
    assert type(back) is Bloom
    assert type(back.inner) is Inner
    assert torch.equal(back.inner.x, BIG)
    assert back[1:] == ((3, 4),)
    assert back.inner.n == 2.0


@pytest.mark.parametrize(
    "items",
    [
        [],
        [{"tensor": 0}],
        [{"tensor": 0}] * 3,
        [{"value": "text"}, {"tensor": 0}],
        [{"list": [{"tensor": 0}]}] * 2,
    ],
)
def test_a_named_tuple_with_wrong_fields_is_a_miss(tmp_path, items):
    Store(tmp_path).put(KEY, PSF, ABOUT)
    forge(
        tmp_path,
        lambda about: {**about, "layout": {"class": "neusee.nodes.values:Psf", "items": items}},
    )
    assert found(tmp_path) is None


# --- format ---------------------------------------------------------------------------------------


def as_format(raw, version):
    """The same entry as another version of the program would write it."""
    about = unseal_record("result", raw)
    if version is not None:
        about["format"] = version
    body = json.dumps(about, separators=(",", ":"))[:-1].encode()
    return body + f',"seal":"{xxhash.xxh3_128_hexdigest(body)}"}}'.encode()


@pytest.mark.parametrize("version", [None, 1, 3, "2", True, 2.5])
@pytest.mark.parametrize("value", VALUES.values(), ids=VALUES)
def test_an_entry_of_another_version_is_left_alone_and_told_of_once(tmp_path, version, value):
    store = Store(tmp_path)
    for key in (KEY, OTHER):
        store.put(key, value, ABOUT)
        raw = as_format(sidecar(tmp_path, key).read_bytes(), version)
        sidecar(tmp_path, key).write_bytes(raw)
    before = {path: path.read_bytes() for path in tmp_path.glob("??/*")}
    store = Store(tmp_path)
    with pytest.warns(UserWarning, match=r"another version .* not read.*`neusee cache gc`") as told:  # noqa: PT031
        for key in (KEY, OTHER):
            assert not store.has(key)
            with pytest.raises(KeyError):
                store.get(key)
        assert list(store.entries()) == []
        assert list(store.check()) == []
        assert store.gc().orphans == 0
    assert len(told) == 1
    assert {path: path.read_bytes() for path in tmp_path.glob("??/*")} == before
    assert heals(tmp_path, value)


def test_old_entries_of_another_version_go_with_the_garbage_and_first_of_all(tmp_path, monkeypatch):
    store = Store(tmp_path)
    for key in (KEY, OTHER):
        store.put(key, BIG, ABOUT)
    sidecar(tmp_path).write_bytes(as_format(sidecar(tmp_path).read_bytes(), 1))
    swept = Store(tmp_path).gc(budget=BIG.nbytes + 2000)
    assert swept.evicted == (KEY,)
    assert not list(tmp_path.glob("ab/*"))
    assert equal(Store(tmp_path).get(OTHER), BIG)
    sidecar(tmp_path, OTHER).write_bytes(as_format(sidecar(tmp_path, OTHER).read_bytes(), 1))
    assert Store(tmp_path).gc().orphans == 0
    monkeypatch.setattr(garbage_files, "_WEEK", -1.0)
    assert Store(tmp_path).gc().orphans == 2
    assert not list(tmp_path.glob("cd/*"))


@pytest.mark.parametrize(
    "layout",
    [
        {"quantised": {"bits": 4}},
        {"tensor": 0, "scale": 2.0},
        {},
        {"stacked": {"names": ["aa.0"], "xxh3": ["0" * 32], "dtype": "float32", "shape": [1, 8]}},
    ],
)
def test_an_unknown_kind_of_layout_is_left_alone(tmp_path, layout):
    Store(tmp_path).put(KEY, BIG, ABOUT)
    forge(tmp_path, lambda about: {**about, "layout": layout})
    raw = sidecar(tmp_path).read_bytes()
    assert found(tmp_path) is None
    assert sidecar(tmp_path).read_bytes() == raw
    assert heals(tmp_path, BIG)


# --- fuzz -----------------------------------------------------------------------------------------

JUNK = [
    None,
    True,
    -1,
    0,
    7,
    2**70,
    1e308,
    float("nan"),
    float("inf"),
    "",
    "x",
    "../../x",
    "\x1b[2J",
    "é" * 9,
]
JUNK += [
    [],
    [[]],
    {},
    {"a": 1},
    [None],
    ["F64", [2**60], False, "AAAA"],
    [0, 1],
    called("os:system"),
    "9" * 50,
]


def mutated(rng, item, depth=0):
    """A JSON value with one part replaced, doubled or taken away."""
    if depth > 3 or not isinstance(item, dict | list) or not item or rng.random() < 0.15:
        return rng.choice(JUNK)
    if isinstance(item, list):
        at = rng.randrange(len(item))
        change = rng.choice(["drop", "double", "deeper", "deeper"])
        middle = (
            []
            if change == "drop"
            else [item[at]] * 2
            if change == "double"
            else [mutated(rng, item[at], depth + 1)]
        )
        return item[:at] + middle + item[at + 1 :]
    name = rng.choice([*item, *item, "layout" if "layout" in item else "extra"])
    if rng.random() < 0.2:
        return {k: v for k, v in item.items() if k != name}
    return {**item, name: mutated(rng, item.get(name), depth + 1)}


def damage_json(rng, root):
    def change(about):
        about = mutated(rng, about)
        return about if isinstance(about, dict) else {"key": KEY, "layout": about}

    forge(root, change)


def damage_bytes(rng, root):
    path = rng.choice([p for p in root.rglob("*") if p.is_file() and p.name != ".lock"])
    raw = bytearray(path.read_bytes())
    kind = rng.choice(["cut", "flip", "grow", "empty", "length", "deep"])
    if kind == "cut":
        raw = raw[: rng.randrange(len(raw) + 1)]
    elif kind == "flip" and raw:
        raw[rng.randrange(len(raw))] ^= 1 << rng.randrange(8)
    elif kind == "grow":
        raw += os.urandom(rng.randrange(1, 5000))
    elif kind == "length":
        raw[:8] = (2 ** rng.randrange(64) - 1).to_bytes(8, "little")
    else:
        raw = b"[" * 100_000 if kind == "deep" else b""
    path.unlink()
    path.write_bytes(raw)


def forge_tensors(rng, root):
    """A file of tensors with a header of its own and the checksum that fits."""
    path = root / KEY[:2] / f"{KEY}.safetensors"
    if not path.exists():
        return damage_json(rng, root)
    raw = path.read_bytes()
    size = int.from_bytes(raw[:8], "little")
    header = json.dumps(mutated(rng, json.loads(raw[8 : 8 + size]))).encode()
    raw = rng.choice([len(header), 2**62, 0]).to_bytes(8, "little") + header + raw[8 + size :]
    path.unlink()
    path.write_bytes(raw)
    payload = {"size": len(raw), "xxh3": xxhash.xxh3_128_hexdigest(raw)}
    return forge(root, lambda about: {**about, "payload": payload})


def swap(rng, root):
    """The payload, or the whole entry, of another key."""
    Store(root).put(OTHER, -BIG, ABOUT)
    for suffix in rng.choice([["safetensors"], ["json"], ["json", "safetensors"]]):
        path = root / OTHER[:2] / f"{OTHER}.{suffix}"
        (root / KEY[:2] / f"{KEY}.{suffix}").unlink(missing_ok=True)
        os.link(path, root / KEY[:2] / f"{KEY}.{suffix}")


def not_a_file(rng, root):
    path = rng.choice([p for p in root.rglob("*") if p.is_file() and p.name != ".lock"])
    path.unlink()
    rng.choice(
        [os.mkfifo, os.mkdir, lambda p: os.symlink("/dev/zero", p), lambda p: os.symlink(p, p)]
    )(path)


def forge_version(rng, root):
    sidecar(root).write_bytes(
        as_format(sidecar(root).read_bytes(), rng.choice([0, 1, 3, 2**70, "2", None, []]))
    )


FORGERIES = [damage_json, damage_json, damage_bytes, forge_tensors, swap, not_a_file, forge_version]


def attack(root, seed):
    """One forged or damaged entry: no exception, no wrong value, nothing run, and healed by the
    next put.
    """
    rng = random.Random(seed)
    name = rng.choice([*VALUES])
    value = VALUES[name]
    Store(root).put(KEY, value, ABOUT | {"origin": ORIGIN, "facts": None})
    rng.choice(FORGERIES)(rng, root)
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")
        store = Store(root)
        Costs(store.journal.rows())
        for about in [store.about(KEY), *(about for _, about in store.entries())]:
            assert about is None or isinstance(about.get("step") or "", str)
        try:
            got = store.get(KEY, type(value))
        except KeyError:
            got = None
        assert got is None or equal(got, value) or type(got) is type(value)
        list(Store(root).check())
        Store(root).gc(budget=10**9)
        store = Store(root)
        if not store.has(KEY) or found(root, type(value)) is None:
            store = Store(root)
            with pytest.raises(KeyError):
                store.get(KEY, type(value))
            assert store.put(KEY, value, ABOUT), "a lasting failure"
            assert equal(store.get(KEY), value)
            assert equal(Store(root).get(KEY), value), "a lasting failure"
        return got is not None and not equal(got, value)


def attacks(tmp_path, seeds):
    return [seed for seed in seeds if attack(tmp_path / f"cache{seed}", seed)]


def rewrites_values(seed):
    """Whether an attack forged the value itself with a right seal, which only a signature can
    tell.
    """
    rng = random.Random(seed)
    rng.choice([*VALUES])
    return rng.choice(FORGERIES) in (damage_json, forge_tensors)


@pytest.mark.parametrize("place", ["??/*.json", "??/*.safetensors", "journal.jsonl", "tmp/.lock"])
@pytest.mark.parametrize("kind", [os.mkdir, os.mkfifo])
@pytest.mark.parametrize("value", VALUES.values(), ids=VALUES)
def test_what_is_no_file_is_replaced_by_one(tmp_path, place, kind, value):
    Store(tmp_path).put(KEY, value, ABOUT)
    for path in tmp_path.glob(place):
        path.unlink()
        kind(path)
    assert heals(tmp_path, value)
    assert Store(tmp_path).put_small(OTHER, BIG[:3], ABOUT)
    Store(tmp_path).gc()
    (tmp_path / "brief.jsonl").unlink()
    kind(tmp_path / "brief.jsonl")
    store = Store(tmp_path)
    assert not store.has(OTHER)
    if kind is os.mkdir:
        assert store.put_small(OTHER, BIG[:3], ABOUT)
        assert Store(tmp_path).has(OTHER)


def test_forged_and_damaged_entries_do_no_harm(tmp_path):
    wrong = attacks(tmp_path, range(150))
    assert all(map(rewrites_values, wrong))
    assert len(wrong) < 8


@pytest.mark.slow
def test_2000_forged_and_damaged_entries_do_no_harm(tmp_path):
    wrong = attacks(tmp_path, range(1000, 3000))
    assert all(map(rewrites_values, wrong))
    assert len(wrong) < 60


def test_no_forged_value_is_read_where_there_is_a_secret(tmp_path, monkeypatch):
    """The forger has no secret: whatever is read is what was written, to the last bit."""
    for seed in range(60):
        root = tmp_path / f"cache{seed}"
        rng = random.Random(seed)
        value = VALUES[rng.choice([*VALUES])]
        monkeypatch.setenv("NEUSEE_CACHE_SECRET", "ours")
        Store(root).put(KEY, value, ABOUT)
        monkeypatch.delenv("NEUSEE_CACHE_SECRET")
        rng.choice(FORGERIES)(rng, root)
        monkeypatch.setenv("NEUSEE_CACHE_SECRET", "ours")
        got = found(root, type(value))
        assert got is None or equal(got, value)
        assert heals(root, value)


# --- the journal and the other files --------------------------------------------------------------


def test_forged_lines_of_the_journal_do_no_harm(tmp_path):
    rng = random.Random(0)
    for i in range(5):
        Store(tmp_path).put_receipt(
            f"{i:032x}", ABOUT | {"origin": ORIGIN, "peak": 1000, "step": "psf"}
        )
    rows = Store(tmp_path).journal.rows()
    assert len(rows) == 5
    with (tmp_path / "journal.jsonl").open("ab") as file:
        for field in ("peak", "seconds", "bytes"):
            for bad in (1e30, -1.0, "much", float("nan"), float("inf"), [], True, 10**400):
                file.write(b"\n" + seal_record("journal", {**rows[0], field: bad}))
        for _ in range(300):
            line = mutated(rng, rows[0])
            file.write(b"\n" + seal_record("journal", line if isinstance(line, dict) else {}))
        # in range, without a seal
        file.write(b"\n" + json.dumps({**rows[0], "peak": 10**11}).encode())
    found = Store(tmp_path).journal.rows()
    assert found[:5] == rows
    assert all((row["peak"] or 0) <= 1 << 50 for row in found)
    assert 10**11 not in [row["peak"] for row in found]
    Costs(found)
    Store(tmp_path).gc()
    assert sorted(row["key"] for row in Store(tmp_path).journal.rows()) == [
        row["key"] for row in rows
    ]


def test_forged_small_results_do_no_harm(tmp_path):
    rng = random.Random(0)
    for i in range(100):
        root = tmp_path / str(i)
        store = Store(root)
        store.put_small(KEY, torch.zeros(3), ABOUT)
        about = mutated(rng, SmallResults(store.disk).find(KEY))
        with (root / "brief.jsonl").open("ab") as file:
            file.write(
                b"\n"
                + seal_record(
                    "small result", {"key": KEY, **(about if isinstance(about, dict) else {})}
                )
            )
        with warnings.catch_warnings():
            warnings.simplefilter("ignore")
            for _ in range(2):
                store = Store(root)
                list(store.entries())
                try:
                    assert isinstance(store.get(KEY, torch.Tensor), torch.Tensor)
                except KeyError:
                    assert not Store(root).has(KEY), "the next process meets it again"
                    store.put_small(KEY, torch.zeros(3), ABOUT)
            assert isinstance(Store(root).get(KEY, torch.Tensor), torch.Tensor)


# --- at a URL -------------------------------------------------------------------------------------


@pytest.mark.parametrize("secret", ["", "ours"])
def test_a_forged_entry_at_a_url_does_no_harm(tmp_path, monkeypatch, secret):
    fsspec = pytest.importorskip("fsspec")
    monkeypatch.setenv("NEUSEE_CACHE_SECRET", secret)
    for i, layout in enumerate(
        (called("os:system"), {"new": 1}, {"tensor": 9}, called("neusee.nodes._node:_arguments"))
    ):
        url = f"file://{tmp_path / str(i)}"
        RemoteStore(url, tmp_path / f"one{i}").put(KEY, STOP, ABOUT)
        fs, root = fsspec.core.url_to_fs(url)
        (path,) = fs.find(root)
        forge(
            Path(path).parents[1],
            lambda about, layout=layout: {**about, "layout": layout},
            kind="result at a URL",
        )
        with warnings.catch_warnings():
            warnings.simplefilter("ignore")
            two = RemoteStore(url, tmp_path / f"two{i}")
            for _ in range(3):
                with pytest.raises(KeyError):
                    two.get(KEY)
            assert not two.has(KEY)
            assert two.put(KEY, STOP, ABOUT)
            assert equal(two.get(KEY), STOP)
            assert equal(RemoteStore(url, tmp_path / f"three{i}").get(KEY), STOP)
