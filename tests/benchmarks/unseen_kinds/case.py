"""What a case is: the code of an own node, what it reads, and how this changes between two runs.

Wherever a value may change, a pair `(first, second)` says both; a single value stays. `None` stands
for a file that is not there.
"""

from __future__ import annotations

import textwrap
from collections.abc import Callable, Mapping
from dataclasses import dataclass, field
from pathlib import Path

#: each own file begins with these lines, so that a case shows its idea alone
HEAD = """
import os
import sys
from pathlib import Path

import numpy as np
import torch
from torch import Tensor

from neusee.nodes import node
from neusee.nodes.units import DataFile


def picture(number) -> Tensor:
    return torch.full((2, 2), float(number))


"""
#: and each other file of nodes ends with a node that no step names
OTHER = """

from neusee.nodes import node


@node()
def idle(x: float) -> float:
    return x
"""
STEP = "a: {node: own.value}"

Text = str | bytes | None
Change = Text | tuple[Text, Text]


@dataclass(frozen=True)
class Case:
    """One own node, or a few, and what changes around it.

    In texts of `env`, `files` and `folder`, `{folder}` stands for the folder of the case,
    `{prefix}` for that of Python, and `{tmp}` for that of temporary files.
    """

    name: str
    about: str
    code: str
    steps: str | tuple[str, str] = STEP
    nodes: str | tuple[str, str] = "own.py"
    files: Mapping[str, Change] = field(default_factory=dict)
    #: writes files that are no text; called with 1, then with 2
    make: Callable[[Path, int], object] | None = None
    env: Mapping[str, Change] = field(default_factory=dict)
    folder: str | tuple[str, str] = "{folder}"  #: the working folder of the program
    stdin: str | tuple[str, str] = ""
    prefix: str | tuple[str, str] = ""  #: words in front of the command, such as `taskset -c 0`
    output: str = "a"
    watched: str = "a"  #: the output whose value is compared
    honest: bool = False  #: nothing changes: the second run should find the result in the cache

    def own(self) -> str:
        """Return the text of `own.py`."""
        return HEAD + textwrap.dedent(self.code)

    def recipe(self, turn: int) -> str:
        """Return the text of the recipe of the first or the second run."""
        steps = textwrap.indent(textwrap.dedent(now(self.steps, turn)).strip(), "  ")
        nodes = now(self.nodes, turn)
        return f"# {self.name}.\nnodes: [{nodes}]\nsteps:\n{steps}\noutputs: [{self.output}]\n"


def now(value: object, turn: int) -> object:
    """Return what a value, or a pair of values, is in a turn."""
    return value[turn - 1] if isinstance(value, tuple) else value
