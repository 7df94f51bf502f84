"""Restoration nodes, which compute a colour picture of the scene from raw digital numbers."""

from neusee.nodes.restore import _result_shapes  # noqa: F401  attaches the shape rules
from neusee.nodes.restore._colour_matrix import colour_matrix
from neusee.nodes.restore._electrons_and_colour import clipped, colour, electrons
from neusee.nodes.restore._inverse._filter_facts import filter_facts
from neusee.nodes.restore._inverse._frame_blur import FrameBlur, frame_blur
from neusee.nodes.restore._inverse._nearby_glare import nearby_glare
from neusee.nodes.restore._inverse._posterior_spread import wiener_spread
from neusee.nodes.restore._inverse._richardson_lucy import richardson_lucy
from neusee.nodes.restore._inverse._wiener import wiener
from neusee.nodes.restore._inverse._wiener_problem import wiener_problem
from neusee.nodes.restore._lasers._find_lasers import find_lasers
from neusee.nodes.restore._lasers._found_glare import found_glare, found_nearby
from neusee.nodes.restore._networks._critic import critic_slopes, critics, skip_critic_draws
from neusee.nodes.restore._networks._fft_mamba import FFTMamba, fft_mamba
from neusee.nodes.restore._networks._informed import Informed, informed
from neusee.nodes.restore._networks._nafnet import NAFNet, nafnet
from neusee.nodes.restore._networks._network_export import export_network, require_exportable
from neusee.nodes.restore._networks._network_node import network
from neusee.nodes.restore._networks._own_network import OwnNetwork, own_network, try_network
from neusee.nodes.restore._networks._restorer import Restorer, parameter_groups, start_network
from neusee.nodes.restore._networks._unet import UNet, unet
from neusee.nodes.restore._networks._unrolled import Unrolled, unrolled
from neusee.nodes.restore._points import _result_shapes as _point_shapes  # noqa: F401  attaches the rules of shape and work
from neusee.nodes.restore._points._by_field import spread_by_field, wiener_by_field
from neusee.nodes.restore._points._measured_psf import measured_psf
from neusee.nodes.restore._sensor_likelihood import MeasuringSensor, measuring_sensor
from neusee.nodes.restore._shading._shading_node import shading
from neusee.nodes.restore._white_level import white_level

__all__ = [
    "FFTMamba",
    "FrameBlur",
    "Informed",
    "MeasuringSensor",
    "NAFNet",
    "OwnNetwork",
    "Restorer",
    "UNet",
    "Unrolled",
    "clipped",
    "colour",
    "colour_matrix",
    "critic_slopes",
    "critics",
    "electrons",
    "export_network",
    "fft_mamba",
    "filter_facts",
    "find_lasers",
    "found_glare",
    "found_nearby",
    "frame_blur",
    "informed",
    "measured_psf",
    "measuring_sensor",
    "nafnet",
    "nearby_glare",
    "network",
    "own_network",
    "parameter_groups",
    "require_exportable",
    "richardson_lucy",
    "shading",
    "skip_critic_draws",
    "spread_by_field",
    "start_network",
    "try_network",
    "unet",
    "unrolled",
    "white_level",
    "wiener",
    "wiener_by_field",
    "wiener_problem",
    "wiener_spread",
]
