"""Digests of the code of nodes: a digest covers a node's module and all modules of `neusee.nodes` that it imports.

Helpers and constants affect a digest; comments, layout and docstrings do not. A file stores the summaries of source
files, so that a run from the cache parses no source. The files ``code/<digest>.json`` store the digests of single
definitions. Cache keys do not need these files; reports of changes use them to name the changed function.
"""

from __future__ import annotations

import functools
import json
import os
import sys
import threading
import warnings
from collections.abc import Iterator
from contextlib import suppress
from pathlib import Path
from typing import Any

import xxhash
from pydantic import TypeAdapter

from neusee.workflows.keys.cache_key import digest
from neusee.workflows.keys.source_summary import ROOT, Summary, Use, module_file, summarise

_LEFT_OUT = frozenset({ROOT, f"{ROOT}._node"})  #: modules that do not affect the result of a node
_KEPT = 1000  #: number of summaries in the file
_SUMMARIES = TypeAdapter(dict[str, Summary])
_PYTHON = "{}.{}".format(*sys.version_info)  #: the text of a syntax tree depends on the version of Python
_THIS_PROCESS = os.urandom(8).hex()

_edited_since: set[str] = set()  #: loaded modules whose source was edited after the import
_frozen: dict[str, tuple[Any, str]] = {}  #: spec and source digest at the first reading, by module


class Code:
    """Digests of the source code of nodes, which stay the same during one run."""

    def __init__(self, memo: Path) -> None:
        self._memo = memo
        self._summaries: dict[str, Summary] = _read(memo)
        self._new = False
        self._digests: dict[str, str] = {}
        self._parts: dict[str, dict[str, dict[str, str]]] = {}  # definitions by digest and module
        self._path = functools.cache(source_file)

    def digest(self, module: str) -> str:
        """Return the digest of a module and of all modules of `neusee.nodes` that it imports, directly or not.

        Raises `LookupError` if an imported module or its source cannot be determined.
        """
        if module not in self._digests:
            seen: dict[str, str] = {}
            parts: dict[str, dict[str, str]] = {}
            todo = [module]
            while todo:
                name = todo.pop()
                if name not in seen:
                    seen[name], parts[name], imports = self._look(name)
                    todo += imports
            code = self._digests[module] = digest(seen)
            if _edited_since.isdisjoint(seen):  # otherwise the digest is valid only in this process
                self._parts[code] = parts
        return self._digests[module]

    def save(self) -> None:
        """Save the new digests of source files and of their functions; do nothing if the folder cannot be written."""
        if self._new:
            self._new = False
            _write(self._memo, dict(list(self._summaries.items())[-_KEPT:]), self._memo.parent / "tmp")
        for code, parts in self._parts.items():
            path = parts_file(self._memo.parent, code)
            if not os.path.exists(path):
                _write(path, parts, self._memo.parent / "tmp")
        self._parts = {}

    def _look(self, module: str) -> tuple[str, dict[str, str], list[str]]:
        path = self._path(module)
        if path is None:
            raise LookupError(f"{module} has no source file, so its nodes have no cache key: save the module as a file")
        summary = self._summary(module, path)
        tree = summary.tree + (_THIS_PROCESS if module in _edited_since else "")
        package = module if path.name == "__init__.py" else module.rpartition(".")[0]
        names = [n for item in summary.imports for n in self._imported(*item, package)]
        for use in summary.uses:
            used = self._used(use, package)
            if used is not None:
                names += used
            elif module.startswith(ROOT):
                what = "the package of all nodes is used, so the modules that a result depends on are unknown"
                raise LookupError(f"{path}:{use[-1]}: {what}: import each name from its own module")
        return tree, summary.definitions, [n for n in names if n.startswith(f"{ROOT}.") and n not in _LEFT_OUT]

    def _imported(self, level: int, base: str, name: str, package: str) -> Iterator[str]:
        """Yield the modules that an import needs: a submodule, or the module that defines the imported name."""
        base = _absolute(level, base, package)
        submodule = f"{base}.{name}"
        if name and submodule.startswith(ROOT) and self._path(submodule) is not None:
            yield submodule
            path = None if base in _LEFT_OUT else self._path(base)
            if path is None or name not in self._summary(base, path).binds:
                return
        yield base

    def _used(self, use: Use, package: str) -> list[str] | None:
        """Return the modules in an expression such as ``name.a.b``, or None if it uses all of `neusee.nodes`."""
        level, base, name, chain, _ = use
        modules = [".".join(filter(None, (_absolute(level, base, package), name)))]
        rest = chain.split(".") if chain else []
        while rest and self._has_submodule(modules[-1], rest[0]):
            modules.append(f"{modules[-1]}.{rest.pop(0)}")
        whole = modules[-1] in ("neusee", ROOT) and (not rest or rest[0].startswith("__"))
        return None if whole else modules[1:]

    def _has_submodule(self, module: str, name: str) -> bool:
        submodule, path = f"{module}.{name}", self._path(module) if module.startswith(ROOT) else None
        is_package = path is not None and path.name == "__init__.py"
        return submodule == ROOT or (is_package and self._path(submodule) is not None)

    def _summary(self, module: str, path: Path) -> Summary:
        source = _source_digest(module, path)
        name = f"{_PYTHON}:{source}"
        if name not in self._summaries:
            self._summaries[name] = summarise(path.read_bytes())
            self._new = True
        return self._summaries[name]


def parts_file(root: Path, code: str) -> Path:
    """Return the path of the file that stores the digest of each definition that the digest ``code`` covers."""
    return root / "code" / f"{code}.json"


def _absolute(level: int, base: str, package: str) -> str:
    """Return the absolute name of the module ``base`` in a relative import with ``level`` leading dots."""
    if not level:
        return base
    above = package.split(".")
    return ".".join([*above[: len(above) - level + 1], *filter(None, [base])])


def _write(path: Path, content: Any, folder: Path) -> None:
    """Write a JSON file by atomic rename; do nothing if the folder cannot be written."""
    part = folder / f"{path.name}.{os.getpid()}.{threading.get_ident()}"
    with suppress(OSError):
        folder.mkdir(parents=True, exist_ok=True)
        path.parent.mkdir(exist_ok=True)
        part.write_text(json.dumps(content))
        os.replace(part, path)


def _read(memo: Path) -> dict[str, Summary]:
    """Return the saved summaries of source files, or an empty dict if their file is damaged or has an older format."""
    try:
        return _SUMMARIES.validate_json(memo.read_bytes())
    except (OSError, ValueError):
        return {}


def source_file(module: str) -> Path | None:
    """Return the source file of a module without importing the module, or None if there is no source file."""
    if module in sys.modules:
        file = getattr(sys.modules[module], "__file__", None)
        return Path(file) if file and os.path.isfile(file) else None
    if not module.startswith(f"{ROOT}."):
        return None
    folders = getattr(sys.modules.get(ROOT), "__path__", ())
    return next(filter(None, (module_file(folder, module.split(".")[2:]) for folder in folders)), None)


def _source_digest(module: str, path: Path) -> str:
    """Return the xxh3 digest of the source file of a module, computed only once if the module is imported."""
    spec = getattr(sys.modules.get(module), "__spec__", None)
    if spec is not None and module in _frozen and _frozen[module][0] is spec:
        return _frozen[module][1]
    source = xxhash.xxh3_128_hexdigest(path.read_bytes())
    _edited_since.discard(module)
    if spec is not None:
        _frozen[module] = (spec, source)
        if _edited(spec, path):
            _edited_since.add(module)
            warnings.warn(f"{path} was edited after its import: restart Python to reuse new results", stacklevel=2)
    return source


def _edited(spec: Any, path: Path) -> bool:
    """Return True if the source file has changed since Python wrote the byte code of the module."""
    try:
        with open(spec.cached or "", "rb") as file:
            head = file.read(16)
        stat = os.stat(path)
        writable = os.access(os.path.dirname(spec.cached), os.W_OK) and not sys.dont_write_bytecode
    except OSError:
        return False
    stamp = b"".join((int(n) & 0xFFFFFFFF).to_bytes(4, "little") for n in (stat.st_mtime, stat.st_size))
    return writable and head[4:8] == bytes(4) and head[8:] != stamp
