"""Honest nodes: ordinary code whose result the parameters decide. The second run should find it
in the cache.
"""

from pathlib import Path

import h5py
import imageio.v3
import numpy as np
import OpenEXR
from astropy.io import fits

from unseen_kinds.case import Case


def honest(name: str, about: str, code: str, **words) -> Case:
    """Return an honest case."""
    return Case(name, about, code, honest=True, **words)


def file(name: str, about: str, header: str, lines: str, **words) -> Case:
    """Return an honest case whose node runs lines on its parameter `header`."""
    indented = "\n".join("    " + line for line in lines.strip("\n").splitlines())
    steps = f"a: {{node: own.value, with: {{header: {header}}}}}"
    return honest(
        name,
        about,
        f"@node()\ndef value(*, header: DataFile) -> Tensor:\n{indented}\n",
        steps=steps,
        **words,
    )


def _exr(folder: Path, turn: int) -> None:
    if turn == 1:
        head = {"compression": OpenEXR.ZIP_COMPRESSION, "type": OpenEXR.scanlineimage}
        OpenEXR.File(head, {"RGB": np.ones((4, 4, 3), np.float32)}).write(str(folder / "lab.exr"))


def _hdf(folder: Path, turn: int) -> None:
    if turn == 1:
        with h5py.File(folder / "lab.h5", "w") as base:
            base["gain"] = np.ones((2, 2))


def _weights(folder: Path) -> None:
    import torch

    torch.save({"weight": torch.ones(2, 2)}, folder / "lab.pt")


def once(write):
    """Return a maker that writes in the first turn only."""
    return lambda folder, turn: write(folder) if turn == 1 else None


CASES = [
    honest(
        "astropy_constants",
        "constants and units of astropy",
        """
        from astropy import constants
        from astropy import units as u

        @node()
        def value(*, wavelength: float = 532e-9) -> Tensor:
            return picture((constants.h * constants.c / (wavelength * u.m)).to_value(u.eV))
        """,
    ),
    honest(
        "astropy_blackbody",
        "a black body and a model of astropy",
        """
        from astropy import units as u
        from astropy.modeling.models import BlackBody, Gaussian1D

        @node()
        def value(*, kelvin: float = 5000.0) -> Tensor:
            light = BlackBody(kelvin * u.K)(550 * u.nm).value * 1e5
            return picture(light + Gaussian1D(1, 0, 1)(0.5))
        """,
    ),
    honest(
        "astropy_table",
        "a table in ECSV that goes through a text",
        """
        from io import StringIO

        from astropy.table import Table

        @node()
        def value() -> Tensor:
            text = StringIO()
            Table({"x": [1.0, 2.0]}).write(text, format="ascii.ecsv")
            return picture(Table.read(text.getvalue(), format="ascii.ecsv")["x"].sum())
        """,
    ),
    honest(
        "astropy_time",
        "the sidereal time of a fixed date",
        """
        from astropy.time import Time

        @node()
        def value(*, day: str = "2020-01-01") -> Tensor:
            return picture(Time(day, scale="tt").jd % 1000)
        """,
    ),
    honest(
        "colour_white",
        "colour: a white point and an observer",
        """
        import colour

        @node()
        def value(*, name: str = "D65") -> Tensor:
            white = colour.CCS_ILLUMINANTS["CIE 1931 2 Degree Standard Observer"][name]
            return torch.as_tensor(colour.xy_to_XYZ(white)).float()
        """,
    ),
    honest(
        "colour_spectrum",
        "colour: a light and its tristimulus values",
        """
        import colour

        @node()
        def value() -> Tensor:
            light = colour.SDS_ILLUMINANTS["D65"].copy().align(colour.SpectralShape(360, 780, 5))
            return torch.as_tensor(colour.sd_to_XYZ(light) / 100).float()
        """,
    ),
    honest(
        "scipy_fit",
        "a fit, a spline and a special function of SciPy",
        """
        from scipy import interpolate, optimize, special

        @node()
        def value(*, order: int = 1) -> Tensor:
            x = np.linspace(0.1, 5, 20)
            (width,), _ = optimize.curve_fit(lambda x, w: special.jv(order, w * x), x, special.jv(order, x), [0.9])
            return picture(width + interpolate.make_interp_spline(x, x**2)(2.0))
        """,
    ),
    honest(
        "scipy_fft_and_signal",
        "scipy.fft, scipy.signal and scipy.ndimage",
        """
        import scipy.fft
        from scipy import ndimage, signal

        @node()
        def value(*, sigma: float = 2.0) -> Tensor:
            frame = ndimage.gaussian_filter(np.eye(16), sigma)
            return torch.from_numpy(signal.convolve(frame, abs(scipy.fft.fft2(frame)), "same"))
        """,
    ),
    honest(
        "scipy_seeded_rvs",
        "rvs with a generator that a parameter seeds",
        """
        from scipy import stats

        @node()
        def value(*, seed: int = 3) -> Tensor:
            return picture(stats.norm.rvs(size=4, random_state=np.random.default_rng(seed)).mean())
        """,
    ),
    honest(
        "scipy_minimize_seeded",
        "differential evolution with a seed",
        """
        from scipy.optimize import differential_evolution

        @node()
        def value(*, seed: int = 3) -> Tensor:
            return picture(differential_evolution(lambda x: (x[0] - 1) ** 2, [(0, 3)], rng=seed, maxiter=3).x[0])
        """,
    ),
    honest(
        "kornia_filter",
        "filters of kornia",
        """
        import kornia

        @node()
        def value(*, sigma: float = 1.5) -> Tensor:
            frame = torch.eye(16)[None, None]
            return kornia.filters.gaussian_blur2d(frame, (5, 5), (sigma, sigma))
        """,
    ),
    honest(
        "kornia_colour",
        "a colour conversion and a warp of kornia",
        """
        import kornia.color
        import kornia.geometry

        @node()
        def value() -> Tensor:
            frame = torch.linspace(0, 1, 48).reshape(1, 3, 4, 4)
            return kornia.geometry.rotate(kornia.color.rgb_to_lab(frame), torch.tensor([30.0]))
        """,
    ),
    honest(
        "linear_of_module",
        "a torch.nn.Linear of the module with weights that are set",
        """
        NET = torch.nn.Linear(2, 2)
        with torch.no_grad():
            NET.weight.fill_(0.5)
            NET.bias.zero_()

        @node()
        def value() -> Tensor:
            return NET(torch.ones(2, 2)).detach()
        """,
    ),
    honest(
        "convolution_of_module_seeded",
        "a torch.nn.Conv2d of the module after torch.manual_seed",
        """
        torch.manual_seed(7)
        NET = torch.nn.Conv2d(1, 1, 3)

        @node()
        def value() -> Tensor:
            return NET(torch.ones(1, 1, 5, 5)).detach()
        """,
    ),
    honest(
        "linear_in_node_seeded",
        "a torch.nn.Linear in the node after a seed of a parameter",
        """
        @node()
        def value(*, seed: int = 3) -> Tensor:
            torch.manual_seed(seed)
            return torch.nn.Linear(2, 2)(torch.ones(2, 2)).detach()
        """,
    ),
    honest(
        "linear_in_node_forked",
        "the same with fork_rng, which leaves the state as it was",
        """
        @node()
        def value(*, seed: int = 3) -> Tensor:
            with torch.random.fork_rng(devices=[]):
                torch.manual_seed(seed)
                net = torch.nn.Sequential(torch.nn.Conv2d(1, 2, 3), torch.nn.ReLU())
            return net(torch.ones(1, 1, 5, 5)).detach()
        """,
    ),
    honest(
        "network_with_weights_set",
        "a network in the node whose first weights are replaced",
        """
        @node()
        def value(*, gain: float = 2.0) -> Tensor:
            net = torch.nn.utils.skip_init(torch.nn.Conv2d, 1, 1, 3, bias=False)
            torch.nn.init.constant_(net.weight, gain)
            return net(torch.ones(1, 1, 5, 5)).detach()
        """,
    ),
    honest(
        "generator_of_argument",
        "noise from the generator of the engine",
        """
        @node()
        def value(*, sigma: float = 2.0, rng: torch.Generator) -> Tensor:
            return sigma * torch.randn(2, 2, generator=rng)
        """,
    ),
    honest(
        "generator_seeded",
        "default_rng with a seed, and torch.Generator with a seed",
        """
        @node()
        def value(*, seed: int = 3) -> Tensor:
            noise = np.random.default_rng(seed).normal(size=(2, 2))
            return torch.from_numpy(noise) + torch.rand(2, 2, generator=torch.Generator().manual_seed(seed))
        """,
    ),
    honest(
        "old_seed_of_numpy",
        "np.random.seed of a parameter, as old scripts do",
        """
        @node()
        def value(*, seed: int = 3) -> Tensor:
            np.random.seed(seed)
            return picture(np.random.rand())
        """,
    ),
    honest(
        "gradient_in_node",
        "an optimisation with autograd and Adam",
        """
        @node()
        def value(*, steps: int = 5) -> Tensor:
            x = torch.zeros(2, 2, requires_grad=True)
            adam = torch.optim.Adam([x], lr=0.1)
            with torch.enable_grad():
                for _ in range(steps):
                    adam.zero_grad()
                    ((x - 1) ** 2).sum().backward()
                    adam.step()
            return x.detach()
        """,
    ),
    honest(
        "dask_array",
        "a dask array",
        """
        import dask.array

        @node()
        def value(*, side: int = 16) -> Tensor:
            return picture(dask.array.ones((side, side), chunks=8).sum().compute())
        """,
    ),
    honest(
        "xarray_interpolation",
        "xarray and its interpolation",
        """
        import xarray

        @node()
        def value(*, at: float = 450.0) -> Tensor:
            table = xarray.DataArray([1.0, 2.0], coords={"nm": [400.0, 500.0]}, dims="nm")
            return picture(table.interp(nm=at))
        """,
    ),
    honest(
        "pandas_group",
        "a table of pandas",
        """
        import pandas

        @node()
        def value() -> Tensor:
            table = pandas.DataFrame({"kind": ["a", "b", "a"], "gain": [1.0, 2.0, 3.0]})
            return picture(table.groupby("kind")["gain"].mean().sum())
        """,
    ),
    honest(
        "scratch_array",
        "np.save and np.load of a scratch file in a temporary folder",
        """
        import tempfile

        @node()
        def value(*, gain: float = 2.0) -> Tensor:
            with tempfile.TemporaryDirectory() as folder:
                path = Path(folder) / "scratch.npy"
                np.save(path, np.full((2, 2), gain))
                return torch.from_numpy(np.load(path))
        """,
    ),
    honest(
        "scratch_hdf",
        "h5py.File on a NamedTemporaryFile",
        """
        import tempfile

        import h5py

        @node()
        def value(*, gain: float = 2.0) -> Tensor:
            with tempfile.NamedTemporaryFile(suffix=".h5") as file:
                with h5py.File(file.name, "w") as lab:
                    lab["gain"] = gain
                with h5py.File(file.name, "r") as lab:
                    return picture(lab["gain"][()])
        """,
    ),
    honest(
        "hdf_in_memory",
        "h5py.File on a BytesIO",
        """
        import io

        import h5py

        @node()
        def value(*, gain: float = 2.0) -> Tensor:
            with h5py.File(io.BytesIO(), "w") as lab:
                lab["gain"] = gain
                return picture(lab["gain"][()])
        """,
    ),
    honest(
        "scratch_database",
        "a database in memory",
        """
        import sqlite3

        @node()
        def value(*, gain: float = 2.0) -> Tensor:
            base = sqlite3.connect(":memory:")
            return picture(base.execute("select 2 * ?", (gain,)).fetchone()[0])
        """,
    ),
    honest(
        "text_as_table",
        "np.genfromtxt of a StringIO",
        """
        from io import StringIO

        @node()
        def value(*, text: str = "1 2") -> Tensor:
            return picture(np.genfromtxt(StringIO(text)).sum())
        """,
    ),
    honest(
        "logging_and_warnings",
        "logging, and warnings that are caught",
        """
        import logging
        import warnings

        log = logging.getLogger(__name__)

        @node()
        def value(*, gain: float = 2.0) -> Tensor:
            log.info("the gain is %s", gain)
            with warnings.catch_warnings():
                warnings.simplefilter("ignore")
                return picture(np.log(np.zeros(1))[0] * 0 + gain if gain < 0 else gain)
        """,
    ),
    honest(
        "caches_of_functools",
        "functools.cache, lru_cache, partial, reduce and singledispatch",
        """
        import functools

        @functools.cache
        def square(n):
            return n * n

        @functools.lru_cache(maxsize=8)
        def power(base, n):
            return base**n

        @functools.singledispatch
        def number(x):
            return float(x)

        @number.register
        def _(x: str):
            return float(len(x))

        @node()
        def value(*, n: int = 3) -> Tensor:
            return picture(functools.reduce(lambda a, b: a + square(b), range(n), power(2, n)) + number("ab"))
        """,
    ),
    honest(
        "classes",
        "dataclasses, enums, a class hierarchy, a protocol and a named tuple",
        """
        import abc
        import enum
        from dataclasses import dataclass, field, replace
        from typing import NamedTuple, Protocol

        class Kind(enum.Enum):
            RAW = "raw"
            LINEAR = "linear"

        class Size(NamedTuple):
            height: int
            width: int

        class Curve(Protocol):
            def at(self, x: float) -> float: ...

        @dataclass(frozen=True)
        class Base(abc.ABC):
            gain: float = 1.0
            tags: list = field(default_factory=list)

            @abc.abstractmethod
            def at(self, x): ...

        class Line(Base):
            def at(self, x):
                return self.gain * x

        class Bent(Line):
            def at(self, x):
                return super().at(x) ** 2

        @node()
        def value(*, kind: str = "raw") -> Tensor:
            curve = replace(Bent(), gain=3.0) if Kind(kind) is Kind.RAW else Line()
            return torch.full(Size(2, 2), curve.at(2.0))
        """,
    ),
    honest(
        "threads_in_node",
        "a ThreadPoolExecutor in the node",
        """
        from concurrent.futures import ThreadPoolExecutor

        @node()
        def value(*, n: int = 8) -> Tensor:
            with ThreadPoolExecutor(2) as pool:
                return picture(sum(pool.map(lambda x: np.sqrt(x), range(n))))
        """,
    ),
    honest(
        "text_tools",
        "regular expressions, json, csv, textwrap and string formats",
        """
        import csv
        import json
        import re

        PATTERN = re.compile(r"gain=(?P<gain>[0-9.]+)")

        @node()
        def value(*, text: str = "iso=3 gain=2.5") -> Tensor:
            found = json.loads(json.dumps({"gain": PATTERN.search(text)["gain"]}))
            (row,) = csv.reader([f"{float(found['gain']):.1f},7"])
            return picture(float(row[0]) + float(row[1]))
        """,
    ),
    honest(
        "decimal_and_fractions",
        "fractions, math, cmath, statistics and itertools",
        """
        import cmath
        import itertools
        import math
        import statistics
        from fractions import Fraction

        @node()
        def value(*, n: int = 4) -> Tensor:
            mean = statistics.fmean(a * b for a, b in itertools.product(range(n), repeat=2))
            return picture(float(Fraction(1, 3)) + math.erf(mean) + abs(cmath.exp(1j * n)))
        """,
    ),
    honest(
        "sympy_expression",
        "an expression of SymPy that becomes a function",
        """
        import sympy

        @node()
        def value(*, order: int = 2) -> Tensor:
            x = sympy.Symbol("x")
            slope = sympy.diff(x ** (order + 1), x)
            return picture(slope.subs(x, 2))
        """,
    ),
    honest(
        "mpmath_local_precision",
        "mpmath with a local precision",
        """
        import mpmath

        @node()
        def value(*, order: int = 2) -> Tensor:
            with mpmath.workdps(30):
                return picture(mpmath.zeta(order))
        """,
    ),
    honest(
        "skimage_tools",
        "filters and measures of scikit-image",
        """
        from skimage import filters, measure, transform

        @node()
        def value(*, sigma: float = 1.0) -> Tensor:
            frame = filters.gaussian(np.eye(16), sigma)
            labels = measure.label(frame > filters.threshold_otsu(frame))
            return picture(labels.max() + transform.resize(frame, (4, 4)).sum())
        """,
    ),
    honest(
        "network_of_graph",
        "a shortest path of networkx",
        """
        import networkx

        @node()
        def value(*, n: int = 5) -> Tensor:
            return picture(networkx.shortest_path_length(networkx.path_graph(n), 0, n - 1))
        """,
    ),
    honest(
        "picture_in_memory",
        "a picture that is compressed and read in memory",
        """
        from io import BytesIO

        from PIL import Image

        @node()
        def value(*, quality: int = 50) -> Tensor:
            buffer = BytesIO()
            Image.fromarray(np.full((8, 8), 99, np.uint8)).save(buffer, "JPEG", quality=quality)
            return torch.from_numpy(np.asarray(Image.open(buffer)).astype(np.float32))
        """,
    ),
    honest(
        "drawn_figure",
        "a figure of matplotlib as numbers",
        """
        @node()
        def value() -> Tensor:
            from matplotlib.backends.backend_agg import FigureCanvasAgg
            from matplotlib.figure import Figure

            canvas = FigureCanvasAgg(Figure(figsize=(1, 1), dpi=20))
            canvas.figure.add_subplot().plot([0, 1], [0, 1])
            canvas.draw()
            return torch.from_numpy(np.asarray(canvas.buffer_rgba()).astype(np.float32))
        """,
    ),
    honest(
        "torch_jit_and_vmap",
        "torch.func, einsum and a scripted function",
        """
        @node()
        def value(*, gain: float = 2.0) -> Tensor:
            slope = torch.func.vmap(torch.func.grad(lambda x: gain * x**2))(torch.arange(4.0))
            return torch.einsum("i,j->ij", slope, slope)
        """,
    ),
    honest(
        "weights_normalised",
        "np.errstate, np.printoptions and torch.no_grad for a block",
        """
        @node()
        def value(*, gain: float = 2.0) -> Tensor:
            with np.errstate(divide="ignore"), np.printoptions(precision=3), torch.no_grad():
                return torch.nan_to_num(torch.from_numpy(np.array([1.0, 0.0]) / np.array([gain, 0.0 + gain])))
        """,
    ),
    honest(
        "module_table",
        "constants, tables and comprehensions at module level",
        """
        TABLE = {name: n**2 for n, name in enumerate("abc")}
        CURVE = np.linspace(0, 1, 11)
        ORDER = sorted({"x", "y"})

        @node()
        def value(*, name: str = "c") -> Tensor:
            return picture(TABLE[name] + CURVE.sum() + len(ORDER))
        """,
    ),
    honest(
        "helper_package",
        "a package of helpers beside the node",
        """
        from optics_lab import airy
        from optics_lab.tables import GLASS

        @node()
        def value(*, glass: str = "bk7") -> Tensor:
            return picture(airy(GLASS[glass]))
        """,
        files={
            "optics_lab/__init__.py": (
                """
from optics_lab.tables import GLASS


def airy(n):
    return ((n - 1) / (n + 1)) ** 2
"""
            ),
            "optics_lab/tables.py": "GLASS = {'bk7': 1.517}\n",
        },
    ),
    honest(
        "installed_helper",
        "a helper in an installed package",
        """
        from labtools import gain

        @node()
        def value(*, x: float = 2.0) -> Tensor:
            return picture(gain(x))
        """,
        env={"PYTHONPATH": "{folder}/site"},
        files={
            "site/labtools.py": (
                "import functools\n\n\n@functools.cache\ndef gain(x):\n    return 2 * x\n"
            )
        },
    ),
    honest(
        "two_steps",
        "two nodes with a tuple between them",
        """
        from typing import NamedTuple

        @node()
        def spot(*, gain: float = 2.0) -> Tensor:
            return picture(gain)

        @node()
        def value(x: Tensor) -> Tensor:
            return x + 1
        """,
        steps="s: {node: own.spot}\na: {node: own.value, from: s}",
    ),
    file(
        "text_parameter",
        "pathlib of the parameter",
        "lab.txt",
        "return picture(Path(header).read_text())",
        files={"lab.txt": "3"},
    ),
    file(
        "table_parameter",
        "np.loadtxt of the parameter",
        "lab.csv",
        "return picture(np.loadtxt(header, delimiter=',').sum())",
        files={"lab.csv": "3,4\n"},
    ),
    file(
        "pandas_parameter",
        "pandas.read_csv of the parameter",
        "lab.csv",
        "import pandas\n\nreturn picture(pandas.read_csv(header)['gain'].sum())",
        files={"lab.csv": "gain\n3\n"},
    ),
    file(
        "json_parameter",
        "json of the parameter",
        "lab.json",
        "import json\n\nwith open(header) as file:\n    return picture(json.load(file)['gain'])",
        files={"lab.json": '{"gain": 3}'},
    ),
    file(
        "yaml_parameter",
        "a YAML file as the parameter",
        "lab.yml",
        "import yaml\n\nreturn picture(yaml.safe_load(Path(header).read_text())['gain'])",
        files={"lab.yml": "gain: 3\n"},
    ),
    file(
        "hdf_parameter",
        "an HDF5 file, which its library opens itself",
        "lab.h5",
        "import h5py\n\nwith h5py.File(header) as lab:\n    return"
        " torch.from_numpy(lab['gain'][()])",
        make=_hdf,
    ),
    file(
        "xarray_parameter",
        "xarray.open_dataset of an HDF5 file",
        "lab.h5",
        """
import xarray

with xarray.open_dataset(header, engine='h5netcdf', phony_dims='sort') as lab:
    return picture(lab['gain'].sum())
""",
        make=_hdf,
    ),
    file(
        "fits_parameter",
        "a FITS file",
        "lab.fits",
        "from astropy.io import fits\n\nreturn"
        " torch.from_numpy(fits.getdata(header).astype(np.float32))",
        make=once(lambda folder: fits.writeto(folder / "lab.fits", np.ones((4, 4)))),
    ),
    file(
        "exr_parameter",
        "an EXR file",
        "lab.exr",
        """
import OpenEXR

with OpenEXR.File(str(header)) as lab:
    return torch.from_numpy(lab.channels()['RGB'].pixels)
""",
        make=_exr,
    ),
    file(
        "png_parameter",
        "a PNG file by imageio",
        "lab.png",
        "import imageio.v3\n\nreturn"
        " torch.from_numpy(imageio.v3.imread(header).astype(np.float32))",
        make=once(lambda folder: imageio.v3.imwrite(folder / "lab.png", np.ones((4, 4), np.uint8))),
    ),
    file(
        "pillow_parameter",
        "a PNG file by Pillow",
        "lab.png",
        "from PIL import Image\n\nreturn"
        " torch.from_numpy(np.asarray(Image.open(header)).astype(np.float32))",
        make=once(lambda folder: imageio.v3.imwrite(folder / "lab.png", np.ones((4, 4), np.uint8))),
    ),
    file(
        "tiff_parameter",
        "a TIFF file by tifffile",
        "lab.tif",
        "import tifffile\n\nreturn torch.from_numpy(tifffile.imread(header).astype(np.float32))",
        make=once(lambda folder: imageio.v3.imwrite(folder / "lab.tif", np.ones((4, 4), np.uint8))),
    ),
    file(
        "weights_parameter",
        "weights of torch",
        "lab.pt",
        "return torch.load(header, weights_only=True)['weight']",
        make=once(_weights),
    ),
    file(
        "memory_map_parameter",
        "np.memmap of the parameter",
        "lab.bin",
        "return torch.from_numpy(np.array(np.memmap(header, np.float32, 'r')))",
        make=once(lambda folder: np.ones(4, np.float32).tofile(folder / "lab.bin")),
    ),
    file(
        "zip_parameter",
        "np.load of an archive of arrays",
        "lab.npz",
        "with np.load(header) as lab:\n    return torch.from_numpy(lab['gain'])",
        make=once(lambda folder: np.savez(folder / "lab.npz", gain=np.ones((2, 2)))),
    ),
    file(
        "stem_parameter",
        "the exposure in the name of the parameter",
        "dark_20ms.txt",
        "return picture(Path(header).stem.split('_')[1][:-2])",
        files={"dark_20ms.txt": "3"},
    ),
    honest(
        "declared_table",
        "a table that the node declares",
        """
        @node(depends=["gain.txt"])
        def value() -> Tensor:
            return picture(np.loadtxt(Path(__file__).with_name("gain.txt")))
        """,
        files={"gain.txt": "3"},
    ),
]
