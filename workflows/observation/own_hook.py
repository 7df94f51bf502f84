"""Observed hook of an own node that runs before its step: what the hook reads may stay in a memo of its module."""

from __future__ import annotations

import os
from collections.abc import Callable, Mapping
from pathlib import Path
from typing import Any, TypeVar

from neusee.nodes import Node
from neusee.nodes.own_modules import own_modules
from neusee.workflows.keys.declared_dependencies import FREE
from neusee.workflows.keys.input_file_digest import files_in
from neusee.workflows.keys.loaded_source import say_once
from neusee.workflows.keys.tainted_code import taint_code
from neusee.workflows.observation.observed_call import observed
from neusee.workflows.observation.own_call import WORDS
from neusee.workflows.observation.own_import import declares
from neusee.workflows.observation.taints import Covered

T = TypeVar("T")


def call_hook(node: Node, hook: Callable[[], T], params: Mapping[str, Any]) -> T:
    """Return what a hook of an own node returns; taint own modules by what it reaches beyond the parameters."""
    home = node.fn.__module__
    files = frozenset(Path(os.path.realpath(file)) for file in files_in(params))
    value, found = observed(hook, Covered(files, lambda _: True))
    free = {entry.removeprefix(FREE) for entry in node.depends}
    left = [each for each in found if not (free & {each.kind, each.what, Path(each.what).name} or declares(home, each))]
    if left:
        taint_code({home, *own_modules()}, tuple(left))
        for each in left:
            text = f"a hook of {node.path} {WORDS[each.kind]} {each.what}, which no cache key covers"
            say_once(home, f"{text}: the results of own nodes are not stored; to have them stored, {each.fix}")
    return value
