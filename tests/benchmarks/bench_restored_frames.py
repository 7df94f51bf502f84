"""How near the restored picture is to the scene, for frames of a camera that the recipe describes
wrongly.

    python tests/benchmarks/bench_restored_frames.py results.jsonl --seeds 0 4 --pictures
    photographs/ python tests/benchmarks/bench_restored_frames.py results.jsonl --report

The frames come from `tests/nodes/restore/lasers/own_camera.py`, a camera in NumPy alone, with an
error that nobody is told of: 0.1 wave of defocus at the rim, half a pixel of tilt, grains of dirt
in the pupil, and another illuminant. Each frame is restored by `neusee restore` with the recipe of
the clean camera: by the filter that knows of no laser, by the filter that is told direction and
wavelength, by the search, and by the network of this package after the search. Beside them stands
the frame as developed, without a restoration. A picture is scored after a shift and one gain for
each channel, which no frame can tell, as PSNR of the encoded picture away from its border. A frame
that stands in the file is not computed again.
"""

import argparse
import contextlib
import functools
import io
import json
import sys
import tempfile
import time
from pathlib import Path
from unittest.mock import patch

import colour
import numpy as np
import torch
from PIL import Image
from safetensors.numpy import load_file
from scipy.optimize import minimize
from scipy.stats import t as student

ROOT = Path(__file__).parents[2]
sys.path.insert(0, str(ROOT))

from neusee.workflows.cli import app  # noqa: E402
from tests.nodes.restore.lasers import own_camera as own  # noqa: E402

SIDE, RIM = 128, 8
MASKS = ("plain", "half_ring", "designed")
STRENGTHS = (0.0, 1e1, 1e2, 1e3, 1e4, 1e5, 1e6)
WEIGHTS = ROOT / "recipes" / "samples" / "neusee_network.safetensors"
METHODS = ("nothing", "blind", "told", "search", "network")
#: of recipes/doe/demonstration
DESIGNED, DEPTH = ROOT / "recipes" / "samples" / "demonstration_mask.png", 33.9189e-6

CAMERA = """\
defaults:
  - camera: neusee
  - scene: china
  - illuminant: daylight
  - lift: lmmse
  - laser: none
  - optics: own
  - sensor: own
  - doe: flat
  - flare: clean
  - restore: wiener_blind
  - reading: coherent
seed: 7
"""
#: the network of this package after the search, which is no option that ships, for it gains nothing
#: there
NETWORK = (
    (ROOT / "recipes" / "restore" / "search.yaml")
    .read_text()
    .replace("node: restore.wiener\n", "node: restore.informed\n")
    .replace(
        "    with:\n      balance:",
        f"    with:\n      weights: {WEIGHTS}\n      width: 12\n      balance:",
    )
)
OPTICS = f"""\
defaults: [small]
optics:
  focal_length: {own.FOCAL} m
  diameter: {own.DIAMETER} m
  samples: {own.SAMPLES}
  pitch: {own.DIAMETER / own.SAMPLES * 1e6:.8f} um
  window: [{SIDE}, {SIDE}]
"""
SENSOR = f"""\
defaults: [small]
sensor:
  shape: [{SIDE}, {SIDE}]
  pixel_pitch: {own.PITCH * 1e6} um
  sampling: point
  camera: own.csv
  full_well: {own.WELL} e-
  read_noise: {own.READ} e-
  offset: {own.OFFSET} e-
  gain: {own.GAIN} DN/e-
  bits: {own.BITS}
"""

FILES = {
    "camera.yaml": CAMERA,
    "optics/own.yaml": OPTICS,
    "sensor/own.yaml": SENSOR,
    "restore/network.yaml": NETWORK,
}

# --- the true camera ------------------------------------------------------------------------------

own_pupil = own.pupil


def tilt_of(seed):
    """Pixels (y, x) by which the tilt of a seed moves the picture, half a pixel in all."""
    towards = np.random.default_rng([seed, 99]).uniform(0, 2 * np.pi)
    return 0.5 * np.cos(towards), 0.5 * np.sin(towards)


@functools.lru_cache(64)
def true_pupil(name):
    """Aperture and height of a mask; a name such as `half_ring~3` has the errors of seed 3."""
    mask, _, seed = name.partition("~")
    if mask == "designed":
        inside = own_pupil("plain")[0]
        with Image.open(DESIGNED) as file:
            white = 65535.0 if file.mode.startswith("I") else 255.0
            grey = Image.fromarray(np.asarray(file, np.float32) / white)
        height = (
            np.asarray(grey.resize((own.SAMPLES, own.SAMPLES), Image.Resampling.BILINEAR), float)
            * DEPTH
        )
    else:
        inside, height = own_pupil(mask)
    if not seed:
        return inside, height * inside
    rng = np.random.default_rng([int(seed), 99])
    at = (np.arange(own.SAMPLES) - (own.SAMPLES - 1) / 2) / (own.SAMPLES / 2)
    v, u = np.meshgrid(at, at, indexing="ij")
    rng.uniform()  # which has drawn the tilt
    down, right = tilt_of(int(seed))
    tilt = own.PITCH * (own.DIAMETER / 2) / own.FOCAL * (v * down + u * right)
    path = rng.choice([-1, 1]) * 0.1 * 550e-9 * (v**2 + u**2) + tilt
    clean = np.ones_like(inside)
    for y, x, r in zip(*rng.uniform(-1, 1, (2, 40)), rng.uniform(0.01, 0.04, 40), strict=True):
        clean[(v - y) ** 2 + (u - x) ** 2 < r**2] = 0
    return inside * clean, (height + path / own.silica(550e-9)) * inside


@functools.cache
def observer():
    """Linear sRGB of light of each band, for a white that the illuminant lights (channel, band)."""
    functions = colour.MSDS_CMFS["CIE 1931 2 Degree Standard Observer"]
    seen = functions[own.BANDS * 1e9].T * own.daylight(own.BANDS)
    seen = seen / seen[1].sum()
    white = colour.xy_to_XYZ(colour.CCS_ILLUMINANTS["CIE 1931 2 Degree Standard Observer"]["D65"])
    adapted = colour.adaptation.matrix_chromatic_adaptation_VonKries(
        seen.sum(1), white, transform="Bradford"
    )
    return colour.RGB_COLOURSPACES["sRGB"].matrix_XYZ_to_RGB @ adapted @ seen


def photographs(folder):
    """Let the camera take crops of the photographs of a folder; returns the function in place of
    `own.picture`.
    """
    files = sorted(p for p in folder.iterdir() if p.suffix.lower() in (".jpg", ".png"))

    def picture(kind, side, rng):
        with Image.open(files[int(kind) % len(files)]) as file:
            whole = np.asarray(file.convert("RGB"), float) / 255
        y, x = (int(rng.integers(0, n - side + 1)) for n in whole.shape[:2])
        return whole[y : y + side, x : x + side] ** 2.2

    return picture


def taken(mask, strength, seed, kind, picture):
    """A frame in digital numbers (y, x, 3), the linear sRGB of its scene (3, y, x), and the
    laser.
    """
    rng = np.random.default_rng([seed, *mask.encode(), int(strength)])
    kept = []

    def remembered(*arguments):
        kept.append(picture(*arguments))
        return kept[-1]

    spot, wavelength = tuple(rng.uniform(-0.35, 0.35, 2) * SIDE), rng.uniform(420e-9, 670e-9)
    laser = own.Laser(spot, wavelength, strength)
    with patch.object(own, "pupil", true_pupil), patch.object(own, "picture", remembered):
        light = own.irradiance(f"{mask}~{seed}", kind, SIDE, rng)
        if strength:
            light = light + laser.electrons(f"{mask}~{seed}", (SIDE, SIDE))
    electrons, _ = own.digitized(light, rng)
    numbers = np.rint((electrons + own.OFFSET) * own.GAIN).astype(np.uint16)
    rim = SIDE // 2
    inner = kept[0][rim : rim + SIDE, rim : rim + SIDE]
    basis = np.stack(
        [np.exp(-0.5 * ((own.BANDS - c) / 45e-9) ** 2) for c in (610e-9, 545e-9, 460e-9)]
    )
    basis /= basis.sum(0) + 0.05
    return numbers.transpose(1, 2, 0), np.einsum("cb,kb,yxk->cyx", observer(), basis, inner), laser


# --- the program ----------------------------------------------------------------------------------


def written_camera(folder):
    """Write the recipe of the clean camera and its masks; return the recipe's path."""
    for name, text in FILES.items():
        path = folder / name
        path.parent.mkdir(exist_ok=True)
        path.write_text("# The clean camera.\n" + text)
    fine = np.arange(390e-9, 711e-9, 1e-9)
    rows = [f"{w * 1e9:.0f}," + ",".join(f"{v:.8f}" for v in own.response(w)) for w in fine]
    (folder / "sensor" / "own.csv").write_text(
        "\n".join(["wavelength (nm),red (1),green (1),blue (1)", *rows]) + "\n"
    )
    for mask in MASKS:
        inside, height = true_pupil(mask)
        # a glass has no height below 0
        np.save(folder / f"{mask}.npy", (height - height.min()) * inside)
    return folder / "camera.yaml"


def outputs_of(numbers, mask, words, outputs, folder, load=load_file):
    """The named outputs of `neusee restore` for a frame and a mask, with further words of the
    command.
    """
    np.save(folder / "frame.npy", numbers)
    told = io.StringIO()
    with (
        tempfile.TemporaryDirectory() as out,
        contextlib.redirect_stdout(told),
        contextlib.redirect_stderr(told),
    ):
        try:
            app.main(
                [
                    "restore",
                    str(folder / "frame.npy"),
                    "--camera",
                    str(folder / "camera.yaml"),
                    "--mask",
                    str(folder / f"{mask}.npy"),
                    *words,
                    f"outputs={json.dumps(outputs)}",
                    "--out",
                    out,
                ]
            )
        except SystemExit as end:
            if end.code not in (0, 3):
                raise RuntimeError(told.getvalue()) from None
        return load(str(next(Path(out).glob("*/data/outputs.safetensors"))))


def restored(numbers, mask, method, laser, folder):
    """What `neusee restore` returns for a frame, linear sRGB (3, y, x), its numbers of lasers,
    and processor time.
    """
    options = {"blind": "wiener_blind", "nothing": "wiener_blind"}
    words = [f"restore={options.get(method, method)}"]
    if method == "told":
        y, x = (1e3 * s * own.PITCH / own.FOCAL for s in laser.spot)
        line = f"wavelength: {laser.wavelength * 1e9} nm, fwhm: {laser.fwhm * 1e9} nm, strength: 1"
        words = ["restore=wiener", f"lasers={{it: {{{line}, angle: [{y} mrad, {x} mrad]}}}}"]
        words = words if laser.strength else ["restore=wiener"]
    outputs = [
        "restored",
        "developed[mask]",
        *(["search"] if method in ("search", "network") else []),
    ]
    start = time.process_time()
    results = outputs_of(numbers, mask, words, outputs, folder)
    number = next(
        (int(v) for k, v in results.items() if k.startswith("search") and k.endswith("number")),
        None,
    )
    picture = results["developed[mask]" if method == "nothing" else "restored"]
    return picture.astype(float), number, time.process_time() - start


# --- the score ------------------------------------------------------------------------------------


def encoded(x):
    x = np.clip(x, 0, 1)
    return np.where(x <= 0.0031308, 12.92 * x, 1.055 * x ** (1 / 2.4) - 0.055)


def score(picture, truth):
    """PSNR in dB after the best shift within two pixels and the gains that bring the medians
    together.
    """
    scale = np.percentile(truth, 99.5)
    truth = truth / scale
    gains = np.median(truth, (1, 2)) / np.maximum(np.median(picture, (1, 2)), 1e-9)
    spectrum = np.fft.fft2(encoded(picture * gains[:, None, None]))
    fy, fx = np.fft.fftfreq(SIDE)[:, None], np.fft.fftfreq(SIDE)
    aim = encoded(truth)[:, RIM:-RIM, RIM:-RIM]

    def error(shift):
        moved = np.fft.ifft2(spectrum * np.exp(-2j * np.pi * (fy * shift[0] + fx * shift[1]))).real
        return float(np.mean((np.clip(moved[:, RIM:-RIM, RIM:-RIM], 0, 1) - aim) ** 2))

    starts = [(y, x) for y in (-0.5, 0, 0.5) for x in (-0.5, 0, 0.5)]
    best = minimize(
        error,
        min(starts, key=error),
        method="Nelder-Mead",
        bounds=[(-2, 2)] * 2,
        options={"xatol": 0.02},
    )
    return -10 * np.log10(best.fun)


# --- runs and tables ------------------------------------------------------------------------------


def run(path, first, count, picture, kinds, masks, strengths, methods=METHODS):
    """Append the frames that the file lacks."""
    done = {(r["seed"], r["mask"], r["strength"], r["method"]) for r in rows(path)}
    with tempfile.TemporaryDirectory() as place:
        folder = Path(place)
        written_camera(folder)
        for seed in range(first, first + count):
            for mask in masks:
                for strength in strengths:
                    todo = [m for m in methods if (seed, mask, strength, m) not in done]
                    if not todo:
                        continue
                    kind = kinds[seed % len(kinds)]
                    numbers, truth, laser = taken(mask, strength, seed, kind, picture)
                    for method in todo:
                        shown, number, seconds = restored(numbers, mask, method, laser, folder)
                        each = {
                            "seed": seed,
                            "mask": mask,
                            "strength": strength,
                            "method": method,
                            "kind": str(kind),
                            "psnr": round(score(shown, truth), 3),
                            "number": number,
                            "seconds": round(seconds, 1),
                        }
                        with path.open("a") as file:
                            file.write(json.dumps(each) + "\n")


def rows(path):
    return [json.loads(line) for line in path.read_text().splitlines()] if path.exists() else []


def report(found):
    """Print the means of the methods that were run, and the paired gains of the search with
    their 95 % intervals.
    """
    methods = [m for m in METHODS if any(r["method"] == m for r in found)]
    by = {(r["seed"], r["mask"], r["strength"], r["method"]): r["psnr"] for r in found}
    whole = {key[:3] for key in by if all((*key[:3], m) in by for m in methods)}
    print(f"mask, strength: frames, PSNR of {', '.join(methods)}; search over each other (dB)")
    for mask in (*MASKS, "all"):
        for strength in STRENGTHS:
            frames = sorted(k for k in whole if k[2] == strength and mask in (k[1], "all"))
            if frames:
                table = {m: np.array([by[(*k, m)] for k in frames]) for m in methods}
                gains = [
                    f"{m} {interval(table['search'] - table[m])}" for m in methods if m != "search"
                ]
                means = " ".join(f"{v.mean():6.2f}" for v in table.values())
                print(f"{mask:9} {strength:7g}: {len(frames):3}  {means}   {'  '.join(gains)}")


def interval(gain):
    """Mean, 95 % interval and least value of paired gains."""
    half = (
        student.ppf(0.975, len(gain) - 1) * gain.std(ddof=1) / len(gain) ** 0.5
        if len(gain) > 1
        else np.inf
    )
    return (
        f"{gain.mean():+.2f} ({gain.mean() - half:+.2f} to {gain.mean() + half:+.2f}, least"
        f" {gain.min():+.2f})"
    )


if __name__ == "__main__":
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("file", type=Path)
    parser.add_argument("--seeds", type=int, nargs=2, metavar=("FIRST", "COUNT"))
    parser.add_argument(
        "--pictures", type=Path, help="folder of photographs in place of the three made kinds"
    )
    parser.add_argument("--masks", nargs="+", default=MASKS)
    parser.add_argument("--strengths", type=float, nargs="+", default=STRENGTHS)
    parser.add_argument("--methods", nargs="+", default=METHODS, choices=METHODS)
    parser.add_argument("--report", action="store_true")
    given = parser.parse_args()
    torch.set_num_threads(1)
    if given.seeds:
        shots = (
            (photographs(given.pictures), range(10**6))
            if given.pictures
            else (own.picture, ("sample", "leaves", "noise"))
        )
        run(given.file, *given.seeds, *shots, given.masks, given.strengths, given.methods)
    if given.report:
        report(rows(given.file))
