"""Rivals of equal protection: equal peaks, the best of the candidates, and values that are those
of the nodes.
"""

import math
from dataclasses import replace

import numpy as np
import pytest
import torch

from neusee.nodes import metrics
from neusee.nodes.optics import round_lens
from neusee.workflows import load
from neusee.workflows.protection.equal_rivals import MEASURES, Candidate, best, quiet_picture
from neusee.workflows.protection.protection_camera import (
    Front,
    FrontBench,
    FrontSettings,
    ProtectionCamera,
    draw_conditions,
    usual_condition,
)
from neusee.workflows.store.result_store import Store

SMALL = ["optics.samples=128", "optics.pitch=63.125 um", "optics.bands=3", "optics.window=[64, 64]"]
SMALL += ["scene.shape=[64, 64]", "sensor.shape=[48, 48]", "doe.waves=5"]
SETTINGS = FrontSettings(0.1, 0.12, 12.0, (64,), None)


@pytest.fixture(scope="module")
def store(tmp_path_factory):
    """Fronts are measured once for all tests."""
    return Store(tmp_path_factory.mktemp("protection"))


@pytest.fixture(scope="module")
def bench(store):
    return FrontBench(ProtectionCamera.of(load("axicon", SMALL), store, 3), store, SETTINGS)


def test_every_rival_has_the_peak_of_the_mask(bench):
    usual = usual_condition()
    own = bench.measure(Front(True), usual).peak
    psf = bench.camera.psf(True, 1.0, bench.camera.bands)
    assert own == pytest.approx(float(metrics.lsr(psf).max()), rel=1e-6)
    for diameter in (1.0, 0.7, 0.5):
        one = bench.measure(Front(False, diameter), usual)
        grey = Candidate(Front(False, diameter), one, one.peak).transmittance(own)
        dimmed = bench.camera.psf(False, diameter, bench.camera.bands)
        peak = grey * metrics.lsr(dimmed).max()
        assert float(peak) == pytest.approx(own, rel=1e-6)
        # pixels average less of a wider spot away
        whole = bench.camera.psf(False, 1.0, bench.camera.bands)
        wider, lens = (
            round_lens(whole.cut_off * width, whole.averaged).peak for width in (diameter, 1.0)
        )
        assert one.peak == pytest.approx(diameter**4 * float((wider / lens).max()), rel=0.06)


@pytest.mark.parametrize("dwell", [None, 0.1])
def test_harm_is_that_of_the_worst_of_all_bands_of_the_recipe(store, dwell):
    """The scene has the shortest band alone, and an axicon passes a laser best in the longest."""
    camera = ProtectionCamera.of(load("axicon", SMALL), store, 1)
    bench = FrontBench(camera, store, replace(SETTINGS, dwell=dwell))
    every = ProtectionCamera.of(load("axicon", SMALL), store, 3).bands
    mask, lens = (camera.psf(masked, 1.0, every) for masked in (True, False))
    peaks = metrics.lsr(mask)
    assert float(peaks.max()) > 1.2 * float(peaks[0])
    measured = bench.measure(Front(True), usual_condition())
    assert measured.peak == pytest.approx(float(peaks.max()), rel=1e-6)
    if dwell is not None:
        heats = metrics.heat_ratio(mask, lens, pixel_pitch=camera.lens["pixel_pitch"], dwell=dwell)
        assert measured.heat == pytest.approx(float(heats.max()), rel=1e-6)


@pytest.mark.slow
def test_five_half_rings_protect_no_better_than_in_their_worst_band(store):
    """They pass 560 nm twice as well as its neighbours; seven bands from end to end miss it."""
    camera = ProtectionCamera.of(load("five_half_rings"), store, 7)
    measured = FrontBench(camera, store, FrontSettings(0.1, 0.12, 14.0, (512,), None)).measure(
        Front(True), usual_condition()
    )
    assert measured.peak == pytest.approx(0.0050, rel=0.02)


def test_a_quiet_picture_is_that_of_the_nodes(bench):
    front, usual = Front(True, 1.0), usual_condition()
    pixel = bench.camera.pixel(0.01, 0.02)
    psf = bench.camera.psf(True, 1.0, bench.camera.bands)
    light = bench.camera.illuminant, bench.camera.responses, bench.camera.bands
    for grey, n in ((1.0, 100.0), (0.1, 3000.0)):
        dim = psf._replace(intensity=psf.intensity * grey)
        exact = metrics.filtered_picture(dim, *light, electrons=n, read_noise=10.5, prnu=0.01)
        values = quiet_picture(bench.measure(front, usual), grey, n, pixel)
        assert values["error"] == pytest.approx(
            -10 * math.log10(float(exact.error.mean())), abs=2e-3
        )
        assert values["information"] == pytest.approx(
            10 * math.log10(float(exact.information.mean())), abs=2e-3
        )
        assert values["NEQ"] == pytest.approx(
            10 / math.log(10) * float(exact.log_neq.mean()), abs=1e-3
        )


def test_the_best_rival_is_the_best_of_the_candidates_at_the_wanted_protection(bench):
    usual, pixel = usual_condition(), bench.camera.pixel(0.0, 0.0)
    fronts = [Front(False, d) for d in (1.0, 0.7, 0.5)]
    measured = [Candidate(f, bench.measure(f, usual), bench.measure(f, usual).peak) for f in fronts]
    chosen = best(measured, 0.03, 100.0, pixel)
    for measure in MEASURES:
        each = [
            quiet_picture(c.found, min(1, 0.03 / c.protection), 100.0, pixel)[measure]
            for c in measured
        ]
        assert chosen[measure][0] == max(each)
        assert chosen[measure][1].front == fronts[int(np.argmax(each))]


def test_dirt_and_defocus_cost_the_filter_that_does_not_know_them(bench):
    calm, pixel = usual_condition(), bench.camera.pixel(0.01, 0.02)
    (rough,) = draw_conditions(1, 3)
    for front in (Front(True), Front(False)):
        one, other = (
            quiet_picture(bench.measure(front, c), 1.0, 1e4, pixel)["error"] for c in (calm, rough)
        )
        assert other < one


def test_another_mask_is_another_result(bench, store):
    other = FrontBench(
        ProtectionCamera.of(load("axicon", [*SMALL, "doe.waves=3"]), store, 3), store, SETTINGS
    )
    steep, gentle = (one.measure(Front(True), usual_condition()).peak for one in (bench, other))
    assert gentle > 1.2 * steep


def test_the_colour_of_a_laser_is_relative_to_the_channel_that_responds_most(bench):
    colour = bench.camera.laser_colour(bench.camera.laser_line(532e-9))
    assert float(colour.max()) == 1.0
    assert int(colour.argmax()) == 1
    at = bench.camera.laser_colour(bench.camera.laser_line(usual_condition().wavelength))
    assert torch.equal(bench.measure(Front(False), usual_condition()).colour, at)


def test_the_lens_scatters_the_same_veil_behind_every_front(bench):
    """The veil, without the core, by Harvey and Shack's law in the middle of a pixel; a stop
    passes less of it.
    """
    usual = replace(usual_condition(), scatter=0.3)
    (surface,), line = usual.surfaces.values(), bench.camera.laser_line(550e-9)
    scale = bench.camera.lens["pixel_pitch"] / bench.camera.lens["focal_length"]
    at = np.hypot(*np.meshgrid(*[np.arange(64) - 32] * 2)) * scale
    law = surface["b0"] * (1 + (at / surface["l"]) ** 2) ** (surface["s"] / 2) * scale**2
    far = at > 20 * scale
    for masked, diameter in ((False, 1.0), (True, 1.0), (True, 0.5)):
        whole, core = (
            one.intensity[0].double().numpy()
            for one in (
                bench.camera.laser_psf(masked, diameter, line, usual, angle=(0.0, 0.0)),
                bench.camera.psf(masked, diameter, line, usual, angle=(0.0, 0.0)),
            )
        )
        veil = whole - (1 - usual.scatter) * core
        assert veil[far] == pytest.approx(diameter**2 * law[far], rel=0.03, abs=5e-10)
