"""Digests of the code of nodes and of the program, and reuse of cache keys from one recipe to the
next.
"""

from __future__ import annotations

import functools
import os
import sys
from collections.abc import Callable, Collection, Iterable, Iterator, Mapping, Sequence
from itertools import chain
from pathlib import Path
from typing import TYPE_CHECKING, Any, NamedTuple

import xxhash

from neusee.nodes import Node
from neusee.workflows.graph.step_shapes import has_path
from neusee.workflows.keys.cache_key import (
    PRIVATE,
    Key,
    device_kind,
    digest,
    is_own,
    is_private,
    key_of,
)
from neusee.workflows.keys.loaded_state import (
    LoadedState,
    counted_values,
    own_settings,
    settings,
    without_modules,
    workflows_digest,
)
from neusee.workflows.keys.module_digest import (
    EDITION,
    OURS,
    Look,
    Names,
    Outline,
    Parts,
    Whole,
    compiled_as_written,
    digest_of,
    imported,
    installed_look,
    is_complete,
    outlines,
    parts_of,
    read_memo,
    say_once,
    source_of,
    write_memo,
    write_parts,
)
from neusee.workflows.keys.module_origin import (
    Kind,
    Origin,
    contents,
    look_again,
    module_file,
    module_path,
    origin_of,
)
from neusee.workflows.keys.source_summary import (
    PYTHON,
    ROOT,
    Import,
    Summary,
    Use,
    reached,
    read_names,
    summarise,
    syntax_outline,
)
from neusee.workflows.keys.unfollowed_constructs import UnfollowedCode
from neusee.workflows.keys.user_code import (
    FREE,
    Siblings,
    changing_refusal,
    holds_here_alone,
    reads_time,
    refusal,
    resolve,
    uncovered,
)

if TYPE_CHECKING:
    from neusee.workflows.graph.recipe_graph import Step


# --- followed imports -----------------------------------------------------------------------------

# The modules that a module imports, each with the names that are used of it.


Lookup = Callable[[str], tuple[Path, Summary] | None]


class Imports:
    """The import statements of one module, resolved to the modules that they load."""

    def __init__(
        self, module: str, path: Path, summary_of: Lookup, kind_of: Callable[[str], Kind]
    ) -> None:
        self._module, self._path, self._summary_of, self._kind_of = (
            module,
            path,
            summary_of,
            kind_of,
        )
        self._package = module if path.name == "__init__.py" else module.rpartition(".")[0]

    def names(self, summary: Summary) -> dict[str, set[str]]:
        """Return the imported modules, each with the names that are used of it; an empty name
        stands for the whole module.

        Raises `LookupError` if the code uses the package `neusee.nodes` as a whole.
        """
        names_by_module: dict[str, set[str]] = {}
        for statement in summary.imports:
            for module, name in self._imported(statement):
                names_by_module.setdefault(module, set()).add(name)
        # uses such as `package.module.name`
        for use in summary.uses:
            modules = self._used(use)
            if modules is None and self._module.startswith(ROOT):
                problem = (
                    "the package of all nodes is used, so the modules that a result depends on are"
                    " unknown"
                )
                raise UnfollowedCode(
                    f"{self._path}:{use[-1]}: {problem}: import each name from its own module"
                )
            for module in modules or ():
                names_by_module.setdefault(module, set()).add("")
        return names_by_module

    def _imported(self, item: Import) -> Iterator[tuple[str, str]]:
        """Yield each module that an import statement needs, with the imported name: a submodule, or
        the module that defines the name.
        """
        level, base, name = item
        base = absolute(level, base, self._package)
        if name and name != "*" and self._is_module(base, name):
            yield f"{base}.{name}", ""
            file_and_summary = self._summary_of(base)
            # the name may be both a submodule and something that the package itself imports
            if file_and_summary is None or name not in file_and_summary[1].binds:
                return
        yield base, name

    def _used(self, use: Use) -> list[str] | None:
        """Return the modules in an expression such as ``name.a.b``, or None if the expression uses
        all of `neusee.nodes`.
        """
        level, base, name, chain, _ = use
        full_name = ".".join(filter(None, (absolute(level, base, self._package), name)))
        modules, attributes = [full_name], chain.split(".") if chain else []
        while attributes and self._is_module(modules[-1], attributes[0]):
            modules.append(f"{modules[-1]}.{attributes.pop(0)}")
        uses_all_nodes = modules[-1] in ("neusee", ROOT) and (
            not attributes or attributes[0].startswith("__")
        )
        # the first module is the import itself, which `_imported` already yields
        return None if uses_all_nodes else modules[1:]

    def _is_module(self, package: str, name: str) -> bool:
        """Return True if ``package`` contains a module ``name``, where the package is followed by
        source or is a plain folder.
        """
        module = f"{package}.{name}"
        if module == ROOT:
            return True
        may_hold_modules = package == ROOT or self._kind_of(package) in ("source", "folder")
        # a loaded module without a path for submodules is no package
        if package in sys.modules and "__path__" not in contents(package):
            return False
        return may_hold_modules and module_path(module) is not None


def absolute(level: int, base: str, package: str) -> str:
    """Return the absolute name of the module ``base`` in a relative import with ``level``
    leading dots.
    """
    if not level:
        return base
    package_parts = package.split(".")
    # one dot stands for the package itself, each further dot for the package above
    return ".".join([*package_parts[: len(package_parts) - level + 1], *filter(None, [base])])


# --- engine digest --------------------------------------------------------------------------------

# Digest of the program's own code: of some modules, and of all modules of `neusee.workflows` that
# they import.
#
# The key of a stored study, design or posterior contains this digest, so that changed code never
# leads to an old result. `code_digest.Code` computes the digests of nodes.


_HERE = Path(__file__).parents[1]
_ROOT = "neusee.workflows"


@functools.cache
def engine(*modules: str) -> str:
    """Return the digest of the code of ``modules`` of neusee.workflows and of all modules there
    that they import.

    The default module is ``engine.runner``. Only imports of neusee.workflows at the top level of a
    module count. Raises `LookupError` for a module without a source file.
    """
    digests: dict[str, str] = {}
    modules_left = list(modules or ("engine.runner",))
    while modules_left:
        name = modules_left.pop()
        if name in digests:
            continue
        path = _source(name)
        if path is None:
            raise LookupError(
                f"{_ROOT}.{name} has no source file below {_HERE}, so its results have no cache key"
            )
        digests[name], imports = outline(path.read_bytes())
        modules_left += imported_by_engine(imports)
    return digest(digests)


def outline(source: bytes) -> Outline:
    """Return the digest of a source file and the import statements at its top level. The same
    source is parsed only once.
    """
    name = f"{PYTHON}:{EDITION}:{xxhash.xxh3_128_hexdigest(source)}"
    if name not in outlines:
        outlines[name] = Outline(*syntax_outline(source))
    return outlines[name]


def imported_by_engine(statements: Iterable[tuple[str, list[str]]]) -> Iterator[str]:
    """Yield the name of each module of neusee.workflows that import statements name, such as
    ``engine.runner``.
    """
    for base, names in statements:
        if not base:
            yield from (_below(name) for name in names if name.startswith(f"{_ROOT}."))
        elif f"{base}.".startswith(f"{_ROOT}."):
            inner_name = _below(base)
            for name in names:
                module = f"{inner_name}.{name}".lstrip(".")
                # `from a import b`: b is a module, or a name of the module a
                yield module if _source(module) is not None or not inner_name else inner_name


def _below(module: str) -> str:
    """Return the name of a module below neusee.workflows, such as ``engine.runner``."""
    return module.removeprefix(_ROOT).lstrip(".")


def _source(name: str) -> Path | None:
    """Return the path of the source file of a module below neusee.workflows, or None if there is
    none.
    """
    return module_file(_HERE, name.split("."))


# --- code digest ----------------------------------------------------------------------------------

# Digests of the code of nodes: of the node's module and of all modules that it imports, by their
# source or version and by the values that they hold.
#
# A digest covers the source of each module of `neusee.nodes`, of the user, of an editable install
# and of a package with nodes. It covers other packages by their version. It also covers the values
# of each loaded module, and what `depends=` declares. Comments and layout do not count, nor do
# docstrings that no code reads. A construct that cannot be followed raises an error. If the loaded
# code differs from its file, the digest is private to the process, and its results are not stored.
#
# One file stores the summaries of all source files, so that a run from the cache parses no source.
# The files ``code/<digest>.json`` store the digests of single definitions. Cache keys do not need
# these files; reports of changes use them to name the changed function.


#: modules whose code affects no result
_LEFT_OUT = frozenset(
    {"neusee", ROOT} | {f"{ROOT}.{n}" for n in ("_hooks", "_node", "import_times", "own_modules")}
)
_WORKFLOWS = "neusee.workflows"
_THIS_PROCESS = os.urandom(8).hex()
_NO_FILE = "{} has no source file, so its nodes have no cache key: save the module as a file"
_PYTHON = "Python {}.{}".format(*sys.version_info)


class Code:
    """Digests of the source code of nodes; they stay fixed during one run."""

    def __init__(self, memo: Path, loaded: Collection[str] | None = None) -> None:
        """Read the summaries of source files in the file ``memo``; ``loaded`` names the modules
        that count as values of their packages, None for all.
        """
        look_again()
        self._memo, self._loaded = memo, loaded
        self._summaries: dict[str, Summary] = read_memo(memo)
        self._new = False  # True if a summary is not in the memo yet
        # digest of each module with all modules that it imports
        self._wholes: dict[str, Whole] = {}
        self._looks: dict[tuple[str, frozenset[str], bool], Look | None] = {}
        self._followed: dict[frozenset[str], Callable[[str], bool]] = {}
        self._origins: dict[tuple[str, frozenset[str]], Origin] = {}
        self._siblings = Siblings(self._whole)
        self._codes: dict[int, tuple[Node, str]] = {}  # digest of each node, by id
        self._parts: dict[str, Parts] = {}  # by digest, not saved yet
        self.parts: dict[str, Parts] = {}  #: the parts that each digest covers

    def of(self, node: Node, classes: tuple[tuple[str, str], ...] = ()) -> str:
        """Return the digest of the code of a node: of its modules, of its ``depends=`` entries, and
        of the values that its function holds in closures.

        ``classes``: module and name of the network classes that a step gives the node; their
        modules count as a whole. Raises `LookupError`, with place and fix, for code that reads what
        cannot be followed.
        """
        if id(node) not in self._codes:
            self._codes[id(node)] = node, self._of(node)
        code = self._codes[id(node)][1]
        for module, name in classes:
            closure = self._whole(module)
            # statements are listed by the name of the outermost class
            self._refuse(closure, module, node, {name.partition(".")[0]})
            covered_parts = {**self._whole(node.fn.__module__).parts, **closure.parts}
            code = self._named(
                digest(code, closure.code),
                covered_parts,
                is_private(code) or is_private(closure.code),
            )
        return self._beside(code, node, [node.fn.__module__, *(module for module, _ in classes)])

    def _beside(self, code: str, node: Node, roots: Sequence[str]) -> str:
        """Return the digest of a node combined with those of the user's other modules that may
        change what the node computes.
        """
        wholes = {name: self._whole(name) for name in self._siblings.of(roots)}
        if not wholes:
            return code
        for name, closure in wholes.items():
            # "_" stands for the statements that run at import
            self._refuse(closure, name, node, {"_"})
        covered_parts = dict(self.parts.get(code, {}))
        for closure in wholes.values():
            covered_parts |= closure.parts
        codes = [closure.code for closure in wholes.values()]
        return self._named(digest(code, codes), covered_parts, any(map(is_private, [code, *codes])))

    def digest(self, module: str) -> str:
        """Return the digest of a module and of all modules that it imports, directly or indirectly.

        Raises `LookupError` if an imported module or its source cannot be determined.
        """
        return self._whole(module).code

    def looks(self, module: str) -> Mapping[str, Look]:
        """Return, by name, the contribution to the digest of a module and of each module that it
        leads to.
        """
        return self._whole(module).looks

    def save(self) -> None:
        """Save the new summaries of source files and the digests of their definitions; do nothing
        if the folder cannot be written.
        """
        if self._new or not is_complete(self._memo):
            self._new = False
            write_memo(self._memo, self._summaries)
        for code, parts in self._parts.items():
            write_parts(self._memo.parent, code, parts)
        self._parts = {}

    def _of(self, node: Node) -> str:
        """Return the digest of the code of a node, without the other modules of the user that
        `_beside` adds.
        """
        module = node.fn.__module__
        # the module with all modules that it imports
        code, closure = self.digest(module), self._whole(module)
        self._refuse(closure, module, node, {node.fn.__name__, "_"})
        # if False, a function made the node, and the variables of that function affect its results
        is_as_in_module = getattr(sys.modules.get(module), node.fn.__name__, None) is node
        if is_as_in_module and not node.depends:
            return code
        source = closure.looks[module].path or Path(module)
        # the ``depends=`` entries of the node itself, beside those of its module
        declared = resolve(node.depends, module, source, node.environment, _is_a_module)
        added_parts, is_private_code = dict(declared.parts), is_private(code)
        for name in declared.modules:
            declared_closure = self._whole(name)
            added_parts, is_private_code = (
                {**added_parts, **parts_of(declared_closure.looks)},
                is_private_code or is_private(declared_closure.code),
            )
        # the process still computes with the earlier content of the file
        if declared.changed:
            is_private_code = True
            _say_changed(module, source, declared.changed[0])
        # a node that another function makes
        if not is_as_in_module:
            added_parts["closure"], inner = self._held_around(node, closure, source)
            is_private_code = is_private_code or any(map(is_private, inner))
        return self._named(
            digest(code, added_parts), {**closure.parts, **added_parts}, is_private_code
        )

    def _held_around(
        self, node: Node, closure: Whole, source: Path
    ) -> tuple[dict[str, str], list[str]]:
        """Return the digest of the closure of a node's function, and the digests of the further
        modules that the values in the closure lead to.
        """
        module = node.fn.__module__
        state = LoadedState(sys.modules[module], (), self._follows(_packages(module)))
        held_parts = {node.path: state.digest({"function": node.fn})}
        if state.changing and f"{FREE}function" not in node.depends:
            raise UnfollowedCode(changing_refusal("function", state.changing["function"], source))
        inner_codes = [
            self._whole(name).code for name in sorted(state.modules.keys() - closure.looks.keys())
        ]
        held_parts.update({f"module {n}": inner_code for n, inner_code in enumerate(inner_codes)})
        return held_parts, inner_codes

    def _whole(self, module: str) -> Whole:
        """Return the digest of a module together with all modules that it leads to."""
        if module in self._wholes:
            return self._wholes[module]
        looks, names = self._led_to(module)
        if module not in looks or looks[module].summary is None:
            raise UnfollowedCode(_NO_FILE.format(module))
        # docstrings count if any of the modules reads docstrings
        reads_docstrings = any(look.summary.documents for look in looks.values() if look.summary)
        # contribution of each module, with docstrings only if they are read
        state = {name: digest_of(look, reads_docstrings) for name, look in looks.items()}
        # code of users may read more settings than code of neusee does
        process_settings = settings() | (own_settings(reads_time(looks)) if is_own(module) else {})
        code = digest(_PYTHON, process_settings, state)
        covered_parts = {
            "Python": {"version": _PYTHON},
            "settings": process_settings,
            **parts_of(looks),
        }
        code = self._named(code, covered_parts, any(look.private for look in looks.values()))
        self._wholes[module] = Whole(code, looks, names, covered_parts)
        return self._wholes[module]

    def _led_to(self, module: str) -> tuple[dict[str, Look], Names]:
        """Return the contribution of each module that ``module`` leads to, itself included, and the
        names that other modules use of each.
        """
        looks: dict[str, Look] = {}
        names: Names = {module: set()}
        modules_left, packages = [module], _packages(module)
        while modules_left:
            name = modules_left.pop()
            # each module once; `_look` returns None for a module that affects no result
            look = self._look(name, packages, name == module) if name not in looks else None
            if look is None:
                continue
            looks[name] = look
            for imported_module, used_names in look.imports.items():
                # only constructs that the used names reach are refused
                names.setdefault(imported_module, set()).update(used_names)
                modules_left.append(imported_module)
        return looks, names

    def _named(self, code: str, parts: Parts, private: bool) -> str:
        """Return a digest and note its parts. If ``private``, the loaded code differs from its
        files, and the digest is valid in this process only.
        """
        if private:
            return PRIVATE + digest(code, _THIS_PROCESS)
        self._parts[code] = self.parts[code] = parts
        return code

    def _refuse(self, closure: Whole, module: str, node: Node, own: set[str]) -> None:
        """Raise `LookupError` for the first construct that cannot be followed, is not declared, and
        is reached from the names ``own`` of the module.
        """
        for name, look in closure.looks.items():
            # an installed package counts by its version
            if look.summary is None or look.path is None:
                continue
            if not look.summary.constructs and not look.changing:
                continue
            # the empty name stands for the whole module
            used_names = own if name == module else closure.names.get(name) or {""}
            declared_entries = [*look.summary.depends, *node.depends]
            if look.changing:
                _refuse_changing(
                    look.changing, look.summary, look.path, used_names, declared_entries
                )
            _refuse_constructs(look.summary, look.path, used_names, declared_entries)

    def _look(self, module: str, packages: frozenset[str], root: bool) -> Look | None:
        """Return the contribution of a module to a digest, computed once; None for a module that
        affects no result.

        ``root``: True for the module of the node itself.
        """
        key = (module, packages, root)
        if key not in self._looks:
            self._looks[key] = (
                None if _decides_nothing(module) else self._looked(module, packages, root)
            )
        return self._looks[key]

    def _looked(self, module: str, packages: frozenset[str], root: bool) -> Look | None:
        """Return the contribution of a module to a digest. Depending on its origin, the module
        counts by the whole of neusee.workflows, by its version, by its bytes or by its source.
        """
        if f"{module}.".startswith(f"{_WORKFLOWS}."):
            return Look({_WORKFLOWS: {"files": workflows_digest()}}, {})
        origin = self._origin(module, packages)
        if origin.kind in ("python", "folder"):
            return None
        if origin.kind in ("distribution", "absent"):
            return installed_look(module, origin.version, packages)
        if origin.path is None:
            raise UnfollowedCode(_NO_FILE.format(module))
        if origin.kind == "binary":
            return Look(
                {f"file {origin.path.name}": {"content": source_of(module, origin.path)[1]}}, {}
            )
        return self._source(module, origin.path, packages, root)

    def _source(self, module: str, path: Path, packages: frozenset[str], root: bool) -> Look:
        """Return the contribution to a digest of a module whose source is followed."""
        is_imported = imported(module)
        summary = self._summary(module, path)
        follows = self._follows(packages)
        free_names = {
            entry.removeprefix(FREE) for entry in summary.depends if entry.startswith(FREE)
        }
        imports = self._imports(module, path, summary, packages, free_names)
        # state: the digest of the values that the loaded module holds
        state, is_private_code, parts = "", holds_here_alone(module), {module: summary.definitions}
        changing: Mapping[str, str] = {}
        if is_imported:
            module_state, state = self._loaded_state(module, summary, follows, free_names, root)
            parts[f"state of {module}"], changing = {"values": state}, module_state.changing
            # modules of the module's values, which its source need not name
            for name in sorted(module_state.modules):
                imports.setdefault(name, set()).update(module_state.modules[name])
            # the loaded code differs from the file
            if module_state.replaced and not is_private_code:
                is_private_code = True
                _say_replaced(module, path, module_state.replaced[0])
        if summary.depends:
            declarations = resolve(summary.depends, module, path, {}, _is_a_module)
            parts.update(declarations.parts)
            imports.update({name: {""} for name in declarations.modules})
            if declarations.changed:
                is_private_code = True
                _say_changed(module, path, declarations.changed[0])
        return Look(parts, imports, summary, path, state, changing, is_private_code)

    def _imports(
        self,
        module: str,
        path: Path,
        summary: Summary,
        packages: frozenset[str],
        free: set[str],
    ) -> dict[str, set[str]]:
        """Return the modules that a module imports, each with the names that are used, without the
        modules declared ``free``.
        """
        # includes names that other modules define
        module_imports = Imports(
            module,
            path,
            lambda name: self._summary_of(name, packages),
            lambda name: self._origin(name, packages).kind,
        )
        names_by_module = module_imports.names(summary)
        return {
            name: used_names
            for name, used_names in names_by_module.items()
            if name.partition(".")[0] not in free
        }

    def _loaded_state(
        self,
        module: str,
        summary: Summary,
        follows: Callable[[str], bool],
        free: set[str],
        root: bool,
    ) -> tuple[LoadedState, str]:
        """Return the state of a loaded module (see `LoadedState`), and the digest of that state."""
        # a loader that changes the source gives byte code that never equals that of the file
        functions = summary.functions if compiled_as_written(module) else ()
        loaded = LoadedState(sys.modules[module], functions, follows)
        values = counted_values(sys.modules[module], summary, free, root)
        # a package holds its loaded submodules as values; only those in ``loaded`` count
        if (kept_modules := self._loaded) is not None:
            values = without_modules(
                module, values, lambda name: follows(name) and name not in kept_modules
            )
        return loaded, loaded.digest(values)

    def _follows(self, packages: frozenset[str]) -> Callable[[str], bool]:
        """Return the function that decides whether the source of a module is followed."""
        if packages not in self._followed:
            self._followed[packages] = functools.cache(
                lambda name: self._is_followed(name, packages)
            )
        return self._followed[packages]

    def _is_followed(self, module: str, packages: frozenset[str]) -> bool:
        """Return True for a module that counts by its source and not by its version."""
        is_not_followed = _decides_nothing(module) or f"{module}.".startswith(f"{_WORKFLOWS}.")
        # the methods of a named tuple state a module of this name, which does not exist
        is_of_tuple = module.startswith("namedtuple_") and module not in sys.modules
        return (
            not is_not_followed
            and not is_of_tuple
            and self._origin(module, packages).kind == "source"
        )

    def _origin(self, module: str, packages: frozenset[str]) -> Origin:
        """Return the origin of a module, looked up once."""
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
        """Return the summary of a source file, from the memo if that contains the same source."""
        (source, content_digest), is_of_user = source_of(module, path), is_own(module)
        # another version of Python, or of the code that summarises, gives another summary
        memo_key = f"{PYTHON}:{EDITION}:{content_digest}{':own' * is_of_user}"
        if memo_key not in self._summaries:
            try:
                self._summaries[memo_key] = _summarised(source, is_of_user)
            except (SyntaxError, ValueError) as error:
                raise UnfollowedCode(f"{path}: {error}") from error
            self._new = True
        return self._summaries[memo_key]


#: cached, so that several stores in one process parse the same source once
_summarised = functools.lru_cache(1000)(summarise)


def _is_a_module(name: str) -> bool:
    """Return True if ``name`` is the name of a module that can be found."""
    return module_path(name) is not None


def _say_changed(module: str, source: Path, entry: str) -> None:
    """Warn that a declared file was changed after the import of its module."""
    say_once(module, f"{source.parent / entry} was changed after the import of {source}: restart")


def _say_replaced(module: str, path: Path, function: str) -> None:
    """Warn that the loaded code of a function differs from the code in its file."""
    text = f"the loaded code of {function}() is not that of {path}, so results are not stored"
    say_once(module, f"{text}: restart Python, and delete __pycache__ if this is said again")


def _refuse_changing(
    changing: Mapping[str, str],
    summary: Summary,
    path: Path,
    used_names: set[str],
    free: Sequence[str],
) -> None:
    """Raise `LookupError` for an object that changes while a process runs, if the used names read
    it and no entry of ``free`` declares it.
    """
    # an empty set stands for the whole module
    names = set[str]() if used_names & {"", "*"} else used_names
    names_read = read_names(summary.statements, names)
    for object_name, kind_of_object in changing.items():
        if object_name in names_read and f"{FREE}{object_name}" not in free:
            raise UnfollowedCode(changing_refusal(object_name, kind_of_object, path))


def _refuse_constructs(
    summary: Summary, path: Path, used_names: set[str], free: Sequence[str]
) -> None:
    """Raise `LookupError` for the first construct that the used names reach and that no entry of
    ``free`` covers.
    """
    # the empty name stands for the whole module
    names_or_all = None if "" in used_names else used_names
    lines = frozenset(chain.from_iterable(reached(summary.statements, names_or_all)))
    reached_constructs = [item for item in summary.constructs if item.line in lines]
    first_uncovered = uncovered(reached_constructs, free)
    if first_uncovered is not None:
        raise UnfollowedCode(refusal(first_uncovered, path))


def _decides_nothing(module: str) -> bool:
    """Return True for a module that affects no result, such as the rules for the shapes of results
    of a family of nodes.
    """
    return module in _LEFT_OUT or (
        module.startswith(f"{ROOT}.") and module.endswith("._result_shapes")
    )


def _packages(module: str) -> frozenset[str]:
    """Return the packages that are followed by source although they are installed: neusee, and the
    package of the node's module.
    """
    return OURS | {module.partition(".")[0]}


# --- known keys -----------------------------------------------------------------------------------

# Reuse of cache keys from one recipe to the next, such as the points of a sweep, where most steps
# keep their key.


class _Known(NamedTuple):
    """The newest cache key of a step, with everything that the key depends on."""

    step: Step
    beside: tuple[Any, ...]  #: seed, kind of the device and keys of the inputs
    key: Key
    origin: dict[str, Any]


class KnownKeys:
    """The newest cache key of each step. A key is computed again only if something that it depends
    on has changed.

    The code of nodes counts as it is in ``code``, and files are read again each time.
    """

    def __init__(self, code: Code) -> None:
        self.code = code
        self._newest: dict[str, _Known] = {}

    def of(
        self, step: Step, keys: Mapping[str, Key], seed: int, device: str
    ) -> tuple[Key, dict[str, Any]]:
        """Return the cache key of ``step`` and the data from which the key is computed, as
        `key_of` does.
        """
        seed_device_inputs = (seed, device_kind(device), *(keys[name] for name in step.sources))
        newest = self._newest.get(step.name)
        if (
            newest is not None
            and newest.beside == seed_device_inputs
            and _is_same(step, newest.step)
        ):
            return newest.key, newest.origin
        key, origin = key_of(step, keys, seed, self.code, device)
        if newest is not None and newest.key == key:
            # the same object, to save memory: many points of a sweep keep their keys
            key = newest.key
        # a step that reads a file is not kept: the content may change under the same path
        if not has_path(step.params):
            self._newest[step.name] = _Known(step, seed_device_inputs, key, origin)
        return key, origin


def _is_same(step: Step, other: Step) -> bool:
    """Return True if two steps of the same name have the same node, inputs and parameters; 0.0 and
    -0.0 count as different.
    """
    if step is other:
        return True
    is_equal = step.node is other.node and step.wires == other.wires and step.cached == other.cached
    is_equal = is_equal and step.params.keys() == other.params.keys()
    return is_equal and all(
        _is_equal(value, other.params[name]) for name, value in step.params.items()
    )


def _is_equal(value: Any, other: Any) -> bool:
    """Return True for the same object, and for two numbers or texts of the same type with equal
    value and equal text.
    """
    if value is other:
        return True
    return (
        type(value) is type(other)
        and isinstance(value, float | int | str)
        and repr(value) == repr(other)
    )
