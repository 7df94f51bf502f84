"""A user's restoration network: building and calling it, and a trial call that shows errors, time
and memory.
"""

import functools
import json
import math
import threading
import traceback
from collections.abc import Iterator, Mapping
from contextlib import contextmanager
from typing import Any, NamedTuple

import torch
from torch import Tensor, nn
from torch.overrides import TorchFunctionMode

from neusee.nodes import ParameterError
from neusee.nodes.own_modules import Architecture
from neusee.nodes.precision import exact_convolutions
from neusee.nodes.resampling import mirrored, resize
from neusee.nodes.restore.networks._restorer import PictureRestorer

_DRAWING = threading.Lock()  #: one thread at a time seeds the global random generator
_LEAST = 32  #: smallest side in pixels of the picture of a trial call
#: errors of Python and torch that the code of a network may raise
_FAILURES = (
    RuntimeError,
    TypeError,
    ValueError,
    LookupError,
    AttributeError,
    ArithmeticError,
    AssertionError,
    OSError,
)


class Trial(NamedTuple):
    """The measured cost of a call of a network on a small picture."""

    operations: float  #: floating-point operations per pixel
    memory: float  #: bytes of all intermediate results per pixel


class OwnNetwork(PictureRestorer):
    """A user's network as a restorer: pictures are padded to a multiple, and wrong results raise an
    error that names the network.
    """

    def __init__(
        self, inner: nn.Module, name: str, multiple: int, options: Mapping[str, Any]
    ) -> None:
        """Wrap a user's module; messages show its ``name``, and the sides of pictures are padded to
        multiples of ``multiple``.
        """
        super().__init__()
        self.inner, self.name, self.multiple = inner, name, multiple
        #: metadata in a file of weights about the class that was trained
        self.options = dict(options)

    @property
    def stored(self) -> nn.Module:
        """Return the user's module, so that a file of weights has the user's names of tensors."""
        return self.inner

    def scales(self, picture: Tensor) -> tuple[Tensor, Tensor]:
        fine = self.called(picture)
        y, x = fine.shape[-2:]
        return resize(fine, -(-y // 2), -(-x // 2)), fine

    def forward(self, picture: Tensor, *conditions: Any) -> Tensor:
        y, x = picture.shape[-2:]
        return self.called(mirrored(picture, -y % self.multiple, -x % self.multiple))[..., :y, :x]

    def called(self, picture: Tensor) -> Tensor:
        """Return the result of the user's network; raise ValueError with its name for a wrong
        result or an error.
        """
        # torch increments `_version` at each change of a tensor in place
        version_before = picture._version
        with self._located(picture):
            result = self.inner(picture)
        sizes = _sizes(picture)
        if picture._version != version_before:
            raise ValueError(f"{self.name} {_CHANGES}")
        if not isinstance(result, Tensor):
            raise ValueError(
                f"{self.name} returns a {type(result).__name__}, not one picture {sizes}"
            )
        if result.shape != picture.shape:
            raise ValueError(
                f"{self.name} returns {_sizes(result)} for a picture {sizes}: return the same shape"
            )
        if not result.is_floating_point():
            raise ValueError(f"{self.name} returns {result.dtype}: return floating-point numbers")
        if not self.training and not torch.isfinite(result).all():
            count = int((~torch.isfinite(result)).sum())
            raise ValueError(
                f"{self.name} returns {count} values that are not finite (NaN or infinity) for"
                f" {sizes}"
            )
        return result

    @contextmanager
    def _located(self, picture: Tensor) -> Iterator[None]:
        """Raise an error of the user's code as ValueError that names the network, file and line."""
        try:
            yield
        except torch.OutOfMemoryError:
            raise
        except _FAILURES as error:
            error_text = " ".join(str(error).split()) or type(error).__name__
            frames = traceback.extract_tb(error.__traceback__)
            user_frames = [
                frame
                for frame in frames
                if "/torch/" not in frame.filename and frame.name != "__torch_function__"
            ]
            file_and_line = (
                # the first frame is this file's own call
                f"{user_frames[-1].filename.rpartition('/')[2]}:{user_frames[-1].lineno}: "
                if user_frames[1:]
                else ""
            )
            raise ValueError(
                f"{self.name} fails for a picture {_sizes(picture)}: {file_and_line}{error_text}"
            ) from error


def own_network(
    architecture: Architecture,
    parameters: dict[str, Any] | None,
    multiple: int | None,
    seed: int = 0,
) -> OwnNetwork:
    """Return a network of a user's class, with random initial weights for ``seed``.

    ``multiple``: the divisor of the sides of a picture; by default the attribute ``multiple`` of
    the class, or 1. The state of the global random generator does not change. Raises ParameterError
    for arguments that the class refuses.
    """
    try:
        arguments = architecture.arguments(parameters)
        with _DRAWING, torch.random.fork_rng(devices=[]):
            torch.manual_seed(seed)
            inner = architecture.network(**(parameters or {}))
    except _FAILURES as error:
        text = (
            str(error)
            if str(architecture) in str(error)
            else f"{architecture}({_listed(parameters)}): {error}"
        )
        raise ParameterError("parameters", text) from error
    network_multiple = getattr(inner, "multiple", 1) if multiple is None else multiple
    if type(network_multiple) is not int or network_multiple < 1:
        raise ParameterError(
            "architecture",
            f"{architecture}.multiple = {network_multiple!r} must be a whole number from 1",
        )
    options = {
        "class": architecture.network.__qualname__,
        "parameters": json.loads(json.dumps(arguments, default=str)),
    }
    return OwnNetwork(inner, str(architecture), network_multiple, options)


def try_network(
    net: OwnNetwork,
    dtype: torch.dtype = torch.float32,
    device: str = "cpu",
    sizes: tuple[int, int] | None = None,
) -> Trial:
    """Call a network on a small picture, and return the cost of the call; raise ParameterError for
    an error or a wrong result.

    The sides of the picture differ, and are odd multiples of `multiple`. So a network that needs
    other sizes, but does not declare them, fails here.
    """
    # odd, so that a network that needs a multiple with more factors of 2 fails
    side_in_multiples = math.ceil(_LEAST / net.multiple) | 1
    y, x = sizes or (net.multiple * side_in_multiples, net.multiple * (side_in_multiples + 2))
    random = torch.Generator().manual_seed(1)
    picture = torch.rand(1, 3, y, x, generator=random, dtype=torch.float64).to(device, dtype)
    net.to(device, dtype).eval()
    argument = picture.clone()
    try:
        with (
            torch.no_grad(),
            torch.random.fork_rng(devices=[]),
            exact_convolutions(picture, deterministic=True),
        ):
            with _Counting() as counted:
                result = net.called(argument)
            second_result = net.called(picture.clone())
    except ValueError as error:
        multiple_hint = (
            "; if it needs sides of a certain multiple, write multiple = 8 in the class (now"
            f" {net.multiple})"
        )
        raise ParameterError(
            "architecture", f"{error}{multiple_hint if 'picture 1 x' in str(error) else ''}"
        ) from error
    if not torch.equal(argument, picture):
        raise ParameterError("architecture", f"{net.name} {_CHANGES}")
    if result.dtype != dtype:
        raise ParameterError(
            "architecture",
            f"{net.name} returns {result.dtype} for {dtype}: keep the type of the input",
        )
    if not torch.equal(result, second_result):
        raise ParameterError(
            "architecture",
            f"{net.name} gives other numbers for the same picture in eval(): {_DRAWS}",
        )
    return Trial(counted.operations / (y * x), counted.memory / (y * x))


_CHANGES = "changes its input: work on a copy, such as picture.clone()"
_DRAWS = "draw random numbers only while self.training is true, and keep no state from call to call"


def tried(
    architecture: Architecture, parameters: dict[str, Any] | None, multiple: int | None
) -> Trial:
    """Return the cost of a call of a class; it is cached for this class and these parameters."""
    text = json.dumps(parameters, sort_keys=True, default=str)
    return _tried(architecture, text, multiple)


@functools.lru_cache(maxsize=32)
def _tried(architecture: Architecture, parameters: str, multiple: int | None) -> Trial:
    return try_network(own_network(architecture, json.loads(parameters), multiple))


class _Counting(TorchFunctionMode):
    """A torch function mode that counts operations, and the bytes of all results that do not share
    memory with their input.
    """

    def __init__(self) -> None:
        super().__init__()
        self.operations, self.memory = 0.0, 0.0

    def __torch_function__(self, func: Any, types: Any, args: Any = (), kwargs: Any = None) -> Any:
        """Run a torch function; count its operations and bytes if its result is in new memory."""
        result = func(*args, **(kwargs or {}))
        input_tensors = [x for x in args if isinstance(x, Tensor)]
        if isinstance(result, Tensor) and result.data_ptr() not in [
            x.data_ptr() for x in input_tensors
        ]:
            self.operations += _operations(getattr(func, "__name__", ""), input_tensors, result)
            self.memory += result.nbytes
        return result


def _operations(name: str, tensors: list[Tensor], result: Tensor) -> float:
    """Return the operations of a torch function: two for each product of a layer, otherwise one for
    each element of the result.
    """
    if name.startswith("conv_transpose"):
        # `tensors[1]` are the weights; `tensors[1][0]` are those of one input (transposed) or of
        # one output channel
        return 2.0 * tensors[0].numel() * tensors[1][0].numel()
    if name.startswith(("conv", "linear")):
        return 2.0 * result.numel() * tensors[1][0].numel()
    if name in ("matmul", "__matmul__", "bmm", "mm", "scaled_dot_product_attention"):
        return 2.0 * result.numel() * tensors[0].shape[-1]
    return float(result.numel())


def _sizes(picture: Tensor) -> str:
    return " x ".join(map(str, picture.shape))


def _listed(parameters: Mapping[str, Any] | None) -> str:
    return ", ".join(f"{name}={value!r}" for name, value in (parameters or {}).items())
