"""A designed mask behind a peak limit, against its rival: the best round stop with a grey filter at the same limit."""

from __future__ import annotations

import math
from typing import Any

import torch
from torch import Tensor

from neusee.nodes import losses, metrics
from neusee.workflows.report.study_page import Mark, Section
from neusee.workflows.training.mask_design.design_terms import Terms

_LIGHTS = (10.0, 30.0, 100.0, 300.0, 1000.0)  #: e- in a pixel, beside that of the design
_DECIBELS = 10 / math.log(10)
_COLUMNS = ("light (e-)", "error, mask (dB)", "error, stop (dB)", "gain (dB)", "stop", "its filter",
            "bits, mask", "bits, stop", "more bits")  # fmt: skip


def against_stops(terms: Terms, height: Tensor) -> dict[str, Any]:
    """Return error and information of a mask behind the peak limit, and those of the best stop, by light of the scene.

    The result is empty if the loss has no such term.
    """
    if not terms.settings.weights.protected:
        return {}
    with torch.no_grad():
        psf, exposure = terms.psf(height), terms.exposure()
        peaks = [float(metrics.lsr(terms.psf(height, None, state)).max()) for state, _ in terms.laws.points()]
        limit, worst = exposure["limit"], max(peaks)
        own = {**terms.passed(), "limit": None if limit is None else limit * peaks[0] / worst}
        lights = sorted({*_LIGHTS, exposure["light"]})
        rows = [_row(terms, psf, {**exposure, "light": light}, own) for light in lights]
    stop = 1.0 if terms.shade is None else terms.recipe.steps[terms.shade.step].params["diameter"]
    return {
        "limit": limit,
        "lsr": worst,
        "stop": stop,
        "filter": 1.0 if limit is None else min(1.0, limit / worst),
        "rows": rows,
    }


def _row(terms: Terms, psf: Any, exposure: dict[str, Any], own: dict[str, Any]) -> dict[str, float]:
    """Return error and information of a mask, whose own limit is lower by what is uncertain, and of the best stop."""
    seen, found = terms.seen(), {"light": exposure["light"]}
    for name in ("filtered_error", "information"):
        found[name] = float(getattr(losses, name)(psf, *seen, **{**exposure, **own}))
        found[f"{name} of the stop"], width, passed = losses.best_stop(terms.plain(), *seen, **exposure, measure=name)
        if name == "filtered_error":
            found |= {"stop": width, "filter of the stop": passed}
    return found


def section(found: dict[str, Any]) -> Section:
    """Return the section of the report page that compares a mask with the best stop at the same peak limit."""
    limit = "no peak limit" if found["limit"] is None else f"a peak of at most {found['limit']:.3g} of the clear lens"
    text = f"""Error of the Wiener-filtered picture of a natural scene over its variance, and information per frequency,
        both for {limit}. The mask has an LSR of {found["lsr"]:.3g} in its worst band and in the worst state of what
        is uncertain, a stop of {found["stop"]:.3g} and a grey filter of
        {found["filter"]:.3g}. The rival is the round stop, as a share of the aperture, with the grey filter that has
        the least error at the same limit. A gain above 0 is in favour of the mask. Unknown glare and clipping are
        neglected."""
    listed, marks = [], dict[tuple[int, int], Mark]()
    for number, row in enumerate(found["rows"]):
        mask, stop = _DECIBELS * row["filtered_error"], _DECIBELS * row["filtered_error of the stop"]
        bits, least = -row["information"], -row["information of the stop"]
        marks[number, 3] = "pass" if mask < stop else "fail"
        marks[number, 8] = "pass" if bits > least else "fail"
        own = (row["stop"], row["filter of the stop"], bits, least, bits - least)
        listed.append((row["light"], mask, stop, stop - mask, *own))
    return Section("Behind a peak limit", text, _COLUMNS, listed, marks=marks)


def line(found: dict[str, Any]) -> str:
    """Return the gain of a mask over the best stop by light of the scene as a line of text."""
    gains = ", ".join(
        f"{_DECIBELS * (row['filtered_error of the stop'] - row['filtered_error']):+.2f} dB at {row['light']:g} e-"
        for row in found["rows"]
    )
    return f"filtered error against the best stop and filter: {gains}"
