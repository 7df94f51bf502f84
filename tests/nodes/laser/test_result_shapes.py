"""What is told of the results of damage and dazzle before a run is what the nodes then give."""

import pytest
import torch

from neusee.nodes.laser import (
    SpotDamage,
    bright_pixels,
    damage,
    damaged_pixels,
    dazzle,
    dazzle_curve,
)
from neusee.nodes.values import Bands, LaserLight, Psf

LINE = Bands(
    *(torch.tensor(x, dtype=torch.float64) for x in ([531e-9, 533e-9], [1e-9, 1e-9], [0.5, 0.5]))
)
SPOT = torch.rand(2, 8, 10)
RAW = torch.rand(3, 6, 7)
SENSOR = {"pixel_pitch": 2.9e-6, "exposure": 0.1, "dwell": 0.1}
DEAD = {"full_well": 1e3, "gain": 1.0}
PICTURE = {"shape": (6, 7), "full_well": 1e3, "quantum_efficiency": 0.5, "read_noise": 3.0}


def light(pulses):
    return LaserLight(*(torch.tensor(x, dtype=torch.float64) for x in (0, 0, 0, 0, 0, pulses, 1)))


def empty_pattern():
    return SpotDamage(
        *torch.zeros(8, 0, dtype=torch.float64), pattern=torch.zeros(8, 10, dtype=torch.uint8)
    )


@pytest.mark.parametrize(("node", "inputs", "params"), [
    (damage, (SPOT, LINE), SENSOR),
    (damage, (SPOT, LINE, light(1.0)), SENSOR | {"pulse_duration": 1e-8}),
    (damage, (SPOT, LINE, light(30.0)), SENSOR | {"pulse_duration": 1e-8}),
    (damaged_pixels, (RAW, [empty_pattern()]), DEAD),
    (damaged_pixels, (RAW.half(), [empty_pattern()]), DEAD),
    (dazzle, (RAW, [RAW]), PICTURE),
    (dazzle_curve, (Psf(SPOT, torch.ones(2, dtype=torch.float64)), LINE), {"strengths": (1.0, 2.0, 3.0)}),
    (dazzle_curve, (Psf(SPOT, torch.ones(2, dtype=torch.float64)), LINE), {}),
    (bright_pixels, (Psf(SPOT, torch.ones(2, dtype=torch.float64)), LINE), {"shape": (6, 20), "pixel_pitch": 2.9e-6}),
])  # fmt: skip
def test_the_told_shape_is_that_of_the_result(node, inputs, params):
    found, told = node(*inputs, **params), node.hooks.shape(*inputs, **params)
    both = [(found, told)] if isinstance(found, torch.Tensor) else zip(found, told, strict=True)
    for one, other in both:
        assert (one.shape, one.dtype) == (other.shape, other.dtype)
