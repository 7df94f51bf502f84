"""Mistakes in tables of one's own: each is located in the recipe or the file, and the exit code
is 2.
"""

import numpy as np
import pytest
from scipy.io import savemat

from neusee.workflows.cli import app

RECIPE = """\
# A bench for tables.
nodes: []
steps:
  bands: {node: spectra.bands, with: {start: 400 nm, stop: 700 nm, count: 4}}
  stop: {node: optics.stop, with: {samples: 8, pitch: 100 um, diameter: 800 um}}
  tested:
    node: NODE
    from: INPUT
    with: {PARAMETER: FILE}
outputs: [tested]
"""
#: for each kind of table: node, input, parameter
KINDS = {
    "camera": ("spectra.responses", "bands", "camera"),
    "light": ("spectra.illuminant", "bands", "kind"),
    "glass": ("doe.material", "bands", "material"),
    "laser": ("spectra.line_table", "{}", "file"),
    "mask": ("doe.pixelwise", "stop", "file"),
}
CAMERA, LIGHT, GLASS = (
    "wavelength (nm),QE (%)\n",
    "wavelength (nm),power (W/nm)\n",
    "wavelength (um),n (1)\n",
)
LASER, SELLMEIER = "wavelength (nm),power (mW)\n", "B (1),C (um^2),from (nm),to (nm)\n"
FOUR = "400,1\n500,2\n600,3\n700,2\n"

#: kind of table, content of the file, what is said
MISTAKES = {
    "no file": ("camera", None, "no such file: "),
    "no header": ("camera", FOUR, "mine.csv:1: the first row holds numbers: begin with a header"),
    "percent as fraction": (
        "camera",
        "wavelength (nm),QE (1)\n" + FOUR,
        "mine.csv:3, column 2, QE (1): 2 1 is more",
    ),
    "more than 100 %": (
        "camera",
        CAMERA + "400,60\n700,101\n",
        "mine.csv:3, column 2, QE (%): 101 % is more than one",
    ),
    "two units": (
        "camera",
        "wavelength (nm),R (%),G (1),B (1)\n400,1,1,1\n700,2,2,2\n",
        "the units %, 1: give all the same",
    ),
    "QE without unit": (
        "camera",
        "wavelength (nm),QE\n" + FOUR,
        "QE needs the unit (1), (%) or (A/W)",
    ),
    "two channels": (
        "camera",
        "wavelength (nm),a (1),b (1)\n400,1,1\n700,1,1\n",
        "3 columns in place of 4 for red",
    ),
    "unsorted": (
        "camera",
        CAMERA + "500,5\n400,6\n",
        "mine.csv:3: 400 nm follows 500 nm: list the wavelengths in rising",
    ),
    "twice": (
        "glass",
        GLASS + "0.4,1.5\n0.5,1.49\n0.5,1.48\n",
        "mine.csv:4: 500 nm stands there again: keep one row",
    ),
    "NaN": (
        "light",
        LIGHT + "# lamp\n350,1\n500,nan\n800,1\n",
        "mine.csv:4: nan is NaN or infinite (column 2, power (W/nm))",
    ),
    "text": (
        "light",
        LIGHT + "350,1\n800,n/a\n",
        "mine.csv:3: 'n/a' is not a number (column 2, power (W/nm))",
    ),
    "short row": (
        "light",
        LIGHT + "350,1\n800\n",
        "mine.csv:3: 1 column in place of 2, the number of headings",
    ),
    "semicolons": (
        "light",
        "wavelength (nm);power (W/nm)\n350;1\n",
        "separates its columns by semicolons: separate",
    ),
    "wavelength without unit": (
        "light",
        "wavelength,power (W/nm)\n" + FOUR,
        "has no unit: write the unit in brackets",
    ),
    "wavelength last": (
        "glass",
        "n (1),wavelength (um)\n1.5,0.4\n",
        "n (1), has no wavelengths: write wavelength (nm)",
    ),
    "wrong unit of length": (
        "glass",
        "wavelength (nm),n (1)\n0.4,1.5\n0.7,1.4\n",
        "mine.csv:2: the wavelength 0.4 is no light",
    ),
    "photons": (
        "light",
        "wavelength (nm),flux (photons/s)\n" + FOUR,
        "flux (photons/s) is no spectral power: divide photons",
    ),
    "darkness": ("light", LIGHT + "350,0\n800,0\n", "mine.csv has no power at any wavelength"),
    "negative light": (
        "light",
        LIGHT + "350,1\n500,-2\n800,1\n",
        "mine.csv:3, column 2, power (W/nm): a light cannot have",
    ),
    "short light": (
        "light",
        LIGHT + FOUR,
        "reach from 350 to 750 nm, but mine.csv is tabulated from 400 to 700 nm: give",
    ),
    "short glass": (
        "glass",
        GLASS + "0.4,1.5\n0.65,1.48\n",
        "mine.csv is known from 400 to 650 nm, not at 700 nm; an index",
    ),
    "n - 1": (
        "glass",
        GLASS + "0.4,0.5\n0.7,0.48\n",
        "mine.csv:2, column 2, n (1): 0.5 is no refractive index: write n",
    ),
    "gap in a glass": (
        "glass",
        GLASS + "0.35,1.5352\n0.351,1.5350\n0.352,1.5347\n0.7,1.51\n0.75,1.5092\n",
        "mine.csv:5: the rows do not tell the index between 352 and 700 nm: give rows there",
    ),
    "underscore": ("light", LIGHT + "350,1_0\n800,1\n", "mine.csv:2: '1_0' is not a number"),
    "n and k": (
        "glass",
        "wavelength (um),n (1),k (1)\n0.4,1.5,0\n0.7,1.4,0\n",
        "mine.csv has 3 columns in place of 2",
    ),
    "root of C": (
        "glass",
        SELLMEIER + "0.7,0.3,400,700\n",
        "the coefficients give no index between 1 and 5 at ",
    ),
    "unit of C": (
        "glass",
        "B (1),C (um),from (nm),to (nm)\n1,0.01,400,700\n",
        "mine.csv: C needs a unit such as um^2",
    ),
    "power without unit": (
        "laser",
        "wavelength (nm),power\n532,1\n",
        "mine.csv: column 2, power, has no unit; write",
    ),
    "negative line": (
        "laser",
        LASER + "532,1\n589,-1\n",
        "mine.csv:3, column 2, power (mW): a laser has no power or width",
    ),
    "one row of a spectrum": (
        "laser",
        "wavelength (nm),power (mW/nm)\n532,1\n",
        "a spectrum needs at least two",
    ),
    "width in percent": (
        "laser",
        "wavelength (nm),power (mW),fwhm (%)\n532,1,1\n",
        "column 3, fwhm (%), has no widths",
    ),
}


@pytest.fixture
def refused(tmp_path, monkeypatch, capfd):
    """Validate a recipe with one step that reads a table; return the error, which is one
    problem.
    """
    monkeypatch.chdir(tmp_path)
    monkeypatch.setenv("NEUSEE_CACHE", str(tmp_path / "cache"))

    def refused(kind, file, **more):
        node, source, parameter = KINDS[kind]
        text = RECIPE.replace("NODE", node).replace("PARAMETER", parameter).replace("FILE", file)
        text = text.replace("    from: INPUT\n", "" if source == "{}" else f"    from: {source}\n")
        text = text.replace(
            "}\noutputs", "".join(f", {k}: {v}" for k, v in more.items()) + "}\noutputs"
        )
        (tmp_path / "bench.yaml").write_text(text.replace("nodes: []\n", ""))
        with pytest.raises(SystemExit) as end:
            app.main(["validate", "bench.yaml"])
        out, err = capfd.readouterr()
        assert (end.value.code, out) == (2, "")
        assert err.endswith("1 problem, nothing was run\n"), err
        return " ".join(err.split())

    return refused


@pytest.mark.parametrize(("kind", "content", "said"), MISTAKES.values(), ids=MISTAKES)
def test_a_mistake_in_a_table_is_located(refused, tmp_path, kind, content, said):
    if content is not None:
        (tmp_path / "mine.csv").write_text(content)
    error = refused(kind, "mine.csv")
    line, column = (7 if kind == "laser" else 8), len(f"    with: {{{KINDS[kind][2]}: ") + 1
    assert error.startswith(
        f"bench.yaml:{line}:{column} steps.tested.with.{KINDS[kind][2]} = mine.csv "
    )
    assert said in error


@pytest.mark.parametrize(
    ("glass", "said"),
    [
        (
            "{B: [1.1], C: [0.01], range: [400 nm, 700 nm]}",
            "needs the unit um^2: write '0.01 um^2', or nm^2",
        ),
        (
            "{B: [1.1], C: [0.01 um], range: [400 nm, 700 nm]}",
            "needs the unit um^2: write '0.01 um^2'",
        ),
        (
            "{B: [1.1, 0.2], C: [0.01 um^2], range: [400 nm, 700 nm]}",
            "2 coefficients B for 1 C: give one C for each B",
        ),
        (
            "{B: [1.1], C: [0.01 um^2], range: [500 nm, 700 nm]}",
            "is known from 500 to 700 nm, not at 400 nm",
        ),
        (
            "{B: [1.1], C: [0.01 um^2], range: [700 nm, 400 nm]}",
            "is empty: exchange the two wavelengths",
        ),
        (
            "{B: [1.1], C: [0.25 um^2], range: [400 nm, 700 nm]}",
            "give no index between 1 and 5 at 400 nm",
        ),
        ("{B: [1.1], C: [0.01 um^2]}", "lacks range"),
        ("{B: [1.1], C: [0.01 um^2], range: [400 nm, 700 nm], D: 1}", ".D = 1 has no meaning here"),
    ],
)
def test_wrong_coefficients_in_a_recipe_are_located(refused, glass, said):
    error = refused("glass", glass)
    assert error.startswith("bench.yaml:8:")
    assert "fused silica" not in error  # what a name would have to be does not help
    assert said in error


@pytest.mark.parametrize(
    ("make", "more", "said"),
    [
        (
            lambda path: np.save(path, np.zeros((8, 6))),
            {},
            "(8, 6), not the pupil grid (8, 8): state its pitch",
        ),
        (
            lambda path: np.save(path, np.zeros((8, 8))),
            {"pitch": "50 um"},
            "smaller than the clear aperture of 0.8 mm",
        ),
        (
            lambda path: np.save(path, np.full((8, 8), 3.0)),
            {},
            "state the unit of the file, such as unit: 1 um",
        ),
        (
            lambda path: np.save(path, np.full((8, 8), np.nan)),
            {},
            "64 heights are NaN or infinite, the first in row 0",
        ),
        (lambda path: np.save(path, np.zeros((8, 8), np.float16)), {}, "16-bit floats (float16)"),
        (lambda path: np.save(path, np.zeros((8, 8), complex)), {}, "values of type complex128"),
        (
            lambda path: np.save(path, np.eye(9) * 1e-6),
            {"pitch": "100 um"},
            "the height jumps by 1 um of 1 um from",
        ),
    ],
)
def test_a_mistake_in_a_height_map_is_located(refused, tmp_path, make, more, said):
    make(tmp_path / "mine.npy")
    error = refused("mask", "mine.npy", **more)
    assert error.startswith("bench.yaml:8:")
    assert said in error


def test_a_header_against_the_recipe_is_located_at_the_recipe(refused, tmp_path):
    savemat(tmp_path / "mine.mat", {"height": np.zeros((8, 8)), "unit": "1 nm"})
    error = refused("mask", "mine.mat", unit="1 um")
    assert error.startswith("bench.yaml:8:34 steps.tested.with.unit = 1 um ")
    assert "1 um, but the header of mine.mat says 0.001 um: leave one of them out" in error
