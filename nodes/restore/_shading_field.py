"""The transmission of dirt and lens, estimated from frames whose scenes differ."""

from __future__ import annotations

import itertools
import math
from collections.abc import Sequence
from pathlib import Path
from typing import Any, NamedTuple

import torch
from torch import Tensor

from neusee.nodes import Check, ParameterError, node
from neusee.nodes.restore._electrons_and_colour import clipped
from neusee.nodes.sensor._digitization import Bits
from neusee.nodes.sensor._frame_file import Curve, frame, frame_problem
from neusee.nodes.sensor._saturation import Well, refuse_without_room, refuse_without_steps
from neusee.nodes.units import DataFiles, Electrons, Gain, Shape
from neusee.nodes.values import Shading

# --- frame cells ----------------------------------------------------------------------------------

# The logarithm of a frame on a coarse grid of cells, from pixels that are not clipped.


MOST = 12  #: cells along the longer side of a frame
_PIXELS = 2  #: least pixels of a cell along a side
_SEEN = 0.5  #: least share of a cell's pixels that are not clipped
#: standard deviations of noise, below which the light of a cell has no logarithm to trust
_DARK = 5.0


class Cells(NamedTuple):
    """A frame on the coarse grid."""

    log: Tensor  #: (cell,) float64, logarithm of the mean electrons of a cell; 0 where not seen
    seen: Tensor  #: (cell,) bool: False for a cell that is clipped or too dark


def grid(shape: tuple[int, int]) -> tuple[int, int]:
    """Return the numbers of cells along y and x, which are nearly squares."""
    pixels = max(_PIXELS, *(-(-n // MOST) for n in shape))
    y, x = (max(2, round(n / pixels)) for n in shape)
    return y, x


def cells_of(electrons: Tensor, clipped: Tensor, read_noise: float) -> Cells:
    """Return the logarithm of the mean light in each cell of a frame; a field that is smooth adds
    its own logarithm.

    Shapes: electrons (channel, y, x), clipped (y, x) bool. Units: e-.
    """
    cells = grid((electrons.shape[-2], electrons.shape[-1]))
    open_ = (~clipped).double()
    light = electrons.double().sum(0) * open_
    noise = (light.clamp_min(0.0) + len(electrons) * read_noise**2) * open_
    count, total, variance = (_summed(picture, cells) for picture in (open_, light, noise))
    pixels_in_cell = _summed(torch.ones_like(open_), cells)
    usable = (count >= _SEEN * pixels_in_cell) & (total > _DARK * variance.sqrt()) & (count > 0)
    log = torch.where(usable, (total / count.clamp_min(1.0)).clamp_min(1e-300).log(), 0.0)
    return Cells(log.flatten(), usable.flatten())


def _summed(values: Tensor, cells: tuple[int, int]) -> Tensor:
    """Sum a picture (y, x) over its cells."""
    rows, columns = (_numbers(n, k, values) for n, k in zip(values.shape, cells, strict=True))
    row_sums = values.new_zeros(cells[0], values.shape[1]).index_add_(0, rows, values)
    return values.new_zeros(cells).index_add_(1, columns, row_sums)


def _numbers(pixels: int, cells: int, like: Tensor) -> Tensor:
    return torch.arange(pixels, device=like.device) * cells // pixels


def at_pixels(values: Tensor, shape: tuple[int, int]) -> Tensor:
    """Interpolate values (y, x) at the centres of the cells to all pixels, by cubic splines
    through these values.
    """
    for axis, pixels in enumerate(shape):
        values = torch.tensordot(
            _spline(values.shape[axis], pixels), values.movedim(axis, 0), 1
        ).movedim(0, axis)
    return values


def _spline(cells: int, pixels: int) -> Tensor:
    """Return the matrix (pixel, cell) of the cubic spline through the centres of cells, constant
    beyond the ends.
    """
    from scipy.interpolate import CubicSpline

    edges = torch.arange(cells + 1, dtype=torch.float64) * pixels / cells
    centres = (edges.ceil()[1:] + edges.ceil()[:-1] - 1) / 2
    places = torch.arange(pixels, dtype=torch.float64).clamp(centres[0], centres[-1])
    weights = CubicSpline(
        centres.numpy(), torch.eye(cells, dtype=torch.float64).numpy(), bc_type="clamped"
    )(places)
    return torch.from_numpy(weights)


# --- scene spectra --------------------------------------------------------------------------------

# How the light of scenes varies over a coarse grid: spectra that a scene may have, and what frames
# share.


EXPONENTS = (1.0, 1.5, 2.0, 2.5, 3.0)  #: b of a power spectrum 1 / f^b
STRETCHES = (0.5, 1.0, 2.0)  #: of frequencies along y: a horizon has more power there
#: share of the power of the modes of a horizon and of a bright centre that scenes have in common
HABIT = 0.12
#: the same of all other modes; the mean log-frame of 200 photographs (BSDS500) has 0.08 and 0.005
CHANCE = 0.01
_FREE = 1e6  #: variance of the unknown level of a frame, relative to that of its scene


class Likelihood(NamedTuple):
    """The law of a scene for each spectrum that it may have, but for its strength."""

    #: (spectrum, cell, cell) float64; 0 for a cell that is not seen, and for a constant
    precision: Tensor
    log_root: Tensor  #: (spectrum,) float64: half the logarithm of the determinant of the precision


def cosines(grid: tuple[int, int]) -> tuple[Tensor, Tensor, Tensor]:
    """Return orthonormal cosines (cell, mode), and the half-periods of each mode along y and x."""
    bases = []
    for n in grid:
        number, place = torch.arange(n, dtype=torch.float64), torch.arange(n, dtype=torch.float64)
        base = torch.cos(math.pi * number * (place[:, None] + 0.5) / n)
        bases.append(base / base.norm(dim=0))
    longest = max(grid)
    y, x = torch.meshgrid(
        *(torch.arange(n, dtype=torch.float64) * longest / n for n in grid), indexing="ij"
    )
    return torch.kron(bases[0], bases[1]), y.flatten(), x.flatten()


def likelihoods(frame: Cells, grid: tuple[int, int]) -> Likelihood:
    """Return the law of the log-scene of a frame whose level is unknown, for each exponent and
    stretch.
    """
    base, y, x = cosines(grid)
    usable = frame.seen
    precisions, roots = [], []
    for exponent, stretch in itertools.product(EXPONENTS, STRETCHES):
        power = ((stretch * y).square() + x.square()).clamp_min(1e-9).pow(-exponent / 2)
        power[0] = 0.0
        power = power / power.sum()
        power[0] = _FREE
        rows = base[usable]
        lower = torch.linalg.cholesky((rows * power) @ rows.mT)
        inverse = torch.cholesky_inverse(lower)
        level = inverse.sum(0)
        inverse = inverse - torch.outer(level, level) / level.sum()
        full = torch.zeros(len(usable), len(usable), dtype=torch.float64)
        full[usable.nonzero(), usable.nonzero().mT] = inverse
        precisions.append(full)
        roots.append(-lower.diagonal().log().sum() - 0.5 * level.sum().log())
    return Likelihood(torch.stack(precisions), torch.stack(roots))


def shared_detail(logs: Sequence[Tensor], usable: Sequence[Tensor], grid: tuple[int, int]) -> float:
    """Return the correlation of the details of two frames, which are too fine to be dirt."""
    base, y, x = cosines(grid)
    fine = torch.hypot(y, x) >= max(grid) / 2
    details = []
    for log, usable_cells in zip(logs, usable, strict=True):
        flat = torch.where(usable_cells, log - log[usable_cells].mean(), 0.0)
        detail = base[:, fine].mT @ flat
        details.append(detail / detail.norm().clamp_min(1e-300))
    total, count = torch.stack(details).sum(0), len(details)
    if count < 2:
        return 0.0
    correlation = (float(total.square().sum()) - count) / (count * (count - 1))
    return min(1.0, max(0.0, correlation))


def habits(precision: Tensor, frames: float, grid: tuple[int, int]) -> Tensor:
    """Return the covariance (cell, cell) of what scenes have in common, from the summed precision
    of the frames.

    Photographs are brighter at the centre and above: their mean does not go to a constant.
    """
    base, y, x = cosines(grid)
    power = frames / (base * (precision @ base)).sum(0).clamp_min(1e-12)
    rows, columns = (y > 0).double() * y, (x > 0).double() * x
    step_y, step_x = max(grid) / grid[0], max(grid) / grid[1]
    upright = (columns == 0) & (rows <= 2.5 * step_y)
    level = (rows == 0) & (((columns / step_x).round() == 2) | ((columns / step_x).round() == 4))
    share = torch.where(upright | level, HABIT, CHANCE)
    share[0] = 0.0
    return (base * (share * power)) @ base.mT


# --- shared field ---------------------------------------------------------------------------------

# The field that frames share, from the logarithms of their cells, with its posterior distribution.


#: of the logarithm of the field, if there is dirt
DEVIATIONS = (0.05, 0.1, 0.15, 0.2, 0.3, 0.4, 0.5)
#: correlation lengths of the field, relative to the longer side of the frame
LENGTHS = (0.12, 0.2, 0.35)
CLEAN = 0.5  #: prior probability that there is no field
_ROUNDS = 6
#: variance of a mode of the prior relative to the largest, below which the mode is left out
_LEAST = 1e-8


class Field(NamedTuple):
    """The posterior distribution of the logarithm of the field, whose mean over the cells is 0."""

    mean: Tensor  #: (cell,) float64
    covariance: Tensor  #: (cell, cell) float64
    clean: float  #: probability that there is no field
    alike: float  #: correlation of the details of two scenes
    scenes: float  #: number of different scenes that tell as much as the frames


def shared_field(frames: Sequence[Cells], grid: tuple[int, int]) -> Field:
    """Return the posterior of the field that all frames share, given that their scenes are drawn
    independently.

    Each log-frame is a constant, the field, and a scene whose spectrum is a power law with
    strength, exponent and stretch of its own. These are fitted to each frame together with the
    field, by variational Bayes.
    """
    laws = {bytes(frame.seen.tolist()): frame for frame in frames}
    likelihood_of = {usable: likelihoods(frame, grid) for usable, frame in laws.items()}
    frame_likelihoods = [likelihood_of[bytes(frame.seen.tolist())] for frame in frames]
    alike = shared_detail([frame.log for frame in frames], [frame.seen for frame in frames], grid)
    single = 1.0 + (len(frames) - 1) * alike  # frames that tell as much as one frame
    modes = [_modes(grid, length) for length in LENGTHS]
    size = grid[0] * grid[1]
    field = Field(
        torch.zeros(size).double(),
        torch.zeros(size, size).double(),
        CLEAN,
        alike,
        len(frames) / single,
    )
    for _ in range(_ROUNDS):
        precision, pull = torch.zeros(size, size).double(), torch.zeros(size).double()
        for picture, likelihood in zip(frames, frame_likelihoods, strict=True):
            own = _expected(likelihood, picture, field)
            precision += own / single
            pull += own @ picture.log / single
        common = torch.eye(size).double() + precision @ habits(
            precision, len(frames) / single, grid
        )
        field = _posterior(
            torch.linalg.solve(common, precision), torch.linalg.solve(common, pull), modes, field
        )
    return field


def _expected(likelihood: Likelihood, frame: Cells, field: Field) -> Tensor:
    """Return the expected precision (cell, cell) of one frame, given the field that is assumed
    at present.
    """
    left = torch.where(frame.seen, frame.log - field.mean, 0.0)
    misfit = torch.einsum("a,kab,b->k", left, likelihood.precision, left)
    misfit = misfit + torch.einsum("kab,ab->k", likelihood.precision, field.covariance)
    freedom = max(int(frame.seen.sum()) - 1, 1)
    weight = torch.softmax(likelihood.log_root - 0.5 * freedom * misfit.clamp_min(1e-300).log(), 0)
    precision: Tensor = torch.einsum(
        "k,kab->ab", weight * freedom / misfit.clamp_min(1e-300), likelihood.precision
    )
    return precision


def _modes(grid: tuple[int, int], length: float) -> Tensor:
    """Return factors (cell, mode) of the prior covariance of a field of deviation 1 whose mean
    is 0.
    """
    y, x = torch.meshgrid(*(torch.arange(n, dtype=torch.float64) for n in grid), indexing="ij")
    places = torch.stack([y.flatten(), x.flatten()], 1)
    covariance = torch.exp(-0.5 * (torch.cdist(places, places) / (length * max(grid))).square())
    covariance = (
        covariance - covariance.mean(0) - covariance.mean(1, keepdim=True) + covariance.mean()
    )
    values, vectors = torch.linalg.eigh(covariance / covariance.diagonal().mean())
    significant = values > _LEAST * values[-1]
    factor: Tensor = vectors[:, significant] * values[significant].sqrt()
    return factor


def _posterior(precision: Tensor, pull: Tensor, modes: Sequence[Tensor], last: Field) -> Field:
    """Return the mixture of the posteriors over all deviations and lengths of the field, and
    over no field.
    """
    deviations = torch.tensor(DEVIATIONS).double()[:, None]
    gains, parts = [], []
    for factor in modes:
        inner = factor.mT @ precision @ factor
        information, turned = torch.linalg.eigh((inner + inner.mT) / 2)
        information, projection = information.clamp_min(0.0), turned.mT @ (factor.mT @ pull)
        left = 1.0 / (deviations**-2 + information)
        gains.append(
            0.5 * (left * projection.square() - torch.log1p(deviations**2 * information)).sum(1)
        )
        parts.append((factor @ turned, left, left * projection))
    gain = torch.stack(gains) - math.log(len(gains) * len(DEVIATIONS))
    share = torch.softmax(gain.flatten(), 0).view_as(gain)
    middles = torch.cat([moved @ shapes.mT for shapes, _, moved in parts])
    mean = share.flatten() @ middles
    about = middles - mean
    covariance = (share.flatten() * about.mT) @ about
    for weight, (shapes, left, _) in zip(share, parts, strict=True):
        covariance = covariance + (shapes * (weight @ left)) @ shapes.mT
    odds = math.exp(min(float(torch.logsumexp(gain.flatten(), 0)), 700.0)) * (1.0 - CLEAN) / CLEAN
    return last._replace(mean=mean, covariance=covariance, clean=1.0 / (1.0 + odds))


# --- shading node ---------------------------------------------------------------------------------

# The transmission of dirt, estimated from frames of one camera whose scenes differ.


TOLD = 0.5  #: least share of the variance of the field that frames must tell
DOUBT = 0.05  #: largest probability that there is no field, with which a frame is divided by it
SCENES = 8  #: least number of different scenes: among fewer, an unusual one decides
MOST_FRAMES = 400  #: frames


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
    """Estimate the smooth transmission, such as dirt on a window, that frames of different scenes
    share.

    The logarithm of a frame on a coarse grid is the sum of an unknown level, the field, and a
    scene. Each scene has a power spectrum 1 / f^b whose strength, exponent and stretch along y are
    fitted to its frame. The field is a Gaussian process of unknown deviation (0.05 to 0.5) and
    length (0.12 to 0.35 of the longer side). Scenes also share habits of photographers, such as a
    bright centre, which count as unknown. With fewer than 8 different scenes, or if the frames tell
    less than half of the variance of the field, or if there is none with more than 5 % probability,
    the transmission is 1 and the frame stays as it is. Clipped pixels, and cells whose light is
    within noise, are left out.

    Shapes: responses (channel, band), of which only the number of channels counts
            -> Shading of (y, x), with knots on a grid of up to 12 x 12 cells.
    Units:  gain DN/e-; offset, full_well and read_noise e-; transmission relative to its geometric
            mean.
    Error:  the posterior deviation of each knot, under the model. A constant factor, and what all
            scenes have in common, cannot be told from dirt. Frames of one scene count as few
            frames, by the correlation of their details. The transmission is the same for all
            channels and frames. Light that dirt scatters (a veil) is not estimated.
    Raises: ParameterError before the run for a file that is no frame of the sensor, and for more
            than 400 files.
    Source: Gaussian process with fixed spectra, Rasmussen and Williams, Gaussian Processes for
            Machine Learning, ch. 2; spectra of scenes: Field, J. Opt. Soc. Am. A 4, 2379 (1987);
            variational Bayes: Bishop, Pattern Recognition and Machine Learning, ch. 10.
    """
    frames = []
    for file in files:
        raw = frame(responses, file=file, shape=shape, bits=bits, curve=curve)
        light = raw.double() / gain - (offset if offset_subtracted else 0.0)
        frames.append(
            cells_of(
                light, clipped(raw, full_well=full_well, gain=gain, bits=bits).any(0), read_noise
            )
        )
    return _estimated(frames, (shape[0], shape[1]))


def _estimated(frames: Sequence[Cells], shape: tuple[int, int]) -> Shading:
    cells = grid(shape)
    field = shared_field([frame for frame in frames if int(frame.seen.sum()) > 1], cells)
    variance = field.covariance.diagonal().clamp_min(0.0)
    power = float(field.mean.square().mean())
    share_told = power / (power + float(variance.mean()))
    certain = share_told >= TOLD and field.clean <= DOUBT and field.scenes >= SCENES
    wide = variance if certain else variance + field.mean.square()
    applied = field.mean if certain else torch.zeros_like(field.mean)
    return Shading(
        transmission=at_pixels(applied.view(cells), shape).exp().float(),
        spread=at_pixels(wide.sqrt().view(cells), shape).clamp_min(0.0).float(),
        estimate=field.mean.view(cells),
        deviation=variance.sqrt().view(cells),
        told=torch.tensor(share_told).double(),
        clean=torch.tensor(field.clean).double(),
        identifiable=torch.tensor(certain),
        frames=torch.tensor(len(frames)),
        alike=torch.tensor(field.alike).double(),
    )


@shading.preflight
def _(
    *,
    responses: Tensor | None = None,
    files: Sequence[Path],
    shape: Shape,
    bits: int = 16,
    curve: Curve | None = None,
    **params: Any,
) -> list[str]:
    if len(files) > MOST_FRAMES:
        raise ParameterError(
            "files",
            f"{len(files)} frames are more than {MOST_FRAMES}: give fewer, of different scenes",
        )
    refuse_without_room(
        params["full_well"], offset=params["offset"], read_noise=params["read_noise"]
    )
    refuse_without_steps(params["full_well"], gain=params["gain"], bits=bits)
    channels = None if responses is None else len(responses)
    for file in files:
        if problem := frame_problem(file, channels, (shape[0], shape[1]), bits, curve):
            raise ParameterError("files", problem)
    return []


@shading.check
def _(result: Shading, *inputs: Any, **params: Any) -> list[Check]:
    count, share_told = int(result.frames), float(result.told)
    frames = "one frame" if count == 1 else f"{count} frames"
    low, high = (float(x) for x in torch.aminmax(result.transmission))
    result_text = (
        f"transmission from {low:.3g} to {high:.3g}"
        if bool(result.identifiable)
        else "not identifiable"
    )
    text = f"{result_text}: {frames} tell {share_told:.0%} of the field"
    return [Check(text, bool(result.transmission.isfinite().all()) and low > 0)]
