"""Spectra: bands, lights, channels, and lifts from three colours to many."""

from neusee.nodes.spectra._bands import bands, filters, line
from neusee.nodes.spectra._compress import compress
from neusee.nodes.spectra._leaves import leaves
from neusee.nodes.spectra._lift import lift_lmmse, lift_lmmse_mixture, lift_mallett, lift_mallett_mixture
from neusee.nodes.spectra._lift_mst import lift_mst_plus_plus
from neusee.nodes.spectra._light import illuminant, illuminate
from neusee.nodes.spectra._metamers import metamers
from neusee.nodes.spectra._reflectances import reflectances
from neusee.nodes.spectra._render import grain, render
from neusee.nodes.spectra._responses import responses
from neusee.nodes.spectra._rows import rows

__all__ = [
    "bands",
    "compress",
    "filters",
    "grain",
    "illuminant",
    "illuminate",
    "leaves",
    "lift_lmmse",
    "lift_lmmse_mixture",
    "lift_mallett",
    "lift_mallett_mixture",
    "lift_mst_plus_plus",
    "line",
    "metamers",
    "reflectances",
    "render",
    "responses",
    "rows",
]
