"""Answers of nodes that an earlier process wrote down, so that a recipe is checked without torch.

A check asks a node for its signature, for the notes of its own check, and for the known form of its
result. All three depend on the code of the nodes, the parameters and the known forms of the inputs
alone. They are kept in the file ``checks.json`` of the cache, under a digest of this code. Where an
answer is missing, the recipe is checked with the nodes themselves, and the answers are written down
then. Nodes of a user and blocks that import code are never answered from the file.
"""

from __future__ import annotations

import functools
import hashlib
import json
import os
import sys
import time
import warnings
from collections import namedtuple
from collections.abc import Collection, Iterable, Iterator, Mapping, Sequence
from contextlib import contextmanager
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Any

import neusee.nodes
from neusee.nodes import Node, ParameterError, input_files
from neusee.workflows.graph.errors import RecipeError
from neusee.workflows.graph.recipe_graph import Recipe, Step, ordered
from neusee.workflows.graph.step_shapes import Form, TensorForm, has_path, inputs_of, is_tensor
from neusee.workflows.keys.cache_key import files_in, is_own, plain
from neusee.workflows.keys.sealed_files import bytes_of, seal_file, unseal_file, write_shared
from neusee.workflows.recipe.asked_nodes import THEMSELVES, AskedNodes
from neusee.workflows.recipe.loading import load_with
from neusee.workflows.recipe.node_families import (
    Own,
    all_nodes,
    are_installed,
    find_node,
    why_no_node,
)
from neusee.workflows.recipe.remembered_nodes import (
    NotRemembered,
    RememberedNode,
    looked_up_parameters,
    signature_of,
)
from neusee.workflows.recipe.step_checks import CheckedStep
from neusee.workflows.recipe.text.recipe_files import is_strange

# --- file of answers ------------------------------------------------------------------------------

NAME = "checks.json"
_MOST_BYTES = 16 << 20  #: greatest size of the file
_MOST_ANSWERS = 4000  #: the newest are kept
_SETTLED = 2_000_000_000  #: ns before the start of a check in which its modules may be imported
_SITES = ("site-packages", "dist-packages")  #: names of folders of installed packages
#: folders of the package whose files decide the answers
_DECISIVE = ("nodes", "workflows/graph", "workflows/recipe")


@dataclass
class Answers:
    """The content of the file: signatures by family and node, and answers by question."""

    edition: str  #: digest of the code that gives the answers
    signatures: dict[str, dict[str, Any]] = field(default_factory=dict)
    by_question: dict[str, Any] = field(default_factory=dict)

    @classmethod
    def read(cls, path: Path, edition: str) -> Answers:
        """Return the content of the file, or nothing of a file that is missing, damaged, of another
        edition or without the required signature.
        """
        try:
            seal, _, content = bytes_of(path, _MOST_BYTES).partition(b"\n")
            document = json.loads(unseal_file("checks", f"{NAME} {edition}", seal, content))
            return cls(edition, dict(document["signatures"]), dict(document["answers"]))
        except (OSError, ValueError, TypeError, KeyError, RecursionError):
            return cls(edition)

    def write(self, path: Path) -> None:
        """Write the file, unless the folder of the cache is missing or cannot be written."""
        if not path.parent.is_dir():
            return
        newest = dict(list(self.by_question.items())[-_MOST_ANSWERS:])
        document = {"signatures": self.signatures, "answers": newest}
        content = json.dumps(document, separators=(",", ":")).encode()
        seal = seal_file("checks", f"{NAME} {self.edition}", content)
        write_shared(path, b"\n".join([seal, content]), path.parent / "tmp")


def edition_of_code(began: int) -> str | None:
    """Return the digest of the code on which all answers depend; None if it may have changed since
    its import.

    The content of every source file counts, and the versions of the installed packages. ``began``
    is the time (ns) at which the process began to check.
    """
    hasher = hashlib.blake2b(digest_size=16)
    root = Path(neusee.nodes.__file__).parents[1]
    for path in _source_files([root / folder for folder in _DECISIVE]):
        with open(path, "rb") as file:
            stat, content = os.fstat(file.fileno()), file.read()
        if max(stat.st_mtime_ns, stat.st_ctime_ns) > began - _SETTLED:
            return None
        hasher.update(b"%s\0%d\0" % (os.fsencode(os.path.relpath(path, root)), len(content)))
        hasher.update(content)
    sites = [folder for folder in sys.path if os.path.basename(folder) in _SITES]
    installed = [sorted(filter(_is_version, os.listdir(folder))) for folder in sites]
    hasher.update(repr([sys.version, sys.flags.optimize, installed, is_strange()]).encode())
    return hasher.hexdigest()


def _source_files(folders: Iterable[Path]) -> Iterator[str]:
    """Yield the paths of all files below some folders, sorted, without byte code."""
    for top in folders:
        for folder, subfolders, files in os.walk(top):
            subfolders[:] = sorted(name for name in subfolders if name != "__pycache__")
            yield from (os.path.join(folder, name) for name in sorted(files))


def _is_version(name: str) -> bool:
    """Return True for a folder that states the version of an installed package in its name."""
    return name.endswith(".dist-info")


# --- questions ------------------------------------------------------------------------------------

# A question has a name: the digest of what decides the answer. Forms of inputs stand in it as JSON
# texts, with the digest of the values of a small tensor.


@dataclass
class Questions:
    """The names of questions; texts of parameters and forms are made once for each object."""

    _params: dict[int, tuple[Step, str | None]] = field(default_factory=dict)
    #: the object beside its text keeps its identity from being used again
    _forms: dict[int, tuple[Form, str | None]] = field(default_factory=dict)

    def name(self, kind: str, step: Step, forms: Iterable[Form]) -> str | None:
        """Return the name of a question to the node of a step, or None if it cannot be stated."""
        if is_own(step.node.fn.__module__):
            return None
        texts = [self._params_text(step), *map(self.text, forms)]
        if any(text is None for text in texts):
            return None
        return _digest(kind, step.node.path, *(str(text) for text in texts))

    def text(self, form: Form) -> str | None:
        """Return a form as a JSON text, or None for one that JSON cannot describe."""
        if form is None:
            return "null"
        if type(form) is list:  # made anew for each question
            texts = [self.text(item) for item in form]
            return None if None in texts else f"[{', '.join(map(str, texts))}]"
        if id(form) not in self._forms:
            try:
                text = json.dumps(_described(form))
            except (TypeError, ValueError):
                text = None
            self._forms[id(form)] = (form, text)
        return self._forms[id(form)][1]

    def note_form(self, form: Form, said: Any) -> None:
        """Take note of a form that was read from JSON."""
        self._forms[id(form)] = (form, json.dumps(said))

    def _params_text(self, step: Step) -> str | None:
        """Return the parameters of a step as a JSON text: a file by its path and its content."""
        if id(step) not in self._params:
            try:
                paths = [os.path.abspath(path) for path in files_in(step.params)]
                values = {name: plain(value) for name, value in step.params.items()}
                text = json.dumps([values, paths])
            except (OSError, TypeError, ValueError):
                text = None
            self._params[id(step)] = (step, text)
        return self._params[id(step)][1]


def _digest(*texts: str) -> str:
    return hashlib.blake2b("\0".join(texts).encode(), digest_size=12).hexdigest()


def _described(form: Form) -> Any:
    """Return a form as JSON; raise TypeError for one that JSON cannot describe."""
    if is_tensor(form):
        values = (
            "" if form.is_meta else hashlib.blake2b(_bytes_of(form), digest_size=12).hexdigest()
        )
        return ["tensor", tuple(form.shape), str(form.dtype), form.element_size(), values]
    if isinstance(form, tuple) and hasattr(form, "_fields"):
        kind = f"{type(form).__module__}:{type(form).__name__}"
        return ["fields", kind, form._fields, [*map(_described, form)]]
    if type(form) in (list, tuple):
        return [type(form).__name__, *map(_described, form)]
    if form is None or type(form) in (bool, int, float, str):
        return ["value", form]
    raise TypeError


def _bytes_of(tensor: Any) -> bytes:
    values: bytes = tensor.detach().cpu().numpy().tobytes()
    return values


@functools.cache
def _fields_class(fields: tuple[str, ...]) -> Any:
    """Return the class of the forms of named tuples with these fields."""
    return namedtuple("FieldsForm", fields)


def _form_of(said: Any) -> Form:
    """Return the form that `_described` has written; raise `NotRemembered` for anything else."""
    match said:
        case ["tensor", [*shape], str(dtype), int(bytes_each), str(values)] if _are_sizes(shape):
            return TensorForm(tuple(shape), dtype, bytes_each, values)
        case ["fields", str(), [*names], [*items]] if len(names) == len(items):
            return _fields_class(tuple(map(str, names)))(*map(_form_of, items))
        case ["tuple", *items]:
            return tuple(map(_form_of, items))
        case ["list", *items]:
            return [*map(_form_of, items)]
        case ["value", value]:
            return value
    raise NotRemembered("the form is written in another way")


def _are_sizes(shape: list[Any]) -> bool:
    return all(isinstance(size, int) for size in shape)


# --- answers of an earlier process ----------------------------------------------------------------


class RememberedNodes(AskedNodes):
    """The answers that an earlier process wrote down; `NotRemembered` is raised without one."""

    reuses_checks = are_imported = False

    def __init__(self, answers: Answers) -> None:
        self._answers, self._questions = answers, Questions()
        self._nodes: dict[str, RememberedNode] = {}

    def refuse_code_of(self, keys: Collection[str | int]) -> None:
        if keys:
            raise NotRemembered("a block of the recipe imports code")

    def find(self, name: str, own: Own) -> Node:
        if not self._answers.signatures:
            raise NotRemembered("no signatures")
        if name not in self._nodes:
            self._nodes[name] = self._node(name, own)
        return self._nodes[name]

    def _node(self, name: str, own: Own) -> RememberedNode:
        family, _, attribute = name.partition(".")
        signatures = self._answers.signatures
        of_family = signatures.get(family, {})
        if attribute not in of_family:
            if are_installed():
                raise NotRemembered("families of installed packages are not remembered")
            all_names = list[str]()
            for other, nodes in signatures.items():
                all_names += [f"{other}.{node}" for node in nodes]
            raise LookupError(why_no_node(name, of_family, own, all_names))
        try:
            return RememberedNode(name, of_family[attribute], self._value)
        except Exception as error:  # a node without a signature, or a forged one
            raise NotRemembered(f"{name} has no signature that can be read") from error

    def _value(self, node: str, parameter: str, given: Any) -> Any:
        """Return the value that another process read of a parameter."""
        return self._answer(_value_question(node, parameter, given))

    def _answer(self, question: str | None) -> Any:
        if question is None or question not in self._answers.by_question:
            raise NotRemembered("a question is new")
        return self._answers.by_question[question]

    def notes(self, step: Step, forms: Mapping[str, Form]) -> Sequence[str]:
        question = self._questions.name("notes", step, forms.values())
        match self._answer(question):
            case ["notes", *notes]:
                return [str(note) for note in notes]
            case ["parameter", str(parameter), str(message)]:
                raise ParameterError(parameter, message)
            case ["value", str(message)]:
                raise ValueError(message)
        raise NotRemembered("the answer has another form")

    def form(self, step: Step, inputs: Sequence[Form]) -> Form:
        if step.node.hooks.shape is None and not step.node.before_run:
            return None
        match self._answer(self._questions.name("form", step, inputs)):
            case ["form", None]:
                return None
            case ["form", said]:
                form = _form_of(said)
                self._questions.note_form(form, said)
                return form
            case ["overflow", str(message)]:
                raise OverflowError(message)
            case ["value", str(message)]:
                raise ValueError(message)
        raise NotRemembered("the answer has another form")


def _is_taken_as_written(given: Any, read: Any) -> bool:
    """Return True for a single value of a recipe that a node takes as it is."""
    is_single = type(given) in (bool, int, float, str, type(None))
    return is_single and type(read) is type(given) and bool(read == given)


def _value_question(node: str, parameter: str, given: Any) -> str | None:
    """Return the name of the question how a parameter is read."""
    try:
        return _digest("value", node, parameter, json.dumps(given))
    except (TypeError, ValueError):
        return None


@contextmanager
def _asked_for_memory() -> Iterator[list[bool]]:
    """Yield a list that is empty as long as no reader of a file has asked for the free memory."""
    asked: list[bool] = []
    measure = input_files._measures[-1]

    def noted() -> input_files.Room:
        asked.append(True)
        return measure()

    input_files.measured_by(noted)
    try:
        yield asked
    finally:
        input_files.measured_by(measure)


# --- answers of this process ----------------------------------------------------------------------


class RecordedNodes(AskedNodes):
    """The nodes themselves, whose answers are written down."""

    reuses_checks = False

    def __init__(self, answers: Answers) -> None:
        self.answers, self._questions = answers, Questions()
        self._is_recording, self.is_new = True, False
        self._large_files = set[Path]()
        #: found in this process, by question
        self._notes: dict[str, Sequence[str]] = {}
        self._forms: dict[str, Form] = {}

    def refuse_code_of(self, keys: Collection[str | int]) -> None:
        self._is_recording = not keys

    def find(self, name: str, own: Own) -> Node:
        return find_node(name, own)

    def note_values(self, node: Node, given: Mapping[str, Any], read: Mapping[str, Any]) -> None:
        if is_own(node.fn.__module__):
            return
        for name in looked_up_parameters(node):
            if name in given and _is_taken_as_written(given[name], read[name]):
                self._record(_value_question(node.path, name, given[name]), read[name])

    def notes(self, step: Step, forms: Mapping[str, Form]) -> Sequence[str]:
        if step.node.hooks.preflight is None:
            return ()
        question = self._questions.name("notes", step, forms.values())
        if question is not None and question in self._notes:
            return self._notes[question]
        try:
            with self._recording(step) as record:
                notes = super().notes(step, forms)
                record(question, ["notes", *notes])
            if question is not None:
                self._notes[question] = notes
            return notes
        except ParameterError as error:
            self._record_mistake(question, step, ["parameter", error.parameter, str(error)])
            raise
        except ValueError as error:
            self._record_mistake(question, step, ["value", str(error)])
            raise

    def form(self, step: Step, inputs: Sequence[Form]) -> Form:
        if step.node.hooks.shape is None and not step.node.before_run:
            return super().form(step, inputs)
        question = self._questions.name("form", step, inputs)
        if question is not None and question in self._forms:
            return self._forms[question]
        try:
            form = self._new_form(question, step, inputs)
        except OverflowError as error:
            self._record_mistake(question, step, ["overflow", str(error)])
            raise
        except ValueError as error:
            self._record_mistake(question, step, ["value", str(error)])
            raise
        if question is not None:
            self._forms[question] = form
        return form

    def _new_form(self, question: str | None, step: Step, inputs: Sequence[Form]) -> Form:
        """Return the form of a result that this process has not asked for yet."""
        with self._recording(step) as record:
            form = super().form(step, inputs)
            text = self._questions.text(form)
            # a form may be unknown because a file could not be read
            if text is not None and (form is not None or not has_path(step.params)):
                record(question, ["form", json.loads(text)])
        return form

    def _record_mistake(self, question: str | None, step: Step, answer: Any) -> None:
        """Record a mistake, unless a file or the memory of the machine may be its cause."""
        if not has_path(step.params):
            self._record(question, answer)

    @contextmanager
    def _recording(self, step: Step) -> Iterator[Any]:
        """Yield the function that records an answer, which is not kept if there was a warning.

        It is not kept either if a file is so large that the free memory decided whether it is read.
        """
        noted: list[tuple[str | None, Any]] = []
        files = set(files_in(step.params))
        with warnings.catch_warnings(record=True) as caught, _asked_for_memory() as measured:
            warnings.simplefilter("always")
            yield lambda question, answer: noted.append((question, answer))
        for warning in caught:
            warnings.warn_explicit(
                warning.message, warning.category, warning.filename, warning.lineno
            )
        # a process may keep a file that it has read, and does not ask again
        self._large_files |= files if measured else set()
        is_kept = not caught and self._large_files.isdisjoint(files)
        for question, answer in noted if is_kept else ():
            self._record(question, answer)

    def _record(self, question: str | None, answer: Any) -> None:
        if self._is_recording and question is not None:
            self.is_new |= question not in self.answers.by_question
            # the newest stand last
            self.answers.by_question.pop(question, None)
            self.answers.by_question[question] = answer

    def learn(self, checked: Iterable[CheckedStep]) -> None:
        """Ask also what the nodes say where a mistake leaves some of their inputs unknown.

        One wrong value is a mistake in each step that reads it, and the steps after these know less
        of their inputs then. So the next mistake in this recipe is found without the nodes.
        """
        by_name = {candidate.step.name: candidate for candidate in checked}
        steps = {name: candidate.step for name, candidate in by_name.items()}
        if not self._is_recording or not self.is_new or _are_of_user(steps.values()):
            return
        order = ordered({name: step.sources for name, step in steps.items()}, steps)
        forms: dict[str, Form] = {}
        for name in order:
            forms[name] = self._asked(steps[name], forms)
        for absent in dict.fromkeys(_with_one_mistake(by_name.values())):
            self._learn_without(absent, [steps[name] for name in order], forms)

    def _learn_without(
        self, absent: frozenset[str], steps: Sequence[Step], usual: Mapping[str, Form]
    ) -> None:
        """Ask the steps that follow steps without a result, one after another."""
        forms = {name: form for name, form in usual.items() if name not in absent}
        changed = set(absent)
        for step in steps:
            if step.name in absent or changed.isdisjoint(step.sources):
                continue
            forms[step.name] = form = self._asked(step, forms)
            if self._questions.text(form) != self._questions.text(usual[step.name]):
                changed.add(step.name)

    def _asked(self, step: Step, forms: Mapping[str, Form]) -> Form:
        """Ask a step for its notes and its form, and return the form; None after a mistake."""
        inputs = inputs_of(step, forms)
        by_input = dict(zip(step.node.inputs, inputs, strict=True))
        checked_forms = {name: by_input[name] for name in step.node.preflight_inputs}
        try:
            self.notes(step, checked_forms)
            return self.form(step, inputs)
        except (ValueError, OSError, OverflowError):
            return None


def _are_of_user(steps: Iterable[Step]) -> bool:
    """Return True if one of the steps has a node of a user."""
    return any(is_own(step.node.fn.__module__) for step in steps)


def _with_one_mistake(checked: Iterable[CheckedStep]) -> Iterator[frozenset[str]]:
    """Yield the steps that one mistake would spoil: all copies of a step, or all steps that read
    one value of the recipe.
    """
    readers: dict[tuple[str | int, ...], set[str]] = {}
    for candidate in checked:
        name = candidate.step.name
        readers.setdefault((name.partition("[")[0],), set()).add(name)
        for value in candidate.params.items.values():
            readers.setdefault(value.path, set()).add(name)
    yield from map(frozenset, readers.values())


# --- check of a recipe ----------------------------------------------------------------------------


def load(
    cache: Path | None, name: str, changes: Sequence[str], first: int = 1
) -> tuple[Recipe, bool]:
    """Return a recipe as `loading.load` does, and True if its nodes were not imported for that.

    ``cache`` is the folder with the file of answers, or None if there is no folder.
    """
    # with torch, the nodes themselves answer as fast
    edition = None if cache is None or "torch" in sys.modules else edition_of_code(time.time_ns())
    if cache is None or edition is None:
        return load_with(THEMSELVES, name, changes, Path().absolute(), first), False
    return load_from(cache / NAME, edition, name, changes, first)


def load_from(
    path: Path, edition: str, name: str, changes: Sequence[str], first: int = 1
) -> tuple[Recipe, bool]:
    """Return a recipe as `load` does, with the answers in a file; new answers are added to it."""
    folder, began = Path().absolute(), time.time_ns()
    answers = Answers.read(path, edition)
    try:
        return load_with(RememberedNodes(answers), name, changes, folder, first), True
    except RecipeError:
        raise
    except Exception:  # something is new, or the file is forged: the nodes themselves decide
        answers = Answers.read(path, edition)
    nodes = RecordedNodes(answers)
    try:
        return load_with(nodes, name, changes, folder, first), False
    finally:
        _keep(nodes, path, began)


def _keep(nodes: RecordedNodes, path: Path, began: int) -> None:
    """Write the answers of the nodes down, if there are new ones and the code is still the same."""
    if not nodes.is_new or edition_of_code(began) != nodes.answers.edition:
        return
    if not nodes.answers.signatures:
        for name, node in all_nodes():
            family, _, attribute = name.partition(".")
            if not is_own(node.fn.__module__):
                of_family = nodes.answers.signatures.setdefault(family, {})
                of_family[attribute] = signature_of(node)
    nodes.answers.write(path)


def with_nodes(recipe: Recipe) -> Recipe:
    """Return a recipe that was checked without its nodes, with the nodes themselves."""
    steps = {
        name: replace(step, node=find_node(step.node.path))
        for name, step in recipe.steps.items()
        if isinstance(step.node, RememberedNode)
    }
    return replace(recipe, steps={**recipe.steps, **steps})
