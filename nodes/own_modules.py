"""Import of the files and folders of a user, and the network classes in them."""

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
    """Forget a module and the modules inside it, but for those that were imported before."""
    for module in list(sys.modules):
        if module not in before and f"{module}.".startswith(f"{name}."):
            del sys.modules[module]


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
    """Return the first part of the name of the module in a file or folder, or of a module that
    is given by its name.
    """
    return Path(file).stem if os.path.isabs(file) else file.partition(".")[0]


def _refuse_taken(name: str, file: Path) -> None:
    """Raise `ImportError` if ``import name`` does not mean ``file``."""
    loaded_module = sys.modules.get(name)
    file_of_name = (
        getattr(loaded_module, "__file__", None)
        if loaded_module is not None
        else _file_of_import(name)
    )
    # a module of Python itself has no file
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

# Network classes of a user, which recipes name by family and class, such as ``mynet.SmallUNet``.


#: the module of a class that is unpickled, which a key covers
__depends__ = ["unaffected:importlib.import_module"]
#: key of the pydantic context: a function that returns the module of a family, or raises
#: LookupError
FAMILY = "family"
_NAME_FORM = "must be the name of a network class in a family of your own, such as mynet.SmallUNet"


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
    """Return the network class that a recipe or a caller names; raise ValueError with the most
    similar name.
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
    """Return the module of a family; raise ValueError where no recipe says which module it is."""
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
    """Return the classes of `torch.nn.Module` that a module or package of a user defines, by
    name.
    """
    values = vars(module).items()
    return {name: value for name, value in values if _is_network_of(module, value)}


def _is_network_of(module: ModuleType, value: object) -> bool:
    """Return True for a concrete class of networks that a module, or one inside it, defines."""
    from torch import nn

    if not isinstance(value, type) or not issubclass(value, nn.Module):
        return False
    defined_here = f"{value.__module__}.".startswith(f"{module.__name__}.")
    return defined_here and not inspect.isabstract(value)


def _hint(name: str, candidates: Any) -> str:
    """Return a hint with the most similar of the known names, or with all of them."""
    close = difflib.get_close_matches(name, list(candidates), 1)
    if close:
        return f"did you mean {close[0]}?"
    return f"there are {', '.join(candidates)}" if candidates else "there are none"


def _imported(name: str, module: str, qualname: str, files: tuple[str, ...]) -> Architecture:
    """Return the network class of a module that is imported here, by its qualified name."""
    import_missing(files, module)
    attribute_value: Any = importlib.import_module(module)
    for attribute in qualname.split("."):
        attribute_value = getattr(attribute_value, attribute)
    return Architecture(name, attribute_value)
