"""Published thresholds of damage: brackets and single figures, each with what was read and where.

The sources were read as abstracts and summaries, not as full tables, so that none has a spread of devices and none has
a probability. A bracket such as "tens of kW/cm2" is taken as 10 to 100 kW/cm2 around its geometric middle. The range of
wavelengths around the laser of the experiment, and the range of durations, are ours.
"""

import math

from neusee.nodes.laser._damage_laws import DamageLaw, Kind

_SCHWARZ = (
    "Schwarz et al., Opt. Eng. 56, 034108 (2017), as summarised in Laser Focus World, July 2018: 532 nm, spot 25.7 um "
    "continuous, 28.2 um for pulses of 10 ns"
)
_TENS = f"{_SCHWARZ}; a bracket, tens of kW/cm2, read as 10 to 100 kW/cm2"
_FRONT_SIDE = (
    "Photonics 12, 790 (2025), abstract: front-side illuminated CMOS, 532 nm, nanosecond pulses; "
    "one figure without spread"
)
GREEN = (500e-9, 560e-9)  #: m, around 532 nm
_CONTINUOUS = (1e-3, 100.0)  #: s, long enough for a spot of 28 um to be in its steady state
NANOSECONDS = (1e-9, 100e-9)  #: s
_PER_CM2 = 1e4


def _single(device: str, damage: Kind, joules: float, spot: float | None, source: str) -> DamageLaw:
    """Return the law of a published fluence in J/cm2 of pulses of nanoseconds, without spread."""
    return DamageLaw(
        device=device,
        damage=damage,
        quantity="fluence",
        median=joules * _PER_CM2,
        factor=None,
        median_factor=None,
        wavelengths=GREEN,
        durations=NANOSECONDS,
        spot=spot,
        source=source,
    )


def _bracket(device: str) -> DamageLaw:
    """Return the law of continuous green light that damages at tens of kW/cm2."""
    return DamageLaw(
        device=device,
        damage="point",
        quantity="irradiance",
        median=math.sqrt(10e3 * 100e3) * _PER_CM2,
        factor=None,
        median_factor=None,
        wavelengths=GREEN,
        durations=_CONTINUOUS,
        spot=25.7e-6,
        source=_TENS,
        low=10e3 * _PER_CM2,
        high=100e3 * _PER_CM2,
    )


PUBLISHED_DAMAGE: tuple[DamageLaw, ...] = (
    _bracket("CMOS"),
    _bracket("CCD"),
    _single("CMOS", "point", 0.1, 28.2e-6, f"{_SCHWARZ}; first traces"),
    _single("CCD", "point", 0.1, 28.2e-6, f"{_SCHWARZ}; first traces, sometimes drawn out along columns"),
    _single("CMOS", "destruction", 100.0, 28.2e-6, f"{_SCHWARZ}; lasting destruction"),
    _single("CMOS", "point", 78.9e-3, None, f"{_FRONT_SIDE}; white bright spot"),
    _single("CMOS", "cross", 241.9e-3, None, f"{_FRONT_SIDE}; horizontal and vertical black lines"),
    _single("CMOS", "frame", 2005.4e-3, None, f"{_FRONT_SIDE}; no valid picture any more"),
)
