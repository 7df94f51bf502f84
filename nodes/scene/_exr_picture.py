"""Scene-linear OpenEXR pictures, converted to linear sRGB."""

from pathlib import Path
from typing import Annotated, Any, Literal

import numpy as np
import torch
from numpy.typing import NDArray
from pydantic import Field
from torch import Tensor

from neusee.nodes import Check, ParameterError, node
from neusee.nodes.scene._crop_to_frame import enlarged, framed
from neusee.nodes.scene._spectral_exr import exr_header
from neusee.nodes.units import DataFile, Shape

White = Annotated[float, Field(gt=0, allow_inf_nan=False)]
_REC709 = (0.64, 0.33, 0.30, 0.60, 0.15, 0.06, 0.3127, 0.3290)  #: of a file whose header has no primaries


@node(rtol=1e-5)
def exr(
    *,
    file: DataFile,
    shape: Shape | None = None,
    white: White | None = None,
    negatives: Literal["clip", "keep"] = "clip",
) -> Tensor:
    """Read a scene-linear OpenEXR picture and convert it to linear sRGB.

    The header of the file gives the primaries; Bradford adaptation is used where the white points differ.

    Shapes: -> (3, y, x) float32, the size of the file or `shape` (scaled to cover `shape`, cropped at the centre).
    Units:  linear sRGB, 1 = `white` in the values of the file (with null the values stay unscaled); no upper limit.
    Error:  half floats resolve 5e-4. Negative light, from noise or colours outside sRGB, is clipped unless kept.
    Raises: ParameterError before the run unless the channels are R, G and B, or Y alone; ValueError for values
            that are not finite.
    Source: OpenEXR technical introduction (chromaticities, adoptedNeutral); matrices of colour-science.
    """
    scene = framed(_linear(file), shape) / (white or 1.0)
    return scene.clamp_min(0) if negatives == "clip" else scene


@exr.preflight
def _(*, file: Path, shape: Shape | None = None, **params: Any) -> list[str]:
    header, names, size = exr_header(file)
    notes = [f"{file.name}: only luminance; the picture is grey"] if _colour_channels(file, names) == ["Y"] else []
    if abs(float(header.get("pixelAspectRatio", 1.0)) - 1) > 1e-3:
        notes += [f"{file.name}: pixels are not square ({header['pixelAspectRatio']:.3f}), but are read as square"]
    return notes + enlarged(size, shape)


@exr.check
def _(result: Tensor, *, file: Path, **params: Any) -> list[Check]:
    linear = _linear(file)
    below, least = int((linear < 0).sum()), float(linear.min())
    text = f"peak {float(result.max()):.4g}, mean {float(result.mean()):.3g}"
    return [Check(text + (f"; {below} of {linear.numel()} values were negative, down to {least:.2g}" if below else ""))]


def _colour_channels(file: Path, names: list[str]) -> list[str]:
    """Return the names of the channels to read from an OpenEXR file: R, G and B, or Y alone."""
    for channels in (["R", "G", "B"], ["Y"]):
        if set(channels) <= set(names) and not {"RY", "BY"} & set(names):
            return channels
    text = (
        f"{file} has the channels {', '.join(names)}, but R, G and B, or Y alone, are needed: save the picture as RGB"
    )
    raise ParameterError("file", text)


def _linear(file: Path) -> Tensor:
    """Read all pixels of an OpenEXR file as linear sRGB, (3, y, x) float32."""
    import OpenEXR

    with OpenEXR.File(str(file), separate_channels=True) as opened:
        header, channels = dict(opened.header()), opened.channels()
        names = _colour_channels(file, list(channels))
        pixels = np.stack([np.asarray(channels[name].pixels, dtype=np.float32) for name in names])
    if bad := int((~np.isfinite(pixels)).sum()):
        raise ValueError(
            f"{file.name} holds {bad} values that are not finite: replace these values by finite numbers, such as 0"
        )
    if names == ["Y"]:
        return torch.from_numpy(pixels).expand(3, -1, -1).clone()
    matrix = torch.from_numpy(_to_srgb(header)).to(torch.float32)
    return (matrix @ torch.from_numpy(pixels).flatten(1)).reshape(pixels.shape)


def _to_srgb(header: dict[str, Any]) -> NDArray[np.float64]:
    """Return the matrix from the primaries of an OpenEXR header to linear sRGB.

    Bradford adaptation maps the neutral of the header to D65.
    """
    import colour

    values = np.asarray(header.get("chromaticities", _REC709), dtype=np.float64)
    if np.allclose(values, _REC709, atol=1e-4) and "adoptedNeutral" not in header:
        return np.eye(3)
    white = values[6:]
    neutral = np.asarray(header.get("adoptedNeutral", white), dtype=np.float64)
    own = colour.models.normalised_primary_matrix(values[:6].reshape(3, 2), white)
    space = colour.RGB_Colourspace("file", values[:6], neutral, matrix_RGB_to_XYZ=own)
    matrix: NDArray[np.float64] = colour.matrix_RGB_to_RGB(space, colour.RGB_COLOURSPACES["sRGB"], "Bradford")
    return matrix
