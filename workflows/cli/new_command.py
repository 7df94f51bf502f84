"""The command ``neusee new``: write a small start that works, with its test."""

from __future__ import annotations

import keyword
from importlib.resources import files
from importlib.util import find_spec
from pathlib import Path
from typing import Annotated

import typer

from neusee.workflows.cli.command_frame import fail, failing, say
from neusee.workflows.cli.command_options import Debug

#: for each kind: the files that it writes, from the name of a start, and the commands to try next
KINDS: dict[str, tuple[dict[str, str], tuple[str, ...]]] = {
    "node": (
        {"NAME.py": "node.py.txt", "test_NAME.py": "test_node.py.txt"},
        ("neusee check NAME.py", "pytest test_NAME.py"),
    ),
    "network": (
        {
            "NAME.py": "network.py.txt",
            "restore/NAME.yaml": "network.yaml.txt",
            "train_NAME.yaml": "train_network.yaml.txt",
            "test_NAME.py": "test_network.py.txt",
        },
        ("neusee check NAME.py", "neusee train train_NAME.yaml", "pytest test_NAME.py"),
    ),
    "mask": (
        {"NAME.py": "mask.py.txt", "doe/NAME.yaml": "mask.yaml.txt", "test_NAME.py": "test_mask.py.txt"},
        ("neusee check NAME.py", "neusee run first_light doe=NAME", "pytest test_NAME.py"),
    ),
    "recipe": (
        {"NAME.yaml": "recipe.yaml.txt", "test_NAME.py": "test_recipe.py.txt"},
        ("neusee validate NAME.yaml", "neusee run NAME.yaml", "pytest test_NAME.py"),
    ),
    "sensor": (
        {
            "sensor/NAME.yaml": "sensor.yaml.txt",
            "sensor/NAME_colour.csv": "sensor_colour.csv.txt",
            "sensor/NAME_mono.csv": "sensor_mono.csv.txt",
            "sensor/test_NAME.py": "test_sensor.py.txt",
        },
        (
            "neusee run first_light sensor=NAME",
            "neusee run first_light sensor=NAME sensor.camera=sensor/NAME_mono.csv camera=mono",
            "pytest sensor/test_NAME.py",
        ),
    ),
}


def new(
    kind: Annotated[str, typer.Argument(help=f"What to begin: {', '.join(KINDS)}.")],
    name: Annotated[str, typer.Argument(help="Its name: letters, digits and _.")],
    folder: Annotated[Path, typer.Option("--in", help="Folder to write in.")] = Path(),
    debug: Debug = False,
) -> None:
    """Write the start of a node, network, mask, recipe or sensor.

    The start works as it is and has a test. No file is replaced.
    """
    if kind not in KINDS:
        fail(f"there is no start of a {kind}: write one of {', '.join(KINDS)}")
    if not name.isidentifier() or keyword.iskeyword(name) or name != name.lower():
        fail(f"{name} is no name: use small letters, digits and _, as for a file of Python")
    names, commands = KINDS[kind]
    paths = {folder / path.replace("NAME", name): start for path, start in names.items()}
    if there := [str(path) for path in paths if path.exists()]:
        fail(f"{', '.join(there)}: there is such a file already, and none is replaced")
    if "NAME.py" in names and (taken := _taken(name)):
        fail(f"{name} is the name of {taken}: take another name, because both cannot be imported")
    with failing(OSError):
        for path, start in paths.items():
            text = (files("neusee.workflows.cli") / "starts" / start).read_text(encoding="utf-8")
            path.parent.mkdir(parents=True, exist_ok=True)
            path.write_text(text.replace("NAME", name), encoding="utf-8")
    place = [] if folder == Path() else [f"  cd {folder}"]
    written = [f"written  {path}" for path in paths]
    say([*written, "", "next", *place, *(f"  {command.replace('NAME', name)}" for command in commands)])


def _taken(name: str) -> str:
    """Return what has the name of a new module already: a family of neusee or a module elsewhere; no text if none."""
    if (files("neusee") / "nodes" / name).is_dir():
        return f"the family {name} of neusee"
    try:
        spec = find_spec(name)
    except (ImportError, ValueError):
        return ""
    if spec is None or (spec.origin and Path(spec.origin).resolve().is_relative_to(Path.cwd())):
        return ""
    return f"a module of Python or of an installed package ({spec.origin or name})"
