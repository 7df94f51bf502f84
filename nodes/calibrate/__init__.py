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
from neusee.nodes.calibrate._prior._free_parameters import Prior
from neusee.nodes.calibrate._prior._sensor_prior import NAMES, Coordinates, prior

__all__ = [
    "CAMERA_NAMES",
    "NAMES",
    "CameraCoordinates",
    "Coordinates",
    "LeastSquares",
    "Likelihood",
    "Prior",
    "Sufficient",
    "camera",
    "camera_prior",
    "density",
    "descriptor",
    "expose",
    "frames",
    "guess",
    "guess_camera",
    "least_squares",
    "levels",
    "prior",
    "reduce",
    "sufficient",
    "table",
]
