"""Spectral cubes: files, layouts, interpolation, what is refused; and spectral OpenEXR out and
in.
"""

import numpy as np
import pytest
import torch
from hypothesis import given, settings
from hypothesis import strategies as st

from neusee.nodes import ParameterError
from neusee.nodes.scene import hyperspectral, read_spectral, spectral_channels, write_spectral
from neusee.nodes.spectra import bands

NM = 1e-9


def ramp(lengths, y=3, x=2):
    """Reflectance that grows with wavelength: linear interpolation is exact."""
    grey = (np.asarray(lengths) - 400) / 400
    return np.broadcast_to(grey[:, None, None], (len(lengths), y, x)).copy()


def eleven(start=400, stop=700, count=11):
    return bands(start=start * NM, stop=stop * NM, count=count)


def npy(folder, array):
    np.save(folder / "c.npy", array)
    return folder / "c.npy"


def test_interpolates_linearly(tmp_path):
    path = npy(tmp_path, ramp(np.linspace(400, 700, 31)))
    wanted = eleven(405, 695, 7)
    result = hyperspectral(wanted, file=path, start=400 * NM, stop=700 * NM, layout="band y x")
    assert result.shape == (7, 3, 2)
    torch.testing.assert_close(
        result[:, 0, 0].double(), (wanted.centres / NM - 400) / 400, atol=1e-6, rtol=0
    )


def test_band_axis_is_last_unless_said(tmp_path):
    cube = np.random.default_rng(1).random((4, 5, 11))
    ends = {"start": 400 * NM, "stop": 700 * NM}
    one = hyperspectral(eleven(), file=npy(tmp_path, cube), **ends)
    two = hyperspectral(
        eleven(), file=npy(tmp_path, np.moveaxis(cube, -1, 0)), layout="band y x", **ends
    )
    assert torch.equal(one, two)
    np.testing.assert_allclose(one.numpy(), np.moveaxis(cube, -1, 0), atol=1e-7)


@pytest.mark.parametrize("kind", ["uint8", "uint16"])
def test_whole_numbers_scale_to_one(tmp_path, kind):
    top = np.iinfo(kind).max
    path = npy(tmp_path, np.full((2, 2, 3), top, kind))
    result = hyperspectral(eleven(count=3), file=path, start=400 * NM, stop=700 * NM)
    assert torch.equal(result, torch.ones(3, 2, 2))


def test_outside_the_file_is_refused_with_the_numbers(tmp_path):
    path = npy(tmp_path, np.ones((2, 2, 31)))
    with pytest.raises(ValueError, match=r"390 to 700 nm.*400 to 700 nm"):
        hyperspectral(eleven(390), file=path, start=400 * NM, stop=700 * NM)


def test_mat_files(tmp_path):
    io = pytest.importorskip("scipy.io")
    cube = np.random.default_rng(2).random((4, 5, 11))
    io.savemat(tmp_path / "c.mat", {"cube": cube, "note": np.ones((2, 2))})
    ends = {"start": 400 * NM, "stop": 700 * NM}
    assert hyperspectral.hooks.preflight(file=tmp_path / "c.mat", **ends) == []
    result = hyperspectral(eleven(), file=tmp_path / "c.mat", variable="cube", **ends)
    np.testing.assert_allclose(result.numpy(), np.moveaxis(cube, -1, 0), atol=1e-7)
    with pytest.raises(ParameterError, match=r"no variable 'cub'.*cube, note"):
        hyperspectral.hooks.preflight(file=tmp_path / "c.mat", variable="cub", **ends)
    with pytest.raises(ParameterError, match="three axes"):
        hyperspectral.hooks.preflight(file=tmp_path / "c.mat", variable="note", **ends)
    io.savemat(tmp_path / "two.mat", {"a": cube, "b": cube})
    with pytest.raises(ParameterError, match="2 cubes"):
        hyperspectral.hooks.preflight(file=tmp_path / "two.mat", **ends)


def test_refusals_before_the_run(tmp_path):
    path = npy(tmp_path, np.ones((2, 2, 3)))
    with pytest.raises(ParameterError, match="400 nm") as error:
        hyperspectral.hooks.preflight(file=path)
    assert error.value.parameter == "start"
    with pytest.raises(ParameterError):
        hyperspectral.hooks.preflight(file=path, start=700 * NM, stop=400 * NM)
    (tmp_path / "c.txt").write_text("1")
    (tmp_path / "bad.mat").write_text("no mat file at all, just text")
    for name, words in (("c.txt", ".mat, .npy or .exr"), ("bad.mat", "-v7")):
        with pytest.raises(ParameterError, match=words):
            hyperspectral.hooks.preflight(file=tmp_path / name, start=400 * NM, stop=700 * NM)
    with pytest.raises(ParameterError, match="complex"):
        hyperspectral.hooks.preflight(
            file=npy(tmp_path, np.ones((2, 2, 3), complex)), start=400 * NM, stop=700 * NM
        )


def test_a_complex_cube_of_matlab_is_refused_although_its_header_says_double(tmp_path):
    from scipy.io import savemat

    savemat(tmp_path / "a.mat", {"cube": np.full((2, 2, 3), 0.5 + 0.25j)})
    with pytest.raises(
        ParameterError, match=r"a\.mat holds complex values: save the cube as real numbers of light"
    ):
        hyperspectral.hooks.preflight(file=tmp_path / "a.mat", start=400 * NM, stop=700 * NM)


def test_values_that_are_not_finite_are_refused(tmp_path):
    path = npy(tmp_path, np.full((2, 2, 3), np.nan))
    with pytest.raises(ValueError, match="12 values"):
        hyperspectral(eleven(count=3), file=path, start=400 * NM, stop=700 * NM)


@settings(max_examples=25, deadline=None)
@given(
    count=st.integers(1, 40),
    y=st.integers(1, 9),
    x=st.integers(1, 9),
    kind=st.sampled_from(["emissive", "reflective"]),
)
def test_spectral_exr_comes_back_bit_for_bit(tmp_path_factory, count, y, x, kind):
    path = tmp_path_factory.mktemp("exr") / "s.exr"
    cube = torch.randn(count, y, x, generator=torch.Generator().manual_seed(count))
    centres = eleven(count=count).centres
    write_spectral(path, cube, centres, kind=kind, header={"comments": "a test"})
    again, found, header = read_spectral(path)
    assert torch.equal(again, cube)
    torch.testing.assert_close(found, centres, atol=1e-15, rtol=0)
    assert header["comments"] == "a test"
    assert header["spectralLayoutVersion"] == "1.0"


def test_names_follow_the_layout(tmp_path):
    OpenEXR = pytest.importorskip("OpenEXR")
    write_spectral(tmp_path / "s.exr", torch.ones(2, 1, 1), [550 * NM, 632.8 * NM])
    with OpenEXR.File(str(tmp_path / "s.exr"), separate_channels=True) as file:
        assert sorted(file.channels()) == ["S0.550,000000nm", "S0.632,800000nm"]


def test_reads_the_units_of_the_layout():
    names = ["S0.0,55um", "S0.5,45e14Hz", "S1.550,0nm", "R", "T.500,0nm", "S0.400,5nm"]
    found = spectral_channels(names)
    assert list(found.values()) == ["S0.400,5nm", "S0.0,55um", "S0.5,45e14Hz"]
    assert [round(w / NM, 3) for w in found] == [400.5, 550.0, 550.078]
    assert spectral_channels(["R", "G", "B"]) == {}


def test_spectral_exr_as_a_scene(tmp_path):
    known = eleven(count=31)
    cube = torch.rand(31, 4, 5, generator=torch.Generator().manual_seed(0))
    write_spectral(tmp_path / "s.exr", cube, known.centres, kind="reflective")
    assert hyperspectral.hooks.preflight(file=tmp_path / "s.exr") == []
    assert torch.equal(hyperspectral(known, file=tmp_path / "s.exr"), cube)
    assert "enlarged" in hyperspectral.hooks.preflight(file=tmp_path / "s.exr", shape=(8, 8))[0]
    assert hyperspectral.hooks.check(cube, known)[0].ok


def test_writing_refuses_what_does_not_fit(tmp_path):
    with pytest.raises(ValueError, match="2 bands"):
        write_spectral(tmp_path / "s.exr", torch.ones(3, 1, 1), [1e-7, 2e-7])
    with pytest.raises(ValueError, match="equal channel names"):
        write_spectral(tmp_path / "s.exr", torch.ones(2, 1, 1), [5e-7, 5e-7])


def test_reading_an_rgb_file_is_refused_with_its_channels(request):
    night = request.config.rootpath / "recipes/samples/night.exr"
    with pytest.raises(ParameterError, match="B, G, R"):
        hyperspectral.hooks.preflight(file=night)
    with pytest.raises(ValueError, match=r"T\.550,0nm"):
        read_spectral(night)
