"""Digests of compiled functions, which tell whether the code that a process runs is that of a source file.

Line numbers, file names and docstrings of modules and classes do not count.
"""

from __future__ import annotations

import importlib.util
import marshal
import sys
from collections.abc import Iterator
from types import CodeType

import xxhash

#: what the byte code of a source depends on beside the source
PYTHON = f"{'{}.{}'.format(*sys.version_info)}-{importlib.util.MAGIC_NUMBER.hex()}-{sys.flags.optimize}"
_MOST = 20_000  #: number of code objects whose digests are kept
_known: dict[int, tuple[CodeType, str]] = {}  #: code objects with their digests, by id
_SHORT = 12  #: digits of the digest of a code object


def functions_of(source: bytes) -> list[str]:
    """Return the digest of each function in a source file, at any depth, in alphabetical order."""
    code = compile(source, "source", "exec", dont_inherit=True)
    return sorted({function_code(inner) for inner in _inner(code)})


def function_code(code: CodeType) -> str:
    """Return the digest of a code object, which never changes, with its name, its constants and its inner functions."""
    known = _known.get(id(code))
    if known is None or known[0] is not code:
        if len(_known) > _MOST:
            _known.clear()
        known = _known[id(code)] = code, _digest_of(code)
    return known[1]


def _digest_of(code: CodeType) -> str:
    consts = tuple(function_code(item) if isinstance(item, CodeType) else item for item in code.co_consts)
    names = (code.co_qualname, code.co_names, code.co_varnames, code.co_freevars, code.co_cellvars)
    sizes = (code.co_flags, code.co_argcount, code.co_posonlyargcount, code.co_kwonlyargcount)
    raw = marshal.dumps((code.co_code, consts, names, sizes, code.co_exceptiontable), 2)
    return xxhash.xxh3_64_hexdigest(raw)[:_SHORT]


def _inner(code: CodeType) -> Iterator[CodeType]:
    todo = [code]
    while todo:
        for item in todo.pop().co_consts:
            if isinstance(item, CodeType):
                yield item
                todo.append(item)
