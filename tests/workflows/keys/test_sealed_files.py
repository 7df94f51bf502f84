"""Files about code in a cache that somebody else changed: the keys stay right, and the files are
written anew.
"""

import importlib
import json
import sys

import pytest

import neusee.nodes
from neusee.workflows.keys import code_digest
from neusee.workflows.keys.code_digest import Code
from neusee.workflows.keys.module_digest import read_parts
from neusee.workflows.keys.sealed_files import seal_file, seal_record, unseal_file, unseal_record

NODE = (
    "import torch\nfrom neusee.nodes import node\n\n\n@node()\ndef value(*, k: float = 1.0):\n   "
    " return k * {}\n"
)


@pytest.fixture
def package(tmp_path, monkeypatch):
    """A package with a node whose source a test may change, and a cache beside it."""
    monkeypatch.setattr(sys, "dont_write_bytecode", True)
    monkeypatch.setattr(neusee.nodes, "__path__", [*neusee.nodes.__path__, str(tmp_path)])
    monkeypatch.delenv("NEUSEE_CACHE_SECRET", raising=False)
    yield tmp_path
    sys.modules.pop("neusee.nodes.sealed_trial", None)
    vars(neusee.nodes).pop("sealed_trial", None)


def digest_of(package, factor):
    """The digest of the node with a factor, as a new process finds it, and the number of sources
    that it parses.
    """
    sys.modules.pop("neusee.nodes.sealed_trial", None)
    vars(neusee.nodes).pop("sealed_trial", None)
    (package / "sealed_trial.py").write_text(NODE.format(factor))
    importlib.invalidate_caches()
    code = Code(package / "cache" / "code.json")
    before = len(code._summaries)
    found = code.of(importlib.import_module("neusee.nodes.sealed_trial").value)
    parsed = len(code._summaries) - before
    code.save()
    return found, parsed


def with_the_tree_of(first, second, raw):
    """A memo, with a right checksum, that gives the second source the syntax digests of the
    first one.
    """
    names, text = raw.partition(b"\n")[2].split(b"\n", 1)
    summaries = json.loads(text)
    own = [name for name, summary in summaries.items() if "value()" in summary[6]]
    summaries[own[second]][:2] = summaries[own[first]][:2]
    content = names + b"\n" + json.dumps(summaries).encode()
    return seal_file("sources", "code.json", content) + b"\n" + content


@pytest.mark.parametrize("secret", ["", "ours"])
def test_a_memo_of_another_writer_is_read_only_without_a_secret(package, monkeypatch, secret):
    """Its summary of one source in place of another would make an old result the result of new
    code.
    """
    memo = package / "cache" / "code.json"
    old, right = digest_of(package, 2.0)[0], digest_of(package, 3.0)[0]
    assert old != right
    memo.write_bytes(with_the_tree_of(0, 1, memo.read_bytes()))
    monkeypatch.setenv("NEUSEE_CACHE_SECRET", secret)
    found, parsed = digest_of(package, 3.0)
    assert (found, parsed > 0) == ((right, True) if secret else (old, False))
    if secret:
        assert b'","sign":"' in memo.read_bytes().partition(b"\n")[0]
        assert digest_of(package, 3.0) == (right, 0)
        monkeypatch.setenv("NEUSEE_CACHE_SECRET", f"new, {secret}")
        assert digest_of(package, 3.0) == (right, 0)
        monkeypatch.setenv("NEUSEE_CACHE_SECRET", "another")
        assert digest_of(package, 3.0)[1] > 0


def test_a_record_of_definitions_of_another_writer_is_not_read_and_written_anew(
    package, monkeypatch
):
    found, _ = digest_of(package, 2.0)
    root, path = package / "cache", package / "cache" / "code" / f"{found}.json"
    right = read_parts(root, found)
    assert "value()" in right["neusee.nodes.sealed_trial"]
    monkeypatch.setenv("NEUSEE_CACHE_SECRET", "ours")
    assert read_parts(root, found) == {}
    digest_of(package, 2.0)
    assert read_parts(root, found) == right
    other = {"neusee.nodes.sealed_trial": {"value()": "0"}}
    for content in (
        seal_record("definitions", {"key": "code/0123", **other}),
        path.read_bytes().replace(b"value()", b"other()"),
        b"",
        b"\xff\x00\n{",
        seal_record("definitions", {"key": f"code/{found}", "module": [1]}),
        b"[" * 100_000,
    ):
        path.write_bytes(content)
        assert read_parts(root, found) == {}
        digest_of(package, 2.0)
        assert read_parts(root, found) == right


def test_the_seal_of_a_file_covers_its_name_and_its_content():
    seal = seal_file("answer", "a", b"content")
    assert unseal_file("answer", "a", seal, b"content") == b"content"
    for name, content in (("b", b"content"), ("a", b"Content")):
        with pytest.raises(ValueError, match="not what was sealed"):
            unseal_file("answer", name, seal, content)
    record = unseal_record("answer", seal)
    with pytest.raises(ValueError, match="not what was sealed"):
        unseal_file("answer", "a", seal_record("answer", {**record, "more": 1}), b"content")


def test_flipped_bits_of_a_record_of_definitions_give_no_definitions(package):
    found, _ = digest_of(package, 2.0)
    path = package / "cache" / "code" / f"{found}.json"
    whole = path.read_bytes()
    for place in range(0, len(whole), max(1, len(whole) // 60)):
        path.write_bytes(whole[:place] + bytes([whole[place] ^ 1]) + whole[place + 1 :])
        assert read_parts(package / "cache", found) == {}


def test_code_that_parses_no_source_is_what_the_memo_is_for(package, monkeypatch):
    right = digest_of(package, 2.0)[0]
    monkeypatch.setattr(code_digest, "_summarised", lambda source: pytest.fail("parsed again"))
    assert digest_of(package, 2.0) == (right, 0)
