"""The folder of a study: document, page, pictures and tables are there together, or the folder
is not.
"""

import csv
import json

import pytest

from neusee.workflows.recipe.loading import load
from neusee.workflows.report.study_report import Section, StudyReport, StudyRun, silent


@pytest.fixture
def recipe(write, tmp_path):
    return load(
        write(
            "steps: {bands: {node: spectra.bands, with: {start: 400 nm, stop: 700 nm, count:"
            " 3}}}\noutputs: [bands]\n"
        ),
        folder=tmp_path,
    )


def test_a_folder_has_the_document_the_page_and_all_files(recipe, tmp_path):
    study = StudyRun("leave-out", recipe, ["neusee", "study"])
    document = study.document({"failed": 2, "tolerance": 0.5})
    report = StudyReport(
        "A title",
        "What came out.",
        [Section("A part", "Its text.")],
        pictures={"drawn": b"PNG", "not drawn": None},
        tables={"table.csv": (("a", "b"), [(1, 2.5)])},
        files={
            "text.txt": "x",
            "bytes.bin": b"y",
            "by_path.txt": lambda path: path.write_text("z"),
        },
        shown=("command", "tolerance"),
        banner="Not fit for use.",
    )
    folder = study.write(tmp_path / "runs", "0123456789", document, report)
    assert folder.name.endswith(f"_{recipe.name}_leave_out_01234567")
    names = {str(p.relative_to(folder)) for p in folder.rglob("*") if p.is_file()}
    written = {"text.txt", "bytes.bin", "by_path.txt", "table.csv", "figures/drawn.png"}
    assert (
        names
        == {
            "report.html",
            "provenance.json",
            "recipe.yaml",
            "ro-crate-metadata.json",
        }
        | written
    )
    assert list(csv.reader((folder / "table.csv").read_text().splitlines())) == [
        ["a", "b"],
        ["1", "2.5"],
    ]
    found = json.loads((folder / "provenance.json").read_text())
    assert found == document
    assert list(found)[:5] == ["study", "recipe", "command", "date", "seconds"]
    assert (found["study"], found["command"], found["failed"]) == ("leave-out", "neusee study", 2)
    assert found["seconds"] >= 0
    assert found["config"] == recipe.config.to_yaml()
    page = (folder / "report.html").read_text()
    assert "Not fit for use." in page
    assert "tolerance" in page
    assert found["date"] not in page


def test_a_study_that_cannot_be_written_leaves_no_folder(recipe, tmp_path):
    study = StudyRun("stability", recipe, [])

    def fail(path):
        raise OSError("disk full")

    with pytest.raises(OSError, match="disk full"):
        study.write(
            tmp_path / "runs",
            "0" * 8,
            study.document({}),
            StudyReport("", "", [], files={"a": fail}),
        )
    assert not list((tmp_path / "runs").iterdir())


def test_silence_says_nothing(capsys):
    silent("a line")
    assert capsys.readouterr().out == ""
