"""From digital numbers back to electrons, clipped values marked, channels to colour."""

from fractions import Fraction

import pytest
import torch

from neusee.nodes.restore import clipped, colour, electrons
from neusee.nodes.sensor import digitize, full_well
from neusee.nodes.units import read_quantity


@pytest.mark.parametrize(("gain", "unit"), [(0.37, "e-/DN"), (0.37, "DN/e-"), (2.5, "e-/DN")])
def test_undoes_the_converter_to_its_rounding(gain, unit):
    charge = torch.rand(3, 9, 9, dtype=torch.float64) * 20000 + 390
    k = read_quantity(f"{gain} {unit}", "DN/e-")
    raw = digitize(charge, gain=k)
    found = electrons(raw, gain=k, offset=390.0)
    step = gain if unit == "e-/DN" else 1 / gain
    assert float((found - (charge - 390)).abs().max()) <= step / 2 * (1 + 1e-9)
    kept = electrons(raw, gain=k, offset=390.0, offset_subtracted=False)
    torch.testing.assert_close(kept - found, torch.full_like(kept, 390.0))


def test_a_kept_pedestal_is_said():
    assert "390 e-" in electrons.hooks.preflight(gain=1.0, offset=390.0, offset_subtracted=False)[0]
    assert electrons.hooks.preflight(gain=1.0, offset=390.0) == []


@pytest.mark.parametrize(("gain", "unit"), [(0.37, "e-/DN"), (0.37, "DN/e-")])
def test_marks_what_clips(gain, unit):
    charge = torch.tensor([[[1e6, 25500.0, 24000.0, 5.0]]])
    k = read_quantity(f"{gain} {unit}", "DN/e-")
    raw = digitize(full_well(charge, capacity=25500.0), gain=k)
    assert clipped(raw, full_well=25500.0, gain=k).tolist() == [[[True, True, False, False]]]


def test_colour_is_a_matrix_at_every_pixel():
    channels, matrix = torch.rand(2, 3, 4, 5), torch.rand(3, 3, dtype=torch.float64)
    found = colour(channels, matrix)
    assert found.dtype == torch.float32
    torch.testing.assert_close(
        found.double(), colour.hooks.reference(channels, matrix), rtol=1e-5, atol=1e-6
    )
    assert torch.autograd.gradcheck(
        lambda c: colour(c, matrix), (torch.rand(3, 2, 2).double().requires_grad_(),)
    )
    with pytest.raises(ValueError, match="do not fit"):
        colour(torch.rand(4, 2, 2), matrix)


def test_electrons_are_within_the_stated_error_of_exact_fractions():
    raw, gain = torch.arange(65536, dtype=torch.float32), 1 / 0.37
    found = electrons(raw, gain=gain, offset=0.0).tolist()
    assert (
        max(
            abs(Fraction(x) - n / Fraction(gain)) / (n / Fraction(gain))
            for n, x in enumerate(found)
            if n
        )
        <= 1.2e-7
    )
