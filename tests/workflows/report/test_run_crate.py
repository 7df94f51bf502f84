"""The crate of a folder of results: what it says is there, and it is there only when the folder
is whole.
"""

import json
import os
from datetime import UTC, datetime
from pathlib import Path

import pytest

from neusee.workflows.report import run_crate
from neusee.workflows.report.run_crate import (
    CRATE,
    CREATOR,
    LICENCE,
    remove_crate,
    restore_crate,
    write_crate,
)
from neusee.workflows.report.run_folder import new_run
from tests.workflows.crate_rules import faults

SAMPLES = Path(__file__).parents[3] / "recipes" / "samples"
SAID = {
    "recipe": "first_light",
    "title": "A camera.",
    "command": "neusee run first_light",
    "began": "2026-01-31T11:59:00+00:00",
    "seconds": 2.0,
    "versions": {"python": "3.11.7", "neusee": "0.1.0", "torch": "2.13.0+cpu", "kornia": "none"},
    "figures": [{"file": "figures/over view.png", "title": "What the camera sees"}],
    "inputs": [{"parameter": "scene.file", "file": "my.jpg", "digest": "00ff"}],
}


@pytest.fixture
def folder(tmp_path):
    """A small folder of results."""
    (tmp_path / "figures").mkdir()
    (tmp_path / "figures" / "over view.png").write_bytes(b"png")
    (tmp_path / "recipe.yaml").write_text("steps: {}\n")
    (tmp_path / ".hidden").write_text("not a result")
    return tmp_path


def graph(folder):
    return {entity["@id"]: entity for entity in json.loads((folder / CRATE).read_text())["@graph"]}


def crated(folder, **more):
    write_crate(folder, "a run", SAID | more, datetime(2026, 1, 31, 12, tzinfo=UTC))
    return graph(folder)


def test_the_crate_says_what_the_folder_holds(folder):
    found = crated(folder)
    assert list(faults(folder)) == []
    picture, action = found["figures/over%20view.png"], found["#a%20run"]
    assert picture["name"] == "figures/over view.png"
    assert (picture["encodingFormat"], picture["contentSize"]) == ("image/png", "3")
    assert picture["description"] == "What the camera sees"
    assert action["name"] == "neusee run first_light"
    assert (action["startTime"], action["endTime"]) == (
        "2026-01-31T11:59:00.000+00:00",
        "2026-01-31T12:00:00.000+00:00",
    )
    assert action["object"] == [{"@id": "recipe.yaml"}, {"@id": "#input-00ff"}]
    assert action["result"] == [{"@id": "figures/over%20view.png"}]
    assert found["https://pypi.org/project/torch/2.13.0/"]["softwareVersion"] == "2.13.0+cpu"
    assert "kornia" not in json.dumps(list(found.values()))
    assert "license" not in found["#input-00ff"]


def test_a_command_that_took_seconds_began_before_it_ended(folder):
    found = crated(folder, began=None, seconds=90.0)
    assert found["#a%20run"]["startTime"] == "2026-01-31T11:58:30.000+00:00"
    assert "startTime" not in crated(folder, began=None, seconds=None)["#a%20run"]


def test_what_did_not_complete_says_so(folder):
    assert crated(folder)["#a%20run"]["actionStatus"] == "http://schema.org/CompletedActionStatus"
    assert (
        crated(folder, state="interrupted")["#a%20run"]["actionStatus"]
        == "http://schema.org/FailedActionStatus"
    )


def test_a_photograph_that_ships_has_its_licence(folder):
    from neusee.workflows.keys.cache_key import file_digest

    row = {
        "parameter": "scene.file",
        "file": "china.jpg",
        "digest": file_digest(SAMPLES / "china.jpg"),
    }
    name = f"#input-{row['digest']}"
    found = crated(folder, inputs=[row, row | {"parameter": "again.file"}])
    assert found[name]["license"] == {"@id": "https://creativecommons.org/licenses/by/2.0/"}
    assert found["https://creativecommons.org/licenses/by/2.0/"]["name"] == "CC BY 2.0"
    assert "danielbuechele" in found[name]["description"]
    assert "scene.file, again.file" in found[name]["description"]
    assert list(faults(folder)) == []
    mine = crated(folder, inputs=[row | {"digest": "00"}])
    assert "license" not in mine["#input-00"]


def test_every_sample_that_ships_has_a_licence():
    shipped = {
        path.name
        for path in SAMPLES.iterdir()
        if path.suffix in (".jpg", ".exr", ".png", ".safetensors")
    }
    assert shipped <= run_crate._samples().keys()


@pytest.mark.parametrize(
    ("given", "name", "place"),
    [
        (
            "Ada Lovelace <https://orcid.org/0000-0002-1825-0097>",
            "Ada Lovelace",
            "https://orcid.org/0000-0002-1825-0097",
        ),
        ("Ada Lovelace", "Ada Lovelace", "#creator"),
        ("Ada <ada>", "Ada <ada>", "#creator"),
    ],
)
def test_the_creator_is_named(given, name, place, folder, monkeypatch):
    monkeypatch.setenv(CREATOR, given)
    found = crated(folder)
    assert found[place] == {"@id": place, "@type": "Person", "name": name}
    assert found["#a%20run"]["agent"] == found["./"]["author"] == {"@id": place}
    assert list(faults(folder)) == []


@pytest.mark.parametrize(
    ("given", "place"),
    [
        ("", "#licence"),
        ("all rights reserved", "#licence"),
        ("https://a.org/by/4.0/", "https://a.org/by/4.0/"),
    ],
)
def test_the_licence_is_named(given, place, folder, monkeypatch):
    monkeypatch.setenv(LICENCE, given)
    found = crated(folder)
    assert found["./"]["license"] == {"@id": place}
    assert found[place]["name"] == (given or "No licence stated")


def test_a_folder_that_is_written_again_has_the_sizes_of_its_files(folder):
    crated(folder)
    crate = remove_crate(folder)
    assert not (folder / CRATE).exists()
    (folder / "recipe.yaml").write_text("longer than before\n")
    restore_crate(folder, crate)
    assert graph(folder)["recipe.yaml"]["contentSize"] == "19"
    assert list(faults(folder)) == []
    assert remove_crate(folder) is not None
    assert remove_crate(folder) is None


@pytest.mark.parametrize("text", ["{", "[]", '{"@graph": 1}'])
def test_a_damaged_crate_is_removed(text, folder):
    (folder / CRATE).write_text(text)
    assert remove_crate(folder) is None
    assert not (folder / CRATE).exists()


def test_no_crate_appears_before_the_folder_is_whole(tmp_path, monkeypatch):
    seen = []
    rename = Path.rename
    monkeypatch.setattr(
        Path, "rename", lambda part, to: seen.append(sorted(os.listdir(part))) or rename(part, to)
    )
    with new_run(tmp_path, "r", "k" * 8) as run:
        run.write("a.txt", "a")
        assert not (run.path / CRATE).exists()
    assert seen == [["a.txt", CRATE]]
    assert list(faults(run.path)) == []


FAULTS = [
    (lambda g: g["./"].pop("license"), "the root has no license"),
    (lambda g: g["./"].update(datePublished="today"), "datePublished is no date"),
    (lambda g: g["recipe.yaml"].update(colour="red"), "recipe.yaml: colour is not in the context"),
    (
        lambda g: g["recipe.yaml"].update({"@type": "Recipes"}),
        "recipe.yaml: Recipes is not in the context",
    ),
    (lambda g: g["recipe.yaml"].update(contentSize="1"), "recipe.yaml has another size than 1"),
    (
        lambda g: g["recipe.yaml"].update(contentSize=9),
        "recipe.yaml contentSize: 9 is neither a text nor a reference",
    ),
    (
        lambda g: g["#a%20run"].update(agent={"@id": "#nobody"}),
        "#a%20run agent: nothing is #nobody",
    ),
    (lambda g: g["#a%20run"].update(object=[]), "the recipe is not what the command read"),
    (
        lambda g: g["#a%20run"].update(startTime="2027-01-31T11:59:00.000+00:00"),
        "the command ended before it began",
    ),
    (lambda g: g["./"].pop("mentions"), "the root does not mention the action"),
    (lambda g: g["./"]["hasPart"].pop(), "recipe.yaml is no part of the root"),
    (
        lambda g: g.update({"#x": {"@id": "#x", "@type": "Person", "name": "x"}}),
        "nothing leads to #x",
    ),
]


@pytest.mark.parametrize(("harm", "said"), FAULTS, ids=[said for _, said in FAULTS])
def test_a_planted_fault_is_found(harm, said, folder):
    found = crated(folder)
    harm(found)
    (folder / CRATE).write_text(
        json.dumps({"@context": run_crate._SPECIFICATION + "/context", "@graph": [*found.values()]})
    )
    assert said in list(faults(folder))


def test_a_file_that_is_gone_or_new_is_found(folder):
    crated(folder)
    (folder / "recipe.yaml").rename(folder / "other.yaml")
    assert {"recipe.yaml is not in the folder", "other.yaml is not in the crate"} <= set(
        faults(folder)
    )
