"""A laser that nobody told, in a camera whose blur frames of white points gave: the camera is in
NumPy alone.

Its lens is out of focus by 0.4 waves, of which the model of the lens, which gives the pattern of
the laser, knows nothing. Restored pictures are compared with the scene that the camera saw, after
one gain for each channel.
"""

import numpy as np
import pytest
import torch

from neusee.nodes import restore
from tests.nodes.restore.lasers import own_camera as own
from tests.nodes.restore.lasers.as_inputs import LENS, inputs, pupil_of

SIDE, WINDOW, RIM = 64, (25, 25), 8
SENSOR = {
    "gain": own.GAIN,
    "offset": own.OFFSET,
    "full_well": own.WELL,
    "read_noise": own.READ,
    "bits": own.BITS,
}
clean_pupil, clean_psf = own.pupil, own.scene_psf


def out_of_focus(mask):
    """The true pupil: the height of a mask, and a path of 0.4 waves at the rim, as a height."""
    inside, height = clean_pupil("plain" if mask == "soft" else mask)
    at = (np.arange(own.SAMPLES) - (own.SAMPLES - 1) / 2) / (own.SAMPLES / 2)
    path = 0.4 * 550e-9 * (at[:, None] ** 2 + at**2)
    return inside, (height + path / own.silica(550e-9) * (mask == "soft")) * inside


def sharp(mask, side):
    """A PSF without blur."""
    found = np.zeros((len(own.BANDS), side, side), np.float32)
    found[:, side // 2, side // 2] = 1
    return found


def white_points(folder):
    """Take four frames of a white point at parts of a pixel, every other one thirty times as
    long, and a dark one.
    """
    rng = np.random.default_rng(5)
    weight = own.band_response() * own.daylight(own.BANDS) * own.BANDS
    for number in range(4):
        spot = rng.uniform(-0.5, 0.5, 2)
        seen = np.tensordot(
            weight, np.stack([own.pattern("soft", w, spot, (SIDE, SIDE)) for w in own.BANDS]), 1
        )
        light = 0.6 * own.WELL * seen / seen.max() * (30 if number % 2 else 1)
        save(folder / f"p{number}.npy", light, rng)
    save(folder / "dark.npy", np.zeros((3, SIDE, SIDE)), rng)


def save(file, light, rng):
    electrons, _ = own.digitized(light, rng)
    np.save(file, np.rint((electrons + own.OFFSET) * own.GAIN).astype(np.uint16).transpose(1, 2, 0))


def quality(picture, truth):
    """PSNR of a picture within the rim, after the best gain and level of each channel."""
    inner = (slice(RIM, -RIM), slice(RIM, -RIM))
    errors = []
    for seen, scene in zip(np.asarray(picture, float), truth, strict=True):
        columns = np.stack([seen[inner].ravel(), np.ones(seen[inner].size)], 1)
        rest = (
            scene[inner].ravel()
            - columns @ np.linalg.lstsq(columns, scene[inner].ravel(), rcond=None)[0]
        )
        errors.append((rest**2).mean() / scene.max() ** 2)
    return -10 * np.log10(np.mean(errors))


@pytest.mark.slow
def test_a_laser_behind_a_measured_psf_is_found_and_removed(tmp_path, monkeypatch):
    monkeypatch.setattr(own, "pupil", out_of_focus)
    white_points(tmp_path)
    responses, seed = torch.ones(3, 31), torch.Generator().manual_seed
    measured = restore.measured_psf(
        responses,
        files=tuple(sorted(tmp_path.iterdir())),
        window=WINDOW,
        shape=(SIDE, SIDE),
        draws=4,
        rng=seed(0),
        **SENSOR,
    )
    told = {"read_noise": own.READ}
    for strength in (1e3, 0.0):
        lasers = [own.Laser((9.3, -7.8), 533e-9, strength)] if strength else []
        frame = own.frame("soft", "leaves", SIDE, lasers, np.random.default_rng(3))
        with monkeypatch.context() as patch:
            patch.setattr(own, "scene_psf", sharp)
            truth = own.irradiance("soft", "leaves", SIDE, np.random.default_rng(3))
        given = inputs(frame, "plain")  # the lens of the recipe, in focus
        electrons, clipped, pupil = given[0], given[1], pupil_of("plain")
        found = restore.find_lasers(*given, most=2, lamps=2, **told, **LENS)
        assert int(found.number) == len(lasers)
        glare = [restore.found_glare(found, pupil, electrons, rank=1, **LENS)]
        nearby = [restore.found_nearby(found, pupil, electrons, rank=1, rng=seed(1), **LENS)]
        light = {"glare": glare, "nearby": nearby, "doubt": 0.3, **told}
        shown = {
            "nothing": electrons,
            "blind": restore.wiener_by_field(electrons, measured, clipped, **told),
            "search": restore.wiener(electrons, given[2], *given[4:], clipped, **light),
            "both": restore.wiener_by_field(electrons, measured, clipped, **light),
        }
        scores = {name: quality(picture, truth) for name, picture in shown.items()}
        print(strength, {name: round(score, 2) for name, score in scores.items()})
        assert scores["both"] > scores["nothing"] + 1.0
        assert scores["both"] > scores["search"] + 0.3
        assert scores["both"] > scores["blind"] + (1.0 if lasers else -0.01)
