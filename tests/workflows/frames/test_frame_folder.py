"""Folders of frames of a camera in NumPy: found by names, headers or a table, and what is wrong
with them is told.
"""

import json
import shutil
from pathlib import Path

import numpy as np
import pytest
from PIL import Image, PngImagePlugin, TiffImagePlugin

from neusee.workflows.calibration import emcee_sampler
from neusee.workflows.cli import app
from neusee.workflows.frames.folder_recipe import recipe_of_folder
from neusee.workflows.frames.frame_folder import FolderRefused, find_levels
from neusee.workflows.recipe.loading import load
from neusee.workflows.store.result_store import Store
from tests.drawn_chains import drawn_chains
from tests.nodes.calibrate.numpy_camera import Camera

LIT = (2000.0, 4000.0, 6000.0, 8000.0, 10000.0)  # photons
TIMES = (0.001, 0.002)  # s, of darks


def shots():
    """Two small frames of each level: (photons, exposure, number, frame)."""
    rng = np.random.default_rng(0)
    for photons, time in [*((0.0, t) for t in TIMES), *((p, 0.001) for p in LIT)]:
        for number in range(2):
            yield (
                photons,
                time,
                number,
                np.rint(100 + 0.1 * rng.poisson(0.5 * photons + 900, (8, 10))).astype(np.uint16),
            )


def png(file, frame, **texts):
    file.parent.mkdir(parents=True, exist_ok=True)
    about = PngImagePlugin.PngInfo()
    for key, text in texts.items():
        about.add_text(key, text)
    Image.fromarray(frame).save(file, pnginfo=about)


def by_name(folder):
    for photons, time, number, frame in shots():
        kind = "dark" if not photons else f"flat_{photons:g}ph"
        png(folder / f"{kind}_{1e3 * time:g}ms_{number}.png", frame)


def by_folders(folder):
    for photons, time, number, frame in shots():
        kind = f"Photons={photons:g}" if photons else "Dark"
        file = folder / kind / f"t={1e6 * time:.0f}us" / f"{number:04d}.tif"
        file.parent.mkdir(parents=True, exist_ok=True)
        Image.fromarray(frame).save(file)


def by_exif(folder):
    for n, (photons, time, _, frame) in enumerate(shots()):
        tags = TiffImagePlugin.ImageFileDirectory_v2()
        tags[33434], tags.tagtype[33434] = time, 12
        tags[270] = f"camera=mine; photons={photons:g}"
        folder.mkdir(exist_ok=True)
        Image.fromarray(frame).save(folder / f"IMG_{n:04d}.tiff", tiffinfo=tags)


def by_texts(folder):
    for n, (photons, time, _, frame) in enumerate(shots()):
        png(folder / f"{n}.png", frame, ExposureTime=f"{1e3 * time:g} ms", Photons=f"{photons:g}")


def by_fits(folder):
    fits = pytest.importorskip("astropy.io.fits")
    folder.mkdir()
    for n, (photons, time, _, frame) in enumerate(shots()):
        header = fits.Header({"EXPTIME": time, "PHOTONS": photons})
        fits.PrimaryHDU(frame, header).writeto(folder / f"{n}.fits")


def by_table(folder):
    folder.mkdir()
    lines = ["file,exposure,photons"]
    for n, (photons, time, _, frame) in enumerate(shots()):
        np.save(folder / f"shot{n}.npy", frame)
        lines.append(f"shot{n}.npy,{1e3 * time:g} ms,{photons:g}")
    (folder / "frames.csv").write_text("\n".join(lines))


@pytest.mark.parametrize("written", [by_name, by_folders, by_exif, by_texts, by_fits, by_table])
def test_levels_are_found_by_each_way_of_telling_them(written, tmp_path):
    written(tmp_path / "lab")
    found = find_levels(tmp_path / "lab")
    assert found.light == "photons"
    told = [(level.light, level.exposure, len(level.files)) for level in found.levels]
    assert told == [*((0.0, t, 2) for t in TIMES), *((p, 0.001, 2) for p in LIT)]


def as_series(folder):
    """The lamp is constant and the exposure differs; nobody knows the photons."""
    for photons, time, number, frame in shots():
        name = f"dark_{1e3 * time:g}ms" if not photons else f"lit_{photons / 2000:g}ms"
        png(folder / f"{name}_{number}.png", frame)


def test_without_photons_the_exposures_tell_the_light(tmp_path):
    as_series(tmp_path)
    found = find_levels(tmp_path)
    assert found.light == "exposure"
    assert [level.light for level in found.levels if not level.dark] == [
        0.001,
        0.002,
        0.003,
        0.004,
        0.005,
    ]


def one_frame(folder):
    (folder / "flat_2000ph_1ms_0.png").unlink()


def other_size(folder):
    png(folder / "flat_2000ph_1ms_0.png", np.zeros((8, 8), np.uint16))


def eight_bits(folder):
    png(folder / "flat_2000ph_1ms_0.png", np.zeros((8, 10), np.uint8))


def no_darks(folder):
    for file in folder.glob("dark*"):
        file.unlink()


def no_exposure(folder):
    (folder / "flat_2000ph_1ms_0.png").rename(folder / "flat_2000ph_0.png")


def wrong_name(folder):
    for a, b in (
        ("flat_2000ph_1ms_0", "x"),
        ("flat_8000ph_1ms_0", "flat_2000ph_1ms_0"),
        ("x", "flat_8000ph_1ms_0"),
    ):
        (folder / f"{a}.png").rename(folder / f"{b}.png")


def no_photons(folder):
    for n in (0, 1):
        (folder / f"flat_2000ph_1ms_{n}.png").rename(folder / f"flat_1ms_{n}.png")


def few_levels(folder):
    for file in (*folder.glob("flat_[68]*"), *folder.glob("flat_1000*")):
        file.unlink()


def colour(folder):
    png(folder / "flat_2000ph_1ms_0.png", np.zeros((8, 10, 3), np.uint8))


def other_time(folder):
    file = folder / "flat_2000ph_1ms_0.png"
    png(file, np.asarray(Image.open(file)), ExposureTime="20 ms")


def bright_darks(folder):
    for n, time in enumerate(("1ms_0", "1ms_1", "2ms_0", "2ms_1")):
        shutil.copy(folder / f"flat_10000ph_1ms_{n % 2}.png", folder / f"dark_{time}.png")


def missing_file(folder):
    (folder / "frames.csv").write_text(
        "file,exposure,photons\nnone.png,1 ms,0\ndark_1ms_0.png,1,0\n"
    )


@pytest.mark.parametrize(
    ("mistake", "words"),
    [
        (one_frame, ["flat_2000ph_1ms_1.png: the level has a single frame: take two or more"]),
        (other_size, ["flat_2000ph_1ms_0.png: 8 x 8 pixels, but 13 files have 10 x 8 pixels"]),
        (eight_bits, ["flat_2000ph_1ms_0.png: 8 bits, but 13 files have 16 bits"]),
        (no_darks, ["no dark frames: cover the lens"]),
        (
            no_exposure,
            ["flat_2000ph_0.png: the exposure is unknown: name files such as dark_10ms_1.png"],
        ),
        (
            wrong_name,
            ["flat_2000ph_1ms_0.png and flat_2000ph_1ms_1.png count as one level", "flat_8000ph"],
        ),
        (
            no_photons,
            ["flat_1ms_0.png, flat_1ms_1.png: photons is missing, which 8 other lit files have"],
        ),
        (few_levels, ["2 lit levels: take 4 or more"]),
        (colour, ["flat_2000ph_1ms_0.png is PNG with pixels of kind RGB, not raw grey"]),
        (other_time, ["flat_2000ph_1ms_0.png: its name says 0.001 s, but its header says 0.02 s"]),
        (bright_darks, ["dark frames have means up to 690 DN"]),
        (
            missing_file,
            [
                "frames.csv:2: no such file: none.png",
                "frames.csv:3: exposure 1: write a time with a unit",
            ],
        ),
    ],
    ids=lambda each: each.__name__ if callable(each) else "",
)
def test_each_mistake_of_a_folder_is_told_with_its_file_and_what_to_do(mistake, words, tmp_path):
    by_name(tmp_path)
    mistake(tmp_path)
    with pytest.raises(FolderRefused) as refused:
        find_levels(tmp_path)
    for text in words:
        assert text in str(refused.value)
    assert len(str(refused.value).splitlines()) == len(words), (
        "one line for each reason, and no other"
    )


def test_an_empty_folder_is_told_how_to_name_files(tmp_path, capsys):
    assert typed(["calibrate", str(tmp_path)]) == 2
    told = capsys.readouterr().err
    assert told.startswith(
        f"nothing was drawn: {tmp_path}: the folder contains no frames: name files such as dark_10ms_1.png"
    )


def written_by(camera, folder, relative=False):
    """16-bit PNG files of the camera in NumPy; ``relative``: the names tell the light in the
    exposure only.
    """
    for _, photons, time, frames in camera.levels():
        for number, frame in enumerate(frames):
            told = (
                f"lit_{photons / 1000:.5f}ms"
                if relative
                else f"lit_{photons:.6g}ph_{1e3 * time:g}ms"
            )
            png(
                folder / f"{told if photons else f'dark_{1e3 * time:.5g}ms'}_{number}.png",
                frame.astype(np.uint16),
            )


def typed(words):
    """The exit code of a command."""
    with pytest.raises(SystemExit) as ended:
        app.main(words)
    return ended.value.code


@pytest.fixture
def working(tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    monkeypatch.setenv("NEUSEE_CACHE", str(tmp_path / "cache"))
    monkeypatch.setattr(emcee_sampler, "sample", drawn_chains)
    return tmp_path


@pytest.mark.slow
def test_a_folder_becomes_a_sensor_with_its_uncertainty(working, capsys):
    """From frames of known truth to a sensor group, whose values and correlations a recipe
    takes.
    """
    written_by(Camera(seed=3, size=64, darks=3, lit=10, faults={"lamp": 0.003}), working / "lab")
    light = "traceability.photons={relative_uncertainty: 0.02, certificate: '4711'}"
    assert typed(["calibrate", "lab", light, "--sensor", "mine"]) == 0, capsys.readouterr().err
    recipe = load("first_light", ["sensor=mine"], folder=working)
    joint = recipe.uncertain.joint
    place = {name: i for i, name in enumerate(joint.names)}
    for name, truth in {"gain": 0.125, "quantum_efficiency": 0.5, "read_noise": 8.0}.items():
        at = place[f"sensor.{name}"]
        assert abs(joint.mean[at] - truth) < 4 * joint.sd[at], name
    assert 0.98 * 0.02 * 0.495 < joint.sd[place["sensor.quantum_efficiency"]] < 0.02, (
        "2 % of the light and more"
    )
    assert joint.sd[place["sensor.gain"]] < 0.04 * 0.125, (
        "chance, and faults that frames of 64 x 64 pixels may hide"
    )
    correlation = joint.factor @ joint.factor.T
    # nine tenths of both widths are what so few pixels may hide, which ties the two values less
    # than chance does
    assert correlation[place["sensor.gain"], place["sensor.read_noise"]] < -0.3

    (results,) = (path for path in (working / "runs").iterdir() if path.name != "latest")
    assert (results / "sensor" / "mine.yaml").read_text() == (
        working / "sensor" / "mine.yaml"
    ).read_text()
    budget = json.loads((results / "budget.json").read_text())
    efficiency = budget["quantities"]["quantum_efficiency"]
    parts = {source["source"]: source.get("contribution") for source in efficiency["sources"]}
    assert parts["photometric calibration of the light"] == pytest.approx(
        0.02 * efficiency["value"]
    )
    assert parts["temperature"] is None
    assert "temperature" in efficiency["not stated"]
    assert budget["traceability"]["instrument"] == "not stated"
    posterior = json.loads((results / "posterior.json").read_text())
    for name, row in budget["quantities"].items():
        if name not in ("bend", "twist", "lamp"):  # the interval of a wide lamp is not symmetric
            low, high = (posterior["stated"][name][end] for end in ("low", "high"))
            assert row["combined standard uncertainty"] == pytest.approx(
                (high - low) / 2 / 1.645, rel=0.02
            ), name
    lone = [
        typed(["calibrate", "calibrate", "--sensor", "mine"]),
        typed(["calibrate", "lab", "--sensor", "My sensor"]),
    ]
    assert lone == [2, 2]


@pytest.mark.slow
def test_gain_and_noise_are_tied_where_the_frames_hide_nothing(working, capsys):
    """A camera that cannot mix pixels or frames has the widths and the correlation of chance
    alone.
    """
    written_by(Camera(seed=3, size=64, darks=3, lit=10, faults={"lamp": 0.003}), working / "lab")
    raw = ["steps.prior.with.mixing=none", "steps.prior.with.lag=none"]
    assert typed(["calibrate", "lab", *raw, "--sensor", "raw"]) == 0, capsys.readouterr().err
    joint = load("first_light", ["sensor=raw"], folder=working).uncertain.joint
    gain, noise = (joint.names.index(f"sensor.{name}") for name in ("gain", "read_noise"))
    assert (joint.factor @ joint.factor.T)[gain, noise] < -0.5
    assert joint.sd[gain] < 0.015 * 0.125, "half of what may hide in such small frames"


@pytest.mark.slow
def test_light_that_is_known_up_to_a_factor_tells_everything_but_the_efficiency(working, capsys):
    written_by(
        Camera(seed=4, size=64, darks=3, lit=10, faults={"lamp": 0.003}),
        working / "lab",
        relative=True,
    )
    assert typed(["calibrate", "lab"]) == 0, capsys.readouterr().err
    (results,) = (path for path in (working / "runs").iterdir() if path.name != "latest")
    posterior = json.loads((results / "posterior.json").read_text())
    assert posterior["parameters"]["quantum_efficiency"]["kind"] == "none"
    assert "mean" not in posterior["parameters"]["quantum_efficiency"]
    gain = posterior["parameters"]["gain"]
    assert abs(gain["mean"] - 0.125) < 4 * gain["sd"]
    assert "quantum_efficiency" not in np.load(results / "draws.npz")
    text = (results / "sensor" / "mine.yaml").read_text()
    assert "# quantum_efficiency: no value from these frames" in text
    assert "known up to a factor" in (results / "report.html").read_text()


def test_a_descriptor_in_the_folder_is_taken(tmp_path):
    lines = ["v 4.0", "n 16 10 8"]
    for n, (photons, time, number, frame) in enumerate(shots()):
        if not number:
            lines.append(f"b {1e9 * time:.0f} {photons}" if photons else f"d {1e9 * time:.0f}")
        np.save(tmp_path / f"{n}.npy", frame)
        lines.append(f"i {n}.npy")
    (tmp_path / "set.txt").write_text("\n".join(lines))
    recipe = recipe_of_folder(tmp_path, Store(tmp_path / "store"))
    assert recipe.steps["measured"].node.path == "calibrate.descriptor"
    assert recipe.steps["camera"].params["gain"] == pytest.approx(0.1, rel=0.3)


def test_a_file_of_somebody_else_is_not_overwritten(working, capsys):
    by_name(working / "lab")
    Path("sensor").mkdir()
    Path("sensor/mine.yaml").write_text("# my own sensor\n")
    assert typed(["calibrate", "lab", "--sensor", "mine"]) == 2
    assert "exists and was not written by a calibration" in capsys.readouterr().err
