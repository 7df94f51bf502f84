"""Families of nodes, such as optics: of neusee, of packages, and of files a recipe names."""

from __future__ import annotations

import functools
import importlib
import importlib.util
import inspect
import os
import pkgutil
import re
import sys
import traceback
from collections.abc import Collection, Iterable, Iterator, Mapping
from dataclasses import dataclass, field
from importlib.metadata import EntryPoint, entry_points
from pathlib import Path
from types import ModuleType
from typing import Any

import neusee.nodes
from neusee.nodes import Node
from neusee.nodes.own_modules import FAMILY, import_file, network_classes, note_module
from neusee.workflows.graph.errors import Diagnostic, nearest
from neusee.workflows.recipe import lazy_imports as lazy
from neusee.workflows.recipe.text.other_spellings import instead
from neusee.workflows.recipe.text.recipe_files import NO_CODE_VARIABLE, is_strange
from neusee.workflows.recipe.text.yaml_values import Value, kind

# --- node families --------------------------------------------------------------------------------

# Families of nodes, such as ``optics``: those of neusee, of installed packages, and of files that a
# recipe names.
#
# A package installs a family by an entry point of the group ``neusee.nodes``. A family of a package
# is imported when a recipe uses it or when all are listed, so that a broken package breaks no other
# recipe.


GROUP = "neusee.nodes"  #: group of the entry points by which packages install families of nodes

NO_FAMILY = "no family of your own has the name"  #: first words of a mistake
Own = Mapping[str, ModuleType]  #: modules of the families that a recipe names, by family
_NO_OWN: Own = {}
#: family of each module of a user, because a node has one name in a process
_family_of: dict[str, str] = {}


def find_node(name: str, own: Own = _NO_OWN) -> Node:
    """Return the node with a name such as ``sensor.digitize``; raise `LookupError` with the most
    similar name.
    """
    family, _, attribute = name.partition(".")
    nodes = nodes_of(family, own) if _exists(family, own) else {}
    if attribute not in nodes:
        all_names = (other_name for other_name, _ in all_nodes(own))
        raise LookupError(why_no_node(name, nodes, own, all_names))
    return nodes[attribute] if _is_ours(family) else _with_parameters(nodes[attribute])


def why_no_node(name: str, of_family: Collection[str], own: Own, all_names: Iterable[str]) -> str:
    """Return the message for a name that no node has, with the most similar name.

    ``of_family`` has the names of the nodes in the family that the name states, and ``all_names``
    the names with their families.
    """
    family, _, attribute = name.partition(".")
    if renaming := instead(name):
        return f"{name} {renaming}"
    if not of_family:
        hint = _elsewhere(attribute, all_names) or nearest(family, families(own))
        return f"no family of nodes {family}; {hint}"
    hint = nearest(attribute, of_family).replace("did you mean ", f"did you mean {family}.")
    return f"no node {name}; {_elsewhere(attribute, all_names) or hint}"


def families(own: Own = _NO_OWN) -> list[str]:
    """Return the names of the families of nodes, such as ``optics``, without importing a family."""
    packages = {info.name for info in pkgutil.iter_modules(neusee.nodes.__path__) if info.ispkg}
    matches = (
        re.fullmatch(rf"{neusee.nodes.__name__}\.([a-z]\w*)", module)
        for module in list(sys.modules)
    )
    return sorted(
        {
            *packages,
            *(match[1] for match in matches if match and _ours(match[1])),
            *_installed(),
            *own,
        }
    )


def nodes_of(family: str, own: Own = _NO_OWN) -> dict[str, Node]:
    """Return the nodes of a family such as ``optics`` by name; raise `LookupError` for an installed
    family that cannot be used.
    """
    if family in own:
        return own_nodes(family, own[family])
    return _ours(family) if _is_ours(family) else own_nodes(family, _load(family))


def all_nodes(own: Own = _NO_OWN) -> Iterator[tuple[str, Node]]:
    """Yield the name, such as ``sensor.digitize``, and the node of each node in all families that
    can be used.
    """
    for family in families(own):
        try:
            nodes = nodes_of(family, own)
        except LookupError:
            continue
        for name, node in nodes.items():
            yield f"{family}.{name}", node


def broken_families() -> dict[str, str]:
    """Return why each installed family cannot be used, by family."""
    broken = dict[str, str]()
    for family in _installed():
        try:
            nodes_of(family)
        except LookupError as error:
            broken[family] = str(error.args[0])
    return broken


def are_installed() -> bool:
    """Return True if installed packages have families of nodes."""
    return bool(_installed())


def is_known(family: str) -> bool:
    """Return True if neusee or an installed package has a family of this name."""
    return _is_ours(family) or family in _installed()


def module_of(family: str, own: Own = _NO_OWN) -> ModuleType:
    """Return the module of a family of the user or of an installed package; raise `LookupError`
    for any other name.
    """
    if family in own:
        return own[family]
    if family in _installed():
        return _load(family)
    raise LookupError(f"{NO_FAMILY} {family}; {nearest(family, [*own, *_installed()])}")


def class_context(own: Own) -> dict[str, Any]:
    """Return the context in which the models of parameters find the network classes of a user."""
    return {FAMILY: functools.partial(module_of, own=own)}


def installed_as(module: str) -> str | None:
    """Return the family that an installed package makes of a module, or None if no package does."""
    return next(
        (family for family, points in _installed().items() if points[0].value == module), None
    )


def family_title(family: str, own: Own = _NO_OWN) -> str:
    """Return the first line of the docstring of a family's module; raise `LookupError` as
    `nodes_of` does.
    """
    if family in own:
        module = own[family]
    elif _is_ours(family):
        module = importlib.import_module(f"{neusee.nodes.__name__}.{family}")
    else:
        module = _load(family)
    return (module.__doc__ or "").strip().partition("\n")[0]


def own_nodes(family: str, module: ModuleType) -> dict[str, Node]:
    """Return the nodes that a module or package of a user defines, each named after the family.

    Raises `LookupError` if the module defines neither a node nor a network, or belongs to a family
    of another name.
    """
    name = module.__name__
    nodes = {
        key: value
        for key, value in vars(module).items()
        if isinstance(value, Node) and f"{value.fn.__module__}.".startswith(f"{name}.")
    }
    if not nodes and not network_classes(module):
        raise LookupError(
            f"{name} defines no node: decorate a function with @node() of neusee.nodes, or write"
            " a network class"
        )
    if _family_of.setdefault(name, family) != family:
        raise LookupError(
            f"{name} already has the name {_family_of[name]} in this process: use that name, or"
            " start a new process"
        )
    for key, node in nodes.items():
        node.path = f"{family}.{key}"
    return nodes


_FOLDERS = (".", "..")


def _names_path(where: str) -> bool:
    """Return True for the path of a file or a folder, and not for the name of a module."""
    has_separator = "/" in where or "\\" in where
    return where.endswith(".py") or has_separator or where in _FOLDERS


def import_own(where: str, folder: Path) -> ModuleType:
    """Import a module that a recipe names: a file or folder relative to ``folder``, or the name of
    a module.

    Raises `LookupError` with place and cause.
    """
    is_path = _names_path(where)
    path = Path(folder, where).expanduser()
    try:
        if is_path:
            full_path = path.resolve() if where in _FOLDERS else path.absolute()
            return import_file(full_path, lazy.observed_call.import_observed)
        module = lazy.observed_call.import_observed(where)
        note_module(where)
        return module
    except ModuleNotFoundError as error:
        if not is_path and error.name and f"{where}.".startswith(f"{error.name}."):
            hint = f"; write ./{where} for the folder" if path.is_dir() else ""
            raise LookupError(f"there is no installed module {where}{hint}") from None
        raise LookupError(_failure(where, error)) from None
    except (Exception, SystemExit) as error:
        raise LookupError(_failure(where, error)) from None


def _with_parameters(node: Node) -> Node:
    """Return a node of a user; raise `LookupError` with its place if its parameters cannot be
    validated.
    """
    code = inspect.unwrap(node.fn).__code__
    source_line, name = f"{Path(code.co_filename).name}:{code.co_firstlineno}", node.fn.__name__
    try:
        if without_annotation := unannotated(node):
            raise LookupError(
                f"{source_line}: {name} gives no type for {without_annotation[0]}: write a type"
                f" such as `{without_annotation[0]}: float`, or a unit of neusee.nodes.units"
            )
        # made at the first use, which reads the annotations
        assert node.params
    except LookupError:
        raise
    except Exception as error:
        text = f"{type(error).__name__}: {' '.join(str(error).split())[:200]}"
        raise LookupError(
            f"{source_line}: the annotations of {name} cannot be read: {text}"
        ) from None
    return node


def unannotated(node: Node) -> list[str]:
    """Return the names of the parameters of a node that have no annotation."""
    parameters = inspect.signature(node.fn).parameters.values()
    names = [p.name for p in parameters if p.kind is p.KEYWORD_ONLY]
    return [name for name in names if name != "rng" and name not in node.hints]


def _failure(where: str, error: BaseException) -> str:
    """Return why the import of a module failed, with the last line of the user's code that ran."""
    user_frames = _own_frames(error)
    source_line = (
        f"{Path(user_frames[-1].filename).name}:{user_frames[-1].lineno}: " if user_frames else ""
    )
    if isinstance(error, SyntaxError) and error.filename:
        source_line = f"{Path(error.filename).name}:{error.lineno}: "
    # an ImportError that neusee raises says everything in its text
    kind = "" if type(error) is ImportError and not user_frames else f"{type(error).__name__}: "
    text = error.msg if isinstance(error, SyntaxError) else str(error)
    return f"{where} cannot be imported: {source_line}{kind}{text}".rstrip()


def _own_frames(error: BaseException) -> list[traceback.FrameSummary]:
    """Return the stack frames of an error that are neither in importlib nor in neusee."""
    package_folder = str(Path(neusee.nodes.__file__).parents[1])
    return [
        frame
        for frame in traceback.extract_tb(error.__traceback__)
        if "importlib" not in frame.filename and not frame.filename.startswith(package_folder)
    ]


def _exists(family: str, own: Own) -> bool:
    return family in own or is_known(family)


def _is_ours(family: str) -> bool:
    """Return True if neusee has a family of this name."""
    module = f"{neusee.nodes.__name__}.{family}"
    return family.isidentifier() and (
        module in sys.modules or importlib.util.find_spec(module) is not None
    )


def _ours(family: str) -> dict[str, Node]:
    """Return the nodes of a family of neusee by name."""
    module = importlib.import_module(f"{neusee.nodes.__name__}.{family}")
    return {name: value for name, value in vars(module).items() if isinstance(value, Node)}


@functools.cache
def _installed() -> dict[str, tuple[EntryPoint, ...]]:
    """Return the entry points of each family of an installed package; a family with the name of a
    family of neusee is ignored.
    """
    points = dict[str, tuple[EntryPoint, ...]]()
    for point in entry_points(group=GROUP):
        if not _is_ours(point.name):
            points[point.name] = (*points.get(point.name, ()), point)
    return points


def _load(family: str) -> ModuleType:
    """Import an installed family; raise `LookupError` with the distribution and the cause if
    that fails.
    """
    points = _installed()[family]
    if len(points) > 1:
        names = " and ".join(
            sorted({point.dist.name if point.dist else point.value for point in points})
        )
        raise LookupError(
            f"{names} both install a family of nodes {family}: uninstall one of the packages"
        )
    module, distribution = (
        points[0].value,
        points[0].dist.name if points[0].dist else points[0].value,
    )
    try:
        loaded = importlib.import_module(module)
        note_module(module)
        return loaded
    except (Exception, SystemExit) as error:
        raise LookupError(
            f"{family} of the installed package {distribution} fails: {_failure(module, error)}"
        ) from None


def _elsewhere(attribute: str, all_names: Iterable[str]) -> str:
    """Return a hint with the nodes of other families that have the name of an unknown node."""
    names = [name for name in all_names if name.partition(".")[2] == attribute]
    return f"did you mean {' or '.join(names)}?" if names else ""


# --- own families ---------------------------------------------------------------------------------

# The list ``nodes`` of a recipe: the files, folders and packages with the user's own families of
# nodes.


KEY = "nodes"
_FORM = "must be a file, a folder or a module, such as bloom.py, or `family: module`"


@dataclass
class OwnFamilies:
    """The families of nodes that a recipe names."""

    modules: dict[str, ModuleType] = field(default_factory=dict)  #: by family
    places: list[Any] = field(default_factory=list)  #: the entries, with the full path of each file
    notes: list[str] = field(default_factory=list)
    is_whole: bool = True  #: whether every family could be read


def read_own_families(root: Value, diagnostics: list[Diagnostic]) -> OwnFamilies:
    """Import what the list ``nodes`` of a recipe names, and return the families; report each
    mistake at its entry.

    Importing runs the code. The variable ``NEUSEE_NO_CODE`` refuses that.
    """
    own_families = OwnFamilies()
    entries = root.items.get(KEY)
    if entries is None or entries.data is None:
        return own_families
    if not isinstance(entries.data, list):
        diagnostics.append(
            Diagnostic(
                entries.mark, KEY, f"must be a list of files and modules, not {kind(entries)}"
            )
        )
        own_families.is_whole = False
        return own_families
    earlier_mistakes = len(diagnostics)
    for entry in entries.data:
        family_and_place = _pair(entry)
        if family_and_place is None:
            diagnostics.append(Diagnostic(entry.mark, entry.name, _FORM))
            continue
        if is_strange():
            message = f"names code, which {NO_CODE_VARIABLE} or --no-code refuses to run"
            diagnostics.append(
                Diagnostic(entry.mark, f"{entry.name} = {family_and_place[1].data}", message)
            )
            continue
        try:
            _add(own_families, *family_and_place)
        except LookupError as error:
            diagnostics.append(
                Diagnostic(
                    entry.mark, f"{entry.name} = {family_and_place[1].data}", str(error.args[0])
                )
            )
    own_families.is_whole = len(diagnostics) == earlier_mistakes
    if own_families.modules:
        names = ", ".join(
            str(getattr(module, "__file__", module)) for module in own_families.modules.values()
        )
        own_families.notes.append(f"reading this recipe ran code: {names}")
    return own_families


def _pair(entry: Value) -> tuple[str, Value] | None:
    """Return the family (empty if not written) and the place of an entry, or None for an entry of
    another form.
    """
    if isinstance(entry.data, str):
        return "", entry
    items = list(entry.items.items()) if isinstance(entry.data, dict) else []
    if len(items) == 1 and isinstance(items[0][1].data, str) and str(items[0][0]).isidentifier():
        return str(items[0][0]), items[0][1]
    return None


def _add(own: OwnFamilies, family: str, where: Value) -> None:
    """Import one entry; raise `LookupError` if that fails or if its family has the name of
    another one.
    """
    folder = Path(where.mark.folder)
    module = import_own(str(where.data), folder)
    family_name = family or module.__name__.rpartition(".")[2]
    if own.modules.get(family_name) is module:
        return
    if family_name in own.modules or is_known(family_name):
        other_file = getattr(
            own.modules.get(family_name), "__file__", "neusee or an installed package"
        )
        text = f"there is already a family of nodes {family_name}, from {other_file}"
        raise LookupError(
            f"{text}: choose another name, as in `nodes: [my_{family_name}: {where.data}]`"
        )
    # raises for a module without a node
    own_nodes(family_name, module)
    own.modules[family_name] = module
    full_path = folder / str(where.data)
    recorded_place = os.path.abspath(full_path) if full_path.exists() else str(where.data)
    own.places.append({family: recorded_place} if family else recorded_place)
