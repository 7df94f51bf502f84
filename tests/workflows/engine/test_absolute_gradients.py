"""A recipe in watts is a differentiable function of the power of its laser and of its distance."""

import torch

from neusee.workflows import as_function, load

SMALL = [
    "scene=siemens",
    "doe=flat",
    "scene.shape=[16,16]",
    "sensor.shape=[16,16]",
    "optics.window=[16,16]",
    "expect={}",
    "optics.samples=64",
    "optics.pitch=126.2 um",
    "optics.bands=3",
    "lasers.pointer.angle=[0 rad, 0 rad]",
]


def test_photons_follow_the_power_and_the_distance_of_a_laser():
    name = "laser_photons[plain,pointer]"
    free = ("light[pointer].power", "light[pointer].distance", "wavefront[pointer].distance")
    function = as_function(load("pointer", SMALL), *free, outputs=[name])

    def peak(power, distance):
        values = dict(zip(free, (power, distance, distance), strict=True))
        return function(values)[name].double().amax()

    power, distance = (
        torch.tensor(x, dtype=torch.float64, requires_grad=True) for x in (5e-3, 300.0)
    )
    found = peak(power, distance)
    by_power, by_distance = torch.autograd.grad(found, (power, distance))
    torch.testing.assert_close(by_power * 5e-3, found.detach(), rtol=1e-5, atol=0.0)
    step = 3.0
    higher, lower = (
        peak(power.detach(), torch.tensor(300.0 + x, dtype=torch.float64)) for x in (step, -step)
    )
    torch.testing.assert_close(by_distance, (higher - lower) / (2 * step), rtol=1e-3, atol=0.0)
