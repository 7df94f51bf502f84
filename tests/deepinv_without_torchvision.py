"""deepinv for tests, with a stand-in for torchvision where torchvision is not installed.

deepinv imports torchvision for data sets, plots, rotations and saved pictures. The operators, the
algorithms and the denoisers that the tests use need none of it. A torchvision of PyPI belongs to a
torch for CUDA, and the tests run with the torch for the CPU, so that this file puts empty modules
of the same names in its place. Every name that deepinv 0.5 asks for while it is imported stands in
`NAMES`; whoever calls one of these names is told that it is a stand-in.
"""

from __future__ import annotations

import importlib
import importlib.util
import sys
import types
import warnings
from typing import Any

import pytest

NAMES = {
    "torchvision": (),
    "torchvision.datasets": (),
    "torchvision.datasets.folder": ("IMG_EXTENSIONS",),
    "torchvision.datasets.utils": ("download_and_extract_archive",),
    "torchvision.transforms": ("CenterCrop", "Compose", "InterpolationMode", "Resize", "ToTensor"),
    "torchvision.transforms.functional": ("crop", "rotate"),
    "torchvision.utils": ("make_grid", "save_image"),
}


def _refusing(name: str) -> type:
    def refuse(*_: Any, **__: Any) -> None:
        raise NotImplementedError(f"{name} is a stand-in of the tests for torchvision")

    return type(
        name.rpartition(".")[2], (), {"__init__": refuse, "NEAREST": None, "BILINEAR": None}
    )


def put_stand_in() -> None:
    """Put empty modules in the place of torchvision, if torchvision is not there."""
    if "torchvision" in sys.modules or importlib.util.find_spec("torchvision"):
        return
    for path, names in NAMES.items():
        module = types.ModuleType(path, "A stand-in of the tests.")
        module.__path__ = []  # type: ignore[attr-defined]
        for name in names:
            setattr(module, name, _refusing(f"{path}.{name}"))
        sys.modules[path] = module
        above, _, last = path.rpartition(".")
        if above:
            setattr(sys.modules[above], last, module)


def deepinv_or_skip() -> Any:
    """Import and return deepinv, or skip the tests of a file with the reason."""
    if importlib.util.find_spec("deepinv") is None:
        pytest.skip("deepinv is not installed: pip install deepinv", allow_module_level=True)
    put_stand_in()
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")  # of the packages that deepinv imports
        return importlib.import_module("deepinv")
