"""Reduction of overexposed frames of a point source to rings of pixels, from which the scatter of a lens is fitted."""

from __future__ import annotations

import math
from collections.abc import Sequence
from pathlib import Path
from typing import Annotated, Any, NamedTuple

import numpy as np
import torch
from numpy.typing import NDArray
from pydantic import Field
from torch import Tensor

from neusee.nodes import Check, ParameterError, node
from neusee.nodes.calibrate._frames._level_frames import refuse_unreadable, stack
from neusee.nodes.sensor._digitization import Bits
from neusee.nodes.sensor._room_for_light import refuse_without_room, refuse_without_steps
from neusee.nodes.sensor._saturation import Well
from neusee.nodes.units import DataFiles, Electrons, Gain

Place = Annotated[float, Field(ge=0, le=1e6)]  #: pixels, from the middle of the first pixel
Numbers = NDArray[np.float64]
_CUT = 0.95  #: share of saturation from which a number says only that the pixel holds more
_BELOW = 5.0  #: standard deviations by which a ring must lie below this cut to be averaged
_WIDER = 1.04  #: ratio of the radii of a ring, from the radius at which this is wider than a pixel
_PARTS = 4  #: parts of a ring, each of which has a radius of its own
_LEAST = 16.0  #: pixels from the source to the first ring, below which pixels are not small
_RINGS = 6  #: least number of rings that can tell anything of the scatter


class Rings(NamedTuple):
    """The mean signal in rings of pixels about an overexposed point source, and the rings that are cut off."""

    mean: Tensor  #: (ring,) float64, e- of a pixel in one exposure, without offset
    pixels: Tensor  #: (ring,) float64, number of pixels, of all frames
    ring: Tensor  #: (part,) int64, ring of each part
    square: Tensor  #: (part,) float64, pixels², mean squared distance from the source
    weight: Tensor  #: (part,) float64, number of pixels
    cut_square: Tensor  #: (cut,) float64, pixels², of each ring whose every pixel is cut off
    cut: Tensor  #: () float64, e-: a pixel that is cut off has at least this signal
    centre: Tensor  #: (2,) float64, y and x of the source, from the middle of the first pixel


class _Camera(NamedTuple):
    gain: float
    offset: float
    full_well: float
    bits: int
    read_noise: float

    @property
    def cut(self) -> float:
        """Return the digital number above which a pixel says only that it holds more."""
        return _CUT * min(2.0**self.bits - 1, self.full_well * self.gain)


@node()
def point_source(
    *,
    files: DataFiles,
    gain: Gain,
    offset: Electrons,
    full_well: Well,
    read_noise: Electrons,
    bits: Bits = 16,
    centre: tuple[Place, Place] | None = None,
) -> Rings:
    """Average the signal of an overexposed point source over rings about the source, and find the rings cut off.

    The source is at ``centre``, or in the middle of the saturated pixels. A pixel above 95 % of saturation says only
    that it holds more. Averaged rings begin beyond 16 pixels, where the mean lies five standard deviations below that
    cut; of the rings inside, those whose every pixel is cut off are kept as a limit.

    Shapes: files of (y, x) numbers -> rings (ring,), parts of rings (part,).
    Units:  DN -> e-.
    Error:  the centre from saturated pixels: 0.1 pixels, which changes a ring by (0.1 / r)**2. Lone bright pixels
            beyond the core are left out.
    Raises: ParameterError before the run, or ValueError, for frames without a saturated pixel, a source that is not in
            the frame, numbers above the converter, and too few rings.
    Source: photon-transfer model of EMVA Standard 1288, release 4.0 Linear; Peterson, Proc. SPIE 5178 (2004), 184.
    """
    camera = _Camera(gain, offset, full_well, bits, read_noise)
    return reduce_rings(stack(files).astype(np.float64), camera, centre)


@point_source.preflight
def _(*, files: Sequence[Path], centre: tuple[float, float] | None, **params: Any) -> list[str]:
    refuse_unreadable("files", files)
    refuse_without_room(params["full_well"], offset=params["offset"], read_noise=params["read_noise"])
    refuse_without_steps(params["full_well"], gain=params["gain"], bits=params["bits"])
    camera = _Camera(**{name: params[name] for name in _Camera._fields})
    try:
        reduce_rings(stack(files).astype(np.float64), camera, centre)
    except ValueError as error:
        raise ParameterError("files", str(error)) from None
    return []


@point_source.check
def _(result: Rings, *others: Any, **params: Any) -> list[Check]:
    first, last = (float(result.square[i].sqrt()) for i in (0, -1))
    y, x = result.centre.tolist()
    text = f"{len(result.mean)} rings from {first:.0f} to {last:.0f} pixels about the source at ({y:.1f}, {x:.1f})"
    return [Check(text, bool((result.pixels > 0).all()))]


def reduce_rings(frames: Numbers, camera: _Camera, centre: tuple[float, float] | None) -> Rings:
    """Return the rings of frames (frame, y, x) of digital numbers; raise ValueError for frames that tell nothing."""
    _refuse_numbers(frames, camera)
    size = frames.shape[1:]
    place = _middle(frames, camera) if centre is None else centre
    if not all(-0.5 <= c <= n - 0.5 for c, n in zip(place, size, strict=True)):
        raise ValueError(f"the source at ({place[0]:g}, {place[1]:g}) is not in the frame of {size[0]} x {size[1]} "
                         "pixels: give `centre` as y and x, in pixels")  # fmt: skip
    y, x = np.ogrid[: size[0], : size[1]]
    square = ((y - place[0]) ** 2 + (x - place[1]) ** 2).astype(np.float64)
    part = _part(square)
    signal = frames / camera.gain - camera.offset
    cut: NDArray[np.bool_] = np.asarray((frames >= camera.cut).any(0))
    first = _first_ring(frames, part // _PARTS, camera)
    used = (part >= first * _PARTS) & ~cut
    hidden = _cut_rings(square, part // _PARTS, cut, first)
    below = (hidden, camera.cut / camera.gain - camera.offset, place)
    rings = _averaged(signal, square, part, used)
    return Rings(*rings, *(torch.as_tensor(x, dtype=torch.float64) for x in below))


def _refuse_numbers(frames: Numbers, camera: _Camera) -> None:
    top = float(frames.max())
    if top > 2**camera.bits - 1:
        raise ValueError(f"the frames hold {top:.0f} DN, which {camera.bits} bits cannot: give the `bits` of the files")
    if top < camera.cut:
        raise ValueError(f"no pixel is saturated: the brightest has {top:.0f} DN of {camera.cut / _CUT:.0f} DN: expose "
                         "longer, or check `bits`, `full_well` and `gain`")  # fmt: skip


def _middle(frames: Numbers, camera: _Camera) -> tuple[float, float]:
    """Return the middle of the saturated pixels; a median first excludes lone pixels far from the source."""
    y, x = np.nonzero((frames >= camera.cut).all(0))
    if not len(y):
        raise ValueError("no pixel is saturated in every frame: give frames of one exposure, or give `centre`")
    away = np.hypot(y - np.median(y), x - np.median(x))
    near = away <= 3 * max(float(np.median(away)), 1.0)
    return float(y[near].mean()), float(x[near].mean())


def _part(square: Numbers) -> NDArray[np.int64]:
    """Return the number of the part of a ring to which each pixel belongs, for rings that grow from one pixel."""
    radius = np.sqrt(square)
    turn = 1 / (_WIDER - 1)  # below this radius rings are one pixel wide
    beyond = turn + np.log(np.maximum(radius, turn) / turn) / math.log(_WIDER)
    ring: NDArray[np.int64] = np.floor(_PARTS * np.where(radius < turn, radius, beyond)).astype(np.int64)
    return ring


def _first_ring(frames: Numbers, ring: NDArray[np.int64], camera: _Camera) -> int:
    """Return the first ring beyond which every ring lies clearly below saturation, lone bright pixels aside."""
    count = np.bincount(ring.ravel())
    cut = (frames >= camera.cut).any(0)
    mean = np.bincount(ring.ravel(), frames.mean(0).ravel()) / count.clip(1)
    noise = np.sqrt(np.maximum(mean * camera.gain, 0) + (camera.read_noise * camera.gain) ** 2)
    many = np.bincount(ring.ravel(), cut.ravel()) > 0.05 * count
    bright = (mean + _BELOW * noise >= camera.cut) | many
    return max(int(np.flatnonzero(bright & (count > 0)).max(initial=-1)) + 1, int(_LEAST))


def _cut_rings(square: Numbers, ring: NDArray[np.int64], cut: NDArray[np.bool_], first: int) -> Numbers:
    """Return the mean squared distance of each ring inside ``first`` and beyond 16 pixels whose every pixel is cut."""
    count, lost, total = (np.bincount(ring.ravel(), x.ravel()) for x in (np.ones_like(square), cut, square))
    numbers = np.arange(len(count))
    whole = (numbers < first) & (numbers >= _LEAST) & (count > 0) & (lost == count)
    mean: Numbers = total[whole] / count[whole]
    return mean


def _averaged(signal: Numbers, square: Numbers, part: NDArray[np.int64], used: NDArray[np.bool_]) -> tuple[Tensor, ...]:
    """Return mean and number of pixels of each ring, and ring, mean squared distance and pixels of each part."""
    numbers, at = np.unique(part[used], return_inverse=True)
    count = np.bincount(at).astype(np.float64)
    distance, mean = (np.bincount(at, values[used]) / count for values in (square, signal.mean(0)))
    ring, of = np.unique(numbers // _PARTS, return_inverse=True)
    if len(ring) < _RINGS:
        raise ValueError(f"only {len(ring)} rings of pixels lie between the saturated pixels and the edge of the frame:"
                         " expose less, or give a larger frame with the source in it")  # fmt: skip
    pixels = np.bincount(of, count)
    found = (np.bincount(of, count * mean) / pixels, pixels * len(signal), of.astype(np.int64), distance, count)
    return tuple(torch.as_tensor(x) for x in found)
