"""The handbook: what stands in its list of pages, which folders it refuses, its reference, and
the site as a whole.
"""

import importlib.util
import json
import re

import pytest
from typer.main import get_command

import neusee
from neusee.workflows.cli import app
from neusee.workflows.cli.handbook_reference import reference_pages
from neusee.workflows.handbook import site_build
from neusee.workflows.handbook.recipe_and_python_reference import escaped, prose, table
from neusee.workflows.handbook.site_build import (
    GUIDE,
    NoPicture,
    Picture,
    draw_pictures,
    pictures_of,
    read_pages,
    with_pictures,
    write_files,
)
from neusee.workflows.recipe.loading import groups
from neusee.workflows.recipe.node_families import all_nodes

PAGE = """# A page

    neusee run first_light   # the first

<!-- picture figures/a.png: What one
sees. -->

    neusee run laser=red sensor.read_noise="5 e-"

<!-- picture figures/b.png: What another sees. -->
"""


@pytest.fixture(scope="module")
def reference():
    return reference_pages(GUIDE.parent)


# --- pages and pictures ---------------------------------------------------------------------------


def test_a_picture_belongs_to_the_command_before_it():
    assert list(pictures_of(PAGE)) == [
        Picture(("run", "first_light"), "figures/a.png", "What one sees."),
        Picture(
            ("run", "laser=red", "sensor.read_noise=5 e-"), "figures/b.png", "What another sees."
        ),
    ]


def test_a_picture_before_the_first_command_is_a_mistake():
    with pytest.raises(ValueError, match=r"figures/b\.png stands before the first command"):
        list(pictures_of("<!-- picture figures/b.png: Nothing. -->\n\n    neusee run\n"))


def test_a_picture_takes_the_place_of_its_mark():
    first, second = pictures_of(PAGE)
    text = with_pictures(PAGE, {second: "pictures/2.png"})
    assert "![What another sees.](pictures/2.png)" in text
    assert "<!-- picture figures/a.png" in text
    assert with_pictures(PAGE, {}) == PAGE
    assert "<!--" not in with_pictures(PAGE, {first: "1.png", second: "2.png"})


def test_the_files_of_the_reader_are_written(tmp_path):
    write_files(
        {
            "a.md": (
                "```yaml\n# my/group/one.yaml: a file.\nseed: 1\n```\n\n```python\n# my/b.py\nx ="
                " 1\n```\n"
            )
        },
        tmp_path,
    )
    assert (tmp_path / "my/group/one.yaml").read_text() == "# my/group/one.yaml: a file.\nseed: 1\n"
    assert (tmp_path / "my/b.py").read_text() == "# my/b.py\nx = 1\n"


def test_a_command_that_fails_is_named_with_its_message(tmp_path):
    picture = Picture(("cache", "no_such"), "figures/a.png", "Nothing.")
    with pytest.raises(NoPicture, match=r"neusee cache no_such ended with exit code 2: .*no_such"):
        draw_pictures([picture], tmp_path, tmp_path / "pictures", print)
    said = []
    assert (
        draw_pictures([picture], tmp_path, tmp_path / "pictures", said.append, strict=False) == {}
    )
    assert said[0].startswith("commands that draw pictures: 1;")
    assert said[1].startswith("no picture: neusee cache no_such ended with exit code 2")


def test_a_command_finds_the_results_of_the_one_before(tmp_path, monkeypatch):
    seen = []

    def run(words, work, results):
        seen.append(sorted(path.read_text() for path in (work / "runs" / "latest").glob("*.png")))
        results.mkdir()
        (results / "a.png").write_text(words[0])
        return results

    monkeypatch.setattr(site_build, "_run", run)
    pictures = [Picture((name,), "a.png", "Nothing.") for name in ("first", "second", "third")]
    draw_pictures(pictures, tmp_path, tmp_path / "pictures", print)
    assert seen == [[], ["first"], ["second"]]


def test_every_picture_of_the_guide_has_a_command_and_a_sentence():
    pictures = [picture for text in read_pages().values() for picture in pictures_of(text)]
    marks = [
        mark
        for text in read_pages().values()
        for mark in re.findall(r"^<!-- picture", text, re.MULTILINE)
    ]
    assert len(pictures) == len(marks)
    assert not [p for p in pictures if not p.caption.endswith(".") or not p.file.endswith(".png")]


# --- the list of pages ----------------------------------------------------------------------------


def test_a_page_that_the_list_does_not_name_stands_in_a_section_of_its_own():
    pages = {
        "index.md": "# Start",
        "new.md": "# Something new\n",
        "ref/a.md": "# A",
        "ref/b.md": "# B",
    }
    nav = [
        {"Start": "index.md"},
        {"How to": [{"Gone": "gone.md"}]},
        {"Reference": [{"Parts": "ref/"}]},
    ]
    assert site_build.complete_nav(nav, pages) == [
        {"Start": "index.md"},
        {"Reference": [{"Parts": [{"A": "ref/a.md"}, {"B": "ref/b.md"}]}]},
        {"More": [{"Something new": "new.md"}]},
    ]


def test_every_page_is_in_the_settings_once(reference, tmp_path):
    pages = {**read_pages(), **reference}
    text = site_build.settings_text(pages, tmp_path, tmp_path)
    found = re.findall(r"[\w/]+\.md", text.partition("\nnav:")[2])
    assert sorted(found) == sorted(pages)


# --- what is refused ------------------------------------------------------------------------------


def ended(words, capsys):
    with pytest.raises(SystemExit) as end:
        app.main(["handbook", "--no-open", "--no-pictures", *words])
    return end.value.code, capsys.readouterr().err


def test_without_mkdocs_one_sentence_says_what_to_install(monkeypatch, capsys, tmp_path):
    found = importlib.util.find_spec
    monkeypatch.setattr(
        importlib.util, "find_spec", lambda name: None if name == "material" else found(name)
    )
    code, err = ended(["--out", str(tmp_path)], capsys)
    assert (code, err) == (
        2,
        'neusee handbook: mkdocs-material is not installed: pip install "neusee[docs]"\n',
    )


def test_a_folder_with_other_files_is_refused_and_kept(monkeypatch, capsys, tmp_path):
    monkeypatch.setattr(site_build, "check_modules", lambda: None)
    (tmp_path / "thesis.txt").write_text("years of work")
    code, err = ended(["--out", str(tmp_path)], capsys)
    assert code == 2
    assert f"{tmp_path} holds files that are no handbook" in err
    for place in ("thesis.txt", "thesis.txt/deep"):
        code, err = ended(["--out", str(tmp_path / place)], capsys)
        assert code == 2
        assert "neusee handbook: --out: " in err
        assert "thesis.txt" in err
    assert (tmp_path / "thesis.txt").read_text() == "years of work"


# --- the reference --------------------------------------------------------------------------------


def test_the_reference_has_every_node_with_its_source(reference):
    for name, node in all_nodes():
        family = name.partition(".")[0]
        section = (
            reference[f"reference/nodes/{family}.md"]
            .partition(f"## {name} {{")[2]
            .partition("\n## ")[0]
        )
        assert "**Source:** " in section, name
        assert not [p for p in node.params.model_fields if f"`{p}`" not in section]
        assert f"(nodes/{family}.md#{name.replace('.', '-')})" in reference["reference/nodes.md"]


def test_the_reference_has_every_option_of_every_command(reference):
    def walk(command, path):
        yield path, command
        for name, inner in getattr(command, "commands", {}).items():
            yield from walk(inner, f"{path} {name}")

    text = reference["reference/options.md"]
    for path, command in walk(get_command(app.app), "neusee"):
        section = re.search(rf"^#+ {path}$(.*?)(?=^#|\Z)", text, re.MULTILINE | re.DOTALL)
        section = section[1] if section else text.partition("\n## ")[0]
        assert not [
            o
            for p in command.params
            for o in p.opts
            if o.startswith("--") and f"`{o}`" not in section
        ], path


def test_the_reference_has_every_public_name_group_and_key(reference):
    python, recipe = (
        reference["reference/public_names.md"],
        reference["reference/recipe_language.md"],
    )
    assert not [
        name
        for name in neusee.__all__
        if not name.startswith("_") and f"### {name}\n" not in python
    ]
    assert not [
        f"{g}={o.name}"
        for g, options in groups().items()
        for o in options
        if f"`{g}={o.name}`" not in recipe
    ]
    keys = (
        "defaults",
        "nodes",
        "steps",
        "seed",
        "tolerance",
        "outputs",
        "posterior",
        "train",
        "expect",
        "node",
        "each",
    )
    assert not [key for key in keys if f"| `{key}` |" not in recipe]


def test_signs_of_markdown_in_a_docstring_stand_for_themselves():
    assert escaped("a*b*c, `x*y`, p_q <z> | w") == r"a\*b\*c, `x*y`, p\_q \<z\> \| w"
    assert table(["a"], [["x | y"]])[-1] == r"| x \| y |"
    assert prose("First.\nUnits: m.\n\n    code * 2\n")[:5] == [
        "First.",
        "",
        "**Units:** m.",
        "",
        "    code * 2",
    ]


# --- the site -------------------------------------------------------------------------------------


@pytest.fixture(scope="module")
def site(tmp_path_factory, reference):
    if importlib.util.find_spec("mkdocs") is None or importlib.util.find_spec("material") is None:
        pytest.skip("mkdocs-material is not installed")
    out = tmp_path_factory.mktemp("book") / "handbook"
    site_build.build_handbook(out, reference, False, print, strict=True)
    return out


@pytest.mark.slow
def test_the_site_has_every_page_and_no_address_of_the_network(site, reference):
    for path in {**read_pages(), **reference}:
        html = (site / path).with_suffix(".html").read_text()
        loaded = re.findall(
            r'<(?:script|img|iframe)[^>]* src="?([^"> ]+)|<link[^>]*stylesheet[^>]*'
            r' href="?([^"> ]+)',
            html,
        )
        assert loaded
        assert not [a or b for a, b in loaded if re.match(r"(?:https?:)?//", a or b)]
        assert re.search(r'<script src="?[./]*assets/iframe-worker\.js', html)


@pytest.mark.slow
def test_the_search_of_files_knows_every_page(site, reference):
    index = json.loads(
        (site / "search" / "search_index.js").read_text().removeprefix("var __index = ")
    )
    found = {entry["location"].partition("#")[0] for entry in index["docs"]}
    assert found == {path.replace(".md", ".html") for path in {**read_pages(), **reference}}


@pytest.mark.slow
def test_a_second_build_replaces_the_first_and_follows_no_link(site, reference, tmp_path):
    (site / "old.html").write_text("old")
    (site / "link").symlink_to(tmp_path)
    (tmp_path / "thesis.txt").write_text("years of work")
    site_build.build_handbook(site, reference, False, print)
    assert not (site / "old.html").exists()
    assert not (site / "link").is_symlink()
    assert (tmp_path / "thesis.txt").exists()
    assert (site / "index.html").exists()


@pytest.mark.long
def test_every_picture_of_the_guide_is_drawn_by_its_command(reference, tmp_path):
    pytest.importorskip("material")
    page = site_build.build_handbook(tmp_path / "handbook", reference, True, print, strict=True)
    wanted = {(p.words, p.file) for text in read_pages().values() for p in pictures_of(text)}
    assert len(list((page.parent / "pictures").iterdir())) == len(wanted) > 30
