"""Import of the files and folders of a user, and the network classes in them."""

from __future__ import annotations

import ast
import difflib
import importlib
import importlib.util
import inspect
import os
import sys
from collections.abc import Callable, Iterator
from dataclasses import dataclass
from pathlib import Path
from types import ModuleType
from typing import TYPE_CHECKING, Annotated, Any

from pydantic import PlainSerializer, PlainValidator, ValidationInfo

if TYPE_CHECKING:
    from torch import nn


# --- own modules ----------------------------------------------------------------------------------

# Import of files and folders with nodes of a user, under the names that the files have.
#
# Such a module is an ordinary module of the process: its folder is searched by ``import``, so that
# it can import helpers beside it. A process that receives one of its nodes imports the same file.


#: file of each module that was imported here, by name, in the order of the imports; None for one
#: imported by its name
_files: dict[str, Path | None] = {}


def import_file(
    path: Path, load: Callable[[str], ModuleType] = importlib.import_module
) -> ModuleType:
    """Import a file such as ``bloom.py``, or a package folder with ``__init__.py``, and return the
    module.

    ``load`` imports the module by its name.
    Raises `ImportError` if there is no such file, if another module has its name or the name of a
    helper beside it, and whatever the code raises.
    """
    file = path / "__init__.py" if path.is_dir() else path
    name = path.name if path.is_dir() else path.stem
    if not file.is_file():
        raise ImportError(
            f"{path} has no __init__.py" if path.is_dir() else f"there is no file {path}"
        )
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
        for added in [
            module
            for module in sys.modules
            if module not in known and f"{module}.".startswith(f"{name}.")
        ]:
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
    """Return the names of the modules with nodes of a user that this process has imported, in
    their order.
    """
    return tuple(name for name in _files if name in sys.modules)


def own_files() -> tuple[str, ...]:
    """Return the files and folders that this process has imported as modules of nodes, and the
    names of others.
    """
    return tuple(str(file or name) for name, file in _files.items())


def import_missing(files: tuple[str, ...], needed: str) -> None:
    """Import the modules of another process that this process lacks.

    The other process may have imported files that no longer exist, or that this process cannot
    import. Only what the module ``needed`` raises is raised: `ImportError` for a missing file, and
    whatever its code raises.
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
    """Return the first part of the name of the module in a file or folder, or of a module that
    is given by its name.
    """
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


# --- network classes ------------------------------------------------------------------------------

# Network classes of a user, which recipes name by family and class, such as ``mynet.SmallUNet``.


#: the module of a class that is unpickled, which a key covers
__depends__ = ["unaffected:importlib.import_module"]
#: key of the pydantic context: a function that returns the module of a family, or raises
#: LookupError
FAMILY = "family"
_FORM = "must be the name of a network class in a family of your own, such as mynet.SmallUNet"


@dataclass(frozen=True)
class Architecture:
    """A network class of a user and its name in a recipe, such as ``mynet.SmallUNet``."""

    name: str
    network: type[Any]  #: a class of `torch.nn.Module`

    def __str__(self) -> str:
        return self.name

    def __reduce__(self) -> tuple[Any, ...]:
        """Pickle a class as module and name, with the files that the process that unpickles the
        class must import.
        """
        return _imported, (
            self.name,
            self.network.__module__,
            self.network.__qualname__,
            own_files(),
        )

    def arguments(self, parameters: dict[str, Any] | None) -> dict[str, Any]:
        """Return the arguments of the class by name, those of ``parameters`` and the defaults of
        the class.

        Raises ValueError for an argument that the class does not take, or that is missing.
        """
        given = dict(parameters or {})
        takes = inspect.signature(self.network).parameters.values()
        any_name = any(one.kind is one.VAR_KEYWORD for one in takes)
        named = {
            one.name: one for one in takes if one.kind not in (one.VAR_KEYWORD, one.VAR_POSITIONAL)
        }
        for name in given:
            if name not in named and not any_name:
                raise ValueError(f"{self} takes no argument {name}; {_nearest(str(name), named)}")
        defaults = {
            name: one.default for name, one in named.items() if one.default is not one.empty
        }
        if missing := [name for name in named if name not in given and name not in defaults]:
            raise ValueError(
                f"{self} needs the argument {missing[0]}: write parameters: {{{missing[0]}: VALUE}}"
            )
        return defaults | given


def _read(given: Any, info: ValidationInfo) -> Architecture:
    """Return the network class that a recipe or a caller names; raise ValueError with the most
    similar name.
    """
    from torch import nn

    if isinstance(given, Architecture):
        return given
    if isinstance(given, type) and issubclass(given, nn.Module):
        return Architecture(f"{given.__module__}.{given.__qualname__}", given)
    family, _, name = given.partition(".") if isinstance(given, str) else ("", "", "")
    if not family.isidentifier() or not name.isidentifier():
        raise ValueError(_FORM)
    module_of: Callable[[str], ModuleType] | None = (info.context or {}).get(FAMILY)
    if module_of is None:
        raise ValueError(f"{_FORM}; here only a recipe can name a class: give the class itself")
    try:
        module = module_of(family)
    except LookupError as error:
        raise ValueError(
            f"{error.args[0]}; list the file of the class, such as `nodes: [{family}.py]`"
        ) from None
    classes = network_classes(module)
    if name in classes:
        return Architecture(given, classes[name])
    if hasattr(module, name):
        kind = (
            "an abstract class"
            if inspect.isabstract(getattr(module, name))
            else "no class of torch.nn.Module"
        )
        raise ValueError(f"{given} is {kind}; {_nearest(name, classes)}")
    raise ValueError(f"{family} has no network class {name}; {_nearest(name, classes)}")


#: a network class, which a recipe names as ``family.Class``
NetworkClass = Annotated[
    Architecture,
    PlainValidator(_read, json_schema_input_type=str),
    PlainSerializer(str, return_type=str),
]


def network_classes(module: ModuleType) -> dict[str, type[nn.Module]]:
    """Return the classes of `torch.nn.Module` that a module or package of a user defines, by
    name.
    """
    from torch import nn

    return {
        name: value
        for name, value in vars(module).items()
        if isinstance(value, type)
        and issubclass(value, nn.Module)
        and not inspect.isabstract(value)
        and f"{value.__module__}.".startswith(f"{module.__name__}.")
    }


def _nearest(name: str, known: Any) -> str:
    """Return a hint with the most similar of the known names, or with all of them."""
    close = difflib.get_close_matches(name, list(known), 1)
    return (
        f"did you mean {close[0]}?"
        if close
        else f"there are {', '.join(known)}"
        if known
        else "there are none"
    )


def _imported(name: str, module: str, qualname: str, files: tuple[str, ...]) -> Architecture:
    import_missing(files, module)
    found: Any = importlib.import_module(module)
    for part in qualname.split("."):
        found = getattr(found, part)
    return Architecture(name, found)
