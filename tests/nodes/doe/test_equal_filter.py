"""The grey filter that weakens a laser as much as a mask: its light against that of a filter in
the pupil.
"""

import pytest
import torch

from neusee.nodes.doe import equal_filter
from neusee.nodes.values import Bands
from neusee.workflows.engine.runner import run
from neusee.workflows.recipe.loading import load
from neusee.workflows.store.result_store import Store

CENTRES = torch.tensor([450e-9, 550e-9, 650e-9], dtype=torch.float64)
BANDS = Bands(CENTRES, torch.full((3,), 1e-7).double(), torch.ones(3).double())
RATIOS = torch.tensor([0.002, 0.05, 0.3], dtype=torch.float64)
SMALL = [
    "scene.shape=[64, 64]",
    "sensor.shape=[48, 48]",
    "optics.samples=64",
    "optics.pitch=126 um",
    "optics.window=[32, 32]",
    "optics.bands=4",
]


def line(nm):
    return Bands(*(torch.tensor([x], dtype=torch.float64) for x in (nm * 1e-9, 1e-9, 1.0)))


@pytest.mark.parametrize(
    ("lasers", "share"),
    [([532], 0.05), ([405, 532], 0.05), ([405], 0.002), ([690, 405], 0.3), ([], 0.3)],
)
def test_the_least_weakened_laser_sets_the_transmittance(lasers, share):
    light = torch.rand(3, 4, 5, generator=torch.Generator().manual_seed(1))
    found = equal_filter(light, RATIOS, BANDS, [line(nm) for nm in lasers])
    torch.testing.assert_close(found, share * light)
    (check,) = equal_filter.hooks.check(found, light, RATIOS, BANDS, [line(nm) for nm in lasers])
    assert f"passes {share:g} of the light" in check.text


def test_a_mask_that_raises_the_peak_has_a_rival_without_filter():
    light = torch.ones(2, 2)
    assert equal_filter(light, 4 * RATIOS, BANDS).equal(light)


def test_ratios_of_other_bands_are_refused():
    with pytest.raises(
        ValueError, match="2 ratios and 3 bands: compute the ratios from the same `bands`"
    ):
        equal_filter(torch.ones(2, 2), RATIOS[:2], BANDS)


@pytest.mark.slow
def test_the_rival_of_a_mask_has_the_light_and_the_colours_of_a_filter_in_the_pupil(tmp_path):
    """The same camera with the filter in its pupil computes point-spread functions and images of
    its own.
    """
    store, given = Store(tmp_path), [*SMALL, "tolerance=0"]
    photons = [f"laser_photons[{arm},green]" for arm in ("plain", "mask")]
    rival = run(
        load("first_light", given),
        store,
        ["rival_photons", "rival_matrix", "matrix", "lsr[mask]", "bands"],
    )
    share = float(rival["lsr[mask]"][(rival["bands"].centres - 532e-9).abs().argmin()])
    whole = [*given, "doe=grey_filter", f"doe.transmittance={share!r}"]
    filtered = run(load("first_light", whole), store, ["photons[mask]", "matrix", *photons])
    assert 0 < share < 0.5
    assert float(filtered[photons[1]].max()) == pytest.approx(
        share * float(filtered[photons[0]].max()), rel=1e-5
    )
    torch.testing.assert_close(
        rival["rival_photons"], filtered["photons[mask]"], rtol=1e-4, atol=1e-3
    )
    torch.testing.assert_close(rival["rival_matrix"] * share, rival["matrix"])
    torch.testing.assert_close(rival["matrix"], filtered["matrix"])
