"""The Python side: changes as Python values, runs from several threads, arrays out, and what a
notebook shows.
"""

from __future__ import annotations

import base64
import importlib
import io
import re
import sys
from concurrent.futures import ThreadPoolExecutor
from dataclasses import replace
from html.parser import HTMLParser
from pathlib import Path
from types import SimpleNamespace

import numpy
import pytest
import torch

import neusee
from neusee.nodes import Check, node
from neusee.nodes.metrics import Quality
from neusee.workflows import Recipe, RecipeError, Step, Store, load
from neusee.workflows.engine.result_values import arrays_of
from neusee.workflows.graph.errors import Location
from neusee.workflows.report import notebook, run_summary

CAMERA = """\
# A camera of toys.
sensor: {gain: 0.5, read_noise: 10 e-, bits: 12}
optics: {window: [8, 8], device: cpu}
lasers:
  green: {wavelength: 532 nm, strength: 1e3}
  red: {wavelength: 638 nm, strength: 2e3}
seed: 7
steps:
  height: {node: toy.height}
  pupil: {node: toy.pupil, from: height, with: {pitch: 3.74 um}}
  psf:
    node: toy.psf
    each: lasers
    from: pupil
    with: {shape: "${optics.window}", wavelength: "${item.wavelength}"}
    device: ${optics.device}
  spot: {node: toy.spot, each: lasers, from: psf, with: {strength: "${item.strength}"}}
  sum: {node: toy.gather, from: {photons: height, lasers: spot, ghosts: null}}
  raw:
    node: toy.digitize
    from: sum
    with: {gain: "${sensor.gain}", sigma: "${sensor.read_noise}", bits: "${sensor.bits}"}
outputs: [raw]
"""


@pytest.fixture
def given(toy, write, tmp_path):
    """Load the camera of toys with changes as Python values."""
    return lambda *overrides, **values: load(write(CAMERA), overrides, tmp_path, **values)


@pytest.fixture
def refused(given):
    """What changes are refused with: one line each."""

    def refused(**values):
        with pytest.raises(RecipeError) as caught:
            given(**values)
        return [
            " | ".join(filter(None, (str(p.mark), p.path, p.message)))
            for p in caught.value.diagnostics
        ]

    return refused


@pytest.mark.parametrize(
    ("values", "words"),
    [
        ({"sensor": {"read_noise": "20 e-"}}, ["sensor.read_noise=20 e-"]),
        ({"sensor.read_noise": "20 e-"}, ["sensor.read_noise=20 e-"]),
        ({"sensor": {"bits": 10, "gain": 0.25}}, ["sensor.bits=10", "sensor.gain=0.25"]),
        ({"lasers": {"green": {"strength": 1e4}}}, ["lasers.green.strength=1e4"]),
        ({"lasers.green": {"strength": 1e4}}, ["lasers.green.strength=1e4"]),
        ({"lasers": {}}, ["lasers={}"]),
        ({"optics": {"window": (16, 4)}}, ["optics.window=[16, 4]"]),
        ({"optics.window.0": 2}, ["optics.window.0=2"]),
        (
            {"seed": 3, "outputs": ["sum"], "tolerance": 0},
            ["seed=3", "outputs=[sum]", "tolerance=0"],
        ),
        ({"~lasers.red": None}, ["~lasers.red"]),
        (
            {"+lasers.blue": {"wavelength": "450 nm", "strength": 5}},
            ["+lasers.blue={wavelength: 450 nm, strength: 5}"],
        ),
        (
            {"steps": {"psf": {"with": {"shape": [2, 2]}}}},
            ["steps.psf.with.shape=[2, 2]", "~optics.window"],
        ),
        (
            {"steps": {"height": {"node": "toy.height", "with": {"samples": 8}}}},
            ["steps.height.with.samples=8"],
        ),
        ({"steps": {"raw": {"device": "cuda:1"}}}, ["steps.raw.device=cuda:1"]),
    ],
)
def test_python_values_are_what_the_command_line_says(given, values, words):
    if "~optics.window" in words:
        values = values | {"~optics.window": None}
    one, other = given(**values), given(*words)
    assert (one.seed, one.tolerance, one.outputs) == (other.seed, other.tolerance, other.outputs)
    assert list(one.steps) == list(other.steps)
    for name, step in one.steps.items():
        same = other.steps[name]
        assert (step.node, step.params, step.wires, step.device) == (
            same.node,
            same.params,
            same.wires,
            same.device,
        )


def test_positional_changes_come_first_and_keywords_win(given):
    recipe = given("sensor.bits=10", "sensor.gain=2", sensor={"bits": 8})
    assert (recipe.steps["raw"].params["bits"], recipe.steps["raw"].params["gain"]) == (8, 2)
    assert recipe.config["sensor.bits"].source == "argument sensor.bits"
    assert recipe.config["sensor.gain"].source == "argument 2"


def test_numbers_of_numpy_and_torch_and_paths_are_values(given, write):
    recipe = given(
        sensor={"gain": numpy.float64(2), "bits": torch.tensor(8)},
        optics={"window": numpy.array([2, 4])},
    )
    assert {name: recipe.steps["raw"].params[name] for name in ("gain", "bits")} == {
        "gain": 2.0,
        "bits": 8,
    }
    assert recipe.steps["psf[red]"].params["shape"] == (2, 4)
    picture = write("x", "picture.png")
    recipe = given(
        **{"+steps.photo": {"node": "toy.photograph", "with": {"file": Path("picture.png")}}}
    )
    assert recipe.steps["photo"].params["file"] == picture


def test_groups_are_chosen_by_keyword():
    recipe = load(
        "first_light",
        doe="axicon",
        sensor={"read_noise": "20 e-"},
        lasers={"green": {"strength": 1e4}},
    )
    assert recipe.steps["height"].node.path == "doe.axicon"
    assert recipe.steps["read[mask]"].params["read_noise"] == 20
    assert recipe.steps["spot[mask,green]"].params["strength"] == 1e4
    assert any("not compared" in note for note in recipe.notes)


@pytest.mark.parametrize(
    ("values", "lines"),
    [
        (
            {"sensor": {"read_nois": "20 e-"}},
            [
                "argument sensor.read_nois | sensor.read_nois=20 e- | unknown; did you mean"
                " sensor.read_noise?"
            ],
        ),
        (
            {"sensor": {"read_noise": 20, "bits": 0}},
            [
                "argument sensor.bits | sensor.bits = 0 | must be greater than or equal to 1",
                (
                    "argument sensor.read_noise | sensor.read_noise = 20 | needs a unit: write 20"
                    " e- (one of e-, ke-)"
                ),
            ],
        ),
        (
            {"sensor.bits": object(), "optics": {"window": {1.5: 2}}},
            [
                (
                    "argument optics | optics.window | a mapping's key must be a name or an"
                    " integer, not 1.5"
                ),
                (
                    "argument sensor.bits | sensor.bits | a recipe cannot contain a value of type"
                    " object: give a number, a string, True or False, None, a list or a mapping"
                ),
            ],
        ),
        (
            {"a b": 1},
            [
                "argument a b | a b | is not an override: write path=value, +path=value, ~path or"
                " group=option"
            ],
        ),
        (
            {"~sensor.bits": 3},
            [
                "argument ~sensor.bits | ~sensor.bits | "
                "~ removes a value and cannot set one: write {'~sensor.bits': None}"
            ],
        ),
    ],
)
def test_a_mistake_says_which_keyword(refused, values, lines):
    assert refused(**values) == lines


# --- where a step asks to run ---------------------------------------------------------------------


def test_a_step_says_where_it_wants_to_run(given):
    recipe = given(
        optics={"device": "cuda:1"}, steps={"raw": {"device": "gpu"}, "sum": {"device": "any"}}
    )
    devices = {name: step.device for name, step in recipe.steps.items()}
    assert devices == {
        "height": "",
        "pupil": "",
        "psf[green]": "cuda:1",
        "psf[red]": "cuda:1",
        "spot[green]": "",
        "spot[red]": "",
        "sum": "",
        "raw": "gpu",
    }
    assert recipe.config["steps.raw.device"].value == "gpu"


def test_a_wrong_device_is_located(refused, toy):
    assert refused(**{"optics.device": "cuda1"}) == [
        "argument optics.device | optics.device = cuda1 | unknown device: write any, cpu, gpu,"
        " cuda, cuda:1 or mps"
    ]
    assert refused(**{"steps.raw.device": 3}) == [
        "argument steps.raw.device | steps.raw.device = 3 | unknown device: write any, cpu, gpu,"
        " cuda, cuda:1 or mps"
    ]
    toy.digitize.device = "cpu"
    assert refused(**{"steps.raw.device": "mps"}) == [
        "argument steps.raw.device | steps.raw.device = mps | toy.digitize runs only on a CPU"
    ]
    toy.digitize.device = "gpu"
    assert refused(**{"steps.raw.device": "cpu"}) == [
        "argument steps.raw.device | steps.raw.device = cpu | toy.digitize runs only on a GPU"
    ]


def test_without_lasers_their_device_is_not_unused(given):
    assert given(lasers={}).config["optics.device"].value == "cpu"


# --- runs -----------------------------------------------------------------------------------------


CALLS: list[float] = []


@node()
def ramp(*, scale: float) -> torch.Tensor:
    """A picture of (3, 24, 40)."""
    CALLS.append(scale)
    return scale * torch.arange(24 * 40.0).reshape(24, 40).expand(3, 24, 40) / 960


@node()
def half(picture: torch.Tensor) -> torch.Tensor:
    return picture / 2


@node()
def quality(picture: torch.Tensor) -> Quality:
    mean = picture.double().mean()
    return Quality(mean, 2 * mean, mean / 2)


quality.fn.__module__ = "neusee.nodes.metrics"


@half.check
def _(result, picture):
    return [Check("half <b>of</b> it", False)]


def small(scale=1.0, samples=None) -> Recipe:
    """ramp -> half -> score, and the picture itself."""
    at = Location("small.yaml", 1, 1)
    steps = {
        "ramp": Step("ramp", ramp, {"scale": scale}, {}, at, {}),
        "half": Step("half", half, {}, {"picture": "ramp"}, at, {}),
        "score": Step("score", quality, {}, {"picture": "half"}, at, {}),
    }
    return Recipe("small", "A <i>ramp</i>.", 0, 1e-3, ("half", "score"), steps)


@pytest.fixture
def store(tmp_path):
    return Store(tmp_path / "cache")


def test_a_result_gives_arrays_and_figures_of_merit(store):
    result = neusee.run(small(2.0), store=store)
    assert torch.equal(result["half"], result.values["half"])
    assert isinstance(result["ramp"], torch.Tensor)
    array = result.numpy("half")
    assert isinstance(array, numpy.ndarray)
    assert numpy.array_equal(array, result["half"].numpy())
    found = result.numpy("score")
    assert isinstance(found, Quality)
    assert isinstance(found.psnr, numpy.ndarray)
    mean = float(result["half"].double().mean())
    assert result.metrics() == {"score.l1": mean, "score.psnr": 2 * mean, "score.ssim": mean / 2}
    assert list(neusee.run(small(2.0), store=store, outputs=["ramp"]).values) == ["ramp"]


def test_numbers_that_numpy_has_no_type_for_become_larger():
    assert arrays_of([torch.ones(2, dtype=torch.bfloat16)])[0].dtype == numpy.float32
    assert arrays_of({"a": (torch.ones(1), None)}) == {"a": (numpy.ones(1), None)}


def test_a_number_a_band_is_a_list(store, monkeypatch):
    @node()
    def lsr(picture: torch.Tensor) -> torch.Tensor:
        return picture[0, 0, :3]

    lsr.fn.__module__ = "neusee.nodes.metrics"
    recipe = small()
    recipe = Recipe(
        "small",
        "",
        0,
        0.0,
        ("lsr",),
        {**recipe.steps, "lsr": Step("lsr", lsr, {}, {"picture": "ramp"}, Location("x"), {})},
    )
    assert neusee.run(recipe, store=store).metrics()["lsr"] == pytest.approx([0, 1 / 960, 2 / 960])


@pytest.mark.slow
def test_several_threads_run_several_recipes_on_one_store(store):
    scales = [float(i % 7) for i in range(28)]
    with ThreadPoolExecutor(8) as pool:
        results = list(pool.map(lambda scale: neusee.run(small(scale), store=store), scales))
    for scale, result in zip(scales, results, strict=True):
        assert torch.equal(result["half"], half(ramp(scale=scale)))
        assert result.recipe.steps["ramp"].params["scale"] == scale
        assert set(result.done) == {"ramp", "half", "score"}


def test_several_threads_read_the_code_of_nodes_at_once(tmp_path):
    with ThreadPoolExecutor(8) as pool:
        results = list(
            pool.map(lambda i: neusee.run(small(1.0), store=Store(tmp_path / str(i))), range(12))
        )
    assert len({result.done["half"].key for result in results}) == 1


def test_several_threads_load_recipes_of_their_own(toy, write):
    path = write(CAMERA)
    with ThreadPoolExecutor(8) as pool:
        recipes = pool.map(lambda gain: load(path, sensor={"gain": gain}), range(1, 41))
    gains = [recipe.steps["raw"].params["gain"] for recipe in recipes]
    assert gains == list(range(1, 41))


# --- what a notebook shows ------------------------------------------------------------------------


class Page(HTMLParser):
    """Checks that every tag is closed, and collects texts, pictures and what the page would
    fetch.
    """

    def __init__(self, text: str) -> None:
        super().__init__()
        self.open, self.pictures, self.tags, self.words = [], [], set(), []
        self.feed(text)
        assert self.open == []

    def handle_starttag(self, tag, attrs):
        self.tags.add(tag)
        if tag == "img":
            given = dict(attrs)
            assert given["alt"]
            head, _, content = given["src"].partition(",")
            assert head == "data:image/png;base64"
            self.pictures.append(base64.b64decode(content))
        else:
            self.open.append(tag)

    def handle_endtag(self, tag):
        assert self.open.pop() == tag

    def handle_data(self, data):
        self.words.append(data.strip())


def sizes(page: Page) -> list[tuple[int, int]]:
    from PIL import Image

    return [Image.open(io.BytesIO(picture)).size for picture in page.pictures]


class Formatter:
    """Formatter of IPython, as far as a package tells it how to show its types."""

    def __init__(self):
        self.shown = {}

    def for_type_by_name(self, module, name, show):
        self.shown[module, name] = show


def told(shell, monkeypatch):
    """What the package tells IPython when it is imported while ``shell`` runs."""
    monkeypatch.setitem(sys.modules, "IPython", SimpleNamespace(get_ipython=lambda: shell))
    importlib.reload(neusee)


def test_a_notebook_is_told_how_to_show_a_recipe_and_a_result(store, monkeypatch):
    html = Formatter()
    display = SimpleNamespace(formatters={"text/html": html})
    told(SimpleNamespace(display_formatter=display), monkeypatch)
    result = neusee.run(small(), store=store)
    recipe = result.recipe
    assert len(html.shown) == 2
    show_result = html.shown[type(result).__module__, type(result).__name__]
    assert show_result(result) == notebook.result_html(result)
    show_recipe = html.shown[type(recipe).__module__, type(recipe).__name__]
    assert show_recipe(recipe) == notebook.recipe_html(recipe)


def test_where_no_notebook_runs_nothing_is_told(monkeypatch):
    told(None, monkeypatch)
    monkeypatch.delitem(sys.modules, "IPython")
    importlib.reload(neusee)


def test_a_result_shows_its_picture_its_values_and_its_steps(store):
    result = neusee.run(small(), store=store)
    text = notebook.result_html(result)
    page = Page(text)
    assert sizes(page) == [(40, 24)]
    assert not page.tags & {"script", "link", "iframe", "object"}
    assert "http" not in re.sub(r"base64,[^\"]+", "", text)
    assert "url(" not in text
    assert {
        "A <i>ramp</i>.",
        "half: half <b>of</b> it",
        "3 run in",
        "3 × 24 × 40",
        "not in the store",
    } <= {"3 run in" if w.startswith("3 run in") else w for w in page.words}
    assert any(w.startswith("l1 0.24974, psnr 0.49948") for w in page.words)
    again = neusee.run(small(), store=store)
    assert "2 cached" not in repr(again)
    assert repr(again).startswith("<result of small: half, score; 3 cached in ")
    assert "cached" in Page(notebook.result_html(again)).words


def test_a_recipe_shows_its_changes_its_steps_and_where_values_stand(given):
    recipe = given(sensor={"gain": 2})
    page = Page(notebook.recipe_html(recipe))
    assert {
        "spot ×2",
        "toy.spot",
        "argument sensor.gain",
        "mine.yaml:3:18",
        "gives raw",
        "Changes",
    } <= set(page.words)
    assert page.pictures == []
    assert repr(recipe) == "<recipe mine: 8 steps -> raw>"
    assert "Changes" not in Page(notebook.recipe_html(given())).words
    assert "where" in page.words  # the steps that ask for a device


@pytest.mark.slow
def test_pictures_weigh_less_than_a_megabyte_and_are_small(store):
    noise = torch.rand(3, 2000, 1500, generator=torch.Generator().manual_seed(1))
    for count in (1, 2, 4, 6):
        made = notebook._pictures({f"p{i}": noise for i in range(count)})
        assert len(made) == min(count, 4)
        assert sum(len(p["png"]) for p in made) < 900_000
        images = [base64.b64decode(p["png"]) for p in made]
        assert all(max(numpy.frombuffer(i[16:24], ">u4")) <= 640 for i in images)
    grey = notebook._pictures({"grey": torch.eye(16), "cube": torch.ones(31, 16, 16), "text": "x"})
    assert [p["name"] for p in grey] == ["grey"]


def test_the_overview_is_shown_by_one_stretch():
    white, black = torch.ones(3, 16, 16), torch.zeros(3, 20, 20)
    values = {
        "truth": white,
        "developed[plain]": black + 0.25,
        "developed[mask]": black,
        "restored": white * 2,
    }
    made = notebook._pictures({**values, "raw": white})
    assert [p["name"] for p in made] == ["truth", "plain lens", "with mask", "restored"]
    from PIL import Image

    pixels = [numpy.asarray(Image.open(io.BytesIO(base64.b64decode(p["png"])))) for p in made]
    assert [p.shape for p in pixels] == [(16, 16, 3)] * 4
    assert [int(p[0, 0, 0]) for p in pixels] == [255, 137, 0, 255]
    del values["restored"]
    assert [p["name"] for p in notebook._pictures({**values, "raw": white})] == [
        "truth",
        "plain lens",
        "with mask",
    ]


def test_showing_a_result_computes_nothing_that_took_long(store, monkeypatch):
    for module in (notebook, run_summary):
        monkeypatch.setattr(module, "TABLE", {"row": {"peak/I_sat": "ramp"}})
    result = neusee.run(small(), store=store, outputs=["half"])
    known = {"peak/I_sat", "row"}
    assert known <= set(Page(notebook.result_html(result)).words)
    monkeypatch.setattr(Store, "about", lambda self, key: None)
    slow = {name: replace(done, seconds=60.0) for name, done in result.done.items()}
    CALLS.clear()
    words = Page(notebook.result_html(replace(result, done=slow))).words
    assert not known & set(words)
    assert CALLS == []
    assert known <= set(Page(notebook.result_html(result)).words)  # cheap: had again
    assert CALLS == [1.0]
