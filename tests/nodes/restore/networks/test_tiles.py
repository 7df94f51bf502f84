"""A picture in tiles: the same where a network sees no farther than a pixel, without seams where
it does.
"""

import pytest
import torch
from hypothesis import given, settings
from hypothesis import strategies as st
from safetensors.torch import save_file
from torch.nn import functional as F
from torch.testing import assert_close

from neusee.nodes import restore
from neusee.nodes.resampling import resize
from neusee.nodes.restore import NAFNet, start_network
from neusee.nodes.restore.networks import tiled


def seeded():
    return torch.Generator().manual_seed(1)


sides = st.integers(1, 150)


@settings(deadline=None)
@given(sides, sides, st.integers(32, 64))
def test_what_looks_at_single_pixels_does_not_notice_tiles(y, x, side):
    picture = torch.rand(1, 3, y, x, generator=seeded(), dtype=torch.float64)
    seen = []

    def change(part):
        seen.append(part.shape[-2:])
        return part.square() + 1

    assert_close(tiled(change, picture, side), picture.square() + 1, rtol=1e-12, atol=0)
    assert {tuple(size) for size in seen} == {(min(y, side), min(x, side))}


def test_as_few_tiles_as_overlap_by_a_quarter():
    seen = []
    tiled(lambda part: seen.append(part) or part, torch.zeros(1, 3, 640, 128), 128)
    assert len(seen) == 7  # 640 = 128 + 6 x 85.3; of 5 or 6 some would share less than 32 rows


def test_no_seam_where_a_tile_does_not_know_its_edge():
    """A blur that takes what lies beyond a tile for dark is 0 there, and counts for nothing."""
    picture = torch.ones(1, 1, 200, 200, dtype=torch.float64)
    kernel = torch.full((1, 1, 5, 5), 1 / 25, dtype=torch.float64)
    found = tiled(lambda part: F.conv2d(part, kernel, padding=2), picture, 64)[0, 0, 4:-4, 4:-4]
    whole = F.conv2d(picture, kernel, padding=2)[0, 0, 4:-4, 4:-4]
    assert float(whole.min()) == pytest.approx(1)
    assert float((found - whole).abs().max()) < 0.04  # beside 0.4 at the edge of a tile


def test_a_node_restores_a_large_picture_in_tiles(tmp_path):
    net = start_network(lambda: NAFNet(4), seeded())
    file = tmp_path / "net.safetensors"
    save_file(net.state_dict(), file)
    picture = torch.rand(3, 80, 40, generator=seeded())
    whole, parts = (restore.nafnet(picture, weights=file, width=4, tile=tile) for tile in (80, 48))
    assert torch.equal(whole, restore.nafnet(picture, weights=file, width=4))
    assert_close(
        parts[:, :24],
        restore.nafnet(picture[:, :48], weights=file, width=4)[:, :24],
        rtol=1e-5,
        atol=1e-6,
    )
    assert not torch.equal(parts, whole)


def test_a_node_restores_a_picture_made_smaller(tmp_path):
    net = start_network(lambda: NAFNet(4), seeded())
    file = tmp_path / "net.safetensors"
    save_file(net.state_dict(), file)
    picture = torch.rand(3, 70, 41, generator=seeded())
    found = restore.nafnet(picture, weights=file, width=4, reduce=4)
    with torch.no_grad():
        wanted = resize(net(resize(picture[None], 18, 11)), 70, 41)[0]
    assert_close(found, wanted, rtol=1e-6, atol=1e-7)
    small = resize(picture[None], 18, 11)
    kept = restore.nafnet(picture, weights=file, width=4, reduce=4, detail=True)
    with torch.no_grad():
        assert_close(
            kept, (picture[None] + resize(net(small) - small, 70, 41))[0], rtol=1e-6, atol=1e-6
        )


def test_detail_changes_nothing_where_nothing_is_made_smaller(tmp_path):
    file = tmp_path / "net.safetensors"
    save_file(start_network(lambda: NAFNet(4), seeded()).state_dict(), file)
    picture = torch.rand(3, 40, 41, generator=seeded())
    given = {"weights": file, "width": 4}
    assert torch.equal(
        restore.nafnet(picture, **given, detail=True), restore.nafnet(picture, **given)
    )
