"""Every command and every block of the README and the guide runs: as it stands, or as a stand-in
that says why.
"""

from __future__ import annotations

import importlib
import os
import re
import shlex
import shutil
import subprocess
import tomllib
import zlib
from functools import partial
from pathlib import Path

import numpy as np
import pytest
from kornia_rs.io import read_image_png_u16
from PIL import Image

from neusee.workflows.cli import app
from neusee.workflows.cli.handbook_reference import reference_pages
from neusee.workflows.handbook import site_build as command_pictures
from neusee.workflows.handbook.site_build import build_handbook, pictures_of, read_pages
from neusee.workflows.keys.cache_key import digest
from neusee.workflows.recipe import node_families
from neusee.workflows.report import files_beside as graph_ahead
from neusee.workflows.report import run_pictures
from neusee.workflows.report.figures import style
from neusee.workflows.report.run_pictures import graphs
from neusee.workflows.simulation import simulate_recipe
from tests.guide_commands import (
    GUIDE,
    OTHER_LINES,
    ROOT,
    WRITTEN,
    blocks,
    cases,
    forgotten_modules,
    import_or_skip,
    indented,
    lines,
    named_files,
    write_reader_files,
)
from tests.guide_machines import scheduler, together
from tests.guide_stand_ins import (
    LABORATORY,
    LIGHT,
    SMALL_OPTIONS,
    STAND_INS,
    NotDeclared,
    StandIn,
    stand_in,
    typed,
)

pytestmark = pytest.mark.filterwarnings("ignore::DeprecationWarning:typer")

#: figures of a run that a page shows, by the words of the command; a test draws no others
SHOWN: dict[tuple[str, ...], set[str]] = {}
for _text in read_pages().values():
    for _picture in pictures_of(_text):
        SHOWN.setdefault(_picture.words, set()).add(Path(_picture.file).stem)


@pytest.fixture(scope="module")
def place(tmp_path_factory):
    """A folder with the reader's files, small options of the packaged groups, and one cache for
    all commands.
    """
    place = tmp_path_factory.mktemp("guide")
    write_reader_files(place)
    Image.new("L", (2, 2)).save(place / "no_graph.png")
    for name, text in SMALL_OPTIONS.items():
        for folder, options in (
            ("options", text),
            ("all_bands", re.sub(", bands: [0-9]+", "", text)),
        ):
            path = place / folder / f"{name}.yaml"
            path.parent.mkdir(parents=True, exist_ok=True)
            path.write_text(
                f"# A small stand-in.\ndefaults: [{path.stem}]\n{options}\n", encoding="utf-8"
            )
    return place


def small_png(figure) -> bytes:
    """Return a figure as a small PNG without the search for a layout, which takes most of the
    time.
    """
    from io import BytesIO

    figure.set_layout_engine("none")
    out = BytesIO()
    figure.savefig(out, format="png", dpi=20)
    return out.getvalue()


@pytest.fixture
def reader(place, monkeypatch, tmp_path):
    """Stand in the folder of the reader, and forget afterwards which modules the commands
    imported from there.
    """
    monkeypatch.chdir(place)
    monkeypatch.setenv("NEUSEE_CACHE", str(place / "cache"))
    monkeypatch.setattr(style, "png_of", small_png)
    with forgotten_modules(place, tmp_path):
        yield place


def carry_out(words: str, place: Path, monkeypatch) -> None:
    """Run a command of a page, or its stand-in, and ask for exit code 0; draw no figures that no
    page shows.
    """
    found, own = stand_in(words, place), tuple(typed(words, None))
    asked = SHOWN.get(own, set())
    with monkeypatch.context() as patch, scheduler(found) as address:
        if found:
            patch.setenv("NEUSEE_RECIPES", str(place / "options"))
        for name, value in (found.constants if found else {}).items():
            module, _, attribute = name.partition(":")
            patch.setattr(importlib.import_module(f"neusee.workflows.{module}"), attribute, value)
        patch.setattr(simulate_recipe, "timeline", lambda result: None)  # no page shows it
        patch.setattr(run_pictures, "FIGURES", [f for f in run_pictures.FIGURES if f.name in asked])
        if "graph" not in asked:
            for module in (run_pictures, simulate_recipe, graph_ahead):
                patch.setattr(module, "GRAPH_DRAWING", partial(no_picture, place))
                patch.setattr(module, "graphs", other_graphs)
        arguments = [address if word == "LOCAL" else word for word in typed(words, found)]
        if found and found.processes > 1:
            return together(arguments, found.processes)
        with pytest.raises(SystemExit) as end:
            app.main([*arguments, *(["--out", str(shown_by(own, place))] if asked else [])])
        assert end.value.code == (found.code if found else 0)
    return None


def no_picture(place: Path, file: Path, **_) -> None:
    """Write a picture of nothing, where no page shows it."""
    shutil.copy(place / "no_graph.png", file)


def other_graphs(recipe, states) -> list:
    """Return the graphs of a run under keys of their own, so that a page that shows one finds no
    picture of nothing.
    """
    return [(digest("no picture", key), arguments) for key, arguments in graphs(recipe, states)]


def shown_by(words: tuple[str, ...], place: Path) -> Path:
    """Return the folder for the results of a command whose pictures a page shows."""
    return place / "shown" / f"{zlib.crc32(repr(words).encode()):x}"


def write_frame(place: Path, monkeypatch) -> None:
    """Run the command of the page that takes a frame, and let the next commands find it in the
    folder `runs`.
    """
    words = 'run half_ring "outputs=[raw]"'
    carry_out(words, place, monkeypatch)
    taken, latest = shown_by(tuple(typed(words, None)), place) / "latest", place / "runs" / "latest"
    latest.parent.mkdir(exist_ok=True)
    latest.unlink(missing_ok=True)
    latest.symlink_to(taken.resolve())
    shutil.copy(taken / "data" / "raw_mask.png", place / "shot.png")


ALONE = {"handbook"}  #: its test is that of the whole site


def run_here(page):
    """Return the commands of a page that a test of this file runs one by one."""
    return [words for words in lines(page) if words not in ALONE]


def timed(found):
    """Return test cases of which those that compute more than a plan are marked slow: the site
    shows their pictures, and finds them there.
    """
    quick = {*LIGHT} - {"compare", "handbook"}
    return [
        pytest.param(
            *case.values,
            id=case.id,
            marks=[] if case.values[0].split()[0] in quick else [pytest.mark.slow],
        )
        for case in found
    ]


#: the measured sensor comes first, so that the commands that take it find it
COMMANDS = sorted(cases(run_here), key=lambda case: case.values[0] != LABORATORY)


@pytest.mark.slow
@pytest.mark.parametrize("words", timed(COMMANDS))
def test_every_command_runs(words, place, reader, tmp_path, monkeypatch, capfd):
    if words.split()[0] in ("new", "init", "check"):
        shutil.copytree(place / "my", tmp_path / "my")
        shutil.copytree(place / "mylab", tmp_path / "mylab") if words.startswith("check") else None
        monkeypatch.chdir(tmp_path)
        monkeypatch.syspath_prepend(str(tmp_path))  # as if the package were installed
        # checked is what `neusee new` writes
        if words in ("check bloom.py", "check mylab.optics --json"):
            carry_out("new node bloom", place, monkeypatch)
            shutil.copy("bloom.py", tmp_path / "mylab" / "optics.py")
    if words.startswith("compare"):
        # as it stands, in the folder `runs`
        carry_out("run first_light seed=7", place, monkeypatch)
        for name in set(re.findall(r"runs/\w+|\d{4}-\w+-\w+", words)):
            shutil.copytree((place / "runs" / "latest").resolve(), place / "runs" / Path(name).name)
    if words == "train train_demonstration --stage 2":
        carry_out("train train_demonstration --stage mask", place, monkeypatch)
    if words.startswith("restore"):
        write_frame(place, monkeypatch)
    if "sensor=lab" in words and "posterior:" not in Path("sensor/lab.yaml").read_text():
        carry_out(LABORATORY, place, monkeypatch)
    carry_out(words, place, monkeypatch)
    assert capfd.readouterr().out


# --- nothing is left out --------------------------------------------------------------------------

#: has a test of its own, because a file of torch.export takes seconds to write
EXPORTED = "my/restore/exported.yaml"
SPOKEN = [words for page in WRITTEN for words in lines(page)]


def test_every_indented_line_is_a_command_or_says_who_runs_it():
    there = [line for page in WRITTEN for line in indented(page)]
    commands = sum(len(lines(page)) for page in WRITTEN)
    others = [line for line in there if line in OTHER_LINES]
    assert len(there) == commands + len(others) > 150
    assert set(OTHER_LINES) == set(others)


def test_every_command_is_run_as_it_stands_or_with_its_stand_in(place):
    cased = {case.values[0] for case in COMMANDS}
    assert cased | ALONE == set(SPOKEN)
    found = {words: stand_in(words, place) for words in cased}
    assert all(each is None or each.why for each in found.values())
    assert all(typed(words, each) for words, each in found.items())
    assert set(STAND_INS) <= cased


@pytest.mark.parametrize(
    "words", ["train new", "evaluate first_light", "study stability", "calibrate my/frames.yaml"]
)
def test_a_large_command_without_a_stand_in_is_refused(words, place):
    with pytest.raises(NotDeclared, match=f"neusee {words}: say in STAND_INS how"):
        stand_in(words, place)


def test_a_word_that_a_stand_in_replaces_stands_in_the_command():
    with pytest.raises(AssertionError, match="no word"):
        typed("run first_light --scenes 3", StandIn("a minute", instead={"20": "1"}))


def test_every_file_of_the_reader_is_used_by_a_command_or_by_another_file():
    files = dict(named_files())
    texts = "\n".join(
        [
            *SPOKEN,
            *files.values(),
            *(each.values[0] for each in cases(lambda page: blocks(page, "python"))),
        ]
    )
    for path, text in files.items():
        rest = texts.replace(text, "")
        name = Path(path)
        by_option = re.search(rf"\b{name.parent.name}(=|: ){name.stem}\b", rest)
        # Python blocks run
        assert by_option or name.name in rest or name.suffix == ".py" or path == EXPORTED, path


# --- blocks ---------------------------------------------------------------------------------------


@pytest.mark.slow
@pytest.mark.parametrize("code", cases(lambda page: blocks(page, "python")))
def test_every_python_block_runs(code, place, reader, tmp_path, monkeypatch):
    import_or_skip(code)
    monkeypatch.setenv("NEUSEE_RECIPES", str(place / "all_bands"))  # expected numbers name bands
    monkeypatch.chdir(tmp_path)
    path = tmp_path / f"block_{zlib.crc32(code.encode()):x}.py"
    path.write_text(code, encoding="utf-8")
    monkeypatch.syspath_prepend(str(tmp_path))
    importlib.import_module(path.stem)
    if 'torch.export.save(whole, "net.pt2")' in code:
        monkeypatch.chdir(place)
        shutil.copy(tmp_path / "net.pt2", place)
        carry_out(
            "run my/train_smallnet.yaml restore=exported restore.weights=net.pt2",
            place,
            monkeypatch,
        )


def test_the_package_of_the_page_on_nodes_has_a_family(reader, tmp_path, monkeypatch):
    ((text,),) = [found for page in WRITTEN if (found := blocks(page, "toml"))]
    written = tomllib.loads(text)
    assert written["build-system"] == {
        "requires": ["hatchling"],
        "build-backend": "hatchling.build",
    }
    project, site = written["project"], tmp_path / "site"
    (site / "mylab").mkdir(parents=True)
    (site / "mylab" / "__init__.py").touch()
    shutil.copy(reader / "my" / "bloom.py", site / "mylab" / "nodes.py")
    about = site / f"{project['name']}-{project['version']}.dist-info"  # as pip leaves it
    about.mkdir()
    (about / "METADATA").write_text(
        f"Metadata-Version: 2.1\nName: {project['name']}\nVersion: {project['version']}\n"
    )
    points = project["entry-points"].items()
    entries = [
        line for name, found in points for line in (f"[{name}]", *map(" = ".join, found.items()))
    ]
    (about / "entry_points.txt").write_text("\n".join(entries) + "\n")
    monkeypatch.syspath_prepend(str(site))
    importlib.invalidate_caches()
    node_families._installed.cache_clear()
    assert "mylab.bloom" in dict(node_families.all_nodes())


@pytest.mark.parametrize("line", [line for line, who in OTHER_LINES.items() if who == "a shell"])
def test_a_shell_takes_the_variable_and_the_program_knows_it(line):
    name, _, value = line.removeprefix("export ").partition("=")
    done = subprocess.run(
        ["sh", "-euc", f"{line}\nenv"], capture_output=True, text=True, check=True
    )
    assert f"{name}={os.path.expandvars(value.strip(chr(34)))}" in done.stdout.splitlines()
    assert f"| `{name}` |" in (ROOT / "recipes" / "guide" / "cache.md").read_text(encoding="utf-8")


# --- the site -------------------------------------------------------------------------------------


@pytest.fixture
def small_pictures(reader, monkeypatch):
    """Let the build of the handbook take its pictures from the stand-ins of the commands, which
    run if none did.
    """
    written = {tuple(shlex.split(words)): words for words in SPOKEN}

    def run(words, *_):
        results = shown_by(words, reader)
        if not results.is_dir():
            monkeypatch.chdir(reader)
            carry_out(written[words], reader, monkeypatch)
        folder = max(path for path in results.iterdir() if path.is_dir() and not path.is_symlink())
        command_pictures._name_latest(folder, reader)
        return folder

    monkeypatch.setattr(command_pictures, "_run", run)
    return reader


@pytest.mark.slow
def test_the_handbook_is_built_strictly_with_every_picture(small_pictures, tmp_path):
    pytest.importorskip("material")
    said: list[str] = []
    page = build_handbook(
        tmp_path / "handbook", reference_pages(GUIDE.parent), True, said.append, strict=True
    )
    wanted = {(p.words, p.file) for text in read_pages().values() for p in pictures_of(text)}
    files = sorted((page.parent / "pictures").iterdir())
    assert len(files) == len(wanted) > 40
    for path in files:
        with Image.open(path) as picture:
            #: digital numbers of SMALL_SENSOR, of which PIL keeps the upper byte
            frame = picture.size == (24, 24)
            assert frame or min(picture.size) > 30, path
            grey = picture.convert("L")
        numbers = read_image_png_u16(str(path), "rgb") if frame else grey
        assert len(np.unique(np.asarray(numbers))) > 10, path
    shown = {
        name
        for html in page.parent.rglob("*.html")
        for name in re.findall(r"pictures/(\w+\.png)", html.read_text())
    }
    assert shown == {path.name for path in files}
    assert not [line for line in said if line.startswith("no picture")]
