"""The PSF of a camera by field, measured from frames of point sources."""

from __future__ import annotations

import math
from collections.abc import Sequence
from pathlib import Path
from typing import Annotated, Any

import torch
from pydantic import AfterValidator, Field
from torch import Generator, Tensor

from neusee.nodes import Check, ParameterError, node
from neusee.nodes.restore._points._point_fit import fitted
from neusee.nodes.restore._points._point_frames import Camera, read_points, refuse_bad_frames
from neusee.nodes.sensor._digitization import Bits
from neusee.nodes.sensor._frame_file import Curve
from neusee.nodes.sensor._room_for_light import refuse_without_room, refuse_without_steps
from neusee.nodes.sensor._saturation import Well
from neusee.nodes.units import DataFiles, Electrons, Gain, Shape
from neusee.nodes.values import MeasuredPsf

_GOOD = 1.5  #: chi-square per pixel above which the model is said not to fit
_INFLATED = 4.0  #: inflation of a variance above which the deviation was seen to be smaller than the error


def _odd(window: tuple[int, int]) -> tuple[int, int]:
    if any(n % 2 == 0 or n < 5 for n in window):
        raise ValueError(f"{list(window)} must be two odd numbers of at least 5")
    return window


Window = Annotated[Shape, AfterValidator(_odd)]
Draws = Annotated[int, Field(ge=4, le=1000)]


@node(device="cpu")
def measured_psf(
    responses: Tensor,
    *,
    files: DataFiles | None = None,
    window: Window = (65, 65),
    zones: Shape = (1, 1),
    draws: Draws = 24,
    shape: Shape,
    gain: Gain,
    offset: Electrons,
    full_well: Well,
    read_noise: Electrons,
    bits: Bits = 16,
    curve: Curve | None = None,
    rng: Generator,
) -> MeasuredPsf:
    """Measure the PSF of each channel by field from frames of point sources.

    Each frame shows one or several points. A file whose name begins with `dark` has no light: the mean of these files
    takes the place of `offset`. The signal, place and background of each point are free, so that exposures may have
    different lengths: a long one tells of the wings, a short one of the core. Pixels that are clipped, or expected
    within four standard deviations of clipping, do not count. The PSF is known at the middles of ``zones`` equal parts
    of the frame, and bilinear between them. All is fitted together: least squares, with the noise of the model.

    Shapes: responses (channel, band), of which only the number of channels counts
            -> kernels (row, column, channel, *window), with draws and deviation.
    Units:  files DN; kernels a share of the light in the window. Each kernel has the sum 1, and its centre, weighted by
            the square of the mean of the channels, is the middle pixel: distortion and an absolute shift are not
            measured, lateral colour is. ``outside`` bounds the light beyond the window if it falls as 1 / r^3 or
            faster from the rim, which light bent by the edge of a pupil does.
    Error:  `deviation`, from draws of the noise of photons, converter, background and centring: a relative standard
            deviation of 1 / sqrt(2 draws). Where the frames fit worse than their noise, the deviation grows by the root
            of chi-square in 5 x 5 pixels. Points far from the middles of the zones tell the PSFs of several nodes at
            once and inflate the variance. Up to an ``inflation`` of 3 the deviation was right; at 7 the error was up to
            1.7 times the deviation.
            Points between pixels are interpolated: 1e-4 for an image with up to 0.4 periods in a pixel; a sharper image
            shows as chi-square. The background beyond the windows counts as free of the light of points; pixels beyond
            windows twice as wide give it where there are enough.
    Raises: ParameterError before the run with every frame that cannot be used, and every zone without a point that is
            not saturated; ValueError where a pixel of the PSF is saturated in every frame.
    Source: Anderson and King, Publ. Astron. Soc. Pac. 112, 1360 (2000), an effective PSF from undersampled stars;
            Papandreou and Yuille, NIPS 23 (2010), for the draws.
    """
    camera = gain, offset, full_well, bits, read_noise
    refuse_bad_frames(files or (), len(responses), _two(shape), _two(window), _two(zones), camera, curve)
    seen = read_points(files or (), _two(window), camera)
    fit = fitted(seen, _two(shape), _two(zones), _two(window), draws, rng)
    kernels = fit.kernels.reshape(*zones, *fit.kernels.shape[1:])
    drawn = fit.draws.reshape(-1, *kernels.shape)
    deviation = (drawn.double() - kernels).square().mean(0).sqrt()
    places = seen.middle + fit.state.offset
    points = torch.cat([seen.owner[:, None].double(), places, fit.state.signal.sum(1, keepdim=True)], 1)
    counts = (x.reshape(*zones) for x in (fit.support, fit.inflation))
    return MeasuredPsf(kernels, deviation, drawn, points, fit.chi, _outside(kernels, drawn.double()), *counts)


@measured_psf.preflight
def _(
    *, responses: Tensor | None = None, files: Sequence[Path] | None, window: tuple[int, int], zones: tuple[int, int],
    shape: tuple[int, int], **params: Any,
) -> list[str]:  # fmt: skip
    if files is None:
        raise ParameterError("files", "give the folder with frames of point sources")
    names = ("gain", "offset", "full_well", "bits", "read_noise")
    gain, offset, full_well, bits, read_noise = (params[name] for name in names)
    refuse_without_room(full_well, offset=offset, read_noise=read_noise)
    refuse_without_steps(full_well, gain=gain, bits=bits)
    camera: Camera = gain, offset, full_well, bits, read_noise
    channels = None if responses is None else len(responses)
    refuse_bad_frames(files, channels, _two(shape), _two(window), _two(zones), camera, params.get("curve"))
    return []


@measured_psf.check
def _(result: MeasuredPsf, *inputs: Any, **params: Any) -> list[Check]:
    peak = (result.deviation.amax((-2, -1)) / result.kernels.amax((-2, -1))).max()
    fit = ", ".join(f"{x:.2f}" for x in result.fit.tolist())
    whole = all(math.isfinite(float(x.sum())) for x in result)
    return [
        Check(f"{len(result.places)} points; chi-square per pixel {fit}", float(result.fit.max()) < _GOOD),
        _counted(result),
        Check(f"deviation at most {float(peak):.2g} of the peak", whole),
        Check(f"light beyond the window at most {float(result.outside.max()):.2g}, if it falls as 1 / r^3 or faster"),
    ]


def _counted(result: MeasuredPsf) -> Check:
    """Return how many points tell each PSF, and the zone in which they tell several PSFs at once."""
    least, worst = float(result.support.min()), float(result.inflation.max())
    row, column = divmod(int(result.inflation.argmax()), result.inflation.shape[1])
    text = f"each zone has {least:.2g} points or more in effect, inflation of variance at most {worst:.3g}"
    if worst <= _INFLATED:
        return Check(text)
    why = (
        f" in zone ({row + 1}, {column + 1}), more than {_INFLATED:g}: its points lie far from the middle of the zone "
        "and tell several PSFs at once, so that the deviation may be too small; take frames with points near the "
        "middles of the zones, or choose fewer zones"
    )
    return Check(text + why, False)


def _two(numbers: Sequence[int]) -> tuple[int, int]:
    y, x = numbers
    return y, x


def _outside(kernels: Tensor, draws: Tensor) -> Tensor:
    """Return  2 pi R^2  times the mean at the rim plus two deviations, the largest of all zones, for each channel."""
    y, x = kernels.shape[-2:]
    rim = torch.ones(y, x, dtype=torch.bool)
    rim[2:-2, 2:-2] = False
    at, spread = kernels[..., rim].mean(-1), (draws - kernels)[..., rim].mean(-1).square().mean(0).sqrt()
    bound = 2.0 * math.pi * (min(y, x) / 2.0) ** 2 * (at.clamp_min(0.0) + 2.0 * spread)
    return bound.amax((0, 1))
