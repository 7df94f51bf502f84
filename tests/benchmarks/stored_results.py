"""The measured tables: one document in `results/` for each script, and RESULTS.md made of them.

    python tests/benchmarks/stored_results.py    # writes RESULTS.md

A document has an order on the page, a heading, the command and the machine, and tables. A table has
a title, the conditions of its measurement, a date, and either columns with rows of text or the
lines that the script printed. `sampling` says that a document was measured with a version whose
sensors sampled the PSF at the centres of their pixels.
"""

from __future__ import annotations

import json
import re
from collections.abc import Iterator, Mapping, Sequence
from datetime import date
from pathlib import Path
from typing import Any

FOLDER = Path(__file__).with_name("results")
PAGE = Path(__file__).with_name("RESULTS.md")
ABOUT = """# Measured

Written by `python tests/benchmarks/stored_results.py` from the documents in `results/`. Times of one row were measured
in one run; those of two tables compare only where the machine and the load are the same.

Where a section says **point sampling**, it was measured with a version whose shipped sensors sampled the PSF at the
centres of their pixels (commit c8b7db26, or an earlier one). Since then they average over the pixel: for the paper's
camera the LSR rises by 0 to 10 %, and a PSF takes 1.2 to 3 times as long.
"""

Document = dict[str, Any]


def stored(name: str) -> Document:
    """Return the document of a script."""
    text = (FOLDER / f"{name}.json").read_text(encoding="utf-8")
    document: Document = json.loads(text)
    return document


def store(name: str, document: Document) -> None:
    """Write the document of a script, and the page anew."""
    text = json.dumps(document, indent=1, ensure_ascii=False)
    (FOLDER / f"{name}.json").write_text(f"{text}\n", encoding="utf-8")
    PAGE.write_text(page(), encoding="utf-8")


def store_rows(
    name: str, rows: Sequence[Sequence[str]], conditions: str, machine: str | None = None
) -> None:
    """Replace the rows of the only table of a script by new ones, measured today."""
    document = stored(name)
    [table] = document["tables"]
    table |= {
        "rows": [list(row) for row in rows],
        "conditions": conditions,
        "date": date.today().isoformat(),
    }
    if machine is not None:
        document["machine"] = machine
    store(name, document)


def page() -> str:
    """Return the text of RESULTS.md."""
    documents = [json.loads(path.read_text(encoding="utf-8")) for path in FOLDER.glob("*.json")]
    documents.sort(key=lambda document: (document["order"], document["heading"]))
    parts = [ABOUT]
    for document in documents:
        parts += _section(document)
    return "\n".join(parts)


def _section(document: Document) -> Iterator[str]:
    yield f"## {document['heading']}\n"
    facts = []
    if document["command"]:
        facts.append(f"Command: `{document['command']}`")
    facts.append(f"Machine: {document['machine'] or 'not recorded'}")
    if document["sampling"]:
        facts.append("**point sampling**")
    yield f"{'. '.join(facts)}.\n"
    title = ""
    for table in document["tables"]:
        if table["title"] != title:
            title = table["title"]
            yield f"### {title}\n"
        yield from _table(table)


def _table(table: Mapping[str, Any]) -> Iterator[str]:
    yield f"{table['conditions']} ({table['date']})\n".lstrip()
    if "printed" in table:
        yield "```\n" + "\n".join(table["printed"]) + "\n```\n"
        return
    lines = [table["columns"], ["---"] * len(table["columns"]), *table["rows"]]
    yield "\n".join(f"| {' | '.join(cells)} |" for cells in lines) + "\n"


def tables_of(markdown: str, title: str) -> list[Document]:
    """Return the tables in a text in Markdown, each with the line that follows as its conditions."""
    tables = []
    for match in re.finditer(r"((?:^\|.*\n)+)\n*([^\n|#<]*)", markdown, re.MULTILINE):
        rows = [_cells(line) for line in match[1].splitlines()]
        measured = re.search(r"Measured on (\d{4}-\d\d-\d\d)", markdown)
        tables.append(
            {
                "title": title,
                "conditions": match[2].strip(),
                "date": measured[1] if measured else date.today().isoformat(),
                "columns": rows[0],
                "rows": rows[2:],
            }
        )
    return tables


def _cells(line: str) -> list[str]:
    return [cell.strip() for cell in line.strip().removeprefix("|").removesuffix("|").split("|")]


if __name__ == "__main__":
    PAGE.write_text(page(), encoding="utf-8")
