"""Signatures: with a secret, only what somebody with the secret wrote is read, wherever it lies."""

import hashlib
import hmac
import json
import warnings

import pytest
import torch

from neusee.workflows.keys.sealed_files import OtherFormat, Unsigned, seal_record, unseal_record
from neusee.workflows.store.derived_files import DerivedFiles
from neusee.workflows.store.remote_store import RemoteStore
from neusee.workflows.store.result_store import Store

KEY = "ab" + "0" * 30
BIG = torch.arange(3000, dtype=torch.float64)
VALUES = {
    "payload": BIG,
    "inline": BIG[:4].clone(),
}
ABOUT = {"step": "s", "seconds": 2.0, "bytes": 32000}


@pytest.fixture
def secret(monkeypatch):
    return lambda text: monkeypatch.setenv("NEUSEE_CACHE_SECRET", text)


def read(store):
    """The value, or None where it is not read; each warning must be the one of a missing
    signature, or of damage.
    """
    with warnings.catch_warnings(record=True):
        warnings.simplefilter("always")
        try:
            return store.get(KEY)
        except KeyError:
            return None


@pytest.fixture(params=["folder", "url"])
def place(request, tmp_path):
    """Opens the shared place of several users anew: a folder, or a URL with a local folder for
    each call.
    """
    opened = []

    def store():
        opened.append(0)
        if request.param == "folder":
            return Store(tmp_path / "shared")
        pytest.importorskip("fsspec")
        return RemoteStore(f"file://{tmp_path / 'there'}", tmp_path / f"here{len(opened)}")

    return store


@pytest.mark.parametrize("value", VALUES.values(), ids=VALUES)
@pytest.mark.parametrize(
    ("writes", "reads", "is_read"),
    [
        ("", "", True),
        ("one", "", True),
        ("one", "one", True),
        ("one", "two, one", True),
        ("two, one", "one", False),
        ("", "one", False),
        ("one", "two", False),
        (" , ", "one", False),
        ("one", " one ,", True),
    ],
)
def test_who_reads_what_whom_wrote(place, secret, value, writes, reads, is_read):
    secret(writes)
    assert place().put(KEY, value, ABOUT)
    secret(reads)
    found = read(place())
    assert (found is not None) == is_read
    if not is_read:  # the run computes the value and writes it over what is not read
        store = place()
        assert read(store) is None
        assert store.put(KEY, value, ABOUT)
        found = store.get(KEY)
    assert torch.equal(found, value)
    assert torch.equal(read(place()), value)


def test_what_is_unsigned_is_told_of_once_and_left_alone(tmp_path, secret):
    for i in range(3):
        Store(tmp_path).put(f"{i:02x}" + "0" * 30, BIG, ABOUT)
    files = {path: path.read_bytes() for path in tmp_path.glob("??/*")}
    secret("one")
    store = Store(tmp_path)
    with pytest.warns(UserWarning, match="without a signature by NEUSEE_CACHE_SECRET") as told:
        assert not any(store.has(f"{i:02x}" + "0" * 30) for i in range(3))
    assert len(told) == 1
    assert {path: path.read_bytes() for path in tmp_path.glob("??/*")} == files


def test_a_signature_is_that_of_format_kind_key_and_content(secret):
    """By the definition, with nothing of the program."""
    secret("one,two")
    raw = seal_record("result", {"key": KEY, "x": 1})
    about = json.loads(raw)
    body = raw[: raw.index(b',"seal"')]
    text = b"neusee cache 2\nresult\n" + KEY.encode() + b"\n" + hashlib.sha256(body).digest()
    assert about["sign"] == hmac.new(b"one", text, "sha256").hexdigest()
    assert unseal_record("result", raw) == {"key": KEY, "x": 1}
    for forged in (
        raw.replace(about["sign"].encode(), b"0" * 64),
        raw[:-76] + b'"}',
        raw[:-1] + b" ",
    ):
        with pytest.raises(ValueError, match=r"signature|checksum"):
            unseal_record("result", forged)
    secret("two")
    with pytest.raises(Unsigned):
        unseal_record("result", raw)


def test_a_record_says_its_version():
    assert json.loads(seal_record("result", {"key": KEY}))["format"] == 2
    other = seal_record("result", {"key": KEY}).replace(b'"format":2', b'"format":3')
    with pytest.raises(OtherFormat, match="version 3, not version 2"):
        unseal_record("result", other[:-43] + seal_of(KEY, 3))


def seal_of(key, version):
    import xxhash

    body = f'{{"key":"{key}","format":{version}'.encode()
    return f',"seal":"{xxhash.xxh3_128_hexdigest(body)}"}}'.encode()[-43:]


@pytest.mark.parametrize("verify", ["always", "sampled", "never"])
def test_a_payload_that_was_exchanged_is_not_read(tmp_path, secret, verify):
    """Its checksum can be forged by anybody; its SHA-256 is signed, and compared in each mode."""
    secret("one")
    Store(tmp_path).put(KEY, BIG, ABOUT)
    path = tmp_path / "ab" / f"{KEY}.safetensors"
    raw = bytearray(path.read_bytes())
    raw[-100] ^= 1
    path.write_bytes(raw)
    assert read(Store(tmp_path, verify=verify)) is None


def test_the_journal_and_small_results_are_signed_too(tmp_path, secret):
    Store(tmp_path).put_small(KEY, BIG[:3], ABOUT)
    assert len(Store(tmp_path).journal.rows()) == 1
    secret("one")
    assert Store(tmp_path).journal.rows() == []
    assert read(Store(tmp_path)) is None
    Store(tmp_path).put_small(KEY, BIG[:3], ABOUT)
    assert len(Store(tmp_path).journal.rows()) == 1
    assert torch.equal(read(Store(tmp_path)), BIG[:3])


def test_a_derived_file_is_bound_by_its_sha256(tmp_path, secret):
    secret("one")
    files = DerivedFiles(Store(tmp_path))
    path = files.keep(KEY, ".png", "picture", lambda path: path.write_bytes(b"picture"))
    assert files.find(KEY, ".png") == path
    assert bytes(Store(tmp_path).get(KEY).tolist()) == hashlib.sha256(b"picture").digest()
    path.unlink()
    path.write_bytes(b"picturf")
    assert files.find(KEY, ".png") is None


def test_a_store_of_a_forged_value_type_is_no_file(tmp_path):
    store = Store(tmp_path)
    files = DerivedFiles(store)
    files.keep(KEY, ".png", "picture", lambda path: path.write_bytes(b"picture"))
    store.put(KEY, ["text"], ABOUT | {"file": f"{KEY}.png"})
    with pytest.warns(UserWarning, match="is damaged"):
        assert DerivedFiles(Store(tmp_path)).find(KEY, ".png") is None
