"""One axis of the scaled Fourier transform, and how its phases stay exact."""

import math
from collections.abc import Callable
from dataclasses import dataclass

import torch
from torch import Tensor

Source = Callable[
    [int, int, Tensor], None
]  #: fill ``planes`` (2, stop - start, n_in) with rows start..stop of the field
Sink = Callable[[slice, slice, Tensor], None]
#: take a patch (2, ..., columns) of the result, re and im; what stands between, flattened, are the rows


@dataclass(frozen=True, slots=True)
class Axis:
    """The sum ``U[k] = sum_j P[j] exp(sign 2 pi i alpha (j - j0) (k - k0))``, j0 and k0 the middles of both grids."""

    n_in: int
    n_out: int
    alpha: float  #: turns per sample and sample: pitch times pitch over wavelength and focal length
    sign: int = -1

    def adjoint(self) -> "Axis":
        """The conjugate transpose, itself such an axis."""
        return Axis(self.n_out, self.n_in, self.alpha, -self.sign)

    @property
    def bandwidth(self) -> float:
        """Time-bandwidth product: how many samples this transform really carries."""
        return self.alpha * self.n_in * self.n_out


def centred(n: int, device: torch.device) -> Tensor:
    """Coordinates ``j - (n - 1) / 2``, float64."""
    return torch.arange(n, dtype=torch.float64, device=device) - (n - 1) / 2


def radians(turns: Tensor) -> Tensor:
    """Phase of float64 ``turns`` after whole turns are taken off, so that a cast to float32 costs 2e-7 rad."""
    return (turns - turns.round()).mul_(2 * math.pi)


def unit_phasor(turns: Tensor, dtype: torch.dtype) -> Tensor:
    """``exp(2 pi i turns)`` as complex of the real ``dtype``."""
    angle = radians(turns).to(dtype)
    return torch.complex(angle.cos(), angle.sin())


def patch_of(x: Tensor, rows: slice, columns: slice, like: Tensor) -> Tensor:
    """View of ``x[..., rows, columns]`` with its rows split as in ``like``, a patch that a sink was given."""
    part = x[..., rows, columns]
    return part.view(*x.shape[:-2], *like.shape[1:])


def row_chunks(rows: int, columns: int, elements: int = 1 << 19) -> list[tuple[int, int]]:
    """Ranges of rows small enough that what happens to them stays in cache."""
    step = max(1, min(rows, elements // max(columns, 1)))
    return [(start, min(start + step, rows)) for start in range(0, rows, step)]
