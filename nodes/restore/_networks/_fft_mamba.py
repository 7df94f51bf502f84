"""The restoring network of the paper: selective scans of a picture and its spectrum, first at half the size."""

from functools import partial

import torch
from torch import Tensor, nn
from torch.nn import functional as F

from neusee.nodes import node
from neusee.nodes.bicubic_resize import resize
from neusee.nodes.restore._networks._mamba_blocks import Block, Directions, Form
from neusee.nodes.restore._networks._restorer import PictureRestorer, Tile, fitting, restored, restorer_checks
from neusee.nodes.restore._networks._scan_layer import Kind
from neusee.nodes.units import Count, DataFile, Layers


class FFTMamba(PictureRestorer):
    """The FFT-Mamba network, whose blocks scan rows and columns in turn, with the same weights at half and full size.

    The first pass computes a coarse estimate, from which the second pass computes a fine estimate. With ``directions``
    4 every block scans rows and columns. With ``pyramid`` the network runs once, and the coarse estimate is the reduced
    fine estimate. Eight blocks, two scales and the modules are those of the paper. The sizes and connections of the
    modules are our choice.
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
        """Return the picture plus the correction that the network predicts from the picture and a first estimate."""
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
    ssm: Kind = "s6",
    directions: Directions = 2,
    pyramid: bool = False,
    frequency: Form = "complex",
    tile: Tile | None = None,
    reduce: Count = 1,
    detail: bool = False,
) -> Tensor:
    """Restore a colour picture with the FFT-Mamba network.

    Each block scans the picture in both directions along rows or columns, scans the spectrum from low to high
    frequencies and back to compute a gate for the spectrum, and weighs both. One pass runs at half the size; one pass
    at the full size takes the result of the first pass.
    ``tile``: a larger picture is restored in overlapping pieces of this side. Use the side of the training pictures,
    because a network is less accurate on longer scans. ``reduce``: the picture is reduced by this factor first and
    enlarged again afterwards, for an element behind which finer detail is lost. ``detail``: the finer detail is added
    unchanged, for a deconvolved picture, in which finer detail is not lost.
    ``ssm`` is the scan: s6 has a decay for each channel and state; ssd has a decay for 16 channels, by matrix products.
    ``directions`` 4: each block scans rows and columns. ``pyramid``: one pass, at the full size. ``frequency``
    amp_phase, for comparison: the gate is computed from amplitude and phase, and changes amplitude and phase.

    Shapes: picture (3, y, x) of any size -> (3, y, x).
    Units:  linear sRGB, as in the training of the weights.
    Error:  float32, 1e-5; of the restoration, the error that the training reached.
    Raises: ParameterError before the run without weights, or where the weights do not fit; ValueError for a picture
            that is not a colour picture or not finite.
    Source: NeuSee, section Image Restoration; Gu and Dao, Mamba, 2023 (s6), Dao and Gu, Mamba-2, 2024
            (ssd); sizes and connections are ours.
    """
    kind = partial(FFTMamba, width, blocks, states, shuffle, ssm, directions, pyramid, frequency)
    return restored(picture, kind, weights, tile, reduce, detail)


fft_mamba.preflight(partial(fitting, FFTMamba))
fft_mamba.check(restorer_checks)
