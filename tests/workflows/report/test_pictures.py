"""Pictures: valid, readable, right where they measure something, and drawn once."""

from __future__ import annotations

import functools
import itertools
import math
import struct
import sys
from types import SimpleNamespace

import pytest
import torch

from neusee.nodes import node
from neusee.nodes.values import Bands, Psf, Pupil
from neusee.workflows.engine.runner import run
from neusee.workflows.graph.errors import Location
from neusee.workflows.graph.recipe_graph import Recipe, Step
from neusee.workflows.report import contents, run_pictures
from neusee.workflows.report.figures import (
    camera_pictures,
    graph_and_timeline,
    optics,
    verification,
)
from neusee.workflows.store.derived_files import DerivedFiles
from neusee.workflows.store.result_store import Store

N, B = 48, 5
PITCH, FOCAL, PIXEL, DIAMETER = 8.078e-3 / 64, 0.11, 2.9e-6, 8.078e-3


def bands() -> Bands:
    centres = torch.linspace(400e-9, 700e-9, B, dtype=torch.float64)
    return Bands(
        centres, torch.full((B,), 75e-9, dtype=torch.float64), torch.ones(B, dtype=torch.float64)
    )


def pupil(waves: float) -> Pupil:
    v = (torch.arange(64, dtype=torch.float64) - 31.5) * PITCH
    radius = torch.hypot(v[:, None], v[None, :])
    clear = (radius <= DIAMETER / 2).double()
    height = waves * 550e-9 / 0.46 * radius / (DIAMETER / 2) * clear
    index = torch.full((B,), 0.46, dtype=torch.float64)
    nothing = torch.zeros_like(height)
    return Pupil(
        clear,
        clear,
        height,
        nothing,
        index,
        bands().centres,
        torch.tensor(PITCH, dtype=torch.float64),
    )


def psf_of(p: Pupil, *, shape: tuple[int, int] = (N, N), precision: str = "double") -> Psf:
    kind = {"single": torch.complex64, "double": torch.complex128}[precision]
    v = (torch.arange(64, dtype=torch.float64) - 31.5) * PITCH
    y = (torch.arange(shape[0], dtype=torch.float64) - shape[0] // 2) * PIXEL
    area = p.aperture.sum() * PITCH**2
    found, peaks = [], []
    for wavelength, index in zip(p.wavelengths.tolist(), p.index.tolist(), strict=True):
        kernel = torch.exp(-2j * math.pi * y[:, None] * v[None, :] / (wavelength * FOCAL)).to(kind)
        field = (p.amplitude * torch.exp(2j * math.pi * index * p.height / wavelength)).to(kind)
        u = kernel @ field @ kernel.T * PITCH**2 / (wavelength * FOCAL)
        found.append(u.abs() ** 2 * PIXEL**2 / area)
        peaks.append(area * PIXEL**2 / (wavelength * FOCAL) ** 2)
    return Psf(torch.stack(found).float(), torch.stack(peaks))


def scene() -> torch.Tensor:
    ramp = torch.linspace(0.05, 0.9, N)
    return torch.stack([ramp.expand(N, N), ramp[:, None].expand(N, N), 0.9 - ramp.expand(N, N)])


def spot() -> torch.Tensor:
    light = torch.zeros(3, N, N)
    light[:, 12, 30] = 1.0
    return light


def transfer_curve() -> torch.Tensor:
    signal = torch.cat([torch.zeros(1), torch.logspace(0, 4.8, 20)]).double()
    predicted = 800.0 + 2.7 * signal
    return torch.stack([signal, predicted * (signal < 60000), predicted], 1)


@pytest.fixture(scope="module")
def light() -> SimpleNamespace:
    plain, mask = psf_of(pupil(0.0)), psf_of(pupil(4.0))
    cube = scene().mean(0).expand(B, N, N) * torch.linspace(0.5, 1.0, B)[:, None, None]
    return SimpleNamespace(
        plain=plain,
        mask=mask,
        lsr=mask.intensity.amax((1, 2)) / mask.clear_peak,
        cube=cube,
        channels=torch.eye(3, B, dtype=torch.float64),
        lamp=torch.linspace(0.9, 1.1, B, dtype=torch.float64),
    )


def linear_image(radiance: torch.Tensor, psf: Psf) -> torch.Tensor:
    """Linear convolution, the axis at N // 2."""
    shape = [r + p for r, p in zip(radiance.shape[-2:], psf.intensity.shape[-2:], strict=True)]
    full = torch.fft.irfft2(
        torch.fft.rfft2(radiance, shape) * torch.fft.rfft2(psf.intensity, shape), shape
    )
    top, left = (n // 2 for n in psf.intensity.shape[-2:])
    return full[..., top : top + radiance.shape[-2], left : left + radiance.shape[-1]]


VARIANTS = [
    ("as used", "", 3e-7, 0.02),
    ("precision", "double", 2e-15, 0.05),
    ("allowed error", "1e-4", 4e-5, 0.01),
]


@pytest.fixture(scope="module")
def drawings(light: SimpleNamespace, table_arguments: dict) -> dict[str, tuple]:
    """Every drawing with arguments that fit it."""
    lines = {"green": Bands(*(x[1:3] for x in bands()))}
    return {
        "overview": (
            camera_pictures.overview,
            dict(
                truth=scene(),
                plain=scene() + 0.3,
                mask=scene(),
                restored=scene(),
                spots={"green": spot()},
            ),
        ),
        "frame": (
            camera_pictures.restored_frame,
            dict(
                frame=scene(),
                restored=scene() - 0.2 * (spot() > 0),
                spread=0.02 + 0.03 * scene(),
                clipped=spot() > 0,
                draws=8,
            ),
        ),
        "height": (optics.height, dict(pupil=pupil(4.0))),
        "psf": (
            optics.psf,
            dict(plain=light.plain, mask=light.mask, bands=bands(), pixel_pitch=PIXEL),
        ),
        "suppression": (
            optics.suppression,
            dict(lsr=light.lsr, bands=bands(), psf=light.mask, bsr=torch.full((B,), 0.9)),
        ),
        "spectra": (
            camera_pictures.spectra,
            dict(
                scene=scene(),
                radiance=light.cube,
                bands=bands(),
                illuminant=light.lamp,
                responses=light.channels,
                lines=lines,
            ),
        ),
        "tables": (optics.tables, table_arguments),
        "sensor": (verification.transfer, dict(measured=transfer_curve())),
        "stability": (verification.stability, dict(step=linear_image, psf=light.plain)),
        "error_time": (verification.error_time, dict(rows=VARIANTS)),
        "graph": (
            graph_and_timeline.graph,
            dict(
                sources={
                    "bands": [],
                    "psf[plain]": ["bands"],
                    "psf[mask]": ["bands"],
                    "image": ["psf[mask]"],
                },
                states={
                    "bands": "cached",
                    "psf[plain]": "cached",
                    "psf[mask]": "run",
                    "image": "left out",
                },
            ),
        ),
    }


def test_a_run_without_restoration_has_an_overview():
    figure = camera_pictures.overview.__wrapped__(truth=scene(), plain=scene() + 0.3, mask=scene())
    assert [ax.get_title() for ax in figure.axes] == ["truth", "plain lens", "with mask"]


NAMES = [f.name for f in contents.FIGURES] + ["graph"]


@pytest.fixture(scope="module")
def figure_of(drawings):
    """The figure of a drawing itself, laid out; several tests look at one."""
    from neusee.workflows.report.figures.style import styled

    @functools.cache
    def figure_of(name):
        draw, arguments = drawings[name]
        with styled():
            figure = draw.__wrapped__(**arguments)
            figure.canvas.draw()
        return figure

    return figure_of


@pytest.mark.slow
@pytest.mark.parametrize("name", NAMES)
def test_every_figure_is_a_picture_and_the_same_one_each_time(drawings, name):
    draw, arguments = drawings[name]
    first = draw(**arguments)
    assert first.startswith(b"\x89PNG")
    width, height = struct.unpack(">II", first[16:24])
    assert 500 < width < 2000
    assert 250 < height < 2000
    assert draw(**arguments) == first


@pytest.mark.slow
@pytest.mark.parametrize("name", NAMES)
def test_texts_are_large_enough_and_none_lies_on_another(figure_of, name):
    from matplotlib.text import Text

    figure = figure_of(name)
    inside = [t for ax in figure.axes for t in _ticks_shown(ax)]
    ticks = {
        id(t)
        for ax in figure.axes
        for axis in (ax.xaxis, ax.yaxis)
        for t in axis.get_ticklabels(which="both")
    }
    texts = [
        t
        for t in figure.findobj(Text)
        if t.get_text().strip() and t.get_visible() and id(t) not in ticks
    ]
    texts += inside
    assert texts
    assert min(t.get_fontsize() for t in texts if "mathdefault" not in t.get_text()) >= 9
    boxes = [(t.get_text(), t.get_window_extent()) for t in texts]
    if name in ("error_time",):
        return  # where its labels fall is up to the clock
    for (a, one), (b, other) in itertools.combinations(boxes, 2):
        apart = (
            one.x1 <= other.x0 + 1
            or other.x1 <= one.x0 + 1
            or one.y1 <= other.y0 + 1
            or other.y1 <= one.y0 + 1
        )
        assert apart, f"{a!r} lies on {b!r}"


def _ticks_shown(ax):
    """Tick labels within the axes' limits: matplotlib keeps others that it never draws."""
    if not ax.axison:
        return []
    shown = []
    for axis, (low, high) in ((ax.xaxis, sorted(ax.get_xlim())), (ax.yaxis, sorted(ax.get_ylim()))):
        ticks = [t for t in axis.get_major_ticks() if low <= t.get_loc() <= high]
        shown += [t.label1 for t in ticks if t.label1.get_visible() and t.label1.get_text().strip()]
        shown += [t.label2 for t in ticks if t.label2.get_visible() and t.label2.get_text().strip()]
    return shown


def test_axes_say_their_unit(figure_of):
    units = {
        "tables": "nm",
        "psf": "µm",
        "suppression": "nm",
        "spectra": "nm",
        "sensor": "DN",
        "error_time": "ms",
        "height": "mm",
    }
    for name, unit in units.items():
        labels = [ax.get_xlabel() for ax in figure_of(name).axes]
        assert any(unit in label for label in labels), f"{name}: {labels}"


@pytest.mark.parametrize("name", NAMES)
def test_no_axes_are_empty(figure_of, name):
    for ax in figure_of(name).axes:
        curves = [
            line for line in ax.lines if len(line.get_xdata()) > 2 or line.get_linestyle() == "None"
        ]
        assert curves or ax.images or ax.patches or ax.collections or ax.texts, ax.get_title()


def test_a_lamp_darkens_neither_the_scene_nor_the_points_of_the_spectra():
    lamp = scene()
    lamp[:, 3, 3] = 1e3
    ax = camera_pictures.canvas(4, 4)[1][0, 0]
    camera_pictures._scene(ax, lamp, points := camera_pictures._points(lamp))
    assert points == camera_pictures._points(scene())
    assert float(ax.images[0].get_array()[:, 20:].max()) > 0.9


@pytest.mark.parametrize(
    ("at", "rings"), [((12, 30), 2), ((0, 30), 0), ((12, N - 1), 0), ((N - 1, N - 1), 0)]
)
def test_a_ring_marks_a_laser_only_inside_the_picture(at, rings):
    light = torch.zeros(3, N, N)
    light[:, *at] = 1.0
    ax = camera_pictures.canvas(4, 4)[1][0, 0]
    camera_pictures._ring(ax, {"green": light}, scene())
    assert len(ax.patches) == rings


def test_without_bsr_there_is_one_panel(light):
    arguments = dict(lsr=light.lsr, bands=bands(), psf=light.mask)
    assert len(optics.suppression.__wrapped__(**arguments).axes) == 1
    assert len(optics.suppression.__wrapped__(**arguments, bsr=torch.full((B,), 0.9)).axes) == 2


@pytest.mark.parametrize("left", [1e-9, 1e-3, 0.2])
def test_one_clipped_level_does_not_squeeze_the_photon_transfer_curve(left):
    whole = transfer_curve()[:-1]
    top = torch.tensor([[7e4, left * (800 + 2.7 * 7e4), 800 + 2.7 * 7e4]], dtype=torch.float64)
    ax = verification.transfer.__wrapped__(measured=torch.cat([whole, top])).axes[0]
    alone = verification.transfer.__wrapped__(measured=whole).axes[0]
    assert ax.get_ylim()[0] == alone.get_ylim()[0]
    (clipped,) = (line for line in ax.lines if line.get_label().startswith("clipped"))
    assert clipped.get_xdata().tolist() == [7e4]
    assert ax.get_ylim()[0] < clipped.get_ydata()[0] < ax.get_ylim()[1]
    assert not any(line.get_label().startswith("clipped") for line in alone.lines)


def test_laser_added_as_shifted_psf_is_sound_where_a_joint_convolution_is_not(light):
    errors = verification.laser_trial(linear_image, light.plain)
    assert float(errors[0, -1]) < 1e-4
    assert float(errors[1, -1]) > 50 * float(errors[0, -1])


def test_graph_places_no_two_boxes_on_one_another_and_readers_below():
    sources = {
        f"s{i}": [f"s{j}" for j in range(max(0, i - 3), i)] + ["root"] for i in range(45)
    } | {"root": []}
    wires, _, _ = graph_and_timeline.grouped(sources, {})
    places = graph_and_timeline.layout(wires)
    by_row = sorted((y, x) for x, y in places.values())
    assert all(a[0] != b[0] or b[1] - a[1] >= 1 for a, b in itertools.pairwise(by_row))
    assert all(places[b][1] < places[name][1] for name, befores in wires.items() for b in befores)


def test_graph_groups_items_and_a_family_that_ran_at_all_ran():
    sources = {"a[x]": [], "a[y]": [], "b": ["a[x]", "a[y]"]}
    wires, looks, counts = graph_and_timeline.grouped(
        sources, {"a[x]": "cached", "a[y]": "run", "b": "not needed"}
    )
    assert wires == {"a": [], "b": ["a"]}
    assert looks == {"a": "run", "b": "cached"}
    assert counts == {"a": 2, "b": 1}


@node()
def truth_node(*, level: float) -> torch.Tensor:
    return scene() * level


@node()
def copy_node(x: torch.Tensor) -> torch.Tensor:
    return x * 1.0


def small_recipe(level: float = 1.0) -> Recipe:
    def step(name, what, wires, **params):
        return Step(name, what, params, wires, Location("test.yaml", 1, 1), {})

    copies = ("developed[plain]", "developed[mask]", "restored")
    steps = {"truth": step("truth", truth_node, {}, level=level)}
    steps |= {name: step(name, copy_node, {"x": "truth"}) for name in copies}
    return Recipe("small", "A test.", 1, 0.0, copies, steps)


def test_a_second_run_draws_nothing_and_a_changed_value_draws_again(tmp_path, monkeypatch):
    store = Store(tmp_path)
    first, missing = run_pictures.pictures(run(small_recipe(), store), DerivedFiles(store))
    assert set(first) == {"overview", "graph"}
    assert "psf" in missing["psf"]
    with monkeypatch.context() as m:
        m.setitem(sys.modules, "matplotlib", None)
        m.setitem(sys.modules, "matplotlib.figure", None)
        store = Store(tmp_path)
        second, _ = run_pictures.pictures(run(small_recipe(), store), DerivedFiles(store))
        assert second["overview"] == first["overview"]
        assert set(second) == set(first)
        with pytest.raises(ImportError):
            run_pictures.pictures(run(small_recipe(0.5), Store(tmp_path)), DerivedFiles(store))
    third, _ = run_pictures.pictures(run(small_recipe(0.5), Store(tmp_path)), DerivedFiles(store))
    assert third["overview"] != first["overview"]


def test_a_damaged_picture_is_drawn_again(tmp_path):
    store = Store(tmp_path)
    shelf = DerivedFiles(store)
    path = shelf.keep("ab" * 16, ".png", "test", lambda path: path.write_bytes(b"as it was"))
    assert shelf.find("ab" * 16, ".png") == path
    path.chmod(0o644)
    path.write_bytes(b"as it is.")
    assert DerivedFiles(store).find("ab" * 16, ".png") is None
    path.unlink()
    assert DerivedFiles(Store(tmp_path)).find("ab" * 16, ".png") is None


def test_every_figure_names_a_function_and_its_arguments():
    import importlib
    import inspect

    for figure in contents.FIGURES:
        module, _, name = figure.draw.partition(":")
        draw = getattr(importlib.import_module(f"neusee.workflows.{module}"), name)
        arguments = inspect.signature(draw).parameters
        assert set(arguments) == set(figure.needs), figure.name
        optional = {n for n, need in figure.needs.items() if need.startswith("?")}
        assert optional == {n for n, p in arguments.items() if p.default is not p.empty}, (
            figure.name
        )
