"""The stability study: what counts as a failure, that it is found, kept, drawn and counted."""

import csv
import json
import math
from dataclasses import replace

import pytest
import torch

from neusee.nodes import node
from neusee.nodes.optics import _psf, psf
from neusee.nodes.optics.transform import PupilIntensity, _intensity, _pupil_field
from neusee.nodes.values import Pupil
from neusee.workflows.graph.errors import Location
from neusee.workflows.graph.recipe_graph import Step
from neusee.workflows.keys.code_digest import Code
from neusee.workflows.recipe.loading import load
from neusee.workflows.recipe.node_families import find_node
from neusee.workflows.store.result_store import Store
from neusee.workflows.studies import case_result, extreme_cases, stability_study
from neusee.workflows.studies.case_result import judge_step
from neusee.workflows.studies.extreme_cases import (
    CASES,
    USUAL,
    Case,
    CaseRecipe,
    Size,
    unchanged_steps,
)
from neusee.workflows.studies.run_study import study_recipe
from neusee.workflows.studies.stability_study import cell_text, short_number

BY_NAME = {case.name: case for case in CASES}


def step_of(fn, **params):
    return Step("it", fn, params, {}, Location("test"), {})


@node(rtol=1e-5)
def doubled(x: torch.Tensor) -> torch.Tensor:
    return x * 2


@node(rtol=1e-5)
def cancelling(x: torch.Tensor) -> torch.Tensor:
    return (x + 1e6) - 1e6


@node()
def hiding(x: torch.Tensor) -> torch.Tensor:
    return torch.where(x > 0, x, 0.0)


@node()
def rooted(x: torch.Tensor) -> torch.Tensor:
    return (x - x.amin()).sqrt()


@node()
def refusing(x: torch.Tensor) -> torch.Tensor:
    if not bool(x.isfinite().all()):
        raise ValueError("x holds values that are not finite: replace them")
    return x


@node()
def breaking(x: torch.Tensor) -> torch.Tensor:
    raise RuntimeError("index out of range in self")


@pytest.fixture
def picture():
    return torch.rand(8, 8, generator=torch.Generator().manual_seed(1))


def test_a_step_within_its_bound_passes_with_both_numbers(picture):
    cell = judge_step(step_of(doubled), [picture], USUAL, 0)
    assert cell.mark == "pass"
    assert 0 <= cell.error <= cell.bound == 1e-5
    assert 0 <= cell.slope <= cell.slope_bound


@pytest.mark.parametrize(
    ("fn", "case"),
    [
        (cancelling, "usual"),
        (rooted, "usual"),
        (hiding, "NaN"),
        (breaking, "usual"),
        (breaking, "NaN"),
    ],
)
def test_what_is_wrong_fails(fn, case, picture):
    assert judge_step(step_of(fn), [picture], BY_NAME[case], 0).mark == "fail"


@pytest.mark.parametrize(
    ("fn", "case"), [(refusing, "NaN"), (doubled, "NaN"), (doubled, "Inf"), (doubled, "float16")]
)
def test_what_is_refused_seen_or_of_its_precision_passes(fn, case, picture):
    assert judge_step(step_of(fn), [picture], BY_NAME[case], 0).mark == "pass"


def test_a_number_that_is_none_is_tried_in_each_picture_alone(picture):
    @node()
    def blind(x: torch.Tensor, y: torch.Tensor) -> torch.Tensor:
        return x + torch.where(y > 2, y, 0.0)

    assert judge_step(step_of(blind), [picture, picture + 0], BY_NAME["NaN"], 0).mark == "fail"


def test_a_case_that_changes_nothing_of_a_step_has_no_cell(picture):
    assert judge_step(step_of(doubled), [], BY_NAME["NaN"], 0) is None
    assert judge_step(step_of(doubled), [picture], BY_NAME["alike"], 0) is None


def test_names_and_groups_of_the_catalogue_are_in_order():
    assert len(BY_NAME) == len(CASES)
    groups = [case.group for case in CASES]
    assert len(dict.fromkeys(groups)) == sum(
        a != b for a, b in zip(groups, ["", *groups], strict=False)
    )


def test_small_chains_keep_the_pupil_and_know_what_a_case_touches(tmp_path):
    recipe, code = load("first_light", []), Code(tmp_path / "code.json")
    usual = CaseRecipe.of(recipe, USUAL, code)
    pupil = usual.steps["stop"].params
    whole = recipe.steps["stop"].params
    assert pupil["pitch"] * USUAL.size.samples == pytest.approx(whole["pitch"] * whole["samples"])
    dim = CaseRecipe.of(recipe, BY_NAME["exposure 1 us"], code)
    same = set(unchanged_steps(dim, usual))
    assert {"psf[mask]", "image[mask]"} <= same
    assert not {"scene_photons[mask]", "spot[mask,green]", "charge[mask]"} & same


def test_a_mask_from_a_file_has_a_stand_in_of_its_depth_so_that_what_follows_is_tested(tmp_path):
    recipe = load("demonstration", [])
    chain = CaseRecipe.of(recipe, USUAL, Code(tmp_path / "code.json"))
    (pupil,) = (
        step
        for step in chain.steps.values()
        if step.node.path == "optics.pupil" and "[mask]" in step.name
    )
    mask = chain.inputs(pupil.name)[0]
    assert mask.shape == (64, 64)
    (depth,) = (
        step.params["depth"] for step in recipe.steps.values() if step.node.path == "doe.pixelwise"
    )
    assert 0.5 * depth < float(mask.max()) <= depth
    assert judge_step(pupil, chain.inputs(pupil.name), USUAL, recipe.seed).mark == "pass"
    assert "takes the place of a mask from a file" in " ".join(stability_study._GUIDE.split())


def _without_restoration(recipe):
    """It is half of the time, and what is tested is the study."""
    steps = {
        n: s
        for n, s in recipe.steps.items()
        if n not in ("deconvolved", "restored", "restored_quality")
    }
    return replace(recipe, steps=steps)


@pytest.mark.slow
def test_the_study_writes_its_folder_and_counts_what_fails(tmp_path, monkeypatch):
    recipe, store, told = (
        _without_restoration(load("laser_free", [])),
        Store(tmp_path / "store"),
        [],
    )
    cases = [Case("usual", "as it is", "usual", size=Size(16, 16, 3)), BY_NAME["NaN"]]
    runs = tmp_path / "runs"
    folder = study_recipe("stability", recipe, store, runs, ["neusee"], told.append, cases=cases)
    assert {p.name for p in folder.iterdir()} >= {
        "report.html",
        "table.csv",
        "provenance.json",
        "figures",
    }
    assert (folder / "figures/stability.png").read_bytes().startswith(b"\x89PNG")
    with (folder / "table.csv").open() as file:
        rows = list(csv.DictReader(file))
    doc = json.loads((folder / "provenance.json").read_text())
    assert [row for row in rows if row["mark"] == "fail"] == []
    assert doc["failed"] == 0
    assert doc["cells"] == len(rows) > 30
    assert len(told) == 2
    before = {row["step"]: row["error"] for row in rows}
    monkeypatch.setattr(stability_study, "judge_step", None)  # what is stored is not judged again
    store = Store(tmp_path / "store")
    again = study_recipe("stability", recipe, store, runs, ["neusee"], told.append, cases=cases)
    with (again / "table.csv").open() as file:
        assert {row["step"]: row["error"] for row in csv.DictReader(file)} == before


def test_words_of_a_cell_say_what_does_not_pass(picture):
    cell = judge_step(step_of(cancelling), [picture], USUAL, 0)
    assert cell_text(cell).startswith("×")
    assert short_number(2.34e-7) == "2e-7"
    assert short_number(0.0) == "0"
    assert short_number(float("inf")) == "inf"


def test_what_is_stated_counts_only_as_long_as_the_docstring_states_it(monkeypatch):
    (path, case), words = next(iter(extreme_cases._STATED.items()))
    assert extreme_cases.stated_words(find_node(path), case) == words
    assert extreme_cases.stated_words(find_node(path), "usual") is None
    monkeypatch.setattr(extreme_cases, "_STATED", {(path, case): "whatever it is"})
    assert extreme_cases.stated_words(find_node(path), case) is None


@pytest.mark.parametrize(
    ("error", "slope", "mark"),
    [
        (0.4, None, "pass"),
        (0.6, None, "warn"),
        (1.0, 1.0, "warn"),
        (0.1, 3.9, "warn"),
        (1.1, None, "fail"),
        (0.1, 4.1, "fail"),
        (float("nan"), None, "fail"),
        (0.1, float("nan"), "fail"),
    ],
)
def test_what_holds_by_less_than_twice_warns(error, slope, mark):
    cell = case_result._marked(error, 1.0, slope, 4.0)
    assert cell.mark == mark, cell
    assert (cell.bound, cell.slope_bound) == (1.0, None if slope is None else 4.0)
    assert [cell.error, cell.slope] == pytest.approx([error, slope], nan_ok=True)


def test_what_every_node_states_it_still_states():
    for path, case in extreme_cases._STATED:
        assert extreme_cases.stated_words(find_node(path), case) is not None


def test_poisson_numbers_are_the_same_in_both_precisions(picture):
    @node()
    def counted(x: torch.Tensor, *, rng: torch.Generator) -> torch.Tensor:
        return torch.poisson(100.1 * x, generator=rng)

    assert judge_step(step_of(counted), [picture], USUAL, 0).mark == "pass"


def test_an_error_of_the_study_itself_is_no_refusal(monkeypatch, picture):
    def wrong(value, truth):
        raise ValueError("zip() argument 2 is shorter than argument 1")

    monkeypatch.setattr("neusee.workflows.studies.case_result._error", wrong)
    assert judge_step(step_of(doubled), [picture], USUAL, 0).mark == "fail"


def test_a_picture_that_two_inputs_share_counts_once(picture):
    @node()
    def added(x: torch.Tensor, y: torch.Tensor) -> torch.Tensor:
        return x * 2 + y

    for case in ("usual", "alike", "negative"):
        cell = judge_step(step_of(added), [picture, picture], BY_NAME[case], 0)
        assert cell.mark == "pass"
        assert cell.slope is not None


def test_a_slope_beyond_the_type_of_its_picture_is_no_fault_of_the_step(picture):
    @node()
    def steep(x: torch.Tensor) -> torch.Tensor:
        return (
            1 + 1e7 * (x.float() - x.float().detach())
            if x.dtype != torch.float64
            else 1 + 1e7 * (x - x.detach())
        )

    assert judge_step(step_of(steep), [picture], BY_NAME["float16"], 0).mark == "pass"


@pytest.mark.parametrize("left", [1e-6, 0.0])
def test_cancellation_counts_in_each_scalar_of_a_result(left, picture):
    signed = torch.cat([picture, -picture.flip(-1) * (1 + left)])

    @node()
    def exact(x: torch.Tensor) -> tuple[torch.Tensor, torch.Tensor]:
        return x.abs().mean(), x.sum()  # the second is a sum of terms that cancel

    @node()
    def wrong(x: torch.Tensor) -> tuple[torch.Tensor, torch.Tensor]:
        return x.abs().mean(), x.sum() + (
            1e-3 * x.abs().sum().detach() if x.dtype == torch.float32 else 0.0
        )

    assert judge_step(step_of(exact), [signed], BY_NAME["usual"], 0).mark != "fail"
    assert judge_step(step_of(wrong), [signed], BY_NAME["usual"], 0).mark == "fail"


@pytest.mark.parametrize(("white", "off", "mark"), [
    (1.0, 0.0, "pass"), (1.0, 1e-2, "fail"), (1e8, 0.0, "pass"), (1e8, 3e-7, "fail"),
])  # fmt: skip
def test_a_picture_that_is_white_in_place_of_black_has_a_psnr_of_zero_decibels(
    white, off, mark, monkeypatch
):
    """The rounding of a pixel counts in the PSNR; a pixel that is cut off at white has none."""
    quality = find_node("metrics.quality")
    fn, params = quality.fn, quality.params().model_dump()

    def changed(estimate, truth, **params):
        found = fn(estimate, truth, **params)
        return found._replace(psnr=found.psnr + off * (estimate.dtype == torch.float32))

    monkeypatch.setattr(quality, "fn", changed)
    step = Step("quality", quality, params, {}, Location("test"), {})
    cell = judge_step(
        step, [torch.full((3, 12, 12), white), torch.zeros(3, 12, 12)], extreme_cases.USUAL, 0
    )
    assert cell.mark == mark, cell


def test_no_result_is_excused_by_the_rounding_of_its_inputs(picture):
    @node(rtol=1e-6)
    def steep(x: torch.Tensor) -> torch.Tensor:
        return torch.sin(100 * x)  # exact but for the product, which rounds once more

    cell = judge_step(step_of(steep), [picture], USUAL, 0)
    assert cell.mark == "fail"
    assert 1e-6 < cell.error < 24e-6  # four roundings of 100 x, at x up to 1
    assert cell.bound == 1e-6


@pytest.mark.parametrize(
    ("turns", "off", "mark"), [(1e17, 2.0**-48, "warn"), (1e4, 2.0**-24, "fail")]
)
def test_a_gradient_that_nobody_knows_in_double_precision_is_a_warning(turns, off, mark, picture):
    @node()
    def wavy(x: torch.Tensor) -> torch.Tensor:
        phase = turns * x.double() * (1 + off * (x.dtype == torch.float32))
        return (x.double() + torch.sin(phase) / turns).to(x.dtype)  # the gradient is 1 + cos(phase)

    cell = judge_step(step_of(wavy), [picture], USUAL, 0)
    assert cell.mark == mark, cell
    assert ("in double precision" in cell.note) == (mark == "warn")


def _plate(side=24):
    """The pupil of a mask of 10 mm, whose phase turns some 8600 times."""
    steps = torch.arange(side) - (side - 1) / 2
    disc = (steps[:, None] ** 2 + steps**2 <= (side / 2) ** 2).float()
    height = (
        10e-3 + 1e-4 * torch.rand(side, side, generator=torch.Generator().manual_seed(3))
    ).float()
    one = torch.tensor([0.46], dtype=torch.float64), torch.tensor([532e-9], dtype=torch.float64)
    return Pupil(disc, disc, height, 0 * height, *one, torch.tensor(1e-4, dtype=torch.float64))


@pytest.mark.parametrize("fault", ["phase", "backward", "constant"])
def test_a_fault_planted_in_the_light_fails_on_a_plate(fault, monkeypatch):
    """A phase in single precision, in the result or in the gradient alone, and a constant that
    is wrong by 1e-5.
    """
    step = Step(
        "psf",
        psf,
        {"focal_length": 0.1, "pixel_pitch": 4e-6, "shape": (12, 12)},
        {},
        Location("test"),
        {},
    )
    # the faults are planted in the torch path
    monkeypatch.setattr(_intensity, "available", lambda device: False)
    assert judge_step(step, [_plate(), None], USUAL, 0).mark == "pass"
    usual = _pupil_field.Field.__init__

    def single(self, screens, view, dtype):
        with monkeypatch.context() as patch:
            patch.setattr(_pupil_field, "_FLOAT32_TURNS", math.inf)
            usual(self, screens, view, dtype)

    if fault == "phase":
        monkeypatch.setattr(_pupil_field.Field, "__init__", single)
    elif fault == "backward":
        backward = PupilIntensity.backward

        def wrong(ctx, *slopes):
            with monkeypatch.context() as patch:
                patch.setattr(_pupil_field.Field, "__init__", single)
                return backward(ctx, *slopes)

        monkeypatch.setattr(_intensity, "KEPT_FIELD_BYTES", 0)
        monkeypatch.setattr(PupilIntensity, "backward", staticmethod(wrong))
    else:
        points = _psf._intensity_at_points

        def off(pupil, camera, lights, dtype, method):
            wrong = 1 + 1e-5 * (dtype == torch.float32)
            return points(pupil, camera, [wrong * light for light in lights], dtype, method)

        monkeypatch.setattr(_psf, "_intensity_at_points", off)
    cell = judge_step(step, [_plate(), None], USUAL, 0)
    assert cell.mark == "fail", cell
    assert (cell.error > cell.bound) == (fault != "backward")


def test_a_gradient_that_cancels_in_a_large_loss_is_no_failure(picture):
    @node()
    def kept(x: torch.Tensor) -> torch.Tensor:
        return 1e5 * (x / x.norm()).square().sum()  # the gradient is 0

    @node()
    def wrong(x: torch.Tensor) -> torch.Tensor:
        return 1e5 * (x / x.norm() ** (1.001 if x.dtype == torch.float32 else 1.0)).square().sum()

    assert judge_step(step_of(kept), [picture], USUAL, 0).mark == "pass"
    assert judge_step(step_of(wrong), [picture], USUAL, 0).slope > 1e-3


def test_the_gradient_of_a_maximum_that_rounding_decides_is_a_warning(picture, monkeypatch):
    @node()
    def brightest(x: torch.Tensor) -> torch.Tensor:
        return (x + 8.0).amax()  # 1 and its neighbour give the same sum in float32

    near = picture / 2
    near[0, 0], near[3, 3] = 1.0, 1.0 - 2.0**-24
    assert judge_step(step_of(brightest), [near], USUAL, 0).mark == "fail", "for any other node"
    assert all(find_node(path) for path in case_result._LARGEST)
    monkeypatch.setattr(case_result, "_LARGEST", (brightest.path,))
    cell = judge_step(step_of(brightest), [near], USUAL, 0)
    assert cell.slope > 0.4
    assert cell.mark == "warn"
    assert "the gradient by" in cell.note

    @node()
    def wrong(x: torch.Tensor) -> torch.Tensor:
        return (x * (0.7 if x.dtype == torch.float32 else 0.2)).exp().amax() / 2

    assert judge_step(step_of(wrong), [picture], USUAL, 0).mark == "fail"
