"""Calibration nodes, which estimate the constants of a sensor with uncertainties from frames of flat light."""

from neusee.nodes.calibrate import _result_shapes  # noqa: F401  attaches the shape rules
from neusee.nodes.calibrate._budget._camera_sources import (
    STATISTICS,
    camera_sources,
    source_freedom,
    variance_shares,
)
from neusee.nodes.calibrate._budget._laboratory import Laboratory, laboratory_contributions
from neusee.nodes.calibrate._budget._sheet_budget import MODEL, sheet_budgets
from neusee.nodes.calibrate._budget._traceability import Traceability
from neusee.nodes.calibrate._budget._uncertainty_budget import COVERAGE, NOT_INVOLVED, NOT_STATED, Budget, Contribution
from neusee.nodes.calibrate._emva_fit import LeastSquares, least_squares
from neusee.nodes.calibrate._frames._emva_descriptor import (
    descriptor,
    descriptor_frames,
    descriptor_release,
    descriptor_series,
    refuse_descriptor,
)
from neusee.nodes.calibrate._frames._frame_headers import FrameHeader, frame_divisor, frame_header, frame_means
from neusee.nodes.calibrate._frames._frame_statistics import levels, reduce
from neusee.nodes.calibrate._frames._hot_pixels import hot_pixels
from neusee.nodes.calibrate._frames._level_frames import frames
from neusee.nodes.calibrate._frames._moment_table import table
from neusee.nodes.calibrate._frames._saturation_signal import SaturationSignal, saturation_signal
from neusee.nodes.calibrate._frames._simulated_frames import expose
from neusee.nodes.calibrate._likelihood._camera_likelihood import camera, expected_levels
from neusee.nodes.calibrate._likelihood._likelihood_node import density
from neusee.nodes.calibrate._likelihood._linear_sensor import Likelihood
from neusee.nodes.calibrate._likelihood._sufficient_statistics import Sufficient, sufficient
from neusee.nodes.calibrate._prior._camera_prior import CAMERA_NAMES, CameraCoordinates, camera_prior
from neusee.nodes.calibrate._prior._first_guess import guess, guess_camera
from neusee.nodes.calibrate._prior._free_parameters import Prior, Ridge
from neusee.nodes.calibrate._prior._sensor_prior import NAMES, Coordinates, prior
from neusee.nodes.calibrate._scatter._point_source import Rings, point_source
from neusee.nodes.calibrate._scatter._scatter_likelihood import guess_scatter, stray_light
from neusee.nodes.calibrate._scatter._scatter_prior import SCATTER_NAMES, ScatterCoordinates, stray_prior
from neusee.nodes.calibrate._sheet._general_model import general_model
from neusee.nodes.calibrate._sheet._nonuniformity import Nonuniformity, SpatialSeries, spatial_series
from neusee.nodes.calibrate._sheet._patterns import (
    DefectHistogram,
    Profiles,
    Spectrogram,
    defects,
    profiles,
    spectrogram,
    without_trend,
)
from neusee.nodes.calibrate._sheet._quantity import Quantity
from neusee.nodes.calibrate._sheet._sheet import EmvaSheet, emva_sheet
from neusee.nodes.calibrate._validity._frame_pairs import FrameTest, Stack
from neusee.nodes.calibrate._validity._hidden_faults import CLEAN_PAIRS, Hidden, open_errors
from neusee.nodes.calibrate._validity._inspection import inspect_frames
from neusee.nodes.calibrate._validity._number_tests import coarse

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
