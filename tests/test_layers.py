"""Layers: nodes know nothing of workflows, a room of workflows imports earlier rooms alone, and
nothing is heavy.

Every rule of a room is a function from the files of workflows to its offences, so that a test can
plant one.
"""

import ast
import functools
import itertools
import re
import subprocess
import sys
from collections import Counter, defaultdict
from pathlib import Path
from typing import NamedTuple

import pytest

ROOT = Path(__file__).parents[1]
HOUSE = ROOT / "workflows"
NODES, WORKFLOWS = sorted(ROOT.glob("nodes/**/*.py")), sorted(ROOT.glob("workflows/**/*.py"))
HEAVY = {"colour", "kornia", "OpenEXR", "scipy", "matplotlib", "skimage"}
FORBIDDEN_IN_NODES = {"yaml", "ruamel", "emcee", "typer", "rich", "jinja2", "logging", "xxhash"}

# --- what is allowed ------------------------------------------------------------------------------

#: The rooms in order: a file imports its own room and earlier ones.
ROOMS = (
    "graph", "keys", "observation", "recipe.text", "recipe.blocks", "recipe.distributions", "recipe", "store",
    "placement", "tolerance", "engine", "report.figures", "report", "contract", "explain", "simulation", "comparison",
    "safety", "restoration", "protection", "priors", "sweeps", "training", "evaluation", "frames", "calibration",
    "studies", "api", "handbook", "answers", "cli",
)  # fmt: skip
DOOR = ""  #: neusee.workflows itself, which offers names of all rooms: no room imports it

#: From a room to a later one, for types alone: nothing is imported when the program runs. These
#: are the only cycles of rooms.
UPWARD = {
    ("graph", "recipe.blocks"): "a field of Recipe: what it says of training, safety, evaluation",
    ("graph", "recipe.distributions"): "a field of Recipe: what it is not sure of",
}

#: Rooms that answer a command each, and do not import one another.
COMMANDS = (
    "contract",
    "explain",
    "simulation",
    "comparison",
    "safety",
    "restoration",
    "sweeps",
    "training",
    "calibration",
    "evaluation",
    "studies",
)
ACROSS = {
    ("simulation", "explain"): "a run says why each of its steps ran",
    (
        "training",
        "explain",
    ): "a training says why it begins anew, in the words that say why a step runs again",
    (
        "studies",
        "calibration",
    ): "the study of calibration judges the posterior that this room computes",
}

#: Rooms inside a family of nodes, which serve that family alone.
FAMILY_ROOMS = frozenset(
    ".".join(path.parent.relative_to(ROOT / "nodes").parts)
    for path in ROOT.glob("nodes/*/*/__init__.py")
)
ACROSS_FAMILIES = {
    ("losses", "restore.inverse"): "a mask is judged by the filter that restores its frames",
    (
        "metrics",
        "restore.inverse",
    ): "the PSF of a channel is that of a grey scene, as in the filter",
    ("restore", "optics.transform"): "lengths of FFTs, and axes that are centred",
}

#: Files of each kind of study: they share `run_study`, and import nothing of another kind.
STUDIES = {
    "accuracy": ("accuracy_study", "accuracy_page", "recipe_knobs", "work_precision"),
    "stability": ("stability_study", "extreme_cases", "case_result"),
    "leave_out": ("leave_out_study", "left_out_steps"),
    "calibration": ("calibration_study", "posterior_tests"),
    "uncertainty": (
        "uncertainty_study",
        "uncertainty_page",
        "sobol_indices",
        "output_draws",
        "linear_propagation",
        "linear_page",
        "reused_choices",
    ),
    "protection": ("protection_study",),
}
KIND_OF_STUDY = {name: kind for kind, names in STUDIES.items() for name in names}

#: Calls that import a module by a name that is only known when they run.
DYNAMIC = {
    "__init__.py": "the names that workflows offers are imported when they are first used",
    "keys/module_digest.py": (
        "a node imports a module when it runs, and the values of the module count before"
    ),
    "report/run_pictures.py": "report.contents names the function that draws each picture",
    "studies/run_study.py": "a kind of study names its room",
    "recipe/node_families.py": "a recipe names the family of a node",
    **{
        f"{room}/lazy_imports.py": "a module that takes long is imported when it is first used"
        for room in ("api", "cli", "recipe", "store")
    },
    "cli/program_options.py": "a command line names the command, whose module alone is imported",
    "training/run_training.py": "TensorBoard is optional, and has no types",
}

#: Files that may use pi.
PI = {
    "recipe/blocks/train_block.py": "half a cosine, along which the rate of training falls",
    "training/mask_optimisers.py": "half a cosine, along which a rate falls, and the bound of an angle",
}
#: files that fork a process and end it
FORKS = {
    "engine/step_process.py": (
        "a step of own code computes in a fork, which flushes what it printed and ends"
    ),
}
MEASURED = {
    "clear_peak",
    "wavelengths",
    "centres",
}  #: fields of neusee.nodes.values that formulas of optics are made of

# --- what a file says -----------------------------------------------------------------------------


class Import(NamedTuple):
    """One name that is imported."""

    module: str
    name: str  #: empty: the module itself
    line: int
    when: str  #: top, function or type

    @property
    def full(self):
        return f"{self.module}.{self.name}".rstrip(".")


@functools.cache
def imports(tree):
    """Every name that is imported, and when: at module level, in a function, or for types alone."""
    return tuple(_imports(tree, "top"))


def _imports(tree, when):
    for item in ast.iter_child_nodes(tree):
        inner = when
        if isinstance(item, ast.FunctionDef | ast.AsyncFunctionDef | ast.Lambda):
            inner = "function"
        elif isinstance(item, ast.If) and "TYPE_CHECKING" in ast.unparse(item.test):
            inner = "type"
        if isinstance(item, ast.ImportFrom):
            assert item.level == 0, "import by the full name"
            yield from (Import(item.module, alias.name, item.lineno, when) for alias in item.names)
        elif isinstance(item, ast.Import):
            yield from (Import(alias.name, "", item.lineno, when) for alias in item.names)
        else:
            yield from _imports(item, inner)


@functools.cache
def parsed(path):
    return ast.parse(path.read_text())


@functools.cache
def items_of(tree):
    """Every node of a syntax tree; the rules ask for the same trees again and again."""
    return tuple(ast.walk(tree))


@functools.cache
def calls_of(tree):
    """Every call of a syntax tree, with the text of what is called."""
    return tuple(
        (item, ast.unparse(item.func)) for item in items_of(tree) if isinstance(item, ast.Call)
    )


def house():
    """The files of workflows: syntax trees by path."""
    return {path.relative_to(HOUSE).as_posix(): parsed(path) for path in WORKFLOWS}


def alone(file, code=""):
    """One file, with more code in it."""
    if not code:
        return {file: parsed(HOUSE / file)}
    source = (HOUSE / file).read_text() if (HOUSE / file).exists() else ""
    return {file: ast.parse(f"{source}\n{code}\n")}


def room_of(module):
    """The innermost room of a module below neusee.workflows."""
    return next(
        (
            room
            for room in sorted(ROOMS, key=len, reverse=True)
            if f"{module}.".startswith(f"{room}.")
        ),
        DOOR,
    )


def home(file):
    return room_of(file.removesuffix(".py").removesuffix("/__init__").replace("/", "."))


def outer(room):
    return room.partition(".")[0]


def edges(files):
    """(from, to, when, where) of every import from one room to another."""
    for file, tree in files.items():
        for each in imports(tree):
            if f"{each.full}.".startswith("neusee.workflows."):
                target = room_of(each.full.removeprefix("neusee.workflows").lstrip("."))
                if target != home(file):
                    yield home(file), target, each.when, f"{file}:{each.line}: {each.full}"


def is_later(room, other):
    return other == DOOR or (room != DOOR and ROOMS.index(other) > ROOMS.index(room))


# --- the rules: offences of a house ---------------------------------------------------------------


def direction(files):
    """Imports of a later room, in a function as well, but for those for types alone that are
    allowed.
    """
    allowed = {(source, target) for source, target in UPWARD}
    for source, target, when, where in edges(files):
        if (
            source != DOOR
            and is_later(source, target)
            and (when != "type" or (source, target) not in allowed)
        ):
            yield (
                f"{where} ({when}): {source} imports {target or 'the whole of workflows'}, which"
                " comes later"
            )


def cycles(files):
    """Rooms that need each other, whether a file, a function or a type imports, but for
    `UPWARD`.
    """
    needs = defaultdict(set)
    for source, target, _, _ in edges(files):
        if DOOR not in (source, target) and (source, target) not in UPWARD:
            needs[source].add(target)
    yield from circles(needs)


def circles(needs):
    """What needs itself through others, from a name to the names that it needs."""
    left = dict(needs)
    while free := [name for name, below in left.items() if left.keys().isdisjoint(below)]:
        left = {name: below for name, below in left.items() if name not in free}
    for name in sorted(left):
        yield f"{name} and {', '.join(sorted(left[name] & left.keys()))} need each other"


def siblings(files):
    """Imports between rooms that answer a command each, and between kinds of studies."""
    for source, target, _, where in edges(files):
        one, other = outer(source), outer(target)
        if one != other and {one, other} <= set(COMMANDS) and (one, other) not in ACROSS:
            yield f"{where}: {one} imports {other}"
    for file, tree in files.items():
        kind = KIND_OF_STUDY.get(Path(file).stem)
        if home(file) != "studies" or kind is None:
            continue
        for each in imports(tree):
            other = KIND_OF_STUDY.get(
                each.full.removeprefix("neusee.workflows.studies.").partition(".")[0]
            )
            if each.full.startswith("neusee.workflows.studies.") and other not in (None, kind):
                yield f"{file}:{each.line}: the study {kind} imports {each.full}"


def pure(files):
    """Imports of other rooms in graph when the program runs, and functions there that run or
    draw.
    """
    for file, tree in files.items():
        if home(file) != "graph":
            continue
        for item in items_of(tree):
            if isinstance(item, ast.FunctionDef) and re.search("^run$|html", item.name):
                yield f"{file}:{item.lineno}: {item.name}"
        for source, target, when, where in edges({file: tree}):
            if when != "type":
                yield f"{where}: {source} imports {target}"


def exits(files):
    """Ends of the program, and imports of typer, outside cli."""
    for file, tree in files.items():
        if home(file) == "cli" or file in FORKS:
            continue
        yield from (
            f"{file}:{e.line}: {e.full}"
            for e in imports(tree)
            if outer(e.full) in ("typer", "click")
        )
        for item, called in calls_of(tree):
            if called in ("sys.exit", "os._exit", "exit", "quit"):
                yield f"{file}:{item.lineno}: {called}"
        for item in items_of(tree):
            raised = ast.unparse(item.exc) if isinstance(item, ast.Raise) and item.exc else ""
            if raised.startswith("SystemExit"):
                yield f"{file}:{item.lineno}: {raised}"


def terminal(files):
    """Words to a terminal outside cli, and the console and the live table of report."""
    for file, tree in files.items():
        if home(file) == "cli" or file in ("report/console.py", *FORKS):
            continue
        names = [
            e
            for e in imports(tree)
            if outer(e.full) == "rich" or e.full in ("sys.stdout", "sys.stderr")
        ]
        yield from (f"{file}:{e.line}: {e.full}" for e in names)
        streams = [
            (item, f"{item.value.id}.{item.attr}") for item in items_of(tree) if _dotted(item)
        ]
        for item, said in (*calls_of(tree), *streams):
            if said in (
                "print",
                "input",
                "sys.stdout",
                "sys.stderr",
                "sys.__stdout__",
                "sys.__stderr__",
            ):
                yield f"{file}:{item.lineno}: {said}"


def _dotted(item):
    return isinstance(item, ast.Attribute) and isinstance(item.value, ast.Name)


def samplers(files):
    """Imports of emcee outside calibration."""
    for file, tree in files.items():
        if home(file) != "calibration":
            yield from (f"{file}:{e.line}" for e in imports(tree) if outer(e.full) == "emcee")


def private(files):
    """Imports of an underscored module, or name, of nodes or of another file of workflows."""
    for file, tree in files.items():
        for each in imports(tree):
            if each.full.startswith("neusee.") and re.search(r"\._[a-z]", each.full):
                yield f"{file}:{each.line}: {each.full}"


def family_rooms(files):
    """Imports of a room inside a family of nodes, or of its files, from outside of that family."""
    for file, tree in files.items():
        for each in imports(tree):
            family, _, inner = each.full.removeprefix("neusee.nodes.").partition(".")
            room = f"{family}.{inner.partition('.')[0]}"
            is_outside = not file.startswith(f"nodes/{family}/")
            if each.full.startswith("neusee.nodes.") and room in FAMILY_ROOMS and is_outside:
                yield f"{file}:{each.line}: {each.full}"


def dynamic(files, allowed=DYNAMIC):
    """Calls that import a module by a name, but for those that are allowed."""
    for file, tree in files.items():
        for item, called in calls_of(tree):
            if called.rpartition(".")[2] in ("import_module", "__import__") and file not in allowed:
                yield f"{file}:{item.lineno}: {called}"


def formulas(files, allowed=PI):
    """Signs of a formula of physics: pi, a constant of nature, or arithmetic with what a node
    measured.

    It sees pi of any library, imports of neusee.nodes.constants and scipy.constants, and a product,
    a quotient or a power of `MEASURED` fields, unless the other side is a number: nanometres are no
    physics. It does not see a formula that is written with plain names.
    """
    for file, tree in files.items():
        for each in imports(tree):
            if (
                each.full.startswith(("neusee.nodes.constants", "scipy.constants"))
                or each.full == "math.pi"
            ):
                yield f"{file}:{each.line}: {each.full}"
        for item in items_of(tree):
            if isinstance(item, ast.Attribute) and item.attr == "pi" and file not in allowed:
                yield f"{file}:{item.lineno}: {ast.unparse(item)}"
            if isinstance(item, ast.BinOp) and isinstance(item.op, ast.Mult | ast.Div | ast.Pow):
                sides = (item.left, item.right)
                if any(map(_is_measured, sides)) and not any(
                    isinstance(side, ast.Constant) for side in sides
                ):
                    yield f"{file}:{item.lineno}: {ast.unparse(item)}"


def _is_measured(side):
    """Whether a value is a measured field, or a method, an item or a part of one."""
    if isinstance(side, ast.Attribute):
        return side.attr in MEASURED or (side.attr != "shape" and _is_measured(side.value))
    if isinstance(side, ast.Call):
        inside = side.args if ast.unparse(side.func) == "float" else []
        return _is_measured(side.func) or any(map(_is_measured, inside))
    if isinstance(side, ast.BinOp):
        return _is_measured(side.left) or _is_measured(side.right)
    return isinstance(side, ast.Subscript | ast.UnaryOp) and _is_measured(
        getattr(side, "value", None) or side.operand
    )


def defined(tree):
    """Names that a module defines at its top, without what it imports."""
    for item in tree.body:
        if isinstance(item, ast.FunctionDef | ast.AsyncFunctionDef | ast.ClassDef):
            yield item.name
        elif isinstance(item, ast.Assign | ast.AnnAssign):
            targets = item.targets if isinstance(item, ast.Assign) else [item.target]
            yield from (
                n.id for target in targets for n in ast.walk(target) if isinstance(n, ast.Name)
            )


def classes(files):
    """Public classes of one name in a room with its inner rooms."""
    found = Counter(
        (file.partition("/")[0], item.name)
        for file, tree in files.items()
        for item in tree.body
        if isinstance(item, ast.ClassDef) and not item.name.startswith("_")
    )
    yield from (f"{room}: {name} is {n} classes" for (room, name), n in found.items() if n > 1)


def names(files):
    """Names in a room that are a module, or an inner room, and a public function too."""
    modules, functions = defaultdict(set), defaultdict(set)
    for file, tree in files.items():
        room = file.partition("/")[0]
        modules[room] |= set(file.removesuffix(".py").split("/")[1:]) - {"__init__"}
        functions[room] |= {
            i.name
            for i in tree.body
            if isinstance(i, ast.FunctionDef) and not i.name.startswith("_")
        }
    yield from (
        f"{room}: {name}" for room in modules for name in sorted(modules[room] & functions[room])
    )


def places(files):
    """Files outside of a room, rooms that the list does not name, and names of the list that are
    no room.
    """
    for file in files:
        folder = file.rpartition("/")[0].replace("/", ".")
        if file != "__init__.py" and folder not in ROOMS:
            yield f"{file} stands in no room of the list"
    yield from (
        f"{room} is no room"
        for room in ROOMS
        if f"{room.replace('.', '/')}/__init__.py" not in files
    )


def offers(files):
    """Rooms whose `__init__` does not ask a question and name what the room offers, or holds
    more than words.
    """
    for room in ROOMS:
        file = f"{room.replace('.', '/')}/__init__.py"
        tree = files[file]
        question, _, rest = (ast.get_docstring(tree) or "").partition("\n\n")
        offered = re.findall(r"`(\w+)\.(\w+)`", rest.partition("Offers: ")[2])
        if not question.endswith("?") or not offered:
            yield f"{file}: no question, or nothing that it offers"
        if len(tree.body) != 1:
            yield f"{file}: more than a docstring"
        for module, name in offered:
            path = file.replace("__init__", module)
            if path not in files or name not in defined(files[path]):
                yield f"{file}: offers {module}.{name}, which is not there"


FILE_RULES = (
    direction, pure, siblings, exits, terminal, samplers, private, family_rooms, dynamic, formulas,
)  # fmt: skip
HOUSE_RULES = (classes, names, places, offers, cycles)

# --- the tests ------------------------------------------------------------------------------------

#: modules of nodes/ itself, each with the modules of neusee.nodes that it may import
BELOW = {
    **{name: set() for name in ("units.py", "constants.py", "values.py", "own_modules.py")},
    "parameters.py": {"neusee.nodes.units"},
    "_node.py": {"neusee.nodes.own_modules", "neusee.nodes.parameters"},
}


def where(paths, offends):
    """The imports that offend, each with its file and line."""
    return [
        f"{path.relative_to(ROOT)}:{each.line}: {each.full}"
        for path in paths
        for each in imports(parsed(path))
        if offends(each)
    ]


def test_the_house_is_imported_by_its_full_name():
    assert not where(
        NODES + WORKFLOWS, lambda each: outer(each.module) in ("nodes", "workflows", "recipes")
    )


def test_nodes_know_only_physics():
    assert not where(
        NODES, lambda each: each.full.startswith(("neusee.workflows", "neusee.recipes"))
    )
    assert not where(NODES, lambda each: outer(each.full) in FORBIDDEN_IN_NODES)


def test_units_below_node_below_the_families():
    for name, allowed in BELOW.items():
        names = {
            e.module
            for e in imports(parsed(ROOT / "nodes" / name))
            if e.module.startswith("neusee.nodes")
        }
        assert names <= allowed, name


def test_no_two_families_of_nodes_need_each_other():
    needs = defaultdict(set)
    families = {path.parent.name for path in ROOT.glob("nodes/*/__init__.py")}
    for path in NODES:
        family = path.relative_to(ROOT / "nodes").parts[0]
        for each in imports(parsed(path)):
            needed = each.full.removeprefix("neusee.nodes.").partition(".")[0]
            if family in families and needed in families - {family}:
                needs[family].add(needed)
    assert needs, "the families are found"
    assert not list(circles(needs))


def node_files():
    """The files of nodes: syntax trees by path."""
    return {path.relative_to(ROOT).as_posix(): parsed(path) for path in NODES}


def test_a_room_of_a_family_serves_that_family_alone():
    assert FAMILY_ROOMS, "the rooms are found"
    crossings = set()
    for line in family_rooms(node_files()):
        family = line.split("/")[1]
        crossings |= {(family, room) for room in FAMILY_ROOMS if f"neusee.nodes.{room}." in line}
    assert crossings == set(ACROSS_FAMILIES)


def test_heavy_imports_wait_until_they_are_needed():
    assert not where(NODES, lambda each: each.when == "top" and outer(each.module) in HEAVY)


@pytest.mark.parametrize("rule", FILE_RULES + HOUSE_RULES, ids=lambda rule: rule.__name__)
def test_the_house_keeps_the_rule(rule):
    assert not list(rule(house()))


def test_workflows_holds_rooms_and_nothing_else():
    there = {path.name for path in HOUSE.iterdir()} - {"__pycache__"}
    assert there == {"__init__.py"} | {outer(room) for room in ROOMS}


def test_every_exception_is_needed():
    found = list(edges(house()))
    assert {(a, b) for a, b, _, _ in found if a != DOOR and is_later(a, b)} == set(UPWARD)
    assert {
        (outer(a), outer(b)) for a, b, _, _ in found if {outer(a), outer(b)} <= set(COMMANDS)
    } >= set(ACROSS)
    assert {line.partition(":")[0] for line in dynamic(house(), allowed=())} == set(DYNAMIC)
    assert {line.partition(":")[0] for line in formulas(house(), allowed=())} == set(PI)


# --- planted offences -----------------------------------------------------------------------------


def later(room):
    """A room that a room may not import: the last one, and for the last one all of workflows."""
    return (
        "neusee.workflows import load"
        if room == ROOMS[-1]
        else "neusee.workflows.cli.app import app"
    )


@pytest.mark.parametrize(
    "form",
    ["from {}", "def _():\n    from {}", "if TYPE_CHECKING:\n    from {}"],
    ids=["top", "function", "type"],
)
def test_a_forbidden_import_that_is_planted_in_a_room_is_found(form):
    for room in ROOMS:
        file = first_file(room)
        found = list(direction(alone(file, form.format(later(room)))))
        assert len(found) == 1, room
        assert found[0].startswith(f"{file}:")


def test_the_very_next_room_is_later():
    for room, after in itertools.pairwise(ROOMS):
        up = alone(first_file(room), f"import neusee.workflows.{after}.some_module")
        down = alone(first_file(after), f"import neusee.workflows.{room}.x")
        assert len(list(direction(up))) == 1, room
        assert not list(direction(down)), room


def first_file(room):
    return f"{room.replace('.', '/')}/__init__.py"


def test_what_is_allowed_for_types_is_forbidden_when_the_program_runs():
    for source, target in UPWARD:
        file, code = f"{source.replace('.', '/')}/__init__.py", f"import neusee.workflows.{target}"
        assert not list(direction(alone(file, f"if TYPE_CHECKING:\n    {code}")))
        assert len(list(direction(alone(file, f"def _():\n    {code}")))) == 1
        assert len(list(direction(alone(file, code)))) == 1


OFFENCES = [
    (siblings, "training/run_training.py", "import neusee.workflows.sweeps.axes"),
    (
        siblings,
        "evaluation/pipelines.py",
        "def _():\n    from neusee.workflows.training import checkpoint",
    ),
    (
        siblings,
        "evaluation/pipelines.py",
        "from neusee.workflows.calibration.run_calibration import calibrate",
    ),
    (siblings, "calibration/emcee_sampler.py", "from neusee.workflows.sweeps import axes"),
    (
        siblings,
        "studies/leave_out_study.py",
        "from neusee.workflows.studies import recipe_knobs",
    ),
    (exits, "engine/runner.py", "sys.exit(1)"),
    (exits, "store/lease.py", "raise SystemExit"),
    (exits, "report/console.py", "def _():\n    import typer"),
    (exits, "training/run_training.py", "os._exit(3)"),
    (terminal, "sweeps/sweep_run.py", "print('done')"),
    (terminal, "engine/runner.py", "sys.stderr.write('x')"),
    (terminal, "engine/runner.py", "from sys import stdout"),
    (terminal, "report/run_page.py", "from rich.console import Console"),
    (samplers, "studies/calibration_study.py", "def _():\n    import emcee"),
    (
        private,
        "report/data_exports.py",
        "def _():\n    from neusee.nodes.scene._exr import write_spectral",
    ),
    (private, "training/run_training.py", "import neusee.nodes._node"),
    (private, "engine/runner.py", "from neusee.nodes.doe import _refractive_index"),
    (private, "engine/runner.py", "from neusee.workflows.store.lease import _name"),
    (family_rooms, "restoration/frame_recipes.py", "from neusee.nodes.restore import inverse"),
    (family_rooms, "engine/runner.py", "import neusee.nodes.optics.transform"),
    (
        family_rooms,
        "training/run_training.py",
        "def _():\n    from neusee.nodes.restore.networks import tiled",
    ),
    (family_rooms, "safety/run_safety.py", "import neusee.nodes.restore.lasers._find_lasers"),
    (family_rooms, "nodes/scene/_exr.py", "from neusee.nodes.restore.networks import tiled"),
    (dynamic, "engine/runner.py", "importlib.import_module('neusee.workflows.cli.app')"),
    (dynamic, "keys/cache_key.py", "__import__('neusee.workflows.cli')"),
    (formulas, "report/figures/optics.py", "area = np.pi * radius**2"),
    (formulas, "engine/runner.py", "from math import pi"),
    (formulas, "sweeps/axes.py", "from neusee.nodes.constants import PLANCK"),
    (formulas, "sweeps/axes.py", "from scipy.constants import c"),
    (
        formulas,
        "training/training_iteration.py",
        "x = psf.intensity.amax((-2, -1)).double() / psf.clear_peak.cpu()",
    ),
    (formulas, "report/run_summary.py", "x = float((line.centres * line.weights).sum())"),
    (formulas, "report/run_summary.py", "x = height / pupil.wavelengths[band]"),
    (classes, "store/lease.py", "class Store:\n    pass"),
    (classes, "recipe/text/overrides.py", "class Uncertain:\n    pass"),
    (names, "store/lease.py", "def result_store():\n    pass"),
    (names, "studies/run_study.py", "def accuracy_study():\n    pass"),
    (places, "helpers.py", "x = 1"),
    (places, "engine/loops/__init__.py", "x = 1"),
    (offers, "graph/__init__.py", "import torch"),
    (pure, "graph/step_shapes.py", "def run(self):\n    pass"),
    (pure, "graph/recipe_graph.py", "def _repr_html_(self):\n    pass"),
    (pure, "graph/recipe_graph.py", "def _():\n    import neusee.workflows.keys.cache_key"),
]


@pytest.mark.parametrize(
    "rule", dict.fromkeys(rule for rule, _, _ in OFFENCES), ids=lambda rule: rule.__name__
)
def test_a_planted_offence_is_found(rule):
    for _, file, code in (offence for offence in OFFENCES if offence[0] is rule):
        found = list(rule({**(house() if rule in HOUSE_RULES else {}), **alone(file, code)}))
        assert len(found) == 1, f"one offence, found once: {file}: {code}"


@pytest.mark.parametrize(
    "words",
    [
        '"""What?\n\nOffers: `runner.gone`."""',
        '"""Rooms.\n\nOffers: `runner.run`."""',
        '"""What?"""',
        "pass",
    ],
)
def test_a_room_that_does_not_say_what_it_offers_is_found(words):
    assert len(list(offers({**house(), "engine/__init__.py": ast.parse(words)}))) == 1


def test_a_room_that_is_gone_is_missed():
    files = {file: tree for file, tree in house().items() if not file.startswith("placement/")}
    assert list(places(files)) == ["placement is no room"]


@pytest.mark.parametrize("form", ["{}", "def _():\n    {}", "if TYPE_CHECKING:\n    {}"])
def test_a_planted_circle_of_rooms_is_found(form):
    code = form.format("import neusee.workflows.report.notebook")
    circle = list(cycles({**house(), **alone("engine/runner.py", code)}))
    assert any(line.startswith("engine and") for line in circle)
    assert any(line.startswith("report and") for line in circle)


def test_nanometres_are_no_formula():
    assert not list(formulas(alone("report/figures/optics.py", "x = bands.centres.double() * 1e9")))


# --- imports cost little --------------------------------------------------------------------------


def test_importing_every_node_loads_nothing_heavy():
    families = sorted(p.parent.name for p in ROOT.glob("nodes/*/__init__.py"))
    lines = "; ".join(f"import neusee.nodes.{f}" for f in families)
    heavy = (
        "sorted(set(m.split('.')[0] for m in sys.modules) &"
        f" {HEAVY | {'emcee', 'ruamel', 'typer'}!r})"
    )
    done = subprocess.run(
        [sys.executable, "-c", f"import sys; {lines}; print({heavy})"],
        capture_output=True,
        text=True,
        check=True,
        cwd=ROOT / "tests",
        env={"PYTHONPATH": str(ROOT / ".src"), "PATH": ""},
    )
    assert done.stdout.strip() == "[]"
