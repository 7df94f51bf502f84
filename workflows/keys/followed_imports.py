"""Modules that the imports of a module lead to, with the names that are used of each."""

from __future__ import annotations

import sys
from collections.abc import Callable, Iterator
from pathlib import Path

from neusee.workflows.keys.module_origin import Kind, contents, module_path
from neusee.workflows.keys.source_summary import ROOT, Import, Summary, Use
from neusee.workflows.keys.unfollowed_code import UnfollowedCode

Lookup = Callable[[str], tuple[Path, Summary] | None]


class Imports:
    """The imports of one module, resolved to modules."""

    def __init__(self, module: str, path: Path, summary_of: Lookup, kind_of: Callable[[str], Kind]) -> None:
        self._module, self._path, self._summary_of, self._kind_of = module, path, summary_of, kind_of
        self._package = module if path.name == "__init__.py" else module.rpartition(".")[0]

    def names(self, summary: Summary) -> dict[str, set[str]]:
        """Return the imported modules with the names that are used; an empty name stands for the whole module.

        Raises `LookupError` if the package of all nodes is used as a whole.
        """
        found: dict[str, set[str]] = {}
        for item in summary.imports:
            for module, name in self._imported(item):
                found.setdefault(module, set()).add(name)
        for use in summary.uses:
            used = self._used(use)
            if used is None and self._module.startswith(ROOT):
                what = "the package of all nodes is used, so the modules that a result depends on are unknown"
                raise UnfollowedCode(f"{self._path}:{use[-1]}: {what}: import each name from its own module")
            for module in used or ():
                found.setdefault(module, set()).add("")
        return found

    def _imported(self, item: Import) -> Iterator[tuple[str, str]]:
        """Yield the modules that an import needs: a submodule, or the module that defines the imported name."""
        level, base, name = item
        base = absolute(level, base, self._package)
        if name and name != "*" and self._is_module(base, name):
            yield f"{base}.{name}", ""
            inner = self._summary_of(base)
            if inner is None or name not in inner[1].binds:
                return
        yield base, name

    def _used(self, use: Use) -> list[str] | None:
        """Return the modules in an expression such as ``name.a.b``, or None if it uses all of `neusee.nodes`."""
        level, base, name, chain, _ = use
        first = ".".join(filter(None, (absolute(level, base, self._package), name)))
        modules, rest = [first], chain.split(".") if chain else []
        while rest and self._is_module(modules[-1], rest[0]):
            modules.append(f"{modules[-1]}.{rest.pop(0)}")
        whole = modules[-1] in ("neusee", ROOT) and (not rest or rest[0].startswith("__"))
        return None if whole else modules[1:]

    def _is_module(self, package: str, name: str) -> bool:
        """Return True if a package, whose source is followed or which is a folder, has a module of this name."""
        module = f"{package}.{name}"
        if module == ROOT:
            return True
        inside = package == ROOT or self._kind_of(package) in ("source", "folder")
        if package in sys.modules and "__path__" not in contents(package):
            return False
        return inside and module_path(module) is not None


def absolute(level: int, base: str, package: str) -> str:
    """Return the absolute name of the module ``base`` in a relative import with ``level`` leading dots."""
    if not level:
        return base
    above = package.split(".")
    return ".".join([*above[: len(above) - level + 1], *filter(None, [base])])
