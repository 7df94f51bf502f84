"""Digests of the code of nodes: what a node's module and all that it imports were loaded from, and what they hold.

A digest covers by source each module of `neusee.nodes`, of the user, of an editable install and of a package with
nodes; other packages by their version; the values of each loaded module; and what `depends=` declares. Comments,
layout and docstrings that nobody reads do not count. What cannot be followed is refused. Loaded code that is not that
of its file gives a private digest, whose results are not stored.

A file stores the summaries of source files, so that a run from the cache parses no source. The files
``code/<digest>.json`` store the digests of single definitions. Cache keys do not need these files; reports of changes
use them to name the changed function.
"""

from __future__ import annotations

import functools
import os
import sys
from collections.abc import Callable, Collection, Mapping, Sequence
from pathlib import Path

from neusee.nodes import Node
from neusee.workflows.keys.cache_key import PRIVATE, digest, is_private
from neusee.workflows.keys.code_memo import EDITION, Parts, is_complete, read_memo, write_memo, write_parts
from neusee.workflows.keys.code_objects import PYTHON
from neusee.workflows.keys.declared_dependencies import FREE, changing_refusal, refusal, resolve, uncovered
from neusee.workflows.keys.followed_imports import Imports
from neusee.workflows.keys.loaded_source import compiled_as_written, imported, say_once, source_of
from neusee.workflows.keys.loaded_state import LoadedState, counted_values, without_modules
from neusee.workflows.keys.module_look import OURS, Look, Names, Whole, digest_of, installed_look, parts_of
from neusee.workflows.keys.module_origin import Origin, look_again, module_path, origin_of
from neusee.workflows.keys.module_owner import is_own
from neusee.workflows.keys.process_settings import own_settings, settings, workflows_digest
from neusee.workflows.keys.reachable_code import reached, read_names
from neusee.workflows.keys.sibling_modules import Siblings
from neusee.workflows.keys.source_summary import ROOT, Summary, summarise
from neusee.workflows.keys.tainted_code import holds_here_alone
from neusee.workflows.keys.unfollowed_code import UnfollowedCode
from neusee.workflows.keys.user_code import reads_time

#: modules that decide no result
_LEFT_OUT = frozenset({"neusee", ROOT} | {f"{ROOT}.{n}" for n in ("_hooks", "_node", "import_times", "own_modules")})
_WORKFLOWS = "neusee.workflows"
_THIS_PROCESS = os.urandom(8).hex()
_NO_FILE = "{} has no source file, so its nodes have no cache key: save the module as a file"
_PYTHON = "Python {}.{}".format(*sys.version_info)


class Code:
    """Digests of the source code of nodes, which stay the same during one run."""

    def __init__(self, memo: Path, loaded: Collection[str] | None = None) -> None:
        """Read the summaries in the file ``memo``; with ``loaded`` packages hold no followed modules but these."""
        look_again()
        self._memo, self._loaded = memo, loaded
        self._summaries: dict[str, Summary] = read_memo(memo)
        self._new = False
        self._wholes: dict[str, Whole] = {}
        self._looks: dict[tuple[str, frozenset[str], bool], Look | None] = {}
        self._followed: dict[frozenset[str], Callable[[str], bool]] = {}
        self._origins: dict[tuple[str, frozenset[str]], Origin] = {}
        self._siblings = Siblings(self._whole)
        self._codes: dict[int, tuple[Node, str]] = {}  # digest of each node, by id
        self._parts: dict[str, Parts] = {}  # by digest, not saved yet
        self.parts: dict[str, Parts] = {}  #: what each digest covers

    def of(self, node: Node, classes: tuple[tuple[str, str], ...] = ()) -> str:
        """Return the digest of the code of a node, with what the node declares and what its function holds.

        ``classes``: module and name of the network classes that a step gives the node; their modules count as a whole.
        Raises `LookupError` with place and fix for code that reads what cannot be followed.
        """
        if id(node) not in self._codes:
            self._codes[id(node)] = node, self._of(node)
        code = self._codes[id(node)][1]
        for module, name in classes:
            whole = self._whole(module)
            self._refuse(whole, module, node, {name.partition(".")[0]})
            parts = {**self._whole(node.fn.__module__).parts, **whole.parts}
            code = self._named(digest(code, whole.code), parts, is_private(code) or is_private(whole.code))
        return self._beside(code, node, [node.fn.__module__, *(module for module, _ in classes)])

    def _beside(self, code: str, node: Node, roots: Sequence[str]) -> str:
        """Return the digest of a node with the other modules of a user that may change what it computes."""
        wholes = {name: self._whole(name) for name in self._siblings.of(roots)}
        if not wholes:
            return code
        for name, whole in wholes.items():
            self._refuse(whole, name, node, {"_"})
        parts = dict(self.parts.get(code, {}))
        for whole in wholes.values():
            parts |= whole.parts
        codes = [whole.code for whole in wholes.values()]
        return self._named(digest(code, codes), parts, any(map(is_private, [code, *codes])))

    def digest(self, module: str) -> str:
        """Return the digest of a module and of all that it imports, directly or not.

        Raises `LookupError` if an imported module or its source cannot be determined.
        """
        return self._whole(module).code

    def looks(self, module: str) -> Mapping[str, Look]:
        """Return what a module and each module that it leads to add to the digest, by name."""
        return self._whole(module).looks

    def save(self) -> None:
        """Save the new digests of source files and of their functions; do nothing if the folder cannot be written."""
        if self._new or not is_complete(self._memo):
            self._new = False
            write_memo(self._memo, self._summaries)
        for code, parts in self._parts.items():
            write_parts(self._memo.parent, code, parts)
        self._parts = {}

    def _of(self, node: Node) -> str:
        module = node.fn.__module__
        code, whole = self.digest(module), self._whole(module)
        self._refuse(whole, module, node, {node.fn.__name__, "_"})
        plain = getattr(sys.modules.get(module), node.fn.__name__, None) is node
        if plain and not node.depends:
            return code
        source = whole.looks[module].path or Path(module)
        declared = resolve(node.depends, module, source, node.environment, lambda name: module_path(name) is not None)
        parts, private = dict(declared.parts), is_private(code)
        for name in declared.modules:
            below = self._whole(name)
            parts, private = {**parts, **parts_of(below.looks)}, private or is_private(below.code)
        if declared.changed:
            private = True
            say_once(module, f"{source.parent / declared.changed[0]} was changed after the import of {source}: restart")
        if not plain:
            state = LoadedState(sys.modules[module], (), self._follows(_packages(module)))
            parts["closure"] = {node.path: state.digest({"function": node.fn})}
            if state.changing and f"{FREE}function" not in node.depends:
                raise UnfollowedCode(changing_refusal("function", state.changing["function"], source))
            inner = [self._whole(name).code for name in sorted(state.modules.keys() - whole.looks.keys())]
            parts["closure"].update({f"module {n}": each for n, each in enumerate(inner)})
            private = private or any(map(is_private, inner))
        return self._named(digest(code, parts), {**whole.parts, **parts}, private)

    def _whole(self, module: str) -> Whole:
        """Return the digest of a module with the modules that it leads to."""
        if module in self._wholes:
            return self._wholes[module]
        looks: dict[str, Look] = {}
        names: Names = {module: set()}
        todo, packages = [module], _packages(module)
        while todo:
            name = todo.pop()
            look = self._look(name, packages, name == module) if name not in looks else None
            if look is not None:
                looks[name] = look
                for other, used in look.imports.items():
                    names.setdefault(other, set()).update(used)
                    todo.append(other)
        if module not in looks or looks[module].summary is None:
            raise UnfollowedCode(
                f"{module} has no source file, so its nodes have no cache key: save the module as a file"
            )
        documents = any(look.summary.documents for look in looks.values() if look.summary)
        state = {name: digest_of(look, documents) for name, look in looks.items()}
        now = settings() | (own_settings(reads_time(looks)) if is_own(module) else {})
        code = digest(_PYTHON, now, state)
        parts = {"Python": {"version": _PYTHON}, "settings": now, **parts_of(looks)}
        code = self._named(code, parts, any(look.private for look in looks.values()))
        self._wholes[module] = Whole(code, looks, names, parts)
        return self._wholes[module]

    def _named(self, code: str, parts: Parts, private: bool) -> str:
        """Return a digest, private to this process where the loaded code is not that of the files."""
        if private:
            return PRIVATE + digest(code, _THIS_PROCESS)
        self._parts[code] = self.parts[code] = parts
        return code

    def _refuse(self, whole: Whole, module: str, node: Node, own: set[str]) -> None:
        """Raise `LookupError` for the first construct that is not followed, not declared, and that ``own`` reaches."""
        for name, look in whole.looks.items():
            if look.summary is None or look.path is None or not (look.summary.constructs or look.changing):
                continue
            used = own if name == module else whole.names.get(name) or {""}
            free = [*look.summary.depends, *node.depends]
            read = read_names(look.summary.statements, set() if used & {"", "*"} else used) if look.changing else set()
            for held, what in look.changing.items():
                if held in read and f"{FREE}{held}" not in free:
                    raise UnfollowedCode(changing_refusal(held, what, look.path))
            lines = [r for r in reached(look.summary.statements, None if "" in used else used)]
            found = [item for item in look.summary.constructs if any(item.line in r for r in lines)]
            left = uncovered(found, free)
            if left is not None:
                raise UnfollowedCode(refusal(left, look.path))

    def _look(self, module: str, packages: frozenset[str], root: bool) -> Look | None:
        key = (module, packages, root)
        if key not in self._looks:
            self._looks[key] = None if _decides_nothing(module) else self._looked(module, packages, root)
        return self._looks[key]

    def _looked(self, module: str, packages: frozenset[str], root: bool) -> Look | None:
        if f"{module}.".startswith(f"{_WORKFLOWS}."):
            return Look({_WORKFLOWS: {"files": workflows_digest()}}, {})
        origin = self._origin(module, packages)
        if origin.kind in ("python", "folder"):
            return None
        if origin.kind in ("distribution", "absent"):
            return installed_look(module, origin.version, packages)
        if origin.path is None:
            raise UnfollowedCode(
                f"{module} has no source file, so its nodes have no cache key: save the module as a file"
            )
        if origin.kind == "binary":
            return Look({f"file {origin.path.name}": {"content": source_of(module, origin.path)[1]}}, {})
        return self._source(module, origin.path, packages, root)

    def _source(self, module: str, path: Path, packages: frozenset[str], root: bool) -> Look:
        """Return what a module adds whose source is followed."""
        known = imported(module)
        summary = self._summary(module, path)
        follows = self._follows(packages)
        inner = Imports(
            module, path, lambda name: self._summary_of(name, packages), lambda name: self._origin(name, packages).kind
        )
        free = {entry.removeprefix(FREE) for entry in summary.depends if entry.startswith(FREE)}
        imports = {name: used for name, used in inner.names(summary).items() if name.partition(".")[0] not in free}
        state, private, parts = "", holds_here_alone(module), {module: summary.definitions}
        changing: Mapping[str, str] = {}
        if known:
            loaded = LoadedState(sys.modules[module], summary.functions if compiled_as_written(module) else (), follows)
            values = counted_values(sys.modules[module], summary, free, root)
            if (only := self._loaded) is not None:
                values = without_modules(module, values, lambda name: follows(name) and name not in only)
            state = loaded.digest(values)
            parts[f"state of {module}"], changing = {"values": state}, loaded.changing
            for name in sorted(loaded.modules):
                imports.setdefault(name, set()).update(loaded.modules[name])
            if loaded.replaced and not private:
                private = True
                text = f"the loaded code of {loaded.replaced[0]}() is not that of {path}, so results are not stored"
                say_once(module, f"{text}: restart Python, and delete __pycache__ if this is said again")
        if summary.depends:
            declared = resolve(summary.depends, module, path, {}, lambda name: module_path(name) is not None)
            parts.update(declared.parts)
            imports.update({name: {""} for name in declared.modules})
            if declared.changed:
                private = True
                say_once(module, f"{path.parent / declared.changed[0]} was changed after the import of {path}: restart")
        return Look(parts, imports, summary, path, state, changing, private)

    def _follows(self, packages: frozenset[str]) -> Callable[[str], bool]:
        """Return the function that tells whether the source of a module is followed."""
        if packages not in self._followed:
            self._followed[packages] = functools.cache(lambda name: self._is_followed(name, packages))
        return self._followed[packages]

    def _is_followed(self, module: str, packages: frozenset[str]) -> bool:
        outside = _decides_nothing(module) or f"{module}.".startswith(f"{_WORKFLOWS}.")
        nowhere = module.startswith("namedtuple_") and module not in sys.modules  # the module of the methods of a tuple
        return not outside and not nowhere and self._origin(module, packages).kind == "source"

    def _origin(self, module: str, packages: frozenset[str]) -> Origin:
        key = (module, packages)
        if key not in self._origins:
            self._origins[key] = origin_of(module, packages)
        return self._origins[key]

    def _summary_of(self, module: str, packages: frozenset[str]) -> tuple[Path, Summary] | None:
        """Return the file and the summary of a module whose source is followed, or None."""
        origin = self._origin(module, packages)
        if origin.kind != "source" or origin.path is None or _decides_nothing(module):
            return None
        return origin.path, self._summary(module, origin.path)

    def _summary(self, module: str, path: Path) -> Summary:
        (source, found), own = source_of(module, path), is_own(module)
        name = f"{PYTHON}:{EDITION}:{found}{':own' * own}"
        if name not in self._summaries:
            try:
                self._summaries[name] = _summarised(source, own)
            except (SyntaxError, ValueError) as error:
                raise UnfollowedCode(f"{path}: {error}") from error
            self._new = True
        return self._summaries[name]


_summarised = functools.lru_cache(1000)(summarise)  #: several stores in one process parse a source once


def _decides_nothing(module: str) -> bool:
    """Return True for a module that decides no result, such as the rules for the shapes of a family of nodes."""
    return module in _LEFT_OUT or (module.startswith(f"{ROOT}.") and module.endswith("._result_shapes"))


def _packages(module: str) -> frozenset[str]:
    """Return the packages that are followed by source though they are installed: that of a node, and this one."""
    return OURS | {module.partition(".")[0]}
