"""What a filter makes of a picture when it is told the laser a little wrongly: `bench_mismatch.py
[SIDE]` (192).

    python tests/benchmarks/bench_mismatch.py 192

The camera of `first_light` behind no mask and behind five half-rings, a green laser of strength
1e3, 1e5 and 1e6. The picture is simulated once. The filter is told the PSF and the laser exactly,
or with one error: direction (half a pixel on each axis), wavelength (2 nm) or defocus (0.1 waves).
PSNR in dB of the restored picture; a table in Markdown, with one row for each kind of knowledge of
the filter and its seconds of processor time. Of the grids of the filter only the coarsest are
solved densely here, which takes a third of the time.
"""

import sys
import time
from pathlib import Path

import torch

from neusee.nodes import metrics, restore
from neusee.nodes.restore.inverse import Light, _conjugate_gradients, _glare, _masked_blur
from neusee.workflows.engine.runner import run
from neusee.workflows.recipe.loading import load
from neusee.workflows.store.result_store import Store

PITCH, FOCAL = 2.9e-6, 0.11
HALF = 0.5 * PITCH / FOCAL
ERRORS = {
    "exactly": [],
    "direction 1/2 px": [f"lasers.green.angle=[{-1e-3 + HALF} rad, {1.2e-3 + HALF} rad]"],
    "wavelength 2 nm": ["lasers.green.wavelength=534 nm"],
    "defocus 0.1 waves": ["optics.defocus=0.1 waves"],
}
LINE = "green"
FILTERS = {
    "pattern known (doubt 0)": {},
    "doubt 0.1": {"doubt": 0.1},
    "doubt 0.3": {"doubt": 0.3},
    "variance of 24 patterns, pixel by pixel": {"patterns": 24, "alone": True},
    "12 patterns": {"patterns": 12},
    "24 patterns": {"patterns": 24},
    "likeliest doubt": {"doubt": None},
    "24 patterns and doubt 0.1": {"patterns": 24, "doubt": 0.1},
    "24 patterns and likeliest doubt": {"patterns": 24, "doubt": None},
}
SEEN = ["signal[mask]", "clipped[mask]", "truth", "matrix", "illuminant", "responses", "bands"]
TOLD = [
    "psf[mask]",
    f"laser_photons[mask,{LINE}]",
    f"laser_pupil[mask,{LINE}]",
    f"direction[{LINE}]",
    f"line[{LINE}]",
    f"laser_responses[{LINE}]",
]


def values(side, mask, strength, changes, names, store):
    """The results of some steps of the camera."""
    small = [
        f"scene.shape=[{side + 96},{side + 96}]",
        f"sensor.shape=[{side},{side}]",
        "optics.window=[512,512]",
    ]
    recipe = load(
        "first_light",
        [f"doe={mask}", f"lasers.green.strength={strength:g}", *small, *changes],
        Path(),
    )
    found = run(recipe, store, names)
    return {name: found[name] for name in names}


def patterns_of(told, count):
    """The patterns that the glare may have, by the law of the recipe group."""
    glare, pupil, towards, line, responses = (told[name] for name in TOLD[1:])
    rng = torch.Generator().manual_seed(0)
    return restore.nearby_glare(
        glare,
        pupil,
        towards,
        line,
        responses,
        focal_length=FOCAL,
        pixel_pitch=PITCH,
        patterns=count,
        rng=rng,
    )


def psnr(seen, told, patterns=0, doubt=0.0, alone=False):
    """PSNR of the picture that a filter with this knowledge restores."""
    glare, nearby = told[TOLD[1]], told["nearby"][:patterns] if patterns else None
    if alone:  # each pixel by itself: the same variance as a doubt that differs from pixel to pixel
        return _psnr(seen, _alone(seen, told, nearby))
    found = restore.wiener(
        *_picture(seen, told),
        [glare],
        None if nearby is None else [nearby],
        doubt=doubt,
        read_noise=10.5,
    )
    return _psnr(seen, found)


def _picture(seen, told):
    return (
        seen["signal[mask]"],
        told["psf[mask]"],
        seen["illuminant"],
        seen["responses"],
        seen["bands"],
        seen["clipped[mask]"],
    )


def _alone(seen, told, nearby):
    """The filter whose noise variance has that of the patterns, and no covariance."""
    whole = _glare._estimated

    def independent(electrons, weights, glare, doubt):
        light = whole(electrons, weights, glare, doubt)
        return Light(light.sum, _glare._total(light), [])

    _glare._estimated = independent
    try:
        return restore.wiener(
            *_picture(seen, told), [told[TOLD[1]]], [nearby], doubt=1e-9, read_noise=10.5
        )
    finally:
        _glare._estimated = whole


def _psnr(seen, found):
    return float(metrics.quality(restore.colour(found, seen["matrix"]), seen["truth"]).psnr)


def main(side):
    store = Store()
    _conjugate_gradients.LOWEST, _masked_blur.DENSE = 64, 20
    print(
        "| mask, strength | filter |",
        " | ".join(ERRORS),
        "| s |\n|---|---|" + "---|" * (len(ERRORS) + 1),
    )
    for mask in ("flat", "five_half_rings"):
        for strength in (1e3, 1e5, 1e6):
            seen = values(side, mask, strength, [], SEEN, store)
            told = {
                name: values(side, mask, strength, changes, TOLD, store)
                for name, changes in ERRORS.items()
            }
            for each in told.values():
                each["nearby"] = patterns_of(each, 24)
            for name, how in FILTERS.items():
                began = time.process_time()
                row = [psnr(seen, each, **how) for each in told.values()]
                took = (time.process_time() - began) / len(row)
                print(
                    f"| {mask}, {strength:g} | {name} |",
                    " | ".join(f"{x:.1f}" for x in row),
                    f"| {took:.1f} |",
                    flush=True,
                )


if __name__ == "__main__":
    main(int(sys.argv[1]) if len(sys.argv) > 1 else 192)
