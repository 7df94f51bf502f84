"""Calibrate: frames of flat illumination to the constants of a sensor, and to how well they are known."""

from neusee.nodes.calibrate._camera import camera
from neusee.nodes.calibrate._camera_prior import CAMERA_NAMES, CameraCoordinates, camera_prior
from neusee.nodes.calibrate._density import density
from neusee.nodes.calibrate._descriptor import descriptor
from neusee.nodes.calibrate._emva import LeastSquares, least_squares
from neusee.nodes.calibrate._frames import frames
from neusee.nodes.calibrate._free import Prior
from neusee.nodes.calibrate._guess import guess, guess_camera
from neusee.nodes.calibrate._law import Likelihood
from neusee.nodes.calibrate._prior import NAMES, Coordinates, prior
from neusee.nodes.calibrate._reduce import levels, reduce
from neusee.nodes.calibrate._simulated import expose
from neusee.nodes.calibrate._sufficient import Sufficient, sufficient
from neusee.nodes.calibrate._table import table

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
