"""A command of a few lines with a recipe, an option, a table and a page, whose answer the tests
keep and ask for.
"""

from __future__ import annotations

import sys
from pathlib import Path
from types import SimpleNamespace

from neusee.workflows.answers import repeated_command
from neusee.workflows.answers import repeated_command as installed_program
from neusee.workflows.answers import repeated_command as typed_command
from neusee.workflows.report.study_report import Section, StudyReport, StudyRun, as_json, cell_text
from neusee.workflows.store.shared_folder import Disk

WORDS = ("safety", "mine.yaml", "a.b=1")
TERMINAL = [80, 24, [False, "utf-8"], [False, "utf-8"]]
KEY = "82a46a54" + "0" * 24


class PlainReport:
    """The page and the document of a command, written without a template."""

    def write(self, folder, document) -> None:
        folder.write("provenance.json", as_json(document))
        folder.write("report.html", f"<p>{document['date']}, {cell_text(document['seconds'])} s")
        folder.write("figures/curve.png", b"PNG")


class Place:
    """A program, a recipe with an option and a table, a cache and a folder of results, all of a
    test's own.
    """

    def __init__(self, root: Path, monkeypatch) -> None:
        self.root, self.work, self.program = root, root / "work", root / "program"
        self.words, self.terminal, self.warns, self.out = (
            list(WORDS),
            list(TERMINAL),
            False,
            Path("runs"),
        )
        self.report: PlainReport | StudyReport = PlainReport()
        self.says_only = False  #: whether the command writes no folder
        self.computed = 0  #: how often the command was computed
        for name, text in {
            "program/__init__.py": "version = 1\n",
            "program/nodes/physics.py": "c = 3e8\n",
            "program/workflows/page.html.j2": "<p>\n",
            "work/mine.yaml": "title: mine\n",
            "work/laser/green.yaml": "wavelength: 532 nm\n",
            "work/table.csv": "1,2\n",
            "other/base.yaml": "seed: 1\n",
            "home/.config/neusee/recipes/laser/red.yaml": "wavelength: 638 nm\n",
        }.items():
            (root / name).parent.mkdir(parents=True, exist_ok=True)
            (root / name).write_text(text)
        (root / "site-packages" / "torch-2.6.dist-info").mkdir(parents=True)
        (root / "modules").mkdir()
        monkeypatch.chdir(self.work)
        monkeypatch.setenv("HOME", str(root / "home"))
        for name in ("XDG_CONFIG_HOME", "NEUSEE_RECIPES", "NEUSEE_CACHE_SECRET"):
            monkeypatch.delenv(name, raising=False)
        monkeypatch.setattr(
            sys, "path", [str(root / "site-packages"), str(root / "modules"), *sys.path]
        )
        real = installed_program.program_state
        monkeypatch.setattr(repeated_command, "program_state", lambda: real(self.program))
        # the tests themselves are code of their own
        monkeypatch.setattr(repeated_command, "_own_code", lambda: ())
        monkeypatch.setattr(repeated_command, "_NATIVE", ())
        # which changes between a fixture and its test
        ignored = typed_command.IGNORED | {"PYTEST_CURRENT_TEST"}
        monkeypatch.setattr(typed_command, "IGNORED", ignored)
        monkeypatch.setattr(repeated_command, "_TICK", 0)
        monkeypatch.setattr(repeated_command, "_IMPORTED", 0)
        monkeypatch.setattr(repeated_command, "running", [])

    def with_a_real_page(self) -> None:
        """Write the page of a study from here on."""
        self.words.append("page=real")
        self.report = StudyReport(
            "Mine", "Lead.", [Section("N", "Text.", ("a",), [[1.5]])], {"curve": b"PNG"}
        )

    @property
    def disk(self) -> Disk:
        return Disk(self.root / "cache")

    def recipe(self) -> SimpleNamespace:
        """Read the recipe, one that it extends, its option and a file that is not there, as a
        command does.
        """
        text = (self.work / "mine.yaml").read_text() + (
            self.work / "laser" / "green.yaml"
        ).read_text()
        text += (self.root / "other" / "base.yaml").read_text()
        try:
            text += (self.work / "wanted.txt").read_text()
        except FileNotFoundError:
            text += "\n"
        values = {"safety.damage.file": Path("table.csv")}
        return SimpleNamespace(
            name="mine", config=SimpleNamespace(to_yaml=lambda: text, values=values)
        )

    def ask(self, meanwhile=lambda: None) -> str:
        """Return what the command prints: its stored answer, or a new one, which is kept."""
        command = repeated_command.Command(self.words, self.terminal, self.disk)
        text = command.answer()
        if text is not None:
            return text
        self.computed += 1
        recipe = self.recipe()
        meanwhile()
        if self.says_only:
            command.keep(recipe.config.to_yaml(), False, recipe)
            return recipe.config.to_yaml()
        run = StudyRun("safety", recipe, ["neusee", *self.words])
        document = run.document({"warnings": ["full"]} if self.warns else {"numbers": [1.5, None]})
        document["warnings"] = ["full"] if self.warns else []
        report = self.report
        folder = run.write(self.out, KEY, document, report)
        text = recipe.config.to_yaml() + "page {}"
        results = repeated_command.Results(folder, self.out, report)
        command.keep(text.format("@neusee-page@"), False, recipe, results)
        return text.format(folder / "report.html")

    def again(self, meanwhile=lambda: None) -> bool:
        """Return True if the command was computed when it was asked."""
        before = self.computed
        self.ask(meanwhile)
        return self.computed > before

    @property
    def stored(self) -> Path | None:
        """The file of the stored answer, if there is one."""
        return next(iter((self.root / "cache" / "answers").rglob("*.answer")), None)
