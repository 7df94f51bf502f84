"""Import of files and folders with nodes of a user, under the names that the files have.

Such a module is an ordinary module of the process: its folder is searched by ``import``, so that it can import helpers
beside it. A process that receives one of its nodes imports the same file.
"""

from __future__ import annotations

import ast
import importlib
import importlib.util
import os
import sys
from collections.abc import Callable, Iterator
from pathlib import Path
from types import ModuleType

#: file of each module that was imported here, by name, in the order of the imports; None for one imported by its name
_files: dict[str, Path | None] = {}


def import_file(path: Path, load: Callable[[str], ModuleType] = importlib.import_module) -> ModuleType:
    """Import a file such as ``bloom.py``, or a package folder with ``__init__.py``, and return the module.

    ``load`` imports the module by its name.
    Raises `ImportError` if there is no such file, if another module has its name or the name of a helper beside it, and
    whatever the code raises.
    """
    file = path / "__init__.py" if path.is_dir() else path
    name = path.name if path.is_dir() else path.stem
    if not file.is_file():
        raise ImportError(f"{path} has no __init__.py" if path.is_dir() else f"there is no file {path}")
    if not name.isidentifier():
        raise ImportError(f"{name} is not the name of a module: use letters, digits and _")
    _refuse_taken(name, file)
    folder = str(path.parent)
    if folder not in sys.path:
        sys.path.append(folder)
    importlib.invalidate_caches()
    known = set(sys.modules)
    try:
        module = load(name)
    except BaseException:
        for added in [module for module in sys.modules if module not in known and f"{module}.".startswith(f"{name}.")]:
            del sys.modules[added]
        raise
    for helper, beside in _helpers(file, path.parent):
        _refuse_taken(helper, beside)
    _files[name] = path.absolute()
    return module


def note_module(name: str) -> None:
    """Note a module with nodes of a user that was imported by its name."""
    _files.setdefault(name, None)


def own_modules() -> tuple[str, ...]:
    """Return the names of the modules with nodes of a user that this process has imported, in their order."""
    return tuple(name for name in _files if name in sys.modules)


def own_files() -> tuple[str, ...]:
    """Return the files and folders that this process has imported as modules of nodes, and the names of others."""
    return tuple(str(file or name) for name, file in _files.items())


def import_missing(files: tuple[str, ...], needed: str) -> None:
    """Import the modules of another process that this process lacks.

    The other process may have imported files that no longer exist, or that this process cannot import. Only what the
    module ``needed`` raises is raised: `ImportError` for a missing file, and whatever its code raises.
    """
    for each in files:
        try:
            _import_if_missing(each)
        except Exception:
            if needed.partition(".")[0] == _top_name(each):
                raise


def _import_if_missing(file: str) -> None:
    if not os.path.isabs(file):
        importlib.import_module(file)
        note_module(file)
    elif _files.get(_top_name(file)) != Path(file):
        import_file(Path(file))


def _top_name(file: str) -> str:
    """Return the first part of the name of the module in a file or folder, or of a module that is given by its name."""
    return Path(file).stem if os.path.isabs(file) else file.partition(".")[0]


def _refuse_taken(name: str, file: Path) -> None:
    """Raise `ImportError` if ``import name`` does not mean ``file``."""
    loaded = sys.modules.get(name)
    taken = getattr(loaded, "__file__", None) if loaded is not None else _found(name)
    if loaded is not None and taken is None:
        raise ImportError(f"the name {name} is that of a module of Python: rename {file}")
    if taken is not None and Path(taken).resolve() != file.resolve():
        raise ImportError(f"the name {name} is that of {taken}: rename {file}")


def _found(name: str) -> str | None:
    """Return the file that ``import name`` would load, or None."""
    try:
        spec = importlib.util.find_spec(name)
    except (ImportError, ValueError):
        return None
    if spec is None:
        return None
    return spec.origin if spec.has_location or spec.origin else None


def _helpers(file: Path, folder: Path) -> Iterator[tuple[str, Path]]:
    """Yield name and file of each module beside ``file`` that ``file`` imports."""
    for item in ast.walk(ast.parse(file.read_bytes())):
        names = [alias.name for alias in item.names] if isinstance(item, ast.Import) else []
        if isinstance(item, ast.ImportFrom) and item.module and not item.level:
            names = [item.module]
        for top in {name.partition(".")[0] for name in names}:
            for beside in (folder / f"{top}.py", folder / top / "__init__.py"):
                if beside.is_file():
                    yield top, beside
                    break
