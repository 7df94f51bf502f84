"""EMVA 1288 descriptors: levels as they are written, images by content, and every mistake with
its line.
"""

import os
from pathlib import Path

import numpy as np
import pytest
import torch
from PIL import Image
from pydantic import ValidationError

from neusee.nodes.calibrate import descriptor, descriptor_frames, descriptor_series, reduce
from neusee.nodes.calibrate._measurement_files import parsed_descriptor
from neusee.workflows.keys.cache_key import plain

DATA = Path(
    os.environ.get("NEUSEE_EMVA1288", Path(__file__).parents[4] / "../shared/data/emva1288")
)
TEXT = """# EMVA1288 data
v 3.0
n 12 6 4
b 40000.0 120.0
i images\\b_0.png
i images\\b_1.png

# the dark of the same exposure
d 40000.0
i images\\d_0.png
i images\\d_1.png
d 1000000 0
i images/d_2.png
i images/d_3.png
i images/d_4.png
"""
NAMES = ["b_0", "b_1", "d_0", "d_1", "d_2", "d_3", "d_4"]


@pytest.fixture
def folder(tmp_path):
    (tmp_path / "images").mkdir()
    rng = np.random.default_rng(1)
    for name in NAMES:
        numbers = rng.integers(1000, 4096, (4, 6), dtype=np.uint16)
        Image.fromarray(numbers).save(tmp_path / "images" / f"{name}.png")
    (tmp_path / "set.txt").write_text(TEXT.replace("\n", "\r\n"), newline="")
    return tmp_path


def given(folder):
    return descriptor.params.model_validate({"file": str(folder / "set.txt")}).file


def pixels(folder, *names):
    return np.stack([np.asarray(Image.open(folder / "images" / f"{n}.png")) for n in names]).astype(
        np.float64
    )


def test_levels_are_those_of_the_pairs(folder):
    found = descriptor(file=given(folder))
    sets = [NAMES[:2], NAMES[2:4]]
    for i, names in enumerate(sets):
        stack = pixels(folder, *names)
        assert float(found.mean[i]) == pytest.approx(stack.mean(), rel=1e-13)
        assert float(found.variance[i]) == pytest.approx(stack.var(0, ddof=1).mean(), rel=1e-13)
    assert found.photons.tolist() == [120.0, 0.0]
    assert found.exposure.tolist() == pytest.approx([4e-5, 4e-5], rel=1e-13)
    assert found.pixels.tolist() == [48.0, 48.0]
    assert found.degrees_of_freedom.tolist() == [24.0, 24.0]


def test_more_images_than_a_pair_are_a_spatial_series_and_no_level(folder):
    ((photons, exposure, frames),) = descriptor_series(given(folder))
    assert (photons, exposure) == (0.0, pytest.approx(1e-3, rel=1e-13))
    assert np.array_equal(torch.stack(list(frames)).numpy(), pixels(folder, *NAMES[4:]))
    assert [name for name, *_ in descriptor_frames(given(folder))] == ["line 4", "line 9"]


def test_without_pairs_every_level_counts(folder):
    (folder / "set.txt").write_text(
        TEXT.replace("b_1.png", "b_1.png\ni images/b_0.png").replace(
            "d_1.png", "d_1.png\ni images/d_2.png"
        )
    )
    assert descriptor(file=given(folder)).pixels.tolist() == [72.0, 72.0, 72.0]


def test_exposure_0_and_decimal_commas_are_read(folder):
    (folder / "set.txt").write_text(
        TEXT.replace("b 40000.0 120.0", "b 000.00 000,35").replace("d 40000.0", "d 0")
    )
    found = descriptor(file=given(folder))
    assert (found.photons.tolist(), found.exposure.tolist()) == ([0.35, 0.0], [0.0, 0.0])


def test_a_path_will_do_where_no_recipe_is_read(folder):
    assert (
        descriptor(file=folder / "set.txt").mean.tolist()
        == descriptor(file=given(folder)).mean.tolist()
    )


def test_every_image_counts_by_its_content(folder):
    keys = {str(plain(given(folder)))}
    for name in NAMES:
        numbers = np.asarray(Image.open(folder / "images" / f"{name}.png")).copy()
        numbers[0, 0] ^= 1
        Image.fromarray(numbers).save(folder / "images" / f"{name}.png")
        keys.add(str(plain(given(folder))))
    assert len(keys) == 1 + len(NAMES)


@pytest.mark.parametrize(
    ("old", "new", "message"),
    [
        ("b_1", "b_9", r"set\.txt:6: no such image: .*b_9\.png"),
        ("v 3.0", "w 3.0", r"set\.txt:2: cannot read 'w'"),
        ("n 12 6 4", "n 12 6", r"set\.txt:3: cannot read n '12 6': write n BITS WIDTH HEIGHT"),
        (
            "b 40000.0 120.0",
            "b 40000.0",
            r"set\.txt:4: cannot read b '40000\.0': write b EXPOSURE_NS PHOTONS",
        ),
        ("b 40000.0 120.0", "b 40000.0 bright", r"set\.txt:4: cannot read b"),
        ("b 40000.0 120.0", "b 40000.0 0", r"set\.txt:4: cannot read b"),
        ("b 40000.0 120.0", "b -1 120", r"set\.txt:4: cannot read b"),
        ("b 40000.0 120.0", "b nan 120", r"set\.txt:4: cannot read b"),
        ("d 1000000 0", "d 1000000 7", r"set\.txt:12: cannot read d"),
        ("i images\\b_1.png\n", "", r"set\.txt:4: 1 image\(s\): a light level needs two or more"),
        ("b 40000.0 120.0\n", "", r"set\.txt:4: an image precedes the first light level"),
        (TEXT, "v 3.0", "no line begins with 'b' or 'd'"),
    ],
)
def test_mistakes_are_told_with_their_line_before_anything_runs(folder, old, new, message):
    assert old in TEXT
    (folder / "set.txt").write_text(TEXT.replace(old, new, 1))
    with pytest.raises(ValidationError, match=message):
        given(folder)


def test_no_descriptor_at_all(tmp_path):
    with pytest.raises(ValidationError, match="no such file"):
        given(tmp_path)


@pytest.mark.parametrize(
    ("old", "new", "message"),
    [
        (
            "n 12 6 4",
            "n 12 4 6",
            r"set\.txt:4: image shape \(4, 6\), but descriptor shape \(6, 4\)",
        ),
        (
            "n 12 6 4",
            "n 10 6 4",
            r"set\.txt:4: a pixel of \d+ DN exceeds the 10 bits given in line n",
        ),
    ],
)
def test_images_are_held_to_what_the_descriptor_says(folder, old, new, message):
    (folder / "set.txt").write_text(TEXT.replace(old, new))
    with pytest.raises(ValueError, match=message):
        descriptor(file=given(folder))


def test_the_check_wants_a_dark(folder):
    found = descriptor(file=given(folder))
    assert descriptor.hooks.check(found)[0].text == "2 levels (1 dark), exposures up to 4e-05 s"
    lit = reduce(np_stack(folder), photons=1.0, exposure=0.1)
    assert not descriptor.hooks.check(lit)[0].ok


def np_stack(folder):
    return torch.from_numpy(pixels(folder, *NAMES[:2]))


@pytest.mark.parametrize(
    ("name", "levels", "dark", "images", "longest"),
    [
        ("001_CCD", 102, 51, [2] * 100 + [50] * 2, 1.402e-2),
        ("003_Simulation", 53, 2, [2] * 51 + [100] * 2, 1e-3),
    ],
)
def test_descriptors_of_the_working_group_are_understood(name, levels, dark, images, longest):
    file = DATA / f"EMVA1288_ReferenceSet_{name}_12Bit_descriptor.txt"
    if not file.is_file():
        pytest.skip(f"no {file.name} in {DATA}: set NEUSEE_EMVA1288")
    said = parsed_descriptor(file)
    assert (said.bits, said.shape) == (12, (480, 640))
    assert (len(said.levels), sum(level.photons == 0 for level in said.levels)) == (levels, dark)
    assert sorted(len(level.images) for level in said.levels) == images
    assert [level.photons > 0 for level in said.series] == [True, False]
    assert len(said.transfer) == levels - 2
    assert max(level.exposure for level in said.levels) == pytest.approx(longest, rel=1e-12)
    with pytest.raises(ValidationError, match=r"descriptor\.txt:\d+: no such image: "):
        descriptor.params.model_validate({"file": str(file)})
