"""Recipes of a stranger who means harm: the text of each, the files beside it, and what it tries.

A recipe is written into a folder of its own. Beside that folder there is one with a secret: a text,
numbers and a picture. Code that runs would leave a file `ran` there.
"""

from __future__ import annotations

import io
import os
import pickle
import zipfile
from collections.abc import Callable
from pathlib import Path
from typing import NamedTuple

import numpy as np

SECRET = "a-secret-of-the-reader"
NUMBER = 0.0625  #: grey of the secret picture
SCRIPT = "<script>stranger()</script>"
PICTURE = '<img src=x onerror="stranger()">'
#: as YAML writes it in double quotes: clears the screen, names the window
ESCAPE = "\\e[2J\\e]0;stranger\\a"

STEPS = """
steps:
  scene: {node: scene.targets, with: {kind: siemens, shape: [8, 8]}}
  raw: {node: sensor.digitize, from: {electrons: scene}, with: {gain: 0.5 e-/DN}}
"""
PLAIN = "# A stranger's recipe.\noutputs: [raw]\ntolerance: 0\n" + STEPS


class Hostile(NamedTuple):
    """One recipe of a stranger."""

    text: str
    make: Callable[[Path], None] = lambda folder: None  #: makes files beside the recipe
    runs: bool = False  #: the recipe is valid, and its run must do no harm


class _Payload:
    """An object whose unpickling runs code."""

    def __init__(self, target: Path) -> None:
        self.target = str(target)

    def __reduce__(self) -> tuple[object, ...]:
        return Path.touch, (Path(self.target),)


def _pickled(folder: Path) -> bytes:
    return pickle.dumps(_Payload(folder.parent / "ran"))


def _weights(name: str) -> Callable[[Path], None]:
    """Return what writes a checkpoint of torch with a pickle that runs code."""

    def make(folder: Path) -> None:
        with zipfile.ZipFile(folder / name, "w") as archive:
            archive.writestr("archive/data.pkl", _pickled(folder))
            archive.writestr("archive/version", "3\n")
            archive.writestr("archive/byteorder", "little")

    return make


def _object_array(folder: Path) -> None:
    np.save(
        folder / "a.npy", np.array([[_Payload(folder.parent / "ran")]], object), allow_pickle=True
    )


def _object_table(folder: Path) -> None:
    raw = io.BytesIO()
    np.save(raw, np.array([_Payload(folder.parent / "ran")] * 40, object), allow_pickle=True)
    with zipfile.ZipFile(folder / "a.npz", "w") as archive:
        archive.writestr("gain.npy", raw.getvalue())


def _code(name: str) -> Callable[[Path], None]:
    """Return what writes a module whose import runs code."""

    def make(folder: Path) -> None:
        (folder / name).parent.mkdir(exist_ok=True)
        (folder / name).write_text(f"open({str(folder.parent / 'ran')!r}, 'w')\n")

    return make


def _link(name: str, target: str) -> Callable[[Path], None]:
    """Return what makes a link out of the folder of the recipe."""

    def make(folder: Path) -> None:
        (folder / name).parent.mkdir(exist_ok=True)
        (folder / name).symlink_to(folder.parent / target)

    return make


def _pipe(folder: Path) -> None:
    os.mkfifo(folder / "a.npy")


def _option(name: str, text: str) -> Callable[[Path], None]:
    def make(folder: Path) -> None:
        (folder / name).parent.mkdir(exist_ok=True)
        (folder / name).write_text(text)

    return make


def _cached(folder: Path) -> None:
    (folder / "pyproject.toml").write_text('name = "neusee"\n')
    (folder / "cache").mkdir()


def picture(file: str) -> str:
    """Return a recipe that shows a picture of a file."""
    steps = f"steps:\n  raw: {{node: scene.photograph, with: {{file: {file}, shape: [8, 8]}}}}\n"
    return f"# A picture.\noutputs: [raw]\ntolerance: 0\n{steps}"


def cube(file: str) -> str:
    """Return a recipe that shows a cube of a file."""
    bands = "bands: {node: spectra.bands, with: {start: 400 nm, stop: 700 nm, count: 4}}"
    raw = (
        f"raw: {{node: scene.hyperspectral, from: bands, with: {{file: {file}, start: 400 nm, stop:"
        " 700 nm}}"
    )
    return f"# A cube.\noutputs: [raw]\ntolerance: 0\nsteps:\n  {bands}\n  {raw}\n"


def table(file: str) -> str:
    """Return a recipe that reads a table of frames."""
    return (
        "# A table.\noutputs: [raw]\nsteps:\n  raw: {node: calibrate.table, with: {file:"
        f" {file}}}}}\n"
    )


def network(settings: str) -> str:
    """Return a recipe that restores with a network of a file."""
    scene = "scene: {node: scene.targets, with: {kind: siemens, shape: [32, 32]}}"
    rgb = f"raw: {{node: restore.network, from: scene, with: {settings}}}"
    return f"# A network.\noutputs: [raw]\nsteps:\n  {scene}\n  {rgb}\n"


def lift(file: str) -> str:
    """Return a recipe that reads the weights of a lift to spectra."""
    return (
        "# A lift.\noutputs: [raw]\nsteps:\n"
        "  bands: {node: spectra.bands, with: {start: 400 nm, stop: 700 nm, count: 31}}\n"
        "  scene: {node: scene.targets, with: {kind: siemens, shape: [32, 32]}}\n"
        f"  raw: {{node: spectra.mst_lift, from: [scene, bands], with: {{weights: {file}}}}}\n"
    )


def valued(value: str) -> str:
    """Return a recipe whose gain is a text of its own."""
    return PLAIN.replace("0.5 e-/DN", value)


def _bomb() -> str:
    lines = ["a0: &a0 [x, x, x, x, x, x, x, x, x, x]"]
    lines += [f"a{i}: &a{i} [{', '.join([f'*a{i - 1}'] * 10)}]" for i in range(1, 10)]
    return PLAIN + "\n".join(lines) + "\n"


def _references() -> str:
    lines = ["b:", "  r0: [x, x, x, x, x, x, x, x, x, x]"]
    lines += [f"  r{i}: [{', '.join([f'${{b.r{i - 1}}}'] * 10)}]" for i in range(1, 10)]
    return PLAIN.replace("8, 8", "8, '${b.r9}'") + "\n".join(lines) + "\n"


HOSTILE: dict[str, Hostile] = {
    # text that is more than data
    "a tag of Python": Hostile(PLAIN + "a: !!python/object/apply:os.system ['touch ../ran']\n"),
    "a tag of a class": Hostile(PLAIN + "a: !<tag:yaml.org,2002:python/name:os.system> x\n"),
    "a billion laughs": Hostile(_bomb()),
    "a billion references": Hostile(_references()),
    "an alias of itself": Hostile(PLAIN + "a: &a [*a]\n"),
    "a reference to itself": Hostile(PLAIN.replace("0.5 e-/DN", "${b.a}") + "b: {a: '${b.c}', c: '${b.a}'}\n"),
    "deep brackets": Hostile(PLAIN + "a: " + "[" * 100_000 + "\n"),
    "deep brackets that close": Hostile(PLAIN + "a: " + "[" * 3000 + "]" * 3000 + "\n"),
    "deep brackets within a value": Hostile(PLAIN.replace("8, 8", "8, " + "[" * 200 + "]" * 200)),
    "a number of many digits": Hostile(PLAIN.replace("8, 8", "8, " + "9" * 5000)),
    "a seed of many digits": Hostile(PLAIN + "seed: " + "9" * 4000 + "\n"),
    "an expression": Hostile(valued("'${__import__(''os'').system(''touch ../ran'')}'")),
    "a template": Hostile(valued("'{{ cycler.__init__.__globals__.os.popen(''touch ../ran'') }}'")),
    "a variable of the environment": Hostile(picture("$STRANGER/secret.png")),
    "a reference to the environment": Hostile(picture("'${env.STRANGER}/secret.png'")),
    # code by name
    "a module beside the recipe": Hostile("nodes: [evil.py]\n" + PLAIN, _code("evil.py")),
    "a folder of code": Hostile("nodes: [./evil]\n" + PLAIN, _code("evil/__init__.py")),
    "a module above": Hostile("nodes: [../evil.py]\n" + PLAIN, _code("../evil.py")),
    "code under a name": Hostile("nodes: [{sensor: evil.py}]\n" + PLAIN, _code("evil.py")),
    "code in an option": Hostile(
        "defaults: [{spill: g}]\n" + PLAIN,
        lambda folder: (_code("evil.py")(folder), _option("spill/g.yaml", "nodes: [../evil.py]\n")(folder)),
    ),
    "code that is no list": Hostile("nodes: evil.py\n" + PLAIN, _code("evil.py")),
    "a node of a module": Hostile(PLAIN.replace("scene.targets", "os.system")),
    "a node of another attribute": Hostile(PLAIN.replace("scene.targets", "scene.__builtins__")),
    "a family by its path": Hostile(PLAIN.replace("scene.targets", "../evil.f"), _code("evil.py")),
    "a class by its name": Hostile(network("{architecture: subprocess.Popen}")),
    "a class of a module beside": Hostile(network("{architecture: evil.Net}"), _code("evil.py")),
    "a class of an unsafe module": Hostile(network("{architecture: torch.nn.Linear}")),
    # files that hold code
    "a pickle for a network": Hostile(network("{weights: a.pt}"), _weights("a.pt")),
    "a pickle with another name": Hostile(
        network("{weights: a.safetensors}"), lambda folder: (folder / "a.safetensors").write_bytes(_pickled(folder))
    ),
    "a graph of torch.export": Hostile(network("{weights: a.pt2}"), _weights("a.pt2")),
    "a graph by a link": Hostile(
        network("{weights: b.pt2}"),
        lambda folder: (_weights("a.bin")(folder), (folder / "b.pt2").symlink_to("a.bin")),
    ),
    "a checkpoint of a lift": Hostile(lift("a.pt"), _weights("a.pt")),
    "an old pickle of a lift": Hostile(lift("a.pth"), lambda f: (f / "a.pth").write_bytes(_pickled(f))),
    "an array of objects": Hostile(cube("a.npy"), _object_array),
    "a table of objects": Hostile(valued("'empirical(a.npz, column gain)'"), _object_table),
    "a posterior of objects": Hostile("posterior: a.npz\n" + PLAIN, _object_table),
    # files that are not the stranger's
    "a picture by its full path": Hostile(picture("{secret}/secret.png")),
    "a picture above": Hostile(picture("../secret/secret.png")),
    "a picture at home": Hostile(picture("~/secret.png")),
    "a picture by a link": Hostile(picture("a.png"), _link("a.png", "secret/secret.png")),
    "a picture in a linked folder": Hostile(picture("in/secret.png"), _link("in", "secret")),
    "a cube by its full path": Hostile(cube("{secret}/secret.npy")),
    "a table of secrets": Hostile(table("../secret/secret.csv")),
    "samples of secrets": Hostile(valued("'empirical(../secret/secret.csv)'")),
    "samples at home": Hostile(valued("'empirical(~/secret.csv)'")),
    "a posterior above": Hostile("posterior: ../secret/secret.csv\n" + PLAIN),
    "a posterior by a pattern": Hostile("posterior: ../sec*/*.csv\n" + PLAIN),
    "thresholds of damage above": Hostile("safety: {damage: {file: ../secret/secret.csv}}\n" + PLAIN),
    "an option by a link": Hostile(
        "defaults: [{spill: g}]\n" + valued("'${password}'"), _link("spill/g.yaml", "secret/secret.yaml")
    ),
    "a recipe above": Hostile("defaults: [../secret/secret.yaml]\n" + valued("'${password}'")),
    "a recipe by a link": Hostile(
        "defaults: [g]\n" + valued("'${password}'"), _link("g.yaml", "secret/secret.yaml")
    ),
    "an option above": Hostile("defaults: [{spill: ../../secret/secret}]\n" + valued("'${password}'")),
    "a group above": Hostile("defaults: [{../secret: secret}]\n" + valued("'${password}'")),
    "options in a circle": Hostile(
        "defaults: [{spill: g}]\n" + PLAIN,
        lambda folder: (
            _option("spill/g.yaml", "defaults: [h]\n")(folder),
            _option("spill/h.yaml", "defaults: [g]\n")(folder),
        ),
    ),
    "photographs of a training": Hostile("train: {photographs: ../secret}\n" + PLAIN),
    "frames above": Hostile(
        "# Frames.\noutputs: [raw]\nsteps:\n  raw: "
        "{node: calibrate.frames, with: {files: ../secret/*.png}}\n"
    ),
    "spectra above": Hostile(
        "# Spectra.\noutputs: [raw]\nsteps:\n"
        "  bands: {node: spectra.bands, with: {start: 400 nm, stop: 700 nm, count: 4}}\n"
        "  raw: {node: spectra.reflectances, from: bands, with: {sets: [], files: ../secret/secret.csv}}\n"
    ),
    "the passwords of the system": Hostile(table("/etc/passwd")),
    "the environment of the process": Hostile(table("/proc/self/environ")),
    # what is no file
    "a device without an end": Hostile(cube("/dev/zero")),
    "the memory of the process": Hostile(cube("/proc/self/mem")),
    "a pipe": Hostile(cube("a.npy"), _pipe),
    "the input of the terminal": Hostile(table("/dev/stdin")),
    "an address": Hostile(picture("https://example.org/a.png")),
    "a file at an address": Hostile(picture("file:///etc/hostname")),
    "a path of zero bytes": Hostile(picture('"a\\0.png"')),
    "a path that is too long": Hostile(picture("a" * 5000 + ".png")),
    # names that leave their place
    "an output above": Hostile(PLAIN.replace("raw", "../../x")),
    "an item above": Hostile(
        PLAIN.replace("raw: {", "raw: {each: items, ").replace("0.5 e-/DN", "'${item.gain}'")
        + 'items: {"../../../x": {gain: 0.5 e-/DN}}\n',
        runs=True,
    ),
    "an item of the root": Hostile(
        PLAIN.replace("raw: {", "raw: {each: items, ").replace("0.5 e-/DN", "'${item.gain}'")
        + 'items: {"/x": {gain: 0.5 e-/DN}, "..": {gain: 0.5 e-/DN}, "con": {gain: 0.5 e-/DN}}\n',
        runs=True,
    ),
    "a file of the run": Hostile("exports: [../../x.exr]\n" + PLAIN),
    "a step with the name of a device": Hostile(PLAIN.replace("raw", "con"), runs=True),
    "a step of other letters": Hostile(PLAIN.replace("raw", "rаw"), runs=True),
    "a step over two lines": Hostile(PLAIN.replace("raw", '"raw\\nx"')),
    # names that are more than text where they are shown
    "a step of zero bytes": Hostile(PLAIN.replace("raw", '"raw\\0"')),
    "escapes in a key": Hostile(PLAIN + f'"{ESCAPE}": 1\n'),
    "escapes in a value": Hostile(valued(f'"{ESCAPE}"')),
    "escapes in a node": Hostile(PLAIN.replace("scene.targets", f'"{ESCAPE}"')),
    "escapes in an item": Hostile(
        PLAIN.replace("raw: {", "raw: {each: items, ").replace("0.5 e-/DN", "'${item.gain}'")
        + f'items: {{"{ESCAPE}": {{gain: 0.5 e-/DN}}}}\n'
    ),
    "escapes in an expected number": Hostile(
        PLAIN + f'expect: {{"{ESCAPE}": {{step: raw, at: [0, 0, 0], value: 1, rtol: 1}}}}\n'
    ),
    "text that runs backwards": Hostile(
        PLAIN + 'expect: {"\\u202Egnp.exe": {step: raw, at: [0, 0, 0], value: 1, rtol: 1}}\n'
    ),
    "a script in the title": Hostile(PLAIN.replace("A stranger's recipe", SCRIPT), runs=True),
    "a script in an expected number": Hostile(
        PLAIN + f"expect: {{'{SCRIPT}{PICTURE}': {{step: raw, at: [0, 0, 0], value: 1, rtol: 1e9}}}}\n", runs=True
    ),
    "a script in an item": Hostile(
        PLAIN.replace("raw: {", "raw: {each: items, ").replace("0.5 e-/DN", "'${item.gain}'")
        + f"items: {{'{SCRIPT}': {{gain: 0.5 e-/DN}}}}\n",
        runs=True,
    ),
    "mathematics in a title": Hostile(PLAIN.replace("A stranger's recipe", r"$\input{/etc/passwd}$ $\frac"), runs=True),
    "a formula of a spreadsheet": Hostile(
        PLAIN + "expect: {\"=HYPERLINK('http://x')\": {step: raw, at: [0, 0, 0], value: 1, rtol: 1e9}}\n", runs=True
    ),
    # sizes
    "a picture of many pixels": Hostile(PLAIN.replace("8, 8", "4000000, 4000000")),
    "a picture of no pixels": Hostile(PLAIN.replace("8, 8", "0, -1")),
    "many bands": Hostile(
        "# Bands.\noutputs: [raw]\nsteps:\n"
        "  raw: {node: spectra.bands, with: {start: 400 nm, stop: 700 nm, count: 1000000000}}\n"
    ),
    "many copies": Hostile(
        PLAIN.replace("raw: {", "raw: {each: [a, b], ")
        + "".join(f"{name}: {{{', '.join(f'i{i}: {{}}' for i in range(300))}}}\n" for name in "ab")
    ),
    # the cache
    "a remote cache": Hostile("cache: 's3://stranger/cache'\n" + PLAIN),
    "a cache of its own": Hostile(PLAIN, _cached, runs=True),
    "steps that are not stored": Hostile(PLAIN.replace("raw: {", "raw: {cache: false, "), runs=True),
    "a step whose cache is a path": Hostile(PLAIN.replace("raw: {", "raw: {cache: ../x, ")),
    "a device of another kind": Hostile(PLAIN.replace("raw: {", "raw: {device: '../x', ")),
}  # fmt: skip
