"""Masks without images: what the known ones do, what can be designed, and whether a learned one is
five times better.

    python tests/benchmarks/bench_design.py FOLDER PIECE [PIECE ...]

Pieces: `known` (masks of a formula), the name of a design below, `designs` (all of them), `table`
        (of what lies in
FOLDER), `filter` (half-rings, and the one made for a Wiener filter: what such a filter leaves
wrong, and why). Each design is kept in FOLDER and not repeated; an interrupted one goes on. All are
judged on the 540 samples, 31 bands and 512 pixels of the recipe. Those of few numbers are learned
on a pupil of half the samples and a window of 504 pixels; pixels are learned on what they are
judged on, for a deep relief is not known between coarse samples.
"""

from __future__ import annotations

import copy
import json
import math
import sys
import time
from pathlib import Path
from typing import Any

import torch
from safetensors.torch import load_file

from neusee.nodes import doe, losses, metrics
from neusee.nodes.values import Stop
from neusee.workflows import load
from neusee.workflows.store.result_store import Store
from neusee.workflows.training.design_run import MaskTraining, design, mask_figures
from neusee.workflows.training.design_terms import Terms

AT = {"optics.samples": 270, "optics.pitch": "29.92 um", "optics.window": [504, 504]}
# at 400 nm 72 waves (of 550 nm) are its Nyquist limit
FINER = {"optics.samples": 405, "optics.pitch": "19.94667 um"}
FIVE = (12.0, 18.0, 24.0, 30.0, 36.0)
HALF_RINGS = (3.0, 5.0, 8.0, 12.0, 14.0, 20.0, 30.0)
COMMON = {"at": AT, "weights": {"lsr": 1.0, "bsr": 4.0}}
RINGS = {"kind": "five_half_rings", "bands": 5, "population": 70, "iterations": 40, "save_every": 5}
DEEP = {
    "kind": "pixelwise",
    "max_height": "20 um",
    "scale": 0.1,
    "learning_rate": 0.03,
    "iterations": 250,
    "at": {},
    "bands": 5,
}
FROM_RINGS = DEEP | {
    "start": "five half-rings, evolved",
    "max_height": "130 um",
    "grid": 540,
    "learning_rate": 0.002,
    "iterations": 120,
}
DESIGNS = {
    "five half-rings, evolved": RINGS,
    "five half-rings, evolved, slopes to 64": (
        RINGS | {"slopes": [4.0, 64.0], "population": 50, "iterations": 12, "polish": 200}
    ),
    "five half-rings, evolved, slopes to 68, polished": (
        RINGS
        | {
            "slopes": [4.0, 68.0],
            "population": 50,
            "iterations": 36,
            "bands": 11,
            "polish": 350,
            "at": FINER,
        }
    ),
    "Zernike, 150 polynomials": {
        "kind": "zernike",
        "modes": 150,
        "waves": 2.5,
        "learning_rate": 0.02,
        "iterations": 120,
    },
    "rings, 40 sided": {"kind": "rings", "learning_rate": 0.01, "noise": 0.5, "iterations": 80},
    "UNet": {"kind": "unet", "max_height": "20 um", "width": 16, "grid": 135, "iterations": 80},
    "pixelwise, 20 um deep": DEEP,
    "pixelwise, 5 um deep": (
        DEEP | {"max_height": "5 um", "scale": 0.04, "learning_rate": 0.05, "iterations": 150}
    ),
    **{
        f"pixelwise, 20 um deep, contrast {weight}": (
            DEEP | {"iterations": 120, "weights": {"lsr": 1.0, "bsr": 4.0, "contrast": weight}}
        )
        for weight in (0.5, 1.0, 2.0, 4.0)
    },
    "pixelwise from the polished half-rings, contrast 2.0, slowly": (
        FROM_RINGS
        | {
            "start": "five half-rings, evolved, slopes to 68, polished",
            "learning_rate": 0.001,
            "iterations": 250,
            "weights": {"lsr": 1.0, "bsr": 4.0, "contrast": 2.0},
            "power": 24,
        }
    ),
    "UNet, 5 um deep": {
        "kind": "unet",
        "max_height": "5 um",
        "grid": 135,
        "iterations": 200,
        "at": FINER,
        "bands": 5,
        "weights": {"lsr": 1.0, "bsr": 4.0, "contrast": 1.0},
    },
    "pixelwise, 5 um deep, contrast 1.0": (
        DEEP
        | {
            "max_height": "5 um",
            "scale": 0.04,
            "learning_rate": 0.05,
            "iterations": 300,
            "power": 24,
            "weights": {"lsr": 1.0, "bsr": 4.0, "contrast": 1.0},
        }
    ),
    "pixelwise, 5 um deep, contrast 1.0, then 2.5": (
        DEEP
        | {
            "start": "pixelwise, 5 um deep, contrast 1.0",
            "max_height": "5 um",
            "grid": 540,
            "learning_rate": 0.03,
            "iterations": 130,
            "power": 32,
            "weights": {"lsr": 1.0, "bsr": 4.0, "contrast": 2.5},
        }
    ),
    "pixelwise from the evolved half-rings, contrast 2.0, slowly": (
        FROM_RINGS
        | {
            "weights": {"lsr": 1.0, "bsr": 4.0, "contrast": 2.0},
            "learning_rate": 0.001,
            "iterations": 300,
            "power": 24,
        }
    ),
    **{
        f"pixelwise from the evolved half-rings, contrast {weight}": (
            FROM_RINGS | {"weights": {"lsr": 1.0, "bsr": 4.0, "contrast": weight}}
        )
        for weight in (0.0, 1.0, 2.0, 4.0)
    },
}
FOR_A_FILTER = "half-ring of 14 waves, then its samples, for a Wiener filter"
DESIGNS[FOR_A_FILTER] = {
    "kind": "recipe_mask",
    "iterations": 160,
    "learning_rate": 4e-3,
    "bands": None,
    "weights": {"lsr": 2.0, "bsr": 1.0, "wiener": 1.0},
    "power": 24,
    "enough": 0.0098,
    "up_to": 0.0625,
    "noise_share": 7e-4,
    "at": {},
}
#: the recipe whose own relief it starts from
OWN = {FOR_A_FILTER: ("half_ring", ["doe.waves=[14]"])}


def known(stop: Stop) -> dict[str, torch.Tensor]:
    """Reliefs of a formula, fused silica, waves at 550 nm."""
    return {
        "plain": doe.flat(stop),
        "vortex, charge 8": doe.vortex(stop, charge=8),
        "axicon, 20 waves": doe.axicon(stop, waves=20.0),
        "spiral axicon, 20 waves, charge 8": doe.spiral_axicon(stop, waves=20.0, charge=8),
        "half-ring, 20 waves": doe.half_rings(stop, waves=(20.0,)),
        "five half-rings, (12, 18, 24, 30, 36)": doe.half_rings(
            stop, waves=(12.0, 18.0, 24.0, 30.0, 36.0)
        ),
        "five half-rings, (16, 28, 40, 52, 64)": doe.half_rings(
            stop, waves=(16.0, 28.0, 40.0, 52.0, 64.0)
        ),
    }


def read(folder: Path, name: str) -> dict[str, Any]:
    """The figures of a mask."""
    found: dict[str, Any] = json.loads((folder / f"{name}.json").read_text())
    return found


def one(name: str, folder: Path) -> None:
    """Design a mask, unless it is there."""
    place = folder / f"{name}.json"
    if place.is_file():
        return
    values, began = {**COMMON, **DESIGNS[name]}, time.perf_counter()
    if "start" in values:  # the relief of another design
        values["start"] = (
            folder / "runs" / read(folder, values["start"])["folder"] / "mask.safetensors"
        )
    how = MaskTraining.model_validate(values)
    recipe, words = OWN.get(name, ("first_light", []))
    made = design(
        load(recipe, words),
        how,
        Store(folder / "cache"),
        folder / "runs",
        lambda s: print(f"{name}: {s}"),
    )
    found = json.loads((made / "mask.json").read_text())
    place.write_text(
        json.dumps(found | {"seconds": time.perf_counter() - began, "folder": made.name})
    )


def formulas(folder: Path) -> None:
    """Judge the masks of a formula."""
    terms = Terms(load("first_light"), MaskTraining(), Store(folder / "cache"))
    for name, height in known(terms.stop).items():
        (folder / f"{name}.json").write_text(
            json.dumps(mask_figures(terms, height) | {"seconds": 0.0})
        )


def filtered(folder: Path) -> None:
    """What a Wiener filter leaves wrong of a picture seen at an eighth: by noise alone, and by
    colour too.
    """
    how = MaskTraining.model_validate(DESIGNS[FOR_A_FILTER] | {"weights": {"wiener": 1.0}})
    terms = Terms(load("half_ring"), how, Store(folder / "cache"))
    masks = {
        f"half-ring, {waves} waves": doe.half_rings(terms.stop, waves=(waves,))
        for waves in HALF_RINGS
    }
    made = folder / "runs" / read(folder, FOR_A_FILTER)["folder"] / "mask.safetensors"
    masks |= {"five half-rings, (12, 18, 24, 30, 36)": doe.half_rings(terms.stop, waves=FIVE)}
    masks |= {FOR_A_FILTER: load_file(made)["height"]}
    print("| mask | mean LSR | contrast to 0.0625 | wrong by noise | and by colour |")
    print("|---|---|---|---|---|")
    for name, height in masks.items():
        with torch.no_grad():
            psf = terms.psf(height)
            kept = math.exp(
                -float(losses.contrast(psf, up_to=how.up_to)) / len(terms.bands.centres)
            )
            wrong = [
                math.exp(float(Terms.parts(_as(terms, colour), height)["wiener"]))
                for colour in (0.0, 1.0)
            ]
        cells = [
            f"{float(metrics.lsr(psf).mean()):.3g}",
            f"{kept:.3g}",
            *(f"{x:.2e}" for x in wrong),
        ]
        print(f"| {name} | {' | '.join(cells)} |")


def _as(terms: Terms, colour: float) -> Terms:
    """The same terms with another share of what is of one band."""
    other = copy.copy(terms)
    other.settings = terms.settings.model_copy(update={"colour": colour})
    return other


def table(folder: Path) -> None:
    """Print what is known, masks of a formula first."""
    print(
        "| mask | mean LSR | worst LSR | BSR | median MTF | bound of it | even light | relief, µm"
        " | s |"
    )
    print("|---|---|---|---|---|---|---|---|---|")
    for name in [*known(16, 1e-4, 1.6e-3), *DESIGNS]:
        place = folder / f"{name}.json"
        if place.is_file():
            found = read(folder, name)
            mean, worst = found["mean"], max(found["bands"]["lsr"])
            cells = [f"{mean['lsr']:.3g}", f"{worst:.3g}", f"{mean['bsr']:.3f}", f"{mean['median_mtf']:.2e}",
                     f"{mean['median_mtf_bound']:.2e}", f"{mean['energy_floor']:.2e}",
                     f"{found['depth'] * 1e6:.3g}", f"{found['seconds']:.0f}"]  # fmt: skip
            print(f"| {name} | {' | '.join(cells)} |")
    for name in DESIGNS:
        place = folder / f"{name}.json"
        numbers = read(folder, name)["numbers"] if place.is_file() else {}
        if "orientation" in numbers:
            print(f"{name}: {numbers}")


def main(folder: Path, pieces: list[str]) -> None:
    """Do the pieces in turn."""
    folder.mkdir(parents=True, exist_ok=True)
    torch.set_num_threads(1)
    for piece in pieces:
        if piece == "known":
            formulas(folder)
        elif piece == "table":
            table(folder)
        elif piece == "filter":
            filtered(folder)
        else:
            for name in DESIGNS if piece == "designs" else [piece]:
                one(name, folder)


if __name__ == "__main__":
    sys.stdout.reconfigure(line_buffering=True)
    main(Path(sys.argv[1]), sys.argv[2:])
