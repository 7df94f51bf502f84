"""The peak of a sampled spot: between its samples, and the light outside its window that may hold a higher one."""

import torch
from torch import Tensor

from neusee.nodes.laser._bright_pixels import light_with_wings

_NEAR = 0.5  #: of the brightest sample, from which the summit of a lobe may be higher than it
_FLOOR = 1e-30  #: of the brightest sample, below which light is dark
_CROSS = ((0, 0), (-1, 0), (1, 0), (0, -1), (0, 1))  #: a sample and its four neighbours, in samples along y and x
_WINGS = 0.03  #: share of the light outside a window, at most, that the wings of a spot in the window explain


def summit_gain(image: Tensor) -> Tensor:
    """Return the peak of a spot over its brightest sample: the highest summit of the parabolas through its lobes.

    A lobe is a sample that none of its four neighbours exceeds. Its summit is that of a parabola along y and of one
    along x, in logarithms, for which a Gaussian lobe is exact.

    Shapes: image (y, x) -> ().
    Units:  any -> none.
    Error:  0.4 % of the peak for the lobes of a round pupil with 4 samples in wavelength times f-number, which is up to
            7.5 % above the brightest sample.
    Raises: nothing.
    Source: by definition.
    """
    top = image.max()
    if min(image.shape) < 3 or not top > 0:
        return torch.ones((), dtype=torch.float64)
    inner = image[1:-1, 1:-1]
    y, x = (inner > _NEAR * top).nonzero(as_tuple=True)  # a few: no other sample is a summit
    here, above, below, left, right = (
        (image[y + 1 + dy, x + 1 + dx].double() / top).clamp_min(_FLOOR).log() for dy, dx in _CROSS
    )
    lobe, gain = torch.ones_like(here, dtype=torch.bool), torch.zeros_like(here)
    for before, after in ((above, below), (left, right)):
        lobe = lobe & (here >= before) & (here >= after)
        bend = (2 * here - before - after).clamp_min(_FLOOR)
        gain = gain + (after - before).square() / (8 * bend)
    summits = torch.where(lobe, here + gain, 0.0)
    return torch.cat([summits, summits.new_zeros(1)]).max().clamp_min(0).exp()


def unseen_light(image: Tensor, passing: float) -> Tensor:
    """Return the share of a beam's light outside the window of its spot that may be in one spot there.

    Of a window that holds nearly all light, the wings go on outside by the radial law of `with_frame`: what they
    explain is in no spot. A window that lacks more may lack a part of the spot itself, so that no law counts.
    ``passing`` is the light through the lens, in the unit of the image. A spot of the share s of the light has at most
    s times the peak of the clear lens in focus with the same beam.

    Shapes: image (y, x) -> ().
    Units:  share of the light through the clear pupil -> none.
    Error:  an upper bound for light that the mask takes from a part of the pupil, or from all of it evenly; a spot that
            the border of the window cuts has up to 10 % more.
    Raises: nothing.
    Source: Cauchy-Schwarz inequality for the field in the pupil; our derivation.
    """
    lacking = 1 - image.double().sum() / passing
    beyond_wings = 1 - light_with_wings(image) / passing
    return torch.where(lacking > _WINGS, lacking, beyond_wings).clamp_min(0)
