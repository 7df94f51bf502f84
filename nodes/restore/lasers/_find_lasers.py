"""Nodes that find lasers in a frame of a known camera, and compute the glare of these lasers."""

from __future__ import annotations

import math
from typing import Annotated, Any

import torch
from pydantic import Field
from torch import Generator, Tensor

from neusee.nodes import Check, ParameterError, node
from neusee.nodes.precision import refuse_not_finite, single
from neusee.nodes.restore.inverse._glare import Patterns
from neusee.nodes.restore.inverse._wiener import View, refuse_other_pictures
from neusee.nodes.restore.lasers._candidates import line_templates
from neusee.nodes.restore.lasers._components import NANOMETRE, Camera, Laser, lamp_light
from neusee.nodes.restore.lasers._frame_likelihood import NORMAL, spreads
from neusee.nodes.restore.lasers._greedy_search import Found, Known, search, without_scattered
from neusee.nodes.restore.lasers._line_pattern import Lens, Sensor, line_pattern
from neusee.nodes.units import Electrons, FocalLength, PixelPitch, PositiveLength, Ratio
from neusee.nodes.values import Bands, FoundLasers, Psf, Pupil

# --- lost light -----------------------------------------------------------------------------------

# Estimates the light of a laser at the aperture from the light that is found in its diffraction
# pattern ("straight" light). Dirt scatters and absorbs the rest.
#
# A real lens deviates from its recipe. Dust, scratches, grease, dents and defocus take light out of
# the pattern, and the scattered light makes the frame differ from the pattern. A fit then finds
# less light in the pattern, and even less where bright pixels are clipped, because the unclipped
# pixels are those that happen to be dark. For the same reason, the fitted electrons vary more
# between parts of the frame than noise and scene explain. This excess variation ("scatter" below)
# is a measure of the lost light.
#
# The prior distribution: half of the lenses are as their recipe says. For the others, let L be the
# logarithm of (light at the aperture / light in the pattern). L has a lognormal distribution. Its
# median is a power of the scatter, times an exponential of the clipped fraction. Power, exponential
# and width were fitted to frames of lenses with the dirt of `recipes/flare/dirty_windshield.yaml`
# (dust, scratches, grease and dents, each 3 to 100 % of it) and the defocus of
# `recipes/mismatch/usual.yaml`. An even attenuation, as by smudges, changes no pattern and is not
# included.


#: largest ratio of the robust to the ideal standard deviation that a clean lens explains
_CLEAN_LENS_GROWTH = 1.05
#: side (pixels) of the frame to which a scatter is scaled, and side of the largest frame whose
#: pixels all add to the estimate of the scatter
_SCATTER_SIDE, _SAMPLED_SIDE = 64, 128
#: relative scatter of the electrons behind a dirty lens: median, and factor of one standard
#: deviation (lognormal)
_USUAL_SCATTER, _SCATTER_FACTOR = 0.004, 2.0
#: median of L: its value at scatter 1 without clipping, its power of the scatter, and its
#: exponential growth with the clipped fraction
_LOST_LOGARITHM, _SCATTER_POWER, _CLIPPING_GROWTH = 2.10, 0.74, 2.15
#: standard deviations of log L: if the scatter is measurable, and if not
_LOST_DEVIATIONS = (0.7, 1.2)
_ALL_LOST = 10.0  #: largest L: above it, hardly any light of a laser is in its pattern
_LAW_QUANTILES = 256  #: number of quantiles that represent a distribution
#: probabilities of an estimate and of the ends of a 90 % interval
_INTERVAL_PROBABILITIES = (0.5, 0.05, 0.95)
_HALVINGS = 60


def at_the_aperture(
    straight: Tensor, spread: Tensor, ideal: Tensor, unclipped: Tensor
) -> tuple[Tensor, Tensor]:
    """Return an estimate of the electrons that a laser would give behind a clean lens, and the ends
    of its 90 % interval.

    ``straight`` are the electrons in the pattern, and ``spread`` is their standard deviation.
    ``ideal`` is the standard deviation for a lens that is as its recipe says.

    Shapes: each (channel,), unclipped (channel, y, x), 0 for clipped pixels -> (channel,),
            (channel, 2).
    Units:  e-.
    """
    # the scatter is that of a mean over the frame, so that it falls as 1 / side
    side = min(unclipped[0].numel() ** 0.5, _SAMPLED_SIDE)
    clipped = 1.0 - unclipped.mean((-2, -1)).to(straight)
    electrons = torch.maximum(straight, spread).clamp_min(1e-30) * (_SCATTER_SIDE / side)
    scatter = (spread.square() - ideal.square()).clamp_min(0.0).sqrt() / electrons
    # the smallest measurable scatter: it increases the deviation by `_CLEAN_LENS_GROWTH`
    least_scatter = math.sqrt(_CLEAN_LENS_GROWTH**2 - 1.0) * ideal / electrons
    measurable = scatter > least_scatter
    # odds of a dirty lens whose scatter is not measurable against a clean lens; prior odds are 1
    dirty_odds = torch.special.ndtr(
        (least_scatter / _USUAL_SCATTER).log() / math.log(_SCATTER_FACTOR)
    )
    dirty_probability = (
        torch.ones_like(electrons) if bool(measurable.any()) else dirty_odds / (1.0 + dirty_odds)
    )
    scatter = torch.where(measurable, scatter, least_scatter.clamp_max(_USUAL_SCATTER))
    width = torch.where(measurable, _LOST_DEVIATIONS[0], _LOST_DEVIATIONS[1])
    # see above: a power of the scatter, times an exponential of the clipped fraction
    log_of_median = (
        math.log(_LOST_LOGARITHM) + _SCATTER_POWER * scatter.log() + _CLIPPING_GROWTH * clipped
    )
    log_loss = torch.exp(
        log_of_median[:, None] + width[:, None] * _normal_quantiles().to(electrons)
    ).clamp_max(_ALL_LOST)
    return _quantiles(straight, spread, log_loss, dirty_probability)


def _normal_quantiles() -> Tensor:
    quantiles: Tensor = torch.special.ndtri(
        (torch.arange(_LAW_QUANTILES, dtype=torch.float64) + 0.5) / _LAW_QUANTILES
    )
    return quantiles


def _quantiles(
    straight: Tensor, spread: Tensor, lost: Tensor, dirty: Tensor
) -> tuple[Tensor, Tensor]:
    """Return the median and a 90 % interval of the light at the aperture: ``straight`` times
    exp(loss), with the normal error ``spread``.

    ``lost`` (channel, node) are equally probable losses of a dirty lens; a clean lens has no loss.
    ``dirty`` (channel,) is the probability of a dirty lens.
    """
    # the first strength is that of a clean lens, without loss
    strengths = straight[:, None] * torch.cat([torch.ones_like(lost[:, :1]), lost.exp()], 1)
    probability_of_strength = torch.cat(
        [1.0 - dirty[:, None], (dirty / lost.shape[1])[:, None].expand_as(lost)], 1
    )
    probabilities = torch.tensor(_INTERVAL_PROBABILITIES).to(strengths).expand(len(strengths), -1)
    low = (strengths.amin(1) - 8.0 * spread)[:, None].expand_as(probabilities)
    high = (strengths.amax(1) + 8.0 * spread)[:, None].expand_as(probabilities)
    # bisection: the distribution function of a mixture of normals has no closed inverse
    for _ in range(_HALVINGS):
        middle = 0.5 * (low + high)
        share_below = torch.special.ndtr(
            (middle[..., None] - strengths[:, None]) / spread.clamp_min(1e-30)[:, None, None]
        )
        below_probability = (probability_of_strength[:, None] * share_below).sum(-1) < probabilities
        low, high = (
            torch.where(below_probability, middle, low),
            torch.where(below_probability, high, middle),
        )
    return high[:, 0], high[:, 1:]


# --- find lasers ----------------------------------------------------------------------------------

# The node that finds lasers in one frame of a known camera, without any knowledge of the lasers.


#: pixels and nm: largest half width of an interval for which a laser counts as identified
_WIDEST_INTERVAL = (0.5, 10.0)
#: smallest lead in log likelihood over a fit at another place or wavelength, for which a laser
#: counts as identified
_RIVAL = 5.0
_CHANNELS, _SMALLEST = (1, 3), 20
_COLOURS = (
    "lasers are found in a frame of 3 colour channels (3, y, x), or of one: give such a camera, or"
    " restore without a search, as `restore=wiener_blind` does"
)
_PRECISE_SIDE = 256  #: largest side in pixels of a frame that is computed in float64


Widths = Annotated[tuple[PositiveLength, ...], Field(min_length=1, max_length=8)]


@node()
def find_lasers(
    electrons: Tensor,
    clipped: Tensor,
    psf: Psf,
    pupil: Pupil,
    illuminant: Tensor,
    responses: Tensor,
    bands: Bands,
    *,
    focal_length: FocalLength,
    pixel_pitch: PixelPitch,
    sensor: Sensor = "point",
    read_noise: Electrons,
    most: Annotated[int, Field(ge=1, le=8)] = 3,
    lamps: Annotated[int, Field(ge=0, le=16)] = 4,
    widths: Widths = (1e-9, 5e-9, 10e-9),
    least: Ratio = 40.0,
    margin: Annotated[float, Field(ge=0, lt=1)] = 0.02,
) -> FoundLasers:
    """Find the lasers in one frame: their number, and direction, wavelength and strength of each,
    with intervals.

    The camera is known and the lasers are not. The pattern of a spectral line at every place and
    wavelength is compared with the frame, which a short filter has made nearly white: the scene
    counts as a random picture whose details are as strong as those around each pixel. The values of
    clipped pixels are not used; their number and places say where a fit begins. The best candidates
    are fitted with a free response of each channel (3 %), and with each of the ``widths`` (full
    width at half maximum) of a line. A laser must gain ``least`` of log likelihood, and at least
    ``margin`` of its gain beyond that of a lamp, a point source whose spectrum is smooth. The
    pattern of a lamp comes from the pupil too, for any place between pixels and over the whole
    frame; what ``psf`` has beyond it, such as stray light, is added. All lasers and lamps are
    fitted at once, and the search goes on in the rest. At the end a laser that does not gain
    ``least`` beside the likeliest speckle of stronger ones, which a dirty lens scatters, is left
    out. Intervals (90 %) come from the second derivatives and the scatter of the residual.

    The strength counts all light at the aperture, as in a recipe. Dirt, edges and defocus take part
    of it out of the pattern; the scatter of the residual tells how much that may be, by a law that
    was learnt from the dirt of `recipes/flare/dirty_windshield.yaml`. An even attenuation is not
    told from a weaker laser.

    In a frame of one channel nothing but the scale of a pattern tells its wavelength, and nothing
    but its sharpness tells a laser from a lamp.

    Shapes: electrons and clipped (channel, y, x) of 1 or 3 channels, psf.intensity (band, any,
            any), pupil, illuminant (band,), responses (channel, band), bands -> FoundLasers of
            ``most`` rows.
    Units:  electrons e-; direction rad; wavelength and widths m; strength e-; gain none.
    Error:  in frames of more than 256 pixels a side float32 rounds the fit. A light that is narrow
            but no laser, such as a light-emitting diode, may be taken for one. A laser that changes
            no pixel that is seen is not found. Two lasers within 2 pixels and 25 nm count as one.
            The responses are linear between the bands. The pattern of a lamp has at most 4 samples
            along a pixel and 4096 a side: where the lens draws finer fringes, a lamp between pixels
            is not exact. `recipes/guide/found_lasers.md` has measured rates and coverage.
    Raises: ValueError for other numbers of channels, frames of fewer than 20 pixels a side, inputs
            of different channels, bands or pixels, and values that are not finite.
    Gradient: none, because a search chooses between candidates.
    Source: matched filter as in Kay, Fundamentals of Statistical Signal Processing II, 1998, ch. 4;
            covariance of a model that may be wrong as in White, Econometrica 50, 1 (1982).
    """
    _refuse(electrons, clipped, psf, pupil, responses, bands)
    lens = Lens(focal_length, pixel_pitch, (electrons.shape[-2], electrons.shape[-1]), sensor)
    with torch.no_grad():
        small_frame = max(electrons.shape[-2:]) <= _PRECISE_SIDE
        frame = electrons.detach().to(torch.float64 if small_frame else torch.float32)
        constant_pupil = Pupil(*(x.detach() for x in pupil))
        frame_and_camera = Known(
            frame,
            (~clipped).to(frame),
            Camera(
                constant_pupil,
                responses.detach().to(frame),
                bands,
                lens,
                torch.tensor(widths[0], dtype=torch.float64),
            ),
            lamp_light(View(psf, illuminant, responses, bands), constant_pupil, lens, frame.dtype),
            line_templates(constant_pupil, responses, bands, lens),
            read_noise,
            widths,
        )
        lasers = without_scattered(
            search(frame_and_camera, most, lamps, least, margin), frame_and_camera, least
        )
        return _table(lasers, frame_and_camera, most)


@find_lasers.preflight
def _(*, responses: Any = None, **_: Any) -> list[str]:
    """Refuse a camera unless it has 1 or 3 channels, if its responses are known before the run."""
    if responses is not None and len(responses) not in _CHANNELS:
        raise ParameterError(
            "responses.camera", f"the camera has {_channel_count(len(responses))}: {_COLOURS}"
        )
    return []


@find_lasers.check
def _(
    result: FoundLasers,
    electrons: Tensor,
    *inputs: Any,
    focal_length: float,
    pixel_pitch: float,
    **_: Any,
) -> list[Check]:
    count = int(result.number)
    if not count:
        return [Check("no laser found")]
    texts = []
    for n in range(count):
        y, x = (result.direction[n] * (focal_length / pixel_pitch)).tolist()
        low, high = (result.wavelength_interval[n] / NANOMETRE).tolist()
        doubt_text = "" if bool(result.identifiable[n].all()) else ", not identifiable"
        texts.append(
            f"{y:+.2f}, {x:+.2f} px, {float(result.wavelength[n]) / NANOMETRE:.1f} nm ({low:.1f} to"
            f" {high:.1f}){doubt_text}"
        )
    one_channel_text = (
        ""
        if len(electrons) > 1
        else "; with one channel, wavelengths come from the scale of the patterns alone"
    )
    return [Check(f"{count} laser{'s' * (count > 1)} found: {'; '.join(texts)}{one_channel_text}")]


def _refuse(
    electrons: Tensor, clipped: Tensor, psf: Psf, pupil: Pupil, responses: Tensor, bands: Bands
) -> None:
    """Raise ValueError unless shapes and bands of frame and camera agree, the pupil is finite, and
    the frame has 1 or 3 channels and enough pixels.
    """
    if electrons.ndim != 3 or len(electrons) not in _CHANNELS:
        raise ValueError(f"electrons {tuple(electrons.shape)}: {_COLOURS}")
    refuse_other_pictures(electrons, psf, responses, clipped, None)
    if min(electrons.shape[-2:]) < _SMALLEST:
        raise ValueError(
            f"a frame of {tuple(electrons.shape[-2:])} pixels is too small: give at least"
            f" {_SMALLEST} a side"
        )
    if len(pupil.wavelengths) != len(bands.centres):
        raise ValueError(
            f"pupil of {len(pupil.wavelengths)} bands and {len(bands.centres)} bands differ: "
            "compute both from one `bands` step"
        )
    refuse_not_finite(
        "no laser can be found", pupil=pupil.path.sum() + pupil.height.sum() + pupil.amplitude.sum()
    )


def _channel_count(channels: int) -> str:
    return f"{channels} channel{'s' * (channels != 1)}"


def _table(search_result: Found, frame: Known, rows: int) -> FoundLasers:
    """Return the found lasers in SI units, in the order of decreasing gain."""
    laser_indices = [
        n for n, component in enumerate(search_result.fit.parts) if isinstance(component, Laser)
    ]
    spread = spreads(search_result.fit, frame.seen) if laser_indices else []
    rows_by_gain = sorted(
        range(len(laser_indices)), key=lambda n: -search_result.choices[laser_indices[n]].gain
    )
    result = _empty(rows, len(frame.electrons))
    radians_per_pixel = frame.camera.lens.pixel_pitch / frame.camera.lens.focal_length
    for row, n in enumerate(rows_by_gain):
        laser = search_result.fit.parts[laser_indices[n]]
        assert isinstance(laser, Laser)
        # values: y and x in pixels, wavelength in nm, then the electrons of each channel
        values = torch.cat([laser.values[:3], laser.channels()]).cpu().double()
        covariance = spread[n].covariance.cpu().double()
        half_interval = NORMAL * covariance.diagonal().sqrt()
        value_intervals = torch.stack([values - half_interval, values + half_interval], -1)
        result.direction[row], result.direction_interval[row] = (
            radians_per_pixel * values[:2],
            radians_per_pixel * value_intervals[:2],
        )
        result.wavelength[row], result.wavelength_interval[row] = (
            NANOMETRE * values[2],
            NANOMETRE * value_intervals[2],
        )
        result.fwhm[row] = laser.fwhm
        result.straight[row], result.straight_spread[row] = values[3:], half_interval[3:] / NORMAL
        strength_and_deviations = (
            result.straight[row],
            result.straight_spread[row],
            spread[n].ideal.cpu().double(),
        )
        result.strength[row], result.strength_interval[row] = at_the_aperture(
            *strength_and_deviations, frame.seen.cpu()
        )
        # identified: no rival, and narrow intervals of place and wavelength
        choice = search_result.choices[laser_indices[n]]
        without_rival = choice.rival > _RIVAL
        result.identifiable[row, 0] = (
            without_rival and float(half_interval[:2].max()) < _WIDEST_INTERVAL[0]
        )
        result.identifiable[row, 1] = (
            without_rival and float(half_interval[2]) < _WIDEST_INTERVAL[1]
        )
        result.gain[row] = torch.tensor([choice.gain, choice.margin])
        result.correlation[row] = covariance / torch.outer(
            half_interval / NORMAL, half_interval / NORMAL
        )
    return result._replace(number=torch.tensor(len(laser_indices)))


def _empty(rows: int, channels: int) -> FoundLasers:
    """Return a table with ``rows`` empty rows: all values are 0 and no laser is found."""
    shapes = ((2,), (), (), (channels,), (2, 2), (2,), (channels, 2))
    tables = [torch.zeros(rows, *shape, dtype=torch.float64) for shape in shapes]
    identifiable = torch.zeros(rows, 2, dtype=torch.bool)
    gain, correlation = (
        torch.zeros(rows, *shape, dtype=torch.float64)
        for shape in ((2,), (3 + channels, 3 + channels))
    )
    (
        directions,
        wavelengths,
        widths,
        strengths,
        direction_intervals,
        wavelength_intervals,
        strength_intervals,
    ) = tables
    no_lasers = torch.tensor(0)
    straight = (torch.zeros_like(strengths), torch.zeros_like(strengths))
    return FoundLasers(
        no_lasers,
        directions,
        wavelengths,
        widths,
        strengths,
        direction_intervals,
        wavelength_intervals,
        strength_intervals,
        identifiable,
        gain,
        correlation,
        *straight,
    )


# --- found glare ----------------------------------------------------------------------------------

# The glare of a laser that was found in a frame, and random patterns from its distribution.


Rank = Annotated[int, Field(ge=1, le=8)]


@node()
def found_glare(
    found: FoundLasers,
    pupil: Pupil,
    electrons: Tensor,
    *,
    rank: Rank = 1,
    focal_length: FocalLength,
    pixel_pitch: PixelPitch,
    sensor: Sensor = "point",
) -> Tensor:
    """Compute the glare of a laser that was found in a frame; 0 where fewer than ``rank`` lasers
    were found.

    The glare is the pattern of a spectral line at the direction and wavelength found, times the
    electrons of each channel that follow it. `restore.wiener` takes it as ``glare``. Every tensor
    of ``found`` and ``pupil`` receives a derivative. Of ``electrons``, the frame, only the shape is
    used.

    Shapes: found (laser,), pupil (v, u), electrons (channel, y, x) -> (channel, y, x).
    Units:  e-; rank counts from 1, the laser of the largest gain.
    Error:  the sums over the pupil are exact in the precision of the height: 1e-6 of the brightest
            pixel for float32. The index of the mask is a cubic between the bands of the pupil.
            Beyond half the alias-free field from the spot the glare is 0.
    Raises: ValueError where the found lasers and the frame differ in the number of channels.
    Source: Goodman, Introduction to Fourier Optics, 3rd edition, eq. 5-14 (field in the focal plane
            of a lens).
    """
    _agree(found, electrons)
    if rank > int(found.number):
        return torch.zeros_like(single(electrons))
    lens = Lens(focal_length, pixel_pitch, (electrons.shape[-2], electrons.shape[-1]), sensor)
    row = rank - 1
    pattern = line_pattern(
        pupil, found.direction[row], found.wavelength[row], lens, found.fwhm[row]
    )
    glare: Tensor = found.straight[row].to(pattern)[:, None, None] * pattern
    return glare.to(single(electrons))


@node()
def found_nearby(
    found: FoundLasers,
    pupil: Pupil,
    electrons: Tensor,
    *,
    rank: Rank = 1,
    focal_length: FocalLength,
    pixel_pitch: PixelPitch,
    sensor: Sensor = "point",
    patterns: Patterns = 12,
    rng: Generator,
) -> Tensor:
    """Draw patterns that the glare of a found laser may have, from the joint normal law of what was
    found.

    Each pattern has its own direction, wavelength and electrons of each channel, drawn with the
    covariance of the found laser. `restore.wiener` takes the patterns as ``nearby``. A laser that
    was not found has patterns of 0.

    Shapes: found (laser,), pupil (v, u), electrons (channel, y, x) -> (pattern, channel, y, x).
    Units:  e-; rank counts from 1.
    Error:  each pattern as `restore.found_glare`. The covariance of the patterns has the relative
            error sqrt(2 / patterns), and at most ``patterns`` dimensions.
    Raises: ValueError where the found lasers and the frame differ in the number of channels.
    Source: sampled prior of a nuisance parameter as in Kaipio and Somersalo, Statistical and
            Computational Inverse Problems, 2005, ch. 5 (approximation error).
    """
    _agree(found, electrons)
    if rank > int(found.number):
        return torch.zeros(patterns, *electrons.shape).to(single(electrons))
    row, lens = (
        rank - 1,
        Lens(focal_length, pixel_pitch, (electrons.shape[-2], electrons.shape[-1]), sensor),
    )
    drawn = []
    for values in _drawn(found, row, patterns, rng):
        pattern = line_pattern(pupil, values[:2], values[2], lens, found.fwhm[row])
        drawn.append(values[3:].clamp_min(0.0).to(pattern)[:, None, None] * pattern)
    return torch.stack(drawn).to(single(electrons))


@found_nearby.check
@found_glare.check
def _(
    result: Tensor, found: FoundLasers, *inputs: Any, rank: int = 1, **params: Any
) -> list[Check]:
    if rank > int(found.number):
        return [Check(f"no laser of rank {rank} was found, so there is no glare")]
    return [Check(f"brightest pixel {float(result.max()):.3g} e-", bool(result.isfinite().all()))]


def _drawn(lasers: FoundLasers, row: int, count: int, rng: Generator) -> Tensor:
    """Return draws (draw, value) of direction, wavelength and electrons of each channel from the
    normal distribution of a found laser.
    """
    most_likely = torch.cat(
        [lasers.direction[row], lasers.wavelength[row][None], lasers.straight[row]]
    )
    intervals = (lasers.direction_interval[row], lasers.wavelength_interval[row][None])
    spread = torch.cat(
        [
            # a 90 % interval extends `NORMAL` standard deviations to each side
            *((ends[:, 1] - ends[:, 0]) / (2 * NORMAL) for ends in intervals),
            lasers.straight_spread[row],
        ]
    )
    # `cholesky` reads one triangle alone; 1e-9 lets a singular matrix be factored
    symmetric = (lasers.correlation[row] + lasers.correlation[row].mT) / 2
    lower_factor = torch.linalg.cholesky(symmetric + 1e-9 * torch.eye(len(symmetric)).to(symmetric))
    normal_numbers = torch.randn(
        count, len(most_likely), generator=rng, device=rng.device, dtype=torch.float64
    ).to(most_likely)
    draws: Tensor = most_likely + spread * (normal_numbers @ lower_factor.mT)
    return draws


def _agree(lasers: FoundLasers, electrons: Tensor) -> None:
    """Raise ValueError unless the frame has as many channels as the found lasers."""
    if electrons.ndim != 3 or len(electrons) != lasers.strength.shape[-1]:
        raise ValueError(
            f"electrons {tuple(electrons.shape)} and found lasers of {lasers.strength.shape[-1]}"
            " channels do not fit: give the frame in which the lasers were found, (channel, y, x)"
        )
