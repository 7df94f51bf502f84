"""Sums over the bands of an image, by band and by few planes: `python
tests/benchmarks/bench_economy.py [REPEATS]`.

Two tables in Markdown, medians of REPEATS (3) in one process, in seconds of the wall and of the
processor, for on a machine that others use the wall says little. First, 31 bands imaged, and few
planes imaged and their light summed; the ratio of the two; the same with `expose`; what was kept,
the largest difference and the bound. Second, what makes a cube few planes, and the lift that makes
them at once.
"""

import statistics
import sys
import time
from functools import partial

import torch

from neusee.nodes.optics import image, image_channels
from neusee.nodes.sensor import expose
from neusee.nodes.spectra import bands, compress, lift_lmmse, responses, rows
from neusee.nodes.values import LowRankCube, Psf

SCENE = bands(start=400e-9, stop=700e-9, count=31)
RESPONSES = responses(SCENE)
SHUTTER = {"pixel_pitch": 2.9e-6, "exposure": 0.1}
SIZES = ((512, 768), (2048, 2048))


def rand(*shape, seed=0):
    return torch.rand(*shape, generator=torch.Generator().manual_seed(seed))


def scene(rank, size):
    """Planes whose cube has just this rank, and that cube."""
    basis = rand(31, rank, seed=1).double() * 0.2 ** torch.arange(rank)
    planes = rand(rank, *size, seed=2)
    each = basis.abs() * planes.abs().amax((1, 2)).double()
    rest = torch.cat([each.flip(1).cumsum(1).flip(1).T, torch.zeros(1, 31, dtype=torch.float64)])
    return LowRankCube(planes, basis, rest), torch.tensordot(basis.float(), planes, 1)


def psf(size):
    """Speckle with long tails, another in each band."""
    y, x = (torch.arange(n) - n // 2 for n in size)
    kernel = rand(31, *size, seed=3) / (1 + (y[:, None] ** 2 + x**2) / 100.0) ** 1.5
    return Psf(kernel / kernel.sum((1, 2), keepdim=True), torch.ones(31, dtype=torch.float64))


def medians(work, repeats):
    """Median seconds of wall and processor, and what came of it; one call before that does not
    count.
    """
    found, walls, busy = work(), [], []
    for _ in range(repeats):
        wall, cpu = time.perf_counter(), time.process_time()
        found = work()
        walls.append(time.perf_counter() - wall)
        busy.append(time.process_time() - cpu)
    return statistics.median(walls), statistics.median(busy), found


def convolutions(repeats):
    print(
        "| scene, PSF | rank | rows | within | bands, s (CPU) | planes, s (CPU) | ratio (CPU) |"
        " exposed (CPU) |",
        end="",
    )
    print(" kept | difference | bound |\n|---|---|---|---|---|---|---|---|---|---|---|")
    for size in SIZES:
        for rank in (3, 6):
            lines(size, rank, repeats)


def lines(size, rank, repeats):
    stack, (mixture, cube) = psf(size), scene(rank, size)
    plain = medians(partial(image, cube, stack), repeats)
    lit = medians(partial(expose, plain[2], SCENE, RESPONSES, **SHUTTER), repeats)
    for count, within in ((3, 0.0), (4, 0.0), (4, 2.5e-4), (4, 1e-2)):
        weights = rows(SCENE, RESPONSES)[:count]
        few = medians(partial(image_channels, mixture, stack, weights, within=within), repeats)
        shown = medians(partial(expose, few[2], SCENE, RESPONSES, **SHUTTER), repeats)
        told = f"| {size[0]} x {size[1]} | {rank} | {count} | {within:g} "
        print(told + compared(plain, few, lit, shown, weights), flush=True)


def compared(plain, few, lit, shown, weights):
    """The rest of a line."""
    summed, channels = torch.tensordot(weights.float(), plain[2], 1), few[2]
    error = float(((summed - channels.planes).abs().amax((1, 2)) / summed.amax((1, 2))).max())
    kept = "{} planes, {} kernels, {} bands, {} x {}".format(*channels.kept.tolist())
    alone, whole = (
        (plain[i] / few[i] for i in (0, 1)),
        ((plain[i] + lit[i]) / (few[i] + shown[i]) for i in (0, 1)),
    )
    return (
        f"| {plain[0]:.2f} ({plain[1]:.2f}) | {few[0]:.3f} ({few[1]:.3f}) | {{:.1f}} ({{:.1f}}) ".format(
            *alone
        )
        + "| {:.1f} ({:.1f}) ".format(*whole)
        + f"| {kept} | {error:.1e} | {float(channels.bound):.1e} |"
    )


def planes(repeats):
    print(
        "\n| 31 x y x x | what | s (CPU) | planes | left, of the brightest |\n|---|---|---|---|---|"
    )
    for size in SIZES:
        for name, colours in (
            ("no clipping", 0.5 + 0.01 * rand(3, *size)),
            ("clipped", rand(3, *size)),
        ):
            cube = lift_lmmse(colours, SCENE)
            for within in (1e-6, 1e-4, 1e-2):
                done = medians(partial(compress, cube, within=within), repeats)
                tell(size, f"compress within {within:g}, {name}", done)
                if lift_lmmse.low_rank_form is not None:
                    done = medians(
                        partial(lift_lmmse.low_rank_form, colours, SCENE, within=within), repeats
                    )
                    tell(size, f"lift to planes within {within:g}, {name}", done)


def tell(size, what, done):
    wall, busy, found = done
    left = float(found.residual_max[-1].max() / found.residual_max[0].max())
    print(
        f"| {size[0]} x {size[1]} | {what} | {wall:.2f} ({busy:.2f}) | {len(found.planes)} |"
        f" {left:.1e} |",
        flush=True,
    )


if __name__ == "__main__":
    repeats = int(sys.argv[1]) if len(sys.argv) > 1 else 3
    convolutions(repeats)
    planes(repeats)
