"""The command `neusee sheet`: from a descriptor or a recipe to page, PDF, JSON and CSV, and what
it refuses.
"""

from __future__ import annotations

import csv
import json
import re

import numpy as np
import pytest
import torch

from neusee.nodes.calibrate import Nonuniformity, emva_sheet, levels, reduce, spatial_series
from neusee.workflows.calibration import emva_figures
from neusee.workflows.calibration import emva_figures as emva_pdf
from neusee.workflows.calibration.emva_sheet import (
    EmvaFrames,
    descriptor_recipe,
    frames_of_recipe,
    operating_point,
    requirements,
    sections,
)
from neusee.workflows.cli import app
from neusee.workflows.frames.folder_recipe import descriptor_of
from neusee.workflows.store.result_store import Store
from tests.nodes.calibrate.numpy_emva import quantities

GAIN, SHAPE, SERIES = 0.4, (40, 48), 16
GRID = [0, *np.linspace(500, 20000, 14).tolist()]


def exposed(rng, photons, frames, noise=12.0, exposure=0.01):
    """Frames of a camera in NumPy alone."""
    electrons = rng.poisson(
        0.5 * photons + 900 * exposure, (frames, *SHAPE)
    ) + noise * rng.standard_normal((frames, *SHAPE))
    return np.clip(np.round(60 + GAIN * electrons), 0, 4095).astype(np.uint16)


@pytest.fixture(scope="module")
def archive(tmp_path_factory):
    """A folder with a descriptor of pairs, of darks at three exposures, and of two series."""
    folder, rng = tmp_path_factory.mktemp("camera"), np.random.default_rng(4)
    text = ["v 4.0", f"n 12 {SHAPE[1]} {SHAPE[0]}"]
    series = [(p, 10, SERIES) for p in (0, GRID[7])]
    for photons, exposure, count in [
        *((p, 10, 2) for p in GRID),
        *((0, t, 2) for t in (200, 400)),
        *series,
    ]:
        text.append(f"b {exposure}000000 {photons}" if photons else f"d {exposure}000000")
        for i, frame in enumerate(exposed(rng, photons, count, exposure=1e-3 * exposure)):
            name = f"{photons:.0f}_{exposure}_{count}_{i}.npy"
            np.save(folder / name, frame)
            text.append(f"i {name}")
    (folder / "EMVA1288_Data.txt").write_text("\n".join(text))
    return folder


def sheet_of(noise=12.0, spatial=True):
    rng = np.random.default_rng(8)
    parts = [
        reduce(
            torch.from_numpy(exposed(rng, p, 2, noise).astype(np.int32)),
            photons=p,
            exposure=0.01,
            scatter="steady",
        )
        for p in GRID
    ]
    stacks = [
        torch.from_numpy(exposed(rng, p, SERIES, noise).astype(np.int32)) for p in (0.0, GRID[7])
    ]
    series = [
        spatial_series(p, 0.01, stack) for p, stack in zip((0.0, GRID[7]), stacks, strict=True)
    ]
    return emva_sheet(levels(parts), Nonuniformity(*series) if spatial else None)


@pytest.fixture(scope="module")
def sheet():
    return sheet_of()


@pytest.fixture
def neusee(tmp_path, monkeypatch, capfd):
    """Call the command line in an empty folder, with one picture alone; give the exit code,
    stdout and stderr.
    """
    monkeypatch.chdir(tmp_path)
    monkeypatch.setenv("NEUSEE_CACHE", str(tmp_path / "cache"))
    monkeypatch.setattr(emva_figures, "PICTURES", {"photon_transfer": emva_figures.photon_transfer})

    def call(*words):
        with pytest.raises(SystemExit) as end:
            app.main(["sheet", *words])
        return (end.value.code or 0, *capfd.readouterr())

    return call


def results(out, tmp_path):
    return tmp_path / out.splitlines()[-1].removesuffix("/report.html")


def curves(folder, name):
    """The number of rows of a table of curves, all of them finite."""
    with (folder / f"{name}.csv").open(newline="") as file:
        _, *rows = csv.reader(file)
    assert all(np.isfinite(float(row[-1])) for row in rows)
    return len(rows)


@pytest.mark.slow
def test_a_descriptor_gives_page_tables_and_document(neusee, archive, tmp_path):
    light = "traceability.photons={relative_uncertainty: 0.03, instrument: photodiode}"
    code, out, _ = neusee(str(archive), light, "--state", "temperature=25 °C")
    assert code == 0
    folder = results(out, tmp_path)
    document = json.loads((folder / "emva1288.json").read_text())
    found = document["quantities"]
    assert found["K"]["value"] == pytest.approx(GAIN, rel=0.05)  # 1920 pixels
    assert found["eta"]["value"] == pytest.approx(50, rel=0.05)
    assert (found["mu_I_mean"]["value"], found["mu_I_mean"]["unit"]) == (
        pytest.approx(900, rel=0.05),
        "e-/s",
    )
    assert document["operating point"]["temperature"] == "25 °C"
    assert document["operating point"]["wavelength"] is None
    with (folder / "emva1288.csv").open(newline="") as file:
        rows = {row["key"]: row for row in csv.DictReader(file)}
    assert {key: float(row["value"]) if row["value"] else None for key, row in rows.items()} == {
        key: each["value"] for key, each in found.items()
    }
    assert len((folder / "transfer.csv").read_text().splitlines()) == len(GRID)
    assert curves(folder, "spectrograms") == 2 * (SHAPE[1] // 2 + 1 + SHAPE[0] // 2 + 1)
    assert curves(folder, "profiles") == 2 * sum(SHAPE)
    assert curves(folder, "defects") > 100
    page = (folder / "report.html").read_text().replace("<wbr>", "")
    assert "stated: temperature" in page
    assert all(each["symbol"] in page for each in found.values())
    assert (folder / "emva1288.pdf").read_bytes()[:5] == b"%PDF-"
    demands = {each["demand"]: (each["found"], each["mark"]) for each in document["demands"]}
    assert demands["50 or more lit levels"] == ("14", "warn")
    assert demands["two frames or more at each level"] == ("2", "pass")
    assert demands["series of 16 or more lit frames for spatial quantities"] == (
        "16 frames",
        "pass",
    )
    assert demands["both series at one exposure"][1] == "pass"
    assert demands["stated: calibration of the light: instrument and certificate"] == (
        "photodiode",
        "pass",
    )
    budgets = json.loads((folder / "budget.json").read_text())["quantities"]
    assert {
        key for key, each in found.items() if each["value"] is not None and not each["bound"]
    } == set(budgets)
    parts = {each["source"]: each for each in budgets["eta"]["sources"]}
    light = parts["photometric calibration of the light"]
    assert light["contribution"] == pytest.approx(0.03 * found["eta"]["value"])
    assert parts["temperature"]["reason"] == "not stated", (
        "a temperature is stated, but no uncertainty of it"
    )
    assert "contribution" not in parts["temperature"]
    whole = sum(each.get("contribution", 0) ** 2 for each in parts.values()) ** 0.5
    assert budgets["eta"]["combined standard uncertainty"] == pytest.approx(whole)
    assert re.search(r"^σ_d +1[0-4]\.\d+ e- ", out, re.MULTILINE)


def test_every_quantity_is_that_of_numpy_alone(archive, tmp_path):
    def frames(photons, exposure, count):
        return np.stack(
            [np.load(archive / f"{photons:.0f}_{exposure}_{count}_{i}.npy") for i in range(count)]
        )

    light = [*((p, 10) for p in GRID), (0, 200), (0, 400)]
    pairs = [(p, 1e-3 * t, frames(p, t, 2)) for p, t in light]
    found = frames_of_recipe(descriptor_recipe(archive / "EMVA1288_Data.txt"), Store(tmp_path))
    sheet = emva_sheet(found.levels, found.spatial)
    truth = quantities(pairs, [frames(p, 10, SERIES) for p in (0, GRID[7])])
    assert set(truth) == {q.key for q in sheet.quantities if not q.key.endswith("_general")}
    stated = {key: sheet[key].value for key in truth if not sheet[key].reason}
    assert len(stated) > 20
    assert stated == pytest.approx({key: truth[key] for key in stated}, rel=1e-3, abs=0)


def test_release_3_keeps_the_drift_of_a_pair(archive, tmp_path):
    recipe = descriptor_recipe(archive / "EMVA1288_Data.txt")
    of = {
        release: frames_of_recipe(recipe, Store(tmp_path), release).levels for release in ("3", "4")
    }
    for i, photons in enumerate(GRID):
        one, two = (np.load(archive / f"{photons:.0f}_10_2_{k}.npy").astype(float) for k in (0, 1))
        apart, count = one - two, one.size
        assert float(of["3"].variance[i]) == pytest.approx((apart**2).mean() / 2, rel=1e-12)
        steady = ((apart**2).mean() - apart.mean() ** 2) / 2 * count / (count - 1)
        assert float(of["4"].variance[i]) == pytest.approx(steady, rel=1e-12)


DRIFT = 30  # DN, between the frames of a pair


@pytest.fixture(scope="module")
def drifting(tmp_path_factory):
    """The lines of a descriptor after its line v; the second frame of each pair is brighter."""
    folder, rng = tmp_path_factory.mktemp("drifting"), np.random.default_rng(5)
    text = [f"n 12 {SHAPE[1]} {SHAPE[0]}"]
    for photons in (0, 4000, 8000):
        text.append(f"b 10000000 {photons}" if photons else "d 10000000")
        for i, frame in enumerate(exposed(rng, photons, 2)):
            np.save(folder / f"{photons}_{i}.npy", frame + np.uint16(DRIFT * i))
            text.append(f"i {folder / f'{photons}_{i}.npy'}")
    return text


@pytest.mark.slow
@pytest.mark.parametrize(
    ("stated", "option", "kept", "said"),
    [
        ("v 3.0", None, True, "includes the difference of the means of its frames, as in release 3.0, because the "
         "descriptor states release 3.0; `--release 4` excludes it."),
        ("v 3,0", None, True, "the descriptor states release 3.0; `--release 4`"),
        ("v 3.1", None, False, "because the descriptor states release 3.1; `--release 3` includes it."),
        ("v 4.0", None, False, "because the descriptor states release 4.0"),
        ("v 3.0", "4", False, ": `--release 4`. The descriptor states release 3.0."),
        ("v 4.0", "3", True, ": `--release 3`. The descriptor states release 4.0."),
        ("# release 3.0, but only as a comment", None, False, "as since release 3.1."),
    ],
)  # fmt: skip
def test_the_release_is_that_of_the_descriptor_unless_the_user_says_another(
    stated, option, kept, said, neusee, drifting, tmp_path
):
    file = tmp_path / "set.txt"
    file.write_text("\n".join([stated, *drifting]))
    _, out, err = neusee(str(file), *(("--release", option) if option else ()))
    folder = results(out, tmp_path)
    with (folder / "transfer.csv").open(newline="") as opened:
        lit = [row for row in csv.DictReader(opened) if float(row["photons"])]
    for row in lit:
        one, two = (
            np.load(drifting[-1][2:].replace("8000_1", f"{float(row['photons']):.0f}_{i}"))
            for i in (0, 1)
        )
        apart = one.astype(float) - two
        bare = (apart.var() + kept * apart.mean() ** 2) / 2
        assert float(row["variance"]) == pytest.approx(bare, rel=1e-3)
        assert apart.mean() ** 2 / 2 > 0.3 * apart.var() / 2, (
            "the drift is large enough to tell both"
        )
    sentence = out.splitlines()[-2]
    assert said in sentence, (out, err)
    assert json.loads((folder / "emva1288.json").read_text())["temporal variance"] == sentence
    assert sentence.replace("`", "") in re.sub(
        r"<[^>]*>|`", "", (folder / "report.html").read_text()
    )
    command = json.loads((folder / "provenance.json").read_text())["command"]
    assert command.endswith(f" --release {option}" if option else "set.txt")


@pytest.mark.slow
def test_relative_light_and_tables_without_frames(neusee, tmp_path):
    code, out, _ = neusee("calibrate_camera", "--relative")
    found = json.loads((results(out, tmp_path) / "emva1288.json").read_text())["quantities"]
    assert code == 0
    assert found["K"]["value"] == pytest.approx(0.25, rel=0.03)  # what the table was simulated with
    assert {
        found[key]["value"] for key in ("eta", "R", "mu_p_min", "mu_p_sat", "DSNU1288", "PRNU1288")
    } == {None}


@pytest.mark.slow
def test_frames_of_a_recipe_give_the_variance_in_time(neusee, tmp_path):
    code, out, _ = neusee("calibrate", "flats.shape=[32,32]")
    assert code == 0
    found = json.loads((results(out, tmp_path) / "emva1288.json").read_text())["quantities"]
    assert found["K"]["value"] == pytest.approx(2.7027, rel=0.06)
    assert found["DSNU1288_DN"]["bound"] == "<"  # of two frames, of a sensor without DSNU


def test_a_folder_has_one_descriptor(archive, tmp_path):
    assert descriptor_of(archive) == archive / "EMVA1288_Data.txt"
    (tmp_path / "readme.txt").write_text("d, as in dark, and b 12 as in bright")
    with pytest.raises(ValueError, match="has no descriptor"):
        descriptor_of(tmp_path)
    for name in ("one.txt", "two.txt"):
        (tmp_path / name).write_text("v 3.0\nd 000.00\ni x.png\n")
    with pytest.raises(ValueError, match="has 2 descriptors: name one descriptor file"):
        descriptor_of(tmp_path)


@pytest.mark.parametrize(
    ("words", "message"),
    [
        (("nothing.txt",), "nothing was computed: no such file: nothing.txt"),
        (
            ("calibrate_camera", "--state", "colour=red"),
            "--state 'colour=red': write one of camera, sensor",
        ),
        (("calibrate_camera", "--state", "camera"), "then = and a text"),
        (("first_light",), "first_light has no step of the nodes calibrate.descriptor"),
    ],
)
def test_mistakes_are_refused(neusee, words, message):
    code, out, err = neusee(*words)
    assert (code, out) == (2, "")
    assert message in err


def planted(archive, folder, change):
    """Write the archive again with changed frames, and return the name of its descriptor."""
    text = (archive / "EMVA1288_Data.txt").read_text()
    photons = 0.0
    for line in text.splitlines():
        kind, _, rest = line.partition(" ")
        if kind in "bd":
            photons = float(rest.split()[1]) if kind == "b" else 0.0
        if kind == "i":
            np.save(folder / rest, change(photons, np.load(archive / rest)))
    (folder / "planted.txt").write_text(text)
    return "planted.txt"


def test_dark_noise_below_rounding_ends_with_exit_code_3(neusee, archive, tmp_path):
    rng = np.random.default_rng(1)
    quiet = planted(
        archive, tmp_path, lambda photons, _: exposed(rng, photons, 1, noise=0.3, exposure=0.0)[0]
    )
    code, out, err = neusee(quiet)
    assert code == 3
    assert err.count("0.49 DN") == 1
    assert "< 0.4899 DN" in out
    assert "Not fit for use" in (results(out, tmp_path) / "report.html").read_text()


def test_mixed_pixels_end_with_exit_code_3(neusee, archive, tmp_path):
    def mixed(_, frame):
        sides = sum(
            np.roll(frame, shift, axis).astype(float)
            for shift, axis in ((1, 0), (-1, 0), (1, 1), (-1, 1))
        )
        return np.round(0.7 * frame + 0.3 * sides / 4).astype(np.uint16)

    code, out, err = neusee(planted(archive, tmp_path, mixed))
    assert (code, "Not fit for use: white noise: " in err) == (3, True)
    document = json.loads((results(out, tmp_path) / "emva1288.json").read_text())
    assert document["quantities"]["K"]["value"] < 0.8 * GAIN  # which nobody could see in the number
    assert {t["name"]: t["verdict"] for t in document["frames"]}["white noise"] == "refused"


def test_every_demand_is_met_or_says_what_is_missing(sheet):
    found = EmvaFrames(None, sheet.spatial, 2)
    rows = requirements(sheet, found, operating_point(["wavelength=525 nm"]))
    assert {row.mark for row in rows} == {"pass", "warn"}
    assert all(row.demand and row.found for row in rows)
    assert next(row for row in rows if "centroid" in row.demand).mark == "pass"
    assert next(row for row in rows if "laboratory" in row.demand).found == "not stated"
    share = GRID[7] / float(sheet.transfer.photons[sheet.transfer.saturation])
    assert float(next(row for row in rows if "50 %" in row.demand).found[:-1]) == pytest.approx(
        100 * share, rel=0.02
    )


def test_sections_stand_in_the_order_of_the_standard_and_none_is_empty(sheet):
    names = list(emva_figures.PICTURES)
    shown = sections(
        sheet, EmvaFrames(None, sheet.spatial, 2), operating_point([]), dict.fromkeys(names, b"png")
    )
    assert [s.heading for s in shown] == [
        "Quantities", "Photon transfer", "Response", "Signal-to-noise ratio", "General model", "Linearity",
        "Dark current", "Spatial nonuniformity", "Spectrograms", "Profiles", "Defect pixels", "The frames",
        "Compliance: what was measured and told",
    ]  # fmt: skip
    assert sum(len(s.rows) for s in shown[:-2]) == len(sheet.quantities)
    bare = sections(sheet, EmvaFrames(None, sheet.spatial, 2), operating_point([]), {})
    assert [s.heading for s in bare if not s.rows] == ["The frames"]


@pytest.mark.parametrize("name", [n for n in emva_figures.PICTURES if n != "dark_current"])
def test_no_panel_of_a_picture_is_empty(sheet, name):
    figure = emva_figures.PICTURES[name](sheet)
    for ax in figure.axes:
        points = [np.asarray(line.get_ydata(), float) for line in ax.lines]
        assert any(len(y) > 5 and np.isfinite(y).all() and np.ptp(y) > 0 for y in points), (
            ax.get_title()
        )
        assert ax.get_xlabel() or name == "linearity"
        assert ax.get_ylabel()


def test_pictures_that_frames_do_not_allow_are_not_drawn():
    bare = sheet_of(spatial=False)
    drawn = [name for name, draw in emva_figures.PICTURES.items() if draw(bare) is not None]
    assert drawn == ["photon_transfer", "sensitivity", "snr", "general_model", "linearity"]


def test_no_text_of_the_summary_leaves_its_cell(sheet):
    """`absolute sensitivity threshold, no linear model` was cut off at the next column."""
    figure = emva_pdf._summary(sheet, "a camera", ["temperature: 25 °C"], {})
    figure.canvas.draw()
    (table,) = figure.axes[1].tables
    for cell in table.get_celld().values():
        text, box = cell.get_text().get_window_extent(), cell.get_window_extent()
        assert box.x0 < text.x0, cell.get_text().get_text()
        assert text.x1 < box.x1, cell.get_text().get_text()


@pytest.mark.slow
def test_the_pdf_has_the_summary_and_every_picture(sheet, monkeypatch):
    pictures = emva_figures.pictures(sheet)
    assert list(pictures) == [name for name in emva_figures.PICTURES if name != "dark_current"]
    assert all(png[:4] == b"\x89PNG" for png in pictures.values())
    few = ("photon_transfer", "dark_current", "snr", "linearity")
    monkeypatch.setattr(
        emva_figures, "PICTURES", {name: emva_figures.PICTURES[name] for name in few}
    )
    pages = emva_pdf.pdf(sheet, "a camera", ["temperature: 25 °C"])
    # without dark current, with a summary
    assert len(re.findall(rb"/Type /Page\b", pages)) == len(few)
