"""One small call of every node, and the tensor or the parameter of it that `torch.func` shall
follow.
"""

from dataclasses import dataclass, field
from functools import partial
from pathlib import Path
from typing import Any

import torch
from safetensors.torch import save_file

from neusee.nodes import calibrate, doe, optics, spectra
from neusee.nodes.restore import FFTMamba, Informed, NAFNet, UNet, Unrolled, start_network
from neusee.nodes.values import (
    Channels,
    Dirt,
    FewBands,
    FoundLasers,
    LowRankCube,
    MeasuredPsf,
    Psf,
    Pupil,
)

HERE = Path(__file__).parent


@dataclass
class Case:
    """A call, and where the tensor stands: an input and its field (``0.intensity``), or a
    parameter.
    """

    of: str
    inputs: tuple[Any, ...] = ()
    params: dict[str, Any] = field(default_factory=dict)
    #: relative agreement of forward and reverse mode in float64, larger where both iterate
    to: float = 1e-8


def seeded(seed=0):
    return torch.Generator().manual_seed(seed)


def rand(*shape, dtype=torch.float64, low=0.1, seed=0):
    return low + torch.rand(*shape, dtype=dtype, generator=seeded(sum(shape) + seed))


BANDS = spectra.bands(start=450e-9, stop=650e-9, count=4)
LINE = spectra.line(wavelength=532e-9, fwhm=5e-9, count=3)
INDEX = doe.material(BANDS)
LIGHT = spectra.illuminant(BANDS)
RESPONSES = spectra.responses(BANDS)
PICTURE, OTHER, SCENE, PLAIN = (
    rand(3, 12, 12),
    rand(3, 12, 12, seed=1),
    rand(4, 12, 12),
    rand(4, 12, 12, seed=1),
)
RAW = 2000 * rand(3, 12, 12)
WIDE_RAW = 2000 * rand(3, 48, 48)  # no longer solved exactly
PSF = Psf(rand(4, 9, 9) / 100, rand(4))
OTHER_PSF = Psf(rand(4, 9, 9) / 50, rand(4))
WIDE = Psf(rand(4, 12, 12) / 200, rand(4))
DISC = torch.ones(16, 16)
HEIGHT = rand(16, 16, dtype=torch.float32) * 1e-6
PUPIL = Pupil(
    DISC, DISC, HEIGHT, 0 * HEIGHT, INDEX, BANDS.centres, torch.tensor(5e-4, dtype=torch.float64)
)
DIRT = Dirt(rand(16, 16, dtype=torch.float32), HEIGHT.clone())
LOW_RANK = LowRankCube(rand(2, 12, 12), rand(4, 2), torch.zeros(3, 4, dtype=torch.float64))
ROWS = spectra.rows(BANDS, RESPONSES)
ALL_BANDS = FewBands(
    torch.eye(4, dtype=torch.float64), torch.arange(4), *torch.zeros(2, dtype=torch.float64)
)
CHANNELS = Channels(rand(3, 12, 12), rand(3, 4), torch.tensor(0.0, dtype=torch.float64))
LEVEL = 1e3 * rand(4)
LASER_PUPIL = PUPIL._replace(index=INDEX[:3], wavelengths=LINE.centres)
DIRECTION = torch.tensor([1e-4, -2e-4], dtype=torch.float64)
# a path of 0 has no scale but a metre
BENT = PUPIL._replace(path=1e-7 * rand(16, 16, dtype=torch.float32, seed=2))
_PLACE, _NM = DIRECTION[None], torch.tensor([533e-9], dtype=torch.float64)
_AMOUNT = torch.tensor([[4e4, 9e4, 1e4]], dtype=torch.float64)
FOUND = FoundLasers(
    torch.tensor(1), _PLACE, _NM, torch.full_like(_NM, 5e-9), _AMOUNT, torch.stack([_PLACE - 1e-6, _PLACE + 1e-6], -1),
    torch.stack([_NM - 2e-9, _NM + 2e-9], -1), torch.stack([0.9 * _AMOUNT, 1.1 * _AMOUNT], -1),
    torch.ones(1, 2, dtype=torch.bool), torch.tensor([[200.0, 100.0]], dtype=torch.float64),
    (0.9 * torch.eye(6, dtype=torch.float64) + 0.1)[None], 0.95 * _AMOUNT, 0.05 * _AMOUNT,
)  # fmt: skip
_KERNELS = rand(4, 1, 2, 3, 9, 9)
_KERNELS = _KERNELS / _KERNELS.sum((-2, -1), keepdim=True)
MEASURED = MeasuredPsf(
    _KERNELS.mean(0),
    _KERNELS.std(0),
    _KERNELS.float(),
    torch.zeros(1, 4, dtype=torch.float64),
    torch.ones(3, dtype=torch.float64),
    torch.zeros(3, dtype=torch.float64),
    *torch.ones(2, 1, 2, dtype=torch.float64),
)

STOP = optics.stop(samples=16, pitch=5e-4, diameter=8e-3)
LENS = {"focal_length": 0.11, "pixel_pitch": 2.9e-6}
STRAY = {**LENS, "diameter": 8e-3, "surfaces": {"lens": {"b0": 0.4, "l": 0.01, "s": -1.5}}}
WELL = {"full_well": 25500.0, "quantum_efficiency": 0.56, "pixel_pitch": 2.9e-6, "exposure": 0.1}
SHUTTER = {"pixel_pitch": 2.9e-6, "exposure": 0.1}
ADC = {"full_well": 25500.0, "gain": 1 / 0.37}
NOISE = {
    "quantum_efficiency": 0.56,
    "dark_current": 2.0,
    "dark_exposure": 0.1,
    "offset": 50.0,
    "full_well": 5e4,
}
SEEN = {"light": 70.0, "read_noise": 3.7, "limit": 0.03}
CAMERA = {"gain": 0.5, **NOISE, "read_noise": 3.0, "bits": 12}


def _levels():
    """Dark and lit frames of a small sensor."""
    photons = (0.0, 500.0, 2000.0, 8000.0)
    lit = [
        calibrate.expose(photons=n, exposure=0.1, shape=(16, 16), rng=seeded(3), **CAMERA)
        for n in photons
    ]
    each = [calibrate.reduce(f, photons=n, exposure=0.1) for f, n in zip(lit, photons, strict=True)]
    return lit[1], each, calibrate.levels(each)


FRAMES, EACH, LEVELS = _levels()
SUFFICIENT = calibrate.sufficient(LEVELS)
_FAR = torch.linspace(20.0, 40.0, 12, dtype=torch.float64)
_EIGHT, _SIXES = torch.full((8,), 300.0, dtype=torch.float64), torch.arange(12) % 8
RINGS = calibrate.Rings(
    1e5 / _FAR[:8], _EIGHT, _SIXES, _FAR**2, 0 * _FAR + 100, _FAR[:2], _EIGHT[0], _FAR[:2]
)
POINT = {"electrons": 3e8, "read_noise": 5.0, "gain": 0.5, "focal_length": 0.05, "diameter": 5e-3, "pixel_pitch": 5e-6,
         "wavelength": 550e-9, "scatter": 0.01}  # fmt: skip


def number(x):
    return torch.tensor(x, dtype=torch.float64)


def saved(folder, name, make):
    """A network's file, with weights that are not those of its start."""
    network = start_network(make, seeded())
    with torch.no_grad():
        for i, p in enumerate(network.parameters()):
            p.add_(0.05 * torch.randn(p.shape, generator=seeded(i)))
    save_file(network.state_dict(), folder / f"{name}.safetensors")
    return folder / f"{name}.safetensors"


def _networks(folder):
    sizes = {"width": 4, "blocks": 2, "states": 3}
    single = PICTURE.float()
    return {
        "restore.fft_mamba": Case(
            "0",
            (single,),
            {"weights": saved(folder, "fft_mamba", partial(FFTMamba, **sizes)), **sizes},
        ),
        "restore.informed": Case(
            "0",
            (WIDE_RAW, PSF, LIGHT, RESPONSES, BANDS, torch.zeros(3, 48, 48, dtype=torch.bool)),
            {
                "weights": saved(folder, "informed", partial(Informed, 2)),
                "width": 2,
                "read_noise": 5.0,
            },
        ),
        "restore.nafnet": Case(
            "0", (single,), {"weights": saved(folder, "nafnet", partial(NAFNet, 4)), "width": 4}
        ),
        "restore.network": Case(
            "0",
            (single,),
            {
                "weights": saved(folder, "own", partial(UNet, 4)),
                "architecture": UNet,
                "parameters": {"width": 4},
            },
        ),
        "restore.unet": Case(
            "0", (single,), {"weights": saved(folder, "unet", partial(UNet, 4)), "width": 4}
        ),
        "restore.unrolled": Case(
            "0",
            (WIDE_RAW, PSF, LIGHT, RESPONSES, BANDS, torch.zeros(3, 48, 48, dtype=torch.bool)),
            {
                "weights": saved(folder, "unrolled", partial(Unrolled, 2)),
                "width": 2,
                "read_noise": 5.0,
            },
        ),
        "spectra.lift_mst_plus_plus": Case(
            "0",
            (
                rand(3, 16, 16, dtype=torch.float32),
                spectra.bands(start=400e-9, stop=700e-9, count=31),
            ),
            {"untrained": "allow"},
        ),
    }


BEAM = {"divergence": 1e-3, "distance": 100.0}

CASES = {
    "calibrate.camera": Case(
        "gain",
        (LEVELS,),
        {
            "gain": number(0.5),
            "quantum_efficiency": 0.56,
            "dark_signal": 25.0,
            "temporal_dark_noise": 3.0,
        },
    ),
    "calibrate.density": Case(
        "gain", (SUFFICIENT,), {"gain": number(0.5), **NOISE, "read_noise": 3.0, "bits": 12}
    ),
    "calibrate.expose": Case(
        "photons", (), {"photons": number(500.0), "exposure": 0.1, "shape": (4, 4), **CAMERA}
    ),
    "calibrate.least_squares": Case("0.variance", (LEVELS,)),
    "calibrate.levels": Case("0.0.mean", (EACH,)),
    "calibrate.reduce": Case("0", (FRAMES,), {"photons": 500.0, "exposure": 0.1}),
    "calibrate.stray_light": Case(
        "b0", (RINGS,), {"b0": number(10.0), "l": 0.01, "s": -2.0, **POINT}
    ),
    "calibrate.sufficient": Case("0.mean", (LEVELS,)),
    "doe.axicon": Case("waves", (STOP,), {"waves": number(2.0)}),
    "doe.cubic": Case("waves", (STOP,), {"waves": number(2.0)}),
    "doe.equal_filter": Case("1", (RAW, rand(4), BANDS, [LINE])),
    "doe.fabricate": Case("0", (HEIGHT,), {"wrap_at": 550e-9, "levels": 4}),
    "doe.half_rings": Case("waves.0", (STOP,), {"waves": [number(2.0), number(1.0)]}),
    "doe.height_error": Case("0", (HEIGHT, STOP), {"rms": 1e-8, "depth": 0.01}),
    "doe.material": Case("0.centres", (BANDS,)),
    "doe.shade": Case("transmittance", (STOP,), {"transmittance": number(0.3), "diameter": 0.8}),
    "doe.smooth": Case("0", (HEIGHT, STOP), {"feature": 1e-3}),
    "doe.spiral_axicon": Case("waves", (STOP,), {"waves": number(2.0), "charge": 1}),
    "doe.zernike": Case(
        "coefficients.4", (STOP,), {"coefficients": {4: number(0.3), 6: number(0.1)}}
    ),
    "flare.dirt": Case("grease", (STOP,), {"grease": number(1e-7), "dust": 3.0}),
    "flare.ghosts": Case(
        "0", (rand(3, 12, 12), LINE, DIRECTION), {**LENS, "count": 3, "radius": 3e-5}
    ),
    "laser.damage": Case(
        "0", (rand(3, 12, 12), LINE), {"pixel_pitch": 2.9e-6, "exposure": 0.1, "dwell": 0.1}
    ),
    "laser.damaged_pixels": Case("0", (RAW,), ADC),
    "laser.dazzle": Case(
        "0",
        (RAW, [RAW]),
        {"shape": (8, 8), "full_well": 25500.0, "quantum_efficiency": 0.56, "read_noise": 5.0},
    ),
    "laser.dazzle_curve": Case("0.intensity", (Psf(rand(3, 9, 9), rand(3)), LINE)),
    "laser.bright_pixels": Case(
        "0.intensity", (Psf(rand(3, 9, 9), rand(3)), LINE), {"shape": (9, 9), "pixel_pitch": 2.9e-6}
    ),
    "laser.light": Case(
        "power",
        (LINE, STOP),
        {**BEAM, "power": number(5e-3), "focal_length": 0.11, "exposure": 0.1},
    ),
    "laser.wavefront": Case("distance", (LINE,), {**BEAM, "distance": number(100.0)}),
    "flare.stray_light": Case("0.intensity", (PSF, PUPIL), STRAY),
    "flare.stray_shares": Case("0.intensity", (PSF, PSF, PUPIL), STRAY),
    "losses.background_loss": Case("0.intensity", (PSF, SCENE)),
    "losses.charbonnier": Case("0", (PICTURE, OTHER)),
    "losses.log_error": Case("0", (PICTURE, OTHER)),
    "losses.contrast": Case("0.intensity", (WIDE,)),
    "losses.fft_l1": Case("0", (PICTURE, OTHER)),
    "losses.filtered_error": Case("0.intensity", (WIDE, LIGHT, RESPONSES, BANDS), SEEN),
    "losses.gradient_penalty": Case("0", (rand(2, 3, 5),)),
    "losses.information": Case("0.intensity", (WIDE, LIGHT, RESPONSES, BANDS), SEEN),
    "losses.suppression_loss": Case("0.intensity", (PSF,)),
    "losses.mrae": Case("0", (SCENE, PLAIN)),
    "losses.wiener": Case("0.intensity", (WIDE, LIGHT, RESPONSES, BANDS)),
    "metrics.bsr": Case("0.intensity", (PSF, SCENE)),
    "metrics.encircled": Case("0.intensity", (PSF,), {"pixel_pitch": 2.9e-6, "radius": 8e-6}),
    "metrics.filtered_picture": Case(
        "0.intensity", (PSF, LIGHT, RESPONSES, BANDS), {"electrons": 50.0, "read_noise": 3.0}
    ),
    "metrics.heat_ratio": Case(
        "0.intensity", (PSF, OTHER_PSF), {"pixel_pitch": 2.9e-6, "dwell": 1e-3}
    ),
    "metrics.light_outside": Case("0.intensity", (PSF, PUPIL)),
    "metrics.limits": Case("0.clear_peak", (PSF,)),
    "metrics.lsr": Case("0.intensity", (PSF,)),
    "metrics.mtf": Case("0.intensity", (WIDE,)),
    "metrics.peak_bsr": Case("0", (SCENE, PLAIN)),
    "metrics.peak_irradiance": Case("0", (SCENE, BANDS, LEVEL), WELL),
    "metrics.protection_bounds": Case(
        "0.intensity", (WIDE,), {"electrons": 50.0, "read_noise": 3.0}
    ),
    "metrics.quality": Case("0", (PICTURE, OTHER)),
    "metrics.saturated": Case("0", (RAW,), ADC),
    "metrics.spectral_error": Case("0.height", (PUPIL, BANDS, LIGHT, RESPONSES), LENS),
    "optics.direction": Case(
        "focal_length", (), {**LENS, "focal_length": number(0.11), "shape": (64, 64)}
    ),
    "optics.few_bands": Case(
        "0.height", (PUPIL, LOW_RANK, ROWS), {**LENS, "shape": (9, 9), "within": 0.1}
    ),
    "optics.few_bands_checked": Case("2.height", (ALL_BANDS, PSF, PUPIL, LOW_RANK, ROWS), LENS),
    "optics.image": Case("1.intensity", (SCENE, PSF)),
    "optics.image_channels": Case("1.intensity", (LOW_RANK, PSF, ROWS)),
    "optics.pupil_of_bands": Case("0.height", (PUPIL, ALL_BANDS)),
    "optics.psf": Case("0.height", (PUPIL,), {**LENS, "shape": (9, 9)}),
    "optics.pupil": Case("0", (HEIGHT, INDEX, BANDS, STOP, DIRT)),
    "optics.laser_irradiance": Case(
        "0.intensity", (Psf(rand(3, 9, 9), rand(3)), LINE), {"strength": 10.0, **WELL}
    ),
    "optics.white_irradiance": Case(
        "illuminance", (BANDS, STOP), {"illuminance": number(1e3), "focal_length": 0.11}
    ),
    "restore.clipped": Case("0", (RAW,), ADC),
    "restore.colour": Case("0", (PICTURE, rand(3, 3))),
    "restore.colour_matrix": Case(
        "1", (BANDS, LIGHT, RESPONSES, LEVEL), {**SHUTTER, "quantum_efficiency": 0.56}
    ),
    "restore.electrons": Case("0", (RAW,), {"gain": 1 / 0.37, "offset": 50.0}),
    "restore.find_lasers": Case(
        "0",
        (
            2000 * rand(3, 32, 32),
            torch.zeros(3, 32, 32, dtype=torch.bool),
            PSF,
            PUPIL,
            LIGHT,
            RESPONSES,
            BANDS,
        ),
        {**LENS, "read_noise": 5.0, "most": 1, "lamps": 0},
    ),
    "restore.found_glare": Case("1.height", (FOUND, BENT, PICTURE), LENS),
    "restore.found_nearby": Case("1.height", (FOUND, BENT, PICTURE), {**LENS, "patterns": 2}),
    "restore.nearby_glare": Case(
        "1.height",
        (rand(3, 9, 9), LASER_PUPIL, DIRECTION, LINE, spectra.responses(LINE)),
        {**LENS, "patterns": 2},
    ),
    "restore.richardson_lucy": Case(
        "0",
        (WIDE_RAW, PSF, LIGHT, RESPONSES, BANDS, torch.zeros(3, 48, 48, dtype=torch.bool)),
        {"read_noise": 5.0, "iterations": 3},
    ),
    "restore.white_level": Case(
        "0", (RAW, torch.zeros(RAW.shape, dtype=torch.bool), PSF, BANDS, LIGHT, RESPONSES), WELL
    ),
    "restore.filter_facts": Case(
        "0",
        (WIDE_RAW, PSF, LIGHT, RESPONSES, BANDS, torch.zeros(3, 48, 48, dtype=torch.bool)),
        {"read_noise": 5.0},
        to=1e-3,
    ),
    "restore.wiener_problem": Case(
        "0",
        (WIDE_RAW, PSF, LIGHT, RESPONSES, BANDS, torch.zeros(3, 48, 48, dtype=torch.bool)),
        {"read_noise": 5.0},
        to=1e-3,
    ),
    "restore.spread_by_field": Case(
        "3",
        (WIDE_RAW, MEASURED, torch.zeros(3, 48, 48, dtype=torch.bool), rand(3, 3)),
        {"read_noise": 5.0, "draws": 2},
    ),
    "restore.wiener_by_field": Case(
        "0",
        (WIDE_RAW, MEASURED, torch.zeros(3, 48, 48, dtype=torch.bool)),
        {"read_noise": 5.0},
        to=1e-3,
    ),
    "restore.wiener_spread": Case(
        "6",
        (
            WIDE_RAW,
            PSF,
            LIGHT,
            RESPONSES,
            BANDS,
            torch.zeros(3, 48, 48, dtype=torch.bool),
            rand(3, 3),
        ),
        {"read_noise": 5.0, "draws": 2},
    ),
    "restore.wiener": Case(
        "0",
        (WIDE_RAW, PSF, LIGHT, RESPONSES, BANDS, torch.zeros(3, 48, 48, dtype=torch.bool)),
        {"read_noise": 5.0},
        to=1e-3,
    ),
    "scene.grey": Case("0", (PICTURE,)),
    "scene.targets": Case("high", (), {"kind": "siemens", "shape": (12, 12), "high": number(0.9)}),
    "sensor.crop": Case("0", (SCENE,), {"shape": (8, 8)}),
    "sensor.dark_current": Case("0", (RAW,), {"mean": 2.0, "full_well": 25500.0}),
    "sensor.digitize": Case("0", (RAW,), {"gain": 1 / 0.37}),
    "sensor.expose": Case("0", (SCENE, BANDS, RESPONSES, LEVEL), SHUTTER),
    "sensor.full_well": Case("0", (RAW,), {"capacity": 3000.0}),
    "sensor.add_photons": Case("0", (RAW, [RAW], [RAW])),
    "sensor.level": Case("0", (SCENE, BANDS, RESPONSES), {"strength": 0.7, **WELL}),
    "sensor.limits": Case(
        "read_noise",
        (),
        {"full_well": 25500.0, "quantum_efficiency": 0.56, "read_noise": number(5.0)},
    ),
    "sensor.photon_noise": Case("0", (RAW,), {"quantum_efficiency": 0.56}),
    "sensor.photon_transfer": Case(
        "full_well",
        (),
        {
            **ADC,
            "full_well": number(25500.0),
            "quantum_efficiency": 0.56,
            "offset": 50.0,
            "read_noise": 3.0,
            "dark": 2.0,
            "levels": 3,
            "pixels": 64,
        },
    ),
    "sensor.read_noise": Case("0", (RAW,), {"offset": 50.0, "read_noise": 3.0}),
    "sensor.saturation": Case("0.centres", (BANDS,), WELL),
    "spectra.bands": Case("start", (), {"start": number(450e-9), "stop": 650e-9, "count": 4}),
    "spectra.compress": Case("0", (SCENE,)),
    "spectra.filters": Case(
        "centres.0", (), {"centres": [number(500e-9), number(600e-9)], "widths": [1e-8, 1e-8]}
    ),
    "spectra.grain": Case("0", (PICTURE,)),
    "spectra.illuminant": Case("0.centres", (BANDS,)),
    "spectra.illuminate": Case("0", (SCENE, LIGHT)),
    "spectra.leaves": Case("0", (rand(5, 4), BANDS), {"shape": (12, 12)}),
    "spectra.lift_lmmse": Case("0", (PICTURE, BANDS)),
    "spectra.lift_lmmse_mixture": Case("0", (PICTURE, BANDS)),
    "spectra.lift_mallett": Case("0", (PICTURE, BANDS)),
    "spectra.lift_mallett_mixture": Case("0", (PICTURE, BANDS)),
    "spectra.line": Case("wavelength", (), {"wavelength": number(532e-9)}),
    "spectra.metamers": Case("0", (rand(5, 4), BANDS), {"count": 4}),
    "spectra.reflectances": Case("0.centres", (BANDS,)),
    "spectra.render": Case("0", (SCENE, BANDS)),
    "spectra.responses": Case("0.centres", (BANDS,)),
    "spectra.rows": Case("1", (BANDS, RESPONSES)),
}

#: nodes that take no tensor and no parameter that could be one
NOTHING_TO_FOLLOW = {
    "calibrate.camera_prior": "states the prior that a recipe writes",
    "calibrate.descriptor": "reads a file",
    "calibrate.frames": "reads files",
    "calibrate.hot_pixels": "reads files",
    "calibrate.point_source": "reads files",
    "calibrate.prior": "states the prior that a recipe writes",
    "calibrate.stray_prior": "states the prior that a recipe writes",
    "calibrate.table": "reads a file",
    "doe.flat": "is 0 on every grid",
    "doe.pixelwise": "reads a file, or draws heights that are to be trained",
    "doe.unet": "draws a network that is to be trained",
    "doe.vortex": "has a whole charge alone",
    "optics.stop": "states the pupil grid, which other nodes read as plain numbers",
    "restore.measured_psf": "reads files",
    "scene.exr": "reads a file",
    "sensor.frame": "reads a file",
    "scene.hyperspectral": "reads a file",
    "scene.photograph": "reads a file",
    "spectra.line_table": "reads a file",
}


def cases(folder):
    """Every case; the files of networks are written to ``folder``."""
    return CASES | _networks(folder)
