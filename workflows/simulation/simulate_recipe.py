"""Run of a recipe, and the folder of the run: page, pictures, numbers, data files and
provenance.
"""

from __future__ import annotations

import warnings
from collections.abc import Callable, Iterator, Mapping, Sequence
from contextlib import contextmanager
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

from neusee.workflows.engine.local_executor import memory_limit
from neusee.workflows.engine.machine_resources import MemoryLimit, guarded, limited
from neusee.workflows.engine.provenance import timestamp
from neusee.workflows.engine.runner import Result, run
from neusee.workflows.engine.step_job import Executor
from neusee.workflows.engine.wanted_steps import wanted
from neusee.workflows.explain.why_rerun import explained
from neusee.workflows.graph.recipe_graph import Event, Recipe, StepRecord
from neusee.workflows.keys.cache_key import digest
from neusee.workflows.report import run_folder, run_page
from neusee.workflows.report.checked_recipe import recipe_text
from neusee.workflows.report.data_exports import data_files, exports
from neusee.workflows.report.files_beside import FilesBeside, GraphAhead
from neusee.workflows.report.run_folder import NotWritten, RunFolder, code_text, new_run
from neusee.workflows.report.run_pictures import (
    GRAPH_DRAWING,
    TIMELINE_DRAWING,
    DerivedFile,
    figure_files,
    graphs,
    pictures,
    states_of,
    timeline,
)
from neusee.workflows.store.derived_files import DerivedFiles
from neusee.workflows.store.result_store import Store
from neusee.workflows.tolerance.cheaper_steps import with_substitutions


@dataclass(frozen=True)
class RunOptions:
    """Options of a run: devices, memory, steps to compute anew, and a function that receives its
    events.
    """

    #: one or several devices, ``cuda:0,cuda:1,cpu``, the preferred one first
    device: str = "cpu"
    executor: Executor | None = None  #: computes the steps in place of this process
    memory: int | None = None  #: bytes that the run may use on each device at most
    #: steps that are computed, with all that follow from them, although their results are stored
    anew: Sequence[str] = ()
    watch: Callable[[Event], None] | None = None  #: gets each event of the run


@dataclass(frozen=True)
class Simulation:
    """A finished run: the path of its folder, the content of its file ``provenance.json``, and
    its stored files.
    """

    folder: Path
    document: dict[str, Any]
    taken: Mapping[str, Path]  #: by name in the folder: the file of the store that was added

    @property
    def page(self) -> Path:
        """Return the path of the HTML page of the run."""
        return self.folder / "report.html"


def simulate(
    recipe: Recipe,
    store: Store,
    runs: Path,
    command: Sequence[str],
    options: RunOptions = RunOptions(),
) -> Simulation:
    """Run a recipe and write the folder ``runs/<date>_<recipe>_<key>/``; after an error no folder
    remains.
    """
    memory = options.memory
    finished: dict[str, StepRecord] = {}
    start_time = timestamp()

    def note(event: Event) -> None:
        if event.done is not None:
            finished[event.step] = event.done
        if options.watch is not None:
            options.watch(event)

    picture_store = DerivedFiles(store)
    # with an explicit limit of memory, no results are held for files beside the run
    memory_beside = memory_limit(None) if memory is None else 0.0
    with (
        warnings.catch_warnings(record=True) as caught_warnings,
        FilesBeside(_files, picture_store, memory_beside) as files_beside,
    ):
        warnings.simplefilter("default")
        # cheaper steps, as far as the tolerance of the recipe allows
        recipe = with_substitutions(recipe, wanted(recipe))
        explained_run, graph_pictures = (
            explained(recipe, store, note),
            GraphAhead(files_beside, store, finished),
        )

        def show(*result: Any) -> None:
            files_beside(*result)
            graph_pictures(*result)

        result = run(
            recipe,
            store,
            wanted(recipe),
            explained_run,
            options.device,
            options.executor,
            memory,
            show,
            anew=options.anew,
        )
        # the records of steps that were computed here have their times
        result = replace(
            result, done={name: finished.get(name, done) for name, done in result.done.items()}
        )
        # the name of the folder follows from the keys of the results
        key = digest([[name, result.keys[name]] for name in wanted(result.recipe)])
        with limited(memory_limit(memory)), _watched(), new_run(runs, recipe.name, key) as folder:
            folder.said = {"began": start_time}
            document = _write(result, picture_store, folder, command, caught_warnings, files_beside)
    return Simulation(folder.path, document, folder.taken)


@contextmanager
def _watched() -> Iterator[None]:
    """Raise `NotWritten` if the memory of the process exceeds its limit while the report is
    written.
    """
    try:
        with guarded():
            yield
    except MemoryLimit as error:
        raise NotWritten(f"the report was stopped, and no part of it is left: {error}") from error


def _files(recipe: Recipe) -> Iterator[DerivedFile]:
    """Yield the pictures and data files that are made in parallel with a run."""
    yield from figure_files()
    yield from data_files(recipe)


def _write(
    result: Result,
    shelf: DerivedFiles,
    folder: RunFolder,
    command: Sequence[str],
    caught: Sequence[warnings.WarningMessage],
    beside: FilesBeside,
) -> dict[str, Any]:
    """Write the folder of a run: all files without pictures while the last pictures are drawn, and
    then the page.
    """
    timeline_file, finish = (
        folder.path / "figures" / "timeline.png",
        _last_pictures(result, folder, beside),
    )
    document = run_page.document(result, command)
    folder.write("code.json", code_text(result))
    folder.write("recipe.yaml", recipe_text(result.recipe))
    folder.write_rows("metrics.csv", ("step", "field", "index", "value"), document["metrics"])
    folder.write_rows("timing.csv", run_page.COLUMNS, run_page.rows(document["steps"]))
    run_folder.prepare()
    finish()
    picture_files, missing_files = pictures(result, shelf)
    files, refused_files = exports(result, shelf)
    document = run_page.with_pictures(
        document, files, missing_files, refused_files, (str(warning.message) for warning in caught)
    )
    folder.said |= document
    for name, path in picture_files.items():
        folder.take(f"figures/{name}.png", path)
    for name, path in files.items():
        folder.take(f"data/{name}", path)
    page_pictures = {
        **picture_files,
        **({"timeline": timeline_file} if timeline_file.exists() else {}),
    }
    folder.write("provenance.json", run_folder.document_text(document))
    folder.write(
        "report.html",
        run_folder.page(
            document, {name: path.read_bytes() for name, path in page_pictures.items()}
        ),
    )
    return document


def _last_pictures(result: Result, folder: RunFolder, beside: FilesBeside) -> Callable[[], None]:
    """Begin the pictures that show no result of a step; return a function that waits for all
    pictures and files.
    """
    step_times = timeline(result)
    timeline_file = folder.place("figures/timeline.png")
    wait_for_timeline = (
        beside.draw(timeline_file, TIMELINE_DRAWING, step_times) if step_times else None
    )
    for key, arguments in graphs(result.recipe, states_of(result.done)):
        beside.add("graph", key, GRAPH_DRAWING, arguments)

    def finish() -> None:
        if wait_for_timeline is not None:
            wait_for_timeline()
        beside.finish()

    return finish
