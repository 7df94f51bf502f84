"""What a training costs: one night at reduced size, and the paper's protocol on one H100.

    python tests/benchmarks/bench_night.py run FOLDER   # a hundredth of the night, here
    python tests/benchmarks/bench_night.py store FOLDER # its forecast, and the hours of the paper

`run` may be killed and given again: the training goes on from its checkpoint, and the processor
seconds of its iterations so far stand in `FOLDER/seconds.json`. `store` makes a table of them and
of the stored figures of an H200, without any further measurement.
"""

import json
import statistics
import sys
import time
from collections import Counter
from pathlib import Path
from unittest import mock

import torch
from stored_results import store, stored

from neusee.nodes.restore import FFTMamba, start_network
from neusee.workflows import Store, load
from neusee.workflows.training.resumable_loop import TrainingSession, write_whole
from neusee.workflows.training.run_training import train

NAME = "what_a_training_costs"
NIGHT = {1: 3000, 2: 8000}  #: iterations of `train_small` in one night, by stage
HUNDREDTH = 100
PAPER = {1: 10_000, 2: 20_000}  #: iterations of the paper, by stage
BATCH = 8
POOL = 4000  #: pictures of stage 2 that are simulated once, in the third column
#: memory bandwidth of an H200 over that of an H100 SXM (4.8 and 3.35 TB/s, NVIDIA's data sheets)
SLOWEST_H100 = 4.8 / 3.35
BACKWARD = 3.0  #: assumed: forward and backward together, in forwards


# --- a hundredth of the night ---------------------------------------------------------------------


def words():
    lengths = [f"train.stages.{n}.iterations={count // HUNDREDTH}" for n, count in NIGHT.items()]
    return [*lengths, "train.held_out=null"]


def run(folder):
    """Train, and note the processor seconds of each iteration; the first after a start counts the
    preparations, and is left out.
    """
    torch.set_num_threads(1)
    file = folder / "seconds.json"
    seconds = json.loads(file.read_text()) if file.is_file() else {}
    last = {"time": None}

    def watch(stage, done, losses):
        now = time.process_time()
        if last["time"] is not None:
            seconds[f"{stage} {done}"] = now - last["time"]
            write_whole(file, json.dumps(seconds, indent=0).encode())
        last["time"] = time.process_time()

    session = TrainingSession(Store(folder / "cache"), folder / "runs", print, watch=watch)
    train(load("train_small", words()), session)


def night_rows(folder):
    seconds = json.loads((folder / "seconds.json").read_text())
    rows, hours = [], 0.0
    for stage, iterations in NIGHT.items():
        taken = [x for name, x in seconds.items() if name.startswith(f"{stage} ")]
        middle = statistics.median(taken)
        mean = statistics.fmean(taken)
        hours += mean * iterations / 3600
        rows.append(
            [
                str(stage),
                str(len(taken)),
                f"{middle:.2f}",
                f"{mean:.2f}",
                f"{iterations}",
                f"{mean * iterations / 3600:.1f}",
            ]
        )
    return [*rows, ["both", "", "", "", str(sum(NIGHT.values())), f"{hours:.1f}"]]


# --- the paper's protocol -------------------------------------------------------------------------


def scans_of_a_picture(side):
    """Count the scans of the paper's network in one picture of ``side`` pixels by their length; the
    scans themselves are left out.
    """
    lengths = Counter()

    def count(u, *inputs):
        lengths[u.shape[1]] += 1
        return u

    net = start_network(lambda: FFTMamba(64, shuffle=2), torch.Generator().manual_seed(0))
    module = sys.modules[type(net).__module__]
    with mock.patch.object(module, "selective_scan", count), torch.no_grad():
        net.pyramid(torch.rand(1, 3, side, side))
    return lengths


def line_through(table, who):
    """Seconds of a scan by its length, from the two lengths that were measured on the H200."""
    points = [
        (int(row[0].replace(" ", "")), float(row[2].split(" ")[0]) / 1e3)
        for row in table["rows"]
        if row[1] == who
    ]
    (short, t_short), (long, t_long) = points
    slope = (t_long - t_short) / (long - short)
    return lambda length: t_short + slope * (length - short)


def hours_of_the_paper(scan_name, scans, pool=None):
    """Hours of each part of the paper's protocol on the H200, from the stored figures.

    With ``pool`` stage 2 uses as many pictures again and again, and simulates each once.
    """
    scan_table, step_table = stored("on_a_gpu")["tables"]
    step_seconds = {row[0]: float(row[1]) for row in step_table["rows"]}
    scan_seconds = line_through(scan_table, scan_name)
    first = BATCH * PAPER[1]
    second = pool or BATCH * PAPER[2]
    # a batch goes through the network at once behind the fixed mask, picture by picture before
    passes = first + PAPER[2]
    seconds = {
        "lift": step_seconds["lift"] * (first + second),
        "images": step_seconds["images"] * (BACKWARD * first + second),
        "BSR": step_seconds["BSR"] * BACKWARD * first,
        "PSFs": step_seconds["31 PSFs"] * BACKWARD * PAPER[1],
        "scans": passes * sum(count * scan_seconds(length) for length, count in scans.items()),
    }
    return {name: x / 3600 for name, x in seconds.items()}


def paper_rows():
    """Rows of the hours of the paper's protocol, and the counted scans of a picture."""
    scans = scans_of_a_picture(256)
    columns = [
        hours_of_the_paper("our chunks in torch", scans),
        hours_of_the_paper("mambapy", scans),
        hours_of_the_paper("mambapy", scans, POOL),
    ]
    rows = [[name, *(f"{column[name]:.0f}" for column in columns)] for name in columns[0]]
    totals = [sum(column.values()) for column in columns]
    rows.append(["together, H200", *(f"{x:.0f}" for x in totals)])
    rows.append(["together, H100", *(f"{x:.0f} to {x * SLOWEST_H100:.0f}" for x in totals)])
    return rows, scans


def memory_of_the_paper():
    """Return GB of one picture of stage 1: the stored peak at 1024 pixels times four."""
    [table] = stored("learning_memory_of_one_iteration")["tables"]
    [row] = [row for row in table["rows"] if row[:2] == ["1", "1024"]]
    return 4 * float(row[5]) / 1e3


def document(folder):
    rows, scans = paper_rows()
    counted = ", ".join(f"{count} of {length} steps" for length, count in sorted(scans.items()))
    today = time.strftime("%Y-%m-%d")
    return {
        "order": 15,
        "heading": "What a training costs",
        "command": "python tests/benchmarks/bench_night.py run FOLDER, then store FOLDER",
        "machine": "Two shared cores, CPU, one thread",
        "sampling": "",
        "tables": [
            {
                "title": "One night",
                "conditions": f"`neusee train train_small {' '.join(words())}`, a hundredth of the"
                " night: processor seconds of an iteration of two pictures, and the hours of one"
                " core for the whole, by the mean.",
                "date": today,
                "columns": [
                    "stage",
                    "iterations measured",
                    "median s",
                    "mean s",
                    "iterations of the night",
                    "hours",
                ],
                "rows": night_rows(folder),
            },
            {
                "title": "The paper's protocol on one GPU",
                "conditions": "Computed, not run: hours for 10 000 and 20 000 iterations of eight"
                " pictures from the figures of single steps on an H200 (see *On a GPU*). Assumed:"
                f" forward and backward take {BACKWARD:g} forwards where a gradient passes; a scan"
                " takes the time of the line through its two measured lengths, whatever its width;"
                " a batch goes through the network at once in stage 2; an H100 takes 1 to"
                f" {SLOWEST_H100:.2f} times as long, the ratio of the bandwidths. One picture has"
                f" {counted}. *Scan in pairs*: no GPU has measured it; the time is that of mambapy,"
                f" which scans in pairs too. *Pool*: `train.pool={POOL}`, so that stage 2 simulates"
                " as many pictures and no more, which the paper does not. Left out: convolutions of the network, the critics, the"
                f" files. Memory of one picture in stage 1: {memory_of_the_paper():.1f} GB, four"
                " times the stored figure of 1024 pixels.",
                "date": today,
                "columns": [
                    "part",
                    "hours, scan in chunks",
                    "hours, scan in pairs",
                    "hours, scan in pairs, pool",
                ],
                "rows": rows,
            },
        ],
    }


if __name__ == "__main__":
    action, folder = sys.argv[1], Path(sys.argv[2])
    folder.mkdir(parents=True, exist_ok=True)
    if action == "run":
        run(folder)
    else:
        store(NAME, document(folder))
