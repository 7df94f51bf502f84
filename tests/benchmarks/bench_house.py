"""How the source reads, beside peers, by one count for all: `bench_house.py NAME=FOLDER ...`.

    pip install radon
    pip download --no-deps --dest peers snakemake joblib
    python tests/benchmarks/bench_house.py neusee=.src/neusee joblib=peers/joblib

Each folder is a package, whose tests are left out. The table in RESULTS.md
has a row for each folder; the line above it counts the imports of private modules (an underscore in
front) in the tests of neusee. What is counted:

- code: without blank lines, comments and docstrings, and without the spaces in front;
- decisions a line: branches, loops, conditional expressions, handlers, boolean operators, filters
  of comprehensions, cases and assertions over code lines, in functions of at least 8 code lines;
- complexity: that of radon, which counts comprehensions and boolean operators too;
- comprehensions: with generator expressions, in a thousand code lines; with two loops: as a number;
- empty names: the share of bindings that `tests/test_plain_names.py` calls empty;
- imports inside: of the package's own modules, in functions.
"""

import ast
import datetime
import io
import os
import sys
import tokenize
from collections.abc import Iterator
from dataclasses import dataclass, field
from pathlib import Path

from radon.complexity import cc_visit
from stored_results import store

ROOT = Path(__file__).parents[2]
TESTS = ROOT / "tests"
sys.path.insert(0, str(ROOT))

from tests.test_plain_names import EMPTY, bindings  # noqa: E402

LEAST = 8  #: code lines of a function whose decisions are counted
LARGEST = 10  #: complexity of a function that is read at once
DECISIONS = (ast.If, ast.For, ast.AsyncFor, ast.While, ast.IfExp, ast.ExceptHandler, ast.Assert)
COMPREHENSIONS = (ast.ListComp, ast.SetComp, ast.DictComp, ast.GeneratorExp)
FUNCTIONS = (ast.FunctionDef, ast.AsyncFunctionDef)
WITH_DOCSTRING = (ast.Module, ast.ClassDef, *FUNCTIONS)
NO_SOURCE = {"tests", "test", "testing", "vendor"}  #: folders that are not counted
COLUMNS = (
    "files",
    "code lines",
    "characters (k)",
    "characters a line",
    "decisions a line",
    "above complexity 10",
    "worst",
    "comprehensions",
    "with two loops",
    "empty names (%)",
    "imports inside",
)


@dataclass
class Counts:
    """What the files of one folder add up to."""

    files: int = 0
    lines: int = 0
    characters: int = 0
    lines_in_functions: int = 0
    decisions: int = 0
    complexities: list[int] = field(default_factory=list)
    comprehensions: int = 0
    with_two_loops: int = 0
    bindings: int = 0
    empty: int = 0
    inside: int = 0

    def row(self) -> list[str]:
        """Return the values of the columns as text."""
        above = [number for number in self.complexities if number > LARGEST]
        return [
            f"{self.files:,}",
            f"{self.lines:,}",
            f"{self.characters / 1e3:,.0f}",
            f"{self.characters / self.lines:.1f}",
            f"{self.decisions / max(1, self.lines_in_functions):.3f}",
            str(len(above)),
            str(max(self.complexities, default=0)),
            f"{1e3 * self.comprehensions / self.lines:.1f}",
            str(self.with_two_loops),
            f"{100 * self.empty / max(1, self.bindings):.1f}",
            str(self.inside),
        ]


def docstring_lines(tree: ast.Module) -> set[int]:
    """Return the numbers of the lines of all docstrings."""
    lines: set[int] = set()
    for item in ast.walk(tree):
        if isinstance(item, WITH_DOCSTRING) and ast.get_docstring(item, clean=False) is not None:
            first = item.body[0]
            lines.update(range(first.lineno, (first.end_lineno or first.lineno) + 1))
    return lines


def code_lines(text: str, tree: ast.Module) -> dict[int, str]:
    """Return the code of each line that has some, by its number."""
    comments = {}
    for token in tokenize.generate_tokens(io.StringIO(text).readline):
        if token.type == tokenize.COMMENT:
            comments[token.start[0]] = token.start[1]
    skipped = docstring_lines(tree)
    code = {}
    for number, line in enumerate(text.split("\n"), 1):
        bare = line[: comments.get(number)].strip()
        if bare and number not in skipped:
            code[number] = bare
    return code


def decisions_of(item: ast.AST) -> int:
    """Return how many decisions one node of a syntax tree stands for."""
    if isinstance(item, ast.BoolOp):
        return len(item.values) - 1
    if isinstance(item, ast.comprehension):
        return len(item.ifs)
    if isinstance(item, ast.Match):
        return len(item.cases)
    return int(isinstance(item, DECISIONS))


def outermost(tree: ast.AST) -> Iterator[ast.AST]:
    """Yield the functions of a file that are in no other function."""
    for item in ast.iter_child_nodes(tree):
        if isinstance(item, FUNCTIONS):
            yield item
        else:
            yield from outermost(item)


def own_imports(function: ast.AST, package: str) -> int:
    """Return how many imports of the package itself stand inside a function."""
    count = 0
    for item in ast.walk(function):
        if isinstance(item, ast.ImportFrom):
            module = item.module or ""
            count += item.level > 0 or module.partition(".")[0] == package
        elif isinstance(item, ast.Import):
            count += any(alias.name.partition(".")[0] == package for alias in item.names)
    return count


def add_functions(counts: Counts, tree: ast.Module, code: dict[int, str], package: str) -> None:
    """Add what the functions of one file hold."""
    for function in outermost(tree):
        numbers = range(function.lineno, (function.end_lineno or 0) + 1)
        lines = sum(number in code for number in numbers)
        counts.inside += own_imports(function, package)
        if lines >= LEAST:
            counts.lines_in_functions += lines
            counts.decisions += sum(decisions_of(item) for item in ast.walk(function))


def add_file(counts: Counts, path: Path, package: str) -> None:
    """Add one file."""
    text = path.read_text(encoding="utf-8-sig", errors="replace")
    tree = ast.parse(text)
    code = code_lines(text, tree)
    counts.files += 1
    counts.lines += len(code)
    counts.characters += sum(map(len, code.values()))
    for block in cc_visit(text):
        counts.complexities += [part.complexity for part in getattr(block, "methods", [block])]
    for item in ast.walk(tree):
        if isinstance(item, COMPREHENSIONS):
            counts.comprehensions += 1
            counts.with_two_loops += len(item.generators) > 1
    names = list(bindings(tree))
    counts.bindings += len(names)
    counts.empty += sum(name in EMPTY for name in names)
    add_functions(counts, tree, code, package)


def python_files(folder: Path) -> list[Path]:
    """Return the files of Python below a folder, also behind links to folders."""
    walk = os.walk(folder, followlinks=True)
    return sorted(
        Path(top, name) for top, _, names in walk for name in names if name.endswith(".py")
    )


def counted(folder: Path) -> Counts:
    """Return the counts of a package, whose tests are left out."""
    counts = Counts()
    for path in python_files(folder):
        if not NO_SOURCE & set(path.relative_to(folder).parts):
            add_file(counts, path, folder.name)
    return counts


def private_imports(tests: Path) -> int:
    """Return how many lines of tests import a module or a package with an underscore in front."""
    count = 0
    for path in tests.rglob("*.py"):
        for item in ast.walk(ast.parse(path.read_text(encoding="utf-8"))):
            if isinstance(item, ast.ImportFrom) and (item.module or "").startswith("neusee."):
                parts = [*(item.module or "").split("."), *(alias.name for alias in item.names)]
                count += any(part.startswith("_") for part in parts)
    return count


def main(arguments: list[str]) -> None:
    """Count the folders, print their rows and store them."""
    if not arguments:
        sys.exit(__doc__)
    rows = []
    for argument in arguments:
        name, _, folder = argument.partition("=")
        rows.append([name, *counted(Path(folder)).row()])
        print(*rows[-1], sep=" | ", flush=True)
    tests = f"Lines of the tests of neusee that import a private module: {private_imports(TESTS)}."
    print(tests)
    table = {"title": "", "columns": ["source", *COLUMNS]}
    heading = "How the source reads, beside peers"
    command = "python tests/benchmarks/bench_house.py NAME=FOLDER ..."
    document = {"order": 58, "heading": heading, "command": command, "machine": "any"}
    date = datetime.date.today().isoformat()
    store(
        "house",
        document
        | {"sampling": "", "tables": [table | {"conditions": tests, "date": date, "rows": rows}]},
    )


if __name__ == "__main__":
    main(sys.argv[1:])
