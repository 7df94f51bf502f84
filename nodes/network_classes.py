"""Network classes of a user, which recipes name by family and class, such as ``mynet.SmallUNet``."""

from __future__ import annotations

import difflib
import importlib
import inspect
from collections.abc import Callable
from dataclasses import dataclass
from types import ModuleType
from typing import TYPE_CHECKING, Annotated, Any

from pydantic import PlainSerializer, PlainValidator, ValidationInfo

from neusee.nodes.own_modules import import_missing, own_files

if TYPE_CHECKING:
    from torch import nn

__depends__ = ["unaffected:importlib.import_module"]  #: the module of a class that is unpickled, which a key covers
FAMILY = "family"  #: key of the pydantic context: a function that returns the module of a family, or raises LookupError
_FORM = "must be the name of a network class in a family of your own, such as mynet.SmallUNet"


@dataclass(frozen=True)
class Architecture:
    """A network class of a user and its name in a recipe, such as ``mynet.SmallUNet``."""

    name: str
    network: type[Any]  #: a class of `torch.nn.Module`

    def __str__(self) -> str:
        return self.name

    def __reduce__(self) -> tuple[Any, ...]:
        """Pickle a class as module and name, with the files that the process that unpickles the class must import."""
        return _imported, (self.name, self.network.__module__, self.network.__qualname__, own_files())

    def arguments(self, parameters: dict[str, Any] | None) -> dict[str, Any]:
        """Return the arguments of the class by name, those of ``parameters`` and the defaults of the class.

        Raises ValueError for an argument that the class does not take, or that is missing.
        """
        given = dict(parameters or {})
        takes = inspect.signature(self.network).parameters.values()
        any_name = any(one.kind is one.VAR_KEYWORD for one in takes)
        named = {one.name: one for one in takes if one.kind not in (one.VAR_KEYWORD, one.VAR_POSITIONAL)}
        for name in given:
            if name not in named and not any_name:
                raise ValueError(f"{self} takes no argument {name}; {_nearest(str(name), named)}")
        defaults = {name: one.default for name, one in named.items() if one.default is not one.empty}
        if missing := [name for name in named if name not in given and name not in defaults]:
            raise ValueError(f"{self} needs the argument {missing[0]}: write parameters: {{{missing[0]}: VALUE}}")
        return defaults | given


def _read(given: Any, info: ValidationInfo) -> Architecture:
    """Return the network class that a recipe or a caller names; raise ValueError with the most similar name."""
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
        raise ValueError(f"{error.args[0]}; list the file of the class, such as `nodes: [{family}.py]`") from None
    classes = network_classes(module)
    if name in classes:
        return Architecture(given, classes[name])
    if hasattr(module, name):
        kind = "an abstract class" if inspect.isabstract(getattr(module, name)) else "no class of torch.nn.Module"
        raise ValueError(f"{given} is {kind}; {_nearest(name, classes)}")
    raise ValueError(f"{family} has no network class {name}; {_nearest(name, classes)}")


#: a network class, which a recipe names as ``family.Class``
NetworkClass = Annotated[
    Architecture, PlainValidator(_read, json_schema_input_type=str), PlainSerializer(str, return_type=str)
]


def network_classes(module: ModuleType) -> dict[str, type[nn.Module]]:
    """Return the classes of `torch.nn.Module` that a module or package of a user defines, by name."""
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
    return f"did you mean {close[0]}?" if close else f"there are {', '.join(known)}" if known else "there are none"


def _imported(name: str, module: str, qualname: str, files: tuple[str, ...]) -> Architecture:
    import_missing(files, module)
    found: Any = importlib.import_module(module)
    for part in qualname.split("."):
        found = getattr(found, part)
    return Architecture(name, found)
