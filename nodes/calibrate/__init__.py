"""Calibration nodes, which estimate the constants of a sensor with uncertainties from frames of flat light."""

from neusee.nodes.calibrate import _result_shapes  # noqa: F401  attaches the shape rules
from neusee.nodes.calibrate._emva_fit import LeastSquares, least_squares
from neusee.nodes.calibrate._frames._emva_descriptor import descriptor
from neusee.nodes.calibrate._frames._frame_statistics import levels, reduce
from neusee.nodes.calibrate._frames._level_frames import frames
from neusee.nodes.calibrate._frames._moment_table import table
from neusee.nodes.calibrate._frames._simulated_frames import expose
from neusee.nodes.calibrate._likelihood._camera_likelihood import camera
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

__all__ = [
    "CAMERA_NAMES",
    "NAMES",
    "SCATTER_NAMES",
    "CameraCoordinates",
    "Coordinates",
    "LeastSquares",
    "Likelihood",
    "Prior",
    "Ridge",
    "Rings",
    "ScatterCoordinates",
    "Sufficient",
    "camera",
    "camera_prior",
    "density",
    "descriptor",
    "expose",
    "frames",
    "guess",
    "guess_camera",
    "guess_scatter",
    "least_squares",
    "levels",
    "point_source",
    "prior",
    "reduce",
    "stray_light",
    "stray_prior",
    "sufficient",
    "table",
]
