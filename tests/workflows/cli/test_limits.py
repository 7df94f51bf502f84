"""Each named limit of input files and recipes: just below it a recipe is valid, just above it is
refused with it.
"""

import math

import numpy as np
import pytest
import torch

from neusee.nodes import input_files
from neusee.nodes.calibrate import _frame_files as _damaged_frames
from neusee.workflows.cli import app

HEAD = "# A limit.\noutputs: [{step}]\nfile: {{file: {file}}}\nsteps:\n"
STOP = "  stop: {{node: optics.stop, with: {{samples: {n}, pitch: 10 um, diameter: 40 um}}}}\n"
BANDS = "  bands: {{node: spectra.bands, with: {{start: 400 nm, stop: 700 nm, count: {n}}}}}\n"
FILE = '"${{file.file}}"'
RECIPES = {
    "photograph": "  photograph: {{node: scene.photograph, with: {{file: " + FILE + ", shape: [4, 4]}}}}\n",
    "exr": "  exr: {{node: scene.exr, with: {{file: " + FILE + ", shape: [4, 4]}}}}\n",
    "cube": BANDS + "  cube: {{node: scene.hyperspectral, from: bands, with: {{file: " + FILE + ", start: 400 nm, "
    "stop: 700 nm}}}}\n",
    "height": STOP + "  height: {{node: doe.pixelwise, from: stop, with: {{file: " + FILE + "}}}}\n",
    "frames": "  frames: {{node: calibrate.frames, with: {{files: " + FILE + "}}}}\n",
    "levels": "  levels: {{node: calibrate.table, with: {{file: " + FILE + "}}}}\n",
    "spectra": BANDS + "  spectra: {{node: spectra.reflectances, from: bands, with: {{sets: [], files: "
    "" + FILE + "}}}}\n",
    "net": "  scene: {{node: scene.targets, with: {{kind: siemens, shape: [32, 32]}}}}\n"
    "  net: {{node: restore.unet, from: scene, with: {{width: 4, weights: " + FILE + "}}}}\n",
}  # fmt: skip


@pytest.fixture
def validate(tmp_path, monkeypatch, capfd):
    """Check a recipe of one file; give the exit code and what is printed."""
    monkeypatch.chdir(tmp_path)
    monkeypatch.setenv("NEUSEE_CACHE", str(tmp_path / "cache"))

    def validate(text):
        (tmp_path / "mine.yaml").write_text(text)
        with pytest.raises(SystemExit) as end:
            app.main(["validate", "mine.yaml"])
        return end.value.code or 0, "".join(capfd.readouterr())

    return validate


def recipe(step, file, n=4):
    return (HEAD + RECIPES[step]).format(step=step, file=file, n=n)


# --- files, with limits that are lowered for the test ---------------------------------------------


def picture(path, n):
    from PIL import Image

    Image.fromarray(np.arange(40 * n * 3, dtype=np.uint8).reshape(40, n, 3)).save(path)


def exr(path, n):
    import OpenEXR

    OpenEXR.File({}, {c: np.full((40, n), 0.5, np.float32) for c in "RGB"}).write(str(path))


def spectral(path, n):
    import OpenEXR

    OpenEXR.File(
        {}, {f"S0.{w},0nm": np.full((4, n), 0.5, np.float32) for w in (400, 500, 600, 700)}
    ).write(str(path))


def npy(shape, kind=np.float32, value=1):
    return lambda path, n: np.save(path, np.full((*shape, n), value, kind))


def matlab(path, n):
    from scipy.io import savemat

    savemat(path, {"cube": np.ones((4, n, 4))})


def fits(path, n):
    astropy = pytest.importorskip("astropy.io.fits")
    astropy.PrimaryHDU(np.ones((4, n), np.uint16)).writeto(path)


def table(path, n):
    lines = [f"{1e3 * i},1,100,{5 + i},6" for i in range(n)]
    path.write_text("\n".join(["photons,exposure_s,pixels,mean,variance", *lines]) + "\n")


def reflectances(path, n):
    path.write_text("nm,a\n" + "".join(f"{380 + 10 * i},0.5\n" for i in range(n)))


#: by name: step, file, writer, size at the limit, name of the limit, its value, and what is said
#: one above it
FILES = {
    "PNG": (
        "photograph",
        "a.png",
        picture,
        40,
        "PIXELS",
        1600,
        "a.png has 41 x 40 pixels, more than the limit of",
    ),
    "JPEG": (
        "photograph",
        "a.jpg",
        picture,
        40,
        "PIXELS",
        1600,
        "a.jpg has 41 x 40 pixels, more than the limit of",
    ),
    "EXR": (
        "exr",
        "a.exr",
        exr,
        40,
        "PIXELS",
        1600,
        "a.exr has 41 x 40 pixels, more than the limit of",
    ),
    "cube": (
        "cube",
        "a.npy",
        npy((4, 5)),
        4,
        "VALUES",
        80,
        "a.npy has 4 x 5 x 5 values, more than the limit of",
    ),
    "MATLAB": (
        "cube",
        "a.mat",
        matlab,
        5,
        "VALUES",
        80,
        "a.mat has 4 x 6 x 4 values, more than the limit of",
    ),
    "spectra": (
        "cube",
        "a.exr",
        spectral,
        5,
        "VALUES",
        80,
        "a.exr has 4 x 4 x 6 values, more than the limit of",
    ),
    "heights": (
        "height",
        "a.npy",
        npy((4,), value=1e-6),
        4,
        "VALUES",
        16,
        "a.npy has 4 x 5 values, more than the limit of",
    ),
    "frames": (
        "frames",
        "a.npy",
        npy((4,), np.uint16),
        4,
        "VALUES",
        16,
        "a.npy has 20 values, more than the limit of",
    ),
    "FITS": (
        "frames",
        "a.fits",
        fits,
        4,
        "VALUES",
        16,
        "a.fits has 20 values, more than the limit of",
    ),
    "table": (
        "levels",
        "a.csv",
        table,
        8,
        "ROWS",
        8,
        "a.csv has more than 8 rows: give a shorter table",
    ),
    "reflectances": (
        "spectra",
        "a.csv",
        reflectances,
        41,
        "ROWS",
        41,
        "a.csv has more than 41 rows",
    ),
}


@pytest.mark.parametrize(
    ("step", "file", "write", "n", "limit", "most", "said"), FILES.values(), ids=FILES
)
def test_a_file_at_the_limit_is_read_and_a_larger_one_is_refused(
    validate, tmp_path, monkeypatch, step, file, write, n, limit, most, said
):
    monkeypatch.setattr(input_files, limit, most)
    if hasattr(_damaged_frames, limit):
        monkeypatch.setattr(_damaged_frames, limit, most)
    write(tmp_path / file, n)
    code, told = validate(recipe(step, file))
    assert code == 0, told
    (tmp_path / file).unlink()
    write(tmp_path / file, n + 1)
    code, told = validate(recipe(step, file))
    assert code == 2
    assert told.startswith(f"mine.yaml:3:14   file.file = {file}   ")
    assert said in told


def test_arrays_and_tables_at_the_shipped_limits(tmp_path):
    """Headers of 10^9 values on a disk that stores no zeros, and 10^6 rows."""
    from neusee.nodes import ParameterError
    from neusee.nodes.scene._hyperspectral import size_and_type

    def cube(*shape):
        with (tmp_path / "a.npy").open("wb") as file:
            head = {"descr": "|u1", "fortran_order": False, "shape": shape}
            np.lib.format.write_array_header_1_0(file, head)
            file.truncate(file.tell() + math.prod(shape))
        return tmp_path / "a.npy"

    assert size_and_type(cube(1000, 1000, 1000), None)[0] == (1000, 1000, 1000)
    with pytest.raises(
        ParameterError, match=r"1 x 1 x 1000000001 values, more than the limit of 1000 million"
    ):
        size_and_type(cube(1, 1, 10**9 + 1), None)
    (tmp_path / "a.csv").write_bytes(b"a\n" + b"1\n" * 1_000_000)
    assert sum(1 for _ in input_files.csv_rows(tmp_path / "a.csv")) == 1_000_001
    with (tmp_path / "a.csv").open("ab") as file:
        file.write(b"1\n")
    with pytest.raises(ValueError, match="has more than 1000000 rows"):
        sum(1 for _ in input_files.csv_rows(tmp_path / "a.csv"))


# --- recipes, at the limits that ship -------------------------------------------------------------

PLAIN = (HEAD + STOP).format(step="stop", file="x", n=4).replace("file: {file: x}\n", "")


def bands(n):
    return (HEAD + BANDS).format(step="bands", file="x", n=n).replace("file: {file: x}\n", "")


def padded(n):
    return PLAIN + "#" * (n - len(PLAIN.encode()) - 1) + "\n"


def referred(n):
    """A parameter made of a text of ten characters, again and again, and of single ones."""
    tens, ones = divmod(n, 10)
    text = "${a.ten}" * tens + "${a.one}" * ones
    head = PLAIN.replace("samples: 4", 'samples: "${a.all}"')
    return f'{head}a:\n  ten: "1234567890"\n  one: "1"\n  all: "{text}"\n'


LIMITS = [
    pytest.param(bands, 100_000, "100001 bands exceed the limit of 100000", id="bands"),
    pytest.param(
        padded, 4_000_000, "more than the limit of 4000000", id="bytes", marks=pytest.mark.slow
    ),
]


@pytest.mark.parametrize(("make", "most", "said"), LIMITS)
def test_a_recipe_at_the_limit_is_valid_and_a_larger_one_is_refused(validate, make, most, said):
    code, told = validate(make(most))
    assert code == 0, told
    code, told = validate(make(most + 1))
    assert code == 2
    assert said in told


def test_a_text_of_references_at_the_limit_is_expanded_and_a_longer_one_is_refused(validate):
    """The expanded text is no number of samples, which is said of the text of 100 000 characters
    alone.
    """
    limit = "references expand this text to more than 100000 characters"
    assert limit not in validate(referred(100_000))[1]
    assert limit in validate(referred(100_001))[1]


# --- FITS frames and network weights, opened before the run ---------------------------------------


def image(path, values, cut=None):
    astropy = pytest.importorskip("astropy.io.fits")
    astropy.PrimaryHDU(values).writeto(path)
    path.write_bytes(path.read_bytes()[:cut])


def odd(value):
    values = np.full((64, 64), 7, np.float32)
    values[3, 4] = value
    return values


FRAMES = {
    "NaN": (lambda path: image(path, odd(np.nan)), "holds nan, not a digital number"),
    "fraction": (lambda path: image(path, odd(0.5)), "holds 0.5, not a digital number"),
    "cut": (lambda path: image(path, np.ones((64, 64), np.uint16), 9000), "its image ends at byte 11072"),
    "cut header": (lambda path: image(path, np.ones((64, 64), np.uint16), 1000), "a.fits is damaged ("),
    "no image": (lambda path: image(path, None), "holds no image: give a FITS file with an image"),
    "four axes": (lambda path: image(path, np.ones((2, 2, 2, 2), np.uint16)), "shape (2, 2, 2, 2) is neither (y, x)"),
    "no FITS": (lambda path: path.write_bytes(b"no" * 3000), "a.fits is damaged (No SIMPLE card found"),
}  # fmt: skip


@pytest.mark.parametrize(("make", "said"), FRAMES.values(), ids=FRAMES)
def test_fits_frames_are_opened_before_the_run(validate, tmp_path, make, said):
    make(tmp_path / "a.fits")
    code, told = validate(recipe("frames", "a.fits"))
    assert code == 2
    assert told.startswith("mine.yaml:3:14   file.file = a.fits   ")
    assert said in told


@pytest.mark.parametrize("kind", ["plain", "scaled", "extension", "compressed"])
def test_right_fits_frames_are_no_mistake(validate, tmp_path, kind):
    fits = pytest.importorskip("astropy.io.fits")
    values = np.arange(64 * 64, dtype=np.uint16).reshape(64, 64) + 40_000
    part = {"extension": fits.ImageHDU, "compressed": fits.CompImageHDU}.get(kind, fits.PrimaryHDU)
    made = part(values.astype(np.float32) if kind == "scaled" else values)
    fits.HDUList(
        [made] if isinstance(made, fits.PrimaryHDU) else [fits.PrimaryHDU(), made]
    ).writeto(tmp_path / "a.fits")
    assert validate(recipe("frames", "a.fits"))[0] == 0


def test_other_frames_with_fractions_are_read_before_the_run(validate, tmp_path):
    np.save(tmp_path / "a.npy", odd(np.nan))
    code, told = validate(recipe("frames", "a.npy"))
    assert code == 2
    assert "a.npy holds nan, not a digital number" in told
    exr(tmp_path / "a.exr", 8)
    code, told = validate(recipe("frames", "a.exr"))
    assert "has the channels B, G, R: save one channel alone" in told


def weights(path, change=None, metadata=None):
    from safetensors.torch import save_file

    from neusee.nodes.network_weights import file_metadata
    from neusee.nodes.restore import UNet

    net = UNet(4)
    tensors = {name: tensor.clone() for name, tensor in net.state_dict().items()}
    if change is not None:
        next(reversed(tensors.values())).flatten()[0] = change
    save_file(tensors, path, {**file_metadata(net), **(metadata or {})})


WEIGHTS = {
    "NaN": (
        lambda path: weights(path, float("nan")),
        "holds 1 values that are not finite (NaN or infinity): train",
    ),
    "infinity": (lambda path: weights(path, float("-inf")), "holds 1 values that are not finite"),
    "options": (
        lambda path: weights(path, None, {"neusee.options": "{broken"}),
        "has damaged options ('{broken')",
    ),
    "cut": (
        lambda path: (weights(path), path.write_bytes(path.read_bytes()[:-9])),
        "is not a safetensors file",
    ),
    "shape": (lambda path: weights_of_width(path, 8), "this network (width 4) has"),
}


def weights_of_width(path, width):
    from safetensors.torch import save_file

    from neusee.nodes.restore import UNet

    save_file(UNet(width).state_dict(), path)


@pytest.mark.parametrize(("make", "said"), WEIGHTS.values(), ids=WEIGHTS)
def test_weights_of_a_network_are_opened_before_the_run(validate, tmp_path, make, said):
    make(tmp_path / "a.safetensors")
    code, told = validate(recipe("net", "a.safetensors"))
    assert code == 2
    assert told.startswith("mine.yaml:3:14   file.file = a.safetensors   ")
    assert said in told


def test_right_weights_are_no_mistake(validate, tmp_path):
    weights(tmp_path / "a.safetensors")
    assert validate(recipe("net", "a.safetensors"))[0] == 0


def test_a_height_network_and_a_lift_refuse_weights_that_are_not_finite(tmp_path):
    from safetensors.torch import save_file

    from neusee.nodes import ParameterError, doe, spectra
    from neusee.nodes.doe import HeightNet

    nets = {
        "height": HeightNet(4),
        "lift": spectra.start_mst_plus_plus(torch.Generator().manual_seed(0)),
    }
    for name, net in nets.items():
        tensors = {
            key: value.detach().clone().contiguous() for key, value in net.state_dict().items()
        }
        save_file(tensors, tmp_path / f"{name}.safetensors")
        next(iter(tensors.values())).view(-1)[0] = float("nan")
        save_file(tensors, tmp_path / f"{name}_nan.safetensors")
    checks = {
        "height": lambda file: doe.unet.hooks.preflight(width=4, weights=file),
        "lift": lambda file: spectra.lift_mst_plus_plus.hooks.preflight(weights=file),
    }
    for name, check in checks.items():
        assert check(tmp_path / f"{name}.safetensors") == []
        with pytest.raises(ParameterError, match="holds 1 values that are not finite"):
            check(tmp_path / f"{name}_nan.safetensors")
