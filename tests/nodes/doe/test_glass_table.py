"""Glasses of one's own: published indices, interpolation of a table, and wavelengths at which
nothing is known.
"""

import math

import numpy as np
import pytest
import torch

from neusee.nodes import ParameterError, doe
from neusee.nodes.values import Bands

#: Malitson, J. Opt. Soc. Am. 55, 1205 (1965): coefficients, and computed indices of his Table at
#: wavelengths in um
SILICA = dict(
    B=(0.6961663, 0.4079426, 0.8974794),
    C=(0.0684043**2, 0.1162414**2, 9.896161**2),
    range=(0.21e-6, 3.71e-6),
)
MALITSON = {
    0.404656: 1.469618,
    0.486133: 1.463126,
    0.546074: 1.460078,
    0.587561: 1.458464,
    0.656272: 1.456367,
}
#: SCHOTT data sheet N-BK7 517642.251: constants of the dispersion formula, and refractive indices
#: at spectral lines, nm
CROWN = dict(
    B=(1.03961212, 0.231792344, 1.01046945),
    C=(0.00600069867, 0.0200179144, 103.560653),
    range=(0.3e-6, 2.5e-6),
)
SCHOTT = {
    404.66: 1.53024,
    486.13: 1.52238,
    546.07: 1.51872,
    587.56: 1.51680,
    632.8: 1.51509,
    656.27: 1.51432,
}


def at(*micrometres):
    centres = torch.tensor(micrometres, dtype=torch.float64) * 1e-6
    return Bands(centres, torch.zeros_like(centres), torch.ones_like(centres))


def write(folder, text):
    (folder / "glass.csv").write_text(text)
    return folder / "glass.csv"


def coefficients(glass, unit="um^2", scale=1.0):
    low, high = (end * 1e9 for end in glass["range"])
    terms = zip(glass["B"], glass["C"], strict=True)
    return f"B (1),C ({unit}),from (nm),to (nm)\n" + "".join(
        f"{b},{c * scale!r},{low},{high}\n" for b, c in terms
    )


def index_table(glass, step, low=0.4, high=1.1):
    """A table of the formula, written apart from that of the package: ten digits every ``step``
    nm.
    """
    text = "wavelength (um),n (1)\n"
    for w in np.arange(round(low * 1000), round(high * 1000) + 1, step) / 1000:
        square = 1 + math.fsum(
            b * w**2 / (w**2 - c) for b, c in zip(glass["B"], glass["C"], strict=True)
        )
        text += f"{w:.3f},{math.sqrt(square):.10f}\n"
    return text


@pytest.mark.parametrize("form", ["recipe", "file", "file in nm^2"])
def test_fused_silica_is_that_of_malitson(tmp_path, form):
    glass = SILICA
    if form != "recipe":
        glass = write(
            tmp_path, coefficients(SILICA, *(("nm^2", 1e6) if form.endswith("nm^2") else ()))
        )
    found = doe.material(at(*MALITSON), material=glass) + 1
    np.testing.assert_allclose(found.numpy(), list(MALITSON.values()), rtol=0, atol=1e-6)


def test_crown_glass_is_that_of_its_data_sheet():
    found = doe.material(at(*(nm / 1000 for nm in SCHOTT)), material=CROWN) + 1
    np.testing.assert_allclose(found.numpy(), list(SCHOTT.values()), rtol=0, atol=5.5e-6)
    assert torch.equal(found, doe.material(at(*(nm / 1000 for nm in SCHOTT)), material="BK7") + 1)


@pytest.mark.parametrize(("step", "bound"), [(10, 1e-7), (50, 2e-5)])
def test_a_table_is_interpolated_between_its_rows(tmp_path, step, bound):
    file = write(tmp_path, index_table(CROWN, step))
    sampled = at(*(0.4 + 0.7 * i / 997 for i in range(998)))
    off = (doe.material(sampled, material=file) - doe.material(sampled, material="BK7")).abs()
    assert float(off.max()) < bound
    rows = at(*(0.4 + step / 1000 * i for i in range(5)))
    torch.testing.assert_close(
        doe.material(rows, material=file), doe.material(rows, material="BK7"), rtol=0, atol=1e-10
    )


@pytest.mark.parametrize("count", [2, 3])
def test_few_rows_are_interpolated_by_all_of_them(tmp_path, count):
    rows = [(0.4, 1.6), (0.6, 1.5), (0.9, 1.47)][:count]
    file = write(tmp_path, "wavelength (um),n (1)\n" + "".join(f"{w},{n}\n" for w, n in rows))
    fit = np.polynomial.Polynomial.fit(*zip(*rows, strict=True), count - 1)
    np.testing.assert_allclose(
        doe.material(at(0.4, 0.51, 0.6), material=file).numpy(), fit(np.array([0.4, 0.51, 0.6])) - 1
    )


def test_the_index_of_a_table_has_a_gradient_by_the_wavelength(tmp_path):
    file = write(tmp_path, index_table(CROWN, 10))
    um = torch.tensor([0.4321, 0.5555, 1.0321], dtype=torch.float64, requires_grad=True)
    assert torch.autograd.gradcheck(
        lambda w: doe.material(at(0.5)._replace(centres=w * 1e-6), material=file), (um,)
    )


@pytest.mark.parametrize("nm", [399, 1064.5])
def test_an_index_is_never_extrapolated(tmp_path, nm):
    file = write(tmp_path, index_table(CROWN, 10, high=1.06))
    for node, params in (
        (doe.material, {"bands": at(0.5, nm / 1000)}),
        (doe.axicon, {"wavelength": nm * 1e-9}),
    ):
        with pytest.raises(ParameterError, match=f"known from 400 to 1060 nm, not at {nm:g} nm"):
            node.hooks.preflight(**params, material=file)
    with pytest.raises(ParameterError, match="an index is not extrapolated") as error:
        doe.fabricate.hooks.preflight(
            material=file, wrap_at=nm * 1e-9, levels=None, max_height=None
        )
    assert error.value.parameter == "wrap_at"
    with pytest.raises(ValueError, match="not extrapolated"):
        doe.material(at(nm / 1000), material=file)


def test_a_mask_of_own_glass_has_the_height_of_the_known_glass(tmp_path):
    from neusee.nodes import optics

    stop = optics.stop(samples=32, pitch=1e-4, diameter=3.2e-3)
    file = write(tmp_path, coefficients(CROWN))
    known = doe.axicon(stop, waves=4.0, material="BK7")
    torch.testing.assert_close(doe.axicon(stop, waves=4.0, material=file), known, rtol=0, atol=0)
    limits = {"wrap_at": 550e-9, "levels": 8, "max_height": None}
    torch.testing.assert_close(
        doe.fabricate(known, material=file, **limits),
        doe.fabricate(known, material="BK7", **limits),
        rtol=0,
        atol=0,
    )


def test_the_check_says_where_a_glass_is_known(tmp_path):
    file = write(tmp_path, index_table(CROWN, 10))
    checks = doe.material.hooks.check(doe.material(at(0.5), material=file), at(0.5), material=file)
    assert [check.text for check in checks] == [
        "glass.csv: n - 1 from 0.5214 to 0.5214",
        "known from 400 to 1100 nm",
    ]
    checks = doe.material.hooks.check(
        doe.material(at(0.5), material=SILICA), at(0.5), material=SILICA
    )
    assert checks[0].text.startswith("own Sellmeier coefficients: ")
