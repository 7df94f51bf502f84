"""Photographs as scenes: linear light from sRGB files, and crops from a folder."""

from __future__ import annotations

import os
from collections.abc import Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

from neusee.nodes import Check, ParameterError, node
from neusee.nodes.file_headers import picture_needs
from neusee.nodes.input_files import (
    file_version,
    head_of,
    needs,
    once_per_version,
    opened,
    refuse_large_picture,
    refuse_other_than_file,
)
from neusee.nodes.scene._picture_changes import (
    Codes,
    DrawnCrop,
    drawn_crop,
    enlargement_notes,
    framed_scene,
    linear_light,
)
from neusee.nodes.units import DataFile, Shape

# --- photograph -----------------------------------------------------------------------------------

# Photographs as scenes: linear light from sRGB files.


_MODES = ("RGB", "L", "P", "1", "I", "I;16", "I;16B")
_CONVERT_REMEDY = (
    "convert the file to 8- or 16-bit sRGB: magick {name} -alpha off -colorspace sRGB -depth 16"
    " {stem}.png"
)
_DAMAGED = "{name} is damaged ({error}): copy the file again, or give another picture"
_ORIENTATION = 0x0112  #: EXIF tag of the orientation
_QUARTER_TURNED = range(5, 9)  #: EXIF orientations that exchange width and height
_LINEAR_PIXEL_BYTES = 12  #: bytes of a pixel in linear light


@node(rtol=1e-5)
def photograph(
    *, file: DataFile, shape: Shape | None = None, crop: DrawnCrop | None = None
) -> Tensor:
    """Read a photograph as linear light: decode the sRGB curve, turn the picture upright, then
    scale and crop.

    ``crop`` has a seed and the number of a scene: the part of the photograph that an evaluation
    with this seed shows in this scene, at full size, in place of the scaled centre.

    Shapes: -> (3, y, x) float32, the size of the file or `shape` (scaled to cover `shape`, cropped
            at the centre).
    Units:  linear sRGB, 1 = the white of the file.
    Error:  half a code value (8 bit: 1.8e-3 near white); the tone curve of the camera is not
            inverted. Every file is read as sRGB: a note names an embedded colour profile, which is
            ignored.
    Raises: ParameterError before the run for another format, for another depth, for transparency,
            for a damaged file, and for more than 64 million pixels.
    Source: IEC 61966-2-1:1999 (sRGB); EXIF 2.3, tag Orientation.
    """
    if crop is None or shape is None:
        return linear_light(_codes(file), _decoded_light, shape)
    return drawn_crop(linear_light(_codes(file), _decoded_light, None), (shape[0], shape[1]), *crop)


@photograph.reference
def _(*, file: Path, shape: Shape | None = None, crop: DrawnCrop | None = None) -> Tensor:
    codes = _codes_to_unit(_codes(file)).double()
    linear = torch.where(codes <= 0.04045, codes / 12.92, ((codes + 0.055) / 1.055) ** 2.4)
    if crop is None or shape is None:
        return framed_scene(linear, shape)
    return drawn_crop(linear, (shape[0], shape[1]), *crop)


@photograph.preflight
def _(*, file: Path, shape: Shape | None = None, crop: DrawnCrop | None = None) -> list[str]:
    if crop is not None and shape is None:
        raise ParameterError(
            "crop", "the part of a photograph has no size: give shape, such as [768, 768]"
        )
    profile, orientation, size = read_header(file)
    if problem := _damage(file):
        raise ParameterError("file", problem)
    notes = (
        [f"{file.name}: colour profile {profile!r} is ignored, and the file read as sRGB"]
        if profile
        else []
    )
    notes += (
        [f"{file.name}: picture turned upright by EXIF orientation {orientation}"]
        if orientation != 1
        else []
    )
    return notes + enlargement_notes(size, shape)


def read_header(file: Path) -> tuple[str, int, tuple[int, int]]:
    """Return the colour profile, the EXIF orientation, and the numbers of rows and columns of
    the upright picture.
    """
    from PIL import Image, UnidentifiedImageError

    refuse_large_picture(file, *_png_size(file))
    try:
        with Image.open(file) as image:
            refuse_large_picture(file, image.height, image.width)
            _refuse_other_picture(file, image)
            picture_needs(file, image, _LINEAR_PIXEL_BYTES)
            orientation = image.getexif().get(_ORIENTATION, 1)
            # `image.size` is (columns, rows)
            return (
                _colour_profile(image),
                orientation,
                image.size if orientation in _QUARTER_TURNED else image.size[::-1],
            )
    except UnidentifiedImageError:
        raise ParameterError(
            "file", f"{file} is not a readable picture: give a PNG or JPEG file"
        ) from None
    except Image.DecompressionBombError:
        raise ParameterError(
            "file", f"{file.name} states more pixels than can be read: reduce the picture"
        ) from None
    except (OSError, SyntaxError) as error:
        raise ParameterError("file", _DAMAGED.format(name=file.name, error=error)) from None


def _png_size(file: Path) -> tuple[int, int]:
    """Return the numbers of rows and columns in the header of a PNG file, or (0, 0) for another
    file.
    """
    header = head_of(file, 24)
    is_png = header.startswith(b"\x89PNG") and len(header) == 24
    return (int.from_bytes(header[20:24]), int.from_bytes(header[16:20])) if is_png else (0, 0)


@once_per_version
def _damage(file: Path) -> str:
    """Return a message for a picture that is truncated or damaged, otherwise an empty text.

    The checksums of a PNG are verified. A JPEG is decoded at an eighth of its size, which reads all
    its data.
    """
    from PIL import Image

    try:
        with Image.open(file) as image:
            picture_needs(file, image, 0)
            if image.format == "PNG":
                image.verify()
            else:
                # decodes at an eighth of the size, which still reads all data
                image.draft("RGB", (1, 1))
                image.load()
    except ParameterError:
        raise
    except (OSError, SyntaxError, ValueError) as error:
        return _DAMAGED.format(name=file.name, error=error)
    return ""


@photograph.check
def _(result: Tensor, **params: Any) -> list[Check]:
    clipped = float((result >= 1).any(0).float().mean())
    return [
        Check(
            f"mean value {float(result.mean()):.3f}, {clipped:.1%} of pixels are saturated",
            float(result.max()) > 0,
        )
    ]


def _refuse_other_picture(file: Path, image: Any) -> None:
    """Raise ParameterError unless a picture is a PNG or JPEG without transparency, grey or RGB."""
    remedy = _CONVERT_REMEDY.format(name=file.name, stem=file.stem)
    if image.format not in ("PNG", "JPEG", "MPO"):
        raise ParameterError(
            "file",
            f"{file} has the format {image.format}, not PNG or JPEG: {remedy}, or use scene.exr",
        )
    if "transparency" in image.info or image.mode.endswith("A"):
        raise ParameterError("file", f"{file} has transparency, which a scene cannot use: {remedy}")
    if image.mode not in _MODES:
        raise ParameterError(
            "file", f"{file} has pixels of type {image.mode}, not grey or RGB: {remedy}"
        )


def _colour_profile(image: Any) -> str:
    """Return the name of the colour profile embedded in a photograph, or an empty text for sRGB
    or no profile.
    """
    from io import BytesIO

    from PIL import ImageCms

    if not image.info.get("icc_profile"):
        return ""
    try:
        name = ImageCms.getProfileDescription(
            ImageCms.ImageCmsProfile(BytesIO(image.info["icc_profile"]))
        ).strip()
    except (OSError, ImageCms.PyCMSError):
        name = "unreadable"
    return "" if "srgb" in name.lower() else name


def _decoded_light(codes: NDArray[Any]) -> Tensor:
    """Decode sRGB code values (y, x, 3) to linear light (3, y, x) float32."""
    from kornia.color import rgb_to_linear_rgb

    light: Tensor = rgb_to_linear_rgb(_codes_to_unit(codes))
    return light


class _CodeRows:
    """Code values (y, x, 3) of a decoded picture; an index copies only the rows of a slice.

    A copy of the whole picture would add up to 0.5 GB to the peak memory for 64 million pixels: the
    copy itself, and the memory of the decoded picture, which the C library may not release.
    """

    def __init__(self, image: Any) -> None:
        image.load()
        self._image = image
        self.shape = (image.height, image.width, 3)

    def __getitem__(self, rows: slice) -> NDArray[Any]:
        start, stop, _ = rows.indices(self._image.height)
        cropped = self._image.crop((0, start, self._image.width, stop))
        is_readable = cropped.mode.startswith("I") or cropped.mode == "RGB"
        if not is_readable:
            cropped = cropped.convert("RGB")
        values = np.asarray(cropped)
        return values if values.ndim == 3 else np.repeat(values[..., None], 3, axis=2)


def _codes_to_unit(codes: Codes) -> Tensor:
    """Return code values (y, x, 3) as (3, y, x) float32 in [0, 1]."""
    codes = codes[:]
    scale = 255.0 if codes.dtype == np.uint8 else 65535.0
    return (
        torch.from_numpy(np.ascontiguousarray(codes.transpose(2, 0, 1), dtype=np.float32)) / scale
    )


def _codes(file: Path) -> Codes:
    """Return the sRGB code values (y, x, 3) of a photograph, turned upright.

    Kornia_rs reads 16-bit colour; Pillow would reduce it to 8 bits.
    """
    from PIL import Image, ImageOps

    refuse_other_than_file(file)
    with Image.open(file) as image:
        _refuse_other_picture(file, image)
        picture_needs(file, image, _LINEAR_PIXEL_BYTES)
        orientation = image.getexif().get(_ORIENTATION, 1)
        if image.mode == "RGB" and _bit_depth(file) == 16:
            return _sixteen_bit_codes(file, orientation)
        upright = ImageOps.exif_transpose(image) if orientation != 1 else image  # a copy
        return _CodeRows(upright)


def _bit_depth(file: Path) -> int:
    """Return the number of bits per channel of a PNG or JPEG file, which is always 8 for JPEG."""
    header = head_of(file, 26)
    return header[24] if header.startswith(b"\x89PNG") else 8


def _sixteen_bit_codes(file: Path, turned: int) -> NDArray[Any]:
    """Read a 16-bit RGB PNG file, and turn the picture upright by the EXIF orientation
    ``turned``.
    """
    from kornia_rs.io import read_image_png_u16

    rows, columns = _png_size(file)
    # bytes per pixel: 6 for the code values, and 12 in linear light
    needs(18.0 * rows * columns, file, f"{columns} x {rows} pixels of 16 bits")
    codes = np.asarray(read_image_png_u16(str(file), "rgb"))
    codes = codes.transpose(1, 0, 2) if turned in _QUARTER_TURNED else codes
    # EXIF orientations: 3 is turned by 180 degrees, 2 and 4 are mirrored, 5 to 8 have rows and
    # columns exchanged
    flip_y, flip_x = turned in (3, 4, 7, 8), turned in (2, 3, 6, 7)
    return codes[:: -1 if flip_y else 1, :: -1 if flip_x else 1]


# --- photograph folder ----------------------------------------------------------------------------

# Search of a folder for readable photographs, and random crops of the photographs from a given
# seed.


__depends__ = ["unaffected:_pictures"]  #: the pictures in memory change no result
_PICTURE_SUFFIXES = frozenset(
    {".png", ".jpg", ".jpeg", ".jpe", ".webp", ".tif", ".tiff", ".bmp", ".gif"}
)
#: first bytes of a format -> end mark of a file of this format
_END_MARKS = {b"\xff\xd8": b"\xff\xd9", b"\x89P": b"IEND"}
#: bytes at the end of a file that must contain the end mark: some cameras write more after it
_TAIL_BYTES = 1 << 16
#: random streams of one seed, for order and draws; the position of a crop has a further stream
_ORDER_STREAM, _DRAW_STREAM = 0, 2
_KEPT_BYTES = 1 << 30  #: largest size in bytes of the decoded photographs that a process keeps
_BROKEN_IN_A_ROW = 100  #: number of successive broken photographs that raises an error

Index = int | Sequence[int]  #: the number of a scene, or (stage, number) of a picture for training


def list_photographs(root: Path) -> tuple[list[Path], list[tuple[Path, str]]]:
    """Return the readable photographs below a folder, sorted by path, and the unreadable files with
    a reason for each.

    Only the header and the end of each file are read; no picture is decoded. Hidden files, hidden
    folders and files without the suffix of a picture are ignored.
    """
    reasons = {path: _unreadable_reason(path) for path in _picture_files(root)}
    broken = [(path, reason) for path, reason in reasons.items() if reason]
    return [path for path, reason in reasons.items() if not reason], broken


def _picture_files(root: Path) -> list[Path]:
    """Return the files with the suffix of a picture below a folder, sorted by path; hidden files
    and folders are left out, and links that lead back to a folder above are not followed.
    """
    pictures, folders_above = list[Path](), dict[str, frozenset[tuple[int, int]]]()
    for folder, subfolders, file_names in os.walk(root, followlinks=True):
        status, ancestors = os.stat(folder), folders_above.get(os.path.dirname(folder), frozenset())
        if (identity := (status.st_dev, status.st_ino)) in ancestors:  # a cycle of links
            subfolders.clear()
            continue
        folders_above[folder] = ancestors | {identity}
        # `os.walk` visits the folders of this list, in its order
        subfolders[:] = sorted(name for name in subfolders if not name.startswith("."))
        pictures += [Path(folder, name) for name in file_names if _is_picture_name(name)]
    return sorted(pictures, key=lambda path: path.relative_to(root).parts)


def _is_picture_name(name: str) -> bool:
    """Return True for the name of a file that is not hidden and has the suffix of a picture."""
    return not name.startswith(".") and Path(name).suffix.lower() in _PICTURE_SUFFIXES


def _unreadable_reason(path: Path) -> str:
    """Return the reason why a file cannot be read as a photograph, or an empty text."""
    try:
        read_header(path)
        with opened(path) as file:
            end_mark = _END_MARKS[file.read(2)]
            file.seek(max(0, path.stat().st_size - _TAIL_BYTES))
            return "" if end_mark in file.read(_TAIL_BYTES) else f"{path.name} stops before its end"
    except (ParameterError, OSError, KeyError, ValueError, SyntaxError) as error:
        return str(error)


def choose_photograph(paths: Sequence[Path], seed: int, index: int) -> Path:
    """Return the photograph for scene ``index``: every photograph is used once before any is
    repeated.

    The order of the photographs is random and depends on the seed.
    """
    order: list[int] = np.random.default_rng([seed, _ORDER_STREAM]).permutation(len(paths)).tolist()
    return paths[order[index % len(paths)]]


def crop_photograph(path: Path, shape: tuple[int, int], seed: int, index: Index) -> Tensor:
    """Crop a photograph, linear sRGB (3, y, x), at a position that depends only on the seed and the
    index.

    A smaller photograph is enlarged first, as `drawn_crop` does. ``scene.photograph`` with ``crop``
    gives the same.
    """
    return drawn_crop(_decoded_photograph(path), shape, seed, index)


#: decoded photographs by file version, in order of their last use
_pictures: dict[tuple[int, ...], Tensor] = {}


def _decoded_photograph(path: Path) -> Tensor:
    """Return a photograph as linear sRGB (3, y, x), from memory if it was used recently.

    A file that has changed since is decoded again.
    """
    version = file_version(path)
    if version is None:
        # a file that was written a moment ago has no version yet
        uncached: Tensor = photograph(file=path)
        return uncached
    picture: Tensor = _pictures.pop(version) if version in _pictures else photograph(file=path)
    _pictures[version] = picture
    # the first entry is the least recently used one
    while len(_pictures) > 1 and sum(map(_bytes_of, _pictures.values())) > _KEPT_BYTES:
        del _pictures[next(iter(_pictures))]
    return picture


def _bytes_of(picture: Tensor) -> int:
    return picture.numel() * picture.element_size()


def _indices(index: Index) -> list[int]:
    return [index] if isinstance(index, int) else list(index)


@dataclass
class Photographs:
    """The photographs of a folder for training, and the files that cannot be read as
    photographs.
    """

    paths: tuple[Path, ...]  #: in the order of their names
    #: unreadable files, each with the reason
    broken: dict[Path, str] = field(default_factory=dict)

    @classmethod
    def under(cls, root: Path) -> Photographs:
        """Find all photographs below a folder at any depth; raise ValueError for a folder
        without photographs.
        """
        paths, broken = list_photographs(root)
        if not paths:
            why = (
                f"; {len(broken)} cannot be read, such as {broken[0][0]}: {broken[0][1]}"
                if broken
                else ""
            )
            raise ValueError(f"the folder {root} holds no readable photograph{why}")
        return cls(tuple(paths), dict(broken))

    def crop(self, shape: tuple[int, int], seed: int, index: Index) -> Tensor:
        """Return a random crop of a random photograph, mirrored with probability 1/2.

        A broken photograph is replaced by another draw. The same ``seed`` and ``index`` give the
        same crop in any order and in any number of processes, whereas the random crops and flips of
        kornia draw from the one random stream of torch.
        """
        rng = np.random.default_rng([seed, _DRAW_STREAM, *_indices(index)])
        for _ in range(_BROKEN_IN_A_ROW):
            path = self.paths[int(rng.integers(len(self.paths)))]
            try:
                picture = crop_photograph(path, shape, seed, index)
            except (OSError, ValueError, SyntaxError) as error:
                self.broken[path] = str(error)
                continue
            return (picture.flip(-1) if rng.random() < 0.5 else picture).contiguous()
        path = next(iter(self.broken))
        raise ValueError(
            f"{_BROKEN_IN_A_ROW} photographs in a row cannot be read, such as {path}:"
            f" {self.broken[path]}"
        )
