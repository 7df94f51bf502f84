"""A node that declares its bands gives each band the same bits, whatever bands stand beside it."""

from typing import get_args

import pytest
import torch
from torch import Tensor

from neusee.nodes import node
from neusee.nodes.optics.transform import Axis, cheapest
from neusee.nodes.values import BAND_FIELDS, Psf, Pupil
from tests.nodes.test_contract import NODES

LENS = {"focal_length": 0.11, "pixel_pitch": 2.9e-6}
DIAMETER = 8e-3
SCATTER = {**LENS, "diameter": DIAMETER, "surfaces": {"lens": {"b0": 9.0, "l": 3e-3, "s": -1.7}}}


def rand(*shape, dtype=torch.float32):
    return torch.rand(*shape, dtype=dtype, generator=torch.Generator().manual_seed(sum(shape)))


def pupil(n, bands, height=1e-6, path=0.0):
    x = (torch.arange(n) - (n - 1) / 2) / (n / 2)
    disc = ((x[:, None] ** 2 + x**2) <= 1).float()
    waves = torch.linspace(400e-9, 700e-9, bands, dtype=torch.float64)
    pitch = torch.tensor(DIAMETER / n, dtype=torch.float64)
    return Pupil(
        disc, disc * rand(n, n), rand(n, n) * height, disc * path, 0.46 + waves * 1e4, waves, pitch
    )


def as_psf(bands, *shape, dtype=torch.float32):
    peak, cut, side = (rand(bands, dtype=torch.float64) for _ in range(3))
    return Psf(rand(bands, *shape, dtype=dtype), peak, cut, side)


CASES = {
    "spectra.illuminate": [
        ((rand(5, 17, 33), rand(5, dtype=torch.float64)), {}),
        ((rand(2, 7, 9, 5), rand(7, dtype=torch.float64)), {"times": "twice"}),
        ((rand(6, 300, 301, dtype=torch.float64), rand(6, dtype=torch.float64)), {}),
        ((rand(31, 128, 128), rand(31, dtype=torch.float64)), {}),
    ],
    "optics.psf": [
        ((pupil(33, 4),), {"shape": (9, 15)}),
        ((pupil(64, 7),), {"shape": (31, 64), "pixel": "zoh", "angle": (1e-4, -2e-4)}),
        (
            (pupil(201, 5, path=3e-7), torch.tensor([2e-4, 1e-4], dtype=torch.float64)),
            {"shape": (65, 65)},
        ),
        ((pupil(40, 4),), {"shape": (12, 12), "sensor": "integrated"}),
        ((pupil(128, 4),), {"shape": (64, 64), "precision": "double"}),
        ((pupil(64, 4),), {"shape": (500, 500), "pixel": "zoh"}),
        ((pupil(400, 4),), {"shape": (600, 600)}),
        ((pupil(512, 31),), {"shape": (256, 256)}),
        ((pupil(301, 4, height=0.0),), {"shape": (33, 47)}),  # few turns of phase: another path
        ((pupil(1080, 4, height=2e-5),), {"shape": (1000, 999)}),
    ],
    "flare.stray_light": [
        ((as_psf(5, 21, 33), pupil(33, 5)), SCATTER),
        (
            (as_psf(7, 40, 41), pupil(40, 7), torch.tensor([2e-4, 1e-4], dtype=torch.float64)),
            SCATTER,
        ),
        ((as_psf(4, 64, 64), pupil(64, 4)), {**SCATTER, "scaling": "roughness"}),
    ],
    "metrics.bsr": [
        ((as_psf(5, 9, 9), rand(5, 17, 33)), {}),
        ((as_psf(4, 64, 64), rand(2, 4, 21, 20)), {}),
        ((as_psf(7, 31, 30, dtype=torch.float64), rand(7, 100, 75)), {}),
        ((as_psf(31, 128, 128), rand(31, 128, 128)), {}),
        ((as_psf(31, 65, 64),), {}),
    ],
    "optics.image": [
        ((rand(5, 17, 33), as_psf(5, 9, 9)), {}),
        ((rand(5, 17, 33), as_psf(5, 9, 10)), {"border": "reflect"}),
        ((rand(2, 4, 21, 20), as_psf(4, 64, 64)), {}),
        ((rand(4, 100, 75, dtype=torch.float64), as_psf(4, 31, 31, dtype=torch.float64)), {}),
        ((rand(31, 128, 128), as_psf(31, 128, 128)), {"border": "reflect"}),
        ((rand(4, 500, 501), as_psf(4, 257, 255)), {}),
    ],
}
EACH = [(path, at) for path, cases in CASES.items() for at in range(len(cases))]
BANDWISE = {n.path: n for n in NODES if n.bands}


def take(value, axis, which):
    if isinstance(value, Tensor):
        return value.index_select(axis, torch.tensor(which))
    fields = BAND_FIELDS[type(value)]
    return value._replace(**{name: take(getattr(value, name), axis, which) for name in fields})


def tensors(value):
    return [value] if isinstance(value, Tensor) else list(value)


# Two threads wait for each other on a core that they share with other tests: seconds of a few
# milliseconds' work.
@pytest.fixture(params=[1, pytest.param(2, marks=pytest.mark.slow)])
def threads(request):
    before = torch.get_num_threads()
    torch.set_num_threads(request.param)
    yield request.param
    torch.set_num_threads(before)


def test_every_node_with_bands_is_tried():
    assert BANDWISE.keys() == CASES.keys()


def test_the_psf_is_tried_with_every_method():
    found = set()
    for (pupil, *_), params in CASES["optics.psf"]:
        n, (y, x) = len(pupil.height), params["shape"]
        for wave in pupil.wavelengths.tolist():
            alpha = DIAMETER / n * LENS["pixel_pitch"] / (wave * LENS["focal_length"])
            found.add(cheapest(Axis(n, y, alpha), Axis(n, x, alpha), torch.device("cpu")))
    assert found == {"direct", "folded", "bluestein", "kaiser_bessel"}


@pytest.mark.parametrize(("path", "at"), EACH)
def test_a_band_has_the_same_bits_alone_and_among_others(path, at, threads):
    bandwise, (inputs, params) = BANDWISE[path], CASES[path][at]
    axes = [bandwise.bands.get(name) for name in bandwise.inputs]
    params = params | (LENS if path == "optics.psf" else {})
    whole = bandwise(*inputs, **params)
    count = tensors(whole)[0].shape[bandwise.bands["return"]]
    subsets = [[i] for i in range(min(count, 4))] + [
        [count - 1],
        [1, 3],
        list(range(1, count)),
        list(range(count))[::-1],
    ]
    for which in subsets:
        part = [x if a is None else take(x, a, which) for x, a in zip(inputs, axes, strict=False)]
        found = bandwise(*part, **params)
        for one, all_of_them in zip(tensors(found), tensors(whole), strict=True):
            expected = all_of_them.index_select(bandwise.bands["return"], torch.tensor(which))
            assert torch.equal(one, expected), which


@pytest.mark.parametrize("path", CASES)
def test_every_tensor_of_the_result_has_bands(path):
    kind = BANDWISE[path].hints["return"]
    kinds = get_args(kind) or (kind,)  # of a union, a tensor is what bands give
    assert Tensor in kinds or BAND_FIELDS[kind] == kind._fields


def test_bands_that_no_one_has_are_refused():
    def half(light: Tensor) -> Tensor:
        return light / 2

    with pytest.raises(ValueError, match="'return'"):
        node(bands={"light": 0})(half)
    with pytest.raises(ValueError, match="dark"):
        node(bands={"dark": 0, "return": 0})(half)


def test_a_random_node_has_no_bands():
    def noise(light: Tensor, *, rng: torch.Generator) -> Tensor:
        return light + torch.rand(1, generator=rng)

    with pytest.raises(ValueError, match="random"):
        node(bands={"light": 0, "return": 0})(noise)


@pytest.mark.parametrize("path", ["optics.laser_irradiance", "flare.ghosts", "spectra.illuminant"])
def test_what_sums_over_the_bands_declares_none(path):
    assert next(n for n in NODES if n.path == path).bands is None
