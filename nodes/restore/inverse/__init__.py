"""The inverse problem of a frame: blur, prior, glare, and the most likely picture before the blur.

The room belongs to `neusee.nodes.restore`, whose files import its files by their own names, so that
a cache key depends on no more than it must. A test imports the names below.
"""

from neusee.nodes.restore.inverse._conjugate_gradients import Lowest, descend
from neusee.nodes.restore.inverse._glare import (
    RADII,
    Light,
    nearby_glare,
    strengths,
    visible,
    with_smooth,
)
from neusee.nodes.restore.inverse._hidden_pixels import halved, most_likely, pulled
from neusee.nodes.restore.inverse._masked_blur import (
    Blurred,
    FrameBlur,
    edge,
    effective_psf,
    frame_blur,
    grey_white,
    halvings,
    torus,
    variance,
)
from neusee.nodes.restore.inverse._posterior_spread import frame_deviation, wiener_spread
from neusee.nodes.restore.inverse._richardson_lucy import richardson_lucy
from neusee.nodes.restore.inverse._wiener import (
    MAPS_OF_CHANNEL,
    LaserLight,
    Settings,
    View,
    filter_facts,
    known_and_light,
    posed,
    wiener,
    wiener_problem,
)
from neusee.nodes.restore.inverse._wiener_prior import (
    BLOTCH_PIXELS,
    Told,
    about_mean,
    drawn_blotches,
    expected_variance,
    fall,
    fitted_law,
    level_and_variance,
    shared_level,
)

__all__ = [
    "BLOTCH_PIXELS",
    "MAPS_OF_CHANNEL",
    "RADII",
    "Blurred",
    "FrameBlur",
    "LaserLight",
    "Light",
    "Lowest",
    "Settings",
    "Told",
    "View",
    "about_mean",
    "descend",
    "drawn_blotches",
    "edge",
    "effective_psf",
    "expected_variance",
    "fall",
    "filter_facts",
    "fitted_law",
    "frame_blur",
    "frame_deviation",
    "grey_white",
    "halved",
    "halvings",
    "known_and_light",
    "level_and_variance",
    "most_likely",
    "nearby_glare",
    "posed",
    "pulled",
    "richardson_lucy",
    "shared_level",
    "strengths",
    "torus",
    "variance",
    "visible",
    "wiener",
    "wiener_problem",
    "wiener_spread",
    "with_smooth",
]
