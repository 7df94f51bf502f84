"""Pictures with known spectra: blacks that no one sees, reflectances in [0, 1], files, and one
rendering for all.
"""

import csv
from pathlib import Path

import numpy as np
import pytest
import torch

from neusee.nodes import ParameterError
from neusee.nodes.spectra import (
    _plausible_spectra,
    bands,
    grain,
    leaves,
    lift_lmmse,
    lift_matrix,
    lift_pictures,
    metamers,
    paints,
    reflectances,
    render,
    start_mst_plus_plus,
    to_srgb,
)

NM = 1e-9
SCENE = bands(start=400 * NM, stop=700 * NM, count=31)
VRHEL = Path(__file__).parents[3] / "../shared/data/spectra/sur_vrhel.mat"


def generator(seed=0):
    return torch.Generator().manual_seed(seed)


@pytest.fixture(scope="module")
def measured():
    return reflectances(SCENE)


def drawn(measured, seed=0, **how):
    return metamers(measured, SCENE, rng=generator(seed), **how)


def test_the_sets_of_colour_science_are_all_there(measured):
    assert measured.shape == (102 + 99 + 15, 31)
    assert measured.dtype == torch.float64
    assert float(measured.min()) >= 0
    assert float(measured.max()) <= 1
    chart = torch.cat([paint.at(SCENE.centres) for paint in paints()])
    assert torch.equal(reflectances(SCENE, sets=("charts",)), chart)


def test_a_metameric_black_has_no_colour(measured):
    black = _plausible_spectra.metameric_blacks(measured, measured, SCENE)
    assert float(black.abs().max()) > 0.05
    assert float((black @ to_srgb(SCENE.centres).T).abs().max()) < 1e-12


@pytest.mark.parametrize("strength", [0.5, 2.0, 10.0])
def test_blacks_change_the_spectrum_and_not_the_colour(measured, strength):
    plain, other = (
        drawn(measured, count=400, blacks=0.0),
        drawn(measured, count=400, blacks=strength),
    )
    colour = render(plain.T[..., None], SCENE)
    off = (render(other.T[..., None], SCENE) - colour).abs()
    assert float((off / colour.abs().amax(0)).max()) < 1e-6
    assert float((other - plain).abs().amax(1).median()) > 0.01
    assert float(other.min()) >= 0
    assert float(other.max()) <= 1


def test_a_spectrum_at_the_rim_has_no_room_and_stays():
    known = torch.rand(20, 31, dtype=torch.float64, generator=generator())
    known[:10] = 1.0
    found = metamers(
        known, SCENE, count=200, mixed=1, thickness=(1.0, 1.0), blacks=5.0, rng=generator()
    )
    white = (found > 1 - 1e-9).all(1)
    assert 0.2 < float(white.double().mean()) < 0.8
    assert float(found.min()) >= 0
    assert float(found.max()) <= 1


def test_one_layer_of_one_measured_spectrum_is_that_spectrum(measured):
    found = drawn(measured, count=50, mixed=1, thickness=(1.0, 1.0), blacks=0.0)
    nearest = torch.cdist(found, measured).amin(1)
    assert float(nearest.max()) < 1e-5


@pytest.mark.parametrize("shape", [(1, 1), (8, 8), (17, 9)])
def test_leaves_of_any_size_are_reflectances(measured, shape):
    for seed in range(6):
        cube = leaves(drawn(measured, seed), SCENE, shape=shape, daylights=0.5, rng=generator(seed))
        assert cube.shape == (31, *shape)
        assert cube.dtype == torch.float32
        assert float(cube.min()) >= 0
        assert float(cube.max()) <= 1


def test_a_picture_is_that_of_its_number_alone(measured):
    torch.manual_seed(1)
    before = torch.get_rng_state()
    one, same, other = (
        leaves(drawn(measured), SCENE, shape=(16, 16), rng=generator(s)) for s in (3, 3, 4)
    )
    assert torch.equal(one, same)
    assert not torch.equal(one, other)
    assert torch.equal(torch.get_rng_state(), before)


def test_leaves_hold_their_own_spectra_at_scales_of_all_kinds(measured):
    """Without texture, shade and daylights a pixel inside a leaf is the leaf's spectrum,
    darkened.
    """
    spectra = drawn(measured)
    how = {"texture": 0.0, "shade": 0.0, "daylights": 0.0, "darkest": 1.0}
    cube = leaves(spectra, SCENE, shape=(64, 64), rng=generator(2), **how).flatten(1).T.double()
    apart = torch.cdist(cube, spectra)
    assert float((apart.amin(1) < 1e-6).double().mean()) > 0.6
    sizes = torch.bincount(apart.argmin(1), minlength=len(spectra))
    assert int(sizes.max()) > 30 * max(1, int(sizes[sizes > 0].min()))


def test_another_daylight_moves_white_along_the_daylights():
    white = torch.ones(4, 31, dtype=torch.float64)
    how = {"texture": 0.0, "shade": 0.0, "darkest": 1.0, "shape": (2, 2)}
    seen = [
        render(leaves(white, SCENE, daylights=1.0, rng=generator(s), **how), SCENE)[:, 0, 0]
        for s in range(20)
    ]
    warmth = [float(c[0] / c[2]) for c in seen]
    assert min(warmth) < 0.8
    assert max(warmth) > 1.3
    same = render(leaves(white, SCENE, daylights=0.0, rng=generator(), **how), SCENE)
    torch.testing.assert_close(same, torch.ones(3, 2, 2))


def test_rendering_is_the_one_that_the_lifts_undo(measured):
    cube = leaves(drawn(measured), SCENE, shape=(16, 16), rng=generator())
    colour = render(cube, SCENE)
    torch.testing.assert_close(
        colour.double(), render.hooks.reference(cube, SCENE), rtol=render.rtol, atol=1e-6
    )
    again = render(lift_lmmse(colour.double(), SCENE), SCENE)
    lit = lift_lmmse(colour.double(), SCENE).amin(0) > 0
    assert float((again - colour)[:, lit].abs().max()) < 1e-6
    torch.testing.assert_close(render(torch.stack([cube, cube]), SCENE)[1], colour)
    light = cube[:, :2, :2].double().requires_grad_()
    assert torch.autograd.gradcheck(lambda x: render(x, SCENE), (light,))


def test_grain_has_the_deviation_that_is_asked_for():
    dark, white = torch.zeros(3, 200, 200), torch.ones(3, 200, 200)
    assert float(grain(dark, read=0.01, shot=0.02, rng=generator()).std()) == pytest.approx(
        0.01, rel=0.02
    )
    bright = grain(white, read=0.01, shot=0.02, rng=generator()) - white
    assert float(bright.std()) == pytest.approx((0.01**2 + 0.02**2) ** 0.5, rel=0.02)
    assert torch.equal(grain(white, read=0.0, shot=0.0, rng=generator()), white)


def test_a_network_starts_at_the_linear_estimate(measured):

    linear = lift_matrix(measured, SCENE.centres)
    net = start_mst_plus_plus(generator(), linear)
    rgb = torch.rand(2, 3, 8, 8, generator=generator(1))
    low, span = (
        rgb.amin((1, 2, 3), keepdim=True),
        rgb.amax((1, 2, 3), keepdim=True) - rgb.amin((1, 2, 3), keepdim=True),
    )
    wanted = torch.einsum("bc,ncyx->nbyx", linear.float(), (rgb - low) / span) * span + low
    torch.testing.assert_close(lift_pictures(net, rgb), wanted, rtol=1e-4, atol=1e-5)
    lift_pictures(net, rgb).square().sum().backward()
    assert float(net.conv_out.weight.grad.abs().max()) > 0


# --- files ----------------------------------------------------------------------------------------


def written(tmp_path, kind, wavelengths, values):
    path = tmp_path / f"mine.{kind}"
    if kind == "csv":
        with path.open("w", newline="") as file:
            rows = csv.writer(file)
            rows.writerow(["wavelength", *(f"paint {i}" for i in range(len(values)))])
            rows.writerows(
                [w, *column] for w, column in zip(wavelengths, np.asarray(values).T, strict=True)
            )
    elif kind == "npz":
        np.savez(path, wavelengths=wavelengths, reflectances=values)
    else:
        from scipy.io import savemat

        step = wavelengths[1] - wavelengths[0]
        savemat(
            path,
            {
                "S_mine": [[wavelengths[0], step, len(wavelengths)]],
                "sur_mine": np.asarray(values).T,
            },
        )
    return path


@pytest.mark.parametrize("kind", ["csv", "npz", "mat"])
def test_own_files_join_the_sets(tmp_path, measured, kind):
    wavelengths = np.arange(390.0, 731.0, 10.0)
    values = [np.linspace(0.1, 0.9, len(wavelengths)), np.full(len(wavelengths), 0.5)]
    path = written(tmp_path, kind, wavelengths, values)
    assert reflectances.hooks.preflight(files=(path,)) == []
    found = reflectances(SCENE, files=(path,))
    assert found.shape == (len(measured) + 2, 31)
    np.testing.assert_allclose(
        found[-2], np.interp(np.arange(400, 701, 10), wavelengths, values[0]), atol=1e-12
    )
    alone = reflectances(SCENE, sets=(), files=(path,))
    assert torch.equal(alone, found[-2:])


@pytest.mark.parametrize(
    ("values", "wavelengths", "words"),
    [
        ([[50.0, 60.0, 70.0]], [400.0, 550.0, 700.0], "1 for white, not 100"),
        ([[0.5, float("nan"), 0.7]], [400.0, 550.0, 700.0], "finite"),
        ([[0.5, 0.6, 0.7]], [700.0, 550.0, 400.0], "rising"),
        ([[0.5, 0.6, 0.7]], [0.4, 0.55, 0.7], "in nm"),
    ],
)
def test_a_file_that_holds_no_reflectances_is_refused_before_the_run(
    tmp_path, values, wavelengths, words
):
    path = written(tmp_path, "csv", wavelengths, values)
    with pytest.raises(ParameterError, match=words) as error:
        reflectances.hooks.preflight(files=(path,))
    assert error.value.parameter == "files"


@pytest.mark.parametrize(
    ("name", "text"), [("a.csv", "x,y\n1"), ("b.npz", "no"), ("c.mat", "no"), ("d.txt", "400 0.5")]
)
def test_a_file_of_another_kind_is_refused(tmp_path, name, text):
    path = tmp_path / name
    path.write_text(text)
    with pytest.raises(ParameterError, match=r"\.npz \(wavelengths, reflectances\)"):
        reflectances.hooks.preflight(files=(path,))


@pytest.mark.parametrize("kind", ["npz", "mat"])
def test_complex_reflectances_are_refused_and_no_part_of_them_is_dropped(tmp_path, kind):
    from scipy.io import savemat

    path, values = tmp_path / f"mine.{kind}", np.full((2, 31), 0.5 + 0.2j)
    if kind == "npz":
        np.savez(path, wavelengths=np.linspace(400, 700, 31), reflectances=values)
    else:
        savemat(path, {"S_mine": [[400.0, 10.0, 31.0]], "sur_mine": values.T})
    with pytest.raises(
        ParameterError,
        match=rf"mine\.{kind} cannot be read as reflectances \(its values are complex",
    ):
        reflectances.hooks.preflight(sets=(), files=(path,))


def test_bands_beyond_a_file_and_nothing_at_all_are_refused(tmp_path):
    path = written(tmp_path, "csv", [450.0, 550.0, 700.0], [[0.5, 0.6, 0.7]])
    with pytest.raises(ValueError, match="holds 450 to 700 nm"):
        reflectances(SCENE, files=(path,))
    with pytest.raises(ParameterError, match="sets and files are both empty"):
        reflectances.hooks.preflight(sets=())
    with pytest.raises(ParameterError, match="exchange"):
        metamers.hooks.preflight(thickness=(2.0, 1.0))
    with pytest.raises(ValueError, match="at least four spectra of 31 bands"):
        metamers(torch.ones(3, 31), SCENE, rng=generator())
    with pytest.raises(ValueError, match=r"not \(leaf, band\) with 31 bands"):
        leaves(torch.ones(3, 30), SCENE, shape=(2, 2), rng=generator())
    with pytest.raises(ValueError, match=r"\(band, y, x\) with 31 bands"):
        render(torch.ones(3, 2, 2), SCENE)


@pytest.mark.skipif(not VRHEL.is_file(), reason="the measured spectra are not beside the project")
def test_a_file_of_the_psychtoolbox():
    found = reflectances(SCENE, sets=(), files=(VRHEL,))
    assert found.shape == (170, 31)
    assert reflectances.hooks.check(found, SCENE)[0].ok
