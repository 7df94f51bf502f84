"""What a measured PSF adds to the search for lasers, where the lens is not in the focus that the
recipe says.

    python tests/benchmarks/bench_measured_psf.py --waves 0.4 --seeds 10 3

The camera is that of `bench_restored_frames.py` behind a plain lens, with grains of dirt, half a
pixel of tilt and ``waves`` of defocus at the rim, of which the recipe knows nothing. Its PSF comes
from six frames of a white point, half of them thirty times as long, and four dark ones. Each frame
is restored by the filter that knows of no laser and by the search, each with the PSF of the recipe
and with the measured one. The score is that of `bench_restored_frames.py`.
"""

import argparse
import contextlib
import inspect
import io
import json
import tempfile
from pathlib import Path
from unittest.mock import patch

import bench_restored_frames as frames
import numpy as np
import torch
from safetensors.numpy import load_file

from neusee.workflows.cli import app
from tests.nodes.restore.lasers import own_camera as own

MASK, WINDOW = "plain", 33
KINDS = ("sample", "leaves", "noise")
METHODS = {
    "blind": ["restore=wiener_blind"],
    "search": ["restore=search"],
    "psf": ["--psf"],
    "psf, search": ["--psf", "restore=search"],
}


def smaller(side, waves):
    """Let the camera have ``side`` pixels, and ``waves`` of defocus."""
    for name, before in (("OPTICS", "window"), ("SENSOR", "shape")):
        text = getattr(frames, name)
        old = f"{before}: [{frames.SIDE}, {frames.SIDE}]"
        assert old in text
        setattr(frames, name, text.replace(old, f"{before}: [{side}, {side}]"))
    source = inspect.getsource(frames.true_pupil.__wrapped__)
    assert "0.1 * 550e-9" in source
    frames.SIDE = side
    exec(source.replace("0.1 * 550e-9", f"{waves} * 550e-9"), vars(frames))


def write_points(folder, seed, count=6, dark=4):
    """Write frames of a white point through the true pupil, at parts of a pixel, and dark
    frames.
    """
    folder.mkdir()
    rng, shape = np.random.default_rng([seed, 5]), (frames.SIDE, frames.SIDE)
    weight = own.band_response() * own.daylight(own.BANDS) * own.BANDS
    with patch.object(own, "pupil", frames.true_pupil):
        for number in range(count):
            spot = rng.uniform(-0.5, 0.5, 2)
            psf = np.stack([own.pattern(f"{MASK}~{seed}", w, spot, shape) for w in own.BANDS])
            light = np.tensordot(weight, psf, 1)
            save(
                folder / f"p{number}.npy",
                0.6 * own.WELL * light / light.max() * (30 if number % 2 else 1),
                rng,
            )
    for number in range(dark):
        save(folder / f"dark{number}.npy", np.zeros((3, *shape)), rng)


def save(file, light, rng):
    electrons, _ = own.digitized(light, rng)
    np.save(file, np.rint((electrons + own.OFFSET) * own.GAIN).astype(np.uint16).transpose(1, 2, 0))


def restored(folder, words, outputs):
    """The outputs of `neusee restore` for the frame of a folder."""
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
                    str(folder / f"{MASK}.npy"),
                    *words,
                    f"outputs={json.dumps(outputs)}",
                    "--out",
                    out,
                ]
            )
        except SystemExit as end:
            if end.code not in (0, 3):
                raise RuntimeError(told.getvalue()) from None
        return load_file(str(next(Path(out).glob("*/data/outputs.safetensors"))))


def scores(folder, seed, strength):
    """The PSNR of a frame as developed, and restored by each method."""
    picture, truth, _ = frames.taken(MASK, strength, seed, KINDS[seed % 3], own.picture)
    np.save(folder / "frame.npy", picture)
    points = ["--psf", str(folder / f"points{seed}"), f"points.window=[{WINDOW},{WINDOW}]"]
    found = {}
    for name, words in METHODS.items():
        given = [each for word in words for each in (points if word == "--psf" else [word])]
        results = restored(folder, given, ["restored", "developed[mask]"])
        found["nothing"] = frames.score(results["developed[mask]"].astype(float), truth)
        found[name] = frames.score(results["restored"].astype(float), truth)
    return found


def main():
    """Print the score of each frame, and the means for each strength."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--waves", type=float, default=0.4)
    parser.add_argument("--side", type=int, default=96)
    parser.add_argument("--seeds", type=int, nargs=2, default=(10, 3), metavar=("FIRST", "COUNT"))
    parser.add_argument("--strengths", type=float, nargs="+", default=(0.0, 1e3, 1e5))
    given = parser.parse_args()
    torch.set_num_threads(1)
    smaller(given.side, given.waves)
    found = {}
    with tempfile.TemporaryDirectory() as place:
        folder = Path(place)
        frames.written_camera(folder)
        for seed in range(given.seeds[0], sum(given.seeds)):
            write_points(folder / f"points{seed}", seed)
            for strength in given.strengths:
                one = scores(folder, seed, strength)
                found.setdefault(strength, []).append(one)
                print(
                    seed,
                    strength,
                    {name: round(value, 2) for name, value in one.items()},
                    flush=True,
                )
    for strength, each in found.items():
        print(
            strength,
            {name: round(float(np.mean([one[name] for one in each])), 2) for name in each[0]},
        )


if __name__ == "__main__":
    main()
