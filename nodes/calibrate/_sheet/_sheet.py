"""The whole sheet of EMVA 1288: all quantities that frames tell, and for the others the reason."""

from __future__ import annotations

from dataclasses import dataclass

from neusee.nodes.calibrate._sheet._general_model import general_quantities
from neusee.nodes.calibrate._sheet._nonuniformity import Nonuniformity, nonuniformity
from neusee.nodes.calibrate._sheet._photon_transfer import PhotonTransfer, photon_transfer
from neusee.nodes.calibrate._sheet._quantity import Quantity
from neusee.nodes.calibrate._sheet._sensitivity import (
    Linearity,
    dark_current,
    gain,
    linearity,
    linearity_errors,
    sensitivity,
)
from neusee.nodes.values import Levels


@dataclass(frozen=True)
class EmvaSheet:
    """The sheet of EMVA 1288 of a camera at one operating point."""

    transfer: PhotonTransfer
    linearity: Linearity | None
    spatial: Nonuniformity
    quantities: tuple[Quantity, ...]  #: in the order of the standard

    def __getitem__(self, key: str) -> Quantity:
        return next(quantity for quantity in self.quantities if quantity.key == key)


def emva_sheet(levels: Levels, spatial: Nonuniformity | None = None, *, photons_told: bool = True) -> EmvaSheet:
    """Compute every quantity of the sheet of EMVA 1288 from light levels and from series of frames.

    ``levels`` are the pairs of the photon-transfer measurement, whose variance is the one in time; ``spatial`` has the
    averaged frames. With ``photons_told`` False the light is known up to a factor, and no quantity in photons follows.

    Shapes: levels (level,); frames (y, x).
    Units:  with each quantity.
    Raises: ValueError without a dark level or without two lit levels.
    Source: EMVA Standard 1288, release 4.0 Linear.
    """
    transfer, patterns = photon_transfer(levels), spatial or Nonuniformity(None, None)
    found = [
        *sensitivity(transfer, photons_told),
        *general_quantities(transfer, photons_told),
        *linearity_errors(transfer),
        *dark_current(transfer),
        *nonuniformity(patterns, gain(transfer).value),
    ]
    return EmvaSheet(transfer, linearity(transfer), patterns, tuple(found))
