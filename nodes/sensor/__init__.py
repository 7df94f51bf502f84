"""Sensor: conversion of photons to electrons, and of electrons to digital numbers."""

from neusee.nodes.sensor import _expected_ranges, _result_shapes  # noqa: F401  attach ranges and shape rules
from neusee.nodes.sensor._digitization import (
    Bits,
    clipping_number,
    crop,
    digitize,
    electrons_to_clip,
    full_well,
)
from neusee.nodes.sensor._exposure import add_photons, expose, level
from neusee.nodes.sensor._frame_file import FRAME_SUFFIXES, frame
from neusee.nodes.sensor._noise import dark_current, photon_noise, read_noise
from neusee.nodes.sensor._photon_transfer import photon_transfer
from neusee.nodes.sensor._saturation import (
    Limits,
    limits,
    line_saturation,
    photons_that_fill,
    refuse_without_room,
    refuse_without_steps,
    saturation,
)

__all__ = [
    "FRAME_SUFFIXES",
    "Bits",
    "Limits",
    "add_photons",
    "clipping_number",
    "crop",
    "dark_current",
    "digitize",
    "electrons_to_clip",
    "expose",
    "frame",
    "full_well",
    "level",
    "limits",
    "line_saturation",
    "photon_noise",
    "photon_transfer",
    "photons_that_fill",
    "read_noise",
    "refuse_without_room",
    "refuse_without_steps",
    "saturation",
]
