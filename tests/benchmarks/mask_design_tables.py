"""Tables of `bench_mask_design.py` from the file that keeps its designs: `mask_design_tables.py FILE`."""

import json
import math
import statistics
import sys
from pathlib import Path

WORDS = {"filter": "mask and filter", "stop": "mask, stop and filter", "alone": "mask alone"}
_AT_LIMIT = 1.0  #: the filter that a mask needs if it keeps the limit alone


def points(found):
    """Designs by way, start, limit and light; the file names them in this order, and the steps in the end."""
    return {(way, start, float(limit), float(light)): point
            for key, point in found.items()
            for way, start, limit, light, _ in [key.split(", ")]}  # fmt: skip


def front(each):
    """A row for each limit and way: the best gain of any start at each light, and the spread over random starts."""
    lights = sorted({key[3] for key in each})
    lines = ["| L | way | " + " | ".join(f"{light:g} e-" for light in lights) + " |", "|---" * (len(lights) + 2) + "|"]
    for limit in sorted({key[2] for key in each}, reverse=True):
        for way in WORDS:
            cells = [best(each, way, limit, light) for light in lights]
            lines.append(f"| {limit:g} | {WORDS[way]} | " + " | ".join(cells) + " |")
    return "\n".join(lines)


def best(each, way, limit, light):
    """The best gain in dB, the start that gave it, and mean and standard deviation over random starts."""
    own = {key[1]: point["gain"] for key, point in each.items() if (key[0], *key[2:]) == (way, limit, light)}
    if not own:
        return "-"
    name = max(own, key=own.get)
    seeds = [gain for start, gain in own.items() if start.startswith("chance")]
    spread = f"; {statistics.mean(seeds):+.2f} ± {statistics.stdev(seeds):.2f}" if len(seeds) > 1 else ""
    return f"{own[name]:+.2f} {name}{spread}"


def starts(each, way="filter"):
    """A row for each limit and start: the gain at each light."""
    lights = sorted({key[3] for key in each})
    lines = [
        "| L | start | " + " | ".join(f"{light:g} e-" for light in lights) + " |",
        "|---" * (len(lights) + 2) + "|",
    ]
    for limit in sorted({key[2] for key in each}, reverse=True):
        for start in dict.fromkeys(key[1] for key in each):
            row = [each.get((way, start, limit, light)) for light in lights]
            cells = [f"{point['gain']:+.2f}" if point else "-" for point in row]
            lines.append(f"| {limit:g} | {start} | " + " | ".join(cells) + " |")
    return "\n".join(lines)


def rivals(each):
    """A row for each limit: the error of the best stop in dB, its diameter and its filter, at each light."""
    lights = sorted({key[3] for key in each})
    lines = ["| L | " + " | ".join(f"{light:g} e-" for light in lights) + " |", "|---" * (len(lights) + 1) + "|"]
    for limit in sorted({key[2] for key in each}, reverse=True):
        cells = []
        for light in lights:
            point = next((p for key, p in each.items() if key[2:] == (limit, light)), None)
            text = "-" if point is None else (
                f"{10 * math.log10(point['rival']):.2f} dB, stop {point['rival stop']:.2f}, "
                f"filter {point['rival filter']:.2f}")  # fmt: skip
            cells.append(text)
        lines.append(f"| {limit:g} | " + " | ".join(cells) + " |")
    return "\n".join(lines)


def disagreement(each):
    """The largest difference in dB between the loss and the judge on the same states, and where it is."""
    apart = {key: 10 * math.log10(point["loss as judged"] / point["error"]) for key, point in each.items()}
    key = max(apart, key=lambda one: abs(apart[one]))
    median = statistics.median(abs(x) for x in apart.values())
    way, start, limit, light = key
    where = f"{WORDS[way]} from {start}, L = {limit:g}, {light:g} e-"
    return f"Loss and judge differ by {median:.3f} dB in the median and {apart[key]:+.3f} dB at most ({where})."


def reached(each):
    """How many masks that are alone keep the limit, and the filter that the worst of the others needs."""
    alone = [point for key, point in each.items() if key[0] == "alone"]
    kept = sum(point["filter"] >= _AT_LIMIT for point in alone)
    least = min((point["filter"] for point in alone), default=1.0)
    text = f"the others need a filter of {least:.2f} or more"
    return f"{kept} of {len(alone)} masks alone keep the limit in all states; {text}."


def summary(found):
    """All tables as Markdown."""
    each = points(found)
    parts = [rivals(each), front(each), *(starts(each, way) for way in WORDS), disagreement(each), reached(each)]
    seconds = sum(point["seconds"] for point in each.values())
    return "\n\n".join([*parts, f"{len(each)} designs, {seconds:.0f} s of processor time."])


if __name__ == "__main__":
    print(summary(json.loads(Path(sys.argv[1]).read_text())))
