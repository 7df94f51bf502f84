"""The paper's restoration: a network that scans a picture and its spectrum, coarse and then fine."""

from functools import partial
from pathlib import Path
from typing import Any

import torch
from torch import Tensor, nn
from torch.nn import functional as F

from neusee.nodes import node
from neusee.nodes.bicubic_resize import resize
from neusee.nodes.restore._networks._mamba_blocks import Block, Directions, Form
from neusee.nodes.restore._networks._restorer import Restorer, Tile, fitting, restored, restorer_checks
from neusee.nodes.restore._networks._scan_layer import Kind
from neusee.nodes.units import Count, DataFile


class FFTMamba(Restorer):
    """Blocks that take turns between rows and columns; two passes with the same weights, the fine one shown the coarse.

    With ``directions`` 4 every block scans both. As a ``pyramid`` it has one pass, and the coarse estimate is the fine
    one made smaller. Published: eight blocks, two scales, which modules there are. Ours: their sizes and how they are
    put together.
    """

    def __init__(
        self,
        width: int = 64,
        blocks: int = 8,
        states: int = 16,
        shuffle: int = 2,
        ssm: Kind = "s6",
        directions: Directions = 2,
        pyramid: bool = False,
        frequency: Form = "complex",
    ) -> None:
        super().__init__()
        self.shuffle, self.multiple, self.one_pass = shuffle, 2 * shuffle, pyramid
        self.options = {"ssm": ssm, "directions": directions, "pyramid": pyramid, "frequency": frequency}
        inside = 3 * shuffle**2
        self.enter = nn.Conv2d(2 * inside, width, 3, padding=1)
        self.blocks = nn.Sequential(
            *(Block(width, states, bool(i % 2), ssm, directions, frequency) for i in range(blocks))
        )
        self.leave = nn.Conv2d(width, width, 3, padding=1)
        self.last = nn.Conv2d(width, inside, 3, padding=1)

    def scales(self, picture: Tensor) -> tuple[Tensor, Tensor]:
        y, x = picture.shape[-2:]
        if self.one_pass:
            fine = self.improved(picture, picture)
            return resize(fine, y // 2, x // 2), fine
        small = resize(picture, y // 2, x // 2)
        coarse = self.improved(small, small)
        return coarse, self.improved(picture, resize(coarse, y, x))

    def improved(self, picture: Tensor, guess: Tensor) -> Tensor:
        """One pass: the picture with what is missing, seen beside a first guess of the restored one."""
        first = self.enter(F.pixel_unshuffle(torch.cat([picture, guess], 1), self.shuffle))
        missing = self.last(first + self.leave(self.blocks(first)))
        return picture + F.pixel_shuffle(missing, self.shuffle)


@node()
def fft_mamba(
    picture: Tensor,
    *,
    weights: DataFile | None = None,
    width: Count = 64,
    blocks: Count = 8,
    states: Count = 16,
    shuffle: Count = 2,
    ssm: Kind = "s6",
    directions: Directions = 2,
    pyramid: bool = False,
    frequency: Form = "complex",
    tile: Tile | None = None,
    reduce: Count = 1,
    detail: bool = False,
) -> Tensor:
    """Restore a colour picture with the FFT-Mamba network.

    Each block scans the picture there and back by rows or by columns, scans its spectrum from low to high frequencies
    and back to draw a gate for it, and weighs both. One pass at half the size; one at the full size, which sees it.
    ``tile``: a larger picture is restored in pieces of this side, which overlap: give that of the pictures it learnt
    from, for the longer a scan, the less a network knows it. ``reduce``: it is made smaller by this factor before, and
    larger again afterwards, where all that is finer is lost behind an element; ``detail``: where it is not, because the
    picture is deconvolved, what is finer stays as it was.
    ``ssm`` is the scan: s6 has a decay for each channel and state, ssd one for 16 channels, of which matrices are made.
    ``directions`` 4: each block scans rows and columns. ``pyramid``: one pass, at the full size. ``frequency``
    amp_phase, to compare: the gate is drawn from amplitude and phase, and turns and scales.

    Shapes: picture (3, y, x) of any size -> (3, y, x).
    Units:  linear sRGB, as the weights were trained on.
    Error:  float32, 1e-5; of the restoration, what the training reached.
    Raises: ParameterError before the run without weights, or where they do not fit; ValueError for a picture
            that is no colour picture or not finite.
    Source: NeuSee, section Image Restoration; Gu and Dao, Mamba, 2023 (s6), Dao and Gu, Mamba-2, 2024
            (ssd); sizes and wiring are ours.
    """
    kind = partial(FFTMamba, width, blocks, states, shuffle, ssm, directions, pyramid, frequency)
    return restored(picture, kind, weights, tile, reduce, detail)


@fft_mamba.preflight
def _(
    *, weights: Path | None = None, tile: int | None = None, reduce: int = 1, detail: bool = False, **sizes: Any
) -> list[str]:
    return fitting(partial(FFTMamba, **sizes), weights, sizes["width"])


@fft_mamba.check
def _(result: Tensor, picture: Tensor, **params: Any) -> list[Any]:
    return restorer_checks(result, picture)
