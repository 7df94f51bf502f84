"""The node that finds lasers in one frame of a known camera, without any knowledge of the lasers."""

from __future__ import annotations

from typing import Annotated, Any

import torch
from pydantic import Field
from torch import Tensor

from neusee.nodes import Check, ParameterError, node
from neusee.nodes._half_precision import refuse_not_finite
from neusee.nodes.restore._inverse._wiener import refuse_other_pictures
from neusee.nodes.restore._lasers._beyond_scatter import without_scattered
from neusee.nodes.restore._lasers._candidates import line_templates
from neusee.nodes.restore._lasers._components import NANOMETRE, Camera, Laser
from neusee.nodes.restore._lasers._greedy_search import Found, Known, search
from neusee.nodes.restore._lasers._intervals import NORMAL, spreads
from neusee.nodes.restore._lasers._lamp_light import lamp_light
from neusee.nodes.restore._lasers._line_pattern import Lens, Sensor
from neusee.nodes.restore._lasers._lost_light import at_the_aperture
from neusee.nodes.units import Electrons, FocalLength, PixelPitch, PositiveLength, Ratio
from neusee.nodes.values import Bands, FoundLasers, Psf, Pupil

_WIDEST = (0.5, 10.0)  #: pixels and nm; half of a wider interval does not identify
_RIVAL = 5.0  #: log likelihood by which the fit exceeds one at another place or wavelength, to identify
_CHANNELS, _SMALLEST = (1, 3), 20
_COLOURS = (
    "lasers are found in a frame of 3 colour channels (3, y, x), or of one: give such a camera, or restore without a "
    "search, as `restore=wiener_blind` does"
)
_PRECISE = 256  #: pixels a side, up to which all is computed in float64


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
    """Find the lasers in one frame: their number, and direction, wavelength and strength of each, with intervals.

    The camera is known and the lasers are not. The pattern of a spectral line at every place and wavelength is compared
    with the frame, which a short filter has made nearly white: the scene counts as a random picture whose details
    are as strong as those around each pixel. The values of clipped pixels are not used; their number and places say
    where a fit begins. The best candidates are fitted with a free response of each channel (3 %), and with each of the
    ``widths`` (full width at half maximum) of a line. A laser must gain ``least`` of log likelihood, and at least
    ``margin`` of its gain beyond that of a lamp, a point source whose spectrum is smooth. The pattern of a lamp comes
    from the pupil too, for any place between pixels and over the whole frame; what ``psf`` has beyond it, such as stray
    light, is added. All lasers and lamps are fitted at once, and the search goes on in the rest. At the end a laser
    that does not gain ``least`` beside the likeliest speckle of stronger ones, which a dirty lens scatters, is left
    out. Intervals (90 %) come from the second derivatives and the scatter of the residual.

    The strength counts all light at the aperture, as in a recipe. Dirt, edges and defocus take part of it out of the
    pattern; the scatter of the residual tells how much that may be, by a law that was learnt from the dirt of
    `recipes/flare/dirty_windshield.yaml`. An even attenuation is not told from a weaker laser.

    In a frame of one channel nothing but the scale of a pattern tells its wavelength, and nothing but its sharpness
    tells a laser from a lamp.

    Shapes: electrons and clipped (channel, y, x) of 1 or 3 channels, psf.intensity (band, any, any), pupil,
            illuminant (band,), responses (channel, band), bands -> FoundLasers of ``most`` rows.
    Units:  electrons e-; direction rad; wavelength and widths m; strength e-; gain none.
    Error:  in frames of more than 256 pixels a side float32 rounds the fit. A light that is narrow but no laser, such
            as a light-emitting diode, may be taken for one. A laser that changes no pixel that is seen is not found.
            Two lasers within 2 pixels and 25 nm count as one. The responses are linear between the bands. The
            pattern of a lamp has at most 4 samples along a pixel and 4096 a side: where the lens draws finer fringes,
            a lamp between pixels is not exact.
            `recipes/guide/found_lasers.md` has measured rates and coverage.
    Raises: ValueError for other numbers of channels, frames of fewer than 20 pixels a side, inputs of different
            channels, bands or pixels, and values that are not finite.
    Gradient: none, because a search chooses between candidates.
    Source: matched filter as in Kay, Fundamentals of Statistical Signal Processing II, 1998, ch. 4; covariance of a
            model that may be wrong as in White, Econometrica 50, 1 (1982).
    """
    _refuse(electrons, clipped, psf, pupil, responses, bands)
    lens = Lens(focal_length, pixel_pitch, (electrons.shape[-2], electrons.shape[-1]), sensor)
    with torch.no_grad():
        precise = max(electrons.shape[-2:]) <= _PRECISE
        frame = electrons.detach().to(torch.float64 if precise else torch.float32)
        plain = Pupil(*(x.detach() for x in pupil))
        known = Known(
            frame,
            (~clipped).to(frame),
            Camera(plain, responses.detach().to(frame), bands, lens, torch.tensor(widths[0], dtype=torch.float64)),
            lamp_light(psf, plain, illuminant, responses, bands, lens, frame.dtype),
            line_templates(plain, responses, bands, lens),
            read_noise,
            widths,
        )
        found = without_scattered(search(known, most, lamps, least, margin), known, least)
        return _table(found, known, most)


@find_lasers.preflight
def _(*, responses: Any = None, **_: Any) -> list[str]:
    """Refuse a camera of another number of channels, where its responses are known before the run."""
    if responses is not None and len(responses) not in _CHANNELS:
        raise ParameterError("responses.camera", f"the camera has {_told(len(responses))}: {_COLOURS}")
    return []


@find_lasers.check
def _(
    result: FoundLasers, electrons: Tensor, *inputs: Any, focal_length: float, pixel_pitch: float, **_: Any
) -> list[Check]:
    count = int(result.number)
    if not count:
        return [Check("no laser found")]
    texts = []
    for n in range(count):
        y, x = (result.direction[n] * (focal_length / pixel_pitch)).tolist()
        low, high = (result.wavelength_interval[n] / NANOMETRE).tolist()
        known = "" if bool(result.identifiable[n].all()) else ", not identifiable"
        texts.append(
            f"{y:+.2f}, {x:+.2f} px, {float(result.wavelength[n]) / NANOMETRE:.1f} nm ({low:.1f} to {high:.1f}){known}"
        )
    alone = "" if len(electrons) > 1 else "; with one channel, wavelengths come from the scale of the patterns alone"
    return [Check(f"{count} laser{'s' * (count > 1)} found: {'; '.join(texts)}{alone}")]


def _refuse(electrons: Tensor, clipped: Tensor, psf: Psf, pupil: Pupil, responses: Tensor, bands: Bands) -> None:
    if electrons.ndim != 3 or len(electrons) not in _CHANNELS:
        raise ValueError(f"electrons {tuple(electrons.shape)}: {_COLOURS}")
    refuse_other_pictures(electrons, psf, responses, clipped, None)
    if min(electrons.shape[-2:]) < _SMALLEST:
        raise ValueError(
            f"a frame of {tuple(electrons.shape[-2:])} pixels is too small: give at least {_SMALLEST} a side"
        )
    if len(pupil.wavelengths) != len(bands.centres):
        raise ValueError(
            f"pupil of {len(pupil.wavelengths)} bands and {len(bands.centres)} bands differ: "
            "compute both from one `bands` step"
        )
    refuse_not_finite("no laser can be found", pupil=pupil.path.sum() + pupil.height.sum() + pupil.amplitude.sum())


def _told(channels: int) -> str:
    return f"{channels} channel{'s' * (channels != 1)}"


def _table(found: Found, known: Known, most: int) -> FoundLasers:
    """Return what was found in SI units, the laser of the largest gain first."""
    at = [n for n, part in enumerate(found.fit.parts) if isinstance(part, Laser)]
    spread = spreads(found.fit, known.seen) if at else []
    order = sorted(range(len(at)), key=lambda n: -found.choices[at[n]].gain)
    result = _empty(most, len(known.electrons))
    pixel = known.camera.lens.pixel_pitch / known.camera.lens.focal_length
    for row, n in enumerate(order):
        part = found.fit.parts[at[n]]
        assert isinstance(part, Laser)
        values = torch.cat([part.values[:3], part.channels()]).cpu().double()
        covariance = spread[n].covariance.cpu().double()
        half = NORMAL * covariance.diagonal().sqrt()
        ends = torch.stack([values - half, values + half], -1)
        result.direction[row], result.direction_interval[row] = pixel * values[:2], pixel * ends[:2]
        result.wavelength[row], result.wavelength_interval[row] = NANOMETRE * values[2], NANOMETRE * ends[2]
        result.fwhm[row] = part.fwhm
        result.straight[row], result.straight_spread[row] = values[3:], half[3:] / NORMAL
        light = (result.straight[row], result.straight_spread[row], spread[n].ideal.cpu().double())
        result.strength[row], result.strength_interval[row] = at_the_aperture(*light, known.seen.cpu())
        choice = found.choices[at[n]]
        alone = choice.rival > _RIVAL
        result.identifiable[row, 0] = alone and float(half[:2].max()) < _WIDEST[0]
        result.identifiable[row, 1] = alone and float(half[2]) < _WIDEST[1]
        result.gain[row] = torch.tensor([choice.gain, choice.margin])
        result.correlation[row] = covariance / torch.outer(half / NORMAL, half / NORMAL)
    return result._replace(number=torch.tensor(len(at)))


def _empty(most: int, channels: int) -> FoundLasers:
    shapes = ((2,), (), (), (channels,), (2, 2), (2,), (channels, 2))
    blank = [torch.zeros(most, *shape, dtype=torch.float64) for shape in shapes]
    certain = torch.zeros(most, 2, dtype=torch.bool)
    gain, spread = (torch.zeros(most, *shape, dtype=torch.float64) for shape in ((2,), (3 + channels, 3 + channels)))
    places, wave, width, size, ends, wave_ends, size_ends = blank
    none = torch.tensor(0)
    straight = (torch.zeros_like(size), torch.zeros_like(size))
    return FoundLasers(none, places, wave, width, size, ends, wave_ends, size_ends, certain, gain, spread, *straight)
