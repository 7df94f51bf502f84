"""Spectral responses of the colour channels of a sensor."""

from typing import Literal

from torch import Tensor

from neusee.nodes import Check, node
from neusee.nodes.spectra._spectral_tables import measured_camera, observer
from neusee.nodes.values import Bands

Camera = Literal["CIE 1931", "Nikon 5100", "Sigma SDMerill"]
_UNSEEN = 1e-3  #: of the largest sensitivity; a band that every channel sees less counts as unseen
#: nm, ends of the range in which some channel has more than `_UNSEEN`, with a margin; found without the table
_SEEN: dict[str, tuple[float, float]] = {
    "CIE 1931": (375.0, 720.0),
    "Nikon 5100": (405.0, 690.0),
    "Sigma SDMerill": (405.0, 675.0),
}


@node(rtol=1e-9)
def responses(bands: Bands, *, camera: Camera = "CIE 1931") -> Tensor:
    """Average the sensitivity of each colour channel over each band, for the CIE observer or a measured camera.

    Shapes: -> (3, band) float64.
    Units:  relative to the largest sensitivity of any channel at any wavelength; no response is negative.
    Error:  linear interpolation between the samples of the table (1, 5 and 10 nm); 0 beyond the table, whose ends are
            below 6e-3 of the peak (CIE 360-830 nm, Nikon 380-780 nm, Sigma 400-680 nm; except that the blue of Sigma
            is still 0.16 at 400 nm).
    Source: CIE 1931 2 degree observer; NPL measurements of the Nikon 5100 and Sigma SD Merrill in colour-science.
    """
    table = observer() if camera == "CIE 1931" else measured_camera(camera)
    return (table.over(bands) / table.values.max()).clamp_min(0).to(bands.centres.device)


@responses.preflight
def _(*, bands: Bands | None = None, camera: Camera = "CIE 1931") -> list[str]:
    if bands is None or bands.centres.is_meta:
        return []
    centres = bands.centres * 1e9
    low, high = _SEEN[camera]
    if low <= float(centres.min()) and float(centres.max()) <= high:
        return []  # most recipes: colour-science, whose import takes a second, is not needed
    most = responses(bands, camera=camera).amax(0)
    unseen = centres[most < _UNSEEN]
    if not len(unseen):
        return []
    which = f"{float(unseen.min()):.5g} nm" + (f" to {float(unseen.max()):.5g} nm" if len(unseen) > 1 else "")
    largest = float(most[most < _UNSEEN].max())
    return [
        f"no channel of {camera} sees {len(unseen)} of {len(centres)} bands, {which}: the largest relative response is "
        f"{largest:.2g}, below {_UNSEEN:g}, so their light is missing from the picture; choose {low:g} to {high:g} nm"
    ]


@responses.check
def _(result: Tensor, bands: Bands, *, camera: Camera = "CIE 1931") -> list[Check]:
    peaks = [float(bands.centres[int(row.argmax())]) * 1e9 for row in result]
    lit = bool((result.amax(1) > 0).all())
    text = f"{camera}: peaks at {peaks[0]:.4g}, {peaks[1]:.4g}, {peaks[2]:.4g} nm"
    return [Check(text, lit or len(bands.centres) < 10)]
