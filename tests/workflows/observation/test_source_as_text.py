"""Source of an own module that a step opens: its comments and lines are in no key, unless a
message quotes them.
"""

import ast
import importlib
import inspect
import linecache
import logging
import sys
import tokenize
import traceback
import warnings
from pathlib import Path

import pytest

CODE = "# 2\ndef gain():\n    return 1\n\n\ndef fail():\n    raise ValueError\n"


@pytest.fixture
def helper(tmp_path, monkeypatch):
    monkeypatch.syspath_prepend(tmp_path)
    monkeypatch.setattr(sys, "dont_write_bytecode", True)
    (tmp_path / "helper_of_lines.py").write_text(CODE)
    importlib.invalidate_caches()
    yield importlib.import_module("helper_of_lines")
    del sys.modules["helper_of_lines"]
    linecache.clearcache()


READERS = {
    "open": lambda helper: Path(helper.__file__).read_text(),
    "comments": lambda helper: inspect.getcomments(helper.gain),
    "source": lambda helper: inspect.getsource(helper),
    "line": lambda helper: linecache.getline(helper.__file__, 1),
    "words": lambda helper: tokenize.open(helper.__file__).close(),
    "tree": lambda helper: ast.parse(Path(helper.__file__).read_bytes()),
}


@pytest.mark.parametrize("kind", READERS)
def test_source_that_is_read_as_a_text_is_found(kind, helper, taints, layer):
    linecache.clearcache()
    assert taints(lambda: READERS[kind](helper)) == [("file", "helper_of_lines.py")]


def test_source_that_is_declared_is_none(helper, tmp_path, taints, layer):
    linecache.clearcache()
    assert taints(lambda: inspect.getsource(helper), tmp_path / "helper_of_lines.py") == []


def quoted(helper):
    with warnings.catch_warnings():
        warnings.simplefilter("always")
        exec(compile("import warnings\nwarnings.warn('x')", helper.__file__, "exec"), {})
    try:
        helper.fail()
    except ValueError:
        logging.getLogger("quoted").exception("x")
        return traceback.format_exc()


def test_a_message_that_quotes_a_line_is_none(helper, taints, layer):
    linecache.clearcache()
    assert taints(lambda: quoted(helper)) == []


def test_an_import_in_a_step_is_none(helper, tmp_path, taints, layer):
    (tmp_path / "late_helper_of_lines.py").write_text(CODE)
    assert taints(lambda: importlib.import_module("late_helper_of_lines")) == []
    del sys.modules["late_helper_of_lines"]
