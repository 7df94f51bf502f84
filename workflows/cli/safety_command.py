"""The command ``neusee safety``: is the sensor damaged or dazzled by a laser, and from which distance?"""

from __future__ import annotations

from pathlib import Path

from neusee.workflows.cli.command_frame import failing, load, refusing, say, the_store
from neusee.workflows.cli.command_list import FAILED
from neusee.workflows.cli.command_options import AsJson, Debug, Out, Quiet, Words
from neusee.workflows.cli.repetition import keep_answer
from neusee.workflows.report.json_output import json_line


def safety(
    words: Words = None,
    quiet: Quiet = False,
    as_json: AsJson = False,
    debug: Debug = False,
    out: Out = Path("runs"),
) -> None:
    """Estimate damage and dazzle by a laser, and the distances.

    The recipe needs a block `safety` and a laser in watts: see safety_pointer. The page has the limits of the
    sensor with their sources, the distances where the laser exceeds them, behind the plain lens, a mask, a grey
    filter and a smaller stop, and the limit of the eye beside them. It is an estimate, no certificate.
    """
    recipe, command = load(words, "safety")
    store = the_store()
    from neusee.workflows.graph.run_error import RunError
    from neusee.workflows.safety.run_safety import assess
    from neusee.workflows.safety.safety_text import lines

    with refusing(), failing(RunError, code=FAILED):
        folder, found = assess(recipe, store, out, command)

    def text(page: str) -> str:
        if as_json:
            return json_line({"report": page, **found.document})
        return page if quiet else "\n".join([*lines(found.paragraphs), "", f"page   {page}"])

    say([text(str(folder / "report.html"))])
    keep_answer(text, as_json, out, folder, found.report, recipe)
