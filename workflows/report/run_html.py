"""The HTML page of a run, from its document and its pictures alone, and the page of an earlier run written again.

Neither torch nor a recipe is needed.
"""

from __future__ import annotations

import base64
import json
import sys
from collections.abc import Mapping
from datetime import datetime
from pathlib import Path
from typing import Any

from neusee.workflows.keys.regular_file import bytes_of, text_of
from neusee.workflows.report.run_crate import remove_crate, restore_crate
from neusee.workflows.report.study_page import compiled, filled

_TEMPLATE = "run_page.html.j2"


def prepare() -> None:
    """Read and compile the template of the page, which takes longer than to fill it."""
    compiled(_TEMPLATE)


def document_text(doc: Mapping[str, Any]) -> str:
    """Return the document of a run as the text of its file ``provenance.json``."""
    return json.dumps(doc, indent=1, ensure_ascii=False, allow_nan=True)


def present_time() -> str:
    """Return the present time as the page of a run shows it."""
    return datetime.now().astimezone().strftime("%Y-%m-%d %H:%M:%S %Z")


def page(doc: Mapping[str, Any], pictures: Mapping[str, bytes]) -> str:
    """Return the report of a run, from its document and pictures, as one HTML page that loads no other file."""
    inline = {name: base64.b64encode(content).decode() for name, content in pictures.items()}
    shown = {**doc, "figures": [f for f in doc["figures"] if f["name"] in inline]}
    return filled(_TEMPLATE, doc=shown, pictures=inline)


def rebuild(folder: Path) -> Path:
    """Write ``report.html`` of a run again, from the document and the pictures in ``folder``, and return its path."""
    doc = json.loads(text_of(folder / "provenance.json"))
    pictures = {p.stem: bytes_of(p, sys.maxsize) for p in sorted((folder / "figures").glob("*.png"))}
    target = folder / "report.html"
    part = folder / ".report.html.part"
    part.write_text(page(doc, pictures), encoding="utf-8")
    crate = remove_crate(folder)
    part.replace(target)
    if crate is not None:
        restore_crate(folder, crate)
    return target
