"""Own thresholds of damage from a CSV file: what a row says, and where a mistake is told."""

import pytest

from neusee.nodes.laser import DamageLaw, read_damage_laws

HEADER = (
    "device,damage,wavelength from (nm),wavelength to (nm),duration from (ns),duration to (ns),"
    "threshold (J/cm2),factor,median factor,spot (um),source"
)
ROW = "CMOS,cross,1500,1600,1,100,0.5,1.6,1.2,20,own test"


@pytest.fixture
def write(tmp_path):
    """Write a file and return its path."""

    def write(text, name="mine.csv"):
        (tmp_path / name).write_text(text, encoding="utf-8")
        return tmp_path / name

    return write


def test_a_row_is_a_law_in_si_units(write):
    (law,) = read_damage_laws(write(f"# a comment\n{HEADER}\n{ROW}\n"))
    assert law == DamageLaw(
        "CMOS", "cross", "fluence", pytest.approx(5e3), 1.6, 1.2, pytest.approx((1500e-9, 1600e-9)),
        pytest.approx((1e-9, 1e-7)), pytest.approx(20e-6), "own test",
    )  # fmt: skip


def test_continuous_light_and_pulses_stand_in_one_file_and_cells_may_be_empty(write):
    header = (
        "source,threshold (kW/cm2),threshold (mJ/cm2),device,damage,wavelength from (um),wavelength"
        " to (um),duration from (s),duration to (s)"
    )
    rows = (
        'a data sheet,30,,CCD,line,0.5,0.6,0.001,10\n"mine, 2'
        ' devices",,80,CCD,point,0.5,0.6,1e-9,1e-7\n'
    )
    one, other = read_damage_laws(write(f"{header}\n{rows}"))
    assert (one.quantity, one.median, one.factor, one.spot) == (
        "irradiance",
        pytest.approx(3e8),
        None,
        None,
    )
    assert (other.quantity, other.median, other.source) == (
        "fluence",
        pytest.approx(800.0),
        "mine, 2 devices",
    )


def test_an_empty_spread_is_a_law_without_probability(write):
    (law,) = read_damage_laws(write(f"{HEADER}\nCMOS,point,500,560,1,100,0.5,,,,a report\n"))
    assert law.factor is law.median_factor is law.spot is None


@pytest.mark.parametrize(("old", "new", "message"), [
    (HEADER, "", r"mine.csv.*no laws of damage below a header|no quantity 'CMOS'"),
    (ROW, "", "mine.csv has no laws of damage below a header"),
    (",source", ",note", r"mine.csv:1, column 11: no quantity 'note'"),
    ("(J/cm2)", "(J)", r"mine.csv:1, column 7, threshold \(J\) has the unit J: write one of \(W/m2\)"),
    ("(J/cm2)", "", r"mine.csv:1, column 7, threshold has no unit"),
    ("spot (um)", "spot (in)", r"column 10, spot \(in\) has the unit in"),
    ("device,", "", "mine.csv: no column device"),
    (",own test", "", "mine.csv:2: 10 columns in place of 11"),
    ("0.5,1.6", "half,1.6", r"mine.csv:2, column 7, threshold \(J/cm2\): 'half' is not a number"),
    ("0.5,1.6", "-0.5,1.6", "column 7, .* -0.5 is not a finite number above 0"),
    ("0.5,1.6", "nan,1.6", "column 7, .* nan is not a finite number above 0"),
    ("0.5,1.6", ",1.6", "column 7, .* 0 thresholds in this row: give one"),
    ("1.6,1.2", "0.6,1.2", "column 8, factor: 0.6: a factor of one standard deviation, such as 2, is above 1"),
    ("1.6,1.2", "1.6,", "column 8, factor: one of factor and median factor is given"),
    ("1500,1600", "1600,1500", r"column 4, wavelength to \(nm\): the range ends before it starts: swap"),
    ("1,100,", "100,1,", r"column 6, duration to \(ns\): the range ends before it starts"),
    ("cross", "star", "column 2, damage: no kind of damage 'star': write one of point, line"),
    ("own test", "", "column 11, source: the cell is empty: say where the threshold is from"),
    (",", ";", "separates its columns by semicolons"),
])  # fmt: skip
def test_a_mistake_is_told_with_line_and_column(write, old, new, message):
    text = f"{HEADER}\n{ROW}\n"
    assert old in text
    with pytest.raises(ValueError, match=message):
        read_damage_laws(write(text.replace(old, new)))


@pytest.mark.parametrize("name", ["mine.yaml", "mine.YML", "mine.json"])
def test_thresholds_in_yaml_are_refused_with_the_form_of_a_table(tmp_path, name):
    (tmp_path / name).write_text(
        "- {device: CMOS, threshold: 1 J/cm2}\n- {device: CCD, threshold: 1 J/cm2}\n"
    )
    with pytest.raises(
        ValueError, match=r"is no CSV file: .* write a header such as device,damage"
    ):
        read_damage_laws(tmp_path / name)
