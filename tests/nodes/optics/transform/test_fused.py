"""The PSF in C++ against the torch path and the matrices of the definition; the node's own tests
run the C++ too.
"""

import hashlib
import math
import shutil

import pytest
import torch

from neusee.nodes import cpp_library, doe
from neusee.nodes.optics import _psf, _psf_definition, psf, pupil, stop
from neusee.nodes.optics.transform import Axis, Sampling, View, _fused, fused_axis, intensity_of
from neusee.nodes.spectra import bands
from neusee.nodes.values import Psf, Pupil

CPU = torch.device("cpu")


@pytest.fixture(scope="module", autouse=True)
def _compiled():
    if shutil.which("g++") is None:
        pytest.skip("no g++: the torch path is tested by itself")
    _fused.operators()  # where there is a compiler, code that does not compile is a failure


def rough(rows, columns, kind=torch.float32, path=0.0, seed=0):
    """A pupil whose height is random, with an amplitude that is zero outside a disc, in two
    bands.
    """
    draw = torch.Generator().manual_seed(seed)
    v, u = (torch.linspace(-1, 1, n, dtype=torch.float64) for n in (rows, columns))
    disc = (v[:, None].square() + u.square() <= 1).to(kind)
    height, bend, grey = (
        torch.rand(rows, columns, generator=draw, dtype=torch.float64).to(kind) for _ in range(3)
    )
    bands = torch.tensor([450e-9, 620e-9], dtype=torch.float64)
    pitch = torch.tensor(8e-3 / max(rows, columns), dtype=torch.float64)
    return Pupil(disc, disc * grey, 2e-5 * height, path * bend, 0.46 + 0 * bands, bands, pitch)


def camera(shape, **params):
    return _psf._Camera(0.11, 2.9e-6, shape, **params)


CASES = [
    ((64, 64), (64, 64), {}, {}),
    ((301, 240), (33, 47), {}, {"path": 3e-6}),
    ((130, 97), (210, 190), {"angle": (1e-4, -2e-4)}, {}),
    (
        (48, 48),
        (35, 40),
        {"pixel": "zoh", "sensor": "integrated"},
        {"path": 1e-6, "kind": torch.float64},
    ),
    ((17, 240), (250, 3), {"pixel": "zoh"}, {}),
    ((1, 5), (1, 1), {}, {}),
]


@pytest.mark.parametrize(("pupil", "shape", "params", "given"), CASES)
@pytest.mark.parametrize("dtype", [torch.float32, torch.float64])
def test_it_is_the_torch_path_but_for_round_off(pupil, shape, params, given, dtype):
    light, view = rough(*pupil, **given), camera(shape, **params)
    found, expected = (
        _psf._focus(light, view, dtype, method).intensity for method in ("fused", "kaiser_bessel")
    )
    truth = _psf_definition.by_definition(light, view).intensity
    averaged = 1e-5 * float(expected.max()) if "sensor" in params else 0.0
    peak = float(_psf_definition.by_definition(light, camera((33, 33))).intensity.max())
    limit = (2e-6 if dtype == torch.float32 else 1e-12) * peak
    assert found.dtype == dtype
    assert float((found - expected).abs().max()) <= limit
    assert float((found - truth).abs().max()) <= limit + averaged


@pytest.mark.parametrize("dtype", [torch.float32, torch.float64])
def test_its_gradients_are_those_of_the_torch_path(dtype):
    light, weight = rough(97, 120, kind=dtype, path=3e-6), torch.rand(2, 41, 30, dtype=dtype)

    def slopes(method):
        parts = [x.clone().requires_grad_() for x in light[1:4]]
        lit = light._replace(amplitude=parts[0], height=parts[1], path=parts[2])
        light_of = _psf._focus(lit, camera((41, 30), pixel="zoh"), dtype, method).intensity
        return torch.autograd.grad((light_of * weight).sum(), parts)

    for found, expected in zip(slopes("fused"), slopes("kaiser_bessel"), strict=True):
        limit = 3e-6 if dtype == torch.float32 else 1e-12
        assert float((found - expected).abs().max()) <= limit * float(expected.abs().max())


def test_only_the_gradient_that_is_asked_for_and_none_where_no_light_passes():
    light, weight = rough(50, 50), torch.ones(2, 9, 9)
    height = light.height.clone().requires_grad_()
    both = light._replace(height=height, amplitude=light.amplitude.clone().requires_grad_())
    (alone,) = torch.autograd.grad(
        (
            _psf._focus(
                light._replace(height=height), camera((9, 9)), torch.float32, "fused"
            ).intensity
            * weight
        ).sum(),
        height,
    )
    amplitude, together = torch.autograd.grad(
        (_psf._focus(both, camera((9, 9)), torch.float32, "fused").intensity * weight).sum(),
        (both.amplitude, height),
    )
    assert torch.equal(alone, together)
    assert not alone[light.amplitude == 0].any()
    assert amplitude[light.amplitude == 0].abs().min() > 0  # a sample that opens would add light


@pytest.mark.parametrize("turns", [1e8, -1e8])
def test_a_phase_of_many_turns_is_exact(turns):
    """One sample sends |U|^2 = 1; two samples interfere as their phases do, whole turns apart or
    not.
    """
    axis = Axis(1, 1, 0.1), Axis(2, 1, 0.1)
    height = torch.tensor([[0.0, turns + 0.3]], dtype=torch.float64)
    sampling = Sampling((View(0, *axis, 1.0, 0.0, (0.0, 0.0), 1.0),), torch.float32, "fused")
    found = float(intensity_of(torch.ones(1, 2), height, torch.zeros(1, 2), sampling))
    assert found == pytest.approx(4 * math.cos(0.3 * math.pi) ** 2, abs=1e-5)


def test_the_bits_depend_on_no_thread(monkeypatch):
    monkeypatch.setattr(_fused, "_SAMPLES_PER_THREAD", 1)
    light = rough(150, 150)
    before = torch.get_num_threads()
    try:
        found = []
        for threads in (1, 2):
            torch.set_num_threads(threads)
            found.append(_psf._focus(light, camera((60, 61)), torch.float32, "fused").intensity)
    finally:
        torch.set_num_threads(before)
    assert torch.equal(*found)


@pytest.mark.filterwarnings("ignore:.*torch.jit.script.*:DeprecationWarning")
def test_a_forward_derivative_outside_of_torch_func_is_refused_and_not_lost():
    light = rough(20, 20)
    with torch.autograd.forward_ad.dual_level():
        height = torch.autograd.forward_ad.make_dual(light.height, torch.ones(20, 20))
        with pytest.raises(NotImplementedError, match="forward mode"):
            _psf._focus(light._replace(height=height), camera((8, 8)), torch.float32, "fused")


@pytest.mark.parametrize(("name", "value"), [("height", math.nan), ("path", -math.inf)])
def test_a_length_that_is_not_finite_is_refused(name, value):
    light = rough(20, 20)
    getattr(light, name)[3, 4] = value
    with pytest.raises(ValueError, match=f"{name} holds values that are not finite"):
        _psf._focus(light, camera((8, 8)), torch.float32, "fused")


def test_not_a_number_in_the_amplitude_is_seen():
    light = rough(40, 40)
    light.amplitude[0, 0] = math.nan
    assert not _psf._focus(light, camera((8, 8)), torch.float32, "fused").intensity.isfinite().any()


def test_every_factor_of_the_fft_is_used_by_the_cases():
    used = set()
    for samples, shape, *_ in CASES:
        for n, k in zip(samples, shape, strict=True):
            alpha = 8e-3 / max(samples) * 2.9e-6 / (450e-9 * 0.11)
            used |= set(
                fused_axis(Axis(n, k, alpha), torch.float32, torch.float32, torch.float32)
                .held[0]
                .tolist()
            )
    assert used == {2, 3, 4, 5, 8}


def test_without_a_compiler_torch_computes_and_it_is_said_once(monkeypatch, tmp_path):
    monkeypatch.setenv("XDG_CACHE_HOME", str(tmp_path))
    monkeypatch.setenv("CXX", str(tmp_path / "no-such-compiler"))
    cpp_library._say_once.cache_clear()
    light = rough(64, 64)
    with pytest.warns(
        UserWarning, match=r"C\+\+ of the PSF is not compiled and torch computes the PSF"
    ) as said:
        found = [
            _psf._focus(light, camera((64, 64)), torch.float32, "auto").intensity for _ in range(2)
        ]
    assert len(said) == 1
    expected = _psf._focus(light, camera((64, 64)), torch.float64, "direct").intensity
    assert all(float((x - expected).abs().max()) <= 2e-6 * float(expected.max()) for x in found)
    with pytest.raises(cpp_library.NoCompilerError, match="could not be run"):
        _psf._focus(light, camera((64, 64)), torch.float32, "fused")


def test_the_digest_of_the_sources_is_that_of_the_sources():
    sources = b"".join(path.read_bytes() for path in _fused.SOURCES)
    assert hashlib.sha256(sources).hexdigest().startswith(_fused.DIGEST)
    assert len(_fused.DIGEST) == 16


@pytest.mark.parametrize(
    ("samples", "pixels", "milliseconds"),
    [(256, 128, 0.37), (540, 160, 1.03), (540, 512, 1.79), (540, 768, 2.59), (1080, 240, 3.56), (1080, 1080, 7.0),
     (2160, 480, 12.8), (2160, 2048, 32.0)],
)  # fmt: skip
def test_the_work_of_a_psf_is_what_the_compiled_code_took(samples, pixels, milliseconds):
    """Milliseconds of one thread (AVX-512), measured for a round stop of 8.08 mm at 540 nm."""
    light, pitch = bands(start=540e-9, stop=540e-9, count=1), 8.0784e-3 / samples
    shape = stop(samples=samples, pitch=pitch, diameter=8.0784e-3)
    lens = {"focal_length": 0.11, "pixel_pitch": 2.9e-6}
    clear = pupil(doe.flat(shape), doe.material(light), light, shape)
    result = Psf(torch.empty(1, pixels, pixels, device="meta"), torch.ones(1))
    assert psf.hooks.work(result, clear, **lens)[1] == pytest.approx(1e6 * milliseconds, rel=0.2)
