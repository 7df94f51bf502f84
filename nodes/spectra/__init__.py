"""Nodes for spectra: spectral bands, illuminants, channel responses, and estimates of spectra
from RGB.
"""

from neusee.nodes.spectra import _result_shapes  # noqa: F401  attaches the shape rules
from neusee.nodes.spectra._bands import (
    bands,
    filters,
    laser_table,
    line,
    line_table,
    mean_wavelength,
)
from neusee.nodes.spectra._channel_responses import camera_curves, responses, rows
from neusee.nodes.spectra._cie_tables import Table, light, observer, paints, to_srgb
from neusee.nodes.spectra._illuminant import illuminant, illuminate, light_curve
from neusee.nodes.spectra._lift import (
    MSTPlusPlus,
    lift_lmmse,
    lift_lmmse_mixture,
    lift_mallett,
    lift_mallett_mixture,
    lift_matrix,
    lift_mst_plus_plus,
    lift_pictures,
    need_mst_plus_plus_bands,
    start_mst_plus_plus,
)
from neusee.nodes.spectra._low_rank_cube import compress
from neusee.nodes.spectra._plausible_spectra import metamers, reflectances
from neusee.nodes.spectra._synthetic_pictures import grain, leaves, render

__all__ = [
    "MSTPlusPlus",
    "Table",
    "bands",
    "camera_curves",
    "compress",
    "filters",
    "grain",
    "illuminant",
    "illuminate",
    "laser_table",
    "leaves",
    "lift_lmmse",
    "lift_lmmse_mixture",
    "lift_mallett",
    "lift_mallett_mixture",
    "lift_matrix",
    "lift_mst_plus_plus",
    "lift_pictures",
    "light",
    "light_curve",
    "line",
    "line_table",
    "mean_wavelength",
    "metamers",
    "need_mst_plus_plus_bands",
    "observer",
    "paints",
    "reflectances",
    "render",
    "responses",
    "rows",
    "start_mst_plus_plus",
    "to_srgb",
]
