"""The report of a run as JSON document: numbers, steps, times, pictures and provenance."""

from __future__ import annotations

import math
import os
import platform
import re
import shlex
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import replace
from pathlib import Path
from typing import Any

from neusee.nodes import Check
from neusee.workflows.engine.provenance import facts_in, state_counts, version_of
from neusee.workflows.engine.runner import Result
from neusee.workflows.engine.wanted_steps import compared
from neusee.workflows.graph.recipe_graph import Recipe, StepRecord
from neusee.workflows.keys.cache_key import file_digest
from neusee.workflows.recipe.distributions.nominal_values import standing_rows
from neusee.workflows.report.contents import FIGURES
from neusee.workflows.report.paper_readings import consequences, in_force
from neusee.workflows.report.run_folder import present_time
from neusee.workflows.report.run_pictures import GRAPH, TIMELINE
from neusee.workflows.report.run_summary import expected, metrics, said_of_frame, story, table
from neusee.workflows.report.tolerance_spent import spectral_error, spent
from neusee.workflows.store.cache_settings import format_size

# --- run timing -----------------------------------------------------------------------------------

# Times of a run: computing time, time that the cache saved, and predicted time.


StepRow = Mapping[str, Any]  #: a step in the document of a run

#: columns of the file ``timing.csv``, which has a line for each step
COLUMNS = (
    "step",
    "node",
    "device",
    "lane",
    "state",
    "began",
    "seconds",
    "predicted",
    "peak",
    "predicted_peak",
    "bytes",
    "key",
)


def rows(steps: Iterable[StepRow]) -> list[list[Any]]:
    """Return the rows of ``timing.csv``, one for each step of a run, with the values of
    `COLUMNS`.
    """
    return [[step[column] for column in COLUMNS] for step in steps]


def timing(steps: Sequence[StepRow], planned: float | None = None) -> dict[str, Any]:
    """Return the total times of a run (predicted, actual, saved by the cache), and the bytes read
    and written.

    Steps with the same result count once.
    """
    steps_run, loaded = _in_state(steps, "run"), _in_state(steps, "cached", "not needed")
    computed_keys = {step["key"] for step in steps_run}
    served_once = _once(step for step in loaded if step["key"] not in computed_keys)
    predicted = [step for step in steps_run if step["predicted"] is not None]
    seconds_run, seconds_saved = _total(steps_run, "seconds"), _total(served_once, "made_in")
    return {
        "ran": len(steps_run),
        "served": len(loaded),
        "steps": len(steps),
        "seconds": seconds_run,
        "span": _span(steps_run),
        "planned": planned if steps_run else None,
        "told": len(predicted),
        "predicted": _total(predicted, "predicted"),
        "actual": _total(predicted, "seconds"),
        "saved": seconds_saved,
        "share": seconds_saved / (seconds_saved + seconds_run)
        if seconds_saved + seconds_run
        else 0.0,
        "read": _total(_in_state(served_once, "cached"), "bytes"),
        "written": _total([step for step in steps_run if step["kept"]], "bytes"),
    }


def _in_state(steps: Iterable[StepRow], *states: str) -> list[StepRow]:
    """Return the steps in one of the states."""
    return [step for step in steps if step["state"] in states]


def _total(steps: Iterable[StepRow], column: str) -> Any:
    """Return the sum of a column of the steps."""
    return sum(step[column] for step in steps)


def _span(ran: Sequence[StepRow]) -> Any:
    """Return the time in s from the start of the first step that ran to the end of the last."""
    if not ran:
        return 0.0
    last_end = max(step["began"] + step["seconds"] for step in ran)
    return last_end - min(step["began"] for step in ran)


def _once(steps: Iterable[StepRow]) -> list[StepRow]:
    """Return one step for each distinct result, with preference for a step whose result was read
    from the cache.
    """
    steps_by_key: dict[str, StepRow] = {}
    for step in steps:
        if step["key"] not in steps_by_key or step["state"] == "cached":
            steps_by_key[step["key"]] = step
    return list(steps_by_key.values())


def said_of(times: Mapping[str, Any]) -> list[str]:
    """Return the times and the sizes in bytes of a run, which `timing` computed, as sentences."""
    lines = []
    if times["ran"]:
        lines.append(
            f"{times['ran']} of {times['steps']} steps ran: {_seconds(times['seconds'])} of"
            " computing time."
        )
    if times["told"]:
        steps = (
            "these steps"
            if times["told"] == times["ran"]
            else f"the {times['told']} whose time was no guess"
        )
        predicted, actual = _seconds(times["predicted"]), _seconds(times["actual"])
        lines.append(f"Predicted for {steps}: {predicted}; actual: {actual}.")
    if times["planned"] is not None:
        planned, span = _seconds(times["planned"]), _seconds(times["span"])
        lines.append(f"Planned duration, with parallel branches: {planned}; actual: {span}.")
    # predicted and actual bytes, of which the first may be unknown
    if times["ran"] and times.get("peak", [None])[0]:
        predicted, actual = (format_size(size) for size in times["peak"])
        lines.append(
            f"Predicted peak memory of the program while the steps ran: {predicted}; actual:"
            f" {actual}."
        )
    if times["served"]:
        share = f"{100 * times['share']:.3g} % of all computing time"
        lines.append(
            f"The cache served {times['served']} steps and saved {_seconds(times['saved'])},"
            f" {share}."
        )
    lines.append(
        f"Read from the cache: {format_size(times['read'])}; written to it:"
        f" {format_size(times['written'])}."
    )
    return lines


def _seconds(value: float) -> str:
    """Return a time as text with its unit."""
    return f"{value:.3g} s" if value < 100 else f"{value:.0f} s"


# --- run page -------------------------------------------------------------------------------------

# The report of a run as JSON document: numbers, steps, pictures and provenance.
#
# `document` returns JSON values, which a run stores beside the pictures as ``provenance.json``.
# `run_folder.page` needs this document and the pictures only.


_LIBRARIES = ("torch", "numpy", "kornia", "colour-science", "OpenEXR", "pydantic", "safetensors")
_COPIED = (
    "device",
    "state",
    "why",
    "seconds",
    "predicted",
    "began",
    "lane",
    "peak",
    "predicted_peak",
    "kept",
)  #: from `StepRecord`
_TITLES = {figure.name: figure.title for figure in FIGURES}
_UNITS = frozenset(("m", "nm", "rad", "e-", "DN", "photons", "W/m2", "dB"))
_SAMPLING = "The PSF is sampled at the pixel centres; one pixel centre lies on the optical axis."


def document(result: Result, command: Sequence[str]) -> dict[str, Any]:
    """Return the report of a run, apart from its pictures, as a document of JSON values.

    It can be made while the last pictures are drawn; `with_pictures` adds what is known only
    afterwards.
    """
    recipe, done = result.recipe, list(result.done.values())
    expectations, unchecked = expected(recipe, result.value), _unchecked(recipe)
    steps = [_step(record, result) for record in done]
    failed = _failed_checks(steps)
    times = timing(steps, _planned(result)) | {"peak": [result.predicted_peak, result.peak_memory]}
    return {
        "recipe": recipe.name,
        "title": recipe.title,
        "version": version_of("neusee"),
        "command": shlex.join(command),
        "started": present_time(),
        "device": result.device,
        "seconds": result.seconds,
        "tolerance": recipe.tolerance,
        "seed": recipe.seed,
        "counts": state_counts(done),
        **_judgement(expectations, failed, unchecked),
        "story": {
            **story(recipe, result.keys, result.value),
            **said_of_frame(recipe, result.keys, result.value),
        },
        "table": table(recipe, result.keys, result.value),
        "metrics": metrics(recipe, result.keys, result.value),
        "notes": [*_sampling(recipe), *recipe.notes, *unchecked_lines(unchecked)],
        "warnings": [],
        "posterior": standing_rows(recipe.uncertain.standings) if recipe.uncertain else [],
        "readings": _readings(recipe),
        "consequences": consequences(recipe.config.values),
        "left_out": [
            {"step": record.step, "bound": record.bound, "why": record.why}
            for record in done
            if record.state == "left out"
        ],
        "spent": spent(result),
        "spectral": spectral_error(recipe, result.keys, result.value),
        "absent": [{"step": step, "where": where} for step, where in recipe.absent.items()],
        "timing": {**times, "said": said_of(times)},
        "steps": steps,
        "figures": [],
        "missing": [],
        "facts": _facts(result),
        "inputs": _inputs(recipe),
    }


def with_pictures(
    doc: Mapping[str, Any],
    files: Iterable[str],
    missing: Mapping[str, str],
    refused: Mapping[str, str],
    warnings: Iterable[str],
) -> dict[str, Any]:
    """Return the document of a run with its pictures and data files, the missing ones of both, and
    all warnings.

    ``missing`` and ``refused`` have the reason for each missing picture and data file; a picture
    without a reason has nothing to show in this recipe.
    """
    distinct_warnings = list(dict.fromkeys(warnings))
    missing_pictures = [
        {"name": name, "title": _TITLES.get(name, name), "why": reason}
        for name, reason in missing.items()
        if reason
    ]
    return {
        **doc,
        "notes": [*doc["notes"], *distinct_warnings],
        "warnings": distinct_warnings,
        "figures": _figures(missing, bool(doc["timing"]["ran"])),
        "missing": [
            *missing_pictures,
            *(
                {"name": name, "title": f"data/{name}", "why": reason}
                for name, reason in refused.items()
            ),
        ],
        "files": sorted(files),
    }


def _failed_checks(steps: Iterable[StepRow]) -> list[str]:
    """Return step and text of each check that failed."""
    failed = []
    for step in steps:
        failed += [
            f"{step['step']}: {check['text']}" for check in step["checks"] if not check["ok"]
        ]
    return failed


def _judgement(
    expectations: Sequence[Mapping[str, Any]],
    failed: Sequence[str],
    unchecked: Sequence[Mapping[str, str]],
) -> dict[str, Any]:
    """Return the expected numbers of a run, compared and not compared, the checks that failed,
    and a verdict.
    """
    return {
        "verdict": verdict(expectations, failed, len(unchecked)),
        "missed": [expectation["name"] for expectation in expectations if not expectation["ok"]],
        "failed": failed,
        "expected": expectations,
        "unchecked": unchecked,
    }


def verdict(
    expectations: Sequence[Mapping[str, Any]], failed: Sequence[str], unchecked: int = 0
) -> str:
    """Return a sentence that counts the expected numbers that the run reproduced, and the checks
    that failed.

    ``unchecked`` is the number of expected numbers whose steps no output needs, so that the run has
    not compared them.
    """
    met_count = sum(expectation["ok"] for expectation in expectations)
    compared_text = f"{met_count} of {len(expectations)} expected numbers within tolerance"
    compared_text += f", {unchecked} more not checked" if unchecked else ""
    nothing_compared_text = (
        f"None of {unchecked} expected numbers checked"
        if unchecked
        else "No expected numbers in this recipe"
    )
    numbers = compared_text if expectations else nothing_compared_text
    checks = (
        "every check held"
        if not failed
        else f"{len(failed)} check{'s' * (len(failed) > 1)} to look at"
    )
    return f"{numbers}; {checks}."


def shape_of(done: StepRecord) -> str:
    """Return the shape of a result as ``31 × 512 × 512``, or an empty string if the shape is
    unknown.
    """
    return " × ".join(map(str, done.facts.shape)) or "number" if done.facts else ""


def _step(done: StepRecord, result: Result) -> dict[str, Any]:
    """Return the entry of one step in the document of a run, taken from the record of the step or,
    failing that, from the record of its stored result.
    """
    node = result.recipe.steps[done.step].node
    stored_metadata = (
        result.store.about(done.key) if done.state in ("cached", "not needed") else None
    )
    done = _remembered(done, stored_metadata) if stored_metadata else done
    return {
        "step": done.step,
        "node": node.path,
        **{name: getattr(done, name) for name in _COPIED},
        "made_in": stored_metadata["seconds"] if stored_metadata else done.seconds,
        "shape": shape_of(done),
        "unit": unit_of(node.__doc__ or ""),
        "size": format_size(done.bytes) if done.bytes else "",
        "bytes": done.bytes,
        "key": done.key,
        # JSON has no infinity
        "bound": done.bound if done.bound is None or math.isfinite(done.bound) else None,
        "checks": [{"text": check.text, "ok": check.ok} for check in done.checks],
    }


def _planned(result: Result) -> float | None:
    """Return the predicted duration of a run in s, or None if the time of a step that ran was
    not predicted.
    """
    steps_run = [done for done in result.done.values() if done.state == "run"]
    if result.schedule is None or any(done.predicted is None for done in steps_run):
        return None
    # a schedule may lack steps of a second attempt
    planned_steps = {slot.task for slot in result.schedule.slots}
    return (
        result.schedule.makespan if all(done.step in planned_steps for done in steps_run) else None
    )


def _remembered(done: StepRecord, about: Mapping[str, Any]) -> StepRecord:
    """Complete the record of a step that was not computed in this run with the metadata of its
    stored result.
    """
    checks = tuple(Check(text, ok) for text, ok in about.get("checks", ()))
    why = f"made {about['date'][:16].replace('T', ' ')} UTC"
    return replace(done, why=why, facts=facts_in(about), checks=checks, bytes=about["bytes"])


def unit_of(docstring: str) -> str:
    """Return the unit of a node's result from the ``Units:`` line of the docstring of the node."""
    lines = (line.strip() for line in docstring.splitlines())
    units = (
        next((line for line in lines if line.startswith("Units:")), "Units:")
        .removeprefix("Units:")
        .strip()
    )
    # the unit of the result, in a line that may name others before
    text_before, found_word, text_after = units.partition("result ")
    first_word = re.split(
        r"[\s,;:]|\.(?:\s|$)", text_after if found_word else text_before, maxsplit=1
    )[0]
    return first_word if first_word in _UNITS else ""


def _sampling(recipe: Recipe) -> list[str]:
    """Return a note on the sampling of the PSF, because every LSR depends on the sampling."""
    samplings = {
        step.params.get("sensor")
        for step in recipe.steps.values()
        if step.node.path == "optics.psf"
    }
    if samplings & {"point", "point_as_printed"}:
        return [_SAMPLING]
    return ["The PSF is averaged over each pixel."] if samplings else []


def _unchecked(recipe: Recipe) -> list[dict[str, str]]:
    """Return the expected numbers whose steps no output needs."""
    return [{"name": number.name, "step": number.step} for number in compared(recipe)[1]]


def unchecked_lines(numbers: Sequence[Mapping[str, str]]) -> list[str]:
    """Return a line that names the expected numbers that a run has not compared, or no line if
    there are none.
    """
    names = ", ".join(number["name"] for number in numbers)
    return (
        [f"not checked, because no output of this run needs their steps: {names}"]
        if numbers
        else []
    )


def _readings(recipe: Recipe) -> list[dict[str, str]]:
    """Return a table row for each contradiction in the paper, with the interpretation that the
    recipe uses.
    """
    values = recipe.config.values
    if not any(path.startswith("reading.") for path in values):
        return []
    texts = ("path", "number", "matter", "reason")
    return [
        {name: str(getattr(contradiction, name)) for name in texts}
        | {"value": _written(values[contradiction.path]), "state": state}
        for contradiction, state in in_force(values)
    ]


def _written(value: Any) -> str:
    """Return a value as a recipe writes the value: ``true`` in place of Python's ``True``."""
    return str(value).lower() if isinstance(value, bool) else str(value)


def _figures(missing: Mapping[str, str], ran: bool) -> list[dict[str, str]]:
    """Return the figures of the document; ``ran`` adds that of the times."""
    figures_of_run = (
        [
            (figure.name, figure.title, figure.caption)
            for figure in FIGURES
            if figure.name not in missing
        ]
        + [GRAPH]
        + [TIMELINE] * ran
    )
    return [
        {"name": name, "title": title, "caption": caption, "file": f"figures/{name}.png"}
        for name, title, caption in figures_of_run
    ]


def _facts(result: Result) -> list[list[str]]:
    """Return a table of the software versions, the machine and the settings of a run."""
    import torch

    counts_of_machine = {"core": os.cpu_count() or 1, "thread": torch.get_num_threads()}
    machine = ", ".join(
        f"{count} {name}{'s' * (count > 1)}" for name, count in counts_of_machine.items()
    )
    rows = [
        ["neusee", version_of("neusee")],
        ["Python", platform.python_version()],
        *[[name, version_of(name)] for name in _LIBRARIES],
        ["machine", f"{platform.system()} {platform.machine()}, {machine}"],
        ["device", result.device],
        ["recipe seed", str(result.recipe.seed)],
        ["tolerance", f"{result.recipe.tolerance:g}"],
        ["engine", f"{result.seconds:.3f} s"],
        ["peak memory", format_size(result.peak_memory)],
    ]
    return [[name, value] for name, value in rows if value]


def _inputs(recipe: Recipe) -> list[dict[str, str]]:
    """Return parameter, name and digest of every input file of a recipe."""
    rows = []
    for step in recipe.steps.values():
        files = {name: value for name, value in step.params.items() if isinstance(value, Path)}
        rows += [
            {"parameter": f"{step.name}.{name}", "file": file.name, "digest": file_digest(file)}
            for name, file in files.items()
        ]
    return rows
