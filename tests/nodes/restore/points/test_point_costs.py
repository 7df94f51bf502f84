"""What is told of a measured PSF before a run, and what the run then gives."""

import numpy as np
import pytest
import torch

from neusee.nodes.restore import measured_psf, spread_by_field, wiener_by_field
from neusee.nodes.values import MeasuredPsf
from neusee.workflows.engine.cost_model import measured_size, shipped, size_of
from neusee.workflows.graph.step_shapes import form_of, without_values
from tests.nodes.restore.points.independent_camera import CAMERA, READ, points

SIDE = 42


def told(value):
    """Shape and type of each tensor."""
    return [(tuple(x.shape), x.dtype) for x in (value if isinstance(value, tuple) else [value])]


@pytest.fixture(scope="module")
def settings(tmp_path_factory):
    """Two frames of four points, and a dark one, as the node takes them."""
    folder, rng = tmp_path_factory.mktemp("points"), np.random.default_rng(0)
    places = [(y + rng.uniform(-0.5, 0.5), x) for y in (10, 31) for x in (10, 31)]
    for number in range(2):
        np.save(folder / f"p{number}.npy", points(rng, (SIDE, SIDE), places, [8e4] * 4))
    np.save(folder / "dark.npy", points(rng, (SIDE, SIDE), [], []))
    files = tuple(sorted(folder.iterdir()))
    return {
        "files": files,
        "window": (7, 7),
        "zones": (2, 2),
        "draws": 4,
        "shape": (SIDE, SIDE),
        **CAMERA,
    }


def test_shapes_and_sizes_before_a_run_are_those_of_the_run(settings):
    responses, seed = torch.ones(3, 5), torch.Generator().manual_seed
    found = measured_psf(responses, **settings, rng=seed(0))
    electrons = torch.tensor(np.random.default_rng(1).poisson(2000.0, (3, SIDE, SIDE))).float()
    clipped, glare = (
        torch.zeros(3, SIDE, SIDE, dtype=torch.bool),
        [torch.rand(3, SIDE, SIDE, generator=seed(1))],
    )
    restored = wiener_by_field(electrons, found, clipped, glare, read_noise=READ)
    spread = spread_by_field(
        electrons, found, clipped, torch.eye(3), glare, draws=2, read_noise=READ, rng=seed(0)
    )
    steps = (
        (measured_psf, [responses], settings, found),
        (wiener_by_field, [electrons, found, clipped, glare], {"read_noise": READ}, restored),
        (
            spread_by_field,
            [electrons, found, clipped, torch.eye(3), glare],
            {"draws": 2, "read_noise": READ},
            spread,
        ),
    )
    for node, inputs, params, value in steps:
        forms = [
            [without_values(y) for y in x] if isinstance(x, list) else without_values(x)
            for x in inputs
        ]
        form = form_of(node, forms, params)
        assert told(form) == told(value), node.path
        size = size_of(node, forms, params, form)
        assert measured_size(node, inputs, params, value) == list(size[:4])
        law = shipped()[node.path]
        assert law.peak(size) > size.result
        assert 0 < law.time(size) < 60


def test_larger_problems_take_longer_and_need_more(settings):
    def law_of(**change):
        given = {**settings, **change}
        return size_of(
            measured_psf,
            [torch.ones(3, 5)],
            given,
            form_of(measured_psf, [torch.ones(3, 5)], given),
        )

    usual, other = law_of(), law_of(draws=24)
    assert other.operations > 2.5 * usual.operations
    wide = law_of(window=(13, 13))
    assert wide.work > 1.5 * usual.work
    assert law_of(zones=(1, 1)).operations < 0.3 * usual.operations


def test_many_zones_cost_the_filter_more_operations_on_smaller_parts():
    frame, one = torch.empty(3, 2000, 2000, device="meta"), torch.ones(3)

    def of(zones, nearby=None):
        kernels = torch.empty(zones, zones, 3, 9, 9, device="meta")
        measured = MeasuredPsf(kernels, kernels, kernels[None], *[one] * 5)
        return wiener_by_field.hooks.work(frame, frame, measured, None, None, nearby)

    whole, parts = of(1), of(3)
    assert parts[1] > 1.5 * whole[1]
    assert parts[0] < 0.6 * whole[0]
    assert of(1, [torch.empty(50, 3, 2000, 2000, device="meta")])[0] > whole[0] + 50 * frame.numel()
