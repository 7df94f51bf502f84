"""The stability study of the shipped recipes: cells, failures, warnings and seconds, as a table for
RESULTS.md.

    python tests/benchmarks/bench_stability.py [--store FOLDER] [RECIPE ...]

Without a name: all shipped recipes. The recipes share one store, so that a recipe counts only the
seconds of cells that no earlier recipe had. With --store, a run that was stopped goes on where it
was; the seconds are those stored with each cell.
"""

from __future__ import annotations

import argparse
import json
import tempfile
from collections.abc import Mapping
from pathlib import Path
from typing import Any

from neusee.workflows import Store, load
from neusee.workflows.studies.run_study import study_recipe

RECIPES = sorted(path.stem for path in (Path(__file__).parents[2] / "recipes").glob("*.yaml"))


def seconds(store: Store) -> dict[str, tuple[int, float]]:
    """Return the number of cells, and the seconds, that each recipe was the first to compute;
    the last of each cell.
    """
    last: dict[tuple[str, str], Mapping[str, Any]] = {}
    for _, about in store.brief.each():
        if str(about.get("step", "")).startswith("stability of "):
            name = (str(about["recipe"]), str(about["step"]))
            last[name] = max(last.get(name, about), about, key=lambda one: str(one["date"]))
    found: dict[str, tuple[int, float]] = {}
    for (recipe, _), about in last.items():
        count, spent = found.get(recipe, (0, 0.0))
        found[recipe] = count + 1, spent + float(about["seconds"])
    return found


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--store", type=Path)
    parser.add_argument("recipes", nargs="*", default=RECIPES)
    given = parser.parse_args()
    with tempfile.TemporaryDirectory() as place:
        store = Store(given.store or Path(place) / "store")
        print(
            "| recipe | cells | fail | warn | first computed here | seconds of these"
            " |\n|---|---|---|---|---|---|"
        )
        for recipe in given.recipes:
            folder = study_recipe(
                "stability", load(recipe), store, Path(place) / "runs", ["neusee"]
            )
            found = json.loads((folder / "provenance.json").read_text())
            count, spent = seconds(Store(store.root)).get(load(recipe).name, (0, 0.0))
            cells = f"{found['cells']} | {found['failed']} | {found['warned']}"
            print(f"| {recipe} | {cells} | {count} | {spent:.0f} |", flush=True)


if __name__ == "__main__":
    main()
