"""What a node declares as unused changes no bit of its result and no word of its checks."""

from __future__ import annotations

import pytest
import torch

from neusee.nodes import laser, optics, registered_nodes, sensor, spectra
from neusee.nodes.units import ElectronsPerSecond

BANDS = spectra.bands(start=500e-9, stop=600e-9, count=3)
STOP = optics.stop(samples=16, pitch=1e-4, diameter=1.6e-3)
#: by node: inputs, parameters, and other values of all that are unused beside these
CASES = {
    spectra.responses: (
        (BANDS,),
        {"camera": "CIE 1931", "quantum_efficiency": 0.5},
        {"quantum_efficiency": None},
    ),
    laser.light: (
        (spectra.line(wavelength=532e-9, fwhm=1e-9), STOP),
        {"strength": 3.0, "focal_length": 0.1, "exposure": 0.1},
        {"focal_length": 0.2, "exposure": 0.3, "lens_transmittance": 0.5},
    ),
    optics.white_irradiance: (
        (BANDS, STOP),
        {"focal_length": 0.1},
        {"focal_length": 0.2, "lens_transmittance": 0.5, "kind": "A", "temperature": 3000.0},
    ),
    optics.direction: (
        (),
        {"angle": (1e-3, 2e-3), "focal_length": 0.1, "pixel_pitch": 3e-6, "shape": (64, 64)},
        {"shape": (8, 8), "share": 0.1, "rule": "focal_length_over_width", "rng": 2},
    ),
    sensor.photon_transfer: (
        (),
        {
            "full_well": 1e4,
            "quantum_efficiency": 0.5,
            "gain": 1.0,
            "offset": 10.0,
            "read_noise": 2.0,
            "dark": 3.0,
            "exposure": 0.1,
        },
        {"exposure": 0.7},
    ),
}
#: parameters beside which none is unused
USED = {
    spectra.responses: None,
    laser.light: {"strength": None},
    optics.white_irradiance: {"luminance": 100.0},
    optics.direction: {"angle": None},
    sensor.photon_transfer: {"dark": ElectronsPerSecond(3.0)},
}


def called(node, inputs, params):
    seed = params.get("rng", 1)
    drawn = {"rng": torch.Generator().manual_seed(seed)} if node.random else {}
    result = node(*inputs, **{**params, **drawn})
    return result, node.hooks.check(result, *inputs, **validated(node, params))


def validated(node, params):
    given = {name: value for name, value in params.items() if name != "rng"}
    return dict(node.params.model_construct(**given))


def test_every_node_that_declares_unused_parameters_has_a_case():
    ours = {n for n in registered_nodes() if n.fn.__module__.startswith("neusee.nodes")}
    assert {node for node in ours if node.hooks.unused} == CASES.keys() == USED.keys()


@pytest.mark.parametrize("node", CASES, ids=lambda node: node.path)
def test_an_unused_parameter_changes_nothing(node):
    inputs, params, others = CASES[node]
    unused = node.unused_parameters(validated(node, params))
    assert others.keys() <= unused
    result, checks = called(node, inputs, params)
    again, checks_again = called(node, inputs, {**params, **others})
    values = result if isinstance(result, tuple) else (result,)
    values_again = again if isinstance(again, tuple) else (again,)
    assert all(torch.equal(a, b) for a, b in zip(values, values_again, strict=True))
    assert checks == checks_again


@pytest.mark.parametrize("node", USED, ids=lambda node: node.path)
def test_beside_other_values_it_counts(node, tmp_path):
    changes = USED[node] or {"camera": tmp_path / "camera.csv"}
    assert not node.unused_parameters(validated(node, {**CASES[node][1], **changes}))
