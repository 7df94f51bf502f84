"""Digests of the code of nodes and of the program, and keys kept from recipe to recipe."""

from __future__ import annotations

import functools
import os
import sys
from collections.abc import Callable, Collection, Iterable, Iterator, Mapping, Sequence
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
    module_path,
    origin_of,
)
from neusee.workflows.keys.source_summary import (
    PYTHON,
    ROOT,
    Import,
    Summary,
    Use,
    module_file,
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

# Modules that the imports of a module lead to, with the names that are used of each.


Lookup = Callable[[str], tuple[Path, Summary] | None]


class Imports:
    """The imports of one module, resolved to modules."""

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
        """Return the imported modules with the names that are used; an empty name stands for the
        whole module.

        Raises `LookupError` if the package of all nodes is used as a whole.
        """
        found: dict[str, set[str]] = {}
        for item in summary.imports:
            for module, name in self._imported(item):
                found.setdefault(module, set()).add(name)
        for use in summary.uses:
            used = self._used(use)
            if used is None and self._module.startswith(ROOT):
                what = (
                    "the package of all nodes is used, so the modules that a result depends on are"
                    " unknown"
                )
                raise UnfollowedCode(
                    f"{self._path}:{use[-1]}: {what}: import each name from its own module"
                )
            for module in used or ():
                found.setdefault(module, set()).add("")
        return found

    def _imported(self, item: Import) -> Iterator[tuple[str, str]]:
        """Yield the modules that an import needs: a submodule, or the module that defines the
        imported name.
        """
        level, base, name = item
        base = absolute(level, base, self._package)
        if name and name != "*" and self._is_module(base, name):
            yield f"{base}.{name}", ""
            inner = self._summary_of(base)
            if inner is None or name not in inner[1].binds:
                return
        yield base, name

    def _used(self, use: Use) -> list[str] | None:
        """Return the modules in an expression such as ``name.a.b``, or None if it uses all of
        `neusee.nodes`.
        """
        level, base, name, chain, _ = use
        first = ".".join(filter(None, (absolute(level, base, self._package), name)))
        modules, rest = [first], chain.split(".") if chain else []
        while rest and self._is_module(modules[-1], rest[0]):
            modules.append(f"{modules[-1]}.{rest.pop(0)}")
        whole = modules[-1] in ("neusee", ROOT) and (not rest or rest[0].startswith("__"))
        return None if whole else modules[1:]

    def _is_module(self, package: str, name: str) -> bool:
        """Return True if a package, whose source is followed or which is a folder, has a module
        of this name.
        """
        module = f"{package}.{name}"
        if module == ROOT:
            return True
        inside = package == ROOT or self._kind_of(package) in ("source", "folder")
        if package in sys.modules and "__path__" not in contents(package):
            return False
        return inside and module_path(module) is not None


def absolute(level: int, base: str, package: str) -> str:
    """Return the absolute name of the module ``base`` in a relative import with ``level``
    leading dots.
    """
    if not level:
        return base
    above = package.split(".")
    return ".".join([*above[: len(above) - level + 1], *filter(None, [base])])


# --- engine digest --------------------------------------------------------------------------------

# Digest of the program's own code, over given modules and all modules of `neusee.workflows` that
# they import.
#
# The key of a stored study, design or posterior contains this digest, so that changed code never
# leads to an old result. `code_digest.Code` computes the digests of nodes.


_HERE = Path(__file__).parents[1]
_ROOT = "neusee.workflows"


@functools.cache
def engine(*modules: str) -> str:
    """Return the digest of the code of some modules of neusee.workflows and of all modules that
    these import.

    The default module is ``engine.runner``. Only imports of neusee.workflows at the top level of a
    module count. Raises `LookupError` for a module without a source file.
    """
    seen: dict[str, str] = {}
    todo = list(modules or ("engine.runner",))
    while todo:
        name = todo.pop()
        if name in seen:
            continue
        path = _source(name)
        if path is None:
            raise LookupError(
                f"{_ROOT}.{name} has no source file below {_HERE}, so its results have no cache key"
            )
        seen[name], imports = outline(path.read_bytes())
        todo += imported_by_engine(imports)
    return digest(seen)


def outline(source: bytes) -> Outline:
    """Return the digest of a source file and the import statements at its top level; an equal
    source is parsed once.
    """
    name = f"{PYTHON}:{EDITION}:{xxhash.xxh3_128_hexdigest(source)}"
    if name not in outlines:
        outlines[name] = Outline(*syntax_outline(source))
    return outlines[name]


def imported_by_engine(statements: Iterable[tuple[str, list[str]]]) -> Iterator[str]:
    """Yield the name of each module of neusee.workflows in import statements, such as
    ``engine.runner``.
    """
    for base, names in statements:
        if not base:
            yield from (_below(name) for name in names if name.startswith(f"{_ROOT}."))
        elif f"{base}.".startswith(f"{_ROOT}."):
            below = _below(base)
            for name in names:
                module = f"{below}.{name}".lstrip(".")
                yield module if _source(module) is not None or not below else below


def _below(module: str) -> str:
    return module.removeprefix(_ROOT).lstrip(".")


def _source(name: str) -> Path | None:
    return module_file(_HERE, name.split("."))


# --- code digest ----------------------------------------------------------------------------------

# Digests of the code of nodes: what a node's module and all that it imports were loaded from, and
# what they hold.
#
# A digest covers by source each module of `neusee.nodes`, of the user, of an editable install and
# of a package with nodes; other packages by their version; the values of each loaded module; and
# what `depends=` declares. Comments, layout and docstrings that nobody reads do not count. What
# cannot be followed is refused. Loaded code that is not that of its file gives a private digest,
# whose results are not stored.
#
# A file stores the summaries of source files, so that a run from the cache parses no source. The
# files ``code/<digest>.json`` store the digests of single definitions. Cache keys do not need these
# files; reports of changes use them to name the changed function.


#: modules that decide no result
_LEFT_OUT = frozenset(
    {"neusee", ROOT} | {f"{ROOT}.{n}" for n in ("_hooks", "_node", "import_times", "own_modules")}
)
_WORKFLOWS = "neusee.workflows"
_THIS_PROCESS = os.urandom(8).hex()
_NO_FILE = "{} has no source file, so its nodes have no cache key: save the module as a file"
_PYTHON = "Python {}.{}".format(*sys.version_info)


class Code:
    """Digests of the source code of nodes, which stay the same during one run."""

    def __init__(self, memo: Path, loaded: Collection[str] | None = None) -> None:
        """Read the summaries in the file ``memo``; with ``loaded`` packages hold no followed
        modules but these.
        """
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
        """Return the digest of the code of a node, with what the node declares and what its
        function holds.

        ``classes``: module and name of the network classes that a step gives the node; their
        modules count as a whole. Raises `LookupError` with place and fix for code that reads what
        cannot be followed.
        """
        if id(node) not in self._codes:
            self._codes[id(node)] = node, self._of(node)
        code = self._codes[id(node)][1]
        for module, name in classes:
            whole = self._whole(module)
            self._refuse(whole, module, node, {name.partition(".")[0]})
            parts = {**self._whole(node.fn.__module__).parts, **whole.parts}
            code = self._named(
                digest(code, whole.code), parts, is_private(code) or is_private(whole.code)
            )
        return self._beside(code, node, [node.fn.__module__, *(module for module, _ in classes)])

    def _beside(self, code: str, node: Node, roots: Sequence[str]) -> str:
        """Return the digest of a node with the other modules of a user that may change what it
        computes.
        """
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
        """Save the new digests of source files and of their functions; do nothing if the folder
        cannot be written.
        """
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
        declared = resolve(
            node.depends,
            module,
            source,
            node.environment,
            lambda name: module_path(name) is not None,
        )
        parts, private = dict(declared.parts), is_private(code)
        for name in declared.modules:
            below = self._whole(name)
            parts, private = {**parts, **parts_of(below.looks)}, private or is_private(below.code)
        if declared.changed:
            private = True
            say_once(
                module,
                f"{source.parent / declared.changed[0]} was changed after the import of {source}:"
                " restart",
            )
        if not plain:
            state = LoadedState(sys.modules[module], (), self._follows(_packages(module)))
            parts["closure"] = {node.path: state.digest({"function": node.fn})}
            if state.changing and f"{FREE}function" not in node.depends:
                raise UnfollowedCode(
                    changing_refusal("function", state.changing["function"], source)
                )
            inner = [
                self._whole(name).code for name in sorted(state.modules.keys() - whole.looks.keys())
            ]
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
                f"{module} has no source file, so its nodes have no cache key: save the module as a"
                " file"
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
        """Return a digest, private to this process where the loaded code is not that of the
        files.
        """
        if private:
            return PRIVATE + digest(code, _THIS_PROCESS)
        self._parts[code] = self.parts[code] = parts
        return code

    def _refuse(self, whole: Whole, module: str, node: Node, own: set[str]) -> None:
        """Raise `LookupError` for the first construct that is not followed, not declared, and
        that ``own`` reaches.
        """
        for name, look in whole.looks.items():
            if (
                look.summary is None
                or look.path is None
                or not (look.summary.constructs or look.changing)
            ):
                continue
            used = own if name == module else whole.names.get(name) or {""}
            free = [*look.summary.depends, *node.depends]
            read = (
                read_names(look.summary.statements, set() if used & {"", "*"} else used)
                if look.changing
                else set()
            )
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
            self._looks[key] = (
                None if _decides_nothing(module) else self._looked(module, packages, root)
            )
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
                f"{module} has no source file, so its nodes have no cache key: save the module as a"
                " file"
            )
        if origin.kind == "binary":
            return Look(
                {f"file {origin.path.name}": {"content": source_of(module, origin.path)[1]}}, {}
            )
        return self._source(module, origin.path, packages, root)

    def _source(self, module: str, path: Path, packages: frozenset[str], root: bool) -> Look:
        """Return what a module adds whose source is followed."""
        known = imported(module)
        summary = self._summary(module, path)
        follows = self._follows(packages)
        inner = Imports(
            module,
            path,
            lambda name: self._summary_of(name, packages),
            lambda name: self._origin(name, packages).kind,
        )
        free = {entry.removeprefix(FREE) for entry in summary.depends if entry.startswith(FREE)}
        imports = {
            name: used
            for name, used in inner.names(summary).items()
            if name.partition(".")[0] not in free
        }
        state, private, parts = "", holds_here_alone(module), {module: summary.definitions}
        changing: Mapping[str, str] = {}
        if known:
            loaded = LoadedState(
                sys.modules[module],
                summary.functions if compiled_as_written(module) else (),
                follows,
            )
            values = counted_values(sys.modules[module], summary, free, root)
            if (only := self._loaded) is not None:
                values = without_modules(
                    module, values, lambda name: follows(name) and name not in only
                )
            state = loaded.digest(values)
            parts[f"state of {module}"], changing = {"values": state}, loaded.changing
            for name in sorted(loaded.modules):
                imports.setdefault(name, set()).update(loaded.modules[name])
            if loaded.replaced and not private:
                private = True
                text = (
                    f"the loaded code of {loaded.replaced[0]}() is not that of {path}, so results"
                    " are not stored"
                )
                say_once(
                    module, f"{text}: restart Python, and delete __pycache__ if this is said again"
                )
        if summary.depends:
            declared = resolve(
                summary.depends, module, path, {}, lambda name: module_path(name) is not None
            )
            parts.update(declared.parts)
            imports.update({name: {""} for name in declared.modules})
            if declared.changed:
                private = True
                say_once(
                    module,
                    f"{path.parent / declared.changed[0]} was changed after the import of {path}:"
                    " restart",
                )
        return Look(parts, imports, summary, path, state, changing, private)

    def _follows(self, packages: frozenset[str]) -> Callable[[str], bool]:
        """Return the function that tells whether the source of a module is followed."""
        if packages not in self._followed:
            self._followed[packages] = functools.cache(
                lambda name: self._is_followed(name, packages)
            )
        return self._followed[packages]

    def _is_followed(self, module: str, packages: frozenset[str]) -> bool:
        outside = _decides_nothing(module) or f"{module}.".startswith(f"{_WORKFLOWS}.")
        # the module of the methods of a tuple
        nowhere = module.startswith("namedtuple_") and module not in sys.modules
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


#: several stores in one process parse a source once
_summarised = functools.lru_cache(1000)(summarise)


def _decides_nothing(module: str) -> bool:
    """Return True for a module that decides no result, such as the rules for the shapes of a
    family of nodes.
    """
    return module in _LEFT_OUT or (
        module.startswith(f"{ROOT}.") and module.endswith("._result_shapes")
    )


def _packages(module: str) -> frozenset[str]:
    """Return the packages that are followed by source though they are installed: that of a node,
    and this one.
    """
    return OURS | {module.partition(".")[0]}


# --- known keys -----------------------------------------------------------------------------------

# Cache keys of recipes that follow one another, such as the points of a sweep: most steps keep the
# key they had.


class _Known(NamedTuple):
    """The newest key of a step, with all that the key depends on."""

    step: Step
    beside: tuple[Any, ...]  #: seed, kind of the device and keys of the inputs
    key: Key
    origin: dict[str, Any]


class KnownKeys:
    """The newest cache key of each step; a key is computed again only if something that it depends
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
        beside = (seed, device_kind(device), *(keys[name] for name in step.sources))
        known = self._newest.get(step.name)
        if known is not None and known.beside == beside and _is_same(step, known.step):
            return known.key, known.origin
        key, origin = key_of(step, keys, seed, self.code, device)
        if known is not None and known.key == key:
            key = known.key  # the same object, which saves memory where many points keep their keys
        if not has_path(step.params):
            self._newest[step.name] = _Known(step, beside, key, origin)
        return key, origin


def _is_same(step: Step, other: Step) -> bool:
    """Return True if two steps of one name have the same node, inputs and parameters, to the
    sign of each zero.
    """
    if step is other:
        return True
    same = step.node is other.node and step.wires == other.wires and step.cached == other.cached
    same = same and step.params.keys() == other.params.keys()
    return same and all(_is_equal(value, other.params[name]) for name, value in step.params.items())


def _is_equal(one: Any, other: Any) -> bool:
    """Return True for the same object, and for numbers and words that are equal and written
    alike.
    """
    if one is other:
        return True
    return (
        type(one) is type(other) and isinstance(one, float | int | str) and repr(one) == repr(other)
    )
