"""Tables of moments: the columns by their names, the drift put back, and every mistake with its
place.
"""

import pytest

from neusee.nodes import ParameterError
from neusee.nodes.calibrate import table

TEXT = (
    "photons,exposure_s,pixels,mean,variance,apart\n0,0.1,100,10.5,2.5,0.2\n50.5,0.2,100,99,7,-1\n"
)


@pytest.fixture
def file(tmp_path):
    (tmp_path / "t.csv").write_text(TEXT)
    return tmp_path / "t.csv"


def test_columns_are_found_by_name(file):
    found = table(file=file)
    assert found.photons.tolist() == [0.0, 50.5]
    assert found.exposure.tolist() == [0.1, 0.2]
    assert found.pixels.tolist() == [200.0, 200.0]
    assert found.mean.tolist() == [10.5, 99.0]
    assert found.variance.tolist() == [2.5, 7.0]
    assert found.degrees_of_freedom.tolist() == [100.0, 100.0]
    assert [len(x) for x in found[6:]] == [0, 0, 0]


def test_the_drift_is_put_back(file):
    assert table(file=file, drift="apart").variance.tolist() == pytest.approx(
        [2.52, 7.5], rel=1e-15
    )


@pytest.mark.parametrize(
    ("unit", "seconds"), [("s", 1.0), ("ms", 1e-3), ("us", 1e-6), ("ns", 1e-9)]
)
def test_exposures_have_a_unit(file, unit, seconds):
    assert table(file=file, exposure_unit=unit).exposure.tolist() == [0.1 * seconds, 0.2 * seconds]


def test_a_byte_order_mark_and_other_names(file):
    file.write_text("\ufeff" + TEXT.replace("photons", "light"), encoding="utf-8")
    assert table.hooks.preflight(file=file, photons="light", mean="mean", drift=None) == []
    assert table(file=file, photons="light").photons.tolist() == [0.0, 50.5]


@pytest.mark.parametrize(
    "parameter", ["photons", "exposure", "pixels", "mean", "variance", "drift"]
)
def test_a_missing_column_is_told_before_the_run(file, parameter):
    with pytest.raises(
        ParameterError, match=r"t\.csv has no column 'lost': name one of photons, exposure_s"
    ) as caught:
        table.hooks.preflight(file=file, **{parameter: "lost"})
    assert caught.value.parameter == parameter


@pytest.mark.parametrize(
    ("old", "new", "message"),
    [
        (
            "50.5",
            "many",
            r"t\.csv:3: column photons: 'many' is not valid for photons: write a number, >= 0",
        ),
        ("50.5", "-1", "column photons"),
        ("50.5", "nan", "column photons"),
        ("50.5", "inf", "column photons"),
        (
            "0.2,100",
            "0,100",
            r"column exposure_s: '0' is not valid for exposure: write a number, > 0",
        ),
        (
            "0.2,100",
            "0.2,100.5",
            "column pixels: '100.5' is not valid for pixels: write a whole number, >= 1",
        ),
        ("0.2,100", "0.2,0", "column pixels"),
        ("0.2,100", "0.2,inf", "column pixels"),
        (",99,7", ",,7", "column mean: '' is not valid for mean"),
        (",99,7,-1", ",99", "column variance: None is not valid for variance"),
        (",99,7", ",99,-7", "column variance"),
        ("0,0.1,100,10.5,2.5,0.2\n50.5,0.2,100,99,7,-1\n", "", "no line below the header"),
    ],
)
def test_what_is_no_number_is_told_with_its_place(file, old, new, message):
    assert old in TEXT
    file.write_text(TEXT.replace(old, new))
    with pytest.raises(ValueError, match=message):
        table(file=file)


def test_the_check_wants_a_dark(file):
    found = table(file=file)
    assert table.hooks.check(found)[0].ok
    assert not table.hooks.check(found._replace(photons=found.photons + 1))[0].ok
