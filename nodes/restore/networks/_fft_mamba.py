"""The restoration network of the paper: selective scans of a picture and its spectrum."""

import functools
import math
from collections.abc import Mapping
from functools import partial
from typing import Any

import torch
from torch import Tensor, nn
from torch.nn import functional as F

from neusee.nodes import node
from neusee.nodes.precision import single
from neusee.nodes.resampling import resize
from neusee.nodes.restore.networks._restorer import (
    ChannelNorm,
    PictureRestorer,
    Scale,
    Tile,
    fitting,
    gated,
    restored,
    restorer_checks,
)
from neusee.nodes.restore.networks._selective_scan import selective_scan
from neusee.nodes.units import Count, DataFile, Layers

# --- scan layer -----------------------------------------------------------------------------------

# Trainable layers for selective scans, with the initial values of their time steps and decay rates.


#: range of the initial time steps of a scan, log-uniform: a memory of 10 to 1000 positions
STEPS = (1e-3, 0.1)


class Scan(nn.Module):
    """A selective scan along a sequence (n, length, channel), whose time step, input and output
    weights are computed from the sequence.
    """

    def __init__(self, channels: int, states: int, rank: int) -> None:
        """Build a scan of ``channels`` with ``states`` state variables each; the time steps are
        computed from ``rank`` features.
        """
        super().__init__()
        self.sizes = [rank, states, states]
        self.read = nn.Linear(channels, sum(self.sizes), bias=False)
        self.rate = nn.Linear(rank, channels, bias=False)
        self.dt_bias = nn.Parameter(torch.empty(channels))
        self.A_log = nn.Parameter(torch.empty(channels, states))
        self.D = nn.Parameter(torch.empty(channels))

    def start(self, rng: torch.Generator) -> None:
        """Set random time steps and fixed decay rates for the start of training.

        Zero biases would give a memory of one position.
        """
        self.dt_bias.copy_(_first_steps(len(self.D), rng))
        self.A_log.copy_(
            torch.arange(1.0, 1.0 + self.A_log.shape[1], device=rng.device)
            .log()
            .expand_as(self.A_log)
        )
        self.D.fill_(1.0)

    def forward(self, u: Tensor) -> Tensor:
        rate, input_weight, output_weight = self.read(u).split(self.sizes, -1)
        rate = single(self.rate(rate))
        with torch.autocast(u.device.type, enabled=False):
            u, step, decay = single(u), _step(rate, self.dt_bias), _decay(self.A_log)
            return selective_scan(
                u, step, decay, single(input_weight), single(output_weight), self.D
            ).to(u.dtype)


class BothWays(nn.Module):
    """The sum of a forward and a backward selective scan, each with its own weights."""

    def __init__(self, channels: int, states: int, rank: int) -> None:
        super().__init__()
        self.there, self.back = (Scan(channels, states, rank) for _ in range(2))

    def forward(self, u: Tensor) -> Tensor:
        result: Tensor = self.there(u) + self.back(u.flip(1)).flip(1)
        return result


def _first_steps(count: int, rng: torch.Generator) -> Tensor:
    """Return random biases whose softplus, the time step, is log-uniform in the range `STEPS`."""
    low, high = map(math.log, STEPS)
    steps = torch.rand(count, generator=rng, device=rng.device).mul_(high - low).add_(low).exp_()
    # inverse of softplus: log(exp(step) - 1) = step + log(1 - exp(-step))
    return steps + torch.log(-torch.expm1(-steps))


def _step(rate: Tensor, bias: Tensor) -> Tensor:
    """Return the time step softplus(rate + bias), limited to the range in which the scan is
    precise.
    """
    return F.softplus(rate + bias).clamp(1e-5, 8.0)


def _decay(A_log: Tensor) -> Tensor:
    """Return the negative decay rate -exp(A_log), limited to a finite range."""
    return -torch.exp(A_log.clamp(-12.0, 6.0))


# --- mamba blocks ---------------------------------------------------------------------------------

# Blocks of the FFT-Mamba network, which combine selective scans of a picture and of the spectrum of
# the picture.


class Spatial(nn.Module):
    """A layer of selective scans along the rows or columns of a picture, whose result is multiplied
    by a gate.
    """

    def __init__(self, width: int, states: int, by_columns: bool) -> None:
        """Build a layer for ``width`` channels; inside it has twice as many, with ``states`` state
        variables each.
        """
        super().__init__()
        inner, self.by_columns = 2 * width, by_columns
        self.enter = nn.Conv2d(width, 2 * inner, 1)
        self.mix = nn.Conv2d(inner, inner, 3, padding=1, groups=inner)
        self.scan = BothWays(inner, states, -(-width // 16))
        self.norm = nn.LayerNorm(inner)
        self.leave = nn.Conv2d(inner, width, 1)

    def forward(self, x: Tensor) -> Tensor:
        value, gate = self.enter(x).chunk(2, 1)
        value = F.silu(self.mix(value))
        scanned = _along(self.scan, value, self.by_columns)
        scanned = self.norm(scanned.movedim(1, -1)).movedim(-1, 1)
        result: Tensor = self.leave(scanned * F.silu(gate))
        return result


def _along(scan: nn.Module, value: Tensor, by_columns: bool) -> Tensor:
    """Apply a selective scan along the rows of a picture (n, channel, y, x), or the columns if
    ``by_columns``.
    """
    value = value.mT if by_columns else value
    scanned: Tensor = (
        scan(value.flatten(2).transpose(1, 2)).transpose(1, 2).unflatten(2, value.shape[-2:])
    )
    return scanned.mT if by_columns else scanned


@functools.lru_cache(maxsize=32)
def radial_order(size: tuple[int, int], device: torch.device) -> tuple[Tensor, Tensor]:
    """Return the flat indices of the half spectrum of a (y, x) picture in order of radius, and the
    rank of each index in this order.

    Radii are in cycles per pixel. Equal radii are ordered by angle, from -90 to 90 degrees.
    """
    y, x = size
    with torch.inference_mode(False):  # a later caller, which trains, may get the cached tensors
        # (fy / y)^2 + (fx / x)^2, times (x y)^2
        rows = torch.fft.fftfreq(y, 1 / y, dtype=torch.float64).round().long()[:, None] * x
        columns = torch.arange(x // 2 + 1)[None] * y
        # integers, so that equal radii compare as equal
        radius = (rows * rows + columns * columns).flatten()
        angle = torch.atan2(rows.double(), columns.double()).flatten()
        # sorted by radius, and by angle where radii are equal
        order = angle.argsort(stable=True)
        order = order[radius[order].argsort(stable=True)]
        return order.to(device), order.argsort().to(device)


class Frequency(nn.Module):
    """A layer that multiplies the spectrum of a picture by a gate, computed by selective scans over
    frequency.

    The gate uses real and imaginary parts, because phase has no gradient at 0. At the start of
    training the gate is close to 1 and the picture passes almost unchanged.
    """

    def __init__(self, width: int, states: int) -> None:
        """Build a layer for ``width`` channels, whose real and imaginary parts enter side by
        side.
        """
        super().__init__()
        self.norm = nn.LayerNorm(2 * width)
        self.enter = nn.Linear(2 * width, 2 * width)
        self.scan = BothWays(width, states, -(-width // 16))
        self.scanned = nn.LayerNorm(width)
        self.leave = nn.Linear(width, 2 * width)
        self.strength = nn.Parameter(torch.empty(()))

    def start(self, rng: torch.Generator) -> None:
        nn.init.constant_(self.strength, 0.1)

    def forward(self, x: Tensor) -> Tensor:
        x, size = single(x), (x.shape[-2], x.shape[-1])
        order, rank = radial_order(size, x.device)
        with torch.autocast(x.device.type, enabled=False):  # FFTs need full precision
            spectrum = torch.fft.rfft2(x, norm="ortho")
            by_radius = spectrum.flatten(2).index_select(2, order)
            parts = torch.cat([by_radius.real, by_radius.imag], 1)
            features = self.norm(parts.transpose(1, 2))
        scan_input, gate = self.enter(features).chunk(2, -1)
        changes = single(self.leave(self.scanned(self.scan(F.silu(scan_input))) * F.silu(gate)))
        real, imaginary = changes.transpose(1, 2).index_select(2, rank).chunk(2, 1)
        with torch.autocast(x.device.type, enabled=False):
            factor = (1 + self.strength * torch.complex(real, imaginary)).view_as(spectrum)
            result: Tensor = torch.fft.irfft2(spectrum * factor, s=size, norm="ortho")
        return result


class Block(nn.Module):
    """A block: a weighted mean of scans of a picture and of its spectrum, then a gated feed-forward
    layer.
    """

    def __init__(self, width: int, states: int, by_columns: bool) -> None:
        """Build a block for ``width`` channels; its feed-forward layer has four times as many."""
        super().__init__()
        self.norm, self.second_norm = ChannelNorm(width), ChannelNorm(width)
        self.spatial = Spatial(width, states, by_columns)
        self.frequency = Frequency(width, states)
        self.weigh = nn.Conv2d(2 * width, width, 1)
        self.widen = nn.Conv2d(width, 4 * width, 1)
        self.mix = nn.Conv2d(4 * width, 4 * width, 3, padding=1, groups=4 * width)
        self.narrow = nn.Conv2d(2 * width, width, 1)
        self.scale, self.second_scale = Scale(width), Scale(width)

    def forward(self, x: Tensor) -> Tensor:
        features = self.norm(x)
        near, far = self.spatial(features), self.frequency(features)
        share = torch.sigmoid(self.weigh(torch.cat([near.to(far), far], 1)))
        x = x + self.scale(share * near + (1 - share) * far)
        result: Tensor = x + self.second_scale(
            self.narrow(gated(self.mix(self.widen(self.second_norm(x)))))
        )
        return result


# --- fft mamba ------------------------------------------------------------------------------------

# The restoration network of the paper: selective scans of a picture and its spectrum, first at half
# size.


class FFTMamba(PictureRestorer):
    """The FFT-Mamba network, whose blocks scan rows and columns in turn, with the same weights at
    half and full size.

    The first pass computes a coarse estimate, from which the second pass computes a fine estimate.
    Eight blocks, two scales and the modules are those of the paper. The sizes and connections of
    the modules are our choice.
    """

    #: metadata in a file of weights. Earlier versions had other values and tensors of the same
    #: shapes, so a file with other metadata is refused
    options: Mapping[str, Any] = {"directions": 2, "pyramid": False, "frequency": "complex"}

    def __init__(
        self, width: int = 64, blocks: int = 8, states: int = 16, shuffle: int = 2
    ) -> None:
        """Build the network with ``width`` channels and ``blocks`` blocks, whose scans have
        ``states`` state variables for each channel.

        Squares of ``shuffle`` x ``shuffle`` pixels become channels (pixel unshuffle).
        """
        super().__init__()
        self.shuffle, self.multiple = shuffle, 2 * shuffle
        # channels of a shuffled colour picture
        inside = 3 * shuffle**2
        self.enter = nn.Conv2d(2 * inside, width, 3, padding=1)
        self.blocks = nn.Sequential(*(Block(width, states, bool(i % 2)) for i in range(blocks)))
        self.leave = nn.Conv2d(width, width, 3, padding=1)
        self.last = nn.Conv2d(width, inside, 3, padding=1)

    def scales(self, picture: Tensor) -> tuple[Tensor, Tensor]:
        y, x = picture.shape[-2:]
        half_picture = resize(picture, y // 2, x // 2)
        coarse = self.improved(half_picture, half_picture)
        return coarse, self.improved(picture, resize(coarse, y, x))

    def improved(self, picture: Tensor, guess: Tensor) -> Tensor:
        """Return the picture plus the correction that the network predicts from the picture and
        a first estimate.
        """
        first = self.enter(F.pixel_unshuffle(torch.cat([picture, guess], 1), self.shuffle))
        missing = self.last(first + self.leave(self.blocks(first)))
        return picture + F.pixel_shuffle(missing, self.shuffle)


@node()
def fft_mamba(
    picture: Tensor,
    *,
    weights: DataFile | None = None,
    width: Layers = 64,
    blocks: Layers = 8,
    states: Layers = 16,
    shuffle: Count = 2,
    tile: Tile | None = None,
    reduce: Count = 1,
    detail: bool = False,
) -> Tensor:
    """Restore a colour picture with the FFT-Mamba network.

    Each block scans the picture in both directions along rows or columns, scans the spectrum from
    low to high frequencies and back to compute a gate for the spectrum, and weighs both. One pass
    runs at half the size; one pass at the full size takes the result of the first pass.
    ``tile``: a larger picture is restored in overlapping pieces of this side. Use the side of the
    training pictures, because a network is less accurate on longer scans. ``reduce``: the picture
    is reduced by this factor first and enlarged again afterwards, for an element behind which finer
    detail is lost. ``detail``: the finer detail is added unchanged, for a deconvolved picture, in
    which finer detail is not lost.

    Shapes: picture (3, y, x) of any size -> (3, y, x).
    Units:  linear sRGB, as in the training of the weights.
    Error:  float32, 1e-5; of the restoration, the error that the training reached.
    Raises: ParameterError before the run without weights, or where the weights do not fit;
            ValueError for a picture that is not a colour picture or not finite.
    Source: NeuSee, section Image Restoration; Gu and Dao, Mamba, 2023; sizes and connections
            are ours.
    """
    kind = partial(FFTMamba, width, blocks, states, shuffle)
    return restored(picture, kind, weights, tile, reduce, detail)


fft_mamba.preflight(partial(fitting, FFTMamba))
fft_mamba.check(restorer_checks)
