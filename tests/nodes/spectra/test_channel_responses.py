"""A camera of one's own: sensitivities from a CSV file, averaged over bands, and what is refused
before the run.
"""

import numpy as np
import pytest
import torch

import neusee
from neusee.nodes import ParameterError
from neusee.nodes.spectra import responses
from neusee.nodes.values import Bands
from neusee.workflows import RecipeError, Store, load

HEAD = "wavelength,red,green,blue\n"
ROWS = [
    (400, 0, 0, 41.5),
    (447.5, -0.2, 10, 100),
    (550, 20, 90.25, 5),
    (601, 80, 30, 0),
    (700, 2, 0, 0),
]


def write(folder, rows=ROWS, name="mine.csv", head=HEAD):
    file = folder / name
    file.write_text(head + "".join(",".join(map(str, row)) + "\n" for row in rows))
    return file


def mean(low, high, x, y):
    """Average a polygon over an interval: the trapezium rule with every corner is exact; 0
    beyond the ends.
    """
    if high == low:
        return float(np.interp(low, x, y, left=0, right=0))
    low_inside, high_inside = max(low, x[0]), min(high, x[-1])
    at = np.array([low_inside, *[k for k in x if low_inside < k < high_inside], high_inside])
    return np.trapezoid(np.interp(at, x, y), at) / (high - low) if high_inside > low_inside else 0.0


@pytest.mark.parametrize("width", [0.0, 0.3, 10.0, 250.0])
def test_a_file_is_averaged_over_each_band(tmp_path, width):
    centres = np.array([380.0, 399.9, 447.5, 488.1, 601.2, 699.0, 810.0])
    numbers = np.array(ROWS, float)
    sides = [(c - width / 2, c + width / 2) for c in centres]
    exact = np.array(
        [[mean(*side, numbers[:, 0], column) for side in sides] for column in numbers[:, 1:].T]
    )
    in_metres = torch.tensor(centres, dtype=torch.float64) * 1e-9
    sampled = Bands(in_metres, torch.full_like(in_metres, width * 1e-9), torch.ones_like(in_metres))
    found = responses(sampled, camera=write(tmp_path))
    assert found.dtype == torch.float64
    np.testing.assert_allclose(found.numpy(), np.maximum(exact, 0) / 100, rtol=0, atol=1e-11)
    assert responses.hooks.check(found, sampled, camera=write(tmp_path))[0].text.startswith(
        "mine.csv: peaks at 601.2"
    )


def test_a_recipe_takes_the_file_and_a_changed_file_is_another_result(tmp_path):
    file = write(tmp_path)
    words = ["sensor.camera=mine.csv", "outputs=[responses]"]
    found = []
    for factor in (1, 1, 2):
        write(tmp_path, [(w, r, factor * g, b) for w, r, g, b in ROWS])
        result = neusee.run(load("first_light", words, tmp_path), store=Store(tmp_path / "store"))
        found.append((result["responses"], result.done["responses"].state))
    assert [state for _, state in found] == ["run", "cached", "run"]
    assert float(found[0][0][0].max()) < 1
    assert float(found[2][0].max()) > 0.9
    assert not torch.equal(found[0][0], found[2][0])
    assert file.is_file()


def test_a_known_camera_is_a_name_in_every_folder(tmp_path):
    for name in ("CIE 1931", "Nikon 5100", "Sigma SDMerill"):
        assert (
            load("first_light", [f"sensor.camera={name}"], tmp_path)
            .steps["responses"]
            .params["camera"]
            == name
        )


def test_light_that_the_file_does_not_see_is_told_with_the_number(tmp_path):
    write(tmp_path)
    recipe = load("first_light", ["sensor.camera=mine.csv", "optics.longest=800 nm"], tmp_path)
    (note,) = [note for note in recipe.notes if "no channel of mine.csv" in note]
    assert "sees 8 of 31 bands, 706.67 nm to 800 nm: the largest relative response is 0, " in note
    assert note.endswith("choose 400 to 700 nm")


@pytest.mark.parametrize(
    ("rows", "said"),
    [
        ([(*ROWS[0], 1), (*ROWS[1], 1)], "5 columns in place of 4"),
        ([row[:3] for row in ROWS], "3 columns in place of 4"),
        ([ROWS[1], ROWS[0]], "in rising order"),
        (ROWS[:1], "at least two wavelengths"),
        ([(w / 1000, r, g, b) for w, r, g, b in ROWS], "in nm"),
        ([*ROWS[:3], (600, "nan", 1, 1)], "NaN or infinite"),
        ([*ROWS[:3], (600, "much", 1, 1)], "mine.csv:5: 'much' is not a number"),
        ([(w, r, g, 0) for w, r, g, _ in ROWS], "a channel has no sensitivity"),
        ([(w, r - 30, g, b) for w, r, g, b in ROWS], "a sensitivity is -30.2"),
        ([], "no columns of numbers"),
    ],
)
def test_what_is_no_camera_is_refused_before_the_run(tmp_path, rows, said):
    file = write(tmp_path, rows)
    with pytest.raises(ParameterError, match=said) as error:
        responses.hooks.preflight(camera=file)
    assert "write a header, then wavelength in nm, red, green and blue" in str(error.value)
    with pytest.raises(RecipeError, match=said):
        load("first_light", ["sensor.camera=mine.csv"], tmp_path)


@pytest.mark.parametrize(
    ("name", "hint"), [("Foo", ""), ("Nikon 510", "; did you mean Nikon 5100?")]
)
def test_a_camera_that_is_neither_known_nor_a_file_is_refused_with_both(tmp_path, name, hint):
    with pytest.raises(RecipeError, match="no such file: ") as error:
        load("first_light", [f"sensor.camera={name}"], tmp_path)
    assert f"{tmp_path / name}; must be 'CIE 1931', 'Nikon 5100' or 'Sigma SDMerill'{hint}" in str(
        error.value
    )
