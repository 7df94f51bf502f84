"""How far is the EMVA 1288 sheet from the reference: `python tests/benchmarks/bench_emva_sheet.py
FOLDER`.

FOLDER holds the reference sets of the EMVA 1288 working group as they come
(github.com/EMVA1288/datasets), each in a folder with `EMVA1288_Data.txt`. Each quantity of the
sheet is compared with that of the package `emva1288` on the same frames, and those of set 001 with
the published ones (release 3.0).
"""

import logging
import sys
import time
from pathlib import Path

import numpy as np

from neusee.nodes.calibrate import (
    Nonuniformity,
    defects,
    descriptor,
    descriptor_series,
    emva_sheet,
    spatial_series,
    without_trend,
)
from tests.nodes.calibrate.test_emva_sheet import PUBLISHED

#: keys of the package by those of the sheet, where they differ
THEIRS = {
    "eta": "QE", "mu_p_min": "u_p_min", "mu_e_min": "u_e_min", "mu_p_sat": "u_p_sat", "mu_e_sat": "u_e_sat",
    "mu_I_mean": "u_I_mean", "mu_I_var": "u_I_var",
    **{f"{kind}1288_column": f"{kind}1288_col" for kind in ("DSNU", "PRNU")},
}  # fmt: skip
#: published, set 001
SPATIAL = {"DSNU1288_DN": 0.154925054745, "DSNU1288": 0.551787767644, "PRNU1288": 0.432704411062}


def ours(file, scatter):
    """The sheet of a descriptor."""
    series = sorted(
        (spatial_series(*each) for each in descriptor_series([file])), key=lambda s: s.photons
    )
    return emva_sheet(descriptor(file=file, scatter=scatter), Nonuniformity(*series))


def theirs(file):
    """The quantities of the reference implementation."""
    # emva1288 1.0.2 was written for NumPy 1
    np.asfarray = lambda values: np.asarray(values, dtype=float)
    from emva1288.process.data import Data1288
    from emva1288.process.loader import LoadImageData
    from emva1288.process.parser import ParseEmvaDescriptorFile
    from emva1288.process.results import Results1288

    images = LoadImageData(
        ParseEmvaDescriptorFile(str(file), loglevel=logging.ERROR).images, loglevel=logging.ERROR
    )
    return Results1288(Data1288(images.data, loglevel=logging.ERROR).data, loglevel=logging.ERROR)


def compared(file):
    """Print the quantities of both, and how many pixels of the histograms differ."""
    began = time.process_time()
    sheet = ours(file, "steady")
    print(f"\n{file.parent.name}: {time.process_time() - began:.1f} s of processor time\n")
    print("| quantity | sheet | package | relative |")
    print("|---|---|---|---|")
    reference = theirs(file)
    for quantity in sheet.quantities:
        value = getattr(reference, THEIRS.get(quantity.key, quantity.key), None)
        value = value() if callable(value) else value
        if value is None:
            continue
        apart = "" if quantity.value is None else f"{abs(quantity.value / value - 1):.1e}"
        print(f"| {quantity.key} | {quantity.text} | {value:.6g} | {apart} |")
    dark, lit = sheet.spatial
    pairs = (
        (defects(dark.total, 1.0), reference.histogram_DSNU),
        (defects(without_trend(lit.total - dark.total), 1.0), reference.histogram_PRNU),
    )
    print(
        "pixels of other classes, of DSNU and of PRNU:",
        *(int(np.abs(a.pixels - b["values"]).sum()) for a, b in pairs),
    )


def published(file):
    """Print the largest relative distance from the published values."""
    sheet = ours(file, "temporal")
    apart = {key: abs(sheet[key].value / value - 1) for key, value in (PUBLISHED | SPATIAL).items()}
    worst = max(apart, key=apart.get)
    print(f"\n{len(apart)} published quantities of set 001: within {apart[worst]:.1e} ({worst})")


if __name__ == "__main__":
    found = sorted(Path(sys.argv[1]).glob("*/EMVA1288_Data.txt"))
    for each in found:
        compared(each)
    published(next(each for each in found if "001" in each.parent.name))
