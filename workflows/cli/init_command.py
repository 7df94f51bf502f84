"""The command ``neusee init``: make a folder for a project of the user's own."""

from __future__ import annotations

from importlib.resources import files
from pathlib import Path
from typing import Annotated

import typer

from neusee.workflows.cli.command_frame import fail, failing, say
from neusee.workflows.cli.command_options import Debug

#: for each file of a project: the start from which it is written, and the name that stands for NAME in the start
FILES: dict[str, tuple[str, str]] = {
    "README.md": ("project/README.md.txt", ""),
    ".gitignore": ("project/gitignore.txt", ""),
    "my_camera.yaml": ("project/my_camera.yaml.txt", ""),
    "sensor/my_sensor.yaml": ("sensor.yaml.txt", "my_sensor"),
    "sensor/my_sensor_colour.csv": ("sensor_colour.csv.txt", "my_sensor"),
    "sensor/my_sensor_mono.csv": ("sensor_mono.csv.txt", "my_sensor"),
    "nodes/blooming.py": ("node.py.txt", "blooming"),
    "nodes/test_blooming.py": ("test_node.py.txt", "blooming"),
    "tests/test_my_camera.py": ("project/test_my_camera.py.txt", ""),
}
NEXT = ("neusee validate my_camera.yaml", "neusee run my_camera.yaml", "neusee check nodes/blooming.py", "pytest")


def init(
    folder: Annotated[
        Path, typer.Argument(help="Folder of the project; the folder is made where there is none.")
    ] = Path(),
    debug: Debug = False,
) -> None:
    """Make a folder for recipes, groups and nodes of your own.

    The folder holds a recipe, a sensor, a node, tests, a README and a .gitignore. The recipe runs as it is. No file is
    replaced.
    """
    above = [path for path in (folder, *folder.parents) if path.exists()]
    if above and not above[0].is_dir():
        fail(f"{above[0]} is a file, so that no project can be made in {folder}: name another folder")
    if there := [name for name in FILES if (folder / name).exists() or (folder / name).is_symlink()]:
        where = "here" if folder == Path() else f"in {folder}"
        fail(f"{', '.join(there)}: there is such a file {where} already, and none is replaced: name an empty folder")
    with failing(OSError):
        for name, (start, called) in FILES.items():
            text = (files("neusee.workflows.cli") / "starts" / start).read_text(encoding="utf-8")
            path = folder / name
            path.parent.mkdir(parents=True, exist_ok=True)
            path.write_text(text.replace("NAME", called) if called else text, encoding="utf-8")
    place = [] if folder == Path() else [f"  cd {folder}"]
    say([*(f"written  {folder / name}" for name in FILES), "", "next", *place, *(f"  {command}" for command in NEXT)])
