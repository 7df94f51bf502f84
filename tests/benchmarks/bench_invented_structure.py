"""Does a restored picture show words, faces or details that the scene does not have?

    python tests/benchmarks/bench_invented_structure.py results.jsonl --seeds 0 4
    python tests/benchmarks/bench_invented_structure.py results.jsonl --report

Frames as in `bench_restored_frames.py`: a camera in NumPy that the recipe describes wrongly,
restored by the command. The scene has eight places on a shaded wall: a word of five letters, a face
20 pixels wide, or nothing. A reader looks at each place for each of 24 words and 6 faces: it takes
the template of the highest correlation within three pixels of shift, if this is at least 0.5.
Counted are the words and faces that are read rightly, those read as another one, and the *empty*
places in which something is read. Beside them stands the share of pixels of empty places, saturated
ones apart, whose error is larger than the 90 % interval that the program states.
"""

import argparse
import contextlib
import functools
import io
import json
import tempfile
from pathlib import Path
from unittest.mock import patch

import numpy as np
import torch
from matplotlib.font_manager import findfont
from PIL import Image, ImageDraw, ImageFont
from safetensors.numpy import load_file
from scipy.ndimage import uniform_filter

from neusee.workflows.cli import app
from neusee.workflows.report.figures.camera_pictures import half_width
from tests.benchmarks import bench_restored_frames as frames
from tests.nodes.restore.lasers import own_camera as own

HIGH, WIDE, DRAWS, NEAR, ENOUGH = 24, 56, 8, 3, 0.5
PLACES = [(y, x) for y in (4, 36, 68, 100) for x in (4, 68)]  #: upper left corners in the picture
METHODS = ("nothing", "blind", "search")
LETTERS = "ACEHKLMNPRSTUXZ"


@functools.cache
def templates():
    """Pictures (y, x) from 0 to 1, of 24 words and 6 faces."""
    rng, font = np.random.default_rng(5), ImageFont.truetype(findfont("DejaVu Sans"), 15)
    words = ["".join(rng.choice(list(LETTERS), 5)) for _ in range(24)]
    found = []
    for word in words:
        image = Image.new("L", (WIDE, HIGH))
        ImageDraw.Draw(image).text((WIDE / 2, HIGH / 2), word, fill=255, font=font, anchor="mm")
        found.append(np.asarray(image, float) / 255)
    for eyes, mouth in ((4, 0), (4, 180), (6, 0), (6, 180), (3, 0), (3, 180)):
        image = Image.new("L", (WIDE, HIGH))
        draw, (x, y) = ImageDraw.Draw(image), (WIDE // 2, HIGH // 2)
        draw.ellipse((x - 10, y - 11, x + 10, y + 11), fill=255)
        for side in (-eyes, eyes):
            draw.ellipse((x + side - 1, y - 5, x + side + 1, y - 3), fill=0)
        draw.arc((x - 5, y, x + 5, y + 7), mouth, mouth + 180, fill=0, width=2)
        found.append(np.asarray(image, float) / 255)
    return found


def drawn(kind, side, rng):
    """The scene in linear colours, and in `drawn.what` the number of the template in each place,
    or None.
    """
    y, x = np.mgrid[:side, :side] / side
    wall = 0.3 + 0.1 * np.sin(2 * np.pi * (x * rng.uniform(0.5, 1.5) + rng.random())) * np.cos(
        2 * np.pi * y
    )
    drawn.what = [
        int(rng.integers(len(templates()))) if rng.random() < 0.5 else None for _ in PLACES
    ]
    rim = (side - frames.SIDE) // 2
    for (down, right), what in zip(PLACES, drawn.what, strict=True):
        if what is not None:
            at = slice(rim + down, rim + down + HIGH), slice(rim + right, rim + right + WIDE)
            wall[at] *= 1 + rng.choice([-0.6, 1.0]) * templates()[what]
    return wall[:, :, None] * np.array([1.0, 0.95, 0.85])


def restored(numbers, mask, method, folder):
    """The restored picture (3, y, x) in linear sRGB, its standard deviation, and the saturated
    pixels (y, x).
    """
    np.save(folder / "frame.npy", numbers)
    option = "search" if method == "search" else "wiener_blind"
    outputs = ["restored", "restored_spread", "developed[mask]", "clipped[mask]"]
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
                    f"restore={option}",
                    f"frame.draws={DRAWS}",
                    f"outputs={json.dumps(outputs)}",
                    "--out",
                    out,
                ]
            )
        except SystemExit as end:
            if end.code not in (0, 3):
                raise RuntimeError(told.getvalue()) from None
        results = load_file(str(next(Path(out).glob("*/data/outputs.safetensors"))))
    picture = results["developed[mask]" if method == "nothing" else "restored"].astype(float)
    return (
        picture,
        results["restored_spread"].astype(float),
        results["clipped[mask]"].astype(bool).any(0),
    )


def read(picture):
    """The template that each place of a luminance (y, x) shows, or None."""
    detail = picture - uniform_filter(picture, 21)
    found = []
    for down, right in PLACES:
        best = (ENOUGH, None)
        for number, template in enumerate(templates()):
            inner = template[NEAR:-NEAR, NEAR:-NEAR]
            inner = inner - inner.mean()
            for y in range(2 * NEAR + 1):
                for x in range(2 * NEAR + 1):
                    part = detail[
                        down + y : down + y + inner.shape[0], right + x : right + x + inner.shape[1]
                    ]
                    part = part - part.mean()
                    alike = abs((part * inner).sum()) / np.sqrt(
                        (part**2).sum() * (inner**2).sum() + 1e-12
                    )
                    best = max(best, (float(alike), number), key=lambda b: b[0])
        found.append(best[1])
    return found


def one(seed, mask, strength, folder):
    numbers, truth, _ = frames.taken(mask, strength, seed, "words", drawn)
    what = list(drawn.what)
    for method in METHODS:
        picture, spread, clipped = restored(numbers, mask, method, folder)
        gains = np.median(truth, (1, 2)) / np.maximum(np.median(picture, (1, 2)), 1e-9)
        seen = read(frames.encoded(picture * gains[:, None, None]).mean(0))
        outside = (np.abs(picture - truth / gains[:, None, None]) > half_width(spread, DRAWS)).mean(
            0
        )
        empty = np.zeros_like(clipped)
        for (down, right), item in zip(PLACES, what, strict=True):
            if item is None:
                empty[down : down + HIGH, right : right + WIDE] = True
        yield {
            "seed": seed, "mask": mask, "strength": strength, "method": method,
            "right": sum(s == w for s, w in zip(seen, what, strict=True) if w is not None),
            "wrong": sum(s not in (w, None) for s, w in zip(seen, what, strict=True) if w is not None),
            "full": sum(w is not None for w in what), "empty": sum(w is None for w in what),
            "invented": sum(s is not None for s, w in zip(seen, what, strict=True) if w is None),
            "outside": round(float(outside[empty & ~clipped].mean()), 4),
        }  # fmt: skip


def report(rows):
    print(
        "| mask | strength | restored by | read rightly | read as another | empty, yet read |"
        " outside its interval |"
    )
    print("|---|---|---|---|---|---|---|")
    for mask in frames.MASKS:
        for strength in sorted({r["strength"] for r in rows}):
            for method in METHODS:
                some = [
                    r
                    for r in rows
                    if (r["mask"], r["strength"], r["method"]) == (mask, strength, method)
                ]
                if some:
                    total = {
                        k: sum(r[k] for r in some)
                        for k in ("right", "wrong", "full", "empty", "invented")
                    }
                    share = (
                        "-"
                        if method == "nothing"
                        else f"{np.mean([r['outside'] for r in some]):.0%}"
                    )
                    read_rightly, empty = (
                        f"{total['right']} of {total['full']}",
                        f"{total['invented']} of {total['empty']}",
                    )
                    print(
                        f"| {mask} | {strength:g} | {method} | {read_rightly} | {total['wrong']} |"
                        f" {empty} | {share} |"
                    )


if __name__ == "__main__":
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("file", type=Path)
    parser.add_argument("--seeds", type=int, nargs=2, metavar=("FIRST", "COUNT"))
    parser.add_argument("--strengths", type=float, nargs="+", default=(0.0, 1e3, 1e5))
    parser.add_argument("--report", action="store_true")
    given = parser.parse_args()
    torch.set_num_threads(1)
    done = frames.rows(given.file)
    if given.seeds:
        have = {(r["seed"], r["mask"], r["strength"]) for r in done}
        with tempfile.TemporaryDirectory() as place, patch.object(own, "picture", drawn):
            frames.written_camera(Path(place))
            for seed in range(given.seeds[0], sum(given.seeds)):
                for mask in frames.MASKS:
                    for strength in given.strengths:
                        if (seed, mask, strength) not in have:
                            found = list(one(seed, mask, strength, Path(place)))
                            done += found
                            with given.file.open("a") as file:
                                file.writelines(json.dumps(r) + "\n" for r in found)
    if given.report:
        report(done)
