"""`neusee restore` restores frames with the camera of a recipe, and names all that do not fit
before it starts.
"""

import json

import numpy as np
import pytest
from kornia_rs import io
from PIL import Image

from neusee.workflows.cli import app

SIDE = 20
QUICK = [
    "optics.samples=128",
    "optics.pitch=63.11 um",
    "optics.window=[32,32]",
    "optics.bands=9",
    f"sensor.shape=[{SIDE},{SIDE}]",
    "frame.draws=2",
]


@pytest.fixture(scope="module")
def cache(tmp_path_factory):
    return tmp_path_factory.mktemp("cache")


@pytest.fixture
def neusee(capfd, tmp_path, monkeypatch, cache):
    monkeypatch.setenv("NEUSEE_CACHE", str(cache))
    monkeypatch.setenv("COLUMNS", "200")
    monkeypatch.chdir(tmp_path)
    (tmp_path / "frames").mkdir()

    def call(*words, small=True):
        with pytest.raises(SystemExit) as end:
            app.main(["restore", *words, *(QUICK if small else [])])
        return (end.value.code or 0, *capfd.readouterr())

    return call


def shot(side=SIDE, top=30000, seed=0):
    """A bright disc on a dark ground, in digital numbers with an offset of 1054 DN."""
    rng = np.random.default_rng(seed)
    y, x = np.indices((side, side)) - side // 2
    light = np.where(np.hypot(y, x) < side / 4, top, top / 4)[..., None] * [0.9, 1.0, 0.7]
    return np.clip(rng.normal(light + 1054, 200), 0, 65535).astype(np.uint16)


def save(path, values):
    path.parent.mkdir(exist_ok=True)
    (
        io.write_image_png_u16(str(path), values, "rgb")
        if path.suffix == ".png"
        else np.save(path, values)
    )


@pytest.mark.slow
def test_a_frame_becomes_a_folder_with_picture_uncertainty_and_page(neusee, tmp_path):
    values = shot()
    values[2:5, 2:5] = 65535
    save(tmp_path / "shot.png", values)
    code, out, err = neusee("shot.png", "--camera", "half_ring", "--quiet")
    assert (code, err) == (0, "")
    folder = tmp_path / out.strip().removesuffix("/report.html")
    page = (folder / "report.html").read_text(encoding="utf-8")
    assert "9 pixels are saturated in at least one channel, 2.25% of the picture" in page
    assert "invented" in page
    assert "no laser" not in page
    assert 'id="results"' not in page  # a frame has no truth that numbers could compare with
    assert {"restored.png", "restored.exr", "restored_spread.exr", "invented.png"} <= {
        path.name for path in (folder / "data").iterdir()
    }
    full = (io.read_image_png_u16(str(folder / "data" / "restored.png"), "rgb") == 65535).any(-1)
    full[2:5, 2:5] = False
    assert 1 <= full.sum() <= 3, "half a percent of the 391 pixels that are not saturated is white"
    marked = np.asarray(Image.open(folder / "data" / "invented.png"))
    expected = np.zeros((SIDE, SIDE))
    expected[2:5, 2:5] = 65535
    np.testing.assert_array_equal(marked, expected)
    assert Image.open(folder / "data" / "restored.png").text["Source"] == "shot.png"
    document = json.loads((folder / "provenance.json").read_text())
    assert document["command"].startswith("neusee restore ")
    assert "--camera half_ring" in document["command"]
    raw = next(step for step in document["steps"] if step["step"] == "raw[mask]")
    assert raw["node"] == "sensor.frame"


@pytest.mark.slow
def test_a_folder_gives_a_folder_of_results_for_each_frame_and_the_second_time_from_the_cache(
    neusee, tmp_path
):
    for number in range(2):
        save(tmp_path / "frames" / f"f{number}.npy", shot(seed=number))
    (tmp_path / "frames" / "notes.txt").write_text("not a frame")
    for _ in range(2):
        code, out, err = neusee("frames", "--camera", "plain_lens", "--mask", "half_ring", "--json")
        assert (code, err) == (0, "")
    found = [json.loads(line) for line in out.splitlines()]
    assert [each["recipe"] for each in found] == ["restore_f0", "restore_f1"]
    assert all(" run" not in each["counts"] for each in found)
    assert all("No pixel of f" in each["story"]["frame"] for each in found)


@pytest.mark.slow
def test_a_camera_may_be_a_sensor_file_and_a_laser_may_be_told(neusee, tmp_path):
    sensor = tmp_path / "lab" / "sensor" / "mine.yaml"
    sensor.parent.mkdir(parents=True)
    sensor.write_text("# Mine.\ndefaults: [small]\nsensor: {read_noise: 3 e-}\n")
    save(tmp_path / "shot.npy", shot())
    code, out, err = neusee(
        "shot.npy", "laser=green", "restore=wiener", "--camera", "lab/sensor/mine.yaml", "--json"
    )
    assert (code, err) == (0, "")
    document = json.loads(out)
    steps = {step["step"]: step for step in document["steps"]}
    assert "laser_photons[mask,green]" in steps
    assert "restored_spread" in steps


@pytest.mark.slow
def test_the_scene_and_the_laser_of_the_camera_are_not_used(neusee, tmp_path):
    (tmp_path / "mine.yaml").write_text(
        "# Mine.\ndefaults: [camera: neusee, scene: china, illuminant: daylight, lift: lmmse,"
        " laser: green, optics: small, sensor: small, doe: flat, flare: clean, restore: wiener,"
        " rival: grey_filter, reading: coherent]\nscene: {file: nowhere.jpg}\nlasers: {green:"
        " {strength: 7}}\noutputs: [raw]\n"
    )
    save(tmp_path / "shot.npy", shot())
    code, _, err = neusee("shot.npy", "--camera", "mine.yaml", "--quiet")
    assert (code, err) == (0, "")


def test_every_bad_frame_of_a_folder_is_named_before_work_starts(neusee, tmp_path):
    save(tmp_path / "frames" / "a.npy", shot())
    save(tmp_path / "frames" / "b.npy", shot(side=12))
    save(tmp_path / "frames" / "c.npy", shot()[..., 0])
    (tmp_path / "frames" / "d.png").write_text("no picture")
    code, out, err = neusee("frames", "--camera", "half_ring")
    assert (code, out) == (2, "")
    lines = err.splitlines()
    assert len(lines) == 4
    for line, words in zip(
        lines, ("12 x 12 pixels", "raw colour filter array", "no PNG file"), strict=False
    ):
        assert line.startswith("frame ")
        assert words in line
    assert lines[-1] == "3 problems, nothing was run"
    assert not (tmp_path / "runs").exists()


@pytest.mark.slow
def test_a_folder_of_point_sources_gives_the_psf_and_its_error(neusee, tmp_path):
    rng, side = np.random.default_rng(0), 32
    camera = {"sensor.shape": f"[{side},{side}]", "points.window": "[7,7]", "points.draws": "4"}
    y, x = np.indices((side, side))
    for number in range(3):
        down, right = np.array([y, x]) - side // 2 - rng.uniform(-0.5, 0.5, 2)[:, None, None]
        light = 3000 * np.exp(-(down**2 + right**2) / 3.4)[..., None] * [0.9, 1.0, 0.7]
        values = (rng.poisson(light) + rng.normal(0, 2.4, light.shape)) / 0.37 + 1054
        save(
            tmp_path / "points" / f"p{number}.npy",
            np.clip(np.round(values), 0, 65535).astype(np.uint16),
        )
    save(tmp_path / "shot.npy", shot(side))
    small = [word for word in QUICK if "shape" not in word] + [
        f"{name}={value}" for name, value in camera.items()
    ]
    code, out, err = neusee(
        "shot.npy", "--camera", "plain_lens", "--psf", "points", *small, "--json", small=False
    )
    assert (code, err) == (0, "")
    document = json.loads(out)
    assert "the error of the measured PSF" in str(document["story"])
    steps = {step["step"]: step["node"] for step in document["steps"]}
    assert steps["measured"] == "restore.measured_psf"
    assert steps["deconvolved"] == "restore.wiener_by_field"
    # the PSF of the recipe is not computed
    assert not [name for name in steps if name.startswith("psf[")]
    page = (tmp_path / document["report"]).read_text(encoding="utf-8")
    assert "3 points; chi-square per pixel" in page
    small += ["restore.most=1", "restore.lamps=0"]
    code, out, err = neusee(
        "shot.npy",
        "--camera",
        "plain_lens",
        "--psf",
        "points",
        "restore=search",
        *small,
        "--json",
        small=False,
    )
    assert (code, err) == (0, "")
    document = json.loads(out)
    steps = {step["step"]: step for step in document["steps"]}
    assert steps["search"]["node"] == "restore.find_lasers"
    assert steps["deconvolved"]["node"] == "restore.wiener_by_field"
    assert steps["measured"]["state"] == "cached"


GOOD = "shot.npy"
BAD = {
    "no such frame": (
        ["absent.png", "--camera", "half_ring"],
        "argument 1   absent.png   no such file or folder",
    ),
    "empty folder": (
        ["frames", "--camera", "half_ring"],
        "argument 1   frames   the folder has no frames: give files",
    ),
    "no camera": ([GOOD], "Missing option '--camera'"),
    "no frame": (["--camera", "half_ring", "sensor.bits=12"], "no frame is named"),
    "unknown camera": ([GOOD, "--camera", "half_rings"], "no such recipe; did you mean half_ring?"),
    "absent camera": ([GOOD, "--camera", "my.yaml"], "my.yaml   no such file"),
    "unknown mask": (
        [GOOD, "--camera", "half_ring", "--mask", "axikon"],
        "no option axikon in doe; did you mean axicon?",
    ),
    "absent map": (
        [GOOD, "--camera", "half_ring", "--mask", "map.npy"],
        "--mask   map.npy   no such file",
    ),
    "unknown value": (
        [GOOD, "--camera", "half_ring", "sensor.reed_noise=3 e-"],
        "did you mean sensor.read_noise?",
    ),
    "unit": ([GOOD, "--camera", "half_ring", "sensor.read_noise=3 m"], "argument 2"),
    "a word": (
        [GOOD, "--camera", "half_ring", "sensor.bits=16", "more"],
        "more: not a change of a value",
    ),
    "a step that a frame lacks": ([GOOD, "--camera", "half_ring", "outputs=[truht]"], "truht"),
    "a field of dirt": (
        [GOOD, "+shading=estimated", "--camera", "half_ring"],
        "dirt is not estimated from frames",
    ),
    "absent points": (
        [GOOD, "--camera", "half_ring", "--psf", "points"],
        "--psf   points   no such file or folder",
    ),
    "folder without points": (
        [GOOD, "--camera", "half_ring", "--psf", "frames"],
        "--psf   frames   the folder has no",
    ),
    "no point": (
        [GOOD, "--camera", "half_ring", "--psf", GOOD, "points.window=[5,5]"],
        "but its background needs 500",
    ),
    "points of another size": (
        [GOOD, "--camera", "half_ring", "--psf", "small.npy"],
        "small.npy has 12 x 12 pixels (y, x)",
    ),
    "window": (
        [GOOD, "--camera", "half_ring", "--psf", GOOD, "points.window=[4,5]"],
        "must be two odd numbers",
    ),
    "two restorers": (
        [GOOD, "--camera", "half_ring", "--psf", GOOD, "restore=wiener"],
        "a filter of its own",
    ),
    "restorer": ([GOOD, "--camera", "half_ring", "restore=magic"], "no option magic in restore"),
    "draws": ([GOOD, "--camera", "half_ring", "frame.draws=1"], "frame.draws"),
    "white": ([GOOD, "--camera", "half_ring", "frame.white=-1"], "frame.white"),
    "bits": ([GOOD, "--camera", "half_ring", "sensor.bits=12"], "12 bits end at 4095"),
    "size": (
        ["small.npy", "--camera", "half_ring"],
        "12 x 12 pixels (y, x), but sensor.shape is [20, 20]",
    ),
    "channels": (["grey.npy", "--camera", "half_ring"], "it may be a raw colour filter array"),
    "values": (["scaled.npy", "--camera", "half_ring"], "no whole number"),
    "format": (["shot.jpg", "--camera", "half_ring"], "no frame that can be read"),
    "tone curve": (["eight.png", "--camera", "half_ring"], "has 8 bits, but sensor.bits is 16"),
    "sensor elsewhere": ([GOOD, "--camera", "loose.yaml"], "put it into a folder called sensor"),
    "tone curve of 8 bits": (
        ["eight.png", "--camera", "half_ring", "sensor.bits=8"],
        "or state frame.curve=linear",
    ),
    "laser twice": (
        [GOOD, "--camera", "half_ring", "laser=grene"],
        "no option grene in laser; did you mean green?",
    ),
    "device": ([GOOD, "--camera", "half_ring", "--device", "tpu"], "--device"),
}


@pytest.mark.parametrize("case", BAD)
def test_a_mistake_is_one_located_line_and_exit_code_2(case, neusee, tmp_path):
    save(tmp_path / GOOD, shot())
    save(tmp_path / "small.npy", shot(side=12))
    save(tmp_path / "grey.npy", shot()[..., 0])
    save(tmp_path / "scaled.npy", shot() / 65535.0)
    Image.fromarray((shot() >> 8).astype(np.uint8)).save(tmp_path / "shot.jpg")
    Image.fromarray((shot() >> 8).astype(np.uint8)).save(tmp_path / "eight.png")
    (tmp_path / "loose.yaml").write_text("# Mine.\nsensor: {read_noise: 3 e-}\n")
    words, message = BAD[case]
    own = {word.partition("=")[0] for word in words}
    small = [word for word in QUICK if word.partition("=")[0] not in own and case != "no frame"]
    code, out, err = neusee(*words, *small, small=False)
    assert (code, out) == (2, ""), err
    lines = [line for line in err.splitlines() if "nothing was run" not in line]
    assert len(lines) == 1, err
    assert message in lines[0]
