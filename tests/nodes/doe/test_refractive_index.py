"""Indices against published values at the Fraunhofer lines."""

import pytest
import torch

from neusee.nodes import doe
from neusee.nodes.values import Bands


def bands(*nanometres):
    centres = torch.tensor(nanometres, dtype=torch.float64) * 1e-9
    return Bands(centres, torch.full_like(centres, 10e-9), torch.ones_like(centres))


PUBLISHED = [
    ("fused silica", (486.1, 587.6, 656.3), (1.46313, 1.45846, 1.45637), 1e-5),
    ("BK7", (486.1, 587.6, 656.3), (1.52238, 1.51680, 1.51432), 1e-5),
    ("PMMA", (486.1, 587.6, 656.3), (1.4971, 1.4907, 1.4880), 5e-4),
    ("photoresist", (632.8,), (1.5707,), 1e-3),
]


@pytest.mark.parametrize(("material", "lines", "indices", "error"), PUBLISHED)
def test_index_is_the_published_one(material, lines, indices, error):
    found = 1 + doe.material(bands(*lines), material=material)
    assert found.dtype == torch.float64
    assert found.tolist() == pytest.approx(indices, abs=error)


def test_silica_delays_as_the_paper_needs():
    found = doe.material(bands(400, 550, 700))
    assert found.tolist() == pytest.approx([0.4701, 0.4599, 0.4553], abs=5e-5)
    assert doe.wave_height("fused silica", 550e-9) == pytest.approx(1.196e-6, rel=1e-3)


@pytest.mark.parametrize("material", ["fused silica", "PMMA", "BK7", "photoresist"])
def test_dispersion_is_normal_over_the_visible_and_differentiable(material):
    visible = bands(*torch.linspace(400, 700, 31).tolist())
    assert bool((doe.material(visible, material=material).diff() < 0).all())
    um = torch.tensor([0.45, 0.6], dtype=torch.float64, requires_grad=True)
    assert torch.autograd.gradcheck(
        lambda w: doe.material(visible._replace(centres=w * 1e-6), material=material), (um,)
    )


def test_check_says_where_the_formula_was_not_fitted():
    for centres, ok in (((450, 700), True), ((400, 700), False)):
        given = bands(*centres)
        checks = doe.material.hooks.check(
            doe.material(given, material="PMMA"), given, material="PMMA"
        )
        assert [check.ok for check in checks] == [True, ok]
