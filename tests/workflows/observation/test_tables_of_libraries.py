"""A table of a library that a step changes is compared by its entries, also where a class stands
around a dict.
"""

from types import SimpleNamespace

from neusee.workflows.observation.left_state import _attributes, _is_of_package


class Table:
    """A mapping as libraries have them, which holds its entries in an attribute."""

    def __init__(self):
        self._data = {"D65": 6504.0}


def test_an_entry_that_is_added_or_changed_is_seen():
    table = Table()
    before = _attributes(table)
    assert _attributes(table) == before
    table._data["lab"] = 2856.0
    assert _attributes(table).keys() - before.keys() == {"_data['lab']"}
    table._data["D65"] = 6500.0
    assert _attributes(table)["_data['D65']"] != before["_data['D65']"]


def test_the_tables_of_a_module_are_its_attributes_alone():
    table = SimpleNamespace(names={"D65": 6504.0})
    assert _attributes(table).keys() == {"names", "names['D65']"}
    assert not [name for name in _attributes(Table) if "[" in name]


def test_what_a_package_imports_of_itself_at_the_first_use_is_no_change():
    from decimal import Decimal

    # a bound method has no module of the package
    assert _is_of_package(Decimal.from_float, "decimal") is False
    assert _is_of_package(Decimal, "decimal")
    assert not _is_of_package(lambda: 1, "decimal")
