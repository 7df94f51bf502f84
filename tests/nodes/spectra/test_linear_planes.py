"""The components of a clipped linear lift without a search: as few as allowed, and every stated
error is a bound.
"""

import pytest
import torch

from neusee.nodes.spectra import _lift, _low_rank_cube, bands, lift_lmmse, lift_lmmse_mixture

SCENE = bands(start=400e-9, stop=700e-9, count=31)


def drawn(seed, negative=0.05):
    """A picture of three channels, and a matrix to 12 bands of which some pixels are negative."""
    g = torch.Generator().manual_seed(seed)
    picture = torch.rand(3, 5000, generator=g) * torch.logspace(0, -seed % 3, 3)[:, None]
    matrix = torch.rand(12, 3, dtype=torch.float64, generator=g) - negative
    return picture, matrix


@pytest.mark.parametrize("within", [1e-1, 3e-2, 1e-2, 1e-3])
@pytest.mark.parametrize("seed", range(6))
def test_stated_errors_are_bounds_and_not_loose(seed, within):
    picture, matrix = drawn(seed)
    cube = (matrix @ picture.double()).clamp_min(0)
    found = _low_rank_cube.linear_planes(picture, matrix, within)
    if found is None:
        assert within < 3e-2, "what is clipped is small in every draw"
        return
    assert float(found.residual_rms[-1].max()) <= within * float(cube.max()) * (1 + 1e-6)
    off = cube - found.basis @ found.planes.double()
    assert bool((off.abs().amax(0) <= found.residual_map.double()).all())
    for k in range(len(found.planes) + 1):
        left = cube - found.basis[:, :k] @ found.planes[:k].double()
        assert bool((left.abs().amax(1) <= found.residual_max[k] * (1 + 1e-6)).all())
        rms = left.square().mean(1).sqrt()
        assert bool((rms <= found.residual_rms[k] * (1 + 1e-6)).all())
        assert float(found.residual_rms[k].max()) <= 1.5 * float(rms.max()) + 1e-5 * float(
            cube.max()
        )


def test_a_looser_error_takes_no_more_components():
    picture, matrix = drawn(1, negative=0.0)
    counts = [
        len(_low_rank_cube.linear_planes(picture, matrix, within).planes)
        for within in (1e-4, 1e-2, 1e-1, 0.5)
    ]
    assert counts[0] == 3
    assert counts == sorted(counts, reverse=True)
    assert counts[-1] == 1


@pytest.mark.parametrize("within", [1e-6, 1e-5])
def test_what_is_clipped_more_than_allowed_needs_a_search(within):
    assert _low_rank_cube.linear_planes(*drawn(0, negative=0.3), within) is None
    assert _low_rank_cube.linear_planes(drawn(0)[0].double(), drawn(0)[1], 1e-2) is None


@pytest.mark.parametrize("within", [1e-2, 1e-3])
def test_a_lift_uses_them_and_is_the_same_cube_within_its_error(within, monkeypatch):
    rgb = torch.rand(3, 64, 64, generator=torch.Generator().manual_seed(3)) * 0.5 + 0.2
    rgb[:, 0, 0] = torch.tensor([0.0, 0.1, 0.0])  # saturated green has negative light
    monkeypatch.setattr(_lift, "few_planes", None)
    found = lift_lmmse_mixture(rgb, SCENE, within=within)
    cube = lift_lmmse(rgb, SCENE)
    off = torch.tensordot(found.basis, found.planes.double(), 1) - cube
    assert float(off.square().mean((1, 2)).sqrt().max()) <= within * float(cube.max())
    assert float(off[:, 0, 0].abs().max()) > 1e-3
    assert bool((off.abs().amax(0) <= found.residual_map * (1 + 1e-5) + 1e-6).all())
