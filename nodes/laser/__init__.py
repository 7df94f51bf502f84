"""Laser beams in absolute units, and what they do: damage and dazzle of a sensor, exposure of an eye."""

from neusee.nodes.laser import _result_shapes  # noqa: F401  attaches the shape rules
from neusee.nodes.laser._air import Law, air_transmittance, size_exponent
from neusee.nodes.laser._beam import (
    Beam,
    Convention,
    axis_density,
    axis_irradiance,
    beam,
    beam_radius,
    curvature_radius,
    peak_on_sensor,
    power_through,
    sensor_density,
    share_through,
    underfilled,
)
from neusee.nodes.laser._bright_pixels import BrightPixels, bright_pixels
from neusee.nodes.laser._damage_distances import (
    airy_diameter,
    defocus_of_source,
    defocused_peak,
    distance_intervals,
    exposure_limit,
    sensor_gain,
)
from neusee.nodes.laser._damage_laws import (
    KINDS,
    Damage,
    DamageLaw,
    damage_at,
    damage_threshold,
    matching_laws,
    spot_reach,
)
from neusee.nodes.laser._damage_pixels import damaged_pixels
from neusee.nodes.laser._damage_published import PUBLISHED_DAMAGE
from neusee.nodes.laser._damage_spot import SpotDamage, damage
from neusee.nodes.laser._damage_table import read_damage_laws
from neusee.nodes.laser._dazzle_area import (
    counted_pixels,
    dazzle_exposure_limit,
    dazzle_strength,
    dazzled_pixels,
    peak_light,
    pixel_share,
    veil_limit,
)
from neusee.nodes.laser._dazzle_curve import DazzleCurve, dazzle_curve
from neusee.nodes.laser._dazzle_picture import Dazzle, dazzle
from neusee.nodes.laser._eye_limits import (
    eye_aperture,
    eye_limit,
    eye_mpe,
    eye_mpe_train,
    hazard_distance,
    nominal_ocular_hazard_distance,
)
from neusee.nodes.laser._light import light, pulses_within, wavefront
from neusee.nodes.laser._spot_on_sensor import frame_power, heated_diameter, spot_in_pixels

__all__ = [
    "KINDS",
    "PUBLISHED_DAMAGE",
    "Beam",
    "BrightPixels",
    "Convention",
    "Damage",
    "DamageLaw",
    "Dazzle",
    "DazzleCurve",
    "Law",
    "SpotDamage",
    "air_transmittance",
    "airy_diameter",
    "axis_density",
    "axis_irradiance",
    "beam",
    "beam_radius",
    "bright_pixels",
    "counted_pixels",
    "curvature_radius",
    "damage",
    "damage_at",
    "damage_threshold",
    "damaged_pixels",
    "dazzle",
    "dazzle_curve",
    "dazzle_exposure_limit",
    "dazzle_strength",
    "dazzled_pixels",
    "defocus_of_source",
    "defocused_peak",
    "distance_intervals",
    "exposure_limit",
    "eye_aperture",
    "eye_limit",
    "eye_mpe",
    "eye_mpe_train",
    "frame_power",
    "hazard_distance",
    "heated_diameter",
    "light",
    "matching_laws",
    "nominal_ocular_hazard_distance",
    "peak_light",
    "peak_on_sensor",
    "pixel_share",
    "power_through",
    "pulses_within",
    "read_damage_laws",
    "sensor_density",
    "sensor_gain",
    "share_through",
    "size_exponent",
    "spot_in_pixels",
    "spot_reach",
    "underfilled",
    "veil_limit",
    "wavefront",
]
