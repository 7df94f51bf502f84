"""The code of a step that is not of neusee: its modules, and the files that its key covers."""

from __future__ import annotations

import os
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import TYPE_CHECKING, Any

from neusee.workflows.keys.cache_key import networks_of
from neusee.workflows.keys.declared_dependencies import FREE, VARIABLE
from neusee.workflows.keys.input_file_digest import files_in
from neusee.workflows.keys.module_owner import is_own
from neusee.workflows.keys.outward_code import is_calm, outward_names
from neusee.workflows.keys.reachable_code import written_only

if TYPE_CHECKING:
    from neusee.nodes import Node
    from neusee.workflows.graph.recipe_graph import Step
    from neusee.workflows.keys.code_digest import Code
    from neusee.workflows.keys.module_look import Look

_TIMED = frozenset({"datetime", "time", "calendar", "email", "zoneinfo", "sqlite3", "logging"})


@dataclass(frozen=True, slots=True)
class OwnCode:
    """The modules of a user that compute a step, and what their key covers beside their source."""

    modules: frozenset[str]  #: those outside of neusee
    followed: frozenset[str]  #: all modules whose source counts
    files: frozenset[str]  #: real paths of parameter files, and of declared files and folders
    free: frozenset[str]  #: what the author states to decide no result: a kind, a name or a path
    changed: frozenset[str] = frozenset()  #: full names of what the code may change in modules of others
    unread: frozenset[str] = frozenset()  #: full names of logs: lists and dicts that their modules only write to
    may_change: bool = False  #: True if the code may change what other code finds: its imports do more than compute
    variables: frozenset[str] = frozenset()  #: variables of the environment that the code declares


def own_code(step: Step, code: Code) -> OwnCode | None:
    """Return the code of a step that is not of neusee, or None for a step of the package alone."""
    return own_code_of(step.node, step.params, [each.__module__ for each in networks_of(step)], code)


def own_code_of(node: Node, params: Mapping[str, Any], networks: Sequence[str], code: Code) -> OwnCode | None:
    """Return the code of a call of a node, as `own_code` does; ``networks`` are the modules of its network classes."""
    roots = [node.fn.__module__, *networks]
    if not any(map(is_own, roots)):
        return None
    looks = {name: look for root in roots for name, look in code.looks(root).items()}
    followed = {name: look for name, look in looks.items() if look.summary is not None}
    modules = frozenset(filter(is_own, followed))
    files = {os.path.realpath(file) for file in files_in(params)}
    free, variables = set[str](), set[str]()
    declared = [(look.path, look.summary.depends) for look in followed.values() if look.summary]
    declared.append((looks[roots[0]].path, [*node.depends]))
    for source, entries in declared:
        free.update(entry.removeprefix(FREE) for entry in entries if entry.startswith(FREE))
        variables.update(entry.removeprefix(VARIABLE) for entry in entries if entry.startswith(VARIABLE))
        beside = [source.parent / entry for entry in entries] if source else []
        files.update(os.path.realpath(path) for path in beside if path.exists())
    summaries = {name: followed[name].summary for name in modules}
    changed = outward_names([each.reach for each in summaries.values() if each])
    unread = {f"{name}.{log}" for name, each in summaries.items() if each for log in written_only(each.statements)}
    imports = {module for each in summaries.values() if each for level, module, _ in each.imports if not level}
    may_change = bool(changed) or any(not is_calm(name) for name in imports - modules)
    return OwnCode(
        modules=modules,
        followed=frozenset(looks),
        files=frozenset(files),
        free=frozenset(free),
        changed=frozenset(changed),
        unread=frozenset(unread),
        may_change=may_change,
        variables=frozenset(variables),
    )


def reads_time(looks: Mapping[str, Look]) -> bool:
    """Return True if code of a user may read the time zone: by the standard library, or by a package of its own."""
    own = [look for name, look in looks.items() if is_own(name)]
    names = {imported.partition(".")[0] for look in own for imported in look.imports}
    return not _TIMED.isdisjoint(names) or any("content" in part for look in own for part in look.parts.values())
