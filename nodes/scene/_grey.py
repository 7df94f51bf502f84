"""The luminance of a colour picture, as the grey picture that a mono camera can be compared
with.
"""

import torch
from torch import Tensor

from neusee.nodes import Check, node
from neusee.nodes.precision import single

_LUMINANCE = (0.2126, 0.7152, 0.0722)  #: of linear red, green and blue with the primaries of sRGB


def luminance(rgb: Tensor, axis: int) -> Tensor:
    """Return the luminance of linear sRGB, whose three channels lie along ``axis`` of ``rgb``
    and have size 1 then.
    """
    red, green, blue = (share * rgb.narrow(axis, i, 1) for i, share in enumerate(_LUMINANCE))
    return red + green + blue


@node(rtol=1e-6)
def grey(picture: Tensor) -> Tensor:
    """Replace the colour of each pixel by its luminance, equal in red, green and blue.

    Shapes: picture (..., 3, y, x) -> the same.
    Units:  linear sRGB.
    Error:  float32: 2e-7 of the brightest channel.
    Raises: ValueError for a number of channels other than three.
    Source: IEC 61966-2-1:1999 (sRGB), luminance of the primaries of ITU-R BT.709.
    """
    if picture.ndim < 3 or picture.shape[-3] != 3:
        raise ValueError(
            f"a picture {tuple(picture.shape)} is not a colour picture: give (3, y, x)"
        )
    light = single(picture)
    return luminance(light, light.ndim - 3).expand_as(light).clone()


@grey.reference
def _(picture: Tensor) -> Tensor:
    shares = torch.tensor(_LUMINANCE, dtype=torch.float64, device=picture.device)
    return torch.einsum("c,...cyx->...yx", shares, picture.double())[..., None, :, :].expand_as(
        picture
    )


@grey.check
def _(result: Tensor, picture: Tensor) -> list[Check]:
    return [Check(f"luminance from {float(result.min()):.3g} to {float(result.max()):.3g}")]
