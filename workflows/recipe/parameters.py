"""Check of the parameters of steps against the signatures of their nodes."""

from __future__ import annotations

import functools
import os
from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

from pydantic import ValidationError

from neusee.nodes import Node, ParameterError
from neusee.nodes.file_parameters import is_file, texts_of
from neusee.workflows.graph.diagnostics import Diagnostic, Location, nearest
from neusee.workflows.graph.recipe_graph import Step, Wire
from neusee.workflows.keys.input_file_digest import files_in
from neusee.workflows.keys.module_owner import is_own
from neusee.workflows.recipe.node_families import Own, class_context
from neusee.workflows.recipe.text.field_errors import message_of
from neusee.workflows.recipe.text.named_files import refuse_outside
from neusee.workflows.recipe.text.no_code import VARIABLE, is_strange
from neusee.workflows.recipe.text.references import broken
from neusee.workflows.recipe.text.renamed_keys import instead, new_name
from neusee.workflows.recipe.text.yaml_values import Value, kind

_LONGEST = 40  #: largest number of characters of a value in a message


@dataclass(slots=True)
class Checker:
    """Checker of the parameters of all steps in a recipe, which collects diagnostics and notes for the user."""

    diagnostics: list[Diagnostic]
    notes: dict[str, None] = field(default_factory=dict)
    #: full path of a file, or of several files, by the path of the value in the recipe
    files: dict[tuple[str | int, ...], Any] = field(default_factory=dict)
    own: Own = field(default_factory=dict)  #: the user's families of nodes, whose network classes a parameter may name

    def read(self, node: Node, given: Value, step: Location) -> dict[str, Any] | None:
        """Return the validated parameters of a step with the defaults of its node, or None if a parameter is wrong."""
        if broken(given):
            return None
        if given.data is not None and not isinstance(given.data, dict):
            message = f"must be a mapping of parameters, not {kind(given)}"
            self.diagnostics.append(Diagnostic(given.mark, given.name, message))
            return None
        values = {str(name): value for name, value in given.items.items()}
        plain = {name: self._plain(node, name, value) for name, value in values.items()}
        try:
            model = node.params.model_validate(plain, context=class_context(self.own))
        except ValidationError as error:
            self.diagnostics += _problems(error, node, values, given, step)
            return None
        params = {name: getattr(model, name) for name in node.params.model_fields}
        strange = [(value, why) for name, value in values.items() if (why := _strange(params[name], value))]
        self.diagnostics += [Diagnostic(value.mark, _said(value), why) for value, why in strange]
        return None if strange else params

    def preflight(
        self,
        bound: Step,
        inputs: Mapping[str, Any],
        source: Callable[[Wire], Mapping[Any, Value]],
        given: Value,
        step: Value,
    ) -> Sequence[str] | None:
        """Check a step with its node's own check, and return its notes, or None for a mistake.

        ``inputs`` has what is known of each input, and ``source`` returns the parameters of the step that feeds one.
        """
        if bound.node.hooks.preflight is None:
            return ()
        try:
            known = {name: inputs.get(name) for name in bound.node.preflight_inputs}
            return _checked(bound, functools.partial(bound.node.hooks.preflight, **bound.params, **known))
        except ParameterError as error:
            fed, _, name = error.parameter.rpartition(".")
            value = (source(bound.wires.get(fed)) if fed else given.items).get(name)
            if value is None:
                self.diagnostics.append(Diagnostic(step.key, f"{step.name}.with.{error.parameter}", str(error)))
            else:
                self.diagnostics.append(Diagnostic(value.mark, _said(value), str(error)))
        except ValueError as error:
            self.diagnostics.append(Diagnostic(step.key, step.name, str(error)))
        except OSError as error:  # a read that fails does not say of which file
            names = ", ".join(path.name for path in files_in(bound.params))
            self.diagnostics.append(Diagnostic(step.key, step.name, f"{names} cannot be read ({error})"))
        return None

    def _plain(self, node: Node, name: str, value: Value) -> Any:
        """Return a parameter value as plain data, with a file path relative to the folder of its YAML file."""
        parts = value.data if isinstance(value.data, list) else [value]
        hint = node.hints.get(name)
        if not is_file(hint) or not all(isinstance(part.data, str) for part in parts) or value.plain in texts_of(hint):
            return value.plain
        paths = [os.path.normpath(Path(part.mark.folder) / Path(part.data).expanduser()) for part in parts]
        full = [os.path.abspath(path) for path in paths]
        self.files[value.path] = full if isinstance(value.data, list) else full[0]
        return paths if isinstance(value.data, list) else paths[0]


def _strange(found: Any, value: Value) -> str:
    """Return why a recipe of a stranger may not name the files that a value led to, or an empty text."""
    files = [part for part in (found if isinstance(found, tuple | list) else [found]) if isinstance(part, Path)]
    if not files or not is_strange():
        return ""
    if any(file.suffix == ".pt2" for file in files):
        return f"a file of torch.export holds code, which {VARIABLE} or --no-code refuses to run"
    try:
        for file in files:
            refuse_outside(file, value.mark)
    except ValueError as error:
        return str(error)
    return ""


def _checked(bound: Step, hook: Callable[[], Sequence[str]]) -> Sequence[str]:
    """Return the notes of a node's own check, which is observed where the node is one of the user."""
    if not is_own(bound.node.fn.__module__):
        return hook()
    from neusee.workflows.observation.own_hook import call_hook  # imports torch

    return call_hook(bound.node, hook, bound.params)


def _problems(
    error: ValidationError, node: Node, values: Mapping[str, Value], given: Value, step: Location
) -> Iterator[Diagnostic]:
    """Yield a diagnostic for each parameter of a step that is wrong, unknown or missing."""
    details = error.errors(include_url=False)
    strangers = [str(e["loc"][0]) for e in details if e["type"] == "extra_forbidden" and len(e["loc"]) == 1]
    meant = {nearest(name, node.params.model_fields) for name in strangers}
    now = {new_name(f"{node.path}.{name}") for name in strangers}
    wrong: dict[tuple[Location, str], list[str]] = {}
    gone: dict[str, Diagnostic] = {}
    for e in details:
        name = str(e["loc"][0])
        if e["type"] == "extra_forbidden" and len(e["loc"]) == 1:
            unknown = f"unknown to {node.path}; {nearest(name, node.params.model_fields)}"
            message = instead(f"{node.path}.{name}") or unknown
            gone.setdefault(message, Diagnostic(values[name].key, f"{given.name}.{name}", message))
        elif e["type"] == "missing" and len(e["loc"]) == 1:
            if f"did you mean {name}?" not in meant and name not in now:
                yield Diagnostic(step, f"{given.name}.{name}", f"missing parameter: {node.path} needs {name}")
        else:
            value = _deepest(values[name], e["loc"][1:])
            wrong.setdefault((value.mark, _said(value)), []).append(message_of(e, value))
    yield from gone.values()  # parameters that moved to the same node share one message
    for (mark, path), messages in wrong.items():
        absent = [message for message in dict.fromkeys(messages) if message.startswith("no such file")]
        others = [message for message in dict.fromkeys(messages) if message not in absent]
        yield Diagnostic(mark, path, "; ".join([*absent, *([", or ".join(others)] if others else [])]))


def _deepest(value: Value, path: tuple[int | str, ...]) -> Value:
    """Return the value at a path of keys below ``value``; keys that it lacks, such as names of types, are skipped."""
    for key in path:
        value = value.child(key) or value
    return value


def _said(value: Value) -> str:
    """Return the name and the text of a recipe value, such as ``sensor.gain = -1``."""
    text = str(value.plain)
    return f"{value.name} = {text if len(text) <= _LONGEST else text[: _LONGEST - 1] + '…'}"
