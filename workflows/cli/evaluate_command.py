"""``neusee evaluate``: masks and restorers on the same scenes and lasers, with confidence intervals."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated, Any

import typer

from neusee.workflows.cli.command_frame import FAILED, Debug, Out, Words, check_device, fail, say, split, the_store

_PIPELINES = "flat+none, five_half_rings+wiener"


def evaluate(
    words: Words = None,
    pipelines: Annotated[
        str,
        typer.Option("--pipelines", help="MASK[@file]+RESTORER[@weights], …; none restores nothing."),
    ] = _PIPELINES,
    data: Annotated[str, typer.Option("--data", help="Folder of photographs; else the recipe's own scene.")] = "",
    scenes: Annotated[int, typer.Option("--scenes", min=1, help="Number of scenes.")] = 20,
    strengths: Annotated[
        str, typer.Option("--strengths", help="Strengths of the laser, multiples of saturation.")
    ] = "0,1e1,1e2,1e3,1e4,1e5,1e6",
    small: Annotated[int, typer.Option("--small", min=11, help="Shorter side of the reduced pictures.")] = 256,
    reference: Annotated[
        str, typer.Option("--reference", help="Pipeline that the others are compared with; by default the first.")
    ] = "",
    device: Annotated[str, typer.Option("--device", help="Where to compute: cpu or cuda.")] = "cpu",
    quiet: Annotated[bool, typer.Option("--quiet", help="Print only the path of the page.")] = False,
    debug: Debug = False,
    out: Out = Path("runs"),
) -> None:
    """Compare masks and restorers on the same scenes and lasers.

    A pipeline is a mask and a restorer. Every pipeline sees the same scenes, lasers and noise. The page has L1, PSNR
    and SSIM with 95 % confidence intervals, suppression by wavelength (LSR, BSR), the contrast that is left, and the
    bound that no mask can pass. Values that the recipe gives as distributions are drawn for each scene. Run the
    same command again to continue.
    """
    name, changes, _ = split(words)
    check_device(device)
    tell = (lambda line: None) if quiet else (lambda line: say([line]))
    how = {"data": data, "scenes": scenes, "strengths": strengths, "small": small, "reference": reference}
    command = ["neusee", "evaluate", name, *changes, f'--pipelines "{pipelines}"', *_given(how)]
    folder = _evaluated(
        name,
        changes,
        pipelines,
        data=data or None,
        scenes=scenes,
        strengths=_numbers(strengths),
        small=small,
        reference=reference.replace(" ", ""),
        out=out,
        command=command,
        tell=tell,
        device=device,
    )
    say([str(folder / "report.html")])


def _given(how: dict[str, Any]) -> list[str]:
    return [f"--{key} {value}" for key, value in how.items() if value]


def _evaluated(name: str, changes: list[str], pipelines: str, **how: Any) -> Path:
    """The folder of the evaluation, or one line of what is wrong."""
    from neusee.workflows.api import verbs
    from neusee.workflows.evaluation.pipelines import Refused
    from neusee.workflows.graph.run_error import RunError

    try:
        return verbs.evaluate(name, pipelines=pipelines, changes=changes, store=the_store(), **how)
    except Refused as error:
        fail(str(error))
    except RunError as error:
        fail(str(error), FAILED)


def _numbers(text: str) -> list[float]:
    found = []
    for word in text.split(","):
        try:
            found.append(float(word))
        except ValueError:
            fail(f"--strengths: {word.strip() or 'nothing'} is no number: write 0,1e1,1e3,1e6")
    return found
