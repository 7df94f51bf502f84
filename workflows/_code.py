"""Digests of code: what a node's module says, and every `neusee.nodes` module it imports.

Comments, layout and docstrings are left out, so better words keep the cache; helpers and
constants are in, so a changed constant never serves an old result. The syntax trees'
digests are kept in a file by the digest of the source, so that a cached run parses nothing.
"""

from __future__ import annotations

import ast
import json
import os
import sys
import warnings
from collections.abc import Iterator
from contextlib import suppress
from pathlib import Path
from typing import Any

import xxhash

from neusee.workflows._keys import digest

_ROOT = "neusee.nodes"
_LEFT_OUT = frozenset({_ROOT, f"{_ROOT}._node"})  #: decide nothing of what a node computes
_KEPT = 2000  #: summaries in the file
_PYTHON = "{}.{}".format(*sys.version_info)  #: a syntax tree's text changes with it
_THIS_PROCESS = os.urandom(8).hex()

Summary = tuple[str, list[tuple[int, str, str]], list[str]]  #: tree's digest, imports, names bound by imports
_edited_since: set[str] = set()  #: loaded modules whose source is no longer what runs
_frozen: dict[str, tuple[Any, str]] = {}  #: module -> its spec and the digest of its source when first seen


class Code:
    """Digests of modules, for the length of one run."""

    def __init__(self, memo: Path) -> None:
        self._memo = memo
        self._summaries: dict[str, Summary] = _read(memo)
        self._new = False
        self._digests: dict[str, str] = {}

    def digest(self, module: str) -> str:
        """Digest of ``module`` and, transitively, of what it imports of `neusee.nodes`."""
        if module not in self._digests:
            seen: dict[str, str] = {}
            todo = [module]
            while todo:
                name = todo.pop()
                if name not in seen:
                    seen[name], imports = self._look(name)
                    todo += imports
            self._digests[module] = digest(seen)
        return self._digests[module]

    def save(self) -> None:
        """Keep the summaries that this run had to make; failing to is no failure."""
        if not self._new:
            return
        self._new = False
        part = self._memo.parent / "tmp" / f"{self._memo.name}.{os.getpid()}"
        with suppress(OSError):
            part.parent.mkdir(parents=True, exist_ok=True)
            part.write_text(json.dumps(dict(list(self._summaries.items())[-_KEPT:])))
            os.replace(part, self._memo)

    def _look(self, module: str) -> tuple[str, list[str]]:
        path = _path(module)
        if path is None:
            raise LookupError(f"{module} has no source file, so its results cannot be told from others: put it in one")
        tree, imports, _ = self._summary(module, path)
        tree += _THIS_PROCESS if module in _edited_since else ""
        package = module if path.name == "__init__.py" else module.rpartition(".")[0]
        names = [n for item in imports for n in self._imported(*item, package)]
        return tree, [n for n in names if n.startswith(f"{_ROOT}.") and n not in _LEFT_OUT]

    def _imported(self, level: int, base: str, name: str, package: str) -> Iterator[str]:
        """Modules that one import reads: a submodule alone, or the module that holds the name."""
        if level:
            base = ".".join([*package.split(".")[: len(package.split(".")) - level + 1], *filter(None, [base])])
        below = f"{base}.{name}"
        if name and below.startswith(_ROOT) and _path(below) is not None:
            yield below
            path = None if base in _LEFT_OUT else _path(base)
            if path is None or name not in self._summary(base, path)[2]:
                return
        yield base

    def _summary(self, module: str, path: Path) -> Summary:
        source = _source_digest(module, path)
        name = f"{_PYTHON}:{source}"
        if name not in self._summaries:
            self._summaries[name] = summarise(path.read_bytes())
            self._new = True
        return self._summaries[name]


def summarise(source: bytes) -> Summary:
    """Digest of a syntax tree without docstrings, and what it imports."""
    tree = ast.parse(source)
    imports: list[tuple[int, str, str]] = []
    binds: list[str] = []
    for item in ast.walk(tree):
        if isinstance(item, ast.Module | ast.FunctionDef | ast.AsyncFunctionDef | ast.ClassDef):
            if ast.get_docstring(item, clean=False) is not None:
                item.body = item.body[1:]
        elif isinstance(item, ast.Import):
            imports += [(0, alias.name, "") for alias in item.names if alias.name.startswith(_ROOT)]
        elif isinstance(item, ast.ImportFrom) and (item.level or (item.module or "").startswith("neusee")):
            imports += [(item.level, item.module or "", alias.name) for alias in item.names]
            binds += [alias.asname or alias.name for alias in item.names]
    return digest(ast.dump(tree)), imports, binds


def _read(memo: Path) -> dict[str, Summary]:
    """Summaries of earlier runs; a damaged file is an empty one."""
    try:
        known = json.loads(memo.read_bytes())
        return {
            name: (str(t), [(int(k), str(m), str(n)) for k, m, n in i], list(b)) for name, (t, i, b) in known.items()
        }
    except (OSError, ValueError, TypeError, AttributeError):
        return {}


def _path(module: str) -> Path | None:
    """Source file of a module, without importing it."""
    if module in sys.modules:
        file = getattr(sys.modules[module], "__file__", None)
        return Path(file) if file and os.path.isfile(file) else None
    inside = module.startswith(f"{_ROOT}.")
    for folder in getattr(sys.modules.get(_ROOT), "__path__", ()) if inside else ():
        stem = os.path.join(folder, *module.split(".")[2:])
        for file in (f"{stem}.py", os.path.join(stem, "__init__.py")):
            if os.path.isfile(file):
                return Path(file)
    return None


def _source_digest(module: str, path: Path) -> str:
    """xxh3 of a source; of a loaded module, as it was when first seen, for that is what runs."""
    spec = getattr(sys.modules.get(module), "__spec__", None)
    if spec is not None and module in _frozen and _frozen[module][0] is spec:
        return _frozen[module][1]
    found = xxhash.xxh3_128_hexdigest(path.read_bytes())
    _edited_since.discard(module)
    if spec is not None:
        _frozen[module] = (spec, found)
        if _edited(spec, path):
            _edited_since.add(module)
            warnings.warn(f"{path} was edited after it was imported: start again to keep its results", stacklevel=2)
    return found


def _edited(spec: Any, path: Path) -> bool:
    """Whether the byte code that Python left at import is of another source than ``path`` now holds."""
    try:
        with open(spec.cached or "", "rb") as file:
            head = file.read(16)
        stat = os.stat(path)
        writable = os.access(os.path.dirname(spec.cached), os.W_OK) and not sys.dont_write_bytecode
    except OSError:
        return False
    stamp = b"".join((int(n) & 0xFFFFFFFF).to_bytes(4, "little") for n in (stat.st_mtime, stat.st_size))
    return writable and head[4:8] == bytes(4) and head[8:] != stamp
