"""The Gantt chart: bars where the plan and the run say, and readable with sixty steps."""

from __future__ import annotations

import struct
from itertools import pairwise

import pytest

from neusee.workflows.placement.heft_schedule import Cluster, Device, Task, heft
from neusee.workflows.report.figures import graph_and_timeline
from neusee.workflows.report.figures.graph_and_timeline import timeline
from neusee.workflows.report.figures.style import styled


def planned(count):
    """``count`` tasks in chains of four on two lanes."""
    tasks = [
        Task(
            f"step{i}",
            (f"step{i - 1}",) if i % 4 else (),
            {"cpu": 0.1 * (i % 9 + 1), "cuda:0": 0.1},
        )
        for i in range(count)
    ]
    return heft(tasks, Cluster((Device("cpu"), Device("cuda:0", "cuda"))))


def ran(schedule):
    return [(s.task, s.device, s.start * 1.1, (s.end - s.start) * 1.1) for s in schedule.slots]


@pytest.fixture
def drawn():
    """The figure itself, before it becomes bytes."""

    def drawn(schedule, rows):
        figure = timeline.__wrapped__(schedule=schedule, rows=rows)
        return figure, figure.axes[0], figure.axes[1]

    return drawn


def names(ax):
    return [tick.get_text() for tick in ax.get_yticklabels()]


def bars(ax, filled):
    """(row, from ms, ms) of the bars of the steps, as drawn."""
    found = [p for p in ax.patches if bool(p.get_facecolor()[3]) == filled]
    return sorted(
        (round(p.get_y() + p.get_height() / 2, 6), round(p.get_x(), 6), round(p.get_width(), 6))
        for p in found
    )


def test_each_step_has_the_bar_of_the_plan_and_that_of_the_run(drawn):
    schedule = planned(9)
    _, _, steps = drawn(schedule, ran(schedule))
    row = {name: y for y, name in enumerate(names(steps))}
    slots = [(s.task, s.device, s.start, s.end - s.start) for s in schedule.slots]
    for filled, spans in ((False, slots), (True, ran(schedule))):
        assert bars(steps, filled) == sorted(
            (row[n], round(b * 1e3), round(t * 1e3)) for n, _, b, t in spans
        )
    starts = {s.task: s.start for s in schedule.slots}
    assert [starts[name] for name in row] == sorted(starts.values())


def test_the_lanes_stand_above(drawn):
    schedule = planned(9)
    _, lanes, _ = drawn(schedule, ran(schedule))
    assert names(lanes) == ["cpu", "cuda:0"]
    assert lanes.get_title(loc="left") == "planned 700 ms, took 770 ms"


def test_the_critical_path_is_red(drawn):
    schedule = planned(9)
    _, _, steps = drawn(schedule, [])
    red = {
        t.get_text()
        for t in steps.get_yticklabels()
        if t.get_color() == graph_and_timeline.VERMILION
    }
    assert red == {s.task for s in schedule.critical_path()}


def test_sixty_steps_do_not_overlap(drawn):
    schedule = planned(60)
    figure, _, steps = drawn(schedule, ran(schedule))
    figure.canvas.draw()
    boxes = [t.get_window_extent() for t in steps.get_yticklabels()]
    assert len(boxes) == 60
    assert all(above.y0 >= below.y1 - 1 for above, below in pairwise(boxes))


def test_of_too_many_the_longest_have_a_row(drawn):
    schedule = planned(200)
    _, _, steps = drawn(schedule, ran(schedule))
    assert len(names(steps)) == 80
    assert steps.get_xlabel().endswith("the 120 shortest steps have no row")


@pytest.mark.parametrize("rows", [[], [("other", "mps", 0.0, 1e-5)]])
def test_what_one_side_lacks_is_left_out(rows):
    for count in (0, 3):
        assert timeline(schedule=planned(count), rows=rows)[:8] == b"\x89PNG\r\n\x1a\n"


def test_it_is_a_picture_of_a_fair_size_and_always_the_same():
    short, long = planned(9), planned(60)
    one, other = (timeline(schedule=short, rows=ran(short)) for _ in range(2))
    assert one == other
    width, height = struct.unpack(">II", timeline(schedule=long, rows=ran(long))[16:24])
    assert 900 < width < 1500
    assert 1200 < height < 2500


def test_a_plan_of_some_steps_is_not_taken_for_the_whole(drawn):
    schedule = planned(9)
    rows = [*ran(schedule), ("unknown", "cpu", 0.8, 0.2)]
    _, lanes, _ = drawn(schedule, rows)
    assert lanes.get_title(loc="left") == "planned 700 ms for 9 of 10 steps, took 1 s"


@pytest.mark.parametrize("name", ["i" * 60, "W" * 60, "s"])
def test_names_and_times_stand_beside_the_bars(drawn, name):
    schedule = planned(9)
    rows = [
        (name if n == 4 else step, lane, began, took)
        for n, (step, lane, began, took) in enumerate(ran(schedule))
    ]
    with styled():
        figure, lanes, steps = drawn(schedule, rows)
        figure.canvas.draw()
    inside = steps.get_window_extent()
    assert all(
        label.get_window_extent().x1 < inside.x0
        for label in (*steps.get_yticklabels(), *lanes.get_yticklabels())
    )
    assert all(text.get_window_extent().x0 > inside.x1 for text in steps.texts)
    left = min(label.get_window_extent().x0 for label in steps.get_yticklabels())
    assert left >= 0 or name[0] == "W"
    width = struct.unpack(">I", timeline(schedule=schedule, rows=rows)[16:20])[0]
    assert width >= max(text.get_window_extent().x1 for text in steps.texts) - left
    assert inside.width > 300
    assert max(text.get_window_extent().x1 for text in steps.texts) <= figure.bbox.x1
    title, legend = lanes.get_window_extent(), figure.legends[0].get_window_extent()
    assert legend.y0 > lanes._left_title.get_window_extent().y1 > title.y1
    assert steps.xaxis.label.get_window_extent().y0 >= 0


@pytest.mark.parametrize("count", [1, 9, 60])
def test_lanes_and_steps_do_not_overlap(drawn, count):
    schedule = planned(count)
    figure, lanes, steps = drawn(schedule, ran(schedule))
    figure.canvas.draw()
    head = next(text for text in steps.texts if text.get_text() == "planned → took")
    assert lanes.get_window_extent().y0 > steps.get_window_extent().y1
    assert head.get_window_extent().y1 < lanes.get_window_extent().y1
