"""What the README and the guide tell a reader to type, and the files of the reader."""

from __future__ import annotations

import contextlib
import re
import shutil
import sys
import warnings
from collections.abc import Callable, Iterator
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import torch
from PIL import Image
from safetensors.torch import save_file

from neusee.nodes import own_modules
from neusee.nodes.restore import Informed, NAFNet, start_network
from neusee.workflows.frames.sensor_group import FIRST
from neusee.workflows.recipe import node_families
from tests.deepinv_without_torchvision import deepinv_or_skip
from tests.nodes.calibrate.numpy_camera import Camera

ROOT = Path(__file__).parents[1]
GUIDE = ROOT / "recipes" / "guide"
PAGES = sorted(GUIDE.glob("*.md"))
WRITTEN = [ROOT / "README.md", ROOT / "CONTRIBUTING.md", *PAGES]
SPOKEN = re.compile(r"^(?:torchrun .* --no-python )?neusee (?P<words>[^#\n]*)")
SYNTAX = "neusee COMMAND [RECIPE] [a.b=1] [+a.b=1] [~a.b] [group=option]"

#: lines of pages that are no command of neusee, and who runs them
OTHER_LINES = {
    'pip install -e ".[test]" && pytest': "continuous integration, as its second command",
    "pip install -e . && neusee run": "continuous integration, as its first command",
    "python3 -m venv ~/neusee_env && . ~/neusee_env/bin/activate": (
        "continuous integration, in another folder"
    ),
    "pip install -e .": "continuous integration, before its first run",
    'export NEUSEE_CACHE_SECRET="a long text that only you and your group know"': "a shell",
    'export NEUSEE_CACHE_SECRET="a long text that only your group knows"': "a shell",
    "export NEUSEE_CACHE=/shared/neusee": "a shell",
    "export NEUSEE_CACHE=s3://my-bucket/neusee": "a shell",
    "export NEUSEE_CACHE=file:///shared/neusee": "a shell",
    "export NEUSEE_CACHE_LOCAL=$HOME/neusee-cache": "a shell",
    SYNTAX: "nobody: it is the grammar of a command",
}


def indented(page: Path) -> list[str]:
    """Return the indented lines of a page that stand outside of its fenced blocks."""
    text = re.sub(
        r"^```.*?^```", "", page.read_text(encoding="utf-8"), flags=re.DOTALL | re.MULTILINE
    )
    return [line.strip() for line in re.findall(r"^ {4}(?! )(.*)$", text, re.MULTILINE)]


def lines(page: Path) -> list[str]:
    """Return the commands of a page, without the word neusee."""
    found = [
        match["words"].strip()
        for line in indented(page)
        if line != SYNTAX and (match := SPOKEN.search(line))
    ]
    return [words.partition(" && ")[0] for words in found]


def blocks(page: Path, language: str) -> list[str]:
    """Return the fenced blocks of a language."""
    return re.findall(
        rf"^```{language}\n(.*?)^```", page.read_text(encoding="utf-8"), re.MULTILINE | re.DOTALL
    )


def cases(found: Callable[[Path], list[str]]) -> list[Any]:
    """Return one test case for each thing that is found on a page; what stands on several pages
    is one case.
    """
    places = {
        x: f"{page.stem}-{n}"
        for page in reversed(WRITTEN)
        for n, x in reversed(list(enumerate(found(page))))
    }
    return [pytest.param(x, id=place) for x, place in places.items()]


@contextlib.contextmanager
def forgotten_modules(*folders: Path) -> Iterator[None]:
    """Forget at the end what was imported from these folders: another folder has other files of
    these names.
    """
    before, path = set(sys.modules), list(sys.path)
    yield
    for name in set(sys.modules) - before:
        if str(getattr(sys.modules[name], "__file__", None) or "").startswith(
            tuple(map(str, folders))
        ):
            del sys.modules[name]
    sys.path[:] = path
    own_modules._files.clear()
    node_families._family_of.clear()
    node_families._installed.cache_clear()


#: packages of extras that `test` does not bring, and how a test imports one or is skipped with the
#: reason
NEEDS = {"deepinv": deepinv_or_skip}


def import_or_skip(code: str) -> None:
    """Import the packages of `NEEDS` that a block of Python imports, or skip the test with the
    reason.
    """
    for package, imported in NEEDS.items():
        if re.search(rf"^(?:from|import) {package}\b", code, re.MULTILINE):
            imported()
            # of the next versions of this package, until the end of the test
            warnings.simplefilter("ignore")


# --- the files of the reader ----------------------------------------------------------------------


def named_files() -> Iterator[tuple[str, str]]:
    """Yield the path and the text of each block that is a file of the reader."""
    for page in PAGES:
        for text in (
            block for language in ("yaml", "csv", "python") for block in blocks(page, language)
        ):
            if named := re.match(r"# (my/[\w/]+\.\w+)", text):
                yield named[1], text


def write_reader_files(folder: Path) -> None:
    """Write every file that the pages speak of: the reader's recipes, frames, photographs,
    weights and masks.
    """
    for name, text in named_files():
        path = folder / name
        path.parent.mkdir(parents=True, exist_ok=True)
        path.write_text(text, encoding="utf-8")
    _write_frames(folder / "my")
    _write_laboratory(folder / "my" / "lab")
    _write_points(folder / "points")
    shutil.copy(ROOT / "recipes" / "samples" / "camera_levels.csv", folder / "my.csv")
    (folder / "camera.csv").write_text(
        "wavelength,red,green,blue\n400,0,0,1\n550,0,1,0\n700,1,0,0\n"
    )
    for name, kind in {
        "net": partial(NAFNet, width=16),
        "best": partial(Informed, width=12),
    }.items():
        save_file(
            start_network(kind, torch.Generator().manual_seed(0)).state_dict(),
            folder / f"{name}.safetensors",
        )
    names: dict[str, Any] = {}
    exec((folder / "my" / "smallnet.py").read_text(encoding="utf-8"), names)
    save_file(names["SmallUNet"](16).state_dict(), folder / "smallnet.safetensors")
    for name, n in {"mask": 540j, "mask_128": 128j}.items():
        np.save(
            folder / f"{name}.npy", 5e-6 * (1 + np.cos(40 * np.hypot(*np.mgrid[-1:1:n, -1:1:n])))
        )
    (folder / "my_photographs").mkdir()
    for name in ("holiday.jpg", "my_photographs/one.jpg"):
        shutil.copy(ROOT / "recipes" / "samples" / "china.jpg", folder / name)
    with Image.open(folder / "holiday.jpg") as image:
        image.rotate(180).save(folder / "my_photographs" / "two.jpg")
    shutil.copytree(folder / "my_photographs", folder / "photographs")
    shutil.copy(ROOT / "recipes" / "samples" / "night.exr", folder / "street.exr")
    (folder / "mylab").mkdir()
    (folder / "mylab" / "__init__.py").write_text('"""A package of nodes."""\n', encoding="utf-8")
    shutil.copy(folder / "my" / "bloom.py", folder / "mylab" / "optics.py")


def _write_points(folder: Path) -> None:
    """Write frames of a point source as the small camera takes them."""
    folder.mkdir(parents=True, exist_ok=True)
    rng, at = np.random.default_rng(0), np.arange(24) - 12.0
    for number in range(4):
        down, right = (np.exp(-((at - shift) ** 2) / 2.6) for shift in rng.uniform(-0.5, 0.5, 2))
        light = 4000.0 * down[:, None, None] * right[:, None] * np.array([0.8, 1.0, 0.7])
        electrons = rng.poisson(light) + rng.normal(0.0, 2.4, light.shape)
        np.save(
            folder / f"point{number}.npy",
            np.clip(np.round(electrons / 0.37 + 1054.0), 0, 65535).astype(np.uint16),
        )


def _write_laboratory(folder: Path) -> None:
    """Write 16-bit PNG frames of a camera of 24 x 24 pixels, whose names tell exposure and
    photons.
    """
    folder.mkdir(parents=True)
    for _, photons, time, frames in Camera(
        seed=5, size=24, darks=3, lit=12, faults={"lamp": 0.003}
    ).levels():
        for number, frame in enumerate(frames):
            name = f"flat_{photons:.0f}ph" if photons else "dark"
            Image.fromarray(frame.astype(np.uint16)).save(
                folder / f"{name}_{1e3 * time:.4g}ms_{number}.png"
            )
    # until the command of the page writes the real one
    sensor = folder.parents[1] / "sensor" / "lab.yaml"
    sensor.parent.mkdir()
    sensor.write_text(
        f"{FIRST}, a stand-in.\ndefaults: [small]\nsensor: {{read_noise: 8 e-}}\n", encoding="utf-8"
    )


def _write_frames(folder: Path) -> None:
    draw = np.random.default_rng(1)
    for level, photons in {
        "dark": 0,
        "dim": 1000,
        "half": 2000,
        "bright": 4000,
        "full": 9000,
    }.items():
        (folder / level).mkdir()
        # 0.5 DN/e-, and noise in the dark
        frames = 100 + 0.5 * draw.poisson(0.56 * photons + 100, (2, 64, 64))
        np.save(folder / level / "frames.npy", frames.round().astype(np.uint16))
    (folder / "set").mkdir()
    described = ["v 4.0", "n 12 64 64"]
    for level, photons in {
        "dark": 0,
        "dim": 1000,
        "half": 2000,
        "bright": 4000,
        "full": 9000,
    }.items():
        described.append(f"{'b' if photons else 'd'} 1000" + f" {photons}" * bool(photons))
        for number, frame in enumerate(np.load(folder / level / "frames.npy")):
            np.save(folder / "set" / f"{level}_{number}.npy", frame)
            described.append(f"i {level}_{number}.npy")
    (folder / "set" / "EMVA1288_descriptor.txt").write_text("\n".join(described) + "\n")
