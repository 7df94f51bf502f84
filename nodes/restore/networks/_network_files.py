"""Networks in files: export to .pt2 or .onnx, checks, and the node for a user's network."""

import importlib.util
import io
import json
import math
import os
import re
import warnings
import zipfile
from collections.abc import Iterator
from pathlib import Path
from typing import Annotated, Any, NamedTuple

import torch
from pydantic import Field
from torch import Tensor, nn

from neusee.nodes import ParameterError, node
from neusee.nodes.file_headers import archive_needs, safetensors_need
from neusee.nodes.input_files import bytes_of, once_per_version
from neusee.nodes.network_weights import fits
from neusee.nodes.own_modules import Architecture, NetworkClass
from neusee.nodes.restore.networks._own_network import OwnNetwork, own_network, tried, try_network
from neusee.nodes.restore.networks._restorer import (
    Flat,
    Restorer,
    Tile,
    restored_by,
    restorer_checks,
)
from neusee.nodes.units import Count, DataFile

# --- network export -------------------------------------------------------------------------------

# Files of a trained network for other programs: a graph of `torch.export` (.pt2) or of ONNX
# (.onnx).


SUFFIXES = (".pt2", ".onnx")
_NEEDED = ("onnx", "onnxscript")
_LARGEST = 4096  #: largest side of a picture for an exported network, pixels
_LEAST = 32  #: smallest side, pixels


class _Graph(nn.Module):
    """A restoration network without padding, for pictures whose sides are multiples of its
    `multiple`.
    """

    def __init__(self, net: Restorer) -> None:
        super().__init__()
        self.net = net

    def forward(self, picture: Tensor) -> Tensor:
        if isinstance(self.net, OwnNetwork):
            result: Tensor = self.net.inner(picture)
            return result
        assert isinstance(self.net, Flat)
        return picture + self.net.change(picture)


def require_exportable(net: Restorer, suffix: str) -> None:
    """Raise ParameterError for a network or a kind of file that `export_network` cannot write."""
    if suffix not in SUFFIXES:
        raise ParameterError(
            "export", f"a network is exported to {' or '.join(SUFFIXES)}, not to {suffix}"
        )
    if not isinstance(net, Flat | OwnNetwork):
        text = (
            "the selective scan of fft_mamba is a kernel that no exported graph holds: train kind:"
            " nafnet or unet"
        )
        raise ParameterError("export", text)
    missing = [
        name for name in _NEEDED if suffix == ".onnx" and importlib.util.find_spec(name) is None
    ]
    if missing:
        text = (
            f'{" and ".join(missing)} must be installed for .onnx: pip install "neusee[onnx]", or'
            " export to .pt2"
        )
        raise ParameterError("export", text)


def export_network(net: Restorer, file: Path) -> None:
    """Write a restoring network with its weights as a graph that other programs run, by the suffix
    of the file.

    The graph takes a picture (1, 3, y, x) in float32, linear sRGB, and returns the restored
    picture. Its sides are multiples of `multiple` from 32 (or one multiple) to 4096 pixels; the
    program that runs the graph pads its pictures. The file appears by an atomic rename.

    Raises: ParameterError as `require_exportable`, and for a class whose operators the format does
            not have.
    """
    require_exportable(net, file.suffix)
    graph, multiple = _Graph(net).eval(), net.multiple
    multiples = -(-2 * _LEAST // multiple)
    # different sides, so that the export does not treat them as one variable
    example = torch.rand(
        1,
        3,
        multiples * multiple,
        (multiples + 1) * multiple,
        generator=torch.Generator().manual_seed(0),
    )
    least_multiples, largest_multiples = -(-_LEAST // multiple), _LARGEST // multiple
    y, x = (
        torch.export.Dim(name, min=least_multiples, max=largest_multiples)
        for name in ("rows", "columns")
    )
    sides = ({2: multiple * y, 3: multiple * x},)
    unfinished = file.with_name(f".{os.getpid()}.{file.name}")
    try:
        with torch.no_grad(), warnings.catch_warnings():
            warnings.simplefilter("ignore")  # deprecation warnings from inside the packages
            _write(graph, example, sides, unfinished)
        unfinished.replace(file)
    except Exception as error:
        error_text = f"{type(error).__name__}: {' '.join(str(error).split())[:300]}"
        raise ParameterError(
            "export", f"the network cannot be written as {file.suffix} ({error_text})"
        ) from error
    finally:
        unfinished.unlink(missing_ok=True)


def _write(graph: nn.Module, example: Tensor, sides: Any, file: Path) -> None:
    """Write a module as a graph for pictures like ``example`` with variable ``sides``; the suffix
    of the file selects the format.
    """
    program = torch.export.export(graph, (example,), dynamic_shapes=sides)
    if file.suffix == ".pt2":
        torch.export.save(program, file)
    else:
        torch.onnx.export(
            program,
            input_names=["picture"],
            output_names=["restored"],
            dynamo=True,
            verbose=False,
            external_data=False,
            f=file,
        )


# --- exported network -----------------------------------------------------------------------------

# A restoration network from a file of `torch.export`: the allowed content of the file, and the
# picture sizes that the network was exported for.
#
# `torch.export.load` reads pickles and calls the functions that the graph names: torch 2.6 to 2.8
# unpickle without limits, and 2.13 does so if `weights_only` fails. So each file is checked first:
# pickles contain only tensors, the graph calls only aten operators and arithmetic, and formulas of
# sizes contain no other names. Then torch reads the checked bytes.


EXPORTED = ".pt2"  #: suffix of a file of `torch.export`
_PROGRAM = re.compile(r"(.*/)?(models/[^/]+\.json|serialized_exported_program\.json)")
_ARITHMETIC = (
    "add|sub|mul|floordiv|truediv|mod|neg|pow|getitem|eq|ne|lt|le|gt|ge|and_|or_|not_|pos|abs"
)
_OPERATOR = re.compile(
    rf"torch\.ops\.aten\.(?!from_file)\w+\.\w+|_operator\.({_ARITHMETIC})|math\.(floor|ceil|trunc)"
)
_IN_FORMULA = re.compile(
    r"Mul|Add|Pow|Integer|Symbol|Mod|PythonMod|FloorDiv|CleanDiv|Max|Min|Rational|positive|integer|nonnegative|True|"
    r"False|Eq|Ne|Le|Lt|Ge|Gt|L|size|stride|storage_offset|and|or|not|int_oo|evaluate|[suz]\d+|\d+"
)
_CONTAINERS = ("builtins.tuple", "builtins.list", "builtins.dict", None)
_FLOAT = 7  #: code of float32 in the graph of a file
_TRIED = 512**2  #: largest number of pixels of a trial call; larger networks have none before a run
_FIX = "export the network again, in eval() and with a picture (1, 3, y, x) as its only input"


class Side(NamedTuple):
    """The allowed lengths in pixels of one side of the pictures for an exported network."""

    least: int
    most: float
    multiple: int


class Graph(NamedTuple):
    """The allowed picture sizes and the torch version of an exported network."""

    sides: tuple[Side, Side]  #: y and x
    version: str  #: version of the torch that wrote the file


def exported_network(file: Path, multiple: int | None = None) -> OwnNetwork:
    """Return the network of a file as a restorer; raise ParameterError for a file that is damaged
    or could run code.
    """
    data = _bytes(file)
    graph = _checked(file, data)
    try:
        inner: nn.Module = torch.export.load(io.BytesIO(data)).module()
    except Exception as error:
        cause = f"{type(error).__name__}: {' '.join(str(error).split())[:200]}"
        hint = (
            f"it is of torch {graph.version}, and this is torch {torch.__version__}: export the"
            " network again"
        )
        raise _refused(file, f"cannot be loaded ({cause}); {hint}") from error
    multiple_used = (
        math.lcm(*(side.multiple for side in graph.sides)) if multiple is None else multiple
    )
    return _Exported(inner, file.name, multiple_used, {})


class _Exported(OwnNetwork):
    """A network without training and evaluation modes: `torch.export` fixes the layers in the mode
    of the export.
    """

    def train(self, mode: bool = True) -> "_Exported":
        self.training = mode
        return self

    def to(self, *args: Any, **kwargs: Any) -> "_Exported":
        """Move the tensors to a device; their type stays that of the file."""
        device = next((x for x in args if isinstance(x, str | torch.device)), kwargs.get("device"))
        if device is not None:
            super().to(device)
        return self


def read_sizes(file: Path, multiple: int | None, sizes: tuple[int, int] | None) -> None:
    """Raise ParameterError for a file that is damaged or could run code, or that was not exported
    for pictures of ``sizes``.
    """
    sides = _tried(file, multiple or 1)
    if sizes is None:
        return
    for axis, size, side in zip("yx", sizes, sides, strict=True):
        padded_multiple = side.multiple if multiple is None else multiple
        size += -size % padded_multiple
        if not side.least <= size <= side.most or size % side.multiple:
            allowed = (
                f"{side.least}"
                if side.least == side.most
                else f"{side.least} to {side.most}, by {side.multiple}"
            )
            tile = (
                f", or write tile: {side.least}" if {s.least for s in sides} == {side.most} else ""
            )
            text = f"{file.name} takes pictures with {allowed} pixels along {axis}, and gets {size}"
            raise ParameterError("weights", f"{text}: export it with dynamic sizes{tile}")


@once_per_version
def _tried(file: Path, multiple: int) -> tuple[Side, Side]:
    """Call an exported network once on a small picture, and return the allowed sizes along y and x.

    The sides of the small picture are multiples of ``multiple``.
    """
    net = exported_network(file)
    sides = _checked(file, _bytes(file)).sides
    multiples = [math.lcm(side.multiple, multiple) for side in sides]
    y, x = (
        # the smallest multiple above 32 within the sizes of the file
        step * math.ceil(max(side.least, 33) / step)
        for side, step in zip(sides, multiples, strict=True)
    )
    y, x = int(min(y, sides[0].most)), int(min(x, sides[1].most))
    if y * x <= _TRIED:
        try_network(net, sizes=(y, x))
    return sides


def _bytes(file: Path) -> bytes:
    """Return the bytes of a file; memory must have room for the file, the part that is being
    checked, and the network.
    """
    archive_needs(file, 3.0, "weights")
    return bytes_of(file, parameter="weights")


def _checked(file: Path, data: bytes) -> Graph:
    """Return sizes and version from the graph of a file; raise ParameterError for a file that could
    run code or is not a restoration network.
    """
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
        raise _refused(
            file, "is no file of torch.export, or a part of it is missing: copy the file again"
        ) from None
    except (KeyError, IndexError, TypeError, AttributeError) as error:
        raise _refused(file, f"has a graph of an unknown form ({error!r}): {_FIX}") from None


def _check_member(file: Path, name: str, data: bytes) -> None:
    """Raise ParameterError for a file inside of the archive that could run code."""
    if "aotinductor" in name or name.endswith((".so", ".cubin", ".cpp")):
        raise _refused(
            file, f"holds a compiled program ({name}), which is not run: use torch.export.save"
        )
    if name.endswith(".pt") and data:
        try:
            torch.load(io.BytesIO(data), weights_only=True)
        except Exception:
            raise _refused(
                file, f"holds a pickle with more than tensors ({name}), which could run code"
            ) from None
    if name.endswith(".json"):
        for key, value in _pairs(json.loads(data)):
            if key == "use_pickle" and value:
                raise _refused(file, f"holds a pickle ({name}), which could run code")


def _graph(file: Path, program: Any) -> Graph:
    """Return sizes and version from the graph of a file, after checks of its calls and inputs."""
    _check_calls(file, program)
    module = program["graph_module"]
    if any(_trains(node) for node in module["graph"]["nodes"]):
        raise _refused(
            file, "was exported in training mode: call eval() of the network before torch.export"
        )
    _check_formulas(file, program, module)
    return Graph(
        _sides(file, program, module), str(program.get("torch_version", "of another version"))
    )


def _check_calls(file: Path, program: Any) -> None:
    """Raise ParameterError for a graph that calls anything but operators of aten and arithmetic."""
    for key, value in _pairs(program):
        if key == "target" and isinstance(value, str) and not _OPERATOR.fullmatch(value):
            raise _refused(file, f"calls {value}, and only operators of aten are run")
        if key in ("in_spec", "out_spec") and isinstance(value, str) and value:
            _check_containers(file, json.loads(value))


def _check_formulas(file: Path, program: Any, module: Any) -> None:
    """Raise ParameterError for a formula of sizes that contains a name other than those of sizes
    and arithmetic.
    """
    formulas = [value for key, value in _pairs(module) if key == "expr_str"]
    for text in (
        *formulas,
        *program.get("range_constraints", {}),
        *(program.get("guards_code") or ()),
    ):
        # `L['picture']` is the input of the network; its name is arbitrary
        without_input_name = re.sub(r"L\['\w+'\]", "L", str(text))
        other_names = [
            word
            for word in re.findall(r"\w+", without_input_name)
            if not _IN_FORMULA.fullmatch(word)
        ]
        if other_names or not re.fullmatch(r"[\w\s()\[\]'\".,=<>!*/%+-]*", without_input_name):
            raise _refused(file, f"has a formula of sizes with other names: {str(text)[:60]}")


def _trains(node: Any) -> bool:
    """Return True for an operator in training mode, such as dropout with ``training`` True."""
    arguments = {
        argument.get("name"): argument.get("arg", {}).get("as_bool") for argument in node["inputs"]
    }
    return arguments.get("training") is True or arguments.get("train") is True


def _check_containers(file: Path, spec: Any) -> None:
    """Raise ParameterError if inputs or results have another structure than tuple, list or dict."""
    for key, value in _pairs(spec):
        if key == "type" and value not in _CONTAINERS:
            raise _refused(file, f"takes or returns a {value}: {_FIX}")


def _sides(file: Path, program: Any, module: Any) -> tuple[Side, Side]:
    """Return the allowed sizes of the pictures; raise ParameterError unless the network returns one
    picture of the size of its input.
    """
    picture, result = _picture_and_result(file, module)
    sizes = picture["sizes"]
    if len(sizes) != 4 or sizes[1].get("as_int") != 3 or sizes[0].get("as_int", 1) != 1:
        raise _refused(
            file, f"takes pictures {_shape(sizes)}, and a colour picture is 1 x 3 x y x x: {_FIX}"
        )
    if picture["dtype"] != _FLOAT or result["dtype"] != _FLOAT:
        raise _refused(
            file, "takes or returns other numbers than float32: export it with a picture in float32"
        )
    if _plain(result["sizes"]) != _plain(sizes):
        shape = _shape(result["sizes"])
        raise _refused(file, f"returns {shape} for a picture of other sizes: return the same shape")
    limits = program.get("range_constraints", {})
    return _side(sizes[2], limits), _side(sizes[3], limits)


def _picture_and_result(file: Path, module: Any) -> tuple[Any, Any]:
    """Return the descriptions (type and sizes) of the only input and the only result of a graph."""
    signature, values = module["signature"], module["graph"]["tensor_values"]
    user_inputs = [
        spec["user_input"]["arg"] for spec in signature["input_specs"] if "user_input" in spec
    ]
    user_outputs = [
        spec["user_output"]["arg"] for spec in signature["output_specs"] if "user_output" in spec
    ]
    if (
        len(user_inputs) != 1
        or len(user_outputs) != 1
        or len(signature["output_specs"]) != 1
        or "as_tensor" not in user_inputs[0]
    ):
        counts_text = (
            f"takes {len(user_inputs)} inputs and returns {len(signature['output_specs'])} results,"
            " state included"
        )
        raise _refused(file, f"{counts_text}: {_FIX}")
    picture = values[user_inputs[0]["as_tensor"]["name"]]
    return picture, values[user_outputs[0]["as_tensor"]["name"]]


def _shape(sizes: Any) -> str:
    """Return sizes as text, with "any" for a variable size."""
    return " x ".join(str(size.get("as_int", "any")) for size in sizes)


def _plain(sizes: Any) -> list[Any]:
    """Return each size as a number, or as its formula in the file."""
    return [size.get("as_int", size.get("as_expr", {}).get("expr_str")) for size in sizes]


def _side(size: Any, limits: Any) -> Side:
    """Return the allowed lengths of a side from its formula, such as ``2*s0`` or
    ``Mul(Integer(2), Symbol('s0', ...))``.
    """
    if "as_int" in size:
        return Side(size["as_int"], size["as_int"], 1)
    formula = size["as_expr"]["expr_str"]
    symbol = re.search(r"\bs\d+\b", formula)
    factor = re.match(r"Mul\(Integer\((\d+)\), Symbol|(\d+)\*s\d+$", formula)
    multiple = int(factor[1] or factor[2]) if factor else 1
    limit = limits.get(symbol[0], {}) if symbol else {}
    largest = limit.get("max_val")
    return Side(
        multiple * int(limit.get("min_val") or 1),
        math.inf if largest is None else multiple * int(largest),
        multiple,
    )


def _pairs(value: Any) -> Iterator[tuple[str, Any]]:
    """Yield each key of nested dicts and lists with its value."""
    pending = [value]
    while pending:
        item = pending.pop()
        if isinstance(item, dict):
            yield from item.items()
            pending += item.values()
        elif isinstance(item, list):
            pending += item


def _refused(file: Path, text: str) -> ParameterError:
    return ParameterError("weights", f"{file.name} {text}")


# --- network node ---------------------------------------------------------------------------------

# The node that restores a picture with a user's network: a class with weights, or a file of
# `torch.export`.


Multiple = Annotated[Count, Field(le=1024)]  #: divisor of the sides of a picture, pixels
_PICKLED = (".pt", ".pth", ".ckpt", ".bin", ".pkl")


@node()
def network(
    picture: Tensor,
    *,
    architecture: NetworkClass | None = None,
    parameters: dict[str, Any] | None = None,
    weights: DataFile | None = None,
    multiple: Multiple | None = None,
    tile: Tile | None = None,
    reduce: Count = 1,
    detail: bool = False,
) -> Tensor:
    """Restore a colour picture with a network of your own.

    The network is a class of `torch.nn.Module`, built with ``parameters`` and the ``weights`` of a
    .safetensors file, or the whole content of a .pt2 file of `torch.export`. It takes a picture (1,
    3, y, x) and returns the restored picture of the same shape. ``multiple``: the sides are padded
    by reflection to a multiple of this number, by default the attribute ``multiple`` of the class,
    or 1. ``tile``, ``reduce`` and ``detail`` as in `fft_mamba`.

    Shapes: picture (3, y, x) of any size -> (3, y, x).
    Units:  linear sRGB, as in the training of the weights.
    Error:  float32, 1e-5; of the restoration, the error that the training reached.
    Raises: ParameterError before the run without weights, where the class or the file fails on a
            small picture, or where the weights do not fit; ValueError for a picture that is not a
            colour picture or not finite, and for a result with other sizes or with values that are
            not finite.
    Source: the author of the network.
    """
    return restored_by(
        lambda: _loaded_network(architecture, parameters, weights, multiple),
        picture,
        tile,
        reduce,
        detail,
    )


def _loaded_network(
    architecture: Architecture | type[nn.Module] | None,
    parameters: dict[str, Any] | None,
    weights: Path | None,
    multiple: int | None,
) -> OwnNetwork:
    """Return the network with its weights, in single precision."""
    file = _weights(weights)
    if file.suffix == EXPORTED:
        return exported_network(file, multiple)
    from safetensors.torch import load_file

    safetensors_need(file, parameter="weights")
    net = own_network(_class(architecture), parameters, multiple)
    net.inner.load_state_dict(load_file(file))
    net.float()
    return net


def _class(architecture: Architecture | type[nn.Module] | None) -> Architecture:
    """Return the class of the network as an `Architecture`, which checks its parameters; raise
    ParameterError if there is none.
    """
    if architecture is None:
        text = (
            "name the class of the network, such as mynet.SmallUNet, or give weights: a .pt2 file"
            " of torch.export"
        )
        raise ParameterError("architecture", text)
    return (
        architecture
        if isinstance(architecture, Architecture)
        else Architecture(architecture.__name__, architecture)
    )


def _weights(weights: Path | None) -> Path:
    """Return the file of weights; raise ParameterError for a missing file or a pickle."""
    if weights is None:
        text = (
            "a network needs trained weights: train them by `neusee train`, and give the"
            " .safetensors file"
        )
        raise ParameterError("weights", text)
    if weights.suffix in _PICKLED:
        text = (
            f"{weights.name} is a pickle, which can run code when it is read: save the weights as"
            " .safetensors"
        )
        raise ParameterError("weights", text)
    return weights


@network.preflight
def _(
    *,
    architecture: Architecture | None = None,
    parameters: dict[str, Any] | None = None,
    weights: Path | None = None,
    multiple: int | None = None,
    tile: int | None = None,
    reduce: int = 1,
    picture: Any = None,
    **others: Any,
) -> list[str]:
    """Raise ParameterError for a class, a file or sizes that do not work; return no warnings."""
    if weights is not None and weights.suffix == EXPORTED:
        for name, value in (("architecture", architecture), ("parameters", parameters or None)):
            if value is not None:
                raise ParameterError(
                    name, f"{weights.name} of torch.export holds its own network: remove {name}"
                )
        read_sizes(weights, multiple, _sizes(picture, tile, reduce))
        return [
            f"{weights.name} of torch.export holds the operations of a network, which this recipe"
            " runs"
        ]
    named = _class(architecture)
    tried(named, parameters, multiple)
    file, net = _weights(weights), own_network(named, parameters, multiple)
    fits(net.inner, file, str(named), net.options)
    return []


def _sizes(picture: Any, tile: int | None, reduce: int) -> tuple[int, int] | None:
    """Return height and width of the pictures that the network receives, or None if they are
    unknown.
    """
    if not isinstance(picture, Tensor) or picture.ndim != 3:
        return None
    y, x = (-(-n // reduce) for n in picture.shape[-2:])
    return (y, x) if tile is None or max(y, x) <= tile else (min(y, tile), min(x, tile))


network.check(restorer_checks)
