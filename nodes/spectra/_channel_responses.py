"""Spectral responses of the colour channels of a sensor."""

from typing import Literal

from torch import Tensor

from neusee.nodes import Check, node
from neusee.nodes.spectra._spectral_tables import measured_camera, observer
from neusee.nodes.values import Bands

Camera = Literal["CIE 1931", "Nikon 5100", "Sigma SDMerill"]


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


@responses.check
def _(result: Tensor, bands: Bands, *, camera: Camera = "CIE 1931") -> list[Check]:
    peaks = [float(bands.centres[int(row.argmax())]) * 1e9 for row in result]
    lit = bool((result.amax(1) > 0).all())
    text = f"{camera}: peaks at {peaks[0]:.4g}, {peaks[1]:.4g}, {peaks[2]:.4g} nm"
    return [Check(text, lit or len(bands.centres) < 10)]
