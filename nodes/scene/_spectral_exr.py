"""Spectral OpenEXR files: one channel per wavelength, named as in Fichet et al. (JCGT 10(3), 2021).

Emitted light is ``S0.550,0nm``, reflectance is ``T.550,0nm``. The decimal mark is a comma because a point separates
layers. Colour-science reads and writes such files only with OpenImageIO, and its import alone takes a second.
"""

import re
from collections.abc import Iterator, Mapping, Sequence
from contextlib import contextmanager, redirect_stdout
from io import StringIO
from pathlib import Path
from typing import Any, Literal, NamedTuple

import numpy as np
import torch
from torch import Tensor

from neusee.nodes import ParameterError
from neusee.nodes.constants import SPEED_OF_LIGHT
from neusee.nodes.picture_bytes import exr_needs
from neusee.nodes.scene._plain_exr import write_lines

_NAME = re.compile(r"(S0|T)\.(\d*,?\d*(?:[eE][-+]?\d+)?)(Y|Z|E|P|T|G|M|k|h|da|d|c|m|u|n|p)?(m|Hz)")
_PREFIX = {
    "": 0, "p": -12, "n": -9, "u": -6, "m": -3, "c": -2, "d": -1, "da": 1, "h": 2, "k": 3,
    "M": 6, "G": 9, "T": 12, "P": 15, "E": 18, "Z": 21, "Y": 24,
}  # fmt: skip


@contextmanager
def exr_parts(file: Path | str) -> Iterator[Any]:
    """Open an OpenEXR file with its pixels; raise ValueError if a part cannot be read to its end.

    For a truncated file, OpenEXR prints a warning to stdout, which would mix with the output of a command, and leaves
    the part out.
    """
    import OpenEXR

    exr_needs(file)
    with OpenEXR.File(str(file), header_only=True) as opened:
        count = len(opened.parts)
    with redirect_stdout(StringIO()):
        opened = OpenEXR.File(str(file), separate_channels=True)
    with opened:
        if len(opened.parts) < count:
            raise ValueError("the pixels end earlier than the header says")
        yield opened


class PartHeader(NamedTuple):
    """The header of one part of an OpenEXR file."""

    name: str
    header: dict[str, Any]
    channels: list[str]
    size: tuple[int, int]  #: rows and columns


def part_headers(file: Path) -> list[PartHeader]:
    """Read the header of each part of an OpenEXR file, whose pixels must have room in memory."""
    import OpenEXR

    exr_needs(file)
    try:
        with OpenEXR.File(str(file), header_only=True) as opened:
            headers = [dict(part.header) for part in opened.parts]
    except (RuntimeError, OSError, ValueError) as why:
        text = f"{file} cannot be read as OpenEXR ({str(why).strip()}): give an .exr file"
        raise ParameterError("file", text) from None
    return [_part(header) for header in headers]


def _part(header: dict[str, Any]) -> PartHeader:
    low, high = ([int(edge) for edge in corner] for corner in header["dataWindow"])
    names = [channel.name for channel in header["channels"]]
    return PartHeader(str(header.get("name", "")), header, names, (high[1] - low[1] + 1, high[0] - low[0] + 1))


def exr_header(file: Path) -> tuple[dict[str, Any], list[str], tuple[int, int]]:
    """Read the header, the channel names, and the numbers of rows and columns of an OpenEXR file with one part."""
    parts = part_headers(file)
    if len(parts) > 1:
        names = ", ".join(part.name for part in parts)
        raise ParameterError("file", f"{file.name} has {len(parts)} parts ({names}): save one part alone")
    return parts[0].header, parts[0].channels, parts[0].size


def write_spectral(
    path: Path | str,
    cube: Tensor,
    centres: Tensor | Sequence[float],
    *,
    kind: Literal["emissive", "reflective"] = "emissive",
    header: Mapping[str, Any] | None = None,
    half: bool = False,
) -> None:
    """Write a spectral cube (band, y, x) with its wavelengths in m to an uncompressed OpenEXR file, as float32.

    With ``half`` the file has float16, half as many bytes, in which values below 6e-8 become zero.
    Raises: ValueError where cube and wavelengths differ in number, where two bands would get the same name, and where a
    value is beyond the range of float16.
    """
    wavelengths = [float(w) for w in centres]
    if cube.ndim != 3 or len(wavelengths) != len(cube):
        raise ValueError(
            f"cube has shape {tuple(cube.shape)}, not (band, y, x) with {len(wavelengths)} bands: "
            "give one wavelength for each band"
        )
    quantity = "S0" if kind == "emissive" else "T"
    names = [quantity + "." + f"{w * 1e9:.6f}nm".replace(".", ",") for w in wavelengths]
    if len(set(names)) < len(names):
        raise ValueError(f"bands closer than 1e-6 nm would have equal channel names: {names}")
    about = {"spectralLayoutVersion": "1.0", **({"emissiveUnits": "W.m^-2"} if kind == "emissive" else {})}
    write_lines(path, names, cube, {**about, **(header or {})}, half)


def read_spectral(path: Path | str) -> tuple[Tensor, Tensor, dict[str, Any]]:
    """Read a spectral OpenEXR file: the cube (band, y, x), the rising wavelengths (band,) in m, and the header.

    The cube is float32, the wavelengths float64. Only the emission is read from a file with both emission and
    reflectance.
    Raises: ValueError, which lists the channels of the file, where no channel is spectral.
    """
    with exr_parts(path) as opened:
        header, channels = dict(opened.header()), opened.channels()
        spectral = spectral_channels(list(channels))
        if not spectral:
            raise ValueError(
                f"{path} has the channels {', '.join(channels)}: none has a name such as S0.550,0nm or T.550,0nm"
            )
        planes = [np.asarray(channels[name].pixels, dtype=np.float32) for name in spectral.values()]
    return torch.from_numpy(np.stack(planes)), torch.tensor(list(spectral), dtype=torch.float64), header


def spectral_channels(names: Sequence[str]) -> dict[float, str]:
    """Return the channel name for each wavelength in m of a spectral OpenEXR file, in rising order of wavelength.

    Reflectance channels are used only if the file has no emission channels.
    """
    for kind in ("S0", "T"):
        matches = [m for m in map(_NAME.fullmatch, names) if m and m[1] == kind and m[2] not in ("", ",")]
        if matches:
            return dict(sorted((_wavelength(m), m[0]) for m in matches))
    return {}


def _wavelength(match: re.Match[str]) -> float:
    exponent = _PREFIX[match[3] or ""]
    number = float(match[2].replace(",", "."))
    # a division converts nanometres, so that 550,0nm gives the same float64 as 550 / 1e9
    value = number / 10.0**-exponent if exponent < 0 else number * 10.0**exponent
    return value if match[4] == "m" else SPEED_OF_LIGHT / value
