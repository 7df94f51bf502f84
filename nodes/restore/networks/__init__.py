"""The restoration networks: their parts, their files, and the selective scan.

The room belongs to `neusee.nodes.restore`, whose files import its files by their own names, so that
a cache key depends on no more than it must. A test imports the names below.
"""

from neusee.nodes.restore.networks._convolutional_networks import (
    Critic,
    NAFBlock,
    NAFNet,
    UNet,
    critic_slopes,
    critics,
    nafnet,
    skip_critic_draws,
    unet,
)
from neusee.nodes.restore.networks._fft_mamba import (
    Block,
    BothWays,
    FFTMamba,
    Frequency,
    Scan,
    Spatial,
    fft_mamba,
    radial_order,
)
from neusee.nodes.restore.networks._network_files import (
    export_network,
    exported_network,
    network,
    require_exportable,
)
from neusee.nodes.restore.networks._own_network import OwnNetwork, own_network, try_network
from neusee.nodes.restore.networks._restorer import (
    Restorer,
    parameter_groups,
    start_network,
    tiled,
)
from neusee.nodes.restore.networks._selective_scan import ScanPlan, reference, selective_scan
from neusee.nodes.restore.networks._wiener_networks import Informed, Unrolled, informed, unrolled

__all__ = [
    "Block",
    "BothWays",
    "Critic",
    "FFTMamba",
    "Frequency",
    "Informed",
    "NAFBlock",
    "NAFNet",
    "OwnNetwork",
    "Restorer",
    "Scan",
    "ScanPlan",
    "Spatial",
    "UNet",
    "Unrolled",
    "critic_slopes",
    "critics",
    "export_network",
    "exported_network",
    "fft_mamba",
    "informed",
    "nafnet",
    "network",
    "own_network",
    "parameter_groups",
    "radial_order",
    "reference",
    "require_exportable",
    "selective_scan",
    "skip_critic_draws",
    "start_network",
    "tiled",
    "try_network",
    "unet",
    "unrolled",
]
