"""A node that reads a measurement in the data format of EMVA 1288."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import dataclass, field
from itertools import chain
from pathlib import Path
from typing import Annotated, Any

import torch
from pydantic import BeforeValidator
from torch import Tensor

from neusee.nodes import Check, node
from neusee.nodes.calibrate._frame_statistics import Temporal, levels, reduce
from neusee.nodes.calibrate._level_frames import refuse_unreadable, stack
from neusee.nodes.input_files import text_of
from neusee.nodes.units import IsFile
from neusee.nodes.values import Levels

_PAIR = 2  #: images of a level of the photon transfer
_WORDS = {
    "b": "b EXPOSURE_NS PHOTONS",
    "d": "d EXPOSURE_NS [0]",
    "n": "n BITS WIDTH HEIGHT",
    "v": "v RELEASE",
}


@dataclass
class _Level:
    """The entries of an EMVA 1288 descriptor for one light level."""

    line: int
    photons: float
    exposure: float  #: s
    #: each with the number of its line
    images: list[tuple[int, Path]] = field(default_factory=list)


@dataclass
class _Measurement:
    bits: int = 24
    shape: tuple[int, int] | None = None
    release: str = ""  #: of EMVA 1288, as line v states it
    levels: list[_Level] = field(default_factory=list)

    @property
    def transfer(self) -> list[_Level]:
        """The levels of the photon transfer: the pairs of images, or all levels if there is no
        pair.
        """
        pairs = [level for level in self.levels if len(level.images) == _PAIR]
        return pairs or self.levels

    @property
    def series(self) -> list[_Level]:
        """The levels of more images than a pair, for spatial quantities."""
        return [level for level in self.levels if len(level.images) > _PAIR]


def _with_images(file: Any) -> tuple[Path, ...]:
    """Return the path of the descriptor, and then the path of each image that the descriptor
    names.
    """
    if isinstance(file, tuple):
        return file
    path = Path(file)
    if not path.is_file():
        raise ValueError(f"no such file: {path}")
    images = list(chain.from_iterable(level.images for level in _parsed(path).levels))
    for line, image in images:
        if not image.is_file():
            raise ValueError(
                f"{path.name}:{line}: no such image: {image}: put the image beside the descriptor"
            )
    return (path, *(image for _, image in images))


DescriptorFile = Annotated[
    tuple[Path, ...], BeforeValidator(_with_images, json_schema_input_type=str), IsFile()
]


@node(rtol=0.0)
def descriptor(*, file: DescriptorFile, scatter: Temporal = "temporal") -> Levels:
    """Read the images that an EMVA 1288 descriptor names, and reduce each level to mean and
    variance as `reduce` does.

    In a descriptor with pairs of images, a level of more images is a series for spatial quantities.
    It is no level of the photon transfer, and `descriptor_series` reads it.

    Shapes: -> (level,), in the order of the descriptor.
    Units:  in the descriptor exposures ns, 0 for the shortest, photons per pixel and exposure; mean
            DN; variance DN2.
    Error:  counted in whole numbers, as in `reduce`. The difference of the means of a pair counts
            as variance, except with `steady`.
    Raises: ValueError, before the run, where the descriptor or an image is missing or cannot be
            read, and for a level of one image; ValueError for images of another size or of more
            bits than the descriptor says.
    Source: EMVA Standard 1288, release 3.0 and 4.0 (data sets of the working group, descriptor
            file).
    """
    files = _with_images(file)
    measurement = _parsed(files[0])
    joined: Levels = levels(
        [_reduced(files[0].name, measurement, level, scatter) for level in measurement.transfer]
    )
    return joined


@descriptor.preflight
def _(*, file: Sequence[Path], **params: object) -> list[str]:
    return refuse_unreadable("file", file[1:])


@descriptor.check
def _(result: Levels, **params: Any) -> list[Check]:
    dark = int((result.photons == 0).sum())
    return [
        Check(
            f"{len(result.mean)} levels ({dark} dark), exposures up to"
            f" {float(result.exposure.max()):.3g} s",
            dark > 0,
        )
    ]


def descriptor_frames(files: Sequence[Path]) -> Iterator[tuple[str, float, float, Tensor]]:
    """Yield name, photons, exposure (s) and frames (frame, y, x) of each level of a descriptor's
    photon transfer.

    ``files`` is the value of the parameter `file` of `descriptor`, whose first path is the
    descriptor.
    """
    for level in _parsed(files[0]).transfer:
        frames = torch.from_numpy(stack([image for _, image in level.images]))
        yield f"line {level.line}", level.photons, level.exposure, frames


def descriptor_series(files: Sequence[Path]) -> Iterator[tuple[float, float, Iterator[Tensor]]]:
    """Yield photons, exposure (s) and an iterator of frames (y, x) of each spatial series of a
    descriptor.

    ``files`` is as in `descriptor_frames`. Each image is read when its turn comes.
    """
    for level in _parsed(files[0]).series:
        yield (
            level.photons,
            level.exposure,
            chain.from_iterable(torch.from_numpy(stack([image])) for _, image in level.images),
        )


def descriptor_release(files: Sequence[Path]) -> str:
    """Return the release of EMVA 1288 that line v of a descriptor states, such as ``3.0``; empty
    without such a line.

    ``files`` is as in `descriptor_frames`.
    """
    return _parsed(files[0]).release


def refuse_descriptor(file: Path) -> None:
    """Raise ValueError with the line of the mistake if a descriptor or an image that it names
    cannot be read.
    """
    refuse_unreadable("file", _with_images(file)[1:])


def _reduced(name: str, measurement: _Measurement, level: _Level, scatter: Temporal) -> Levels:
    """Return the statistics of one level of a descriptor, which is called ``name``; raise
    ValueError for images of another size or of more bits than the descriptor says.
    """
    images = stack([image for _, image in level.images])
    if measurement.shape and images.shape[1:] != measurement.shape:
        raise ValueError(
            f"{name}:{level.line}: image shape {images.shape[1:]}, but descriptor shape"
            f" {measurement.shape} (y, x)"
        )
    if int(images.max()) >= 2**measurement.bits:
        raise ValueError(
            f"{name}:{level.line}: a pixel of {images.max()} DN exceeds the {measurement.bits}"
            " bits given in line n"
        )
    statistics: Levels = reduce(
        torch.from_numpy(images), photons=level.photons, exposure=level.exposure, scatter=scatter
    )
    return statistics


def _parsed(path: Path) -> _Measurement:
    """Return the measurement that a descriptor states, line by line; raise ValueError, with the
    line, for a mistake.
    """
    measurement = _Measurement()
    for number, line in _lines(path):
        kind, _, content = line.partition(" ")
        try:
            _take(measurement, kind, content.strip(), path.parent, number)
        except ValueError as error:
            raise ValueError(f"{path.name}:{number}: {error}") from None
    for level in measurement.levels:
        if len(level.images) < 2:
            raise ValueError(
                f"{path.name}:{level.line}: {len(level.images)} image(s): a light level needs two"
                " or more"
            )
    if not measurement.levels:
        raise ValueError(
            f"{path.name}: no line begins with 'b' or 'd', so there is no light level: give an EMVA"
            " 1288 descriptor"
        )
    return measurement


def _lines(path: Path) -> Iterator[tuple[int, str]]:
    """Yield the number and the text of each descriptor line that is neither empty nor a comment."""
    text = text_of(path, "utf-8-sig", "replace")
    for number, line in enumerate(text.splitlines(), 1):
        if line.strip() and not line.lstrip().startswith("#"):
            yield number, line.strip().replace("\t", " ")


def _take(measurement: _Measurement, kind: str, content: str, folder: Path, line: int) -> None:
    """Add the content of one line of a descriptor to the measurement."""
    if kind == "i":
        if not measurement.levels:
            raise ValueError(
                "an image precedes the first light level: begin the level with a line 'b' or 'd'"
            )
        measurement.levels[-1].images.append((line, folder / content.replace("\\", "/")))
        return
    if kind not in _WORDS:
        raise ValueError(f"cannot read {kind!r}: begin the line with v, n, b, d, i or #")
    words = content.split()
    try:
        # some laboratories write decimal commas
        numbers = [float(word.replace(",", ".")) for word in words]
        if kind == "n":
            # the line states the width before the height
            measurement.bits, measurement.shape = int(words[0]), (int(words[2]), int(words[1]))
        elif kind == "v":
            measurement.release = words[0].replace(",", ".")
        else:
            measurement.levels.append(_level(line, kind, numbers))
    except (ValueError, IndexError):
        raise ValueError(f"cannot read {kind} {content!r}: write {_WORDS[kind]}") from None


def _level(line: int, kind: str, numbers: list[float]) -> _Level:
    """Return the light level of a descriptor line; raise ValueError for an invalid exposure or
    number of photons.
    """
    # a dark line may leave its number of photons, 0, out
    exposure, photons = (*numbers, 0.0)[:2] if kind == "d" else numbers
    if not 0 <= exposure < float("inf") or not (
        0 < photons < float("inf") if kind == "b" else photons == 0
    ):
        raise ValueError
    # from nanoseconds to seconds
    return _Level(line, photons, exposure * 1e-9)
