"""A restoring network from a file of `torch.export`: what the file may hold, and the sizes that it was exported for.

`torch.export.load` reads pickles and calls what the graph of the file names: torch 2.6 to 2.8 unpickle without limits,
and 2.13 does so where `weights_only` fails. So each file is checked first: pickles hold tensors only, the graph calls
only operators of aten and arithmetic, and formulas of sizes hold no other names. Torch then reads the checked bytes.
"""

import io
import json
import math
import re
import zipfile
from collections.abc import Iterator
from pathlib import Path
from typing import Any, NamedTuple

import torch
from torch import nn

from neusee.nodes import ParameterError
from neusee.nodes.array_bytes import archive_needs
from neusee.nodes.input_files import once_per_version
from neusee.nodes.input_size import bytes_of
from neusee.nodes.restore._networks._own_network import OwnNetwork, try_network

EXPORTED = ".pt2"  #: suffix of a file of `torch.export`
_PROGRAM = re.compile(r"(.*/)?(models/[^/]+\.json|serialized_exported_program\.json)")
_ARITHMETIC = "add|sub|mul|floordiv|truediv|mod|neg|pow|getitem|eq|ne|lt|le|gt|ge|and_|or_|not_|pos|abs"
_OPERATOR = re.compile(rf"torch\.ops\.aten\.(?!from_file)\w+\.\w+|_operator\.({_ARITHMETIC})|math\.(floor|ceil|trunc)")
_IN_FORMULA = re.compile(
    r"Mul|Add|Pow|Integer|Symbol|Mod|PythonMod|FloorDiv|CleanDiv|Max|Min|Rational|positive|integer|nonnegative|True|"
    r"False|Eq|Ne|Le|Lt|Ge|Gt|L|size|stride|storage_offset|and|or|not|int_oo|evaluate|[suz]\d+|\d+"
)
_CONTAINERS = ("builtins.tuple", "builtins.list", "builtins.dict", None)
_FLOAT = 7  #: of float32, in the graph of a file
_TRIED = 512**2  #: pixels; a network for larger pictures alone is not tried before the run
_FIX = "export the network again, in eval() and with a picture (1, 3, y, x) as its only input"


class Side(NamedTuple):
    """Sizes of a side of the pictures that an exported network takes, in pixels."""

    least: int
    most: float
    multiple: int


class Graph(NamedTuple):
    """What the graph of an exported network says."""

    sides: tuple[Side, Side]  #: y and x
    version: str  #: of the torch that wrote the file


def exported_network(file: Path, multiple: int | None = None) -> OwnNetwork:
    """Return the network of a file as a restorer; raise ParameterError for a file that is not to be read."""
    data = _bytes(file)
    graph = _checked(file, data)
    try:
        inner: nn.Module = torch.export.load(io.BytesIO(data)).module()
    except Exception as error:
        cause = f"{type(error).__name__}: {' '.join(str(error).split())[:200]}"
        hint = f"it is of torch {graph.version}, and this is torch {torch.__version__}: export the network again"
        raise _refused(file, f"cannot be loaded ({cause}); {hint}") from error
    own = math.lcm(*(side.multiple for side in graph.sides)) if multiple is None else multiple
    return _Exported(inner, file.name, own, {})


class _Exported(OwnNetwork):
    """A network that has no modes: `torch.export` fixes the layers as they were when the file was written."""

    def train(self, mode: bool = True) -> "_Exported":
        self.training = mode
        return self

    def to(self, *args: Any, **kwargs: Any) -> "_Exported":
        """Move the tensors to a device; the type of the numbers stays that of the file."""
        device = next((x for x in args if isinstance(x, str | torch.device)), kwargs.get("device"))
        if device is not None:
            super().to(device)
        return self


def read_sizes(file: Path, multiple: int | None, sizes: tuple[int, int] | None) -> None:
    """Raise ParameterError for a file that is not to be read, or that was exported for other sizes than ``sizes``."""
    sides = _tried(file, multiple or 1)
    if sizes is None:
        return
    for axis, size, side in zip("yx", sizes, sides, strict=True):
        own = side.multiple if multiple is None else multiple
        size += -size % own
        if not side.least <= size <= side.most or size % side.multiple:
            allowed = f"{side.least}" if side.least == side.most else f"{side.least} to {side.most}, by {side.multiple}"
            tile = f", or write tile: {side.least}" if {s.least for s in sides} == {side.most} else ""
            text = f"{file.name} takes pictures with {allowed} pixels along {axis}, and gets {size}"
            raise ParameterError("weights", f"{text}: export it with dynamic sizes{tile}")


@once_per_version
def _tried(file: Path, multiple: int) -> tuple[Side, Side]:
    """Try an exported network on a small picture with sides of a multiple, and return the sizes that it takes."""
    net = exported_network(file)
    sides = _checked(file, _bytes(file)).sides
    steps = [math.lcm(side.multiple, multiple) for side in sides]
    y, x = (step * math.ceil(max(side.least, 33) / step) for side, step in zip(sides, steps, strict=True))
    y, x = int(min(y, sides[0].most)), int(min(x, sides[1].most))
    if y * x <= _TRIED:
        try_network(net, sizes=(y, x))
    return sides


def _bytes(file: Path) -> bytes:
    """Return the bytes of a file whose content has room in memory: itself, a part that is checked, and the network."""
    archive_needs(file, 3.0, "weights")
    return bytes_of(file, parameter="weights")


def _checked(file: Path, data: bytes) -> Graph:
    """Return what the graph of a file says; raise ParameterError for a file that could run code, or does not fit."""
    try:
        with zipfile.ZipFile(io.BytesIO(data)) as archive:
            names = archive.namelist()
            program = next((name for name in names if _PROGRAM.fullmatch(name)), None)
            if program is None:
                raise _refused(file, "is no file of torch.export: write it by torch.export.save")
            if archive.testzip() is not None:
                raise _refused(file, "is damaged: copy the file again")
            for name in names:
                _check_member(file, name, archive.read(name))
            return _graph(file, json.loads(archive.read(program)))
    except (zipfile.BadZipFile, EOFError, UnicodeDecodeError, json.JSONDecodeError):
        raise _refused(file, "is no file of torch.export, or a part of it is missing: copy the file again") from None
    except (KeyError, IndexError, TypeError, AttributeError) as error:
        raise _refused(file, f"has a graph of an unknown form ({error!r}): {_FIX}") from None


def _check_member(file: Path, name: str, data: bytes) -> None:
    """Raise ParameterError for a file inside of the archive that could run code."""
    if "aotinductor" in name or name.endswith((".so", ".cubin", ".cpp")):
        raise _refused(file, f"holds a compiled program ({name}), which is not run: use torch.export.save")
    if name.endswith(".pt") and data:
        try:
            torch.load(io.BytesIO(data), weights_only=True)
        except Exception:
            raise _refused(file, f"holds a pickle with more than tensors ({name}), which could run code") from None
    if name.endswith(".json"):
        for key, value in _pairs(json.loads(data)):
            if key == "use_pickle" and value:
                raise _refused(file, f"holds a pickle ({name}), which could run code")


def _graph(file: Path, program: Any) -> Graph:
    for key, value in _pairs(program):
        if key == "target" and isinstance(value, str) and not _OPERATOR.fullmatch(value):
            raise _refused(file, f"calls {value}, and only operators of aten are run")
        if key in ("in_spec", "out_spec") and isinstance(value, str) and value:
            _check_containers(file, json.loads(value))
    module = program["graph_module"]
    if any(_trains(node) for node in module["graph"]["nodes"]):
        raise _refused(file, "was exported in training mode: call eval() of the network before torch.export")
    formulas = [value for key, value in _pairs(module) if key == "expr_str"]
    for text in (*formulas, *program.get("range_constraints", {}), *(program.get("guards_code") or ())):
        bare = re.sub(r"L\['\w+'\]", "L", str(text))  # the input of the network, by its name
        wrong = [word for word in re.findall(r"\w+", bare) if not _IN_FORMULA.fullmatch(word)]
        if wrong or not re.fullmatch(r"[\w\s()\[\]'\".,=<>!*/%+-]*", bare):
            raise _refused(file, f"has a formula of sizes with other names: {str(text)[:60]}")
    return Graph(_sides(file, program, module), str(program.get("torch_version", "of another version")))


def _trains(node: Any) -> bool:
    """Return True for an operator that computes otherwise in training, such as dropout, and is told to do so."""
    given = {one.get("name"): one.get("arg", {}).get("as_bool") for one in node["inputs"]}
    return given.get("training") is True or given.get("train") is True


def _check_containers(file: Path, spec: Any) -> None:
    for key, value in _pairs(spec):
        if key == "type" and value not in _CONTAINERS:
            raise _refused(file, f"takes or returns a {value}: {_FIX}")


def _sides(file: Path, program: Any, module: Any) -> tuple[Side, Side]:
    """Return the sizes of the pictures; raise ParameterError unless one picture gives one of the same sizes."""
    signature, values = module["signature"], module["graph"]["tensor_values"]
    given = [spec["user_input"]["arg"] for spec in signature["input_specs"] if "user_input" in spec]
    found = [spec["user_output"]["arg"] for spec in signature["output_specs"] if "user_output" in spec]
    if len(given) != 1 or len(found) != 1 or len(signature["output_specs"]) != 1 or "as_tensor" not in given[0]:
        many = f"takes {len(given)} inputs and returns {len(signature['output_specs'])} results, state included"
        raise _refused(file, f"{many}: {_FIX}")
    about, result = values[given[0]["as_tensor"]["name"]], values[found[0]["as_tensor"]["name"]]
    sizes = about["sizes"]
    if len(sizes) != 4 or sizes[1].get("as_int") != 3 or sizes[0].get("as_int", 1) != 1:
        shape = " x ".join(str(size.get("as_int", "any")) for size in sizes)
        raise _refused(file, f"takes pictures {shape}, and a colour picture is 1 x 3 x y x x: {_FIX}")
    if about["dtype"] != _FLOAT or result["dtype"] != _FLOAT:
        raise _refused(file, "takes or returns other numbers than float32: export it with a picture in float32")
    if _plain(result["sizes"]) != _plain(sizes):
        shape = " x ".join(str(size.get("as_int", "any")) for size in result["sizes"])
        raise _refused(file, f"returns {shape} for a picture of other sizes: return the same shape")
    limits = program.get("range_constraints", {})
    return _side(sizes[2], limits), _side(sizes[3], limits)


def _plain(sizes: Any) -> list[Any]:
    return [size.get("as_int", size.get("as_expr", {}).get("expr_str")) for size in sizes]


def _side(size: Any, limits: Any) -> Side:
    """Return the sizes of a side from its formula, such as ``2*s0`` or ``Mul(Integer(2), Symbol('s0', ...))``."""
    if "as_int" in size:
        return Side(size["as_int"], size["as_int"], 1)
    text = size["as_expr"]["expr_str"]
    symbol = re.search(r"\bs\d+\b", text)
    factor = re.match(r"Mul\(Integer\((\d+)\), Symbol|(\d+)\*s\d+$", text)
    times = int(factor[1] or factor[2]) if factor else 1
    limit = limits.get(symbol[0], {}) if symbol else {}
    most = limit.get("max_val")
    return Side(times * int(limit.get("min_val") or 1), math.inf if most is None else times * int(most), times)


def _pairs(value: Any) -> Iterator[tuple[str, Any]]:
    """Yield each key with its value, at any depth."""
    todo = [value]
    while todo:
        item = todo.pop()
        if isinstance(item, dict):
            yield from item.items()
            todo += item.values()
        elif isinstance(item, list):
            todo += item


def _refused(file: Path, text: str) -> ParameterError:
    return ParameterError("weights", f"{file.name} {text}")
