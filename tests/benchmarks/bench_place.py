"""How good and how fast the scheduler is: `python tests/benchmarks/bench_place.py [GRAPHS]`.

Prints tables in Markdown: HEFT and CPOP over the exact optimum on random layered graphs, the memory
that a refusal asks for over the least of all orders, and the time to place ten thousand tasks.
"""

import importlib
import math
import random
import sys
import time
from dataclasses import replace
from pathlib import Path
from statistics import mean

from neusee.workflows.placement.heft_schedule import Cluster, Device, Task, TooLarge, heft

sys.path.insert(0, str(Path(__file__).parents[1] / "workflows"))
plans, cpop = importlib.import_module("plans"), importlib.import_module("cpop")


def quality(graphs: int) -> None:
    print(
        f"| {graphs} graphs each, 3 devices | HEFT / optimum: mean, worst | CPOP: mean, worst |"
        " HEFT is optimal |"
    )
    print("|---|---|---|---|")
    for count in (8, 9, 10):
        for talk in (0.3, 1.0, 3.0):
            ratios = [against_optimum(seed, count, talk) for seed in range(graphs)]
            ours, other = zip(*ratios, strict=True)
            best = sum(ratio < 1 + 1e-6 for ratio in ours) / graphs
            row = (
                f"{mean(ours):.3f}, {max(ours):.3f} | {mean(other):.3f}, {max(other):.3f} |"
                f" {best:.0%}"
            )
            print(f"| {count} tasks, an edge costs {talk:g} of a task | {row} |", flush=True)


def against_optimum(seed: int, count: int, talk: float) -> tuple[float, float]:
    tasks, cluster = plans.layered(seed, count, talk=talk)
    ours = heft(tasks, cluster).makespan
    other = max(end for _, _, end in cpop.cpop(tasks, cluster).values())
    best = plans.Exact(tasks, cluster, min(ours, other)).best
    return ours / best, other / best


def memory(graphs: int) -> None:
    ratios = []
    for seed in range(graphs):
        tasks, _, keep = plans.crowded(seed)
        tasks = [replace(t, seconds={"cpu": 1.0}) for t in tasks]
        try:
            heft(tasks, Cluster((Device("cpu", memory=-1.0),)), keep)
        except TooLarge as error:
            ratios.append(error.needed / max(plans.least_memory(tasks, keep), 1.0))
    least = sum(ratio == 1 for ratio in ratios) / graphs
    print(
        "\n| memory that a refusal asks for, over the least of all orders | mean | worst | least of"
        " all |"
    )
    print("|---|---|---|---|")
    row = f"{mean(ratios):.3f} | {max(ratios):.3f} | {least:.0%}"
    print(f"| {graphs} random graphs of 4 to 16 tasks, one device | {row} |")


def long_plan(count: int, devices: int, limit: float) -> tuple[list[Task], Cluster]:
    """Tasks that read one to three of the last sixty."""
    dice, names = random.Random(1), [f"d{k}" for k in range(devices)]
    tasks = []
    for i in range(count):
        sources = (
            tuple({f"t{dice.randrange(max(0, i - 60), i)}" for _ in range(dice.randint(1, 3))})
            if i
            else ()
        )
        seconds = {d: dice.uniform(0.1, 3.0) for d in names}
        tasks.append(
            Task(
                f"t{i}",
                sources,
                seconds,
                dice.randint(1, 100) * 1e6,
                dice.randint(1, 300) * 1e6,
                31,
            )
        )
    return tasks, Cluster(tuple(Device(d, memory=limit) for d in names))


def speed(count: int) -> None:
    print(f"\n| {count} tasks | time to place | makespan | most memory | cut into parts |")
    print("|---|---|---|---|---|")
    for devices, limit in (
        (1, math.inf),
        (1, 3e9),
        (2, math.inf),
        (9, math.inf),
        (9, 3e9),
        (9, 1e9),
    ):
        tasks, cluster = long_plan(count, devices, limit)
        began = time.process_time()
        schedule = heft(tasks, cluster)
        took = time.process_time() - began
        cut, most = (
            sum(slot.parts > 1 for slot in schedule.slots),
            max(schedule.peak.values()) / 1e9,
        )
        what = f"{devices} of {limit / 1e9:g} GB" if limit < math.inf else f"{devices}, no limit"
        print(
            f"| devices: {what} | {took:.2f} s | {schedule.makespan:.0f} s | {most:.2f} GB |"
            f" {cut} |",
            flush=True,
        )


if __name__ == "__main__":
    graphs = int(sys.argv[1]) if len(sys.argv) > 1 else 40
    quality(graphs)
    memory(10 * graphs)
    speed(10_000)
