"""A camera of one channel from a table of its quantum efficiency: the whole chain, and light at
1064 nm.
"""

from functools import partial

import numpy as np
import pytest
import torch
from PIL import Image
from safetensors.torch import save_file

import neusee
from neusee.nodes.restore import NAFNet, start_network
from neusee.nodes.scene import exr_parts, grey
from neusee.workflows import Store, load

#: quantum efficiency in percent by wavelength in nm, as a data sheet draws it
QE = [
    (350, 20),
    (400, 45),
    (450, 60),
    (525, 69),
    (600, 62),
    (700, 45),
    (850, 19),
    (950, 7),
    (1050, 1.2),
    (1100, 0.2),
]
SENSOR = """\
# A mono camera like an IMX, with its quantum efficiency to 1100 nm.
defaults: [small]
sensor:
  camera: mono.csv
  quantum_efficiency: 0.69
  read_noise: 2 e-
"""
LASER = """\
# A neodymium laser.
lasers:
  infrared: {wavelength: 1064 nm, fwhm: 1 nm, strength: 1e3, angle: [0.2 mrad, -0.1 mrad]}
"""
SMALL = [
    "laser=infrared",
    "camera=mono",
    "scene.shape=[64, 64]",
    "sensor.shape=[48, 48]",
    "optics.samples=64",
    "optics.pitch=126.2 um",
    "optics.window=[64, 64]",
    "optics.bands=5",
    "doe.waves=[2]",
    "expect={}",
]
PLANCK, LIGHT = 6.62607015e-34, 299792458.0


@pytest.fixture
def mono(tmp_path):
    """Compute outputs of a small recipe with the mono camera of a folder."""
    for path, text in (("sensor/mine.yaml", SENSOR), ("laser/infrared.yaml", LASER)):
        (tmp_path / path).parent.mkdir()
        (tmp_path / path).write_text(text)
    rows = "".join(f"{nm},{percent}\n" for nm, percent in QE)
    (tmp_path / "sensor" / "mono.csv").write_text(
        "# read off a curve\nwavelength (nm),QE (%)\n" + rows
    )

    def compute(outputs, *words):
        recipe = load(
            "first_light", [*SMALL, "sensor=mine", *words, f"outputs=[{outputs}]"], tmp_path
        )
        return recipe, neusee.run(recipe, store=Store(tmp_path / "store"))

    return compute


def test_1064_nm_gives_the_photons_of_the_direct_sum(mono):
    """Irradiance times QE over its largest, wavelength, exposure and area of a pixel, over the
    energy of a photon.
    """
    _, result = mono('"spot[plain,infrared]", "laser_photons[plain,infrared]", "line[infrared]"')
    line, spot = result["line[infrared]"], result["spot[plain,infrared]"].double().numpy()
    wanted = np.zeros(spot.shape[1:])
    for centre, image in zip(line.centres.numpy(), spot, strict=True):
        share = np.interp(centre * 1e9, *zip(*QE, strict=True)) / 69
        wanted += image * share * 0.1 * 2.9e-6**2 * centre / (PLANCK * LIGHT)
    found = result["laser_photons[plain,infrared]"]
    assert found.shape == (1, 64, 64)
    np.testing.assert_allclose(
        found[0].double().numpy(), wanted, rtol=2e-6, atol=1e-6 * wanted.max()
    )
    assert wanted.max() > 25500 / 0.69  # the laser alone fills a pixel


@pytest.mark.slow
def test_the_same_laser_is_missing_from_the_picture_of_an_eye(mono):
    recipe, result = mono("laser_photons", "sensor.camera=CIE 1931", "camera=neusee")
    assert float(result["laser_photons[plain,infrared]"].abs().max()) == 0
    assert any("no channel of CIE 1931 sees 5 of 5 bands" in note for note in recipe.notes)


@pytest.mark.slow
@pytest.mark.parametrize("restore", ["wiener", "richardson_lucy"])
def test_the_whole_chain_runs_with_one_channel_and_its_pictures_are_grey(mono, restore):
    _, result = mono(
        "raw, developed, restored, truth, scene, restored_quality, saturated", f"restore={restore}"
    )
    assert result["raw[mask]"].shape == (1, 48, 48)
    for name in ("developed[plain]", "restored", "truth"):
        picture = result[name]
        assert picture.shape == (3, 48, 48)
        assert torch.equal(picture[0], picture[1])
        assert torch.equal(picture[0], picture[2])
    luminance = (
        result["scene"].double() * torch.tensor([0.2126, 0.7152, 0.0722]).double()[:, None, None]
    ).sum(0)
    torch.testing.assert_close(
        result["truth"][0].double(), luminance[8:56, 8:56], rtol=1e-6, atol=1e-7
    )
    assert float(result["restored_quality"].psnr) > 10


@pytest.mark.slow
def test_a_grey_scene_is_developed_to_its_luminance(mono):
    """Behind the plain lens and without a laser, a flat grey field keeps its level: the matrix
    balances white.
    """
    words = ["laser=none", "scene=siemens", "sensor.read_noise=0 e-", "restore=wiener_blind"]
    _, result = mono("developed, truth", *words)
    inner = (slice(None), slice(16, 32), slice(16, 32))
    developed, truth = result["developed[plain]"][inner], result["truth"][inner]
    assert float(developed.mean() / truth.mean()) == pytest.approx(1, abs=0.06)


def test_grey_is_the_luminance_in_each_channel():
    picture = torch.rand(2, 3, 4, 5, generator=torch.Generator().manual_seed(1))
    torch.testing.assert_close(
        grey(picture).double(), grey.hooks.reference(picture), rtol=1e-6, atol=1e-7
    )
    assert torch.equal(grey(torch.ones(3, 2, 2)), torch.ones(3, 2, 2))
    with pytest.raises(ValueError, match=r"\(1, 4, 5\) is not a colour picture"):
        grey(picture[0, :1])


@pytest.mark.slow
@pytest.mark.parametrize(
    "change", ["restore=nafnet", "flare=dirty_windshield", "reading=as_printed"]
)
def test_every_other_branch_of_the_graph_runs_with_one_channel(tmp_path, mono, change):
    net = start_network(partial(NAFNet, width=16), torch.Generator().manual_seed(0))
    save_file(net.state_dict(), tmp_path / "net.safetensors")
    weights = ["restore.weights=net.safetensors", "restore.width=16"] if "nafnet" in change else []
    _, result = mono("raw, restored, restored_quality, bsr, peak, transfer", change, *weights)
    assert bool(torch.isfinite(result["restored"]).all())
    assert result["restored"].shape == (3, 48, 48)


@pytest.mark.slow
def test_the_page_of_a_run_shows_the_mono_camera(tmp_path, mono, monkeypatch):
    from neusee.workflows.cli import app

    mono("bands")
    monkeypatch.chdir(tmp_path)
    monkeypatch.setenv("NEUSEE_CACHE", str(tmp_path / "cache"))
    outputs = (
        "outputs=[raw, restored, lsr, bsr, outside, developed_quality, restored_quality, peak,"
        " saturated, transfer]"
    )
    with pytest.raises(SystemExit) as end:
        app.main(["run", "first_light", *SMALL, "sensor=mine", outputs])
    assert not end.value.code
    latest = tmp_path / "runs" / "latest"
    drawn = {path.stem for path in (latest / "figures").iterdir()}
    assert drawn >= {
        "overview",
        "spectra",
        "tables",
        "suppression",
        "psf",
        "height",
        "sensor",
        "graph",
    }
    page = (latest / "report.html").read_text()
    assert 'id="tables">Your own tables' in page
    assert "LSR at 700 nm, the band nearest to the laser at 1064 nm" in page
    assert {path.name for path in (latest / "data").iterdir()} >= {
        "raw_mask.png",
        "raw_mask.exr",
        "restored.exr",
    }
    raw = np.asarray(Image.open(latest / "data" / "raw_mask.png"))
    assert raw.shape == (48, 48)
    assert raw.max() > 1000
    with exr_parts(latest / "data" / "raw_mask.exr") as opened:
        np.testing.assert_array_equal(opened.channels()["Y"].pixels, raw)


@pytest.mark.slow
def test_a_search_for_lasers_runs_with_one_channel(mono):
    _, result = mono("restored, search", "restore=search", "restore.most=1", "restore.lamps=0")
    assert result["search"].strength.shape == (1, 1)
    assert result["restored"].shape == (3, 48, 48)
    assert bool(torch.isfinite(result["restored"]).all())
