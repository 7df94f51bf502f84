"""The first command of the README tells what the README says."""

from __future__ import annotations

import json
import re
from dataclasses import replace
from pathlib import Path

import pytest

from neusee.workflows.recipe.loading import load
from neusee.workflows.simulation.simulate_recipe import simulate
from neusee.workflows.store.result_store import Store

README = Path(__file__).parents[3] / "README.md"
OUTPUTS = (
    "lsr[mask]",
    "peak[plain]",
    "peak[mask]",
    "developed_quality[plain]",
    "developed_quality[mask]",
)
OUTPUTS += ("restored_quality", "saturated[plain]", "saturated[mask]")


@pytest.mark.slow
def test_the_story_has_the_numbers_of_the_readme(tmp_path):
    recipe = replace(load("first_light"), outputs=OUTPUTS)
    done = simulate(recipe, Store(tmp_path / "store"), tmp_path, ["neusee", "run"])
    story = json.loads((done.folder / "provenance.json").read_text())["story"]
    told = re.findall(r"\d[\d.,]*\d", story["buys"] + story["costs"])
    assert told == [
        "232",
        "3.95",
        "916",
        "0.00158",
        "530",
        "26.9",
        "14.6",
        "17.7",
        "459",
        "267",
        "1.72",
    ]
    text = README.read_text(encoding="utf-8")
    row = next(
        line for line in text.splitlines() if line.startswith("| plain lens, same filter")
    ).split("|")
    rival = story["numbers"]["grey filter, restored"]
    assert (
        f"passes {float(row[1].split('transmittance=')[1].rstrip('`) '))} of the light"
        in story["rival"]
    )
    # of one decimal
    assert float(row[2].removesuffix("dB ")) == pytest.approx(rival["PSNR (dB)"], abs=0.06)
    sentence = " ".join(
        text.partition("The run computes the first rival itself: ")[2].split("\n\n")[0].split()
    )
    assert (
        sentence
        == f"a grey filter that passes 0.00158 of the light gives a PSNR of {row[2].strip()}, and"
        " no pixel saturates."
    )
    assert int(row[4]) == rival["saturated px"] == 0
    assert "no pixel saturates" in story["rival"]
    assert not [number for number in told if not re.search(rf"\b{re.escape(number)}\b", text)]
    page = done.page.read_text(encoding="utf-8")
    assert (
        page.index(story["buys"])
        < page.index(story["rival"])
        < page.index('alt="What the camera sees')
        < page.index('id="results"')
    )
