"""Rules on what a node says of itself: docstring, annotations, arguments of its hooks."""

from __future__ import annotations

import ast
import inspect
import textwrap
from collections.abc import Iterator

from neusee.nodes import Node
from neusee.workflows.contract.finding import Finding

_LINES = ("Shapes:", "Units:", "Error:", "Source:")
_LONGEST = 240  #: characters of the first paragraph
_HOOKS = ("reference", "skip_bound", "skip_scale", "zero_bound", "preflight", "shape", "check")


def check_docstring(node: Node) -> Iterator[Finding]:
    """Find whether the docstring begins with one sentence and has the lines of a node."""
    text = inspect.getdoc(node.fn) or ""
    first, lines = text.split("\n\n")[0], text.splitlines()
    faults = []
    if not first.endswith(".") or not first[:1].isupper() or len(first) > _LONGEST:
        faults.append("the first paragraph must be one sentence")
    for word in _LINES:
        found = [line for line in lines if line.startswith(word)]
        if len(found) != 1 or len(found[0].removeprefix(word).strip()) < 2:
            faults.append(f"one line must begin with {word}")
    if "Raises:" not in text and _raises(node):
        faults.append("the function raises an error, so one line must begin with Raises:")
    yield Finding("docstring", not faults, "; ".join(faults) or "one sentence, shapes, units, error and source")


def check_signature(node: Node) -> Iterator[Finding]:
    """Find whether every argument and the result are annotated, and the parameters can be validated."""
    try:
        names = inspect.signature(node.fn).parameters
        bare = [name for name in names if name not in node.hints and name != "rng"]
        bare += [] if "return" in node.hints else ["the result"]
        fields = [] if bare else list(node.params.model_fields)
    except Exception as error:
        yield Finding("signature", False, f"an annotation cannot be read: {type(error).__name__}: {error}")
        return
    count = f"{len(fields)} parameter{'s' * (len(fields) != 1)}"
    text = f"without an annotation: {', '.join(bare)}" if bare else f"{count}, all annotated"
    yield Finding("signature", not bare, text)


def check_hooks(node: Node) -> Iterator[Finding]:
    """Find whether each hook takes arguments that the node has."""
    own = {*inspect.signature(node.fn).parameters, "result"}
    faults = []
    for name in _HOOKS:
        hook = getattr(node.hooks, name)
        for p in inspect.signature(hook).parameters.values() if hook else ():
            if p.kind is p.KEYWORD_ONLY and p.name not in own:
                faults.append(f"{name} asks for {p.name}, which {node.fn.__name__} does not have")
    there = [name for name in _HOOKS if getattr(node.hooks, name)]
    yield Finding("hooks", not faults, "; ".join(faults) or (", ".join(there) or "none"))


def _raises(node: Node) -> bool:
    try:
        source = textwrap.dedent(inspect.getsource(node.fn))
    except OSError:
        return False
    return any(isinstance(item, ast.Raise) for item in ast.walk(ast.parse(source)))
