"""What is covered by the key of a step, and what a step reached beyond it."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path
from typing import Literal, NamedTuple

Kind = Literal[
    "file", "folder", "write", "attribute", "process", "network", "random", "import", "memory", "variable", "unknown"
]


class Covered(NamedTuple):
    """What the key of a step knows: a step may reach it."""

    files: frozenset[Path]  #: real paths of files and folders; a folder covers what is in it
    modules: Callable[[str], bool]  #: True for a module whose source the key follows


class Taint(NamedTuple):
    """One thing that a step reached and its key does not know."""

    kind: Kind
    what: str  #: path, command, address, generator or module
    fix: str  #: what to write


_OF_PATHS = ("file", "folder", "write", "attribute")
_FIX: dict[Kind, str] = {
    "file": 'declare it, depends=["{name}"], or make it a parameter of type DataFile; or write cache: false',
    "folder": 'declare the folder, depends=["{name}"], or make its files a parameter of type DataFiles; or write '
    "cache: false",
    "write": 'empty the file where it is opened, mode "w", or write to a temporary one; or, if no result depends on '
    'what was there before, depends=["unaffected:{name}"]; or write cache: false',
    "attribute": "give it as a parameter; or write cache: false",
    "process": "compute it in the node, or run it before and give its output as a DataFile; or write cache: false",
    "network": "fetch it before and give the file as a DataFile; or write cache: false",
    "random": "draw from an argument rng of the node, a generator that the engine seeds; or write cache: false",
    "import": 'write the import as a statement, or declare the module: depends=["{name}"]; or write cache: false',
    "memory": "return it as a value to the steps that read it, or, if no result depends on it, declare "
    'depends=["unaffected:{name}"]; or write cache: false',
    "variable": 'make it a parameter, or declare it, depends=["env:{name}"]; or write cache: false',
    "unknown": "write cache: false",
}
_SEED = "set the seed in the node before it draws, {call}, from a parameter or a constant"
_OF_LAYERS = (
    "make a layer whose weights the node fills itself without drawing them, "
    "torch.nn.utils.skip_init(torch.nn.Linear, 3, 2)"
)
#: what else to write against a draw, by what was drawn from
_OF_CHANCE = {
    "torch": f"{_SEED.format(call='torch.manual_seed(seed)')}; or {_OF_LAYERS}",
    "torch.cuda": f"{_SEED.format(call='torch.manual_seed(seed)')}; or {_OF_LAYERS}",
    "numpy.random": _SEED.format(call="np.random.seed(seed)"),
}


def taint(kind: Kind, what: str) -> Taint:
    """Return a taint with what to write against it."""
    fix = _FIX[kind].format(name=_short(kind, what))
    return Taint(kind, what, f"{_OF_CHANCE[what]}; or {fix}" if kind == "random" and what in _OF_CHANCE else fix)


def _short(kind: Kind, what: str) -> str:
    """Return the last name of a file or of something in a module, by which it is declared."""
    if kind == "memory":
        return what.rpartition(".")[2]
    return Path(what).name if kind in _OF_PATHS else what
