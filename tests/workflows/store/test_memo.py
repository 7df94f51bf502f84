"""Values that are computed once: kept under a key, whatever their type, and computed again where
a file is damaged.
"""

import time
from dataclasses import dataclass, field

import pytest

from neusee.workflows.store.result_store import Store, compute_once

ABOUT = {"step": "a study"}


@dataclass(frozen=True)
class Measured:
    seconds: float
    steps: tuple[str, ...] = ()
    errors: dict[str, list[float]] = field(default_factory=dict)


FOUND = Measured(0.1 + 0.2, ("a", "b"), {"raw": [1e-300, float("inf")]})


@pytest.mark.parametrize("small", [False, True])
@pytest.mark.parametrize(
    ("kind", "value"),
    [(Measured, FOUND), (dict, {"psnr": 0.1 + 0.2}), (dict, {}), (list, [1.5, 2.5])],
)
def test_a_value_is_computed_once_and_comes_back_as_it_was(tmp_path, kind, value, small):
    calls = []

    def compute():
        calls.append(1)
        return value

    for _ in range(2):
        found = compute_once(Store(tmp_path), "0" * 32, kind, compute, ABOUT, small=small)
        assert found == value
        assert type(found) is kind
    assert len(calls) == 1


def test_the_metadata_say_what_it_is_when_it_was_made_and_how_long_it_took(tmp_path):
    store = Store(tmp_path)
    began = time.perf_counter()
    compute_once(store, "0" * 32, Measured, lambda: FOUND, ABOUT)
    whole = time.perf_counter() - began
    about = store.about("0" * 32)
    assert about["step"] == "a study"
    assert 0 <= about["seconds"] <= whole
    assert about["date"].endswith("+00:00")
    compute_once(store, "1" * 32, Measured, lambda: FOUND, {**ABOUT, "seconds": 7.0})
    assert store.about("1" * 32)["seconds"] == 7.0


def test_a_damaged_value_is_computed_again(tmp_path):
    compute_once(Store(tmp_path), "0" * 32, dict, lambda: {"first": 1}, ABOUT)
    (file,) = tmp_path.glob(f"*/{'0' * 32}.json")
    file.write_bytes(file.read_bytes().replace(b"first", b"worst"))
    with pytest.warns(UserWarning, match="damaged"):
        assert compute_once(Store(tmp_path), "0" * 32, dict, lambda: {"second": 2}, ABOUT) == {
            "second": 2
        }


def test_what_fails_is_not_kept(tmp_path):
    store = Store(tmp_path)

    def fail():
        raise KeyError("no such step")

    with pytest.raises(KeyError, match="no such step"):
        compute_once(store, "0" * 32, dict, fail, ABOUT)
    assert not store.has("0" * 32)
