"""Restoration nodes, which compute a colour picture of the scene from raw digital numbers."""

from neusee.nodes.restore import _result_shapes  # noqa: F401  attaches the shape rules
from neusee.nodes.restore._electrons_and_colour import (
    clipped,
    colour,
    colour_matrix,
    electrons,
    white_level,
)
from neusee.nodes.restore._inverse._glare import nearby_glare
from neusee.nodes.restore._inverse._masked_blur import FrameBlur, frame_blur
from neusee.nodes.restore._inverse._posterior_spread import wiener_spread
from neusee.nodes.restore._inverse._richardson_lucy import richardson_lucy
from neusee.nodes.restore._inverse._wiener import filter_facts, wiener, wiener_problem
from neusee.nodes.restore._lasers._find_lasers import find_lasers, found_glare, found_nearby
from neusee.nodes.restore._measured_psf import measured_psf
from neusee.nodes.restore._networks._convolutional_networks import (
    NAFNet,
    UNet,
    critic_slopes,
    critics,
    nafnet,
    skip_critic_draws,
    unet,
)
from neusee.nodes.restore._networks._fft_mamba import FFTMamba, fft_mamba
from neusee.nodes.restore._networks._network_files import (
    export_network,
    network,
    require_exportable,
)
from neusee.nodes.restore._networks._own_network import OwnNetwork, own_network, try_network
from neusee.nodes.restore._networks._restorer import Restorer, parameter_groups, start_network
from neusee.nodes.restore._networks._wiener_networks import Informed, Unrolled, informed, unrolled
from neusee.nodes.restore._sensor_likelihood import MeasuringSensor, measuring_sensor
from neusee.nodes.restore._wiener_by_field import spread_by_field, wiener_by_field

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
