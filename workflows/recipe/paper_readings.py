"""Contradictions in the paper of Peng et al., the interpretation that the recipes choose for each, and the reason.

Source: Peng et al., "Learning to See Through Flare", ICCV 2025 workshops. The group ``reading`` makes each choice.
"""

from __future__ import annotations

from collections.abc import Iterable
from typing import NamedTuple


class Reading(NamedTuple):
    """A contradiction in the paper: the recipe key, its coherent and printed value, and the reason for the choice."""

    path: str  #: of the recipe key
    number: str
    matter: str
    coherent: object
    as_printed: object
    reason: str

    @property
    def name(self) -> str:
        return self.path.partition(".")[2]


READINGS = (
    Reading(
        "reading.aperture",
        "C1",
        "an aperture of 11 mm on a pupil of 2160 x 3.74 um = 8.078 mm",
        "inscribed",
        "clipped",
        "the mask stops the lens, so the open disc is the 8.078 mm that the grid holds; "
        "`stretched` widens the pitch to 5.093 um instead",
    ),
    Reading(
        "reading.illuminant",
        "C5, C23",
        "the daylight curve is multiplied in twice",
        "once",
        "twice",
        "the lift gives reflectance, so light enters once",
    ),
    Reading(
        "reading.level",
        "C6",
        "each of 31 bands peaks at alpha_b times the saturation irradiance",
        "channel_sum",
        "per_band",
        "the well fills with the sum over bands; per band the scene would be 31 times over-exposed",
    ),
    Reading(
        "reading.photon_mean",
        "C12",
        "photons ~ N(c1 mu, c2 sigma)",
        "additive",
        "literal",
        "read to the letter the image vanishes at c1 = 0; as added noise, p + N(c1 p, c2 sqrt p), it does not",
    ),
    Reading(
        "reading.drawn_in",
        "C13",
        "noise is drawn before the quantum efficiency",
        "electrons",
        "photons",
        "detection is binomial, so electrons are Poisson; before it sigma is low by sqrt(0.56) = 0.748",
    ),
    Reading(
        "reading.offset_subtracted",
        "C15",
        "a read noise with a mean of 390 e-",
        True,
        False,
        "a mean is an offset, known from calibration and subtracted before restoration",
    ),
    Reading(
        "sensor.gain",
        "C17",
        "a gain of 0.37 without a unit",
        "0.37 e-/DN",
        "0.37 DN/e-",
        "25 500 e- / 0.37 = 68 919 DN fills 16 bit; 0.37 DN/e- never passes 9 435 DN",
    ),
    Reading(
        "reading.rounding",
        "C18",
        "floor(x + U(-1/2, 1/2))",
        "nearest",
        "dithered_floor",
        "the printed form is half a DN low and adds 1/6 DN^2 of variance",
    ),
    Reading(
        "reading.direction",
        "C20",
        "laser directions drawn with 3 sigma = 0.36 f / W",
        "width_over_focal_length",
        "focal_length_over_width",
        "0.36 W / f = 0.0194 rad keeps the spot on the sensor; as printed, 6.7 rad puts it 0.73 m away and is refused",
    ),
    Reading(
        "reading.line",
        "C22",
        "a 10 nm line sampled every 10 nm",
        "integrated",
        "point",
        "bins integrate the line; point samples miss or add up to 5.7 % of its energy",
    ),
)


def in_force(values: dict[str, object]) -> Iterable[tuple[Reading, str]]:
    """Yield each contradiction in the paper that a recipe resolves, with the recipe's choice.

    The choice is ``coherent``, ``as printed`` or the recipe's own value.
    """
    for row in READINGS:
        if row.path in values:
            value = values[row.path]
            known = {str(row.coherent): "coherent", str(row.as_printed): "as printed"}
            yield row, known.get(str(value), str(value))
