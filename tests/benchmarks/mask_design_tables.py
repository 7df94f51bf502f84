"""Tables of `bench_mask_design.py` from the file that keeps its designs, and its figure:
`mask_design_tables.py FILE`.

With a second argument the figure is written to that PNG file.
"""

import json
import math
import statistics
import sys
from pathlib import Path

from neusee.workflows.report.figures.style import BLACK, BLUE, GREEN, ORANGE, canvas, drawn

WORDS = {"filter": "mask and filter", "stop": "mask, stop and filter", "alone": "mask alone"}
_AT_LIMIT = 1.0  #: the filter that a mask needs if it keeps the limit alone


def points(found):
    """Designs by way, start, limit and light; the file names them in this order, and the steps
    in the end.
    """
    return {
        (way, start, float(limit), float(light)): point
        for key, point in found.items()
        for way, start, limit, light, _ in [key.split(", ")]
    }


def front(each):
    """A row for each limit and way: the best gain of any start at each light, and the spread
    over random starts.
    """
    lights = sorted({key[3] for key in each})
    lines = [
        "Best gain in dB and its start; mean and standard deviation over random starts (how many):",
        "",
        "| L | way | " + " | ".join(f"{light:g} e-" for light in lights) + " |",
        "|---" * (len(lights) + 2) + "|",
    ]
    for limit in sorted({key[2] for key in each}, reverse=True):
        for way in WORDS:
            cells = [best(each, way, limit, light) for light in lights]
            lines.append(f"| {limit:g} | {WORDS[way]} | " + " | ".join(cells) + " |")
    return "\n".join(lines)


def best(each, way, limit, light):
    """The best gain in dB, the start that gave it, and mean and standard deviation over random
    starts.
    """
    own = {
        key[1]: point["gain"]
        for key, point in each.items()
        if (key[0], *key[2:]) == (way, limit, light)
    }
    if not own:
        return "-"
    name = max(own, key=own.get)
    seeds = [gain for start, gain in own.items() if start.startswith("chance")]
    spread = (
        f"; {statistics.mean(seeds):+.2f} ± {statistics.stdev(seeds):.2f} ({len(seeds)})"
        if len(seeds) > 1
        else ""
    )
    return f"{own[name]:+.2f} {name}{spread}"


def starts(each, way="filter"):
    """A row for each limit and start: the gain at each light."""
    lights = sorted({key[3] for key in each})
    lines = [
        f"Gain by start, {WORDS[way]}:",
        "",
        "| L | start | " + " | ".join(f"{light:g} e-" for light in lights) + " |",
        "|---" * (len(lights) + 2) + "|",
    ]
    for limit in sorted({key[2] for key in each}, reverse=True):
        for start in dict.fromkeys(key[1] for key in each):
            row = [each.get((way, start, limit, light)) for light in lights]
            if not any(row):
                continue
            cells = [f"{point['gain']:+.2f}" if point else "-" for point in row]
            lines.append(f"| {limit:g} | {start} | " + " | ".join(cells) + " |")
    return "\n".join(lines if len(lines) > 4 else [])


def rivals(each):
    """A row for each limit: the error of the best stop in dB, its diameter and its filter, at
    each light.
    """
    lights = sorted({key[3] for key in each})
    lines = [
        "The rival, and its error over the variance of the scene:",
        "",
        "| L | " + " | ".join(f"{light:g} e-" for light in lights) + " |",
        "|---" * (len(lights) + 1) + "|",
    ]
    for limit in sorted({key[2] for key in each}, reverse=True):
        cells = []
        for light in lights:
            point = next((p for key, p in each.items() if key[2:] == (limit, light)), None)
            text = (
                "-"
                if point is None
                else (
                    f"{10 * math.log10(point['rival']):.2f} dB, stop {point['rival stop']:.2f}, "
                    f"filter {point['rival filter']:.2f}"
                )
            )
            cells.append(text)
        lines.append(f"| {limit:g} | " + " | ".join(cells) + " |")
    return "\n".join(lines)


def disagreement(each):
    """The largest difference in dB between the loss and the judge on the same states, and where
    it is.
    """
    apart = {
        key: 10 * math.log10(point["loss as judged"] / point["error"])
        for key, point in each.items()
    }
    key = max(apart, key=lambda one: abs(apart[one]))
    median = statistics.median(abs(x) for x in apart.values())
    way, start, limit, light = key
    where = f"{WORDS[way]} from {start}, L = {limit:g}, {light:g} e-"
    price = [
        10 * math.log10(point["error"]) - 10 / math.log(10) * point["loss"]
        for key, point in each.items()
        if key[0] != "alone"
    ]
    return (
        f"On the same states loss and judge differ by {median:.3f} dB in the median and"
        f" {apart[key]:+.3f} dB at most ({where}). The judge's error is above the loss in the"
        f" nominal state by {statistics.median(price):.2f} dB in the median and {max(price):.2f} dB"
        " at most: the price of what is not known, and of the worst peak."
    )


def reached(each):
    """How many masks that are alone keep the limit, and the filter that the worst of the others
    needs.
    """
    alone = [point for key, point in each.items() if key[0] == "alone"]
    if not alone:
        return "No mask was designed alone."
    kept = sum(point["filter"] >= _AT_LIMIT for point in alone)
    least = min(point["filter"] for point in alone)
    text = f"the others need a filter of {least:.2f} or more"
    return f"{kept} of {len(alone)} masks alone keep the limit in all states; {text}."


def summary(found):
    """All tables as Markdown."""
    each = points(found)
    parts = [
        rivals(each),
        front(each),
        *(starts(each, way) for way in WORDS),
        disagreement(each),
        reached(each),
    ]
    seconds = sum(point["seconds"] for point in each.values())
    return "\n\n".join(
        [*filter(None, parts), f"{len(each)} designs, {seconds:.0f} s of processor time."]
    )


@drawn
def figure(each):
    """The gain over the light of the scene, a panel for each limit: the best of each way, and
    the random starts.
    """
    limits, lights = (
        sorted({key[2] for key in each}, reverse=True),
        sorted({key[3] for key in each}),
    )
    figure, axes = canvas(3.3 * len(limits), 3.4, 1, len(limits), sharey=True)
    for axis, limit in zip(axes[0], limits, strict=True):
        for (way, words), colour, mark in zip(
            WORDS.items(), (BLUE, ORANGE, GREEN), "osD", strict=True
        ):
            gains = {
                light: max(
                    (
                        p["gain"]
                        for key, p in each.items()
                        if (key[0], *key[2:]) == (way, limit, light)
                    ),
                    default=None,
                )
                for light in lights
            }
            there = [light for light in lights if gains[light] is not None]
            axis.semilogx(
                there, [gains[light] for light in there], color=colour, marker=mark, label=words
            )
        random = [
            (key[3], p["gain"])
            for key, p in each.items()
            if key[0] == "filter" and key[1].startswith("chance") and key[2] == limit
        ]
        axis.plot(
            *zip(*random, strict=True),
            color=BLACK,
            marker="x",
            linestyle="none",
            label="random starts, filter",
        )
        axis.axhline(0, color=BLACK, linewidth=0.8)
        axis.set(title=f"peak at most {limit:g}", xlabel="light (e- a pixel)")
    axes[0, 0].set_ylabel("gain over the best stop (dB)")
    figure.legend(*axes[0, 0].get_legend_handles_labels(), loc="outside lower center", ncols=4)
    return figure


if __name__ == "__main__":
    kept = json.loads(Path(sys.argv[1]).read_text())
    print(summary(kept))
    if len(sys.argv) > 2:
        Path(sys.argv[2]).write_bytes(figure(points(kept)))
