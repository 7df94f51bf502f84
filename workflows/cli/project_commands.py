"""The commands for a project of the user's own: ``neusee init``, ``new`` and ``check``."""

from __future__ import annotations

import json
import keyword
from dataclasses import asdict
from importlib.resources import files
from importlib.util import find_spec
from itertools import chain
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, TypeVar

import typer

from neusee.workflows.cli import lazy_imports as lazy
from neusee.workflows.cli.command_frame import AsJson, Debug, fail, failing, say
from neusee.workflows.cli.commands_and_exit_codes import DONE, MISSED
from neusee.workflows.contract.surroundings import elsewhere

if TYPE_CHECKING:
    from collections.abc import Iterable, Mapping, Sequence
    from types import ModuleType

    from torch import nn

    from neusee.nodes import Node
    from neusee.workflows.contract.node_rules import Finding

T = TypeVar("T")


# --- init command ---------------------------------------------------------------------------------

# The command ``neusee init``: make a folder for a project of the user's own.


#: for each file of a project: the template (start) from which it is written, and the name in place
#: of NAME in the template
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
NEXT = (
    "neusee validate my_camera.yaml",
    "neusee run my_camera.yaml",
    "neusee check nodes/blooming.py",
    "pytest",
)


def init(
    folder: Annotated[
        Path, typer.Argument(help="Folder of the project; the folder is made where there is none.")
    ] = Path(),
    debug: Debug = False,
) -> None:
    """Make a folder for recipes, groups and nodes of your own.

    The folder holds a recipe, a sensor, a node, tests, a README and a .gitignore. The recipe runs
    as it is. No file is replaced.
    """
    _refuse_inside_file(folder)
    existing_names = [name for name in FILES if _is_taken(folder / name)]
    if existing_names:
        place_text = "here" if folder == Path() else f"in {folder}"
        fail(
            f"{', '.join(existing_names)}: there is such a file {place_text} already, and"
            " none is replaced: name an empty folder"
        )
    with failing(OSError):
        for name, (start, called) in FILES.items():
            _write_start(folder / name, start, called)
    _say_written([folder / name for name in FILES], folder, NEXT)


def _refuse_inside_file(folder: Path) -> None:
    """End the command for a folder that is a file, or that would be inside a file."""
    existing_folders = [path for path in (folder, *folder.parents) if path.exists()]
    if existing_folders and not existing_folders[0].is_dir():
        fail(
            f"{existing_folders[0]} is a file, so that no project can be made in {folder}:"
            " name another folder"
        )


def _is_taken(path: Path) -> bool:
    """Return True if there is a file, also if it is a broken link."""
    return path.exists() or path.is_symlink()


def _write_start(path: Path, start: str, name: str) -> None:
    """Write a file from a template, with ``name`` in place of NAME, or unchanged without a name."""
    text = (files("neusee.workflows.cli") / "starts" / start).read_text(encoding="utf-8")
    if name:
        text = text.replace("NAME", name)
    path.parent.mkdir(parents=True, exist_ok=True)
    path.write_text(text, encoding="utf-8")


def _say_written(paths: Iterable[Path], folder: Path, commands: Iterable[str]) -> None:
    """Print the files that were written, and the commands to try next."""
    change_folder = [] if folder == Path() else [f"  cd {folder}"]
    written_lines = [f"written  {path}" for path in paths]
    say([*written_lines, "", "next", *change_folder, *(f"  {command}" for command in commands)])


# --- new command ----------------------------------------------------------------------------------

# The command ``neusee new``: write a small start that works, with its test.


#: for each kind: the files that it writes, each with its template, and the commands to try next
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
        {
            "NAME.py": "mask.py.txt",
            "doe/NAME.yaml": "mask.yaml.txt",
            "test_NAME.py": "test_mask.py.txt",
        },
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
    _refuse_no_name(name)
    names, commands = KINDS[kind]
    paths = {folder / path.replace("NAME", name): start for path, start in names.items()}
    if existing := [str(path) for path in paths if path.exists()]:
        fail(f"{', '.join(existing)}: there is such a file already, and none is replaced")
    if "NAME.py" in names and (owner := _taken(name)):
        fail(f"{name} is the name of {owner}: take another name, because both cannot be imported")
    with failing(OSError):
        for path, start in paths.items():
            _write_start(path, start, name)
    _say_written(paths, folder, [command.replace("NAME", name) for command in commands])


def _refuse_no_name(name: str) -> None:
    if not name.isidentifier() or keyword.iskeyword(name) or name != name.lower():
        fail(f"{name} is no name: use small letters, digits and _, as for a file of Python")


def _taken(name: str) -> str:
    """Return a description of the family or module that already has the name of a new module; empty
    if none has it.
    """
    if (files("neusee") / "nodes" / name).is_dir():
        return f"the family {name} of neusee"
    try:
        spec = find_spec(name)
    except (ImportError, ValueError):
        return ""
    # the module that is to be written may be there already
    if spec is None or (spec.origin and Path(spec.origin).resolve().is_relative_to(Path.cwd())):
        return ""
    return f"a module of Python or of an installed package ({spec.origin or name})"


# --- check command --------------------------------------------------------------------------------

# The command ``neusee check``: does a node keep the rules for nodes?


_MARKS = {True: "ok", False: "FAIL", None: "-"}


def check(
    place: Annotated[
        str, typer.Argument(help="A file, a folder or a module with nodes, or a node: optics.psf.")
    ],
    as_json: AsJson = False,
    debug: Debug = False,
) -> None:
    """Check whether nodes keep what the nodes of neusee keep.

    Docstring, annotations, hooks, what a cache key covers; on the example of each node: the
    reference, gradients against finite differences, bands, bounds and shapes, and the same call in
    a process with other surroundings. A network class of yours is called on small pictures. The
    exit code is 3 if a rule fails. Runs the code.
    """
    with failing(LookupError), elsewhere(early=not _is_of_neusee(place)) as process:
        nodes, networks = _nodes_and_networks(place)

        by_name = lazy.node_contract.check_all(nodes, networks, process)
    failure_count = sum(finding.ok is False for finding in chain.from_iterable(by_name.values()))
    if as_json:
        document = {name: list(map(asdict, findings)) for name, findings in by_name.items()}
        say([json.dumps(document, indent=1)])
    else:
        _say_findings(by_name)
        say([f"{_count(len(nodes), len(networks))}: {_verdict(failure_count)}"])
    code = MISSED if failure_count else DONE
    raise typer.Exit(code)


def _say_findings(by_name: Mapping[str, Sequence[Finding]]) -> None:
    """Print each node or network with its findings: the mark, the rule and a text."""
    for name, findings in by_name.items():
        say(
            [
                name,
                *(
                    f"  {_MARKS[finding.ok]:<4}  {finding.rule:<11}  {finding.text}"
                    for finding in findings
                ),
                "",
            ]
        )


def _verdict(failed: int) -> str:
    if not failed:
        return "every rule holds"
    return f"{failed} rule{'s fail' if failed > 1 else ' fails'}"


def _is_of_neusee(place: str) -> bool:
    """Return True for a node or a family of neusee, without an import of them."""
    return (files("neusee") / "nodes" / place.partition(".")[0]).is_dir() and not place.endswith(
        ".py"
    )


def _installed(family: str) -> ModuleType | None:
    """Return the module of a family of an installed package; None for a family of neusee."""
    try:
        return lazy.node_families.module_of(family)
    except LookupError:
        return None


def _is_module(place: str) -> bool:
    """Return True if a name with dots is that of a module, such as ``mylab.nodes``, and not of a
    node.
    """
    try:
        return find_spec(place) is not None
    except ImportError:
        return False


def _count(nodes: int, networks: int) -> str:
    """Return the numbers of nodes and networks as text, such as ``2 nodes and 1 network``."""
    # nodes are counted even if there are none, unless there are networks
    counts = [(nodes, "node")] * (nodes > 0 or not networks) + [(networks, "network")] * (
        networks > 0
    )
    return " and ".join(f"{count} {noun}{'s' * (count != 1)}" for count, noun in counts)


def _nodes_and_networks(place: str) -> tuple[dict[str, Node], dict[str, type[nn.Module]]]:
    """Return the nodes and the network classes at a place by name; raise `LookupError` if there
    are none.
    """
    family = place.partition(".")[0]
    if not place.endswith(".py") and "/" not in place and lazy.node_families.is_known(family):
        if place == family:
            module = _installed(family)
            network_classes = lazy.node_contract.whole_networks(module) if module else {}
            return _within(family, lazy.node_families.nodes_of(family)), _within(
                family, network_classes
            )
        if not _is_module(place):
            return {place: lazy.node_families.find_node(place)}, {}
    module = lazy.node_families.import_own(place, Path.cwd())
    name = lazy.node_families.installed_as(module.__name__) or module.__name__.rpartition(".")[2]
    return _within(name, lazy.node_families.own_nodes(name, module)), _within(
        name, lazy.node_contract.whole_networks(module)
    )


def _within(family: str, members: Mapping[str, T]) -> dict[str, T]:
    """Return the members of a family by their names in a recipe."""
    return {f"{family}.{name}": member for name, member in members.items()}
