"""The option `damage: published` in a recipe in watts: one verdict for every setting of the
camera, and dead pixels.
"""

import pytest
import torch

import neusee
from neusee.workflows import Store, load
from neusee.workflows.graph.errors import RecipeError

RECIPE = """\
# A small camera in watts with damage.
defaults:
  - camera: mono
  - scene: edge
  - illuminant: daylight
  - lift: mallett
  - optics: small
  - sensor: small
  - doe: axicon
  - flare: clean
  - restore: wiener
  - reading: coherent
  - damage: published
scene: {shape: [48, 48], illuminance: 500 lx}
optics: {samples: 128, pitch: 63.12 um, window: [48, 48], bands: 4}
sensor: {camera: mono.csv, shape: [40, 44], exposure: 5 ms, background: null, dark_current: 0.02 e-/s}
reading: {damage_multiple: null}
outputs: [damage, dead]
"""
GREEN = """\
lasers:
  dot: {wavelength: 532 nm, fwhm: 1 nm, power: 3 W, divergence: 1 mrad, distance: 30 m, angle: [0 mrad, 0 mrad]}
  flash: {wavelength: 532 nm, fwhm: 1 nm, pulse_energy: 7 uJ, pulse_duration: 10 ns, divergence: 1 mrad, distance: 50 m,
          angle: [0.1 mrad, 0.2 mrad]}
"""
INFRARED = """\
lasers:
  lidar: {wavelength: 1550 nm, fwhm: 1 nm, pulse_energy: 1 mJ, pulse_duration: 5 ns, repetition_rate: 100 kHz,
          divergence: 1 mrad, distance: 200 m, angle: [0 mrad, 0 mrad]}
"""
OWN = (
    "device,damage,wavelength from (nm),wavelength to (nm),duration from (ns),duration to (ns),"
    "threshold (J/cm2),source\n"
    "CMOS,line,1500,1600,1,100,0.01,invented\n"
)


@pytest.fixture(scope="module")
def compute(tmp_path_factory):
    """Outputs of the recipe with changes, from one store."""
    folder = tmp_path_factory.mktemp("damage")
    (folder / "green.yaml").write_text(RECIPE + GREEN)
    (folder / "infrared.yaml").write_text(RECIPE + INFRARED)
    (folder / "own.csv").write_text(OWN)
    (folder / "mono.csv").write_text("wavelength (nm),QE (%)\n350,20\n525,69\n1100,0.2\n")
    store = Store(folder / "store")
    return lambda name, outputs, *changes: neusee.run(
        load(f"{name}.yaml", list(changes), folder), store=store, outputs=outputs
    )


def test_the_verdict_is_the_same_for_every_exposure_gain_well_and_noise(compute):
    steps = [f"damage[{arm},{laser}]" for arm in ("plain", "mask") for laser in ("dot", "flash")]
    nominal = compute("green", steps)
    camera = (
        "sensor.gain=3 e-/DN",
        "sensor.full_well=900 e-",
        "sensor.quantum_efficiency=0.1",
        "sensor.read_noise=1 e-",
    )
    for change in (["sensor.exposure=1 us"], ["sensor.exposure=1 s", *camera]):
        other = compute("green", steps, *change)
        for step in steps:
            for field in ("ratio", "least", "most", "probability"):
                torch.testing.assert_close(
                    getattr(other[step], field), getattr(nominal[step], field), rtol=1e-5, atol=0
                )
    assert 1 < float(nominal["damage[plain,dot]"].ratio[0]) < 100
    assert float(nominal["damage[mask,dot]"].ratio[0]) < 1
    assert len(nominal["damage[plain,flash]"].ratio) == 7


@pytest.mark.slow
def test_the_frame_has_the_dead_pixels_of_both_lasers(compute):
    found = compute(
        "green", ["raw[plain]", "dead[plain]", "damage[plain,dot]", "damage[plain,flash]"]
    )
    raw, dead = found["raw[plain]"], found["dead[plain]"]
    pattern = (found["damage[plain,dot]"].pattern | found["damage[plain,flash]"].pattern)[
        4:44, 2:46
    ]
    black = (pattern & 4 > 0).any(0) | (pattern & 4 > 0).any(1)[:, None]  # crosses
    assert 0 < int((pattern & 1).sum()) < 400
    assert 0 < int(black.sum()) < black.numel()
    assert bool((dead[:, black] == 0).all())
    white = (pattern & 1 > 0) & ~black
    assert bool((dead[:, ~black & ~white] == raw[:, ~black & ~white]).all())


def test_a_laser_without_a_law_is_not_judged_and_the_others_are(compute):
    """Once one laser of 1550 nm refused the whole recipe."""
    found = compute("infrared", ["damage[plain,lidar]", "dead[plain]", "raw[plain]"])
    assert found["damage[plain,lidar]"].ratio.isnan().all()
    assert torch.equal(found["dead[plain]"], found["raw[plain]"])


def test_damage_none_takes_the_steps_out(compute):
    found = compute("green", ["raw[plain]"], "damage=none", "outputs=[raw]")
    assert float(found["raw[plain]"].max()) > 0
    with pytest.raises(RecipeError, match=r"outputs\.0 +step damage is null"):
        compute("green", ["raw[plain]"], "damage=none")


def test_at_1550_nm_own_thresholds_are_judged_although_no_channel_sees_the_laser(compute):
    step = "damage[plain,lidar]"
    found = compute("infrared", [step, "light[lidar]"], "damage.thresholds=own.csv")
    fluence = float(found["light[lidar]"].pulse_fluence)
    assert float(found[step].ratio[0]) == pytest.approx(fluence / 100, rel=0.05)
