"""The table of 36 lasers of every kind of pulse agrees with the formulas of a pocket calculator."""

import pytest

from tests.benchmarks import judged_lasers


@pytest.mark.slow
@pytest.mark.usefixtures("without_remedies")
def test_no_laser_of_the_table_contradicts_the_formulas_by_hand(capsys):
    assert judged_lasers.main() == 0
    assert capsys.readouterr().out.endswith("36 lasers, 0 contradictions\n")
