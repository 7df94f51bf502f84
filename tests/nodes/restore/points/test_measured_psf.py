"""The PSF from frames of point sources, against a camera in NumPy whose PSF is known in closed
form.
"""

import numpy as np
import pytest
import torch

from neusee.nodes import ParameterError
from neusee.nodes.restore import _measured_psf, _point_frames, measured_psf
from tests.nodes.restore.points.independent_camera import CAMERA, centred, numbers, place_in, points

TRIPLE = torch.ones(3, 5)


def measure(folder, shape, window, zones=(1, 1), draws=24, **other):
    given = {**CAMERA, **other}
    seed = torch.Generator().manual_seed(1)
    files = tuple(sorted(folder.iterdir()))
    return measured_psf(
        TRIPLE, files=files, window=window, zones=zones, draws=draws, shape=shape, rng=seed, **given
    )


def beside(place, rng):
    return tuple(c + rng.uniform(-0.5, 0.5) for c in place)


def misfit(found, zone, truth):
    return ((found.kernels[zone].numpy() - truth) / found.deviation[zone].numpy()) ** 2


@pytest.fixture(scope="module")
def one_zone(tmp_path_factory):
    """One point in each of six frames: short exposures, and exposures five times as long with a
    clipped core.
    """
    folder, rng, shape = tmp_path_factory.mktemp("points"), np.random.default_rng(4), (44, 46)
    for number in range(6):
        long = number % 2
        np.save(
            folder / f"p{number}.npy",
            points(rng, shape, [beside((22, 23), rng)], [6e5 if long else 1e5]),
        )
    return folder, shape, measure(folder, shape, (15, 15))


def test_a_point_on_the_axis_gives_the_psf_within_its_error(one_zone):
    _, shape, found = one_zone
    wrong = misfit(found, (0, 0), centred(place_in((22, 23), shape), (15, 15)))
    assert 0.6 < wrong.mean() < 1.6, wrong.mean()
    assert float(found.fit.min()) > 0.85
    assert float(found.fit.max()) < 1.15
    torch.testing.assert_close(found.kernels.sum((-2, -1)), torch.ones(1, 1, 3).double())


def test_a_long_exposure_tells_of_the_wings_and_not_of_the_core(one_zone, tmp_path):
    folder, shape, found = one_zone
    for number in (0, 2, 4):
        (tmp_path / f"p{number}.npy").write_bytes((folder / f"p{number}.npy").read_bytes())
    short = measure(tmp_path, shape, (15, 15))
    ratio = (found.deviation / short.deviation)[0, 0].square().mean(0).sqrt()
    assert float(ratio[:2].mean()) < 0.6  # six times the light in the wings
    assert float(ratio[7, 7]) > 0.6  # where the long ones are clipped


def test_points_are_where_they_were_drawn(tmp_path):
    rng, shape = np.random.default_rng(0), (60, 100)
    places = [(20.3, 25.4), (38.7, 71.2)]
    np.save(tmp_path / "p.npy", points(rng, shape, places, [1e5, 4e4], lobe=0.0))
    found = measure(tmp_path, shape, (11, 11), draws=4).places.numpy()
    apart = np.array(places) - np.array(places)[0]
    np.testing.assert_allclose(found[:, 1:3] - found[0, 1:3], apart, atol=0.05)
    np.testing.assert_allclose(found[0, 3] / found[1, 3], 2.5, rtol=0.02)


def test_dark_frames_take_the_place_of_the_offset_and_hot_pixels_are_no_points(tmp_path):
    rng, shape = np.random.default_rng(1), (44, 44)
    pattern = rng.uniform(0, 40, (3, *shape))
    # a hot pixel alone, and a warm one in the window
    pattern[:, 5, 5], pattern[:, 22, 25] = 5000, 900
    for number in range(4):
        frame = points(rng, shape, [beside((22, 22), rng)], [1.2e5], dark=pattern)
        np.save(tmp_path / f"p{number}.npy", frame)
        np.save(tmp_path / f"dark{number}.npy", numbers(np.zeros((3, *shape)), rng, pattern))
    found = measure(tmp_path, shape, (11, 11))
    truth = centred(place_in((22, 22), shape), (11, 11))
    assert len(found.places) == 4
    assert misfit(found, (0, 0), truth).mean() < 1.8
    alone = tuple(sorted(tmp_path.glob("p*.npy")))
    seed = torch.Generator().manual_seed(1)
    without = measured_psf(TRIPLE, files=alone, window=(11, 11), shape=shape, rng=seed, **CAMERA)
    near, nearer = (
        abs(x.kernels[0, 0].numpy() - truth)[:, 4:7, 7:10].mean() for x in (without, found)
    )
    assert near > 2 * nearer


def test_a_psf_too_sharp_for_the_pixels_is_said_by_chi_square(tmp_path):
    rng, shape = np.random.default_rng(2), (40, 40)
    y, x = np.indices(shape)
    for number in range(5):
        place = beside((20, 20), rng)
        near = np.maximum(abs(y - place[0]), abs(x - place[1]))
        light = 1.5e4 * np.exp(-(near**2) / 0.9) + 5.0
        np.save(tmp_path / f"p{number}.npy", numbers(np.stack([light] * 3), rng))
    found = measure(tmp_path, shape, (9, 9), draws=8)
    assert float(found.fit.max()) > 1.5
    assert not all(check.ok for check in measured_psf.hooks.check(found))


def two_zones(folder, places, frames, lobe=0.0, **other):
    """Measure two zones beside one another, of 50 x 100 pixels together, from one point in each
    of them.
    """
    rng = np.random.default_rng(0)
    for number in range(frames):
        beside_them = [tuple(c + rng.uniform(-0.3, 0.3) for c in place) for place in places]
        np.save(
            folder / f"p{number}.npy", points(rng, (50, 100), beside_them, [1e5, 1e5], lobe=lobe)
        )
    return measure(folder, (50, 100), zones=(1, 2), **other)


@pytest.mark.parametrize(("away", "good"), [(25, True), (4, False)])
def test_a_zone_whose_points_lie_far_from_its_middle_is_named_with_the_inflation_of_its_variance(
    tmp_path, away, good
):
    """The nodes are in the columns 24.5 and 74.5. For two points the numbers are those of two
    equations.
    """
    found = two_zones(
        tmp_path, [(10.0, 49.5 - away), (38.0, 49.5 + away)], 2, window=(7, 7), draws=4
    )
    whole = found.places[:, 2].numpy().round()
    right = np.clip((whole - 24.5) / 50, 0, 1)
    normal = np.einsum("pi,pj->ij", *[np.stack([1 - right, right], 1)] * 2)
    inverse = np.linalg.inv(normal)
    np.testing.assert_allclose(found.support[0].numpy(), 1 / inverse.diagonal(), rtol=1e-6)
    np.testing.assert_allclose(
        found.inflation[0].numpy(), inverse.diagonal() * normal.diagonal(), rtol=1e-6
    )
    (check,) = (each for each in measured_psf.hooks.check(found) if "points or more" in each.text)
    assert check.ok == good
    assert ("in zone (1, " in check.text) != good


@pytest.mark.slow
@pytest.mark.parametrize("frames", [2, 5])
def test_points_that_tell_two_psfs_at_once_tell_them_within_their_error(tmp_path, frames):
    """The PSFs must stay in their middles: added, those that lie beside one another make a wider
    one.
    """
    found = two_zones(tmp_path, [(24.5, 38.5), (24.5, 60.5)], frames, window=(11, 11))
    assert 1.5 < float(found.inflation.max()) < 3
    truth = centred((0.0, 0.0), (11, 11), lobe=0.0)
    for zone in (0, 1):
        wrong = misfit(found, (0, zone), truth)
        assert 0.6 < wrong.mean() < 1.6, wrong.mean()
        assert wrong[:, 3:8, 3:8].mean() < 2


@pytest.mark.slow
def test_the_psf_by_field_agrees_within_its_error_at_every_node(tmp_path):
    """Windows overlap, the long exposures are clipped; 1.09 is expected of 24 draws, for a
    deviation is drawn too.
    """
    rng, shape, window, zones = np.random.default_rng(3), (140, 140), (25, 25), (2, 2)
    grid = [(y, x) for y in (34.5, 104.5) for x in (34.5, 104.5)]
    for number in range(8):
        signals = [6e5 if number % 2 else 6e4] * 4
        np.save(
            tmp_path / f"p{number}.npy", points(rng, shape, [beside(p, rng) for p in grid], signals)
        )
    found, core = measure(tmp_path, shape, window, zones), []
    for number, place in enumerate(grid):
        wrong = misfit(found, divmod(number, 2), centred(place_in(place, shape), window))
        assert 0.8 < wrong.mean() < 1.5, (place, wrong.mean())
        core.append(wrong[:, 10:15, 10:15].mean())
    # few directions in 25 pixels: 0.99 to 1.43 on average over six such sets
    assert 0.6 < np.mean(core) < 1.8, core
    apart = misfit(found, (0, 0), centred(place_in(grid[1], shape), window)).mean()
    assert apart > 3  # the PSFs of two nodes are told apart
    share = 1 - np.array(
        [centred(place_in(p, shape), (95, 95))[:, 35:60, 35:60].sum((1, 2)) for p in grid]
    )
    assert (share.max(0) < found.outside.numpy()).all()


# --- the model ------------------------------------------------------------------------------------


def test_shifting_is_exact_for_smooth_pictures_and_has_the_right_slope():
    at = np.arange(41) - 20.0
    offset = torch.tensor([0.37, -0.42, 2.3], dtype=torch.float64)
    value, slope = _point_frames.shifting(offset, 41)
    wave = np.exp(-(at**2) / 4.5)
    for row, d in enumerate(offset.tolist()):
        expected = np.exp(-((at - d) ** 2) / 4.5)
        np.testing.assert_allclose(value[row].numpy() @ wave, expected, atol=2e-4)
        np.testing.assert_allclose(slope[row].numpy() @ wave, expected * (at - d) / 2.25, atol=1e-3)
    small = 1e-6
    ahead, behind = (_point_frames.shifting(offset + step, 41)[0] for step in (small, -small))
    torch.testing.assert_close((ahead - behind) / (2 * small), slope, rtol=0, atol=1e-6)


def test_the_slope_is_the_transpose_of_the_change_and_the_change_that_of_the_model(one_zone):
    folder, shape, _ = one_zone
    seen = _point_frames.read_points(
        tuple(sorted(folder.iterdir())), (15, 15), tuple(CAMERA[n] for n in _ORDER)
    )
    share = _point_frames.node_weights(seen.middle, shape, (2, 2))
    draw = torch.Generator().manual_seed(0)
    like = _point_frames.State(
        torch.rand(4, 3, 15, 15), torch.rand(6, 3), torch.rand(6, 2) - 0.5, torch.rand(6, 3)
    )
    state, by = (
        _point_frames.State(*(torch.rand(x.shape, generator=draw).double() for x in like))
        for _ in range(2)
    )
    near = _point_frames.linear(seen, state, share)
    pixels = torch.randn(seen.light.shape, generator=draw).double()
    there, back = float((near.change(by) * pixels).sum()), float(near.slope(pixels).dot(by))
    assert abs(there - back) < 1e-10 * abs(there)
    small = 1e-6
    ahead, behind = (
        _point_frames.linear(seen, moved, share).model(moved.background)
        for moved in (state.plus(by, small), state.plus(by, -small))
    )
    torch.testing.assert_close(
        (ahead - behind) / (2 * small), near.change(by), rtol=1e-5, atol=1e-5
    )


_ORDER = ("gain", "offset", "full_well", "bits", "read_noise")


def test_weights_of_nodes_are_linear_between_nodes_and_add_up_to_one():
    weights = _point_frames.hats(torch.arange(12), 12, 3)  # nodes at 1.5, 5.5, 9.5
    torch.testing.assert_close(weights.sum(1), torch.ones(12).double())
    middles = torch.tensor([1.5, 5.5, 9.5], dtype=torch.float64)
    torch.testing.assert_close(weights @ middles, torch.arange(12).double().clamp(1.5, 9.5))


def test_the_centre_does_not_depend_on_where_the_points_were():
    kernel = torch.tensor(centred((0.2, -0.1), (25, 25)))[None]
    down, _ = _point_frames.shifting(torch.tensor([0.4]).double(), 25)
    torch.testing.assert_close(
        _measured_psf.gauged(down[:, None] @ kernel), kernel, rtol=0, atol=2e-4
    )


# --- what is refused ------------------------------------------------------------------------------


def refused(folder, **other):
    given = {"window": (11, 11), "zones": (1, 1), "shape": (40, 40), "draws": 4, **CAMERA, **other}
    files = tuple(sorted(folder.iterdir()))
    with pytest.raises(ParameterError) as error:
        measured_psf.hooks.preflight(responses=TRIPLE, files=files, **given)
    return error.value.parameter, str(error.value)


def test_every_bad_frame_is_named(tmp_path):
    rng = np.random.default_rng(0)
    np.save(tmp_path / "a.npy", points(rng, (40, 40), [(20, 20)], [5e4]))
    np.save(tmp_path / "b.npy", points(rng, (30, 40), [(20, 20)], [5e4]))
    np.save(tmp_path / "c.npy", points(rng, (40, 40), [(20, 20)], [5e4])[0])
    (tmp_path / "d.png").write_text("no picture")
    parameter, text = refused(tmp_path)
    assert parameter == "files"
    assert text.startswith("3 of 4 frames cannot be used: b.npy has 30 x 40 pixels")
    assert "c.npy has one channel" in text
    assert "d.png is no PNG file" in text


def test_frames_without_points_and_points_without_room_are_named(tmp_path):
    rng = np.random.default_rng(0)
    np.save(tmp_path / "a.npy", points(rng, (40, 40), [], []))
    np.save(tmp_path / "b.npy", points(rng, (40, 40), [(20, 20)], [5e4]))
    _, text = refused(tmp_path)
    assert "1 of 2 frames cannot be used: a.npy shows no point source" in text
    (tmp_path / "a.npy").unlink()
    _, text = refused(tmp_path, window=(39, 39))
    assert "b.npy has 79 pixels beyond the windows of its 1 points" in text


def test_zones_without_a_point_that_is_not_saturated_are_named(tmp_path):
    rng = np.random.default_rng(0)
    np.save(tmp_path / "a.npy", points(rng, (40, 40), [(10, 10), (30, 30)], [5e4, 9e5]))
    parameter, text = refused(tmp_path, zones=(2, 2))
    assert parameter == "zones"
    assert text.startswith(
        "3 of 2 x 2 zones have no point with an unsaturated core, (row, column) (1, 2), (2, 1),"
        " (2, 2)"
    )


def test_no_frames_and_dark_frames_alone_are_refused(tmp_path):
    given = {"window": (11, 11), "zones": (1, 1), "shape": (40, 40), "draws": 4, **CAMERA}
    with pytest.raises(ParameterError, match="give the folder"):
        measured_psf.hooks.preflight(responses=TRIPLE, files=None, **given)
    np.save(tmp_path / "dark.npy", points(np.random.default_rng(0), (40, 40), [], []))
    assert "only names that begin with dark" in refused(tmp_path)[1]


def test_a_core_that_is_saturated_in_every_frame_is_refused(tmp_path):
    rng = np.random.default_rng(0)
    frame = points(rng, (40, 40), [(20, 20)], [1e5])
    # a pixel that the point does not fill, in the window of the only point
    frame[:, 18, 18] = 65535
    frame[:, 22:24, 22:24] = int((CAMERA["full_well"]) * CAMERA["gain"])
    np.save(tmp_path / "a.npy", frame)
    with pytest.raises(
        ValueError, match="pixels of the PSF are saturated, or beyond the edge, in every frame"
    ):
        measure(tmp_path, (40, 40), (11, 11))
