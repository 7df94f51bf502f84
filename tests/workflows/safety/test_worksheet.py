"""The worksheet: every line is computed again from the lines before, and the chain from the
inputs by other means.
"""

import functools
import html
import math
import re

import pytest
from scipy.integrate import quad
from scipy.optimize import brentq

from neusee.workflows import Store, load
from neusee.workflows.safety import safety_estimate
from neusee.workflows.safety.safety_estimate import CERTIFICATE, estimate
from neusee.workflows.safety.safety_text import UNITS
from neusee.workflows.safety.worksheet import worksheet_page

FEW = ["safety.draws=100", "safety.protection={}"]
SHEETS = {
    "pointer": ("safety_pointer", ["lasers.pointer.power=1 W", "lasers.pointer.distance=25 m"]),
    "haze": ("safety_drone_dazzler", []),
    "lidar": ("safety_car_lidar", []),
    "lidar by the older rule": ("safety_car_lidar", ["safety.eye.rule=N^(-1/4)"]),
    "far lidar": ("safety_car_lidar_1550", []),
    "pulse": ("safety_laboratory", []),
    "show": ("safety_show", []),
}
#: with what helps: one laser of each emission; the others have the same lines of it
HELPED = ("pointer", "lidar", "pulse")
ROW = re.compile(r'<tr data-symbol="([^"]*)">(.*?)</tr>', re.DOTALL)
CELL = re.compile(r"<td[^>]*>(.*?)</td>", re.DOTALL)
KNOWN = {
    "pi": math.pi,
    "exp": math.exp,
    "ln": math.log,
    "log10": math.log10,
    "sqrt": math.sqrt,
    "tanh": math.tanh,
    "min": min,
    "max": max,
    "__builtins__": {},
}


@pytest.fixture(scope="module")
def sheet_of(tmp_path_factory):
    """A function that makes the sheet of a name once for all tests."""
    return functools.cache(lambda name: made_sheet(name, Store(tmp_path_factory.mktemp("store"))))


@pytest.fixture(
    params=[
        pytest.param(name, marks=[] if name == "pointer" else [pytest.mark.slow]) for name in SHEETS
    ]
)
def sheet(request, sheet_of):
    """The estimate, the text of its worksheet, and its lines: value and numbers by symbol."""
    return sheet_of(request.param)


def made_sheet(name, store):
    recipe, changes = SHEETS[name]
    with pytest.MonkeyPatch.context() as patch:
        if name not in HELPED:
            patch.setattr(safety_estimate, "remedies", lambda *_: ())
        found = estimate(load(recipe, [*FEW, *changes]), store)
    text = worksheet_page(found)
    lines = {}
    for symbol, row in ROW.findall(text):
        cells = [html.unescape(cell) for cell in CELL.findall(row)]
        assert symbol not in lines
        lines[symbol] = {"value": float(cells[4]), "numbers": cells[3], "formula": cells[2]}
    return found, text, lines


def test_every_line_is_its_formula_with_the_printed_numbers(sheet):
    _, _, lines = sheet
    computed = {symbol: line for symbol, line in lines.items() if line["numbers"]}
    assert len(computed) >= 8
    for symbol, line in computed.items():
        value = eval(line["numbers"].replace("×", "*").replace("^", "**"), KNOWN)
        assert value == pytest.approx(line["value"], rel=3e-4), symbol


def test_every_formula_has_the_printed_value_of_each_symbol(sheet):
    _, _, lines = sheet
    symbols = {symbol: line["value"] for symbol, line in lines.items()}
    for symbol, line in lines.items():
        if line["formula"] and "H(" not in line["formula"]:
            scope = {name.replace("lambda", "lam"): value for name, value in symbols.items()}
            text = line["formula"].replace("×", "*").replace("^", "**").replace("lambda", "lam")
            assert eval(text, KNOWN | scope) == pytest.approx(line["value"], rel=3e-4), symbol


def test_the_chain_from_the_inputs_by_quadrature(sheet):
    """Power and field in the aperture as integrals of the Gaussian beam, in place of the closed
    forms.
    """
    _, _, lines = sheet
    at = {symbol: line["value"] for symbol, line in lines.items()}
    w = math.hypot(at["w0"], at["theta"] * at["R"] / 2)
    axis = 2 * at["X"] * at["T"] / (math.pi * w * w)
    radius = at["D"] / 2
    power = quad(lambda r: axis * math.exp(-2 * r * r / w**2) * 2 * math.pi * r, 0, radius)[0]
    field = quad(lambda r: math.sqrt(axis) * math.exp(-r * r / w**2) * 2 * math.pi * r, 0, radius)[
        0
    ]
    assert at["El"] == pytest.approx(axis, rel=1e-4)
    if "S" in at:
        joules = at["n"] / at["eta"] * 6.62607015e-34 * 299792458.0 / at["lambda"]
        assert at["S"] == pytest.approx(joules / (at["t"] * at["p"] ** 2), rel=1e-4)
    assert at["Xa"] == pytest.approx(power, rel=1e-4)
    assert at["Ec"] == pytest.approx(at["tau"] * field**2 / (at["lambda"] * at["F"]) ** 2, rel=1e-4)


def test_the_sheet_has_the_numbers_of_the_verdict(sheet):
    found, _, lines = sheet
    plain = [each for each in found.findings if each.option == "plain lens"]
    for number, finding in enumerate(plain, 1):
        assert lines[f"r{number}"]["value"] == pytest.approx(finding.ratio, rel=1e-5)
    if found.eye is not None:
        assert lines["M"]["value"] == pytest.approx(found.eye.limit, rel=1e-5)
        assert lines["NOHD"]["value"] == pytest.approx(found.eye.distance.value, rel=1e-5)
    else:
        assert "M" not in lines
    nearest = min((row.angle for row in found.eye_dazzle.rows), default=None)
    rows = [row for row in found.eye_dazzle.rows if row.angle == nearest]
    assert [line for line in lines if line.startswith("lx")] == [
        f"lx{i}" for i in range(1, len(rows) + 1)
    ]


def test_the_hazard_distance_is_where_the_mean_over_the_aperture_is_the_limit(sheet):
    _, _, lines = sheet
    at = {symbol: line["value"] for symbol, line in lines.items()}
    if at.get("NOHD", 0) <= 0:
        return

    def excess(distance):
        w = math.hypot(at["w0"], at["theta"] * distance / 2)
        return (
            at["X"] * -math.expm1(-(at["a"] ** 2) / (2 * w * w)) / (math.pi * at["a"] ** 2 / 4)
            - at["M"]
        )

    assert brentq(excess, 1e-3, 1e8) == pytest.approx(at["NOHD"], rel=1e-3)


def test_the_sheet_says_what_it_is_and_loads_nothing(sheet):
    found, text, _ = sheet
    assert text.count(CERTIFICATE) >= 2
    assert "@page" in text
    assert "A4" in text
    assert not re.search(r"(?:src|href)=|url\(|<script", text)
    for heading in (
        "Inputs",
        "At the lens",
        "Limits of the sensor",
        "The eye",
        "Dazzle of the eye",
        "Assumed",
    ):
        assert heading in text
    if found.eye is not None:
        assert html.escape(found.eye.source, quote=False).replace("'", "&#39;") in text
    assert set(UNITS) == {"irradiance", "fluence"}


@pytest.mark.slow
def test_the_rule_of_the_eye_stands_on_page_terminal_and_document(sheet):
    from neusee.workflows.safety.run_safety import document
    from neusee.workflows.safety.safety_page import report
    from neusee.workflows.safety.safety_text import paragraphs

    found = sheet[0]
    if found.eye is None:
        return
    source = found.eye.source
    assert document(found)["eye"]["source"] == source
    assert any(source in line for part in paragraphs(found) for line in part)
    assert any(source in section.text for section in report(found).sections)
    if found.emission == "pulse train" and found.exposures.beams[0].wavelength < 1400e-9:
        rule = found.safety.settings.eye.rule
        assert ("edition of 2014" in source) == (rule == "IEC 60825-1:2014")
        assert ("edition of 2007" in source) == (rule == "N^(-1/4)")
