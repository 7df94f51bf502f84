"""The search for lasers in a frame: candidates, their patterns, the likelihood and the fit.

The room belongs to `neusee.nodes.restore`, whose files import its files by their own names, so that
a cache key depends on no more than it must. A test imports the names below.
"""

from neusee.nodes.restore.lasers._candidates import line_templates
from neusee.nodes.restore.lasers._components import Camera, Lamp, Laser, lamp_light
from neusee.nodes.restore.lasers._find_lasers import (
    at_the_aperture,
    find_lasers,
    found_glare,
    found_nearby,
)
from neusee.nodes.restore.lasers._frame_likelihood import (
    NORMAL,
    censored,
    filled,
    filter_of,
    fitted,
    misfit_of,
    spreads,
)
from neusee.nodes.restore.lasers._greedy_search import (
    Choice,
    Found,
    Known,
    data_of,
    without_scattered,
)
from neusee.nodes.restore.lasers._line_pattern import (
    Lens,
    grid_patterns,
    index_at,
    line_moves,
    line_pattern,
)

__all__ = [
    "NORMAL",
    "Camera",
    "Choice",
    "Found",
    "Known",
    "Lamp",
    "Laser",
    "Lens",
    "at_the_aperture",
    "censored",
    "data_of",
    "filled",
    "filter_of",
    "find_lasers",
    "fitted",
    "found_glare",
    "found_nearby",
    "grid_patterns",
    "index_at",
    "lamp_light",
    "line_moves",
    "line_pattern",
    "line_templates",
    "misfit_of",
    "spreads",
    "without_scattered",
]
