"""Common parts of all transforms: axes, phasors with a precise phase, reusable buffers."""

import contextlib
import math
import threading
from collections.abc import Callable, Iterator
from dataclasses import dataclass
from math import prod

import torch
from torch import Tensor

# --- workspace ------------------------------------------------------------------------------------

# Reusable buffers: the page faults of a new 100 MB buffer take longer than the transform that fills
# the buffer.


__depends__ = ("unaffected:_idle",)
_MOST_IDLE_WORKSPACES = 2
_idle: list["Workspace"] = []
_lock = threading.Lock()


class Workspace:
    """Named buffers for one thread at a time; each name returns the same memory, enlarged for
    larger requests.
    """

    def __init__(self, dtype: torch.dtype, device: torch.device) -> None:
        self.dtype, self.device = dtype, device
        self._flat: dict[tuple[str, torch.dtype], Tensor] = {}

    def take(self, name: str, *shape: int, dtype: torch.dtype | None = None) -> Tensor:
        """Return an uninitialised buffer; an earlier buffer of the same name and type is
        overwritten.
        """
        key = (name, dtype or self.dtype)
        buffer, size = self._flat.get(key), prod(shape)
        if buffer is None or buffer.numel() < size:
            self._flat.pop(key, None)
            buffer = self._flat[key] = torch.empty(size, dtype=key[1], device=self.device)
        return buffer[:size].view(shape)


@contextlib.contextmanager
def borrowed(dtype: torch.dtype, device: torch.device) -> Iterator[Workspace]:
    """Yield a workspace that no other thread uses; at most two idle workspaces are kept."""
    with _lock:
        idle_fitting = [w for w in _idle if (w.dtype, w.device) == (dtype, device)]
        work = idle_fitting[-1] if idle_fitting else Workspace(dtype, device)
        if idle_fitting:
            _idle.remove(work)
    try:
        yield work
    finally:
        with _lock:
            _idle.append(work)
            del _idle[:-_MOST_IDLE_WORKSPACES]


# --- sample axis ----------------------------------------------------------------------------------

# The axes of the scaled Fourier transform, and phasors with an exact phase.


Source = Callable[
    [int, int, Tensor], None
]  #: fills ``planes`` (2, stop - start, n_in) with rows start..stop of the field
Sink = Callable[[slice, slice, Tensor], None]
#: takes a patch (2, ..., columns) of the result, re and im; the dimensions between are the rows,
#: unflattened

#: the last axis is transformed in float64 if it takes less than this share of the time of the first
FLOAT64_WORK_SHARE = 1 / 10


@dataclass(frozen=True, slots=True)
class Axis:
    """An axis of ``U[k] = sum_j P[j] exp(sign 2 pi i alpha (j - j0) (k - k0))``; j0 and k0 are
    the centres.
    """

    n_in: int
    n_out: int
    #: turns per input and output sample: pitch x pitch / (wavelength x focal length)
    alpha: float
    sign: int = -1

    def adjoint(self) -> "Axis":
        """Return the axis of the adjoint transform."""
        return Axis(self.n_out, self.n_in, self.alpha, -self.sign)

    @property
    def bandwidth(self) -> float:
        """Return the time-bandwidth product: the number of independent samples of the transform."""
        return self.alpha * self.n_in * self.n_out


def centred(n: int, device: torch.device) -> Tensor:
    """Return the coordinates ``j - (n - 1) / 2`` of n samples about their centre, float64."""
    return torch.arange(n, dtype=torch.float64, device=device) - (n - 1) / 2


def radians(turns: Tensor) -> Tensor:
    """Return the phase ``turns`` modulo one turn, in radians, so that a cast to float32 is exact
    to 2e-7 rad.
    """
    return (turns - turns.round()).mul_(2 * math.pi)


def unit_phasor(turns: Tensor, dtype: torch.dtype) -> Tensor:
    """Return ``exp(2 pi i turns)`` as a complex tensor of the real ``dtype``."""
    angle = radians(turns).to(dtype)
    return torch.complex(angle.cos(), angle.sin())


def last_type(
    first: float, last: float, dtype: torch.dtype, little: float = FLOAT64_WORK_SHARE
) -> torch.dtype:
    """Return the type of the transform along the last axis, from the times along the first and the
    last axis.

    The type is float64 if this costs little time. The round-off of the first axis averages out
    along the last axis; the round-off of the last axis does not. In float32, the error of the last
    axis is about 2^-24 of the brightest field. This is 1.2e-3 of an intensity that is 1e-8 of the
    brightest pixel.
    """
    return torch.float64 if last <= little * first else dtype


def patch_view(x: Tensor, rows: slice, columns: slice, like: Tensor) -> Tensor:
    """Return a view of ``x[..., rows, columns]`` in the shape of the patch ``like``."""
    view = x[..., rows, columns]
    return view.view(*x.shape[:-2], *like.shape[1:])


def row_chunks(rows: int, columns: int, elements: int = 1 << 19) -> list[tuple[int, int]]:
    """Return ranges of rows of an array, each of which fits in the CPU's cache."""
    step = max(1, min(rows, elements // max(columns, 1)))
    return [(start, min(start + step, rows)) for start in range(0, rows, step)]
