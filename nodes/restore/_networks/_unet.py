"""A standard UNet, a baseline for restoring networks that use spectra and selective scans."""

from functools import partial
from itertools import pairwise

import torch
from torch import Tensor, nn

from neusee.nodes import node
from neusee.nodes.restore._networks._restorer import LEAK, LEAKY, Flat, Tile, fitting, restored, restorer_checks
from neusee.nodes.units import Count, DataFile, Layers


class UNet(Flat):
    """A network whose encoder halves size and doubles channels three times, with skips to a mirrored decoder."""

    multiple, gain = 8, LEAKY

    def __init__(self, width: int = 32) -> None:
        super().__init__()
        sizes = [width, 2 * width, 4 * width, 8 * width]
        self.down = nn.ModuleList(_pair(a, b) for a, b in pairwise([3, *sizes]))
        self.shrink = nn.MaxPool2d(2)
        self.grow = nn.ModuleList(nn.ConvTranspose2d(2 * b, b, 2, 2) for b in sizes[2::-1])
        self.up = nn.ModuleList(_pair(2 * b, b) for b in sizes[2::-1])
        self.last = nn.Conv2d(width, 3, 1)

    def change(self, picture: Tensor) -> Tensor:
        passed = [self.down[0](picture)]
        for level in self.down[1:]:
            passed.append(level(self.shrink(passed[-1])))
        x = passed[-1]
        for grow, level, skip in zip(self.grow, self.up, passed[-2::-1], strict=True):
            x = level(torch.cat([grow(x), skip], 1))
        result: Tensor = self.last(x)
        return result


def _pair(inputs: int, outputs: int) -> nn.Sequential:
    first, second = nn.Conv2d(inputs, outputs, 3, padding=1), nn.Conv2d(outputs, outputs, 3, padding=1)
    return nn.Sequential(first, nn.LeakyReLU(LEAK), second, nn.LeakyReLU(LEAK))


@node()
def unet(
    picture: Tensor,
    *,
    weights: DataFile | None = None,
    width: Layers = 32,
    tile: Tile | None = None,
    reduce: Count = 1,
    detail: bool = False,
) -> Tensor:
    """Restore a colour picture with a standard UNet, a baseline.

    ``tile``, ``reduce`` and ``detail`` as in `fft_mamba`.

    Shapes: picture (3, y, x) of any size -> (3, y, x).
    Units:  linear sRGB, as in the training of the weights.
    Error:  float32, 1e-5; of the restoration, the error that the training reached.
    Raises: ParameterError before the run without weights, or where the weights do not fit; ValueError for a picture
            that is not a colour picture or not finite.
    Source: Ronneberger et al., U-Net, MICCAI 2015; four levels, padded convolutions and the added picture are ours.
    """
    return restored(picture, partial(UNet, width), weights, tile, reduce, detail)


unet.preflight(partial(fitting, UNet))
unet.check(restorer_checks)
