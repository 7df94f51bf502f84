"""What one step leaves in the process, where another step, without a wire between them, finds it.

The first step gets another parameter in the second run; the second step keeps its key.
"""

from unseen_kinds.case import Case

STEPS = tuple(
    f"""
    a: {{node: own.before, with: {{gain: {gain}}}}}
    b: {{node: own.value}}
    """
    for gain in (1, 2)
)


def left(name: str, about: str, put: str, get: str, top: str = "", **words) -> Case:
    """Return a case whose node `before` leaves `gain` by a line, and whose node `value` returns
    an expression.
    """
    code = f"""
{top}

@node()
def before(*, gain: int) -> Tensor:
    {put}
    return picture(gain)


@node()
def value() -> Tensor:
    return picture({get})
"""
    return Case(name, about, code, STEPS, output="a, b", watched="b", **words)


CASES = [
    left("global_name", "a global", "global GAIN; GAIN = gain", "GAIN", "GAIN = 0"),
    left("list_entry", "a list of the module", "LOG.append(gain)", "sum(LOG)", "LOG = []"),
    left(
        "own_attribute",
        "an attribute of a function",
        "helper.gain = gain",
        "helper.gain",
        """
def helper():
    pass


helper.gain = 0
""",
    ),
    left(
        "class_attribute",
        "an attribute of a class",
        "Lab.gain = gain",
        "Lab.gain",
        "class Lab:\n    gain = 0",
    ),
    left(
        "singleton",
        "the only object of a class",
        "Lab.get().gain = gain",
        "Lab.get().gain",
        """
class Lab:
    one = None
    gain = 0

    @classmethod
    def get(cls):
        if cls.one is None:
            cls.one = cls()
        return cls.one
""",
    ),
    left(
        "default_argument",
        "a default argument that can change",
        "remember(gain)",
        "remember()",
        """
def remember(gain=None, seen=[0]):
    if gain:
        seen[0] = gain
    return seen[0]
""",
    ),
    left(
        "closure",
        "a variable of a closure",
        "SET(gain)",
        "GET()",
        """
def cell():
    gain = 0

    def put(new):
        nonlocal gain
        gain = new

    return put, lambda: gain


SET, GET = cell()
""",
    ),
    left(
        "context_variable",
        "a ContextVar",
        "GAIN.set(gain)",
        "GAIN.get()",
        """
import contextvars

GAIN = contextvars.ContextVar('gain', default=0)
""",
    ),
    left(
        "thread_local",
        "threading.local",
        "LOCAL.gain = gain",
        "getattr(LOCAL, 'gain', 0)",
        """
import threading

LOCAL = threading.local()
""",
    ),
    left(
        "weak_dictionary",
        "a WeakKeyDictionary",
        "KEPT[Lab] = gain",
        "KEPT.get(Lab, 0)",
        """
import weakref


class Lab:
    pass


KEPT = weakref.WeakKeyDictionary()
""",
    ),
    left(
        "data_frame",
        "a cell of a DataFrame",
        "TABLE.loc[0, 'gain'] = gain",
        "TABLE.loc[0, 'gain']",
        """
import pandas

TABLE = pandas.DataFrame({'gain': [0]})
""",
    ),
    left(
        "attributes_of_xarray",
        "an attribute of a DataArray",
        "DATA.attrs['gain'] = gain",
        "DATA.attrs.get('gain', 0)",
        """
import xarray

DATA = xarray.DataArray([0])
""",
    ),
    left(
        "values_of_xarray",
        "the values of a DataArray",
        "DATA[0] = gain",
        "DATA[0]",
        """
import xarray

DATA = xarray.DataArray([0])
""",
    ),
    left("array", "an element of an array", "TABLE[0] = gain", "TABLE[0]", "TABLE = np.zeros(2)"),
    left(
        "buffer_of_network",
        "a buffer of a module of torch",
        "NET.running_mean.fill_(gain)",
        "NET.running_mean[0]",
        "NET = torch.nn.BatchNorm2d(1, affine=False)",
    ),
    left(
        "queue",
        "a queue",
        "QUEUE.put(gain)",
        "QUEUE.qsize()",
        """
import queue

QUEUE = queue.Queue()
""",
    ),
    left(
        "counter",
        "itertools.count",
        "[next(COUNT) for _ in range(gain)]",
        "next(COUNT)",
        """
import itertools

COUNT = itertools.count()
""",
    ),
    left(
        "generator",
        "a generator of the module",
        "[next(STEPS) for _ in range(gain)]",
        "next(STEPS)",
        "STEPS = (n for n in range(100))",
    ),
    left(
        "memo_of_dictionary",
        "a memo",
        "MEMO.setdefault('gain', gain)",
        "MEMO.setdefault('gain', 9)",
        "MEMO = {}",
    ),
    left(
        "lru_cache",
        "functools.lru_cache of a function of the surroundings",
        "CURRENT[0] = gain; gain_now()",
        "gain_now()",
        """
import functools

CURRENT = [0]


@functools.lru_cache
def gain_now():
    return CURRENT[0]
""",
    ),
    left(
        "cached_property",
        "functools.cached_property",
        "LAB.seed = gain; LAB.gain",
        "LAB.gain",
        """
import functools


class Lab:
    seed = 0

    @functools.cached_property
    def gain(self):
        return self.seed


LAB = Lab()
""",
    ),
    left("seed_of_torch", "a seed", "torch.manual_seed(gain)", "torch.rand(1)"),
    left("seed_of_numpy", "a seed of NumPy", "np.random.seed(gain)", "np.random.rand()"),
    left(
        "seed_of_random",
        "a seed of random",
        "random.seed(gain)",
        "random.random()",
        "import random",
    ),
    left(
        "environment",
        "a variable of the process",
        "os.putenv('LAB', 'x' * gain)",
        "len(subprocess.getoutput('echo $LAB'))",
        "import subprocess",
    ),
    left(
        "decimal_context",
        "the precision of decimal",
        "decimal.getcontext().prec = 4 * gain",
        "len(str(decimal.Decimal(1) / 3))",
        "import decimal",
    ),
    left(
        "mpmath",
        "the digits of mpmath",
        "mpmath.mp.dps = 4 * gain",
        "len(str(mpmath.mpf(1) / 3))",
        "import mpmath",
    ),
    left(
        "print_options",
        "how NumPy prints",
        "np.set_printoptions(precision=4 * gain)",
        "len(str(np.float64(1) / 3 * np.ones(1)))",
    ),
    left(
        "default_type",
        "the default type of torch",
        "torch.set_default_dtype([torch.float32, torch.float64][gain - 1])",
        "torch.ones(1).element_size()",
    ),
    left(
        "seterr",
        "np.seterr",
        "np.seterr(divide=['ignore', 'warn'][gain - 1])",
        "len(np.geterr()['divide'])",
    ),
    left(
        "fft_backend",
        "the workers of scipy.fft",
        "scipy.fft.set_workers(gain).__enter__()",
        "scipy.fft.get_workers()",
        "import scipy.fft",
    ),
    left(
        "pandas_option",
        "an option of pandas",
        "pandas.set_option('display.precision', 4 * gain)",
        "pandas.get_option('display.precision')",
        "import pandas",
    ),
    left(
        "xarray_option",
        "an option of xarray",
        "xarray.set_options(display_width=40 * gain)",
        "xarray.get_options()['display_width']",
        "import xarray",
    ),
    left(
        "dask_config",
        "a value of dask.config",
        "dask.config.set({'lab.gain': gain})",
        "dask.config.get('lab.gain', 0)",
        "import dask",
    ),
    left(
        "matplotlib",
        "a parameter of matplotlib",
        "matplotlib.rcParams['figure.dpi'] = 50 * gain",
        "matplotlib.rcParams['figure.dpi']",
        "import matplotlib",
    ),
    left(
        "cosmology",
        "the default cosmology of astropy",
        "default_cosmology.set(['Planck13', 'WMAP5'][gain - 1])",
        "default_cosmology.get().H0.value",
        "from astropy.cosmology import default_cosmology",
    ),
    left(
        "astropy_units",
        "units that a step enables",
        "units.set_enabled_aliases({'labs': [units.s, units.h][gain - 1]})",
        "units.Unit('labs').to(units.s)",
        "from astropy import units",
    ),
    left(
        "astropy_configuration",
        "a value of the configuration of astropy",
        "conf.set_temp('remote_timeout', gain).__enter__()",
        "conf.remote_timeout",
        "from astropy.utils.data import conf",
    ),
    left(
        "colour_scale",
        "the domain and range scale of colour",
        "colour.set_domain_range_scale(['reference', '1'][gain - 1])",
        "colour.XYZ_to_Lab(np.array([0.2, 0.1, 0.05]))[0]",
        "import colour",
    ),
    left(
        "networkx",
        "the configuration of networkx",
        "networkx.config.warnings_to_ignore = {'cache'} if gain == 1 else set()",
        "len(networkx.config.warnings_to_ignore)",
        "import networkx",
    ),
    left(
        "recursion_limit",
        "the recursion limit",
        "sys.setrecursionlimit(2000 * gain)",
        "sys.getrecursionlimit()",
    ),
    left(
        "switch_interval",
        "the switch interval",
        "sys.setswitchinterval(0.01 * gain)",
        "sys.getswitchinterval()",
    ),
    left(
        "warnings_filter",
        "a filter of warnings",
        "warnings.simplefilter(['ignore', 'error'][gain - 1], BytesWarning)",
        "warnings.filters[0][0] == 'error'",
        "import warnings",
    ),
    left(
        "log_level",
        "a level of logging",
        "logging.getLogger('lab').setLevel(10 * gain)",
        "logging.getLogger('lab').level",
        "import logging",
    ),
    left(
        "locale",
        "the locale",
        "locale.setlocale(locale.LC_CTYPE, ['C', 'C.UTF-8'][gain - 1])",
        "len(locale.setlocale(locale.LC_CTYPE))",
        "import locale",
    ),
    left(
        "working_folder",
        "the working folder",
        "os.chdir(['/', '/usr'][gain - 1])",
        "len(Path.cwd().parts)",
    ),
    left(
        "working_folder_hidden",
        "the working folder, which the other step reads by a relative name",
        "os.chdir(['/', '/usr'][gain - 1])",
        "len(os.path.realpath(''))",
    ),
    left(
        "memory_file",
        "the file system of fsspec in memory",
        "fsspec.filesystem('memory').pipe('/gain', b'x' * gain)",
        "fsspec.filesystem('memory').size('/gain') if fsspec.filesystem('memory').exists('/gain')"
        " else 0",
        "import fsspec",
    ),
    left(
        "shared_database",
        "a database in memory that the process shares",
        "BASE.execute('update gains set gain = ?', (gain,))",
        "BASE.execute('select gain from gains').fetchone()[0]",
        """
import sqlite3

BASE = sqlite3.connect('file:lab?mode=memory&cache=shared', uri=True, check_same_thread=False)
BASE.execute('create table if not exists gains (gain int)')
BASE.execute('insert into gains values (0)')
""",
    ),
    left(
        "scratch_file",
        "a file in the temporary folder",
        "Path(tempfile.gettempdir(), f'neusee_unseen_{os.getpid()}').write_text(str(gain))",
        "Path(tempfile.gettempdir(), f'neusee_unseen_{os.getpid()}').read_text()",
        "import tempfile",
    ),
    left(
        "codec",
        "an error handler of codecs",
        "codecs.register_error('lab', lambda error: (str(gain), error.end))",
        "b'\\xff'.decode('ascii', 'lab')",
        "import codecs",
    ),
    left(
        "dialect",
        "a dialect of csv",
        "csv.field_size_limit(1000 * gain)",
        "csv.field_size_limit()",
        "import csv",
    ),
    left(
        "subclass",
        "a class that the step makes",
        "KEPT.append(type('Mine', (Lab,), {'gain': gain}))",
        "sum(kind.gain for kind in Lab.__subclasses__())",
        """
class Lab:
    gain = 0


KEPT = []
""",
    ),
    left(
        "attribute_of_library",
        "an attribute of a module of a library",
        "np.lab_gain = gain",
        "getattr(np, 'lab_gain', 0)",
    ),
    left(
        "attribute_of_sys",
        "an attribute of sys",
        "sys.lab_gain = gain",
        "getattr(sys, 'lab_gain', 0)",
    ),
    left(
        "attribute_of_builtins",
        "a name in builtins",
        "setattr(builtins, 'lab_gain', gain)",
        "getattr(builtins, 'lab_gain', 0)",
        "import builtins",
    ),
    left(
        "deep_in_library",
        "a dictionary inside a library",
        "colour.MSDS_CMFS._lab_gain = gain",
        "getattr(colour.MSDS_CMFS, '_lab_gain', 0)",
        "import colour",
    ),
    left(
        "table_of_library",
        "an entry of a table of colour",
        "colour.models.RGB_COLOURSPACES['lab'] = gain",
        "colour.models.RGB_COLOURSPACES.get('lab', 0)",
        "import colour",
    ),
    left(
        "enum_member",
        "an attribute of a member of an enum",
        "Kind.RAW.gain = gain",
        "Kind.RAW.gain",
        """
import enum


class Kind(enum.Enum):
    RAW = 1


Kind.RAW.gain = 0
""",
    ),
    left(
        "slots",
        "a slot of a frozen dataclass",
        "object.__setattr__(LAB, 'gain', gain)",
        "LAB.gain",
        """
import dataclasses


@dataclasses.dataclass(frozen=True, slots=True)
class Lab:
    gain: int = 0


LAB = Lab()
""",
    ),
    left(
        "ctypes_memory",
        "memory that ctypes holds",
        "CELL.value = gain",
        "CELL.value",
        """
import ctypes

CELL = ctypes.c_int(0)
""",
    ),
    left(
        "byte_array", "a bytearray", "CELL.__setitem__(0, gain)", "CELL[0]", "CELL = bytearray(2)"
    ),
    left(
        "shared_memory_map",
        "an anonymous memory map",
        "CELL.__setitem__(0, gain)",
        "CELL[0]",
        """
import mmap

CELL = mmap.mmap(-1, 16)
""",
    ),
    left(
        "text_stream",
        "a StringIO",
        "TEXT.write('x' * gain)",
        "len(TEXT.getvalue())",
        """
import io

TEXT = io.StringIO()
""",
    ),
    left(
        "signal_timer",
        "a timer of the process",
        "signal.setitimer(signal.ITIMER_VIRTUAL, 1e6 * gain)",
        "round(signal.getitimer(signal.ITIMER_VIRTUAL)[0], -5)",
        "import signal",
    ),
    left(
        "thread_that_stays",
        "a thread that the step starts and that answers",
        "threading.Thread(target=threading.Event().wait, args=(30,), name='lab' * gain,"
        " daemon=True).start()",
        "sum(len(t.name) for t in threading.enumerate() if t.name.startswith('lab'))",
        "import threading",
    ),
    left(
        "flush_denormal",
        "numbers that are flushed to zero",
        "torch.set_flush_denormal(gain == 2)",
        "torch.tensor(1e-40) * 1 > 0",
    ),
    left(
        "deterministic_switch",
        "a switch of torch",
        "torch.backends.mkldnn.set_flags(gain == 2).__class__",
        "torch.backends.mkldnn.enabled",
    ),
    left(
        "threads_of_torch",
        "threads of torch",
        "torch.set_num_threads(gain)",
        "getattr(torch, 'get_num_' + 'threads')()",
    ),
    left(
        "patch_of_library",
        "mock.patch that stays",
        "mock.patch('numpy.trapezoid', lambda values: gain).start()",
        "np.trapezoid([0.0, 0.0])",
        "from unittest import mock",
    ),
    left(
        "method_of_own_class",
        "a method that is replaced",
        "setattr(Lab, 'gain', lambda self: gain)",
        "Lab().gain()",
        """
class Lab:
    def gain(self):
        return 0
""",
    ),
    left(
        "module_attribute_of_helper",
        "a dictionary in a helper module",
        "shared.put('gain', gain)",
        "shared.get('gain')",
        "import shared",
        files={
            "shared.py": (
                """
_BOX = {}


def put(name, number):
    _BOX[name] = number


def get(name):
    return _BOX.get(name, 0)
"""
            )
        },
    ),
    left(
        "object_in_helper_list",
        "an object in a list in a helper module",
        "shared.ALL[0][1].gain = gain",
        "shared.ALL[0][1].gain",
        "import shared",
        files={
            "shared.py": (
                """
class Lab:
    gain = 0


ALL = [('lab', Lab())]
"""
            )
        },
    ),
    left(
        "installed_memo",
        "a memo in an installed package",
        "labtools.put(gain)",
        "labtools.get()",
        "import labtools",
        env={"PYTHONPATH": "{folder}/site"},
        files={
            "site/labtools.py": (
                """
_BOX = {}


def put(gain):
    _BOX['gain'] = gain


def get():
    return _BOX.get('gain', 0)
"""
            )
        },
    ),
    left(
        "installed_instance",
        "the only object of a class of an installed package",
        "LAB.put(gain)",
        "LAB.get()",
        "from labtools import LAB",
        env={"PYTHONPATH": "{folder}/site"},
        files={
            "site/labtools.py": (
                """
class Lab:
    def __init__(self):
        self._gain = 0

    def put(self, gain):
        self._gain = gain

    def get(self):
        return self._gain


LAB = Lab()
"""
            )
        },
    ),
]
