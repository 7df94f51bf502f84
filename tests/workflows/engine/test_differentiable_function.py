"""A recipe as a function: the same bits as a run, with gradients, computing no more than it
must.
"""

import math
from dataclasses import replace

import pytest
import torch
from torch.autograd import gradcheck

from neusee.nodes import TensorStats, node
from neusee.workflows.engine.differentiable_function import _Ends, as_function
from neusee.workflows.engine.runner import run
from neusee.workflows.graph.errors import Location, RunError
from neusee.workflows.graph.recipe_graph import Recipe, Step
from neusee.workflows.recipe.loading import load
from neusee.workflows.store.result_store import Store

CALLS: list[str] = []
SMALL = ["optics.samples=96", "optics.pitch=84.15 um", "optics.bands=5", "optics.window=[24, 24]"]
SMALL += ["scene.shape=[32, 32]", "sensor.shape=[24, 24]"]


@node()
def scene(*, n: int = 64):
    CALLS.append("scene")
    return torch.linspace(0.0, 1.0, n, dtype=torch.float64)


@node()
def height(*, n: int = 64, scale: float = 1.0):
    CALLS.append("height")
    return scale * torch.linspace(-1.0, 1.0, n, dtype=torch.float64)


@node()
def psf(height, *, focus: float = 0.5):
    CALLS.append("psf")
    field = torch.exp(1j * (height * 6 + focus * height**2))
    power = torch.fft.fft(field).abs().square()
    return torch.stack([power, power], -1)[:, 0]


@node()
def image(scene, psf, *, gain: float = 2.0):
    CALLS.append("image")
    return gain * torch.fft.ifft(torch.fft.fft(scene) * torch.fft.fft(psf)).real


@node()
def noise(image, *, sigma: float = 0.1, rng: torch.Generator):
    CALLS.append("noise")
    return image + sigma * torch.randn(image.shape, generator=rng, dtype=image.dtype)


@noise.skip_bound
def _(image, *, sigma):
    return sigma / image.max


@node()
def loss(images):
    CALLS.append("loss")
    return sum(i.square().mean() for i in images)


@pytest.fixture(autouse=True)
def _fresh():
    CALLS.clear()


@pytest.fixture
def store(tmp_path):
    return Store(tmp_path)


def step(name, what, wires=None, **params):
    return Step(
        name, what, dict(what.params(**params)), wires or {}, Location("test.yaml", 1, 1), {}
    )


def camera(tolerance=0.0, **params):
    """Scene and height, two points of focus, noise on each, and one number of both."""
    given = {name: {} for name in ("height", "psf[a]", "image[a]", "noise[a]")} | params
    steps = [
        step("scene", scene),
        step("height", height, **given["height"]),
        step("psf[a]", psf, {"height": "height"}, **given["psf[a]"]),
        step("psf[b]", psf, {"height": "height"}, focus=2.0),
        step("image[a]", image, {"scene": "scene", "psf": "psf[a]"}, **given["image[a]"]),
        step("image[b]", image, {"scene": "scene", "psf": "psf[b]"}),
        step("noise[a]", noise, {"image": "image[a]"}, **given["noise[a]"]),
        step("loss", loss, {"images": ("noise[a]", "image[b]")}),
    ]
    return Recipe("test", "", 7, tolerance, ("loss",), {s.name: s for s in steps})


def number(x, **options):
    return torch.tensor(x, dtype=torch.float64, **options)


@pytest.mark.parametrize("gain", [2.0, 3.7])
def test_a_parameter_gives_what_a_run_gives(store, gain):
    function = as_function(camera(), "image[a].gain", store=store)
    expected = run(camera(**{"image[a]": {"gain": gain}}), store).values["loss"]
    assert torch.equal(function({"image[a].gain": gain})["loss"], expected)
    assert torch.equal(function({"image[a].gain": number(gain)})["loss"], expected)


@pytest.mark.parametrize("scale", [1.0, 0.3])
def test_a_step_gives_what_a_run_gives(store, scale):
    recipe = replace(camera(height={"scale": scale}), outputs=("loss", "noise[a]", "psf[b]"))
    function = as_function(recipe, "height", store=store)
    result = run(recipe, store)
    found = function({"height": result.value("height")})
    assert list(found) == ["loss", "noise[a]", "psf[b]"]
    assert all(torch.equal(found[name], result.values[name]) for name in found)


def test_gradients_reach_parameters_and_steps(store):
    recipe = camera()
    one = as_function(recipe, "psf[a].focus", "image[a].gain", store=store)
    names = ("psf[a].focus", "image[a].gain")
    inputs = (number(0.4, requires_grad=True), number(1.5, requires_grad=True))
    assert gradcheck(lambda *x: one(dict(zip(names, x, strict=True)))["loss"], inputs)
    whole = as_function(recipe, "height", store=store)
    start = run(recipe, store).value("height")[:64].clone().requires_grad_()
    assert gradcheck(lambda x: whole({"height": x})["loss"], start)


def test_what_theta_cannot_reach_is_computed_once(store):
    function = as_function(camera(), "image[a].gain", store=store)
    assert sorted(CALLS) == ["height", "image", "psf", "psf", "scene"]
    CALLS.clear()
    for gain in (1.0, 2.0, 3.0):
        function({"image[a].gain": gain})
    assert CALLS == ["image", "noise", "loss"] * 3
    CALLS.clear()
    as_function(camera(), "image[a].gain", store=Store(store.root))
    assert CALLS == []


def test_what_makes_a_given_step_is_not_run(store):
    as_function(camera(), "height", store=store)
    assert CALLS == ["scene"]


def test_an_output_that_nothing_reaches_is_a_constant(store):
    function = as_function(camera(), "image[a].gain", store=store, outputs=("image[b]", "image[a]"))
    one, two = (function({"image[a].gain": gain}) for gain in (1.0, 2.0))
    assert one["image[b]"] is two["image[b]"]
    assert not torch.equal(one["image[a]"], two["image[a]"])


def test_a_given_step_may_itself_be_an_output(store):
    x = torch.ones(64, dtype=torch.float64)
    found = as_function(camera(), "height", store=store, outputs=("height", "loss"))({"height": x})
    assert torch.equal(found["height"], x)


def test_noise_is_the_same_at_every_call(store):
    function = as_function(camera(), "image[a].gain", store=store)
    assert torch.equal(
        function({"image[a].gain": 2.0})["loss"], function({"image[a].gain": 2.0})["loss"]
    )


@pytest.mark.parametrize("gain", [1e-6, 1.0, 1e6])
def test_the_ladder_stands_as_in_a_run(store, gain):
    recipe = camera(tolerance=1e-3, **{"image[a]": {"gain": gain}})
    result = run(recipe, store, outputs=("noise[a]",))
    CALLS.clear()
    function = as_function(recipe, "image[a].gain", store=store, outputs=("noise[a]",))
    x = number(gain, requires_grad=True)
    found = function({"image[a].gain": x})["noise[a]"]
    assert torch.equal(found, result.values["noise[a]"])
    assert ("noise" in CALLS) == (result.done["noise[a]"].state == "run") == (gain < 1)
    found.sum().backward()
    assert x.grad is not None


def test_a_free_bound_parameter_moves_the_verdict(store):
    function = as_function(
        camera(tolerance=1e-3), "noise[a].sigma", store=store, outputs=("noise[a]",)
    )
    clean, noisy = (function({"noise[a].sigma": number(s)})["noise[a]"] for s in (0.0, 1e3))
    assert CALLS.count("noise") == 1
    assert not torch.equal(clean, noisy)


@pytest.mark.parametrize(
    ("free", "message"),
    [
        ("heigth", "no step 'heigth'; did you mean height"),
        ("image[a].gian", r"image\[a\] has no parameter 'gian'; did you mean gain"),
        ("imag[a].gain", r"no step 'imag\[a\]'; did you mean image\[a\]"),
        ("image[b].gain", r"no output depends on image\[b\]"),
    ],
)
def test_a_wrong_name_is_refused_with_the_nearest(store, free, message):
    with pytest.raises(ValueError, match=message):
        as_function(camera(), free, store=store, outputs=("noise[a]",))


@pytest.mark.parametrize("theta", [{}, {"height": 1.0, "scene": 1.0}, {"scene": 1.0}])
def test_theta_must_be_what_was_asked_for(store, theta):
    with pytest.raises(ValueError, match="theta must hold exactly height"):
        as_function(camera(), "height", store=store)(theta)


def test_an_error_names_the_step(store):
    function = as_function(camera(), "height", store=store)
    with pytest.raises(
        RunError,
        match=r"image\[a\] .*RuntimeError(?s:.*)inputs: scene \(64,\) float64, psf \(63,\) float64",
    ):
        function({"height": torch.ones(63, dtype=torch.float64)})


def test_a_chain_of_ten_thousand_steps(store):
    steps = [step("s0", height, n=4)] + [
        step(f"s{i}", psf, {"height": f"s{i - 1}"}) for i in range(1, 10_000)
    ]
    recipe = Recipe("test", "", 1, 0.0, ("s9999",), {s.name: s for s in steps})
    assert as_function(recipe, "s9990", store=store)(
        {"s9990": torch.zeros(4, dtype=torch.float64)}
    )["s9999"].shape == (4,)
    assert CALLS == ["psf"] * 9


@pytest.mark.parametrize("values", [[1.0, -2.0, 3.5], [math.nan, 1.0], [math.inf, -1.0], []])
def test_the_ends_of_a_picture_are_those_of_its_facts(values):
    x = torch.tensor(values)
    quick, whole = _Ends(x), TensorStats.of(x)
    for name in ("shape", "dtype", "min", "max", "finite", "sum", "support"):
        one, other = getattr(quick, name), getattr(whole, name)
        assert one == other or (one != one and other != other), name


def test_torch_func_follows_it_backwards_as_autograd_does(store):
    """A given value is a view of a larger tensor: it is settled, although what `torch.func`
    follows owns no memory.
    """
    function = as_function(camera(), "height", outputs=["loss"], store=store)
    given = torch.linspace(-1.0, 1.0, 128, dtype=torch.float64)[::2]
    found, pull = torch.func.vjp(lambda x: function({"height": x})["loss"], given)
    leaf = given.clone().requires_grad_()
    expected = function({"height": leaf})["loss"]
    assert torch.equal(found, expected.detach())
    torch.testing.assert_close(
        pull(torch.ones_like(found))[0], torch.autograd.grad(expected, leaf)[0]
    )


def test_torch_func_follows_a_parameter(store):
    function = as_function(camera(), "image[a].gain", outputs=["loss"], store=store)

    def loss(gain):
        return function({"image[a].gain": gain})["loss"]

    gain = torch.tensor(2.0, dtype=torch.float64)
    leaf = gain.clone().requires_grad_()
    torch.testing.assert_close(
        torch.func.grad(loss)(gain), torch.autograd.grad(loss(leaf), leaf)[0]
    )


# too wide for an exact restoration
WIDE = [*SMALL[:-1], "sensor.shape=[48, 48]", "scene.shape=[56, 56]"]


def camera_and_height(store, output, exact=False):
    """``first_light`` as a function of the height of its mask, and that height."""
    recipe = load("first_light", WIDE if output == "restored" else SMALL, doe="axicon")
    recipe = replace(recipe, exact=exact)
    function = as_function(recipe, "fabricated", outputs=[output], store=store)
    return lambda height: function({"fabricated": height})[output], run(
        recipe, store, ["fabricated"]
    )["fabricated"]


# of torch
@pytest.mark.slow
@pytest.mark.filterwarnings("ignore:`torch.jit.script`", "ignore:There is a performance drop")
@pytest.mark.parametrize("output", ["lsr[mask]", "raw[mask]", "restored"])
def test_torch_func_follows_the_camera_backwards_and_forwards(output, store):
    result, height = camera_and_height(store, output)
    rng = torch.Generator().manual_seed(1)
    found, pull = torch.func.vjp(result, height)
    weight, push = (
        torch.rand(found.shape, dtype=found.dtype, generator=rng),
        1e-9 * torch.rand(96, 96, generator=rng),
    )
    leaf = height.clone().requires_grad_()
    expected = result(leaf)
    assert torch.equal(found, expected.detach())
    (slope,) = torch.autograd.grad(expected, leaf, weight)
    torch.testing.assert_close(pull(weight)[0], slope)
    value, change = torch.func.jvp(result, (height,), (push,))
    assert torch.equal(value, found)
    terms = (slope * push).double(), (change * weight).double()
    off = abs(float(terms[0].sum() - terms[1].sum()))
    assert off < 1e-3 * float(terms[1].abs().sum())
    assert off < 1e-2 * abs(float(terms[1].sum()))


# of torch
@pytest.mark.filterwarnings("ignore:`torch.jit.script`", "ignore:There is a performance drop")
@pytest.mark.parametrize("output", ["lsr[mask]", "raw[mask]"])
def test_torch_func_follows_the_exact_camera_for_several_masks(output, store):
    result, height = camera_and_height(store, output, exact=True)
    masks = torch.stack([height, 1.1 * height, 0 * height])
    found = torch.func.vmap(result, randomness="same")(masks)
    assert not torch.equal(found[0], found[1])
    torch.testing.assert_close(
        found, torch.stack([result(mask) for mask in masks]), rtol=1e-6, atol=0
    )


# of torch
@pytest.mark.filterwarnings("ignore:`torch.jit.script`", "ignore:There is a performance drop")
def test_a_psf_has_no_second_derivative_in_any_mode(store):
    result, height = camera_and_height(store, "lsr[mask]")
    push = torch.ones_like(height)
    slope = torch.func.grad(lambda x: result(x).sum())
    with pytest.raises(RuntimeError, match="no second derivative"):
        torch.func.jvp(slope, (height,), (push,))
    with pytest.raises(RuntimeError, match="no second derivative"):
        torch.func.grad(lambda x: torch.func.jvp(result, (x,), (push,))[1].sum())(height)
    with pytest.raises(RuntimeError, match="no second derivative"):
        torch.func.grad(lambda x: slope(x).sum())(height)


# of torch
@pytest.mark.filterwarnings("ignore:`torch.jit.script`", "ignore:There is a performance drop")
@pytest.mark.parametrize(
    ("output", "exact", "step", "way"),
    [
        ("raw[mask]", False, r"image\[mask\]", "or take dataclasses.replace"),
        (
            "restored",
            True,
            "deconvolved",
            "call the function for one tensor after another; recipes/guide",
        ),
    ],
)
def test_what_does_not_pass_a_transform_is_told_with_its_place_and_a_way(
    output, exact, step, way, store
):
    result, height = camera_and_height(store, output, exact)
    with pytest.raises(
        RunError, match=rf"\.yaml:\d+:\d+   {step}.*torch\.func\.vmap does not pass .*{way}"
    ):
        torch.func.vmap(result, randomness="same")(torch.stack([height, height]))


def test_a_mistake_under_a_transform_stays_what_it_is(store):
    function = as_function(camera(), "height", outputs=["loss"], store=store)
    with pytest.raises(
        RunError,
        match=r"(?s)^(?!.*does not pass).*inputs: scene \(64,\) float64, psf \(63,\) float64",
    ):
        torch.func.vjp(
            lambda x: function({"height": x})["loss"], torch.ones(63, dtype=torch.float64)
        )
