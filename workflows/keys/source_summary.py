"""Summary of a source file: the digests of its definitions, its imports, and what it may change
elsewhere.
"""

from __future__ import annotations

import ast
import importlib.util
import marshal
import re
import sys
import threading
from collections import defaultdict
from collections.abc import Collection, Iterable, Iterator, Mapping, Sequence
from itertools import chain, filterfalse
from types import CodeType
from typing import NamedTuple

import xxhash

from neusee.workflows.keys.cache_key import digest
from neusee.workflows.keys.source_syntax import (
    Block,
    Kinds,
    NameScope,
    Syntax,
    each,
    last_name,
    reads_attributes_unnamed,
    roots,
    texts,
)
from neusee.workflows.keys.unfollowed_constructs import (
    Construct,
    constructs,
    facts,
    literal_import,
    moments,
    orders,
)

# --- code objects ---------------------------------------------------------------------------------

# Digests of compiled functions. They show whether the code that a process runs is the code of a
# source file.
#
# Line numbers, file names and docstrings of modules and classes do not count.


#: version and options of Python, on which the byte code of a source depends
PYTHON = (
    f"{'{}.{}'.format(*sys.version_info)}-{importlib.util.MAGIC_NUMBER.hex()}-{sys.flags.optimize}"
)
_MOST_DIGESTS = 20_000  #: greatest number of code objects whose digests are kept
_known: dict[int, tuple[CodeType, str]] = {}  #: code objects with their digests, by id
_CODE_DIGEST_DIGITS = 12  #: digits of the digest of a code object


def functions_of(source: bytes) -> list[str]:
    """Return the digest of each function in a source file, at any depth, in alphabetical order."""
    code = compile(source, "source", "exec", dont_inherit=True)
    return sorted({function_code(inner_code) for inner_code in _inner(code)})


def function_code(code: CodeType) -> str:
    """Return the digest of a code object with its name, its constants and its inner functions; a
    code object never changes.
    """
    digested = _known.get(id(code))
    if digested is None or digested[0] is not code:
        if len(_known) > _MOST_DIGESTS:
            _known.clear()
        digested = _known[id(code)] = code, _digest_of(code)
    return digested[1]


def _digest_of(code: CodeType) -> str:
    """Return the digest of a code object: byte code, constants, names and numbers of arguments, but
    not line numbers or file name.
    """
    constants = tuple(
        function_code(item) if isinstance(item, CodeType) else item for item in code.co_consts
    )
    names = (code.co_qualname, code.co_names, code.co_varnames, code.co_freevars, code.co_cellvars)
    sizes = (code.co_flags, code.co_argcount, code.co_posonlyargcount, code.co_kwonlyargcount)
    # marshal format 2 writes no references, which may differ between equal objects
    marshalled = marshal.dumps((code.co_code, constants, names, sizes, code.co_exceptiontable), 2)
    return xxhash.xxh3_64_hexdigest(marshalled)[:_CODE_DIGEST_DIGITS]


def _inner(code: CodeType) -> Iterator[CodeType]:
    """Yield the code objects of all functions and classes in a code object, at any depth."""
    code_left = [code]
    while code_left:
        for item in code_left.pop().co_consts:
            if isinstance(item, CodeType):
                yield item
                code_left.append(item)


# --- reachable code -------------------------------------------------------------------------------

# Statements of a module that a node may run: those that run at import, and those that define the
# names in use.


_QUIET = ("node", "pytest", "hypothesis", "functools", "staticmethod", "dataclass", "torch.no_grad")
_WRITERS = frozenset({"append", "add", "extend", "update", "insert", "appendleft", "clear"})
_DEFINITION = (ast.FunctionDef, ast.AsyncFunctionDef, ast.ClassDef)


class Statement(NamedTuple):
    """A statement at the top level of a module."""

    first: int
    last: int  #: lines
    binds: list[str]  #: names that it defines; empty for a statement that is run for its effect
    refers: list[str]  #: names that it reads, at any depth
    writes: list[str]  #: names whose object it changes, as in ``log.append(x)``


def statements(blocks: Iterable[Block]) -> list[Statement]:
    """Return the statements at the top level of a module."""
    return [_statement(block.item, block.kinds) for block in blocks]


def reached(parts: Sequence[Statement], names: Collection[str] | None) -> list[range]:
    """Return the lines of the statements that may run when some names are used; None stands for all
    names.
    """
    statements_run = parts
    if names is not None and "*" not in names:
        statements_run = _run_by(parts, _led_to(parts, set(names)))
    return [range(statement.first, statement.last + 1) for statement in statements_run]


def read_names(parts: Sequence[Statement], names: Collection[str]) -> set[str]:
    """Return the names that are read by the statements that may run when some names are used; an
    empty collection stands for all names.
    """
    given_names = set(names) or set(chain.from_iterable(statement.binds for statement in parts))
    return _led_to(parts, given_names)


def _led_to(parts: Sequence[Statement], names: set[str]) -> set[str]:
    """Return ``names`` and all names that the statements read that may run when these are used."""
    # repeated until no name is added
    while True:
        statements_run = _run_by(parts, names)
        names_with_read = names.union(*(statement.refers for statement in statements_run))
        if names_with_read == names:
            return names
        names = names_with_read


def _run_by(parts: Sequence[Statement], names: set[str]) -> list[Statement]:
    """Return the statements that define one of the names, and those that are run for their
    effect.
    """
    return [
        statement
        for statement in parts
        if not statement.binds or not names.isdisjoint(statement.binds)
    ]


def written_only(parts: Sequence[Statement]) -> set[str]:
    """Return the names of objects that a module changes but that none of its code reads, such as a
    log.
    """
    writes = chain.from_iterable(statement.writes for statement in parts)
    return set(writes).difference(*(statement.refers for statement in parts))


def _statement(item: ast.stmt, kinds: Kinds) -> Statement:
    """Return a top-level statement with its lines and the names that it defines, reads and
    changes.
    """
    decorators = getattr(item, "decorator_list", ())
    # decorators are on lines above the definition
    first_line = min([item.lineno, *(decorator.lineno for decorator in decorators)])
    ids_of_written = {id(name) for name in _noted(kinds)}
    names_loaded = [name for name in each(kinds, ast.Name) if isinstance(name.ctx, ast.Load)]
    refers = {name.id for name in names_loaded if id(name) not in ids_of_written}
    writes = {name.id for name in names_loaded if id(name) in ids_of_written}
    return Statement(
        first_line,
        item.end_lineno or item.lineno,
        sorted(_binds(item)),
        sorted(refers),
        sorted(writes),
    )


def _noted(kinds: Kinds) -> Iterator[ast.AST]:
    """Yield the name in ``name.append(x)`` and ``name[i] = x``, which change an object but do not
    read it.
    """
    for item in each(kinds, ast.Expr):
        method = item.value.func if isinstance(item.value, ast.Call) else None
        if isinstance(method, ast.Attribute) and method.attr in _WRITERS:
            yield method.value
    for item in each(kinds, ast.Assign):
        yield from (target.value for target in item.targets if isinstance(target, ast.Subscript))


def _binds(item: ast.stmt) -> Iterable[str]:
    """Return the names that a statement defines; none if the statement also does something else."""
    if isinstance(item, _DEFINITION):
        is_quiet = all(ast.unparse(mark).startswith(_QUIET) for mark in item.decorator_list)
        return {item.name} if is_quiet else set()
    targets = _targets(item)
    names = {target.id for target in targets if isinstance(target, ast.Name)}
    # another target, such as an attribute, is an effect
    return names if len(names) == len(targets) else set()


def _targets(item: ast.stmt) -> list[ast.expr]:
    """Return the expressions that a statement assigns to, such as the names on the left side."""
    if isinstance(item, ast.Assign):
        return item.targets
    target = getattr(item, "target", None)
    return [] if target is None else [target]


# --- outward code ---------------------------------------------------------------------------------

# Code that changes objects outside of its own module, or searches for them: patches, registries,
# subclasses, settings.
#
# A key covers imported code. Code in another file of the same recipe, which nobody imports, may
# change what the covered code computes: it sets an attribute of a module or a class, fills a
# registry, or derives a class. Such code is recognised by its form. In doubt it counts: a call
# whose value nobody uses presumably changes something.


#: packages whose functions change nothing but their arguments, except for functions whose name says
#: so
CALM = frozenset(
    {
        *(
            "torch",
            "numpy",
            "scipy",
            "math",
            "cmath",
            "functools",
            "itertools",
            "operator",
            "collections",
            "typing",
        ),
        *(
            "dataclasses",
            "enum",
            "abc",
            "contextlib",
            "re",
            "json",
            "copy",
            "statistics",
            "fractions",
            "numbers",
        ),
        *(
            "types",
            "pathlib",
            "typing_extensions",
            "pydantic",
            "neusee",
            "__future__",
            "builtins",
            "string",
            "os",
        ),
        *(
            "datetime",
            "textwrap",
            "struct",
            "heapq",
            "bisect",
            "inspect",
            "traceback",
            "kornia",
            "einops",
            "triton",
        ),
    }
)
#: functions that affect no result, or only a setting whose value is in each key
_QUIET_CALLS = (
    *(
        "warnings.warn",
        "warnings.catch_warnings",
        "logging",
        "print",
        "sys.path",
        "time.sleep",
        "matplotlib.use",
    ),
    *(
        "torch.manual_seed",
        "torch.set_num_threads",
        "torch.set_num_interop_threads",
        "torch.set_default_dtype",
    ),
    *("torch.set_default_device", "torch.set_float32_matmul_precision", "torch.set_flush_denormal"),
    *("torch.use_deterministic_algorithms", "ctypes.Structure", "ctypes.Union"),
)
_QUIET_DECORATORS = (
    *(
        "functools",
        "dataclasses",
        "contextlib",
        "typing",
        "abc",
        "enum",
        "typing_extensions",
        "pydantic",
        "types",
    ),
    *(
        "torch.no_grad",
        "torch.inference_mode",
        "torch.enable_grad",
        "torch.jit",
        "torch.compile",
        "numba",
        "triton",
    ),
    *("torch.autograd.function", "pytest", "warnings"),
)
_HOOK = re.compile(
    r"reference|preflight|check|\w+_bound|skip_\w+|\w+_error|propagate_\w+|band_invariant|\w+_range"
)
_SETTER = re.compile(
    r"(un|de)?register|(set|reset|enable|disable|patch|install|configure|use|seed|inject|override|add|define|impl)"
    r"(_|[A-Z])|(set|reset|patch|install|configure|use|seed|inject|override|define|impl)$|seterr|setattr|load_library|"
    r"putenv|unsetenv|chdir|umask"
)
_CHANGER = re.compile(r"(append|extend|insert|clear|pop|popitem|remove|discard|setdefault|update)$")
#: methods that change their object, in packages outside of `CALM`
_MUTATOR = re.compile(
    r"(add|push|train|eval|half|double|float|to|apply|load_state_dict|requires_grad|sort|reverse|fill|put|itemset|"
    r"resize|start|step|send|write)$|.*[^_]_$"
)
_SEEKS = frozenset(
    {
        "__subclasses__",
        "_getframe",
        "currentframe",
        "get_objects",
        "get_referrers",
        "registered_nodes",
    }
)
_DEFINITIONS = (ast.FunctionDef, ast.AsyncFunctionDef, ast.ClassDef, ast.Lambda)


class Reach(NamedTuple):
    """What the code of a module may change, or searches for, outside of the module."""

    #: full names of what it may change in other modules; an empty name stands for an unknown one
    outward: list[str]
    #: names from other modules that it passes to functions, which may change their arguments
    passed: list[str]
    unused: list[str]  #: modules that it imports but never names, so for the effect of the import
    inward: bool  #: True if its functions change objects of its own module
    changes_arguments: bool
    seeks: bool  #: True if it searches for classes and objects without naming them


NOWHERE = Reach([], [], [], False, False, False)


def reach_of(tree: ast.Module, bound: Mapping[str, str]) -> Reach:
    """Return what the code of a module may change or search for; ``bound`` maps each imported name
    to its full name, which begins with a dot for a relative import.
    """
    code_pass = _Pass(bound)
    code_pass.visit_all(tree.body, NameScope(tree, None))
    unnamed_imports = {
        full_name
        for name, full_name in bound.items()
        if name not in code_pass.named and not is_calm(full_name)
    }
    return Reach(
        sorted(code_pass.outward),
        sorted(code_pass.passed),
        sorted(unnamed_imports),
        code_pass.inward,
        code_pass.changes_arguments,
        code_pass.seeks,
    )


def outward_names(reaches: Collection[Reach]) -> set[str]:
    """Return the full names of what code may change in other modules, directly or through functions
    that it calls.
    """
    names = set(chain.from_iterable(reach.outward for reach in reaches))
    if any(reach.changes_arguments for reach in reaches):
        names.update(*(reach.passed for reach in reaches))
    return names


class _Pass:
    """A pass over the code of a module that collects the fields of its `Reach`."""

    def __init__(self, bound: Mapping[str, str]) -> None:
        self._bound = bound
        # names changed in other modules, names passed to functions, and all names that occur
        self.outward, self.passed, self.named = set[str](), set[str](), set[str]()
        self.inward = self.changes_arguments = self.seeks = False

    def visit_all(self, items: list[ast.stmt], scope: NameScope) -> None:
        for item in items:
            self._visit(item, scope)

    def _visit(self, item: ast.AST, scope: NameScope) -> None:
        """Note what a part of the code may change, and then visit its own parts."""
        if isinstance(item, _DEFINITIONS):
            self._definition(item, scope)
            # names inside a definition belong to its own scope
            scope = NameScope(item, scope)
        elif isinstance(item, ast.Call):
            self._call(item, scope, bare=False)
        elif isinstance(item, ast.Expr) and isinstance(item.value, ast.Call):
            self._call(item.value, scope, bare=True)
        elif isinstance(item, ast.Global):
            self.inward = True
        elif isinstance(item, ast.Attribute | ast.Name | ast.Subscript):
            self._name(item, scope)
        for child in ast.iter_child_nodes(item):
            self._visit(child, scope)

    # --- stores -----------------------------------------------------------------------------------

    def _name(self, item: ast.Attribute | ast.Name | ast.Subscript, scope: NameScope) -> None:
        """Note a name; note the object of an attribute or index expression that is set or
        deleted.
        """
        self.seeks |= last_name(item) in _SEEKS
        if isinstance(item, ast.Name):
            self.named.add(item.id)
        elif not isinstance(item.ctx, ast.Load):
            self._changed(item, scope)

    def _changed(self, item: ast.expr, scope: NameScope) -> None:
        """Note that the code sets or deletes ``item``, which is a part of an object."""
        for root in roots(item, scope, self._bound):
            if root.kind == "import":
                self.outward.add(root.name)
            elif root.kind == "argument":
                self.changes_arguments = True
            else:
                # statements at the top level of a module only build the module itself
                self.inward |= root.kind == "class" or not scope.is_module

    # --- calls ------------------------------------------------------------------------------------

    def _call(self, call: ast.Call, scope: NameScope, bare: bool) -> None:
        """Note what a call may change; ``bare``: no code uses its value, so the call presumably
        changes something.
        """
        function_name = last_name(call.func)
        if function_name in ("setattr", "delattr", "__setattr__", "__delattr__"):
            # the first argument is the object whose attribute is set
            for argument in call.args[:1]:
                self._changed(argument, scope)
        for root in roots(call.func, scope, self._bound):
            if root.kind == "import":
                self._imported_call(call, root.name, scope, bare)
            # a call such as f(x) may change its arguments
            elif isinstance(call.func, ast.Name):
                self.passed |= self._given(call, scope)
            # a call such as x.f() may change the object x; at the top level it only builds the
            # module
            elif root.kind in ("own", "class") and not scope.is_module:
                self.inward |= bare or _changes(function_name)

    def _imported_call(self, call: ast.Call, full: str, scope: NameScope, bare: bool) -> None:
        """Note the call of a function of another module if the call may change something."""
        function_name = last_name(call.func)
        # append the method's name for a method of the result of another call
        full_name = full if function_name in full.split(".") else f"{full}.{function_name}"
        passed_names = self._given(call, scope)
        if _is_quiet(full_name, call):
            return
        if is_calm(full):
            # by the convention of torch, a name that ends with "_" means that the argument is
            # changed
            if bare or function_name.endswith("_"):
                self.outward.update(filterfalse(is_calm, passed_names))
        else:
            self.passed |= passed_names
        if _changes_package(full_name, function_name, bare):
            self.outward.add(full_name)

    def _given(self, call: ast.Call, scope: NameScope) -> set[str]:
        """Return the names from other modules that a call gets as arguments, but not the results of
        functions of other modules.
        """
        names = set[str]()
        for argument in [*call.args, *(word.value for word in call.keywords)]:
            if not isinstance(argument, ast.Call):
                names |= self._imports(argument, scope)
        # "()" in a name stands for the result of a call
        return {name for name in names if "()" not in name}

    def _imports(self, item: ast.expr, scope: NameScope) -> set[str]:
        """Return the full names of the objects of other modules that an expression is part of."""
        return {root.name for root in roots(item, scope, self._bound) if root.kind == "import"}

    # --- definitions ------------------------------------------------------------------------------

    def _definition(self, item: ast.AST, scope: NameScope) -> None:
        """Note decorators and base classes from other modules: both may register the function or
        class.
        """
        for mark in getattr(item, "decorator_list", ()):
            decorator = mark.func if isinstance(mark, ast.Call) else mark
            imports = self._imports(decorator, scope)
            self.outward.update(filterfalse(_is_quiet_decorator, imports))
        if isinstance(item, ast.ClassDef):
            # keywords of a class, such as the metaclass, too
            for base in [*item.bases, *(word.value for word in item.keywords)]:
                imports = self._imports(base, scope)
                self.outward.update(filterfalse(_is_quiet_base, imports))


def is_calm(name: str) -> bool:
    """Return True for a name from a package whose functions change nothing but their arguments."""
    return name.partition(".")[0] in CALM


def _changes_package(name: str, method: str, bare: bool) -> bool:
    """Return True for a call that may change the package of the called function, given by its full
    name.
    """
    if not is_calm(name):
        return bare or _changes(method)
    return name.startswith("torch.library.") or (bare and _is_setter(method))


def _is_setter(method: str) -> bool:
    """Return True for the name of a function that sets, registers or adds something."""
    return bool(_SETTER.match(method) or _CHANGER.match(method))


def _changes(method: str) -> bool:
    """Return True for the name of a method that changes its object."""
    return any(words.match(method) for words in (_SETTER, _CHANGER, _MUTATOR))


def _is_quiet_decorator(name: str) -> bool:
    """Return True for a decorator that registers nothing. Decorators that add a hook to a node of
    neusee do change that node.
    """
    if name.startswith("neusee."):
        return not _HOOK.fullmatch(name.rpartition(".")[2])
    return _starts(name, _QUIET_DECORATORS)


def _is_quiet_base(name: str) -> bool:
    """Return True for a class that keeps no register of its subclasses."""
    return is_calm(name) or _starts(name, _QUIET_CALLS)


def _is_quiet(name: str, call: ast.Call) -> bool:
    """Return True for a function that affects no result, such as one that suppresses warnings."""
    if name in ("warnings.filterwarnings", "warnings.simplefilter"):
        action = call.args[0] if call.args else None
        return isinstance(action, ast.Constant) and action.value in ("ignore", "once", "default")
    return _starts(name, _QUIET_CALLS)


def _starts(name: str, entries: tuple[str, ...]) -> bool:
    """Return True if a full name is one of the entries, or lies inside one of them."""
    return any(f"{name}.".startswith(f"{entry}.") for entry in entries)


# --- source summary -------------------------------------------------------------------------------

# Summary of a source file: the digests of the file and of its definitions, its imports, and the
# constructs that cannot be followed.


ROOT = "neusee.nodes"
#: lock around the parser: that of Python 3.11 miscounts the depth if two threads parse
_parsing = threading.Lock()
_READS = ("__doc__", "getdoc", "cleandoc", "getcomments")  #: names by which code reads docstrings
_DEFINITION_DIGEST_DIGITS = 16  #: digits of the digest of a definition
#: packages whose attribute expressions are not noted
_LARGE = frozenset({"torch", "numpy", "scipy", *sys.stdlib_module_names})

#: level of a relative import (0 if absolute), module, name (empty for ``import module``)
Import = tuple[int, str, str]
#: use of an imported name: its import, the attributes after the name, the line
Use = tuple[int, str, str, str, int]


class Summary(NamedTuple):
    """Summary of the source of a module, for cache keys and for reports of changed code."""

    tree: str  #: digest of the syntax tree without docstrings
    whole: str  #: digest of the syntax tree with docstrings
    documents: bool  #: True if the code reads docstrings
    imports: list[Import]
    binds: list[str]  #: names bound by the imports
    uses: list[Use]
    #: digest by label: ``psf()``, ``class Psf``, ``constant _FALL``, ``imports``
    definitions: dict[str, str]
    functions: list[str]  #: digests of the compiled functions
    constructs: list[Construct]
    statements: list[Statement]
    depends: list[str]  #: the entries of ``__depends__``
    reach: Reach  #: of the code of a user


def summarise(source: bytes, own: bool = False) -> Summary:
    """Return the summary of a source file; comments, layout and docstrings do not affect the
    digests.

    With ``own``, constructs that matter only in code of the user are searched for too.
    """
    # one thread at a time
    with _parsing:
        syntax_tree = ast.parse(source)
        functions = functions_of(source)
    tree = Syntax(syntax_tree)
    syntax_digest = _digest_of_syntax(tree)
    imports, imports_by_name = _imports(tree.all)
    names = _full_names(imports_by_name)
    unfollowed_constructs, reach = constructs(tree, names), NOWHERE
    # constructs that matter only in code of a user
    if own:
        unfollowed_constructs = _with_constructs_of_users(
            unfollowed_constructs, syntax_tree, tree, names
        )
        reach = reach_of(
            syntax_tree,
            {name: _full(import_forms) for name, import_forms in imports_by_name.items()},
        )
    return Summary(
        tree=syntax_digest,
        # used instead of ``tree`` if any code reads docstrings
        whole=digest(syntax_digest, tree.documents),
        documents=_reads_docstrings(tree.all, own) or _reads_docstrings(tree.not_run, own),
        imports=[*imports, *_literal_imports(tree.all, names)],
        binds=_names_from_modules(imports_by_name),
        uses=_uses(tree.all, imports_by_name),
        definitions=_definitions(tree.texts),
        functions=functions,
        constructs=unfollowed_constructs,
        statements=statements(tree.blocks),
        depends=[*chain.from_iterable(_declared(item) for item, _ in tree.texts)],
        reach=reach,
    )


def _names_from_modules(bound: Mapping[str, set[Import]]) -> list[str]:
    """Return the names that statements such as ``from module import name`` bind."""
    return sorted(
        name
        for name, import_forms in bound.items()
        if any(import_form[2] for import_form in import_forms)
    )


def _full_names(bound: Mapping[str, set[Import]]) -> dict[str, str]:
    """Return the full name of each name that an absolute import binds."""
    names: dict[str, str] = {}
    for name, import_forms in bound.items():
        for import_form in sorted(import_forms):
            # level 0: an absolute import
            if not import_form[0]:
                names[name] = ".".join(filter(None, import_form[1:]))
    return names


def syntax_outline(source: bytes) -> tuple[str, list[tuple[str, list[str]]]]:
    """Return the digest of the syntax tree of a source file, and the import statements at its top
    level.

    No comment, layout or docstring affects the digest. An import statement is the module in ``from
    a import b, c`` with the names, or an empty text with the modules of ``import a, b``.
    """
    with _parsing:
        tree = ast.parse(source)
    imports: list[tuple[str, list[str]]] = []
    for item in tree.body:
        if isinstance(item, ast.Import | ast.ImportFrom):
            module = getattr(item, "module", "") or ""
            imports.append((module, [alias.name for alias in item.names]))
    return _digest_of_syntax(Syntax(tree)), imports


def _digest_of_syntax(tree: Syntax) -> str:
    """Return the digest of a syntax tree without docstrings."""
    return digest([text for _, text in tree.texts])


def _imports(kinds: Kinds) -> tuple[list[Import], dict[str, set[Import]]]:
    """Return the imports of a module, and the import of each name that an import binds."""
    imports: list[Import] = []
    bound: dict[str, set[Import]] = defaultdict(set)
    for item in each(kinds, ast.Import):
        for alias in item.names:
            imports.append((0, alias.name, ""))
            # `import a.b` binds a, `import a.b as c` binds c to a.b
            module_name = alias.name if alias.asname else _top(alias.name)
            bound[alias.asname or module_name].add((0, module_name, ""))
    for item in each(kinds, ast.ImportFrom):
        for alias in item.names:
            import_form = (item.level, item.module or "", alias.name)
            imports.append(import_form)
            bound[alias.asname or alias.name].add(import_form)
    return list(dict.fromkeys(imports)), bound


def _literal_imports(kinds: Kinds, names: Mapping[str, str]) -> Iterator[Import]:
    """Yield the imports in calls such as ``import_module("a.b")``."""
    for call in each(kinds, ast.Call):
        module = literal_import(call, names)
        if module:
            name_without_dots = module.lstrip(".")
            # the number of leading dots is the level
            yield len(module) - len(name_without_dots), name_without_dots, ""


def _with_constructs_of_users(
    usual: list[Construct], parsed: ast.Module, tree: Syntax, names: Mapping[str, str]
) -> list[Construct]:
    """Return the constructs that cannot be followed, including those that matter only in code of a
    user.
    """
    usual_places = {(item.line, item.text.rpartition(".")[2]) for item in usual}
    of_users = [*facts(tree.all, names), *moments(tree.all, names)]
    further = [
        item for item in of_users if (item.line, item.text.rpartition(".")[2]) not in usual_places
    ]
    return sorted({*usual, *orders(parsed), *further}, key=lambda item: (item.line, item))


def _reads_docstrings(kinds: Kinds, own: bool) -> bool:
    """Return True for code that reads a docstring as data; in the user's ``own`` code also if it
    reads attributes whose names it does not spell out.
    """
    if own and (reads_attributes_unnamed(kinds) or _spells_docstring(kinds)):
        return True
    as_attribute = any(item.attr in _READS for item in each(kinds, ast.Attribute))
    as_name = any(
        # `__doc__` and `getdoc`, read as plain names
        item.id in _READS[:2] and isinstance(item.ctx, ast.Load)
        for item in each(kinds, ast.Name)
    )
    return (
        as_attribute
        or as_name
        or any(item.value == "__doc__" for item in each(kinds, ast.Constant))
    )


def _spells_docstring(kinds: Kinds) -> bool:
    """Return True if a text of the code has the word ``__doc__`` in it."""
    return any("__doc__" in text for text, _ in texts(kinds))


def _declared(item: ast.stmt) -> list[str]:
    """Return the entries of ``__depends__ = ("table.csv", "env:NAME")``."""
    # only an assignment to ``__depends__`` has entries
    if not isinstance(item, ast.Assign) or "__depends__" not in [
        getattr(name, "id", "") for name in item.targets
    ]:
        return []
    try:
        entries = ast.literal_eval(item.value)
    except ValueError:
        entries = None
    if not isinstance(entries, tuple | list) or not all(
        isinstance(entry, str) for entry in entries
    ):
        raise ValueError(
            f"line {item.lineno}: __depends__ must be a tuple of texts, not"
            f" {ast.unparse(item.value)[:60]}"
        )
    return list(entries)


def _full(ways: set[Import]) -> str:
    """Return the full name that an import binds, with the leading dots of a relative import."""
    level, *names = min(ways)
    return "." * level + ".".join(filter(None, names))


def _chained(way: Import) -> bool:
    """Return True for an import whose attributes may name a module that is followed by source."""
    return bool(way[0]) or _top(way[1]) not in _LARGE


def _top(module: str) -> str:
    """Return the top-level package of a module."""
    return module.partition(".")[0]


def _uses(kinds: Kinds, bound: dict[str, set[Import]]) -> list[Use]:
    """Return each use of an imported name in an expression such as ``a.b.c``, and each use of a
    whole package.
    """
    followed_imports = {
        name: set(filter(_chained, import_forms)) for name, import_forms in bound.items()
    }
    first_lines: dict[tuple[int, str, str, str], int] = {}
    for name, attributes, line in _chains(kinds):
        for import_form in followed_imports.get(name, ()):
            if attributes or ".".join(filter(None, import_form[1:])) in ("neusee", ROOT, "nodes"):
                use = (*import_form, ".".join(attributes))
                first_lines[use] = min(line, first_lines.get(use, line))
    return sorted((*use, line) for use, line in first_lines.items())


def _chains(kinds: Kinds) -> Iterator[tuple[str, list[str], int]]:
    """Yield the first name, the attributes and the line number of each expression such as
    ``a.b.c`` in a module.
    """
    # each expression comes before its parts, so the parts of earlier ones are skipped
    ids_of_parts: set[int] = set()
    for item in each(kinds, ast.Attribute, ast.Name):
        if id(item) in ids_of_parts:
            continue
        expression: ast.expr = item
        attributes: list[str] = []
        # walk from the last attribute to the first name
        while isinstance(expression, ast.Attribute):
            attributes.append(expression.attr)
            ids_of_parts.add(id(expression.value))
            expression = expression.value
        if isinstance(expression, ast.Name) and (
            attributes or isinstance(expression.ctx, ast.Load)
        ):
            yield expression.id, attributes[::-1], item.lineno


def _definitions(texts: Iterable[tuple[ast.stmt, str]]) -> dict[str, str]:
    """Return the digest of each top-level definition of a module, by labels such as ``psf()`` or
    ``class Psf``.

    Definitions with the same label share one digest.
    """
    texts_by_label: dict[str, list[str]] = defaultdict(list)
    for item, text in texts:
        for label in _labels(item):
            texts_by_label[label].append(text)
    return {
        label: digest(parts)[:_DEFINITION_DIGEST_DIGITS] for label, parts in texts_by_label.items()
    }


def _labels(item: ast.stmt) -> Iterable[str]:
    """Return the labels of the definitions in a top-level statement, such as ``psf()`` or
    ``constant _FALL``.
    """
    if isinstance(item, ast.FunctionDef | ast.AsyncFunctionDef):
        return [f"{_owner(item)}()"]
    if isinstance(item, ast.ClassDef):
        return [f"class {item.name}"]
    if isinstance(item, ast.Import | ast.ImportFrom):
        return ["imports"]
    target_parts = chain.from_iterable(map(ast.walk, _targets(item)))
    names = [target_part.id for target_part in target_parts if isinstance(target_part, ast.Name)]
    return [f"constant {name}" for name in names] or ["other statements"]


def _owner(function: ast.FunctionDef | ast.AsyncFunctionDef) -> str:
    """Return the name of a function, or ``psf.check`` for a function ``_`` with the decorator
    ``@psf.check``.
    """
    decorators = function.decorator_list if function.name == "_" else []
    for decorator in decorators:
        if isinstance(decorator, ast.Attribute) and isinstance(decorator.value, ast.Name):
            return f"{decorator.value.id}.{decorator.attr}"
    return function.name
