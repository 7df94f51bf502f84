"""A folder of photographs: list_photographs in one order, cut by the seed alone, what is broken
said.
"""

import numpy as np
import pytest
import torch
from PIL import Image

from neusee.nodes.scene import choose_photograph, crop_photograph, list_photographs, photograph


@pytest.fixture
def folder(tmp_path):
    rng = np.random.default_rng(1)
    for name, size in (
        ("b/two.png", (30, 40)),
        ("a.JPG", (50, 24)),
        ("b/.hidden.png", (8, 8)),
        ("c.png", (20, 20)),
    ):
        path = tmp_path / name
        path.parent.mkdir(exist_ok=True)
        image = Image.fromarray(rng.integers(0, 256, (*size, 3), dtype=np.uint8))
        image.save(path, "JPEG" if name.endswith("JPG") else "PNG")
    (tmp_path / "notes.txt").write_text("not a picture")
    return tmp_path


def test_photographs_are_listed_in_the_order_of_their_paths_and_broken_ones_with_the_reason(folder):
    (folder / "cut.png").write_bytes((folder / "c.png").read_bytes()[:-30])
    (folder / "cut.jpg").write_bytes((folder / "a.JPG").read_bytes()[:-30])
    (folder / "empty.png").touch()
    Image.new("RGBA", (9, 9)).save(folder / "clear.png")
    Image.new("RGB", (9, 9)).save(folder / "web.webp")
    paths, broken = list_photographs(folder)
    assert [p.relative_to(folder).as_posix() for p in paths] == ["a.JPG", "b/two.png", "c.png"]
    said = {path.name: reason for path, reason in broken}
    assert sorted(said) == ["clear.png", "cut.jpg", "cut.png", "empty.png", "web.webp"]
    assert "truncated" in said["cut.png"]
    assert "stops before its end" in said["cut.jpg"]
    assert "transparency" in said["clear.png"]
    assert "WEBP" in said["web.webp"]


def test_a_crop_is_a_part_of_the_photograph_as_the_scene_step_reads_it(folder):
    path = folder / "b" / "two.png"
    whole = photograph(file=path)
    part = crop_photograph(path, (12, 16), 5, 3)
    places = whole.unfold(1, 12, 1).unfold(2, 16, 1).permute(1, 2, 0, 3, 4)
    assert (places == part).flatten(2).all(-1).sum() == 1


def test_crops_are_the_same_in_any_order_and_differ_by_seed_and_index(folder):
    path = folder / "b" / "two.png"
    first = {i: crop_photograph(path, (8, 8), 5, i) for i in range(6)}
    for i in reversed(range(6)):
        assert torch.equal(crop_photograph(path, (8, 8), 5, i), first[i])
    others = [
        crop_photograph(path, (8, 8), 6, 0),
        crop_photograph(path, (8, 8), 5, (1, 0)),
        *list(first.values())[1:],
    ]
    assert not any(torch.equal(first[0], x) for x in others)


def test_a_photograph_that_is_too_small_is_enlarged_until_it_covers_the_scene(folder):
    part = crop_photograph(folder / "c.png", (24, 40), 1, 1)
    assert part.shape == (3, 24, 40)
    assert part.is_contiguous()
    assert part.min() >= 0.0


def test_scenes_are_all_photographs_before_any_comes_again(folder):
    paths, _ = list_photographs(folder)
    order = [choose_photograph(paths, 7, i) for i in range(6)]
    assert set(order[:3]) == set(paths)
    assert order[3:] == order[:3]
