"""Settings of a library or of the process, which another file of the recipe sets when it is
imported.
"""

from unseen_kinds.case import OTHER, Case


def setting(name: str, about: str, lines: str, other: str, first: str, second: str) -> Case:
    """Return a case whose file `other.py` makes a call with the first or the second word in the
    place of `WORD`.
    """
    indented = "\n".join("    " + line for line in lines.strip("\n").splitlines())
    code = f"@node()\ndef value() -> Tensor:\n{indented}\n"
    texts = (other.replace("WORD", first) + OTHER, other.replace("WORD", second) + OTHER)
    return Case(name, about, code, nodes="own.py, other.py", files={"other.py": texts})


def setting_of_import(
    name: str, about: str, line: str, other: str, first: str, second: str
) -> Case:
    """Return a case whose module makes a constant when it is imported, after `other.py`."""
    code = f"""
try:
    GAIN = float({line} > 0)
except Exception:
    GAIN = 7.0


@node()
def value() -> Tensor:
    return picture(GAIN)
"""
    texts = (other.replace("WORD", first) + OTHER, other.replace("WORD", second) + OTHER)
    return Case(name, about, code, nodes="other.py, own.py", files={"other.py": texts})


CASES = [
    Case(
        "time_zone",
        "the hour of a fixed time, in the zone of the process",
        """
        from datetime import datetime

        @node()
        def value() -> Tensor:
            return picture(datetime.fromtimestamp(0).hour)
        """,
        env={"TZ": ("UTC", "Asia/Tokyo")},
    ),
    Case(
        "time_zone_of_pandas",
        "pandas asks for the zone itself",
        """
        import pandas

        @node()
        def value() -> Tensor:
            return picture(pandas.Timestamp(0, unit="s", tz="UTC").tz_convert("tzlocal()").hour)
        """,
        env={"TZ": ("UTC", "Asia/Tokyo")},
    ),
    setting_of_import(
        "seterr",
        "np.seterr raises where it warned, and a constant of the module meets it",
        "np.float64(1.0) / np.float64(0.0)",
        "import numpy\n\nnumpy.seterr(divide='WORD')\n",
        "ignore",
        "raise",
    ),
    Case(
        "hash_seed",
        "the order of a set of words",
        """
        @node()
        def value() -> Tensor:
            words = {"red", "green", "blue", "violet", "grey", "white"}
            return torch.tensor([float(len(word) + ord(word[0])) for word in [*words]])
        """,
        env={"PYTHONHASHSEED": ("1", "2")},
    ),
    Case(
        "hash_of_tuple",
        "a bin by the hash of a tuple of words",
        """
        @node()
        def value(*, name: str = "imx") -> Tensor:
            return picture((name, "lens").__hash__() % 1000)
        """,
        env={"PYTHONHASHSEED": ("1", "2")},
    ),
    setting(
        "decimal_precision",
        "the precision of decimal",
        """
import decimal

return picture(len(str(decimal.Decimal(1) / 3)))
""",
        "import decimal\n\ndecimal.getcontext().prec = WORD\n",
        "5",
        "9",
    ),
    setting(
        "mpmath_digits",
        "the digits of mpmath",
        """
import mpmath

return picture(len(str(mpmath.mpf(1) / 3)))
""",
        "import mpmath\n\nmpmath.mp.dps = WORD\n",
        "5",
        "9",
    ),
    setting(
        "recursion_limit",
        "how deep a recursion gets",
        """
def deep(level):
    try:
        return deep(level + 1)
    except RecursionError:
        return level

return picture(deep(0) // 500)
""",
        "import sys\n\nsys.setrecursionlimit(WORD)\n",
        "2000",
        "6000",
    ),
    setting_of_import(
        "warnings_as_errors",
        "a warning that another file makes an error, and a constant of the module meets it",
        "__import__('warnings').warn('dark frame is old') or 5",
        "import warnings\n\nwarnings.simplefilter('WORD')\n",
        "ignore",
        "error",
    ),
    setting(
        "fft_backend",
        "another file sets a backend of scipy.fft",
        """
import scipy.fft

return picture(scipy.fft.fft(np.ones(2))[0].real)
""",
        """
import numpy
import scipy.fft


class Backend:
    __ua_domain__ = "numpy.scipy.fft"

    @staticmethod
    def __ua_function__(method, args, kwargs):
        return numpy.full(2, WORD + 0j)


scipy.fft.set_global_backend(Backend)
""",
        "5",
        "6",
    ),
    setting(
        "pandas_option",
        "the precision with which pandas prints",
        """
import pandas

return picture(len(str(pandas.Series([1 / 3]))))
""",
        "import pandas\n\npandas.set_option('display.precision', WORD)\n",
        "3",
        "9",
    ),
    setting(
        "xarray_option",
        "whether xarray keeps attributes",
        """
import xarray

data = xarray.DataArray([1.0], attrs={"gain": 1})
return picture(len((data.mean()).attrs))
""",
        "import xarray\n\nxarray.set_options(keep_attrs=WORD)\n",
        "True",
        "False",
    ),
    setting(
        "dask_config",
        "a value of dask.config",
        """
import dask.array

return picture(len(dask.array.ones((64, 64), chunks="auto").chunks[0]))
""",
        "import dask\n\ndask.config.set({'array.chunk-size': 'WORD'})\n",
        "1MiB",
        "4KiB",
    ),
    setting(
        "matplotlib_parameter",
        "a parameter of matplotlib",
        """
import matplotlib

return picture(matplotlib.rcParams["figure.dpi"])
""",
        "import matplotlib\n\nmatplotlib.rcParams['figure.dpi'] = WORD\n",
        "50",
        "70",
    ),
    setting(
        "astropy_constants",
        "an alias of a unit that another file enables",
        """
from astropy import units

return picture((1 * units.Unit("labs")).to_value("s"))
""",
        "from astropy import units\n\nunits.set_enabled_aliases({'labs': units.WORD})\n",
        "s",
        "h",
    ),
    setting(
        "colour_float",
        "the float type of colour",
        """
import colour

return picture(colour.algebra.spow(1 / 3, 2.2).dtype.itemsize + colour.utilities.as_float([1.0]).dtype.itemsize)
""",
        "import colour\nimport numpy\n\ncolour.utilities.set_default_float_dtype(numpy.WORD)\n",
        "float32",
        "float64",
    ),
    setting(
        "default_dtype",
        "the default type of torch",
        "return picture(torch.tensor([0.1]).element_size())",
        "import torch\n\ntorch.set_default_dtype(torch.WORD)\n",
        "float32",
        "float64",
    ),
    setting(
        "torch_seed",
        "another file sets the seed of torch, and the node draws",
        "return torch.rand(2, 2)",
        "import torch\n\ntorch.manual_seed(WORD)\n",
        "1",
        "2",
    ),
    setting(
        "locale_numbers",
        "the locale of the process",
        """
import locale as place

return picture(len(place.setlocale(place.LC_CTYPE)))
""",
        "import locale\n\nlocale.setlocale(locale.LC_ALL, 'WORD')\n",
        "C",
        "C.UTF-8",
    ),
    setting(
        "first_weekday",
        "the first day of the week of calendar",
        """
import calendar

return picture(calendar.monthcalendar(2026, 1)[0].index(1))
""",
        "import calendar\n\ncalendar.setfirstweekday(WORD)\n",
        "0",
        "6",
    ),
    setting(
        "print_options_of_torch",
        "a number that passes through the text of a tensor",
        "return picture(str(torch.tensor(1 / 3, dtype=torch.float64))[7:].split(',')[0])",
        "import torch\n\ntorch.set_printoptions(precision=WORD)\n",
        "2",
        "6",
    ),
    setting(
        "truncated_images",
        "a switch of Pillow",
        """
from PIL import ImageFile

return picture(ImageFile.LOAD_TRUNCATED_IMAGES)
""",
        "from PIL import ImageFile\n\nImageFile.LOAD_TRUNCATED_IMAGES = WORD\n",
        "False",
        "True",
    ),
    setting(
        "sympy_and_digits",
        "the longest integer that becomes a text",
        """
try:
    return picture(len(str(10**5000)))
except ValueError:
    return picture(0)
""",
        "import sys\n\nsys.set_int_max_str_digits(WORD)\n",
        "4300",
        "0",
    ),
    setting(
        "umask",
        "the rights that new files get",
        """
import tempfile

with tempfile.TemporaryDirectory() as folder:
    os.close(os.open(folder + "/new", os.O_CREAT | os.O_WRONLY, 0o666))
    return picture(getattr(os.stat(folder + "/new"), "st_" + "mode"))
""",
        "import os\n\nos.umask(WORD)\n",
        "0o022",
        "0o077",
    ),
    setting(
        "working_folder",
        "another file changes the working folder",
        "return picture(len(os.listdir(os.curdir)))",
        "import os\nfrom pathlib import Path\n\nos.chdir(Path(__file__).parent / WORD)\n",
        "'.'",
        "'..'",
    ),
    setting(
        "logging_level",
        "the level of the root logger decides",
        """
import logging

return picture(logging.getLogger("lab").isEnabledFor(logging.INFO))
""",
        "import logging\n\nlogging.getLogger('lab').setLevel(WORD)\n",
        "10",
        "40",
    ),
    setting(
        "threshold_of_gc",
        "how often the collector runs",
        """
import gc

return picture(gc.get_threshold()[0])
""",
        "import gc\n\ngc.set_threshold(WORD)\n",
        "700",
        "800",
    ),
]
