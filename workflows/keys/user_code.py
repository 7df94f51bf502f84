"""The user's code behind a step: its declared dependencies, its observed dependencies (taints), and
other modules of the user.
"""

from __future__ import annotations

import os
import re
from collections.abc import Callable, Iterable, Mapping, Sequence
from dataclasses import dataclass
from itertools import chain, starmap
from pathlib import Path, PurePath
from typing import TYPE_CHECKING, Any, Literal, NamedTuple

from neusee.nodes.import_times import import_time
from neusee.nodes.own_modules import own_modules
from neusee.workflows.keys.cache_key import digest, file_digest, files_in, is_own, networks_of
from neusee.workflows.keys.module_digest import Look, Whole, edited_since
from neusee.workflows.keys.module_origin import origin_of
from neusee.workflows.keys.source_summary import (
    Reach,
    Summary,
    is_calm,
    outward_names,
    written_only,
)
from neusee.workflows.keys.unfollowed_constructs import Construct, UnfollowedCode

if TYPE_CHECKING:
    from neusee.nodes import Node
    from neusee.workflows.graph.recipe_graph import Step
    from neusee.workflows.keys.code_digest import Code


# --- declared dependencies ------------------------------------------------------------------------

# Dependencies that a node declares with ``depends=``, or a module with ``__depends__``, and the
# constructs that they cover.
#
# An entry is a file or folder beside the module (``table.csv``), ``env:NAME``, the name of a
# module, or ``unaffected:open``: the author states that no result depends on this construct.


FREE = "unaffected:"
VARIABLE = "env:"
_FIX = {
    "file": (
        'give it as a parameter of type Path, or declare it: depends=["{name}"], beside the module'
    ),
    "env": 'make it a parameter, or declare it: depends=["env:{name}"]',
    "import": 'write the import as a statement, or declare each module: depends=["package.module"]',
    "run": 'declare the file or the module that it runs: depends=["kernel.cpp"]',
    "state": "make it a parameter",
    "stamp": "make it a parameter",
    "source": 'declare the file of the code, with its comments and lines: depends=["helper.py"]',
    "hash": "write sorted(...) around the set, or a digest of hashlib",
}
_NAME = {"file": "table.csv", "env": "NAME"}


class Declared(NamedTuple):
    """Declared dependencies: the digest of each by its name, the modules among them, and the files
    that were changed.
    """

    parts: dict[str, dict[str, str]]
    modules: list[str]
    changed: list[str]  #: files that were changed after the import of the module that declares them


def resolve(
    entries: Sequence[str],
    module: str,
    source: Path,
    then: Mapping[str, str | None],
    exists: Callable[[str], bool],
) -> Declared:
    """Return the dependencies that a module declares; ``then`` holds the environment variables at
    the time of its import.

    Raises `LookupError` for an entry that is neither an existing file nor a module.
    """
    declared = Declared({}, [], [])
    for entry in entries:
        # "env:NAME", "unaffected:name", a file, or a module
        if entry.startswith(VARIABLE):
            name = entry.removeprefix(VARIABLE)
            # the values at the import and now; only one if both are equal
            values = dict.fromkeys([then.get(name, os.environ.get(name)), os.environ.get(name)])
            declared.parts[f"environment variable {name}"] = {"value": digest(*values)[:16]}
        elif not entry.startswith(FREE):
            path = source.parent / entry
            if path.exists():
                declared.parts[f"file {entry}"] = {"content": _content(path)}
                if _changed(path, import_time(module)):
                    declared.changed.append(entry)
            elif all(word.isidentifier() for word in entry.split(".")) and exists(entry):
                declared.modules.append(entry)
            else:
                text = (
                    f"{source}: depends={entry!r} is no file in {source.parent} and no module:"
                    " correct the name"
                )
                raise UnfollowedCode(text)
    return declared


def uncovered(met: Iterable[Construct], entries: Sequence[str]) -> Construct | None:
    """Return the first construct that no entry covers, or None."""
    for item in met:
        if not any(_covers(entry, item) for entry in entries):
            return item
    return None


def refusal(item: Construct, source: Path) -> str:
    """Return the message that refuses a construct: its place, its text, the reason and the fix."""
    fix = _FIX[item.kind].format(name=item.name or _NAME.get(item.kind, ""))
    name = item.text if item.text.isidentifier() else item.kind
    free_advice = f'or, if no result depends on it, depends=["{FREE}{name}"]'
    return (
        f"{source}:{item.line}: {item.text}: {item.why}, and a cache key cannot see it: {fix};"
        f" {free_advice}"
    )


def changing_refusal(name: str, kind_of_object: str, source: Path) -> str:
    """Return the message that refuses a name whose object changes while a process runs, or could
    not be read.
    """
    return (
        f"{source}: {name} is or holds a {kind_of_object}, and a cache key cannot see it: "
        "make it inside of the function that uses it; or, if no result depends on it,"
        f' depends=["{FREE}{name}"]'
    )


def _covers(entry: str, item: Construct) -> bool:
    """Return True if a declared entry covers a construct that cannot be followed."""
    if entry.startswith(FREE):
        free_name = entry.removeprefix(FREE)
        names_of_construct = (item.kind, item.name, PurePath(item.name).name, item.text)
        return free_name in names_of_construct or item.text.startswith(
            (f"{free_name}.", f"{free_name}(")
        )
    if entry.startswith(VARIABLE):
        return item.kind == "env" and item.name in ("", entry.removeprefix(VARIABLE))
    if item.kind == "file":
        return (
            # an empty name: the code does not show which file it reads
            not item.name
            or not PurePath(entry).suffix
            or PurePath(entry).name == PurePath(item.name).name
        )
    if item.kind == "source":
        return PurePath(entry).suffix == ".py"
    return item.kind in ("run", "import")


def _content(path: Path) -> str:
    """Return the digest of a file, or of all files of a folder with their names."""
    if not path.is_dir():
        return file_digest(path)
    files = sorted(
        file for file in path.rglob("*") if file.is_file() and "__pycache__" not in file.parts
    )
    return digest([[file.relative_to(path).as_posix(), file_digest(file)] for file in files])


def _changed(path: Path, since: int) -> bool:
    """Return True if a file, or anything in a folder, was changed after a time (ns)."""
    files_inside = path.rglob("*") if path.is_dir() else ()
    return any(os.stat(file).st_ctime_ns > since for file in (path, *files_inside))


# --- tainted code ---------------------------------------------------------------------------------

# Code of the user that was observed to depend on something its key does not cover. Its results are
# valid in this process only.
#
# A module may keep what it has read, in a cache or in a variable, and later calls cannot be
# observed to use it. Therefore a taint stays until the process ends, for all code that uses one of
# the tainted modules.


_taints: dict[str, tuple[Any, ...]] = {}  #: taints by module, see `observation.taints.Taint`
#: modules whose taint the run may not have processed yet
_held_back: set[str] = set()


def hold_back(modules: Iterable[str]) -> None:
    """Let no further result of these modules be stored: one of their steps was just observed to
    depend on something its key does not cover.
    """
    _held_back.update(modules)


def may_be_stored(modules: Iterable[str]) -> bool:
    """Return True if none of these modules is held back, so that their results may be stored."""
    return _held_back.isdisjoint(modules)


def taint_code(modules: Iterable[str], taints: tuple[Any, ...]) -> bool:
    """Mark modules of the user as code whose results no other process may use; return True if at
    least one was not marked before.
    """
    new_modules = [module for module in modules if module not in _taints]
    _taints.update(dict.fromkeys(new_modules, taints))
    return bool(new_modules)


def taints_of(modules: Iterable[str]) -> tuple[Any, ...]:
    """Return the taints of some modules in this process, each once."""
    taints = chain.from_iterable(_taints.get(module, ()) for module in modules)
    return tuple(dict.fromkeys(taints))


def holds_here_alone(module: str) -> bool:
    """Return True if the results of a module are valid in this process only: its file was edited
    after the import, or it is tainted.
    """
    return edited_since(module) or module in _taints


# --- sibling modules ------------------------------------------------------------------------------

# Other modules of the user: which of them may change what a node computes?
#
# All files under ``nodes:`` of a recipe are loaded into one process. A file that patches a library
# changes every result of the process, including those of neusee's own nodes. A file that fills a
# registry or derives a class changes results of other nodes of the user. The digest of such a file
# becomes part of their keys. A file that changes nothing outside of itself affects no other key.


#: the nodes whose results a module may change: none, those of the user, or all
Scope = Literal["nothing", "own", "all"]
_GETTER = re.compile(r"get|current|default|instance|global|regist|shared|root", re.IGNORECASE)
_UNSEEN = ("run", "import")  #: kinds of constructs that run unknown code


class Siblings:
    """The user's modules in this process, and which of them are part of the key of a node."""

    def __init__(self, whole_of: Callable[[str], Whole]) -> None:
        self._whole_of = whole_of
        # for each module, the nodes whose results it may change
        self._scopes: dict[str, Scope] = {}

    def of(self, roots: Sequence[str]) -> list[str]:
        """Return the modules of the user that may change what the code of ``roots`` computes, in
        the order of their import.

        Raises `LookupError` for a module that cannot be followed.
        """
        # all modules of the user in this process
        modules_of_user = own_modules()
        if not modules_of_user:
            return []
        followed_looks = _looks_of(roots, lambda root: self._whole_of(root).looks)
        own_reaches, has_own_root = _own(followed_looks), any(map(is_own, roots))
        others_not_followed = [name for name in modules_of_user if name not in followed_looks]
        return [
            name for name in others_not_followed if self._joins(name, own_reaches, has_own_root)
        ]

    def _joins(self, module: str, mine: Mapping[str, Reach], own: bool) -> bool:
        """Return True if a module may change what a node computes.

        ``mine``: the reach of the node's own user modules; ``own`` is False for a node without
        any.
        """
        scope = self._scope_of(module)
        if scope == "all" or not own:
            return scope == "all"
        # modules used by both, through which one may change the other
        shared_modules = _own(self._whole_of(module).looks).keys() & mine.keys()
        changes_itself = any(mine[name].inward for name in shared_modules)
        # the last condition: code that searches for classes may find those of any module
        return scope == "own" or changes_itself or any(reach.seeks for reach in mine.values())

    def _scope_of(self, module: str) -> Scope:
        """Return the nodes whose results a module may change, determined once."""
        if module not in self._scopes:
            self._scopes[module] = _scope(self._whole_of(module).looks)
        return self._scopes[module]


def _scope(looks: Mapping[str, Look]) -> Scope:
    """Return the nodes whose results the code of a module and of its helpers may change."""
    reaches = _own(looks).values()
    names = outward_names(reaches)
    for reach in reaches:
        # modules imported only for the effect of their import
        names |= {name for name in reach.unused if _kind(name) == "distribution"}
    names_of_users = {name for name in names if _is_of_user(name)}
    if _holds_unseen(looks) or any(_is_shared(name) for name in names - names_of_users):
        return "all"
    return "own" if names_of_users else "nothing"


def _holds_unseen(looks: Mapping[str, Look]) -> bool:
    """Return True if code of the user among some modules runs code that cannot be determined."""
    # only code of users
    summaries = [look.summary for name, look in looks.items() if is_own(name) and look.summary]
    constructs = chain.from_iterable(summary.constructs for summary in summaries)
    return any(construct.kind in _UNSEEN for construct in constructs)


def _own(looks: Mapping[str, Look]) -> dict[str, Reach]:
    """Return the reach of each module of the user, by name."""
    return {
        name: look.summary.reach for name, look in looks.items() if is_own(name) and look.summary
    }


def _is_of_user(name: str) -> bool:
    """Return True if a full name belongs to a module of the user."""
    return name.startswith(".") or (
        _kind(name) in ("source", "folder") and is_own(name.partition(".")[0])
    )


def _is_shared(name: str) -> bool:
    """Return True for an object of a library that other code sees too, unlike the result of a call
    such as an open file.
    """
    function_name, separator, _ = name.rpartition("()")
    return not separator or _GETTER.search(function_name.rpartition(".")[2]) is not None


def _kind(name: str) -> str:
    """Return the kind of origin of the top-level package in a full name; "nowhere" for a relative
    name.
    """
    top_package = name.partition(".")[0]
    return origin_of(top_package, frozenset()).kind if top_package else "nowhere"


# --- user code ------------------------------------------------------------------------------------

# The user's code behind a step: its modules, and the files that its key covers.


_TIMED = frozenset({"datetime", "time", "calendar", "email", "zoneinfo", "sqlite3", "logging"})


@dataclass(frozen=True, slots=True)
class OwnCode:
    """The modules of the user that compute a step, and what their key covers beside their
    source.
    """

    modules: frozenset[str]  #: modules outside of neusee
    followed: frozenset[str]  #: all modules whose source counts
    files: frozenset[str]  #: real paths of parameter files, and of declared files and folders
    free: frozenset[str]  #: what the author states to affect no result: a kind, a name or a path
    #: full names of what the code may change in other modules
    changed: frozenset[str] = frozenset()
    #: full names of logs: lists and dicts that their modules write to and never read
    unread: frozenset[str] = frozenset()
    #: True if the code may change the state that other code uses
    may_change: bool = False
    variables: frozenset[str] = frozenset()  #: environment variables that the code declares


def own_code(step: Step, code: Code) -> OwnCode | None:
    """Return the user's code behind a step, or None for a step whose code is all of neusee."""
    return own_code_of(
        step.node, step.params, [network.__module__ for network in networks_of(step)], code
    )


def own_code_of(
    node: Node, params: Mapping[str, Any], networks: Sequence[str], code: Code
) -> OwnCode | None:
    """Return the user's code behind a call of a node, as `own_code` does; ``networks`` are the
    modules of its network classes.
    """
    root_modules = [node.fn.__module__, *networks]
    if not any(map(is_own, root_modules)):
        return None
    looks = _looks_of(root_modules, code.looks)
    summaries = {name: look.summary for name, look in looks.items() if look.summary is not None}
    own_summaries = {name: summary for name, summary in summaries.items() if is_own(name)}
    files_and_entries = [(looks[name].path, summary.depends) for name, summary in summaries.items()]
    # files that the node declares lie beside its own module
    files_and_entries.append((looks[root_modules[0]].path, [*node.depends]))
    entries = [*chain.from_iterable(depends for _, depends in files_and_entries)]
    parameter_files = map(os.path.realpath, files_in(params))
    declared_files = chain.from_iterable(starmap(_declared_files, files_and_entries))
    changed_names = outward_names([summary.reach for summary in own_summaries.values()])
    return OwnCode(
        modules=frozenset(own_summaries),
        followed=frozenset(looks),
        files=frozenset(chain(parameter_files, declared_files)),
        free=_after(FREE, entries),
        changed=frozenset(changed_names),
        unread=_unread_logs(own_summaries),
        may_change=bool(changed_names) or _may_change_others(own_summaries),
        variables=_after(VARIABLE, entries),
    )


def _looks_of(
    roots: Iterable[str], looks_of: Callable[[str], Mapping[str, Look]]
) -> dict[str, Look]:
    """Return the contribution to the digest of each module that some modules lead to."""
    looks: dict[str, Look] = {}
    for root in roots:
        looks.update(looks_of(root))
    return looks


def _declared_files(source: Path | None, entries: Sequence[str]) -> set[str]:
    """Return the real paths of the existing files that the entries of a source file name."""
    paths_beside = [source.parent / entry for entry in entries] if source else []
    return {os.path.realpath(path) for path in paths_beside if path.exists()}


def _after(prefix: str, entries: Iterable[str]) -> frozenset[str]:
    """Return the names that follow a prefix in the declared entries."""
    return frozenset(entry.removeprefix(prefix) for entry in entries if entry.startswith(prefix))


def _unread_logs(summaries: Mapping[str, Summary]) -> frozenset[str]:
    """Return the full names of objects that their modules write to and never read."""
    logs = set[str]()
    for name, summary in summaries.items():
        logs |= {f"{name}.{log}" for log in written_only(summary.statements)}
    return frozenset(logs)


def _may_change_others(summaries: Mapping[str, Summary]) -> bool:
    """Return True if modules of the user import a module outside of themselves that is not in a
    package of `CALM`.
    """
    imports = set[str]()
    for summary in summaries.values():
        imports |= {module for level, module, _ in summary.imports if not level}
    return any(not is_calm(name) for name in imports - summaries.keys())


def reads_time(looks: Mapping[str, Look]) -> bool:
    """Return True if code of the user may read the time zone, through the standard library or
    through a package.
    """
    own_looks = [look for name, look in looks.items() if is_own(name)]
    imports = chain.from_iterable(look.imports for look in own_looks)
    if not _TIMED.isdisjoint(name.partition(".")[0] for name in imports):
        return True
    # packages that count by their content: whether they read the clock is unknown
    contents = chain.from_iterable(look.parts.values() for look in own_looks)
    return any("content" in content for content in contents)
