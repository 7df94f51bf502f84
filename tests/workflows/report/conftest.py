"""Files with one table of each kind, as a user would write them, and the arguments of the figure
that draws them.
"""

from pathlib import Path
from typing import Any

import numpy as np
import pytest

CAMERA = (
    "wavelength (nm),QE (%)",
    [(400, 45), (525, 69), (700, 45), (900, 12), (1064, 0.8), (1100, 0.2)],
)
LIGHT = ("wavelength (nm),power (W/nm)", [(350, 1), (500, 3), (560, 9), (800, 0.5)])
GLASS = ("wavelength (um),n (1)", [(0.35, 1.539), (0.5, 1.5214), (0.7, 1.5131), (1.2, 1.5049)])
LINES = ("wavelength (nm),power (mW)", [(457.9, 30), (488, 150), (514.5, 200)])
SPECTRUM = ("wavelength (nm),power (mW/nm)", [(805, 0), (807, 3), (808, 9), (809, 3), (811, 0)])


def write(folder: Path, name: str, table: tuple[str, list[tuple[float, ...]]]) -> Path:
    """Write a table as CSV and return its path."""
    header, rows = table
    (folder / name).write_text(
        "\n".join([header, *(",".join(map(str, row)) for row in rows)]) + "\n"
    )
    return folder / name


@pytest.fixture(scope="module")
def table_arguments(tmp_path_factory: pytest.TempPathFactory) -> dict[str, Any]:
    """Write a file of each kind, and return the arguments of the figure of all of them."""
    folder = tmp_path_factory.mktemp("tables")
    lasers = {
        "argon": write(folder, "argon.csv", LINES),
        "diode": write(folder, "diode.csv", SPECTRUM),
        "green": None,
    }
    np.save(folder / "map.npy", np.add.outer(np.arange(40) ** 2, np.arange(30)) * 1e-3)
    return {
        "camera": write(folder, "mono.csv", CAMERA),
        "glass": write(folder, "glass.csv", GLASS),
        "light": write(folder, "lamp.csv", LIGHT),
        "lasers": lasers,
        "height": folder / "map.npy",
        "unit": 1e-6,
        "pitch": 2e-4,
    }
