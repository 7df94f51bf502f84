"""Calibration nodes, which estimate the constants of a sensor with uncertainties from frames of
flat light.
"""

from neusee.nodes.calibrate import _result_shapes  # noqa: F401  attaches the shape rules
from neusee.nodes.calibrate._camera_likelihood import camera, expected_levels
from neusee.nodes.calibrate._emva_descriptor import (
    descriptor,
    descriptor_frames,
    descriptor_release,
    descriptor_series,
    refuse_descriptor,
)
from neusee.nodes.calibrate._emva_fit import LeastSquares, least_squares
from neusee.nodes.calibrate._emva_quantities import Quantity
from neusee.nodes.calibrate._emva_sheet import EmvaSheet, emva_sheet, general_model
from neusee.nodes.calibrate._frame_files import (
    FrameHeader,
    frame_divisor,
    frame_header,
    frame_means,
)
from neusee.nodes.calibrate._frame_pairs import CLEAN_PAIRS, FrameTest, Hidden, Stack, open_errors
from neusee.nodes.calibrate._frame_statistics import (
    SaturationSignal,
    levels,
    reduce,
    saturation_signal,
)
from neusee.nodes.calibrate._inspection import inspect_frames
from neusee.nodes.calibrate._laboratory import Laboratory, Traceability, laboratory_contributions
from neusee.nodes.calibrate._level_frames import expose, frames, hot_pixels
from neusee.nodes.calibrate._moment_table import table
from neusee.nodes.calibrate._nonuniformity import (
    DefectHistogram,
    Nonuniformity,
    Profiles,
    SpatialSeries,
    Spectrogram,
    defects,
    profiles,
    spatial_series,
    spectrogram,
    without_trend,
)
from neusee.nodes.calibrate._number_tests import coarse
from neusee.nodes.calibrate._priors import (
    CAMERA_NAMES,
    NAMES,
    CameraCoordinates,
    Coordinates,
    Prior,
    Ridge,
    camera_prior,
    guess,
    guess_camera,
    prior,
)
from neusee.nodes.calibrate._scatter_likelihood import (
    Rings,
    guess_scatter,
    point_source,
    stray_light,
)
from neusee.nodes.calibrate._scatter_prior import SCATTER_NAMES, ScatterCoordinates, stray_prior
from neusee.nodes.calibrate._sensor_likelihood import Likelihood, Sufficient, density, sufficient
from neusee.nodes.calibrate._sheet_budget import (
    MODEL,
    STATISTICS,
    camera_sources,
    sheet_budgets,
    source_freedom,
    variance_shares,
)
from neusee.nodes.calibrate._uncertainty_budget import (
    COVERAGE,
    NOT_INVOLVED,
    NOT_STATED,
    Budget,
    Contribution,
)

__all__ = [
    "CAMERA_NAMES",
    "CLEAN_PAIRS",
    "COVERAGE",
    "MODEL",
    "NAMES",
    "NOT_INVOLVED",
    "NOT_STATED",
    "SCATTER_NAMES",
    "STATISTICS",
    "Budget",
    "CameraCoordinates",
    "Contribution",
    "Coordinates",
    "DefectHistogram",
    "EmvaSheet",
    "FrameHeader",
    "FrameTest",
    "Hidden",
    "Laboratory",
    "LeastSquares",
    "Likelihood",
    "Nonuniformity",
    "Prior",
    "Profiles",
    "Quantity",
    "Ridge",
    "Rings",
    "SaturationSignal",
    "ScatterCoordinates",
    "SpatialSeries",
    "Spectrogram",
    "Stack",
    "Sufficient",
    "Traceability",
    "camera",
    "camera_prior",
    "camera_sources",
    "coarse",
    "defects",
    "density",
    "descriptor",
    "descriptor_frames",
    "descriptor_release",
    "descriptor_series",
    "emva_sheet",
    "expected_levels",
    "expose",
    "frame_divisor",
    "frame_header",
    "frame_means",
    "frames",
    "general_model",
    "guess",
    "guess_camera",
    "guess_scatter",
    "hot_pixels",
    "inspect_frames",
    "laboratory_contributions",
    "least_squares",
    "levels",
    "open_errors",
    "point_source",
    "prior",
    "profiles",
    "reduce",
    "refuse_descriptor",
    "saturation_signal",
    "sheet_budgets",
    "source_freedom",
    "spatial_series",
    "spectrogram",
    "stray_light",
    "stray_prior",
    "sufficient",
    "table",
    "variance_shares",
    "without_trend",
]
