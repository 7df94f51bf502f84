"""What `neusee validate` and the start of `neusee run` refuse or note, by the command line,
before any step runs.
"""

import re

import numpy as np
import pytest

from neusee.nodes.spectra import _bands, _channel_responses
from neusee.workflows.cli import app
from neusee.workflows.recipe import step_checks

OpenEXR = pytest.importorskip("OpenEXR")
SMALL = (
    "scene=siemens",
    "scene.shape=[48,48]",
    "sensor.shape=[40,40]",
    "optics.window=[32,32]",
    "optics.samples=64",
    "optics.pitch=126 um",
    "optics.bands=3",
    "lasers.green.angle=[0.1 mrad, 0 mrad]",
)


@pytest.fixture
def neusee(tmp_path, monkeypatch, capfd):
    """Call the command line in an empty folder; give the exit code, stdout and stderr."""
    monkeypatch.chdir(tmp_path)
    monkeypatch.setenv("NEUSEE_CACHE", str(tmp_path / "cache"))

    def call(*words: str) -> tuple[int, str, str]:
        with pytest.raises(SystemExit) as end:
            app.main(list(words))
        return (end.value.code or 0, *capfd.readouterr())

    return call


def without_openexr(text):
    """The lines of a text but for those that OpenEXR itself prints."""
    return "".join(line for line in text.splitlines(keepends=True) if "EXR_ERR" not in line)


@pytest.fixture
def refused(neusee, tmp_path):
    """Call `validate` and `run` with the same changes; both must refuse with the same text,
    which this returns.
    """

    def refused(*words):
        code, out, err = neusee("validate", "first_light", *words)
        assert (code, out) == (2, ""), out
        err = without_openexr(err)
        code, out, again = neusee("run", "first_light", *words)
        assert (code, out) == (2, "")
        assert without_openexr(again) == err
        assert not (tmp_path / "cache").exists()
        assert not (tmp_path / "runs").exists()
        return err

    return refused


@pytest.mark.parametrize(
    ("change", "said"),
    [
        (
            "sensor.shape=[800,800]",
            ("sensor.shape = [800, 800]", "larger than the image of 768 x 768", "enlarge"),
        ),
        (
            "lasers.green.angle=[60 deg, 0 deg]",
            ("lasers.green.angle = ", "1.047 rad", "below 1", "57.3 deg"),
        ),
        ("lasers.green.angle=[0 deg, 180 deg]", ("lasers.green.angle = ", "180 deg", "3.142 rad")),
        (
            "lasers.green.angle=[10 mrad, 0 mrad]",
            ("lasers.green.angle = ", "2.21 mm", "carries only 1.91 mm"),
        ),
        (
            "optics.focal_length=55 mm",
            ("optics.focal_length = 55 mm", "carries only 0.735 mm", "optics.samples="),
        ),
        ("optics.bands=100000000", ("optics.bands = 100000000", "limit of 100000", "fewer bands")),
        (
            "expect.x={step: lsr[mask], at: [40], value: 1, rtol: 1}",
            ("expect.x.at = [40]", "lsr[mask] has 31 values"),
        ),
        (
            "expect.x={step: lsr[mask], at: [0, 0], value: 1, rtol: 1}",
            ("expect.x.at = [0, 0]", "give 1 indices"),
        ),
        ("expect.x={step: lsr[mask], value: 1, rtol: 1}", ("expect.x.at = []", "must select one")),
        (
            "expect.x={step: psf[mask], at: [clear_peek, 2], value: 1, rtol: 1}",
            ("no field clear_peek; did you mean clear_peak?",),
        ),
    ],
)
def test_a_value_that_fails_after_the_optics_is_refused_at_its_place(refused, change, said):
    change = change.replace("lsr[mask]", '"lsr[mask]"').replace("psf[mask]", '"psf[mask]"')
    err = refused(change)
    assert all(line.startswith("argument 2") for line in err.splitlines()[:-1])
    assert [part for part in said if part not in err] == []


def test_a_result_that_no_memory_holds_is_refused_with_its_sizes(refused, monkeypatch):
    monkeypatch.setattr(step_checks, "machine_memory", lambda: 8e9)
    err = refused("scene=siemens", "scene.shape=[20000,20000]", "optics.pixel=zoh")
    assert (
        "9.6 GB for a result of 3 x 20000 x 20000 values and one input, and this machine has 8 GB"
        in err
    )


def test_a_step_that_a_cheaper_form_replaces_or_that_nobody_needs_is_not_judged_by_its_size(
    neusee, monkeypatch
):
    """All 31 bands of this scene take 0.5 GB, but only three planes of them are computed."""
    monkeypatch.setattr(step_checks, "machine_memory", lambda: 2e8)
    code, _, err = neusee(
        "validate",
        "first_light",
        "scene=siemens",
        "scene.shape=[2048,2048]",
        "optics.pixel=zoh",
        "outputs=[raw]",
    )
    assert (code, err) == (0, "")


def test_what_no_output_needs_is_noted(neusee):
    code, out, _ = neusee(
        "validate",
        "first_light",
        "lasers.green.angle=[10 mrad, 0 mrad]",
        "outputs=[lsr]",
        "expect=null",
    )
    assert code == 0
    assert "carries only 1.91 mm" in out
    assert "(no output needs the step laser_psf[mask,green])" in out


def test_a_picture_with_more_rows_than_any_sensor_is_refused(refused):
    said = refused("scene=siemens", "scene.shape=[10000000000,100]")
    assert "scene.shape.0 = 10000000000   must be less than or equal to 1000000" in said


def test_an_expected_number_that_the_change_affects_is_dropped_rather_than_refused(neusee):
    code, out, _ = neusee("validate", "first_light", "optics.bands=3")
    assert code == 0
    assert "not compared" in out


@pytest.mark.slow
def test_what_is_known_before_the_run_is_what_the_run_gives(tmp_path):
    """Shapes of every step that has a rule, against the results of a run in full."""
    from neusee.workflows import load, run
    from neusee.workflows.graph.recipe_graph import in_order
    from neusee.workflows.graph.step_shapes import inputs_of
    from neusee.workflows.recipe.asked_nodes import THEMSELVES
    from neusee.workflows.store.result_store import Store

    recipe = load("first_light", SMALL)
    known = {}
    for name in in_order({name: step.sources for name, step in recipe.steps.items()}, recipe.steps):
        step = recipe.steps[name]
        known[name] = THEMSELVES.form(step, inputs_of(step, known))
    found = {name: value for name, value in known.items() if value is not None}
    assert {
        "raw[mask]",
        "truth",
        "psf[plain]",
        "spot[mask,green]",
        "lsr[mask]",
        "level",
    } <= found.keys()
    results = run(recipe, Store(tmp_path / "store"), outputs=list(found)).values
    assert {name: shapes(value) for name, value in found.items()} == {
        name: shapes(results[name]) for name in found
    }


def shapes(value):
    return [tuple(part.shape) for part in (value if isinstance(value, tuple) else (value,))]


# --- light that no channel sees -------------------------------------------------------------------


@pytest.mark.parametrize(
    ("wavelength", "bands"), [("1064 nm", "1052 nm to 1076 nm"), ("20 um", "19988 nm to 20012 nm")]
)
def test_a_laser_that_no_channel_sees_is_noted_with_the_response(neusee, wavelength, bands):
    code, out, _ = neusee("validate", "first_light", f"lasers.green.wavelength={wavelength}")
    assert code == 0
    (note,) = [line for line in out.splitlines() if "no channel" in line]
    assert (
        note == f"note     no channel of CIE 1931 sees 5 of 5 bands, {bands}: the largest relative"
        " response is 0, below 0.001, so their light is missing from the picture; choose 375 to"
        " 720 nm"
    )


@pytest.mark.parametrize("camera", ["CIE 1931", "Nikon 5100", "Sigma SDMerill"])
def test_inside_the_range_that_needs_no_table_every_wavelength_is_seen(camera):
    """The range stands as two numbers in the program; the table of colour-science is asked here."""
    import colour

    table = (
        colour.MSDS_CMFS["CIE 1931 2 Degree Standard Observer"]
        if camera == "CIE 1931"
        else colour.MSDS_CAMERA_SENSITIVITIES[f"{camera} (NPL)"]
    )
    low, high = _channel_responses._SEEN_RANGE[camera]
    inside = (table.wavelengths >= low - 5) & (table.wavelengths <= high + 5)
    assert (table.values.max(1) / table.values.max())[inside].min() > 1e-3


# --- input files ----------------------------------------------------------------------------------


def exr(path, channels, **header):
    about = {"compression": OpenEXR.ZIP_COMPRESSION, "type": OpenEXR.scanlineimage, **header}
    OpenEXR.File(about, channels).write(str(path))


def plane(value=0.5, size=(64, 64)):
    return np.full(size, value, np.float32) + np.random.default_rng(1).random(size, np.float32) / 10


def picture(folder, suffix):
    from PIL import Image

    values = np.random.default_rng(2).integers(0, 255, (60, 60, 3), np.uint8)
    Image.fromarray(values).save(folder / f"a{suffix}")
    return folder / f"a{suffix}"


def cut(path):
    path.write_bytes(path.read_bytes()[: path.stat().st_size // 2])


def bad_exr(folder, value):
    exr(
        folder / "a.exr",
        {**{c: plane() for c in "RG"}, "B": np.where(np.eye(64) > 0, value, plane())},
    )


def cut_exr(folder):
    exr(folder / "a.exr", {c: plane() for c in "RGB"})
    cut(folder / "a.exr")


def parts_exr(folder, *names):
    about = {"compression": OpenEXR.ZIP_COMPRESSION, "type": OpenEXR.scanlineimage}
    parts = [OpenEXR.Part({**about, "name": name}, {c: plane() for c in "RGB"}) for name in names]
    OpenEXR.File(parts).write(str(folder / "a.exr"))


def bomb_png(folder):
    """A small file whose header states 12000 x 12000 pixels."""
    import struct
    import zlib

    def chunk(kind, data):
        return (
            struct.pack(">I", len(data)) + kind + data + struct.pack(">I", zlib.crc32(kind + data))
        )

    head = struct.pack(">IIBBBBB", 12000, 12000, 8, 2, 0, 0, 0)
    (folder / "a.png").write_bytes(
        b"\x89PNG\r\n\x1a\n"
        + chunk(b"IHDR", head)
        + chunk(b"IDAT", zlib.compress(b"\0" * 36001))
        + chunk(b"IEND", b"")
    )


def claimed_exr(folder):
    """An OpenEXR file whose header states far more pixels than it has."""
    exr(folder / "a.exr", {c: plane() for c in "RGB"})
    data = (folder / "a.exr").read_bytes()
    at = data.index(b"dataWindow\0box2i\0") + len(b"dataWindow\0box2i\0") + 4
    big = np.array([0, 0, 99_999, 99_999], "<i4").tobytes()
    (folder / "a.exr").write_bytes(data[:at] + big + data[at + 16 :])


SCENES = {
    "truncated JPEG": ("china", "a.jpg", lambda d: cut(picture(d, ".jpg")), "a.jpg is damaged"),
    "truncated PNG": ("china", "a.png", lambda d: cut(picture(d, ".png")), "a.png is damaged"),
    "decompression bomb": (
        "china",
        "a.png",
        bomb_png,
        "12000 x 12000 pixels, more than the limit of 64 million",
    ),
    "folder": ("china", "a.png", lambda d: (d / "a.png").mkdir(), "is a folder, not a file"),
    "NaN": ("night", "a.exr", lambda d: bad_exr(d, np.nan), "64 values that are not finite"),
    "infinity": ("night", "a.exr", lambda d: bad_exr(d, np.inf), "64 values that are not finite"),
    "truncated EXR": (
        "night",
        "a.exr",
        cut_exr,
        "a.exr is damaged (the pixels end earlier than the header says)",
    ),
    "EXR header": ("night", "a.exr", claimed_exr, "100000 x 100000 pixels"),
    "two channels": (
        "night",
        "a.exr",
        lambda d: exr(d / "a.exr", {c: plane() for c in "RG"}),
        "X, Y and Z, or Y",
    ),
    "several parts": (
        "night",
        "a.exr",
        lambda d: parts_exr(d, "left", "right"),
        "parts left, right: set part",
    ),
}


@pytest.mark.parametrize(("scene", "file", "make", "said"), SCENES.values(), ids=SCENES)
def test_the_content_of_a_scene_is_checked(refused, tmp_path, scene, file, make, said):
    make(tmp_path)
    err = refused(f"scene={scene}", f"scene.file={file}")
    assert err.startswith(f"argument 3   scene.file = {file}   ")
    assert said in err


CUBE = """\
# A cube.
file: {file: a.npy}
steps:
  bands: {node: spectra.bands, with: {start: 400 nm, stop: 700 nm, count: 4}}
  cube:
    node: scene.hyperspectral
    from: bands
    with: {file: "${file.file}", start: 400 nm, stop: 700 nm}
outputs: [cube]
"""
TABLE = """\
# Levels.
file: {file: a.csv}
steps: {levels: {node: calibrate.table, with: {file: "${file.file}"}}}
outputs: [levels]
"""
HEIGHT = """\
# A height map.
file: {file: a.npy}
steps:
  stop: {node: optics.stop, with: {samples: 4, pitch: 10 um, diameter: 40 um}}
  height: {node: doe.pixelwise, from: stop, with: {file: "${file.file}"}}
outputs: [height]
"""
REFLECTANCES = """\
# Reflectances.
file: {file: a.csv}
steps:
  bands: {node: spectra.bands, with: {start: 400 nm, stop: 700 nm, count: 4}}
  spectra: {node: spectra.reflectances, from: bands, with: {sets: [], files: "${file.file}"}}
outputs: [spectra]
"""
FRAMES = """\
# Frames.
file: {file: a.png}
steps: {frames: {node: calibrate.frames, with: {files: "${file.file}"}}}
outputs: [frames]
"""
HEAD = "photons,exposure_s,pixels,mean,variance\n"


def npy(value, dtype=np.float32, shape=(4, 4, 4)):
    def save(path):
        data = np.full(shape, 0.5, dtype)
        data.flat[0] = value
        np.save(path, data)

    return save


def large_npy(path):
    """A file of 128 bytes that states 10^12 values."""
    with path.open("wb") as file:
        np.lib.format.write_array_header_1_0(
            file, {"descr": "<f4", "fortran_order": False, "shape": (10_000, 10_000, 10_000)}
        )


def text(content):
    return lambda path: path.write_bytes(content.encode())


def grey(path, count=None, values=None):
    """Write a picture of random grey levels, or the first ``count`` bytes of this picture."""
    from PIL import Image

    levels = (
        np.random.default_rng(3).integers(0, 65535, (40, 40), np.uint16)
        if values is None
        else values
    )
    Image.fromarray(levels).save(path)
    path.write_bytes(path.read_bytes()[:count])


FILES = {
    "truncated PNG frame": (FRAMES, lambda path: grey(path, 900), "a.png is damaged"),
    "truncated TIFF frame": (
        FRAMES.replace("png", "tif"),
        lambda path: grey(path, 2000),
        "a.tif is damaged",
    ),
    "colour frame": (
        FRAMES,
        lambda path: grey(path, values=np.zeros((4, 4, 3), np.uint8)),
        "not raw grey",
    ),
    "complex frame": (
        FRAMES.replace("png", "npy"),
        npy(1, np.complex64),
        "values of type complex64",
    ),
    "NaN in a cube": (CUBE, npy(np.nan), "a.npy holds 1 values that are not finite"),
    "complex cube": (CUBE, npy(1, np.complex64), "values of type complex64"),
    "large cube": (CUBE, large_npy, "a.npy cannot be read"),
    "cube of two axes": (CUBE, npy(1, shape=(4, 4)), "save a cube with three axes"),
    "complex heights": (HEIGHT, npy(0, np.complex128, (4, 4)), "values of type complex128"),
    "NaN height": (HEIGHT, npy(np.nan, shape=(4, 4)), "every height must be finite"),
    "bad cell": (
        TABLE,
        text(HEAD + "0,1,100,5,x1\n"),
        "a.csv:2: column variance: 'x1' is not valid",
    ),
    "semicolons": (
        TABLE,
        text(HEAD.replace(",", ";") + "0;1;100;5;6\n"),
        "separates its columns by semicolons",
    ),
    "tabs": (
        TABLE,
        text(HEAD.replace(",", "\t") + "0\t1\t100\t5\t6\n"),
        "separates its columns by tabs",
    ),
    "no rows": (TABLE, text(HEAD), "has no line below the header"),
    "bad reflectance": (
        REFLECTANCES,
        text("nm,a\n380,0.5\n780,high\n"),
        "a.csv:3: 'high' is not a number",
    ),
    "reflectances by ;": (
        REFLECTANCES,
        text("nm;a\n380;0.5\n780;0.5\n"),
        "separates its columns by semicolons",
    ),
}


@pytest.mark.parametrize(("recipe", "make", "said"), FILES.values(), ids=FILES)
def test_the_content_of_every_other_file_is_checked(neusee, tmp_path, recipe, make, said):
    (tmp_path / "mine.yaml").write_text(recipe)
    make(tmp_path / re.search(r"file: (a\.\w+)", recipe)[1])
    code, out, err = neusee("run", "mine.yaml")
    assert (code, out) == (2, "")
    assert err.startswith("mine.yaml:2:14   file.file = a.")
    assert said in err


def test_a_file_that_is_repaired_is_read_again(refused, neusee, tmp_path):
    bad_exr(tmp_path, np.nan)
    refused("scene=night", "scene.file=a.exr")
    bad_exr(tmp_path, 0.25)
    assert neusee("validate", "first_light", "scene=night", "scene.file=a.exr")[0] == 0


def test_one_part_of_a_file_with_several_is_chosen_by_name(neusee, tmp_path):
    parts_exr(tmp_path, "left", "right")
    words = ("validate", "first_light", "scene=night", "scene.file=a.exr")
    assert neusee(*words, "steps.scene.with.part=right")[0] == 0
    code, _, err = neusee(*words, "steps.scene.with.part=middle")
    assert code == 2
    assert "a.exr has no part 'middle': name one of left, right" in err


# --- limits ---------------------------------------------------------------------------------------

LIMITED = """\
# A limit.
a: {A}
seven: {S}
steps:
  stop: {node: optics.stop, with: {samples: "${seven.samples}", pitch: 10 um, diameter: 70 um}}
  more: {node: optics.stop, with: "${a.a0}"}
outputs: [stop]
"""


def chain(link):
    """Twelve levels, each with nine references to the next: 9^12 values at the top."""
    levels = [f"  a{n}: {link.replace('#', str(n + 1))}" for n in range(12)]
    return LIMITED.replace("{A}", "\n" + "\n".join(levels) + "\n  a12: x").replace(
        "{S}", "{samples: 7}"
    )


def many(count):
    rows = "".join(f"  s{n}: {{node: doe.flat, from: stop}}\n" for n in range(count))
    return (
        LIMITED.partition("  more")[0].replace("{A}", "{}").replace("{S}", "{samples: 7}")
        + rows
        + "outputs: [stop]"
    )


def product(one, other):
    lists = "".join(
        f"{name}:\n" + "".join(f"  {name}{n}: {{}}\n" for n in range(count))
        for name, count in (("p", one), ("q", other))
    )
    step = "  s: {node: doe.flat, each: [p, q], from: stop}\n"
    head = LIMITED.partition("  more")[0].replace("a: {A}\n", "").replace("{S}", "{samples: 7}")
    return head + step + "outputs: [stop]\n" + lists


LIMITS = {
    "text": (
        chain('"' + "${a.a#}" * 9 + '"'),
        "a.a6   references expand this text to more than 100000 characters",
    ),
    "list": (
        chain("[" + ", ".join(['"${a.a#}"'] * 9) + "]"),
        "references expand this value to more than 100000 values",
    ),
    "mapping": (
        chain("{" + ", ".join(f'k{i}: "${{a.a#}}"' for i in range(9)) + "}"),
        "references expand this value to more than 100000 values",
    ),
    "each": (
        product(3000, 3000),
        "steps.s.each   makes 3000 p x 3000 q = 9000000 steps, more than the limit of 20000",
    ),
    "each, by two": (
        product(20, 1001),
        "makes 20 p x 1001 q = 20020 steps, more than the limit of 20000",
    ),
    "file": (
        many(100) + "#" * 4_000_000,
        "more than the limit of 4000000: split the recipe into groups",
    ),
}


@pytest.mark.slow
@pytest.mark.parametrize(("recipe", "said"), LIMITS.values(), ids=LIMITS)
def test_a_recipe_that_grows_beyond_a_limit_is_refused_with_the_limit(
    neusee, tmp_path, recipe, said
):
    (tmp_path / "mine.yaml").write_text(recipe)
    code, out, err = neusee("validate", "mine.yaml")
    assert (code, out) == (2, "")
    assert said in err
    assert "\n1 problem," in err


def test_the_limit_of_steps_counts_the_steps_and_their_copies(neusee, tmp_path, monkeypatch):
    from neusee.workflows.recipe import steps

    monkeypatch.setattr(steps, "_MOST_STEPS", 30)
    (tmp_path / "mine.yaml").write_text(many(29))
    assert neusee("validate", "mine.yaml")[0] == 0
    (tmp_path / "mine.yaml").write_text(many(30))
    code, _, err = neusee("validate", "mine.yaml")
    assert code == 2
    assert "steps.s29   with this step the recipe has 31 steps, more than the limit of 30" in err


# --- the folder of results ------------------------------------------------------------------------

COMMANDS = (
    ("run", "first_light"), ("sweep", "first_light", "sensor.c2=0,1"), ("train", "train_small"),
    ("evaluate", "first_light"), ("calibrate", "camera"), ("study", "stability", "first_light"),
    ("study", "uncertainty", "first_light"),
)  # fmt: skip


@pytest.mark.parametrize("words", COMMANDS, ids=" ".join)
def test_a_folder_that_cannot_hold_results_is_refused_before_any_work(neusee, tmp_path, words):
    (tmp_path / "taken").write_text("a file")
    for out in ("taken", "taken/runs"):
        code, said, err = neusee(*words, "--out", out)
        assert (code, said) == (2, "")
        assert (
            err == f"--out: {'taken' if out == 'taken' else tmp_path / 'taken'} is not a folder, so"
            f" that no results can be written to {out}: name another folder with --out\n"
        )
    assert not (tmp_path / "cache").exists()


def test_a_folder_that_the_system_does_not_let_us_write_is_refused(neusee, tmp_path, monkeypatch):
    """As `os.mkdir` says it for a read-only file system; the rights of a folder do not bind the
    root of a machine.
    """
    import errno
    import tempfile

    def refuse(**options):
        raise OSError(errno.EROFS, "Read-only file system")

    monkeypatch.setattr(tempfile, "mkdtemp", refuse)
    code, said, err = neusee("run", "first_light")
    assert (code, said) == (2, "")
    assert err.startswith(f"--out: the folder {tmp_path} cannot be written (Read-only file system)")


def test_a_python_call_refuses_such_a_folder_too(tmp_path):
    import neusee

    (tmp_path / "taken").write_text("a file")
    with pytest.raises(ValueError, match="is not a folder"):
        neusee.study("first_light", kind="stability", out=tmp_path / "taken")


def test_the_check_of_the_folder_leaves_nothing(neusee, tmp_path):
    from neusee.workflows.report.run_folder import writable_folder

    assert writable_folder(tmp_path / "runs" / "mine") == tmp_path / "runs" / "mine"
    assert list(tmp_path.iterdir()) == []


# --- words of the command line, and values of one's own recipe ------------------------------------


@pytest.mark.parametrize(
    ("words", "said"),
    [
        (("sensor.read_noise=20", "e-"), "e-: not a change of a value: quote a value that has a space: "
         "'sensor.read_noise=20 e-'\n"),
        (("seed=1", "lasers.green.angle=[0", "deg,", "1", "deg]", "seed=2"), "'lasers.green.angle=[0 deg, 1 deg]'\n"),
    ],
)  # fmt: skip
def test_a_value_with_a_space_needs_quotes(neusee, words, said):
    for command in ("run", "validate", "sweep", "evaluate"):
        code, out, err = neusee(command, "first_light", *words)
        assert (code, out) == (2, "")
        assert err.endswith(said)


def test_a_file_of_ones_own_recipe_is_no_mistake_with_a_scene_that_has_no_file(neusee, tmp_path):
    picture(tmp_path, ".png")
    groups = (
        "camera: neusee, scene: china, illuminant: daylight, lift: lmmse, laser: green, optics:"
        " small, sensor: small"
    )
    groups += ", doe: five_half_rings, flare: clean, restore: wiener, reading: coherent"
    defaults = "".join(f"  - {group}\n" for group in groups.split(", "))
    (tmp_path / "mine.yaml").write_text(
        f"# Mine.\ndefaults:\n{defaults}scene: {{file: a.png}}\noutputs: [raw]\n"
    )
    assert "not used" not in neusee("validate", "mine.yaml")[1]
    code, out, _ = neusee("validate", "mine.yaml", "scene=siemens")
    assert code == 0
    assert "note     scene.file (mine.yaml:14:15) is not used with scene=siemens\n" in out
    code, out, _ = neusee("config", "mine.yaml", "scene=siemens")
    assert code == 0
    assert "a.png" not in out
    code, _, err = neusee("validate", "mine.yaml", "scene=siemens", "scene.file=a.png")
    assert code == 2
    assert "argument 3   scene.file   unknown: no step refers to this value" in err


def test_the_guide_states_each_limit_as_the_program_has_it():
    from neusee.nodes import input_files
    from neusee.workflows.recipe import steps
    from neusee.workflows.recipe.text import references, yaml_values
    from neusee.workflows.recipe.text.recipe_files import packaged

    text = (packaged() / "guide" / "recipes.md").read_text(encoding="utf-8")
    stated = [
        int(number.replace(" ", ""))
        for number in re.findall(r"^\|[^|]+\| ([\d ]+) \|$", text, re.MULTILINE)
    ]
    assert references._MOST_VALUES == references._MOST_CHARACTERS
    assert stated == [
        steps._MOST_STEPS,
        yaml_values._MOST_BYTES,
        references._MOST_VALUES,
        yaml_values._MOST_ALIASED_VALUES,
        _bands._MOST_BANDS,
        input_files.PIXELS,
        input_files.VALUES,
        input_files.ROWS,
    ]


READS_A_VARIABLE = '''import os

from neusee.nodes import node


@node()
def gain_of_day():
    """Return the gain of the day."""
    return float(os.environ.get("GAIN_OF_DAY", 2))
'''


def test_own_code_that_no_key_covers_ends_with_the_code_of_a_mistake(neusee, tmp_path):
    (tmp_path / "reads_a_variable.py").write_text(READS_A_VARIABLE)
    (tmp_path / "r.yaml").write_text(
        "nodes: [reads_a_variable.py]\nsteps: {mine: {node:"
        " reads_a_variable.gain_of_day}}\noutputs: [mine]\n"
    )
    code, _, err = neusee("run", "r.yaml", "--out", "runs")
    assert code == 2
    assert re.search(
        r"^\S*reads_a_variable.py:9: os.environ.get: .* depends=\[\"env:GAIN_OF_DAY\"\]",
        err,
        re.MULTILINE,
    )
