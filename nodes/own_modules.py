"""Import of a user's files and folders, and the network classes in them."""

from __future__ import annotations

import ast
import difflib
import importlib
import importlib.util
import inspect
import os
import sys
from collections.abc import Callable, Collection, Iterator
from dataclasses import dataclass
from pathlib import Path
from types import ModuleType
from typing import TYPE_CHECKING, Annotated, Any

from pydantic import PlainSerializer, PlainValidator, ValidationInfo

if TYPE_CHECKING:
    from torch import nn


# --- own modules ----------------------------------------------------------------------------------

# Import of files and folders with user-defined nodes, as modules with the names of the files.
#
# Such a module is an ordinary module of the process. Its folder is added to ``sys.path``, so that
# it can import helper modules beside it. A process that receives one of its nodes imports the same
# file.


#: file of each module with user-defined nodes, by module name, in the order of import; None for a
#: module that was imported by its name
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
    modules_before = set(sys.modules)
    try:
        module = load(name)
    except BaseException:
        _forget_modules(name, modules_before)
        raise
    for helper, helper_file in _helpers(file, path.parent):
        _refuse_taken(helper, helper_file)
    _files[name] = path.absolute()
    return module


def _forget_modules(name: str, before: Collection[str]) -> None:
    """Remove a module and its submodules from ``sys.modules``, except those that were imported
    before.
    """
    for module in list(sys.modules):
        if module not in before and f"{module}.".startswith(f"{name}."):
            del sys.modules[module]


def note_module(name: str) -> None:
    """Record a module with user-defined nodes that was imported by its name."""
    _files.setdefault(name, None)


def own_modules() -> tuple[str, ...]:
    """Return the names of the modules with user-defined nodes that this process has imported, in
    the order of import.
    """
    return tuple(name for name in _files if name in sys.modules)


def own_files() -> tuple[str, ...]:
    """Return the files and folders of the imported modules with user-defined nodes; for a module
    imported by its name, the name.
    """
    return tuple(str(file or name) for name, file in _files.items())


def import_missing(files: tuple[str, ...], needed: str) -> None:
    """Import the modules with user-defined nodes that another process has imported and this one has
    not.

    The other process may have imported files that no longer exist, or that this process cannot
    import. Only errors of the module ``needed`` are raised: `ImportError` for a missing file, and
    any exception of its code.
    """
    for file in files:
        try:
            _import_if_missing(file)
        except Exception:
            if needed.partition(".")[0] == _top_name(file):
                raise


def _import_if_missing(file: str) -> None:
    """Import a file, or a module given by its name, unless this process has imported it."""
    if not os.path.isabs(file):
        importlib.import_module(file)
        note_module(file)
    elif _files.get(_top_name(file)) != Path(file):
        import_file(Path(file))


def _top_name(file: str) -> str:
    """Return the first part of the name of a module, given as a file or folder or by its name."""
    return Path(file).stem if os.path.isabs(file) else file.partition(".")[0]


def _refuse_taken(name: str, file: Path) -> None:
    """Raise `ImportError` if ``import name`` would not load ``file``."""
    loaded_module = sys.modules.get(name)
    file_of_name = (
        getattr(loaded_module, "__file__", None)
        if loaded_module is not None
        else _file_of_import(name)
    )
    # a built-in module of Python has no file
    if loaded_module is not None and file_of_name is None:
        raise ImportError(f"the name {name} is that of a module of Python: rename {file}")
    if file_of_name is not None and Path(file_of_name).resolve() != file.resolve():
        raise ImportError(f"the name {name} is that of {file_of_name}: rename {file}")


def _file_of_import(name: str) -> str | None:
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
    for top_name in _imported_tops(file):
        for candidate in (folder / f"{top_name}.py", folder / top_name / "__init__.py"):
            if candidate.is_file():
                yield top_name, candidate
                break


def _imported_tops(file: Path) -> Iterator[str]:
    """Yield the first part of the name of each module that a file imports."""
    for syntax_node in ast.walk(ast.parse(file.read_bytes())):
        names = (
            [alias.name for alias in syntax_node.names]
            if isinstance(syntax_node, ast.Import)
            else []
        )
        if isinstance(syntax_node, ast.ImportFrom) and syntax_node.module and not syntax_node.level:
            names = [syntax_node.module]
        yield from {name.partition(".")[0] for name in names}


# --- network classes ------------------------------------------------------------------------------

# User-defined network classes, which recipes name by family (module) and class, such as
# ``mynet.SmallUNet``.


#: the module of an unpickled class, which is part of a cache key
__depends__ = ["unaffected:importlib.import_module"]
#: key of the pydantic context; its value is a function that returns the module of a family, or
#: raises LookupError
FAMILY = "family"
_NAME_FORM = "must be the name of a network class in a family of your own, such as mynet.SmallUNet"


@dataclass(frozen=True)
class Architecture:
    """A user-defined network class with its name in a recipe, such as ``mynet.SmallUNet``."""

    name: str
    network: type[Any]  #: a class of `torch.nn.Module`

    def __str__(self) -> str:
        return self.name

    def __reduce__(self) -> tuple[Any, ...]:
        """Pickle a class by module and name, with the files to import when it is unpickled."""
        return _imported, (
            self.name,
            self.network.__module__,
            self.network.__qualname__,
            own_files(),
        )

    def arguments(self, parameters: dict[str, Any] | None) -> dict[str, Any]:
        """Return the arguments of the class by name: ``parameters``, completed by the defaults of
        the class.

        Raises ValueError for an argument that the class does not take, or that is missing.
        """
        arguments_given = dict(parameters or {})
        class_parameters = inspect.signature(self.network).parameters.values()
        named_parameters = {
            argument.name: argument
            for argument in class_parameters
            if argument.kind not in (argument.VAR_KEYWORD, argument.VAR_POSITIONAL)
        }
        if not any(argument.kind is argument.VAR_KEYWORD for argument in class_parameters):
            self._refuse_unknown(arguments_given, named_parameters)
        defaults = {name: argument.default for name, argument in named_parameters.items()}
        for name, default in defaults.items():
            if name not in arguments_given and default is inspect.Parameter.empty:
                raise ValueError(
                    f"{self} needs the argument {name}: write parameters: {{{name}: VALUE}}"
                )
        return defaults | arguments_given

    def _refuse_unknown(self, written: Collection[str], named: Collection[str]) -> None:
        """Raise ValueError for an argument that the class does not take."""
        for name in written:
            if name not in named:
                raise ValueError(f"{self} takes no argument {name}; {_hint(str(name), named)}")


def _network_class_of(value: Any, info: ValidationInfo) -> Architecture:
    """Return the network class for a value in a recipe or in a call; a ValueError names the most
    similar class.
    """
    from torch import nn

    if isinstance(value, Architecture):
        return value
    if isinstance(value, type) and issubclass(value, nn.Module):
        return Architecture(f"{value.__module__}.{value.__qualname__}", value)
    family, _, name = value.partition(".") if isinstance(value, str) else ("", "", "")
    if not family.isidentifier() or not name.isidentifier():
        raise ValueError(_NAME_FORM)
    module = _module_of_family(family, info)
    classes = network_classes(module)
    if name in classes:
        return Architecture(value, classes[name])
    if hasattr(module, name):
        kind = (
            "an abstract class"
            if inspect.isabstract(getattr(module, name))
            else "no class of torch.nn.Module"
        )
        raise ValueError(f"{value} is {kind}; {_hint(name, classes)}")
    raise ValueError(f"{family} has no network class {name}; {_hint(name, classes)}")


def _module_of_family(family: str, info: ValidationInfo) -> ModuleType:
    """Return the module of a family; raise ValueError if no recipe assigns a module to it."""
    module_of: Callable[[str], ModuleType] | None = (info.context or {}).get(FAMILY)
    if module_of is None:
        raise ValueError(
            f"{_NAME_FORM}; here only a recipe can name a class: give the class itself"
        )
    try:
        return module_of(family)
    except LookupError as error:
        raise ValueError(
            f"{error.args[0]}; list the file of the class, such as `nodes: [{family}.py]`"
        ) from None


#: a network class, which a recipe names as ``family.Class``
NetworkClass = Annotated[
    Architecture,
    PlainValidator(_network_class_of, json_schema_input_type=str),
    PlainSerializer(str, return_type=str),
]


def network_classes(module: ModuleType) -> dict[str, type[nn.Module]]:
    """Return the subclasses of `torch.nn.Module` that a user's module or package defines, by
    name.
    """
    values = vars(module).items()
    return {name: value for name, value in values if _is_network_of(module, value)}


def _is_network_of(module: ModuleType, value: object) -> bool:
    """Return True for a concrete subclass of `torch.nn.Module` defined in a module or one of its
    submodules.
    """
    from torch import nn

    if not isinstance(value, type) or not issubclass(value, nn.Module):
        return False
    defined_here = f"{value.__module__}.".startswith(f"{module.__name__}.")
    return defined_here and not inspect.isabstract(value)


def _hint(name: str, candidates: Any) -> str:
    """Return a hint for error messages with the most similar known name, or with all known
    names.
    """
    close = difflib.get_close_matches(name, list(candidates), 1)
    if close:
        return f"did you mean {close[0]}?"
    return f"there are {', '.join(candidates)}" if candidates else "there are none"


def _imported(name: str, module: str, qualname: str, files: tuple[str, ...]) -> Architecture:
    """Import a module and return one of its network classes, by its qualified name."""
    import_missing(files, module)
    attribute_value: Any = importlib.import_module(module)
    for attribute in qualname.split("."):
        attribute_value = getattr(attribute_value, attribute)
    return Architecture(name, attribute_value)
