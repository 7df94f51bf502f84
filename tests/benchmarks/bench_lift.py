"""Lifts from RGB to spectra, side by side: a measured scene, and drawn pictures of reflectances
that none has seen.

    python tests/benchmarks/bench_lift.py WEIGHTS CUBE.mat [REFLECTANCES ...]

WEIGHTS is what `neusee train train_lift` leaves (mst_plus_plus.safetensors, or state.pt on the
way); CUBE a scene of 31 bands from 400 to 700 nm, such as CAVE's; REFLECTANCES files that
`spectra.reflectances` reads, of which 32 pictures of 64 x 64 are drawn, each leaf one measured
spectrum. All see the noiseless picture that `spectra.render` gives.
"""

from __future__ import annotations

import sys
import time
from collections.abc import Callable
from pathlib import Path

import torch
from torch import Tensor

from neusee.nodes.scene import hyperspectral
from neusee.nodes.spectra import (
    bands,
    leaves,
    lift_lmmse,
    lift_mallett,
    lift_matrix,
    lift_mst_plus_plus,
    metamers,
    reflectances,
    render,
)

SCENE = bands(start=400e-9, stop=700e-9, count=31)
PICTURES, SIZE, LEAST = 32, (64, 64), 1e-2
Lift = Callable[[Tensor], Tensor]


def lifts(weights: Path) -> dict[str, Lift]:
    """The three lifts of a recipe, MST++ with these weights, and the estimate that its training
    starts at.
    """
    rng, linear = torch.Generator(), lift_matrix(reflectances(SCENE), SCENE.centres)
    return {
        "lmmse": lambda rgb: lift_lmmse(rgb, SCENE),
        "lmmse over all sets": lambda rgb: torch.einsum("bc,cyx->byx", linear, rgb).clamp_min(0),
        "mallett": lambda rgb: lift_mallett(rgb, SCENE),
        "MST++": lambda rgb: lift_mst_plus_plus(rgb.float(), SCENE, weights=weights, rng=rng),
    }


def weights_in(path: Path) -> Path:
    """The weights themselves; of a state on the way, its average beside it."""
    if path.name != "state.pt":
        return path
    parts = torch.load(path, weights_only=True)["parts"]
    found = parts["average"] if "average" in parts else parts["net"]
    out = path.with_name("on_the_way.pth")
    torch.save({k.removeprefix("module."): v for k, v in found.items() if k != "n_averaged"}, out)
    return out


def drawn(files: tuple[Path, ...]) -> list[Tensor]:
    """Pictures of these reflectances as they were measured: no mixtures, no blacks, no other
    light.
    """
    known = reflectances(SCENE, sets=(), files=files)
    cubes = []
    for number in range(PICTURES):
        rng = torch.Generator().manual_seed(number)
        spectra = metamers(known, SCENE, mixed=1, thickness=(1.0, 1.0), blacks=0.0, rng=rng)
        cubes.append(leaves(spectra, SCENE, shape=SIZE, daylights=0.0, rng=rng))
    return cubes


def row(lift: Lift, cubes: list[Tensor]) -> str:
    """Errors over all pixels of all pictures, and of the colour that comes back."""
    square = relative = angle = colour = count = lit_count = 0.0
    began = time.perf_counter()
    for cube in cubes:
        truth = cube.double()
        rgb = render(truth, SCENE)
        found = lift(rgb).double()
        off, lit = found - truth, truth >= LEAST
        square, count = square + float(off.square().sum()), count + truth.numel()
        relative, lit_count = (
            relative + float((off.abs()[lit] / truth[lit]).sum()),
            lit_count + int(lit.sum()),
        )
        cosine = (found * truth).sum(0) / (found.norm(dim=0) * truth.norm(dim=0)).clamp_min(1e-12)
        angle += float(cosine.clamp(-1, 1).acos().rad2deg().mean()) / len(cubes)
        colour += float((render(found, SCENE) - rgb).square().mean().sqrt()) / len(cubes)
    rms = (square / count) ** 0.5
    psnr = -20 * torch.tensor(rms).log10().item()
    seconds = time.perf_counter() - began
    return (
        f"{psnr:.2f} | {rms:.4f} | {relative / lit_count:.4f} | {angle:.2f} | {colour:.1e} |"
        f" {seconds:.2f} |"
    )


def main(weights: Path, cube: Path, files: tuple[Path, ...]) -> None:
    """Print a table for the scene, and one for the pictures."""
    torch.set_num_threads(1)
    scenes = {cube.stem: [hyperspectral(SCENE, file=cube, start=400e-9, stop=700e-9)]}
    if files:
        scenes[", ".join(file.stem for file in files)] = drawn(files)
    print("| scene | lift | PSNR, dB | RMSE | MRAE from 0.01 | angle, degrees | colour, rms | s |")
    print("|---|---|---|---|---|---|---|---|")
    for scene, cubes in scenes.items():
        for name, lift in lifts(weights_in(weights)).items():
            print(f"| {scene} | {name} | {row(lift, cubes)}", flush=True)


if __name__ == "__main__":
    main(Path(sys.argv[1]), Path(sys.argv[2]), tuple(map(Path, sys.argv[3:])))
