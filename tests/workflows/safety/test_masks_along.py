"""Limits and intervals of distance behind a mask are those of a separate code."""

import math
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np
import pytest

from neusee.workflows import Store, load
from neusee.workflows.safety.laser_spots import peaks_of
from neusee.workflows.safety.run_safety import document
from neusee.workflows.safety.safety_estimate import estimate
from tests.workflows.safety import own_mask_spot as own

EFFICIENCY, WELL, EXPOSURE = 0.05, 30000, 1e-6
END = 1.03  # ends of intervals agree within this factor
CAREFUL = 0.08  #: on the careful side, since what an interpolation may miss counts upward
LIMIT = 0.03  # limits at the distance of the recipe agree within this share

pytestmark = pytest.mark.usefixtures("without_remedies")

RECIPE = """
defaults: [camera: lens_only, optics: lens_only, doe: {doe}, safety: masked_dazzle]
optics: {{focal_length: {focal_length} m, diameter: {diameter} m, spot_pitch: {spot_pitch} m, samples: {samples}}}
wide: {{pitch: {wide_pitch} m, window: {window}}}
doe: {numbers}
lasers:
  pointer:
    wavelength: {wavelength} m
    power: {power} W
    divergence: {divergence} rad
    waist: {waist} m
    m_squared: null
    distance: {metres} m
safety:
  draws: 100
  distances: [{near} m, 1 km]
  lens: {{focal_length: {focal_length} m, diameter: {diameter} m, transmittance: {transmittance}}}
  sensor: {{pixel_pitch: {pixel} m, shape: {shape}, quantum_efficiency: 0.05, full_well: 30000 e-, exposure: 1 us}}
  dazzle: {{share: {share}}}
  damage: {{file: thresholds.csv}}
  protection: {{mask: "laser_lsr[mask,pointer]"}}
outputs: [laser_lsr]
"""
THRESHOLDS = (
    "device,damage,wavelength from (nm),wavelength to (nm),duration from (s),duration to (s),"
    "threshold (kW/cm2),low (kW/cm2),high (kW/cm2),spot (um),source\n"
    "CMOS,line,300,1200,1e-9,1e6,{threshold},{low},{high},,drawn\n"
)


@dataclass(frozen=True)
class Case:
    """A recipe of a drawn camera and the laser that reaches its limits at two distances."""

    setting: own.Setting
    doe: str
    numbers: str
    samples: int
    parts: int  # samples of the dazzled area in a pixel
    share: float
    saturates_at: float
    damages_at: float
    metres: float = 10.0
    near: float = 0.3

    @property
    def saturation(self) -> float:
        return own.saturation(
            self.setting.wavelength, self.setting.pixel, EFFICIENCY, WELL, EXPOSURE
        )

    @property
    def power(self) -> float:
        return self.saturation / own.levels(self.setting, self.saturates_at, self.share)[0]

    @property
    def threshold(self) -> float:
        return self.power * own.peak(self.setting, self.damages_at)

    @property
    def unit(self) -> float:
        return self.setting.wavelength * self.setting.focal_length / self.setting.diameter


def write(case: Case, power: float, threshold: float, folder: Path) -> str:
    """Write the recipe, its thresholds and its height map, and return the path of the recipe."""
    setting = case.setting
    kilowatts = threshold / 1e7
    bracket = {"threshold": kilowatts, "low": kilowatts * 0.999, "high": kilowatts * 1.001}
    (folder / "thresholds.csv").write_text(THRESHOLDS.format(**bracket))
    if case.doe == "pixelwise":
        line = (np.arange(case.samples) - (case.samples - 1) / 2) * 2 / case.samples
        np.save(folder / "mask.npy", setting.mask.height(*np.meshgrid(line, line, indexing="ij")))
    text = RECIPE.format(
        doe=case.doe,
        numbers=case.numbers,
        focal_length=setting.focal_length,
        diameter=setting.diameter,
        spot_pitch=case.unit / 4,
        samples=case.samples,
        wide_pitch=setting.pixel / case.parts,
        window=[count * case.parts for count in setting.shape],
        wavelength=setting.wavelength,
        power=power,
        divergence=setting.divergence,
        waist=setting.waist,
        metres=case.metres,
        near=case.near,
        transmittance=setting.transmittance,
        pixel=setting.pixel,
        shape=list(setting.shape),
        share=case.share,
    )
    path = folder / "masked.yaml"
    path.write_text(text)
    return str(path)


def behind_mask(path: str, changes: list[str], store: Store) -> tuple[dict[str, dict], list[str]]:
    """Return the rows of the mask by effect, and what the estimate does not say."""
    said = document(estimate(load(path, changes), store))
    rows = {row["effect"]: row for row in said["limits"] if row["protection"] == "mask"}
    return rows, said["not_said"]


def holds(ends: list[tuple[float, float]], metres: float) -> bool:
    return any(near / END <= metres <= far * END for near, far in ends)


def own_levels(case: Case, metres: float, name: str) -> tuple[float, float]:
    """Return the light for each watt at a rank 8 pixels, or a hundredth, later and earlier.

    Pixels stand on a lattice, about a spot in the middle of one: eight of them have the same
    distance.
    """
    light = own.pixels(case.setting, metres)
    if name == "with scatter":
        light = 0.995 * light + own.scattered(case.setting, metres)
    room = max(0.01 * case.share, 8 / light.size)
    return own.faintest_of(light, case.share + room), own.faintest_of(light, case.share - room)


def own_margins(
    case: Case, power: float, threshold: float, name: str, metres: float
) -> tuple[float, float]:
    """Return the least and the greatest exposure over the limit that the separate code allows."""
    if name == "damage":
        return (power * own.peak(case.setting, metres) / threshold,) * 2
    lower, higher = own_levels(case, metres, name)
    return power * lower / case.saturation, power * higher / case.saturation


def compare(case: Case, power: float, threshold: float, name: str, row: dict) -> None:
    """Compare the limit, the ends of all intervals, and the distances outside of them, of one
    row.
    """

    def margins(metres: float) -> tuple[float, float]:
        return own_margins(case, power, threshold, name, metres)

    lower, higher = margins(case.metres)
    assert lower * (1 - LIMIT) < row["ratio"] < higher * (1 + CAREFUL), (
        name,
        row["ratio"],
        lower,
        higher,
    )
    ends = [(zone["near"]["value"], zone["far"]["value"]) for zone in row["zones"]]
    assert ends, name
    for near, far in ends:
        begins = near == pytest.approx(case.near)
        assert begins or (margins(near / END)[0] < 1 < margins(near * (1 + CAREFUL))[1]), (
            name,
            near,
        )
        assert margins(far / (1 + CAREFUL))[1] > 1 > margins(far * END)[0], (name, far)
    for metres in np.geomspace(case.near, 300, 7):
        assert holds(ends, metres) or margins(metres)[0] < 1, (
            f"{name}: not exceeded at {metres:g} m"
        )


def check(case: Case, folder: Path) -> None:
    """Compare one camera with and without scatter."""
    power, threshold = case.power, case.threshold
    path, store = write(case, power, threshold, folder), Store(folder / "store")
    rows, _ = behind_mask(path, [], store)
    compare(case, power, threshold, "damage", rows["damage"])
    compare(case, power, threshold, "with scatter", rows["dazzle"])
    rows, _ = behind_mask(path, ["+safety.lens.scatter=null"], store)
    compare(case, power, threshold, "without scatter", rows["dazzle"])


SMALL = Case(
    setting=own.Setting(
        wavelength=532e-9,
        divergence=1e-3,
        waist=2 * 532e-9 / (math.pi * 1e-3),
        focal_length=0.0103,
        diameter=2.5e-3,
        transmittance=0.9,
        pixel=2.1e-6,
        shape=(61, 81),
        mask=own.axicon(5),
    ),
    doe="axicon",
    numbers="{waves: 5}",
    samples=192,
    parts=1,
    share=0.04,
    saturates_at=12.0,
    damages_at=3.0,
    metres=5.0,
)


@pytest.mark.slow
def test_a_small_camera_behind_an_axicon(tmp_path):
    check(SMALL, tmp_path)


def tilted(waves: float) -> own.Mask:
    """Return a wedge that moves the spot by 2 wavelengths times f-number a wave."""
    wave = 550e-9 / own.fused_silica(550e-9)
    return own.Mask(lambda v, u: waves * wave * (1 + u) + 0 * v, waves)


@pytest.mark.slow
@pytest.mark.parametrize(("waves", "is_computed"), [(12.0, True), (40.0, False)])
def test_a_peak_outside_the_window_of_its_spot_counts(waves, is_computed, tmp_path):
    """In a window of 16 wavelengths times f-number to each side a spot at 24 is found, one at 80
    is bounded.
    """
    setting = replace(SMALL.setting, mask=tilted(waves))
    numbers = f"{{file: mask.npy, unit: 1 m, pitch: {setting.diameter / SMALL.samples:.12g} m}}"
    path = write(
        replace(SMALL, setting=setting, doe="pixelwise", numbers=numbers), 1.0, 1.0, tmp_path
    )
    recipe = load(
        path, ["optics.window=[128, 128]", "safety.distances=[0.5 m, 100 m]", "safety.dazzle=null"]
    )
    assert recipe.safety is not None
    peaks = peaks_of(recipe, recipe.safety, Store(tmp_path / "store"))
    assert peaks is not None
    for metres, ratio in peaks.along[::3]:
        truth = own.peak(setting, metres) / own.clear_peak(setting, metres)
        assert ratio > 0.97 * truth, metres
        assert ratio < 1.03 * truth or not is_computed, metres
    assert bool(peaks.outside) != is_computed


def drawn_mask(kind: str, draw: np.random.Generator) -> tuple[own.Mask, str, str]:
    """Return a mask of a kind, its recipe and the numbers of the recipe."""
    if kind == "axicon":
        waves = round(draw.uniform(4, 20), 1)
        return own.axicon(waves), "axicon", f"{{waves: {waves}}}"
    if kind == "five_half_rings":
        slopes = tuple(int(waves) for waves in draw.integers(6, 26, 5))
        return own.five_half_rings(slopes), "five_half_rings", f"{{waves: {list(slopes)}}}"
    waves = round(draw.uniform(4, 20), 1)
    return (
        own.smooth_random(int(draw.integers(1000)), waves),
        "pixelwise",
        "{file: mask.npy, unit: 1 m, pitch: PITCH m}",
    )


def drawn_case(kind: str, seed: int) -> Case:
    """Draw a camera, a beam, a mask and the distances at which the limits are reached."""
    draw = np.random.default_rng(seed)
    wavelength = round(draw.uniform(450, 900)) * 1e-9
    diameter = round(draw.uniform(2.5, 5), 2) * 1e-3
    focal_length = round(diameter * draw.uniform(2.8, 8), 5)
    unit = wavelength * focal_length / diameter
    divergence = round(draw.uniform(0.5, 3), 2) * 1e-3
    mask, doe, numbers = drawn_mask(kind, draw)
    samples = 384
    return Case(
        setting=own.Setting(
            wavelength=wavelength,
            divergence=divergence,
            waist=2 * wavelength / (math.pi * divergence) * draw.choice([1.0, 1.5]),
            focal_length=focal_length,
            diameter=diameter,
            transmittance=0.9,
            pixel=round(unit * draw.uniform(0.9, 1.5), 8),
            shape=(2 * int(draw.integers(70, 90)) + 1, 2 * int(draw.integers(90, 110)) + 1),
            mask=mask,
        ),
        doe=doe,
        numbers=numbers.replace("PITCH", f"{diameter / samples:.12g}"),
        samples=samples,
        parts=3,
        share=round(draw.uniform(0.03, 0.06), 4),
        saturates_at=draw.uniform(15, 100),
        damages_at=draw.uniform(5, 40),
    )


@pytest.mark.parametrize(
    ("kind", "seed"),
    [
        pytest.param("axicon", 1, marks=pytest.mark.long),  # a smaller one is above
        pytest.param("five_half_rings", 2, marks=pytest.mark.slow),
        pytest.param("smooth_random", 3, marks=pytest.mark.slow),
    ],
)
def test_drawn_cameras_behind_masks(kind, seed, tmp_path):
    check(drawn_case(kind, seed), tmp_path)


@pytest.mark.slow
def test_bounds_count_where_the_samples_do_not_carry_the_curvature(tmp_path):
    """At 0.3 m a beam of 20 mrad has 50 waves of curvature over a lens of 8 mm, which 192
    samples do not carry.
    """
    small = SMALL.setting
    lens = replace(
        small,
        divergence=0.02,
        waist=2 * 532e-9 / (math.pi * 0.02),
        focal_length=4.12 * 8e-3,
        diameter=8e-3,
    )
    case = replace(SMALL, setting=lens, metres=0.3)
    power, threshold = case.power, case.threshold
    rows, not_said = behind_mask(
        write(case, power, threshold, tmp_path), [], Store(tmp_path / "store")
    )
    assert any("At less than" in sentence for sentence in not_said), not_said
    assert rows["damage"]["ratio"] > own_margins(case, power, threshold, "damage", 0.3)[0]
    assert rows["dazzle"]["ratio"] > own_margins(case, power, threshold, "with scatter", 0.3)[0]
