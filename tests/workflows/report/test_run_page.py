"""The folder of a run and its page: whole or not there, self-contained, and the numbers right."""

from __future__ import annotations

import csv
import json
import re
from dataclasses import replace
from html.parser import HTMLParser

import pytest
import torch

import neusee
from neusee.nodes import Check, node
from neusee.workflows.graph.errors import Location
from neusee.workflows.graph.recipe_graph import Expectation, Recipe, Step
from neusee.workflows.placement.tasks_and_devices import Schedule, Slot
from neusee.workflows.report import run_folder, run_page, run_pictures, run_summary
from neusee.workflows.report.run_folder import find_run, new_run
from neusee.workflows.simulation.simulate_recipe import simulate
from neusee.workflows.store.result_store import Store


def test_a_folder_has_its_name_only_when_it_is_complete(tmp_path):
    with new_run(tmp_path, "first_light", "0123456789") as run:
        run.write("figures/a.png", b"png")
        assert [p.name for p in tmp_path.iterdir() if not p.name.startswith(".")] == []
    assert run.path.name.endswith("_first_light_01234567")
    assert (run.path / "figures" / "a.png").read_bytes() == b"png"
    assert (tmp_path / "latest").resolve() == run.path.resolve()


def test_a_failed_run_leaves_nothing(tmp_path):
    def stopped() -> None:
        with new_run(tmp_path, "x", "0" * 8) as run:
            run.write("half", b"half")
            raise KeyboardInterrupt

    with pytest.raises(KeyboardInterrupt):
        stopped()
    assert list(tmp_path.iterdir()) == []


def test_nothing_is_overwritten_and_latest_follows(tmp_path):
    names = []
    for content in ("first", "second", "third"):
        with new_run(tmp_path, "x", "0" * 8) as run:
            run.write("it", content)
        names.append(run.path.name)
    assert [n[len(names[0]) :] for n in names] == ["", "_2", "_3"]
    assert (tmp_path / names[0] / "it").read_text() == "first"
    assert (tmp_path / "latest" / "it").read_text() == "third"


def test_latest_is_a_file_where_links_fail(tmp_path, monkeypatch):
    def refuse(self, *args, **kwargs):
        raise OSError("no links here")

    monkeypatch.setattr(run_folder.Path, "symlink_to", refuse)
    with new_run(tmp_path, "x", "0" * 8) as run:
        run.write("provenance.json", "{}")
    assert (tmp_path / "latest").read_text().strip() == run.path.name
    assert find_run("latest", tmp_path) == tmp_path / run.path.name


def test_a_run_that_is_not_there_is_said_to_be_missing(tmp_path):
    with pytest.raises(FileNotFoundError, match="no run at nowhere"):
        find_run("nowhere", tmp_path)


@node()
def number(*, value: float) -> torch.Tensor:
    """Give a number.

    Units: result DN.
    """
    return torch.tensor([value, 2 * value], dtype=torch.float64)


@number.check
def _(result, *, value):
    return [Check("not negative", value >= 0)]


@node()
def doubled(x: torch.Tensor) -> torch.Tensor:
    """Double it. Units: DN."""
    return 2 * x


def recipe(value: float = 3.0, promised: float = 6.0) -> Recipe:
    mark = Location("<script>.yaml", 3, 1)
    steps = {
        "number": Step("number", number, {"value": value}, {}, mark, {}),
        "truth": Step("truth", doubled, {}, {"x": "number"}, mark, {}),
    }
    expect = (Expectation("twice & more", "truth", (0,), promised, 0.01, mark),)
    return Recipe(
        "small", "A <b>small</b> recipe.", 5, 1e-3, ("truth",), steps, expect, notes=("a < b",)
    )


@pytest.fixture
def done(tmp_path):
    return simulate(
        recipe(), Store(tmp_path / "cache"), tmp_path / "runs", ["neusee", "run", "small", "a=1 m"]
    )


class Reader(HTMLParser):
    """Checks that every tag is closed, and collects what the page would fetch."""

    VOID = frozenset({"meta", "img", "br", "link", "input", "wbr"})

    def __init__(self) -> None:
        super().__init__()
        self.open, self.fetched, self.ids, self.links = [], [], set(), set()

    def handle_starttag(self, tag, attrs):
        given = dict(attrs)
        self.fetched += [given[k] for k in ("src", "srcset", "data") if k in given]
        if tag in ("script", "link", "iframe"):
            self.fetched.append(tag)
        if tag == "img":
            assert given.get("alt")
        self.ids.add(given.get("id"))
        if tag == "a":
            self.links.add(given["href"].removeprefix("#"))
        if tag not in self.VOID:
            self.open.append(tag)

    def handle_endtag(self, tag):
        assert self.open.pop() == tag


def test_the_page_is_one_file_that_fetches_nothing(done):
    text = done.page.read_text()
    reader = Reader()
    reader.feed(text)
    assert reader.open == []
    assert reader.fetched
    assert all(f.startswith("data:image/png;base64,") for f in reader.fetched)
    assert reader.links <= reader.ids
    assert "http" not in re.sub(r"base64,[^\"]+", "", text)
    assert "url(" not in text
    assert "A &lt;b&gt;small&lt;/b&gt; recipe." in text
    assert "a &lt; b" in text


def test_the_page_reads_on_paper_and_on_a_telephone(done):
    text = done.page.read_text()
    assert "@media print" in text
    assert 'name="viewport"' in text
    assert "overflow-x: auto" in text


class Tables(HTMLParser):
    """Collects for each table the classes of the elements around it."""

    def __init__(self) -> None:
        super().__init__()
        self.around: list[list[str]] = []
        self.open: list[str] = []

    def handle_starttag(self, tag, attrs):
        if tag == "table":
            self.around.append(list(self.open))
        if tag not in Reader.VOID:
            self.open.append(dict(attrs).get("class") or "")

    def handle_endtag(self, tag):
        self.open.pop()


def test_every_table_scrolls_within_its_box(done):
    tables = Tables()
    tables.feed(done.page.read_text())
    assert len(tables.around) == 4
    assert all("scroll" in around for around in tables.around)


def test_sentences_have_room_beside_wide_columns_and_show_no_backticks(done):
    doc = {**done.document, "readings": [{"name": "a", "value": "b", "state": "c", "matter": "of `d`", "number": "C1",
                                          "reason": "`e` < f"}]}  # fmt: skip
    text = run_folder.page(doc, {})
    assert '<th class="why">contradiction in the paper</th><th class="why">why</th>' in text
    assert re.search(r"\.why \{ min-width: \d+rem; \}", text)
    assert "<td>of <code>d</code> (C1)</td><td><code>e</code> &lt; f</td>" in text


def test_a_section_without_a_figure_is_left_out_and_its_reason_is_a_note(done):
    text = done.page.read_text()
    headings = re.findall(r'<h2 id="([a-z-]+)">', text)
    assert headings == [
        "results",
        "notes",
        "left-out",
        "graph",
        "time",
        "steps",
        "provenance",
        "again",
    ]
    assert re.findall(r'<a href="#([a-z-]+)">', text) == headings
    (line,) = re.findall(r"<li>Not drawn: (.*)</li>", text)
    assert "Point-spread functions (the recipe has no step" in line
    assert "raw_mask.png" not in line


def test_a_reason_and_a_check_share_a_column_that_wraps(done):
    step = {
        **done.document["steps"][0],
        "state": "left out",
        "why": "changes at most 0",
        "checks": [{"text": "a < b", "ok": True}],
    }
    text = run_folder.page({**done.document, "steps": [step]}, {})
    assert (
        '<td class="check"><span class="soft">changes at most 0</span>; <span>a &lt; b</span></td>'
        in text
    )
    assert "nowrap" not in re.search(r"td\.check \{(.*?)\}", text)[1]


def test_a_short_time_is_not_shown_as_none(done):
    steps = [{**done.document["steps"][0], "made_in": seconds} for seconds in (0.0004, 0.0006, 0.0)]
    text = run_folder.page({**done.document, "steps": steps}, {})
    cells = re.findall(r"</td><td class=\"n\">(&lt; 0.001|[\d.]+)(?:<br>.*?)?</td><td>2 DN", text)
    assert cells == ["&lt; 0.001", "0.001", "0.000"]


def test_a_truth_value_is_written_as_a_recipe_writes_it():
    assert [run_page._written(value) for value in (True, False, "once", 0.1)] == [
        "true",
        "false",
        "once",
        "0.1",
    ]


def _luminance(colour: str) -> float:
    channels = [int(colour[i : i + 2], 16) / 255 for i in (1, 3, 5)]
    linear = [c / 12.92 if c <= 0.04045 else ((c + 0.055) / 1.055) ** 2.4 for c in channels]
    return sum(w * c for w, c in zip((0.2126, 0.7152, 0.0722), linear, strict=True))


def test_text_stands_out_from_its_ground(done):
    blocks = re.findall(r":root \{(.*?)\}", done.page.read_text(), re.S)
    assert len(blocks) == 2  # light and dark
    pairs = [
        ("ink", "paper"),
        ("link", "paper"),
        ("soft", "paper"),
        ("good-ink", "good"),
        ("bad-ink", "bad"),
        ("bad-ink", "paper"),
        ("watch-ink", "watch"),
    ]
    for colours in (dict(re.findall(r"--([\w-]+): (#\w{6})", block)) for block in blocks):
        for ink, ground in pairs:
            light, dark = sorted(
                (_luminance(colours[ink]), _luminance(colours[ground])), reverse=True
            )
            assert (light + 0.05) / (dark + 0.05) >= (7 if ink != "link" else 4.5), (ink, ground)


def test_the_folder_holds_what_the_page_says(done):
    names = {p.relative_to(done.folder).as_posix() for p in done.folder.rglob("*") if p.is_file()}
    assert {"report.html", "recipe.yaml", "provenance.json", "metrics.csv", "timing.csv"} <= names
    assert {"figures/graph.png", "figures/timeline.png", "data/outputs.safetensors"} <= names
    doc = json.loads((done.folder / "provenance.json").read_text())
    assert {f["file"] for f in doc["figures"]} == {n for n in names if n.startswith("figures/")}
    assert doc["command"] == "neusee run small 'a=1 m'"
    assert doc["seed"] == 5
    assert {s["step"]: s["state"] for s in doc["steps"]} == {"number": "run", "truth": "run"}
    assert all(len(s["key"]) == 32 for s in doc["steps"])
    rows = list(csv.DictReader((done.folder / "timing.csv").read_text().splitlines()))
    assert [r["step"] for r in rows] == ["number", "truth"]
    missing = {m["name"] for m in doc["missing"]}
    assert {"overview", "psf", "raw_mask.png"} <= missing


def test_outputs_read_back_as_they_are(done):
    from safetensors.torch import load_file

    tensors = load_file(done.folder / "data" / "outputs.safetensors")
    assert torch.equal(tensors["truth"], torch.tensor([6.0, 12.0], dtype=torch.float64))


@pytest.mark.parametrize(
    ("promised", "met"), [(6.0, True), (6.05, True), (6.1, False), (-6.0, False)]
)
def test_expected_numbers_are_met_or_missed(promised, met):
    rows = run_summary.expected(recipe(promised=promised), lambda step: torch.tensor([6.0, 12.0]))
    assert [r["ok"] for r in rows] == [met]


def test_a_number_that_is_none_is_missed():
    rows = run_summary.expected(
        recipe(promised=6.0), lambda step: torch.tensor([float("nan"), 12.0])
    )
    assert not rows[0]["ok"]


def test_a_missed_number_and_a_failed_check_stand_first(tmp_path):
    done = simulate(recipe(-3.0, 6.0), Store(tmp_path / "c"), tmp_path / "runs", ["neusee", "run"])
    assert done.document["missed"] == ["twice & more"]
    assert done.document["failed"] == ["number: not negative"]
    text = done.page.read_text()
    assert 'class="verdict bad"' in text
    assert text.index("twice &amp; more") < text.index('id="results"')


def test_the_page_can_be_written_again_from_what_is_stored(done):
    before = done.page.read_bytes()
    done.page.unlink()
    assert run_folder.rebuild(done.folder).read_bytes() == before


def test_a_second_run_reads_the_same_numbers_and_says_where_they_come_from(done, tmp_path):
    again = simulate(recipe(), Store(tmp_path / "cache"), tmp_path / "runs", ["neusee", "run"])
    assert again.document["table"] == done.document["table"]
    assert again.document["expected"] == done.document["expected"]
    steps = {s["step"]: s for s in again.document["steps"]}
    assert (steps["truth"]["state"], steps["number"]["state"]) == ("cached", "not needed")
    assert "made" in steps["number"]["why"]
    assert steps["number"]["shape"] == "2"
    assert steps["number"]["unit"] == "DN"
    first, second = (f / "figures" / "graph.png" for f in (done.folder, again.folder))
    assert first.read_bytes() != second.read_bytes()


@pytest.mark.parametrize(
    ("line", "unit"),
    [
        ("Units:  electrons e-; gain e-/DN; result DN in [0, 1].", "DN"),
        ("Units:  m.", "m"),
        ("Units:  result W/m2 per unit of the image.", "W/m2"),
        ("Units:  height m; defocus waves.", ""),
        ("Units:  none; 1 for the clear lens.", ""),
        ("", ""),
    ],
)
def test_the_unit_of_a_result_is_read_from_the_docstring(line, unit):
    assert run_page.unit_of(f"Say.\n\n    {line}\n") == unit


# --- time -----------------------------------------------------------------------------------------


def row(step, state="run", seconds=0.0, began=0.0, predicted=None, key=None, **more):
    made = {"made_in": seconds, "bytes": 1000, "kept": True}
    return {
        "step": step,
        "state": state,
        "seconds": seconds,
        "began": began,
        "predicted": predicted,
    } | {
        "key": key or step,
        **made,
        **more,
    }


def test_time_is_added_up_with_each_key_once():
    rows = [
        row("a", "not needed", 3.0),
        row("b", "cached", 5.0, bytes=400),
        row("twin of b", "cached", 5.0, key="b", bytes=400),
        row("c", "left out", 9.0),
        row("d", "run", 1.0, began=0.5, predicted=1.5),
        row("e", "run", 2.0, began=0.75, kept=False),
        row("twin of e", "cached", 2.0, key="e"),
    ]
    found = run_page.timing(rows, planned=2.5)
    assert (found["ran"], found["served"], found["steps"], found["told"]) == (2, 4, 7, 1)
    assert (found["seconds"], found["span"], found["planned"]) == (3.0, 2.25, 2.5)
    assert (found["predicted"], found["actual"]) == (1.5, 1.0)
    assert (found["saved"], found["share"]) == (8.0, 8 / 11)
    assert (found["read"], found["written"]) == (400, 1000)
    assert run_page.said_of(found) == [
        "2 of 7 steps ran: 3 s of computing time.",
        "Predicted for the 1 whose time was no guess: 1.5 s; actual: 1 s.",
        "Planned duration, with parallel branches: 2.5 s; actual: 2.25 s.",
        "The cache served 4 steps and saved 8 s, 72.7 % of all computing time.",
        "Read from the cache: 400 B; written to it: 1 kB.",
    ]


def test_a_result_that_is_read_counts_before_the_same_one_asleep():
    rows = [row("a", "not needed", 3.0, key="k"), row("b", "cached", 3.0, key="k", bytes=70)]
    found = run_page.timing(rows)
    assert (found["read"], found["saved"], found["share"], found["planned"]) == (70, 3.0, 1.0, None)


def test_the_page_says_what_the_cache_saved(done, tmp_path):
    assert done.document["timing"]["ran"] == 2
    assert "2 of 2 steps ran" in done.page.read_text()
    again = simulate(recipe(), Store(tmp_path / "cache"), tmp_path / "runs", ["neusee", "run"])
    took = sum(s["seconds"] for s in done.document["steps"])
    assert again.document["timing"]["saved"] == pytest.approx(took)
    assert again.document["timing"]["share"] == 1.0
    assert "The cache served 2 steps and saved" in again.page.read_text()


def test_the_plan_is_compared_where_all_that_ran_was_known(tmp_path):
    result = neusee.run(recipe(), store=Store(tmp_path / "cache"))
    slots = (Slot("number", "cpu", 0.0, 1.0), Slot("truth", "cpu", 1.0, 3.0))
    known = {name: replace(done, predicted=1.5) for name, done in result.done.items()}

    def planned(done, slots):
        told = replace(result, done=done, schedule=Schedule(slots, 3.0, {"cpu": 0.0}, 0.0))
        return run_page.document(told, [])["timing"]["planned"]

    assert planned(known, slots) == 3.0
    assert planned(known, slots[:1]) is None
    assert planned({**known, "truth": replace(known["truth"], predicted=None)}, slots) is None


def test_a_page_of_before_there_was_an_account_of_time_is_still_written(done):
    path = done.folder / "provenance.json"
    doc = json.loads(path.read_text())
    del doc["timing"]
    doc["steps"] = [{k: v for k, v in s.items() if k != "predicted"} for s in doc["steps"]]
    path.write_text(json.dumps(doc))
    page = run_folder.rebuild(done.folder)
    assert "Time" in page.read_text()
    (entry,) = [
        e
        for e in json.loads((done.folder / "ro-crate-metadata.json").read_text())["@graph"]
        if e["@id"] == "report.html"
    ]
    assert entry["contentSize"] == str(page.stat().st_size)


def test_the_page_shows_what_each_step_was_expected_to_take(done):
    text = done.page.read_text()
    assert text.count(" expected</span>") == sum(
        s["predicted"] is not None for s in done.document["steps"]
    )
    doc = dict(done.document)
    doc["steps"] = [{**s, "predicted": 1.25} for s in doc["steps"]]
    assert run_folder.page(doc, {}).count("1.250 expected</span>") == 2


def test_every_row_of_the_page_has_a_cell_for_each_column(done):
    for body in re.findall(r"<table.*?</table>", done.page.read_text(), re.DOTALL):
        counts = [
            len(re.findall(r"<t[hd][ >]", row))
            for row in re.findall(r"<tr>.*?</tr>", body, re.DOTALL)
        ]
        assert len(set(counts)) <= 1, body[:200]


def test_the_run_is_drawn_over_time_unless_nothing_ran(done, tmp_path):
    assert "data:image/png" in done.page.read_text().split('id="time"')[1].split('id="steps"')[0]
    again = simulate(recipe(), Store(tmp_path / "cache"), tmp_path / "runs", ["neusee", "run"])
    assert not (again.folder / "figures" / "timeline.png").exists()
    assert (
        "data:image/png" not in again.page.read_text().split('id="time"')[1].split('id="steps"')[0]
    )
    assert "timeline" not in {f["name"] for f in again.document["figures"]}


def test_only_what_was_known_is_drawn_as_the_plan(tmp_path):
    result = neusee.run(recipe(), store=Store(tmp_path / "cache"))
    told = {
        "number": replace(
            result.done["number"], predicted=1.0, began=5.0, seconds=2.0, lane="cpu:1"
        ),
        "truth": replace(
            result.done["truth"], predicted=None, began=7.0, seconds=1.0, lane="cpu:1"
        ),
    }
    plan = Schedule(
        (Slot("number", "cpu:1", 0.0, 1.0), Slot("truth", "cpu:1", 1.0, 99.0)),
        99.0,
        {"cpu:1": 0.0},
        0.0,
    )
    seen = run_pictures.timeline(replace(result, done=told, schedule=plan))
    assert seen["rows"] == [("number", "cpu:1", 0.0, 2.0), ("truth", "cpu:1", 2.0, 1.0)]
    assert [slot.task for slot in seen["schedule"].slots] == ["number"]
    told = {name: replace(done, predicted=1.5) for name, done in told.items()}
    seen = run_pictures.timeline(
        replace(result, done=told, schedule=replace(plan, slots=plan.slots[:1]))
    )
    assert [(s.task, s.device, s.start, s.end, s.after) for s in seen["schedule"].slots] == [
        ("number", "cpu:1", 0.0, 1.5, ""),
        ("truth", "cpu:1", 1.5, 3.0, "number"),
    ]
    assert run_pictures.timeline(replace(result, schedule=None))["schedule"].slots == ()
    assert run_pictures.timeline(replace(result, done={})) is None


def test_a_guess_leaves_no_gap_in_the_plan_that_is_drawn(tmp_path):
    result = neusee.run(recipe(), store=Store(tmp_path / "cache"))
    told = {
        "number": replace(
            result.done["number"], predicted=None, began=5.0, seconds=2.0, lane="cpu"
        ),
        "truth": replace(result.done["truth"], predicted=1.0, began=7.0, seconds=1.0, lane="cpu"),
    }
    plan = Schedule(
        (Slot("number", "cpu", 0.0, 99.0), Slot("truth", "cpu", 99.0, 100.0)),
        100.0,
        {"cpu": 0.0},
        0.0,
    )
    seen = run_pictures.timeline(replace(result, done=told, schedule=plan))
    assert [(s.task, s.start, s.end) for s in seen["schedule"].slots] == [("truth", 0.0, 1.0)]
