"""The transmission of dirt, estimated from frames of one camera whose scenes differ."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path
from typing import Any

import torch
from torch import Tensor

from neusee.nodes import Check, ParameterError, node
from neusee.nodes.restore._electrons_and_colour import clipped
from neusee.nodes.restore._shading._frame_cells import Cells, at_pixels, cells_of, grid
from neusee.nodes.restore._shading._shared_field import shared_field
from neusee.nodes.sensor._digitization import Bits
from neusee.nodes.sensor._frame_file import Curve, frame, frame_problem
from neusee.nodes.sensor._room_for_light import refuse_without_room, refuse_without_steps
from neusee.nodes.sensor._saturation import Well
from neusee.nodes.units import DataFiles, Electrons, Gain, Shape
from neusee.nodes.values import Shading

TOLD = 0.5  #: least share of the variance of the field that frames must tell
DOUBT = 0.05  #: largest probability that there is no field, with which a frame is divided by it
SCENES = 8  #: least number of different scenes: among fewer, an unusual one decides
MOST = 400  #: frames


@node(rtol=1e-5)
def shading(
    responses: Tensor,
    *,
    files: DataFiles,
    shape: Shape,
    bits: Bits = 16,
    gain: Gain,
    offset: Electrons,
    offset_subtracted: bool = True,
    full_well: Well,
    read_noise: Electrons,
    curve: Curve | None = None,
) -> Shading:
    """Estimate the smooth transmission, such as dirt on a window, that frames of different scenes share.

    The logarithm of a frame on a coarse grid is the sum of an unknown level, the field, and a scene. Each scene has a
    power spectrum 1 / f^b whose strength, exponent and stretch along y are fitted to its frame. The field is a Gaussian
    process of unknown deviation (0.05 to 0.5) and length (0.12 to 0.35 of the longer side). Scenes also share habits of
    photographers, such as a bright centre, which count as unknown. With fewer than 8 different scenes, or if the frames
    tell less than half of the variance of the field, or if there is none with more than 5 % probability, the
    transmission is 1 and the frame stays as it is. Clipped pixels, and cells whose light is within noise, are left out.

    Shapes: responses (channel, band), of which only the number of channels counts
            -> Shading of (y, x), with knots on a grid of up to 12 x 12 cells.
    Units:  gain DN/e-; offset, full_well and read_noise e-; transmission relative to its geometric mean.
    Error:  the posterior deviation of each knot, under the model. A constant factor, and what all scenes have in
            common, cannot be told from dirt. Frames of one scene count as few frames, by the correlation of their
            details. The transmission is the same for all channels and frames. Light that dirt scatters (a veil) is not
            estimated.
    Raises: ParameterError before the run for a file that is no frame of the sensor, and for more than 400 files.
    Source: Gaussian process with fixed spectra, Rasmussen and Williams, Gaussian Processes for Machine Learning, ch. 2;
            spectra of scenes: Field, J. Opt. Soc. Am. A 4, 2379 (1987); variational Bayes: Bishop, Pattern
            Recognition and Machine Learning, ch. 10.
    """
    frames = []
    for file in files:
        raw = frame(responses, file=file, shape=shape, bits=bits, curve=curve)
        light = raw.double() / gain - (offset if offset_subtracted else 0.0)
        frames.append(cells_of(light, clipped(raw, full_well=full_well, gain=gain, bits=bits).any(0), read_noise))
    return _estimated(frames, (shape[0], shape[1]))


def _estimated(frames: Sequence[Cells], shape: tuple[int, int]) -> Shading:
    cells = grid(shape)
    field = shared_field([each for each in frames if int(each.seen.sum()) > 1], cells)
    variance = field.covariance.diagonal().clamp_min(0.0)
    power = float(field.mean.square().mean())
    told = power / (power + float(variance.mean()))
    certain = told >= TOLD and field.clean <= DOUBT and field.scenes >= SCENES
    wide = variance if certain else variance + field.mean.square()
    applied = field.mean if certain else torch.zeros_like(field.mean)
    return Shading(
        transmission=at_pixels(applied.view(cells), shape).exp().float(),
        spread=at_pixels(wide.sqrt().view(cells), shape).clamp_min(0.0).float(),
        estimate=field.mean.view(cells),
        deviation=variance.sqrt().view(cells),
        told=torch.tensor(told).double(),
        clean=torch.tensor(field.clean).double(),
        identifiable=torch.tensor(certain),
        frames=torch.tensor(len(frames)),
        alike=torch.tensor(field.alike).double(),
    )


@shading.preflight
def _(
    *, responses: Tensor | None = None, files: Sequence[Path], shape: Shape, bits: int = 16,
    curve: Curve | None = None, **params: Any,
) -> list[str]:  # fmt: skip
    if len(files) > MOST:
        raise ParameterError("files", f"{len(files)} frames are more than {MOST}: give fewer, of different scenes")
    refuse_without_room(params["full_well"], offset=params["offset"], read_noise=params["read_noise"])
    refuse_without_steps(params["full_well"], gain=params["gain"], bits=bits)
    channels = None if responses is None else len(responses)
    for file in files:
        if problem := frame_problem(file, channels, (shape[0], shape[1]), bits, curve):
            raise ParameterError("files", problem)
    return []


@shading.check
def _(result: Shading, *inputs: Any, **params: Any) -> list[Check]:
    count, told = int(result.frames), float(result.told)
    frames = "one frame" if count == 1 else f"{count} frames"
    low, high = (float(x) for x in torch.aminmax(result.transmission))
    found = f"transmission from {low:.3g} to {high:.3g}" if bool(result.identifiable) else "not identifiable"
    text = f"{found}: {frames} tell {told:.0%} of the field"
    return [Check(text, bool(result.transmission.isfinite().all()) and low > 0)]
