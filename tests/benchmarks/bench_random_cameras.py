"""Random cameras and lasers, judged by `neusee safety` and by formulas of their own: which
distances disagree?

    python tests/benchmarks/bench_random_cameras.py cameras.jsonl [--first 0 --count 200]

Camera N is drawn from the seed [32, N]. FILE has one line for each camera that is done; a second
call goes on. A distance is off where it differs by more than 3 %, and no 3 % of the exposure
explain it. An end of an interval is off where it is, by more than 3 %, outside of the reference's
quantiles three standard deviations of both Monte Carlo samples to each side. A limit is
*false-safe* where neusee says nowhere, or a distance that is off and nearer than that of the
reference.
"""

from __future__ import annotations

import argparse
import json
import math
import sys
import tempfile
import time
from collections import Counter
from collections.abc import Iterator
from pathlib import Path
from typing import Any, cast
from unittest import mock

import numpy as np
import torch

from neusee.workflows import RecipeError, load
from neusee.workflows.safety import safety_estimate
from neusee.workflows.safety.exposure_limits import limit_ratio
from neusee.workflows.safety.run_safety import document
from tests.benchmarks.random_cameras import DRAWS, OWN_DRAWS, Camera, camera
from tests.workflows.safety import own_camera_limits as own
from tests.workflows.safety.own_camera_spots import Floats, Spots, spots_of, table_of

NEAREST, FURTHEST, SAMPLES = 1.0, 1e5, 600  # m, and distances between
OFF, DEVIATIONS = 0.03, 3.0
QUANTILES = (0.05, 0.95)
SATURATED = "saturated"
Found = dict[str, Any]


def ratios(
    given: dict[str, Any], metres: Floats, spots: Spots, place: int | None
) -> dict[str, Floats]:
    """Return exposure over limit, of saturation without a place in the bracket, else of each
    part of the light.
    """
    if place is None:
        return {SATURATED: own.saturation_ratio(given, metres, spots)}
    return {
        f"damage: {part}": ratio
        for part, ratio in own.damage_ratios(given, metres, spots, place).items()
    }


def reference(known: Camera) -> dict[str, Found]:
    """Return near and far end of each limit with the interval of the far end, and the largest
    ratio.
    """
    metres = np.unique(np.append(np.geomspace(NEAREST, FURTHEST, SAMPLES), known.distance))
    fill, waves = own.taper_and_defocus(known.given, metres)
    found = {}
    for damage in (True, False) if known.judged else (False,):
        spots = spots_of(fill, waves, known.half_pixel, damage)
        nominal, upper = (
            ratios(known.given, metres, spots, place if damage else None) for place in (0, 1)
        )
        drawn = far_ends(known, metres, spots, damage)
        for name, ratio in nominal.items():
            ratio = upper[name] if above_alone(known, name) else ratio
            found[name] = summary(metres, ratio, waves) | intervals(drawn[name])
    return found


def above_alone(known: Camera, name: str) -> bool:
    """Return True for a part of the light that only the upper end of the bracket judges."""
    return known.opens_below and name in ("damage: pulse", "damage: accumulation")


def summary(metres: Floats, ratio: Floats, waves: Floats) -> Found:
    """Return the nominal zones of a limit, and the waves of defocus at its far end."""
    (near, far), (_, less), (_, more) = own.zones(
        metres, ratio[None] * [[1], [1 / (1 + OFF)], [1 + OFF]]
    )
    beyond = metres >= (far[-1] if len(far) else metres[ratio.argmax()]) * 0.97
    found = {
        "near": near.tolist(),
        "far": far.tolist(),
        "most": float(ratio.max()),
        "waves": float(waves[beyond][0]),
    }
    return found | {"least_far": float(less.max(initial=0)), "most_far": float(more.max(initial=0))}


def far_ends(known: Camera, metres: Floats, spots: Spots, damage: bool) -> dict[str, Floats]:
    """Return the farthest distance of each draw for each limit; NaN for a draw without any."""
    given = known.drawn()
    coarse = metres[::6]
    rough = Spots(*(part[None, ::6] for part in (spots.peak, spots.heat, spots.pixel)))
    found = {}
    for name, rows in bracketed(known, given, coarse, rough, damage).items():
        last = farthest(coarse, rows)
        if np.isnan(last).all():
            found[name] = last
            continue
        ends = np.clip([np.nanmin(last) * 0.5, np.nanmax(last) * 1.5], NEAREST, FURTHEST)
        fine = np.geomspace(
            float(ends[0]), float(ends[1]), 3 + int(np.log(ends[1] / ends[0]) / 0.015)
        )
        fill, waves = np.broadcast_arrays(*own.taper_and_defocus(given, fine[None, :]))
        shape = table_of(fill, waves, known.half_pixel, damage)(fill, waves)
        found[name] = farthest(fine, bracketed(known, given, fine, shape, damage)[name])
    return found


def bracketed(
    known: Camera, given: dict[str, Any], metres: Floats, spots: Spots, damage: bool
) -> dict[str, Floats]:
    """Return the ratios (draw, distance); a third of the draws each has an end or the middle of
    the bracket.
    """
    if not damage:
        whole = np.ones((OWN_DRAWS, len(metres)))
        return {
            name: ratio * whole
            for name, ratio in ratios(given, metres[None, :], spots, None).items()
        }
    chosen = np.random.default_rng([34, known.number]).integers(-1, 2, (OWN_DRAWS, 1))
    by_place = {place: ratios(given, metres[None, :], spots, place) for place in own.PLACES}
    found = {}
    for name, upper in by_place[1].items():
        parts = (
            [upper] * 3
            if above_alone(known, name)
            else [by_place[place][name] for place in own.PLACES]
        )
        found[name] = np.select([chosen == place for place in own.PLACES], parts)
    return found


def farthest(metres: Floats, ratio: Floats) -> Floats:
    """Return the far end of the last zone of each row; NaN without a zone."""
    return np.array([far[-1] if len(far) else math.nan for _, far in own.zones(metres, ratio)])


def intervals(far: Floats) -> Found:
    """Return the interval of the far end, with the quantiles that the Monte Carlo samples may
    differ by.
    """
    known = np.sort(far[~np.isnan(far)])
    if len(known) < 100:
        return {"nowhere": 1 - len(known) / len(far)}
    found: Found = {"nowhere": 1 - len(known) / len(far)}
    for name, share in zip(("low", "high"), QUANTILES, strict=True):
        count = 1 / (DRAWS * len(known) / len(far)) + 1 / len(known)
        room = DEVIATIONS * math.sqrt(share * (1 - share) * count)
        places = np.clip([share, share - room, share + room], 0, 1)
        found[name] = np.quantile(known, places).tolist()
    return found


def judged(known: Camera, folder: Path, draws: int = DRAWS) -> Found:
    """Return what neusee says of the camera, or the reason why it refuses the recipe."""
    (folder / "camera.yaml").write_text(known.recipe(draws))
    # what would help is not compared, and costs half of the time
    with mock.patch.object(safety_estimate, "remedies", return_value=()):
        try:
            said: Any = document(safety_estimate.estimate(load("camera.yaml", [], folder)))
        except RecipeError as error:
            return {"refused": str(error)}
    found = {}
    for limit in said["limits"]:
        name = SATURATED if limit["limit"].startswith(SATURATED) else limit["limit"]
        zones = limit["zones"]
        found[name] = {
            "near": [zone["near"]["value"] for zone in zones],
            "far": [zone["far"] for zone in zones],
        }
    verdict = said["damage"][0]["verdict"] if said["damage"] else ""
    eye = said["eye"]["distance"] if said["eye"] else None
    return {"limits": found, "verdict": verdict, "eye": eye}


def compared(known: Camera, ours: dict[str, Found], theirs: Found) -> Iterator[Found]:
    """Yield a row for each limit, and one for the eye."""
    for name, own_zones in ours.items():
        said = theirs["limits"].get(name)
        yield {"limit": name} | (
            distances(own_zones, said) if said else {"state": "missing", "false_safe": False}
        )
    unexpected = [
        name for name in theirs["limits"] if name.startswith("damage") and not known.judged
    ]
    yield from (
        {"limit": name, "state": "judged without a law", "false_safe": True} for name in unexpected
    )
    if eye_judged(known) and theirs["eye"]:
        nominal, drawn = (
            float(np.mean(own.eye_distance(known.given))),
            own.eye_distance(known.drawn()),
        )
        interval = intervals(np.ravel(drawn)) if np.size(drawn) > 1 else {}
        yield {"limit": "eye"} | distances(
            {"far": [nominal], "most": 2.0} | interval, {"far": [theirs["eye"]]}
        )


def eye_judged(known: Camera) -> bool:
    """Return True for continuous light and single pulses from 10 ps on that the reference has a
    limit for.
    """
    pulse = known.given.get("duration")
    return known.given["wavelength"] >= 400e-9 and (
        pulse is None or (pulse >= 1e-11 and "rate" not in known.given)
    )


def distances(ours: Found, theirs: Found) -> Found:
    """Return how both far ends agree, those of the last zone, and its near end and interval."""
    far, said = [
        last[-1] if last else 0.0
        for last in (ours["far"], [zone["value"] for zone in theirs["far"]])
    ]
    row: Found = {"ours": ours, "neusee": theirs, "ends": {}}
    if not far or not said:
        clear = bool(far and ours["most"] > 1 + OFF) or bool(said and ours["most"] < 1 / (1 + OFF))
        state = "nowhere" if not far and not said else "off: nowhere" if clear else "undecided"
        return row | {"state": state, "false_safe": state == "off: nowhere" and bool(far)}
    if min(far, said) >= FURTHEST * 0.999 or max(far, said) <= NEAREST * 1.001:
        return row | {"state": "beyond the range", "false_safe": False}
    least, most = (
        min(far * (1 - OFF), ours.get("least_far", far)),
        max(far * (1 + OFF), ours.get("most_far", far)),
    )
    row |= {
        "ratio": said / far,
        "state": "alike" if least <= said <= most else "off: far",
        "false_safe": said < least,
    }
    near, first = ours.get("near"), theirs.get("near")
    if near and first and len(near) == len(first) == 1:
        row["near"] = first[0] / near[0]
    for end in ("low", "high"):
        if end in ours:
            row["ends"][end] = end_agrees(ours[end], theirs["far"][-1][end])
    return row


def end_agrees(expected: list[float], said: float) -> Found:
    """Return the ratio of an end of an interval, and whether the scatter of both samples and 3 %
    explain it.
    """
    middle, least, most = expected
    off = not least * (1 - OFF) <= said <= most * (1 + OFF)
    return {"ratio": said / middle, "off": off, "false_safe": said < least * (1 - OFF)}


def line_of(number: int, folder: Path, draws: int = DRAWS) -> Found:
    """Return everything that is known of one camera."""
    known, start = camera(number), time.process_time()
    ours = reference(known)
    between = time.process_time()
    theirs = judged(known, folder, draws)
    seconds = [between - start, time.process_time() - between]
    line = {
        "number": number,
        "recipe": known.recipe(draws),
        "seconds": seconds,
        "laws": list(known.laws),
    }
    if "refused" in theirs:
        return line | {"refused": theirs["refused"], "rows": []}
    rows = list(compared(known, ours, theirs))
    safe = theirs["verdict"] == "below" and not known.judged
    return line | {"verdict": theirs["verdict"], "unjudged_reads_safe": safe, "rows": rows}


def light_along(known: Camera, folder: Path) -> tuple[Floats, Floats, Floats]:
    """Return the light of the brightest pixel by neusee and by the reference, and the defocus,
    over the distance.
    """
    (folder / "camera.yaml").write_text(known.recipe(DRAWS))
    with mock.patch.object(safety_estimate, "remedies", return_value=()):
        found = safety_estimate.estimate(load("camera.yaml", [], folder))
    finding = next(each for each in found.findings if each.limit.effect != "damage")
    theirs = limit_ratio(found.safety, "plain lens", finding.limit, found.exposures)[0]
    metres = found.exposures.distances
    fill, waves = own.taper_and_defocus(known.given, metres)
    ours = own.saturation_ratio(known.given, metres, spots_of(fill, waves, known.half_pixel, False))
    return np.asarray(theirs), np.asarray(ours), np.abs(waves)


def table(lines: list[Found]) -> str:
    """Return the table of all cameras: by limit how many were compared, and how many are off."""
    counts: dict[str, Counter[str]] = {}
    for line in lines:
        for row in line["rows"]:
            count_row(counts.setdefault(row["limit"], Counter()), row)
    heads: tuple[str, ...] = (
        "compared",
        "nowhere",
        "beyond the range",
        "undecided",
        "missing",
        "off",
        "false-safe",
    )
    heads = (*heads, "near ends", "near off", "ends of intervals", "ends off", "ends false-safe")
    refused = sum("refused" in line for line in lines)
    unjudged = sum(line.get("unjudged_reads_safe", False) for line in lines)
    text = [
        f"{len(lines)} cameras, {refused} refused, {unjudged} without a law that read as safe",
        "",
    ]
    text += ["| limit | " + " | ".join(heads) + " |", "|---" * (len(heads) + 1) + "|"]
    for name, count in sorted(counts.items()):
        text.append(f"| {name} | " + " | ".join(str(count[head]) for head in heads) + " |")
    return "\n".join([*text, "", *details(lines)])


def count_row(count: Counter[str], row: Found) -> None:
    """Add one limit of one camera to the counts."""
    state = cast(str, row["state"])
    found = {
        "compared": state in ("alike", "off: far"),
        "off": state.startswith(("off", "judged")),
        state: True,
    }
    found |= {"false-safe": row["false_safe"]}
    if "near" in row:
        found |= {"near ends": True, "near off": abs(row["near"] - 1) > OFF}
    count.update(name for name, true in found.items() if true)
    for end in row.get("ends", {}).values():
        count.update(
            ["ends of intervals"]
            + ["ends off"] * end["off"]
            + ["ends false-safe"] * end["false_safe"]
        )


def details(lines: list[Found]) -> Iterator[str]:
    """Yield a line for each limit that is off, and for each camera that is refused."""
    for line in lines:
        if "refused" in line:
            yield f"camera {line['number']} refused: {line['refused']}"
        for row in line["rows"]:
            ends = {name: end for name, end in row.get("ends", {}).items() if end["off"]}
            words = [row["state"]] if row["state"].startswith(("off", "judged", "missing")) else []
            words += [f"far {row['ratio']:.3f}"] if row["state"] == "off: far" else []
            words += [f"near {row['near']:.3f}"] if abs(row.get("near", 1) - 1) > OFF else []
            words += [f"{name} end {end['ratio']:.3f}" for name, end in ends.items()]
            words += ["false-safe"] if row["false_safe"] else []
            if words:
                yield f"camera {line['number']} {row['limit']}: {', '.join(words)}"


def main() -> int:
    """Add the cameras that FILE lacks, and print the table; return 1 for a limit that is
    false-safe.
    """
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("file", type=Path)
    parser.add_argument("--first", type=int, default=0)
    parser.add_argument("--count", type=int, default=200)
    asked = parser.parse_args()
    torch.set_num_threads(1)
    asked.file.touch()
    done = {json.loads(text)["number"] for text in asked.file.read_text().splitlines()}
    with tempfile.TemporaryDirectory() as folder:
        for number in range(asked.first, asked.first + asked.count):
            if number not in done:
                line = line_of(number, Path(folder))
                with asked.file.open("a") as file:
                    file.write(json.dumps(line) + "\n")
    lines = [json.loads(text) for text in asked.file.read_text().splitlines()]
    print(table(lines))
    return int(any(row["false_safe"] for line in lines for row in line["rows"]))


if __name__ == "__main__":
    sys.exit(main())
