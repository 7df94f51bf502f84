"""Sums over the bands of an image, band by band and by few planes: `python tests/benchmarks/bench_economy.py [REPEATS]`.

Two tables in Markdown, medians of REPEATS (3) in one process, the ways in turn. First, 31 bands imaged and exposed,
beside few planes imaged and exposed: `image` and `image_channels` alone, then with `expose`; kept, the error against
float64 of each way on the small scene, and the bound. Second, what makes a cube few planes, and the lift that makes
them at once.
"""

import statistics
import sys
import time

import torch

from neusee.nodes.optics import image, image_channels
from neusee.nodes.sensor import expose
from neusee.nodes.spectra import bands, compress, lift_lmmse, responses, rows
from neusee.nodes.values import Mixture, Psf

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
    return Mixture(planes, basis, rest), torch.tensordot(basis.float(), planes, 1)


def psf(size):
    """Speckle with long tails, another in each band."""
    y, x = (torch.arange(n) - n // 2 for n in size)
    kernel = rand(31, *size, seed=3) / (1 + (y[:, None] ** 2 + x**2) / 100.0) ** 1.5
    return Psf(kernel / kernel.sum((1, 2), keepdim=True), torch.ones(31, dtype=torch.float64))


def seconds(work):
    began = time.perf_counter()
    found = work()
    return time.perf_counter() - began, found


def medians(works, repeats):
    """Median seconds of each, in turn; and what each gave the last time."""
    for work in works:
        work()
    each = [[seconds(work) for work in works] for _ in range(repeats)]
    return [statistics.median(t for t, _ in column) for column in zip(*each, strict=True)], [v for _, v in each[-1]]


def convolutions(repeats):
    print(
        "| scene and PSF | rank | rows | within | 31 bands, s | planes, s | ratio | with expose | kept | error | bound |"
    )
    print("|---|---|---|---|---|---|---|---|---|---|---|")
    for size in SIZES:
        stack = psf(size)
        for rank in (3, 6):
            mixture, cube = scene(rank, size)
            for count, within in ((3, 0.0), (4, 0.0), (4, 2.5e-4), (4, 1e-2)):
                row(size, rank, count, within, mixture, cube, stack, repeats)


def row(size, rank, count, within, mixture, cube, stack, repeats):
    weights, seen = rows(SCENE, RESPONSES)[:count], RESPONSES

    def by_band():
        return image(cube, stack)

    def by_planes():
        return image_channels(mixture, stack, weights, within=within)

    (plain, few), (bandwise, channels) = medians([by_band, by_planes], repeats)
    (plain_lit, few_lit), _ = medians(
        [lambda: expose(bandwise, SCENE, seen, **SHUTTER), lambda: expose(channels, SCENE, seen, **SHUTTER)], repeats
    )
    summed = torch.tensordot(weights.float(), bandwise, 1)
    error = float(((summed - channels.planes).abs().amax((1, 2)) / summed.amax((1, 2))).max())
    kept = "{} planes, {} kernels, {} bands, {} x {}".format(*channels.kept.tolist())
    print(
        f"| {size[0]} x {size[1]} | {rank} | {count} | {within:g} | {plain:.2f} | {few:.3f} | {plain / few:.1f} | "
        f"{(plain + plain_lit) / (few + few_lit):.1f} | {kept} | {error:.1e} | {float(channels.bound):.1e} |",
        flush=True,
    )


def planes(repeats):
    print("\n| 31 x y x x | what | s | planes | left, of the brightest |\n|---|---|---|---|---|")
    for size in SIZES:
        for name, colours in (("no clipping", 0.5 + 0.01 * rand(3, *size)), ("clipped", rand(3, *size))):
            cube = lift_lmmse(colours, SCENE)
            for within in (1e-6, 1e-4, 1e-2):
                (once,), (found,) = medians([lambda c=cube, w=within: compress(c, within=w)], repeats)
                tell(size, f"compress within {within:g}, {name}", once, found)
                if lift_lmmse.mixed is not None:
                    works = [lambda c=colours, w=within: lift_lmmse.mixed(c, SCENE, within=w)]
                    (once,), (found,) = medians(works, repeats)
                    tell(size, f"lift to planes within {within:g}, {name}", once, found)


def tell(size, what, once, found):
    left = float(found.rest[-1].max() / found.rest[0].max())
    print(f"| {size[0]} x {size[1]} | {what} | {once:.2f} | {len(found.planes)} | {left:.1e} |", flush=True)


if __name__ == "__main__":
    repeats = int(sys.argv[1]) if len(sys.argv) > 1 else 3
    convolutions(repeats)
    planes(repeats)
