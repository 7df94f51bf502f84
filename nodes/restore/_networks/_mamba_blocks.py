"""Blocks of the FFT-Mamba network, which combine selective scans of a picture and of the spectrum of the picture."""

import functools
from typing import Any, Literal

import torch
from torch import Tensor, nn
from torch.nn import functional as F

from neusee.nodes._half_precision import single
from neusee.nodes.restore._networks._restorer import ChannelNorm, Scale, gated
from neusee.nodes.restore._networks._scan_layer import BothWays, Kind

Directions = Literal[2, 4]  #: 2: a block scans rows or columns; 4: both
Form = Literal["complex", "amp_phase"]  #: the numbers that represent a spectrum in a scan and in its gate
SMALL = 1e-4  #: added to the square of an amplitude, so that gradients stay finite


class Spatial(nn.Module):
    """A layer that applies selective scans along the rows or columns of a picture, or both, and gates the result."""

    def __init__(
        self, width: int, states: int, by_columns: bool, kind: Kind = "s6", directions: Directions = 2
    ) -> None:
        super().__init__()
        inner, self.by_columns = 2 * width, by_columns
        self.enter = nn.Conv2d(width, 2 * inner, 1)
        self.mix = nn.Conv2d(inner, inner, 3, padding=1, groups=inner)
        self.scan = BothWays(inner, states, -(-width // 16), kind)
        self.across = BothWays(inner, states, -(-width // 16), kind) if directions == 4 else None
        self.norm = nn.LayerNorm(inner)
        self.leave = nn.Conv2d(inner, width, 1)

    def forward(self, x: Tensor) -> Tensor:
        value, gate = self.enter(x).chunk(2, 1)
        value = F.silu(self.mix(value))
        scanned = _along(self.scan, value, self.by_columns)
        if self.across is not None:
            scanned = scanned + _along(self.across, value, not self.by_columns)
        scanned = self.norm(scanned.movedim(1, -1)).movedim(-1, 1)
        result: Tensor = self.leave(scanned * F.silu(gate))
        return result


def _along(scan: nn.Module, value: Tensor, by_columns: bool) -> Tensor:
    """Apply a selective scan along the rows of a picture (n, channel, y, x), or the columns if ``by_columns``."""
    value = value.mT if by_columns else value
    scanned: Tensor = scan(value.flatten(2).transpose(1, 2)).transpose(1, 2).unflatten(2, value.shape[-2:])
    return scanned.mT if by_columns else scanned


class _Phase(torch.autograd.Function):
    """The angle of a complex number z, with a finite gradient: |z|**2 + `SMALL` replaces |z|**2."""

    @staticmethod
    def forward(ctx: Any, real: Tensor, imaginary: Tensor) -> Tensor:
        ctx.save_for_backward(real, imaginary)
        return torch.atan2(imaginary, real)

    @staticmethod
    def backward(ctx: Any, *seen: Tensor) -> tuple[Tensor, Tensor]:
        real, imaginary = ctx.saved_tensors
        slope = seen[0] / (real.square() + imaginary.square() + SMALL)
        return -slope * imaginary, slope * real


@functools.lru_cache(maxsize=32)
def radial_order(size: tuple[int, int], device: torch.device) -> tuple[Tensor, Tensor]:
    """Return the positions in the half spectrum of a (y, x) picture by rising radius, and the rank of each position.

    Radii are in cycles per pixel. Equal radii are ordered by angle, from -90 to 90 degrees.
    """
    y, x = size
    with torch.inference_mode(False):  # the cache may serve a caller that trains
        rows = torch.fft.fftfreq(y, 1 / y, dtype=torch.float64).round().long()[:, None] * x
        columns = torch.arange(x // 2 + 1)[None] * y
        radius = (rows * rows + columns * columns).flatten()  # whole numbers, so that equal radii compare equal
        angle = torch.atan2(rows.double(), columns.double()).flatten()
        order = angle.argsort(stable=True)
        order = order[radius[order].argsort(stable=True)]
        return order.to(device), order.argsort().to(device)


class Frequency(nn.Module):
    """A layer that multiplies the spectrum of a picture by a gate, computed by selective scans over frequency.

    The gate uses real and imaginary parts, because phase has no gradient at 0. Amplitude and phase, ``amp_phase``, are
    for comparison. At the start of training the gate is close to 1 and the picture passes almost unchanged.
    """

    def __init__(self, width: int, states: int, kind: Kind = "s6", form: Form = "complex") -> None:
        super().__init__()
        self.form = form
        self.norm = nn.LayerNorm(2 * width)
        self.enter = nn.Linear(2 * width, 2 * width)
        self.scan = BothWays(width, states, -(-width // 16), kind)
        self.scanned = nn.LayerNorm(width)
        self.leave = nn.Linear(width, 2 * width)
        self.strength = nn.Parameter(torch.empty(()))

    def start(self, rng: torch.Generator) -> None:
        nn.init.constant_(self.strength, 0.1)

    def forward(self, x: Tensor) -> Tensor:
        x, size = single(x), (x.shape[-2], x.shape[-1])
        order, place = radial_order(size, x.device)
        with torch.autocast(x.device.type, enabled=False):  # FFTs need full precision
            spectrum = torch.fft.rfft2(x, norm="ortho")
            sorted_ = spectrum.flatten(2).index_select(2, order)
            seen = self.norm(torch.cat(self._parts(sorted_), 1).transpose(1, 2))
        value, gate = self.enter(seen).chunk(2, -1)
        drawn = single(self.leave(self.scanned(self.scan(F.silu(value))) * F.silu(gate)))
        first, second = drawn.transpose(1, 2).index_select(2, place).chunk(2, 1)
        with torch.autocast(x.device.type, enabled=False):
            factor = self._factor(first, second).view_as(spectrum)
            result: Tensor = torch.fft.irfft2(spectrum * factor, s=size, norm="ortho")
        return result

    def _parts(self, spectrum: Tensor) -> tuple[Tensor, Tensor]:
        real, imaginary = spectrum.real, spectrum.imag
        if self.form == "complex":
            return real, imaginary
        phase: Tensor = _Phase.apply(real, imaginary)  # type: ignore[no-untyped-call]
        return (real.square() + imaginary.square() + SMALL).sqrt(), phase

    def _factor(self, first: Tensor, second: Tensor) -> Tensor:
        """Return the factor near 1 that multiplies the spectrum, in complex form or from amplitude and phase."""
        if self.form == "complex":
            return 1 + self.strength * torch.complex(first, second)
        amplitude, turn = 1 + self.strength * first, self.strength * second
        return torch.complex(amplitude * turn.cos(), amplitude * turn.sin())


class Block(nn.Module):
    """A block that mixes selective scans of a picture and of its spectrum, with a gated feed-forward layer."""

    def __init__(
        self,
        width: int,
        states: int,
        by_columns: bool,
        kind: Kind = "s6",
        directions: Directions = 2,
        form: Form = "complex",
    ) -> None:
        super().__init__()
        self.norm, self.second_norm = ChannelNorm(width), ChannelNorm(width)
        self.spatial = Spatial(width, states, by_columns, kind, directions)
        self.frequency = Frequency(width, states, kind, form)
        self.weigh = nn.Conv2d(2 * width, width, 1)
        self.widen = nn.Conv2d(width, 4 * width, 1)
        self.mix = nn.Conv2d(4 * width, 4 * width, 3, padding=1, groups=4 * width)
        self.narrow = nn.Conv2d(2 * width, width, 1)
        self.scale, self.second_scale = Scale(width), Scale(width)

    def forward(self, x: Tensor) -> Tensor:
        seen = self.norm(x)
        near, far = self.spatial(seen), self.frequency(seen)
        share = torch.sigmoid(self.weigh(torch.cat([near.to(far), far], 1)))
        x = x + self.scale(share * near + (1 - share) * far)
        result: Tensor = x + self.second_scale(self.narrow(gated(self.mix(self.widen(self.second_norm(x))))))
        return result
