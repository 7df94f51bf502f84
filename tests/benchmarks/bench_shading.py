"""What the frames of a folder tell of a shading field: coverage of its intervals, and what dividing
by it gains.

    python tests/benchmarks/bench_shading.py photographs/ [side]

A camera in NumPy: a field of twelve blurred grains that takes up to half of the light, 15 % of it,
or nothing; scenes from photographs, Poisson and read noise, clipping. The gain is that of a frame
with an error of 28 dB, as a restored one has, divided by the field or not, each at its best scale.
Nothing here is shared with the estimate but its cells.
"""

import sys
from pathlib import Path

import numpy as np
import torch
from PIL import Image

from neusee.nodes.restore._shading_field import at_pixels, cells_of, grid, shared_field

FULL, READ, ERROR = 20000.0, 10.0, 0.04


def photographs(folder, side):
    for path in sorted(p for p in folder.rglob("*") if p.suffix.lower() in (".jpg", ".png")):
        with Image.open(path) as file:
            square = min(file.size)
            left, top = ((n - square) // 2 for n in file.size)
            small = (
                file.convert("RGB")
                .crop((left, top, left + square, top + square))
                .resize((side, side))
            )
        yield (np.asarray(small, float) / 255).transpose(2, 0, 1) ** 2.2 * 0.7 * FULL + 20


def field(depth, side, rng):
    y, x = np.mgrid[:side, :side] / side
    grains = np.zeros((side, side))
    for _ in range(12):
        (cy, cx), radius = rng.random(2), rng.uniform(0.08, 0.25)
        grains += rng.uniform(0.1, 0.5) * np.exp(-((y - cy) ** 2 + (x - cx) ** 2) / 2 / radius**2)
    return 1 - depth * grains / grains.max()


def trial(scenes, light, rng):
    """Share of knots in their 90 % interval, whether the picture is divided, and the gain in dB."""
    side, frames = light.shape[0], []
    for scene in scenes:
        electrons = rng.poisson(scene * light) + rng.normal(0, READ, scene.shape)
        clipped = torch.from_numpy((electrons >= 1.125 * FULL).any(0))
        frames.append(cells_of(torch.from_numpy(electrons), clipped, READ))
    knots = grid((side, side))
    found = shared_field(frames, knots)
    mean, deviation = found.mean.numpy(), found.covariance.diagonal().clamp_min(0).sqrt().numpy()
    true = (
        np.log(light)
        .reshape(knots[0], side // knots[0], knots[1], side // knots[1])
        .mean((1, 3))
        .ravel()
    )
    inside = np.mean(np.abs(true - true.mean() - mean) <= 1.645 * deviation + 1e-6)
    told = np.mean(mean**2) / np.mean(mean**2 + deviation**2)
    used = bool(told >= 0.5 and found.clean < 0.05 and found.scenes >= 8)
    truth = scenes[0] / (0.7 * FULL)
    seen = truth * light + rng.normal(0, ERROR, truth.shape)
    divided = seen / np.exp(used * at_pixels(found.mean.reshape(knots), (side, side)).numpy())
    return inside, used, psnr(divided, truth) - psnr(seen, truth)


def psnr(picture, truth):
    scale = (picture * truth).sum() / (picture**2).sum()
    return -10 * np.log10(np.mean((scale * picture - truth) ** 2))


def main(folder, side=192):
    torch.set_num_threads(1)
    every, rng = list(photographs(Path(folder), int(side))), np.random.default_rng(5)
    print(
        "| field | frames | trials | knots in their 90 % interval | divided | mean gain | least |"
    )
    print("|---|---|---|---|---|---|---|")
    for name, depth in (("strong", 0.5), ("weak", 0.15), ("clean", 0.0)):
        for count in (1, 12, 40, 80):
            rows = []
            for _ in range(8 if count < 30 else 4):
                chosen = [every[n] for n in rng.choice(len(every), count, replace=False)]
                rows.append(trial(chosen, field(depth, int(side), rng), rng))
            inside, used, gain = np.array(rows, float).T
            print(f"| {name} | {count} | {len(rows)} | {inside.mean():.0%} | {used.sum():.0f} | {gain.mean():+.2f} "
                  f"| {gain.min():+.2f} |", flush=True)  # fmt: skip


if __name__ == "__main__":
    main(*sys.argv[1:3])
