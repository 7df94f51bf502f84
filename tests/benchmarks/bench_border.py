"""What the width of the unknown border does to the Wiener filter, with no laser.

    python tests/benchmarks/bench_border.py results.jsonl --pictures photographs/ --seeds 1100 3
    python tests/benchmarks/bench_border.py results.jsonl --report

Frames of `bench_restored_frames.py`: crops of photographs behind each mask, and crops of the sample
behind the designed mask whose scene is an even sky. Each is restored by the filter with an unknown
border as wide as the reach of the PSF, 1.5, 2 and 3 times as wide. The gains are those over the
frame as developed, in dB, the seconds of one processor.
"""

import argparse
import json
import sys
import tempfile
import time
from pathlib import Path

import numpy as np
import torch
from safetensors.torch import load_file

ROOT = Path(__file__).parents[2]
sys.path.insert(0, str(ROOT))

from neusee.nodes import restore  # noqa: E402
from neusee.nodes.values import Bands, Psf  # noqa: E402
from tests.benchmarks import bench_restored_frames as frames  # noqa: E402
from tests.nodes.restore.lasers import own_camera as own  # noqa: E402

EVEN = 0.04  #: standard deviation of an encoded scene, below which it counts as an even sky
OUTPUTS = [
    "developed[mask]",
    "signal[mask]",
    "clipped[mask]",
    "psf[mask]",
    "matrix",
    "illuminant",
    "responses",
    "bands",
]
BORDERS = (1.0, 1.5, 2.0, 3.0)


def inputs(numbers, mask, folder):
    """What the filter of `neusee restore` is given for a frame."""
    return frames.outputs_of(numbers, mask, ["restore=wiener_blind"], OUTPUTS, folder, load_file)


def gains(given, truth):
    """The gain of each filter over the frame as developed, and the PSNR of that, in dB."""
    psf = Psf(given["psf[mask].intensity"], given["psf[mask].clear_peak"])
    bands = Bands(*(given[f"bands.{name}"] for name in ("centres", "widths", "weights")))
    light = (
        given["signal[mask]"],
        psf,
        given["illuminant"],
        given["responses"],
        bands,
        given["clipped[mask]"].bool(),
    )
    nothing = frames.score(given["developed[mask]"].double().numpy(), truth)
    found = {"developed": nothing}
    for border in BORDERS:
        start = time.process_time()
        seen = restore.wiener(*light, border=border, read_noise=own.READ)
        found[f"{border:g} s"] = time.process_time() - start
        picture = torch.einsum("kc,cyx->kyx", given["matrix"].to(seen), seen).double().numpy()
        found[f"{border:g}"] = frames.score(picture, truth) - nothing
    return {name: round(float(value), 3) for name, value in found.items()}


def scenes(first, count, pictures):
    """Kind of scene, mask, seed, kind of picture and its function; skies are looked for in later
    seeds.
    """
    for seed in range(first, first + count):
        for mask in frames.MASKS:
            yield "photograph", mask, seed, seed, pictures
    for seed in range(first, first + 40 * count):
        yield "sky", "designed", seed, "sample", own.picture


def run(path, first, count, folder):
    """Append the frames that the file lacks."""
    done, skies = {(r["scene"], r["mask"], r["seed"]) for r in frames.rows(path)}, 0
    with tempfile.TemporaryDirectory() as place:
        frames.written_camera(Path(place))
        for scene, mask, seed, kind, picture in scenes(first, count, frames.photographs(folder)):
            if (scene, mask, seed) in done:
                skies += scene == "sky"
                continue
            if scene == "sky" and (skies >= count or not is_even(mask, seed)):
                continue
            skies += scene == "sky"
            numbers, truth, _ = frames.taken(mask, 0.0, seed, kind, picture)
            each = {
                "scene": scene,
                "mask": mask,
                "seed": seed,
                **gains(inputs(numbers, mask, Path(place)), truth),
            }
            with path.open("a") as file:
                file.write(json.dumps(each) + "\n")


def is_even(mask, seed):
    """True if the part of the sample that a seed draws is an even sky."""
    rng = np.random.default_rng([seed, *mask.encode(), 0])
    rng.uniform(size=3)  # place and wavelength of a laser
    inner = own.picture("sample", 2 * frames.SIDE, rng)[64:-64, 64:-64]
    return frames.encoded(inner / np.percentile(inner, 99.5)).std((0, 1)).mean() < EVEN


def report(rows):
    """Print the mean gain, the least, and the median time of each border, by scene and mask."""
    names = [f"{border:g}" for border in BORDERS]
    print(
        "scene, mask: frames, PSNR as developed; mean gain (least), median time with borders"
        f" {', '.join(names)}"
    )
    for scene, mask in sorted({(r["scene"], r["mask"]) for r in rows}):
        some = [r for r in rows if (r["scene"], r["mask"]) == (scene, mask)]
        shown = [
            f"{np.mean([r[k] for r in some]):+.2f} dB ({min(r[k] for r in some):+.2f}) "
            f"{np.median([r[f'{k} s'] for r in some]):.2f} s"
            for k in names
        ]
        print(
            f"{scene:10} {mask:9} {len(some):3}  {np.mean([r['developed'] for r in some]):.2f} "
            f" {'  '.join(shown)}"
        )


if __name__ == "__main__":
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("file", type=Path)
    parser.add_argument("--pictures", type=Path, help="folder of photographs")
    parser.add_argument("--seeds", type=int, nargs=2, metavar=("FIRST", "COUNT"))
    parser.add_argument("--report", action="store_true")
    given = parser.parse_args()
    torch.set_num_threads(1)
    if given.seeds:
        run(given.file, *given.seeds, given.pictures)
    if given.report:
        report(frames.rows(given.file))
