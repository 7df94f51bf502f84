"""What the machine, the clock, the terminal and the process say."""

import os
from pathlib import Path

from unseen_kinds.case import Case


def asks(name: str, about: str, lines: str, **words) -> Case:
    """Return a case whose node runs a few lines that return a number."""
    indented = "\n".join("    " + line for line in lines.strip("\n").splitlines())
    return Case(
        name, about, f"@node()\ndef value(*, place: str = '.') -> Tensor:\n{indented}\n", **words
    )


def table(name: str, about: str, path: str) -> Case:
    """Return a case whose node reads a table at a path that the recipe has as a text."""
    code = """
    @node()
    def value(*, table: str) -> Tensor:
        return picture(np.loadtxt(table))
    """
    steps = f"a: {{node: own.value, with: {{table: '{path}'}}}}"
    return Case(name, about, code, steps, files={path: ("1", "2")})


def _git(folder: Path, turn: int) -> None:
    head = folder / ".git" / "HEAD"
    head.parent.mkdir(exist_ok=True)
    head.write_text("ab" * turn)


def _touched(folder: Path, turn: int) -> None:
    (folder / "dark.txt").write_text("1")
    os.utime(folder / "dark.txt", (1e9 * turn, 1e9 * turn))


def _rights(folder: Path, turn: int) -> None:
    (folder / "dark.txt").write_text("1")
    (folder / "dark.txt").chmod(0o600 + turn * 4)


PARAMETER = "a: {node: own.value, with: {header: dark.txt}}"

CASES = [
    asks(
        "clock_of_pandas",
        "pandas.Timestamp.now",
        "import pandas\n\nreturn picture(pandas.Timestamp.now().microsecond)",
    ),
    asks(
        "clock_of_numpy",
        "np.datetime64('now')",
        "return picture(np.datetime64('now').astype(int) % 100000)",
    ),
    asks(
        "clock_of_astropy",
        "astropy Time.now",
        "from astropy.time import Time\n\nreturn picture(Time.now().unix % 1000)",
    ),
    asks(
        "clock_of_email",
        "a date of an e-mail",
        "import email.utils\n\nreturn picture(email.utils.formatdate()[17:25].replace(':', ''))",
    ),
    asks(
        "clock_of_log",
        "the time of a log record",
        "import logging\n\nreturn picture(logging.makeLogRecord({}).created % 1000)",
    ),
    asks(
        "clock_by_getattr",
        "a clock that getattr finds",
        "import time\n\nreturn picture(getattr(time, 'monotonic' + '_ns')() % 1000)",
    ),
    asks(
        "clock_of_torch",
        "a timer of torch",
        "import timeit\n\nreturn picture(timeit.timeit('1', number=10) * 1e9)",
    ),
    asks(
        "clock_of_new_file",
        "the time of a file that the node has just made",
        """
import tempfile

with tempfile.NamedTemporaryFile() as file:
    return picture(os.fstat(file.fileno())[8] % 100000)
""",
    ),
    asks(
        "clock_of_uuid",
        "uuid1 and uuid4",
        "import uuid\n\nreturn picture(uuid.uuid1().time_low % 1000)",
    ),
    asks("number_of_process", "the process number", "return picture(os.getpid())"),
    asks("address", "id of an object", "return picture(id(object()) // 4096 % 10000)"),
    asks(
        "address_in_text",
        "the address in the text of an object",
        "return picture(int(repr(object())[-13:-1], 16) // 4096 % 10000)",
    ),
    asks(
        "hash_of_object",
        "the hash of an object, as a key of a bin",
        "return picture(hash(object()) // 256 % 10000)",
    ),
    asks(
        "address_of_tensor", "data_ptr", "return picture(torch.ones(2).data_ptr() // 4096 % 10000)"
    ),
    asks(
        "temporary_name",
        "the name of a temporary file",
        """
import tempfile

with tempfile.NamedTemporaryFile() as file:
    return picture(sum(map(ord, file.name)))
""",
    ),
    asks(
        "thread_number",
        "the number of a thread",
        "import threading\n\nreturn picture(threading.get_native_id())",
    ),
    asks(
        "memory_of_process",
        "how much memory the process has",
        "import psutil\n\nreturn picture(psutil.Process().memory_info().rss)",
    ),
    asks(
        "load_of_machine",
        "the counter of processor time",
        "import psutil\n\nreturn picture(psutil.cpu_times().user + psutil.cpu_times().idle)",
    ),
    asks(
        "usage_of_process",
        "resource.getrusage",
        "import resource\n\nreturn picture(resource.getrusage(0).ru_utime * 1e6)",
    ),
    asks(
        "uninitialised",
        "memory that nobody has filled",
        "return torch.empty(2, 2) + torch.from_numpy(np.empty((2, 2)))",
        env={"MALLOC_PERTURB_": (None, "165")},
    ),
    asks(
        "processors",
        "the processors that the process may use",
        "return picture(len(os.sched_getaffinity(0)))",
        prefix=("taskset -c 0", "taskset -c 0,1"),
    ),
    asks(
        "processors_of_joblib",
        "psutil counts the processors that the process may use",
        "import psutil\n\nreturn picture(len(psutil.Process().cpu_affinity()))",
        prefix=("taskset -c 0", "taskset -c 0,1"),
    ),
    asks(
        "open_files",
        "how many files the process may open",
        "import resource\n\nreturn picture(resource.getrlimit(resource.RLIMIT_NOFILE)[0])",
        prefix=("prlimit --nofile=1024:2048", "prlimit --nofile=1025:2048"),
    ),
    asks(
        "niceness", "the priority", "return picture(os.nice(0))", prefix=("nice -n 1", "nice -n 2")
    ),
    asks(
        "host_name",
        "the name of the machine",
        "import socket\n\nreturn picture(len(socket.gethostname()))",
        prefix=("unshare --uts", "{folder}/renamed"),
        files={
            "renamed": (
                "#!/bin/sh\nexec unshare --uts sh -c 'hostname a_long_name_of_a_machine; exec"
                ' "$@"\' sh "$@"\n'
            )
        },
        make=lambda folder, turn: (folder / "renamed").chmod(0o755),
    ),
    asks(
        "standard_input",
        "what stands in the standard input",
        "return picture(sys.stdin.readline())",
        stdin=("1\n", "2\n"),
    ),
    asks(
        "input_as_file",
        "input by its number",
        "return picture(os.read(0, 10))",
        stdin=("1\n", "2\n"),
    ),
    asks(
        "working_folder",
        "the name of the working folder",
        "return picture(len(os.path.abspath('')))",
        folder=("{folder}/one", "{folder}/three"),
        files={"one/x": "", "three/x": ""},
    ),
    asks(
        "file_of_working_folder",
        "a table that is looked for in the working folder",
        "return picture(np.loadtxt(os.path.join(place, 'gain.txt')))",
        folder=("{folder}/one", "{folder}/three"),
        files={"one/gain.txt": "1", "three/gain.txt": "2"},
    ),
    asks(
        "words_of_command", "the words of the command", "return picture(ord(sys.orig_argv[-1][-1]))"
    ),
    asks(
        "head_of_git",
        "the hash of the repository",
        "return picture(len((Path(place) / '.git' / 'HEAD').read_text()))",
        make=_git,
    ),
    Case(
        "time_of_parameter",
        "the date of the parameter, by the library of zip files",
        """
        @node()
        def value(*, header: DataFile) -> Tensor:
            import zipfile

            return picture(zipfile.ZipInfo.from_file(header, "x").date_time[0])
        """,
        steps=PARAMETER,
        make=_touched,
    ),
    Case(
        "rights_of_parameter",
        "the rights of the parameter, by tarfile",
        """
        @node()
        def value(*, header: DataFile) -> Tensor:
            import io
            import tarfile

            return picture(tarfile.open(fileobj=io.BytesIO(), mode="w").gettarinfo(header).mode)
        """,
        steps=PARAMETER,
        make=_rights,
    ),
    Case(
        "time_by_fsspec",
        "the time of the parameter, by fsspec",
        """
        @node()
        def value(*, header: DataFile) -> Tensor:
            import fsspec

            return picture(fsspec.filesystem("file").info(str(header))["mtime"] // 1e8)
        """,
        steps=PARAMETER,
        make=_touched,
    ),
    asks(
        "shared_memory",
        "shared memory of another program",
        """
from multiprocessing import shared_memory

memory = shared_memory.SharedMemory("neusee_unseen_kind")
number = memory.buf[0]
memory.close()
return picture(number)
""",
        files={"/dev/shm/neusee_unseen_kind": (b"\x01" * 8, b"\x02" * 8)},
    ),
    table(
        "file_in_tmp",
        "what an earlier session left among temporary files",
        "{tmp}/neusee_unseen_kind.txt",
    ),
    table("file_of_system", "settings of the machine", "/usr/local/etc/neusee_unseen_kind.conf"),
    table(
        "file_in_var_tmp",
        "a scratch table that outlives a restart",
        "/var/tmp/neusee_unseen_kind.txt",
    ),
    table("file_in_shared_memory", "a file in shared memory", "/dev/shm/neusee_unseen_kind.txt"),
    table(
        "file_in_cache_of_user",
        "a table that a download left in the cache of the user",
        "{folder}/.cache/lab/gain.txt",
    ),
]
