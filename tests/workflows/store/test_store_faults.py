"""What may befall a store: kill -9, damage, full and read-only disks, crowds, clocks.

Always the same three promises, each through whole runs in processes of their own: never a wrong
value, never a lasting failure (the next run is right and the one after it computes nothing),
and nothing half-made left behind for longer than a lease.
"""

from __future__ import annotations

import importlib.util
import os
import random
import signal
import subprocess
import tempfile
import time
from collections import Counter
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import pytest
import torch
from hypothesis import HealthCheck, given, settings
from hypothesis import strategies as st

SPEC = importlib.util.spec_from_file_location("forks", Path(__file__).parents[1] / "forks.py")
forks = importlib.util.module_from_spec(SPEC)
SPEC.loader.exec_module(forks)

NODES = """
import os
import time

import torch

from neusee.nodes import node

__depends__ = ("unaffected:os",)


def ran(name):
    file = os.open(os.environ["FAULT_LOG"], os.O_WRONLY | os.O_APPEND | os.O_CREAT, 0o666)
    os.write(file, f"{name} {os.getpid()}\\n".encode())
    os.close(file)
    time.sleep(float(os.environ.get("FAULT_PAUSE", "0.003")))
    while os.path.exists(os.environ.get("FAULT_GATE", "")):
        time.sleep(0.005)
    if os.environ.get("FAULT_FAILS"):
        raise ValueError("it was told to fail")


@node()
def begin(*, level: float, count: int):
    ran("begin")
    return torch.arange(count) + level


@node()
def add(x, *, k: float):
    ran(f"add{k:g}")
    return x + k


@node()
def total(x):
    ran("total")
    return x.sum(dtype=torch.float64)[None]


@node()
def whose():
    ran("whose")
    return torch.full((5000,), float(os.getpid()))
"""
NOBODY = "os.setuid(65534)"
COUNT = 20_000  #: numbers in a value that has a payload: 80 kB
STEPS = ("begin", "one", "two", "three", "total")
ALL = Counter({"begin": 1, "add1": 1, "add2": 1, "add3": 1, "total": 1})


class Ward:
    """A store under observation, and a row of steps that all are outputs: four large ones and a
    small one.
    """

    def __init__(self, folder: Path, server: Any, store: Path | None = None) -> None:
        self.folder, self.server, self.store = folder / "nodes", server, store or folder / "cache"
        self.log = folder / "ran.txt"
        self.folder.mkdir()
        (self.folder / "fault.py").write_text(NODES)

    def job(
        self, level: float = 0.0, count: int = COUNT, first: str = "", pause: float = 0.003
    ) -> dict[str, Any]:
        steps = [["begin", "begin", {"level": level, "count": count}, {}]]
        for k, (name, source) in enumerate(zip(STEPS[1:4], STEPS, strict=False)):
            steps.append([name, "add", {"k": k + 1.0}, {"x": source}])
        steps.append(["total", "total", {}, {"x": "three"}])
        return {**self._common(first, pause), "steps": steps, "outputs": STEPS}

    def whose(self, pause: float = 0.003, gate: Path | str = "") -> dict[str, Any]:
        """A job whose value tells which process has computed it, which takes as long as there is
        a file ``gate``.
        """
        first = f"os.environ['FAULT_GATE'] = {str(gate)!r}"
        return {
            **self._common(first, pause),
            "steps": [["whose", "whose", {}, {}]],
            "outputs": ["whose"],
        }

    def _common(self, first: str, pause: float) -> dict[str, Any]:
        environment = {"FAULT_LOG": str(self.log), "FAULT_PAUSE": str(pause)}
        first = f"import os; os.environ.update({environment!r})\n{first}"
        return {"folder": self.folder, "family": "fault", "store": self.store, "first": first}

    def run(self, **options: Any) -> tuple[list[str], Counter[str]]:
        """Run, see that every value is right, and give the warnings and what was computed."""
        self.forget()
        found = self.server.run(**self.job(**options))
        self.right(found, options.get("level", 0.0), options.get("count", COUNT))
        return found["warnings"], self.ran()

    def right(self, found: dict[str, Any], level: float = 0.0, count: int = COUNT) -> None:
        assert found.get("error") is None, found["error"]
        x, expected = torch.arange(count) + level, {}
        for k, name in enumerate(STEPS[:4]):
            x = x + float(k) if k else x
            expected[name] = forks.shown(x)
        assert found["values"] == {**expected, "total": [float(x.sum(dtype=torch.float64))]}

    def ran(self) -> Counter[str]:
        return Counter(line.split()[0] for line in self.lines())

    def lines(self) -> list[str]:
        return self.log.read_text().splitlines() if self.log.exists() else []

    def forget(self) -> None:
        self.log.unlink(missing_ok=True)

    def well(self, **options: Any) -> None:
        """The next run is right and quiet, and the one after it computes nothing."""
        assert self.run(**options)[0] == []
        assert self.run(**options) == ([], Counter())

    def files(self, suffix: str) -> list[Path]:
        return sorted(self.store.glob(f"[0-9a-f][0-9a-f]/*.{suffix}"))

    def leftovers(self) -> list[str]:
        """Half-made files that the next run leaves where they are, though they are a day old."""
        for path in self.store.rglob("*"):
            if path.is_file():
                os.utime(path, (time.time() - 86400,) * 2)
        self.run(level=-1.0)
        return [
            path.name
            for path in (self.store / "tmp").iterdir()
            if path.stat().st_mtime < time.time() - 3600
        ]


@pytest.fixture(scope="module")
def server(tmp_path_factory):
    found = forks.Forks(tmp_path_factory.mktemp("forks"))
    yield found
    found.close()


@pytest.fixture
def ward(tmp_path, server):
    return Ward(tmp_path, server)


def mounted(folder: Path, options: str) -> None:
    command = ["mount", "-t", "tmpfs", "-o", options, "tmpfs", folder]
    if os.geteuid() != 0 or subprocess.run(command, capture_output=True).returncode:
        pytest.skip(
            "only root may mount a small disk; the tests with a limit on the size of files stand in"
            " for it"
        )


@pytest.fixture
def disk(tmp_path, server) -> Iterator[Ward]:
    """A ward whose store is a disk of its own, of 1 MB."""
    folder = tmp_path / "disk"
    folder.mkdir()
    mounted(folder, "size=1m")
    try:
        yield Ward(tmp_path, server, folder)
    finally:
        subprocess.run(["umount", "-l", folder], check=True)


def remount(ward: Ward, options: str) -> None:
    subprocess.run(["mount", "-o", f"remount,{options}", ward.store], check=True)


# kill -9


def killed(ward: Ward, count: int) -> None:
    """Kill ``count`` runs at random points, each followed by one that is let alone."""
    draw = random.Random(count)
    began = time.monotonic()
    ward.run(level=-2.0)
    whole = time.monotonic() - began
    for i in range(count):
        child = ward.server.start(**ward.job(level=float(i)))
        time.sleep(draw.uniform(0.1, 1.0) * whole)
        child.kill()
        child.wait()
        ward.well(level=float(i))
    assert ward.leftovers() == []


@pytest.mark.slow
def test_a_killed_run_does_no_harm(ward):
    killed(ward, 8)


@pytest.mark.long
def test_fifty_killed_runs_do_no_harm(ward):
    """`test_a_killed_run_does_no_harm` kills eight."""
    killed(ward, 50)


@pytest.mark.slow
def test_killed_crowds_do_no_harm(ward):
    """Four runs of the same steps at once, of which one after the other is killed."""
    draw = random.Random(4)
    for i in range(6):
        crowd = [ward.server.start(**ward.job(level=float(i))) for _ in range(4)]
        for child in crowd[:3]:
            time.sleep(draw.uniform(0.0, 0.05))
            child.kill()
        ward.right(crowd[3].result(), float(i))
        ward.well(level=float(i))
    assert ward.leftovers() == []


# damage

DAMAGES = {
    "cut to half": lambda raw: raw[: len(raw) // 2],
    "one byte short": lambda raw: raw[:-1],
    "no bytes": lambda raw: b"",
    "all zero": lambda raw: bytes(len(raw)),
    "one byte more": lambda raw: raw + b"\0",
    "another content": lambda raw: b"{}" * 100,
}


@pytest.mark.slow
@pytest.mark.parametrize("suffix", ["json", "safetensors"])
@pytest.mark.parametrize("damage", DAMAGES)
def test_damage_is_seen_and_mended(ward, suffix, damage):
    ward.run()
    for path in ward.files(suffix):
        path.write_bytes(DAMAGES[damage](path.read_bytes()))
    count = len(ward.files(suffix))
    assert count == (5 if suffix == "json" else 4)
    warnings, ran = ward.run()
    assert all("is damaged" in text for text in warnings)
    assert len(warnings) == count
    assert sum(ran.values()) == count
    ward.well()


@pytest.mark.slow
@settings(
    max_examples=12,
    deadline=None,
    suppress_health_check=[HealthCheck.function_scoped_fixture, HealthCheck.too_slow],
)
@given(
    which=st.integers(0, 4),
    suffix=st.sampled_from(["json", "safetensors"]),
    at=st.floats(0, 1),
    bit=st.integers(0, 7),
)
def test_no_flipped_bit_is_served(ward, which, suffix, at, bit):
    ward.run()
    paths = ward.files(suffix)
    path = paths[which % len(paths)]
    raw = bytearray(path.read_bytes())
    raw[int(at * (len(raw) - 1))] ^= 1 << bit
    path.write_bytes(raw)
    warnings, ran = ward.run()
    assert len(warnings) == 1
    assert sum(ran.values()) == 1
    ward.well()


def test_damage_beside_the_results_costs_nothing(ward):
    """The journal, the memo of the code, locks: whatever else lies there is advice, not truth."""
    ward.run()
    kept = {*ward.files("json"), *ward.files("safetensors")}
    others = [path for path in ward.store.rglob("*") if path.is_file() and path not in kept]
    assert others
    for damage in DAMAGES.values():
        for path in others:
            path.write_bytes(damage(path.read_bytes() if path.exists() else b""))
        assert ward.run() == ([], Counter())


# full and read-only disks


@pytest.mark.parametrize("free", [0, 3, 50, 85, 200])  # kB; a value has 80 kB
def test_a_full_disk_costs_one_warning(disk, free):
    ballast = disk.store / "ballast"
    ballast.write_bytes(bytes((1024 - free) * 1024))
    warnings, ran = disk.run()
    assert ran == ALL
    assert len(warnings) == 1
    assert "cannot be written" in warnings[0]
    ballast.unlink()
    disk.well()
    assert disk.leftovers() == []


def test_a_disk_without_room_for_names_costs_one_warning(disk):
    remount(disk, "nr_inodes=6")
    warnings, ran = disk.run()
    assert ran == ALL
    assert len(warnings) == 1
    remount(disk, "nr_inodes=1000")
    disk.well()


@pytest.mark.parametrize("limit", [0, 100, 2000, 50_000])
def test_files_that_may_not_grow_cost_one_warning(ward, limit):
    """What a full disk looks like to a program, for those who may not mount one."""
    first = (
        "import resource, signal\n"
        "signal.signal(signal.SIGXFSZ, signal.SIG_IGN)\n"
        f"resource.setrlimit(resource.RLIMIT_FSIZE, ({limit}, resource.RLIM_INFINITY))"
    )
    last = "resource.setrlimit(resource.RLIMIT_FSIZE, (resource.RLIM_INFINITY,) * 2)"
    ward.log.write_text("x" * 10)
    ward.forget()
    found = ward.server.run(
        **ward.job(first=f"{first}\nos.environ['FAULT_LOG'] = '/dev/null'"), last=last
    )
    ward.right(found)
    assert len(found["warnings"]) == 1
    assert "cannot be written" in found["warnings"][0]
    ward.well()
    assert ward.leftovers() == []


@pytest.mark.parametrize("before", ["nothing", "all", "some"])
def test_a_read_only_store_is_read(disk, before):
    if before != "nothing":
        disk.run()
    if before == "some":
        for path in disk.files("json")[:3]:
            path.unlink()
    remount(disk, "ro")
    warnings, ran = disk.run()
    assert sum(ran.values()) == {"nothing": 5, "some": 3, "all": 0}[before]
    assert len(warnings) == (0 if before == "all" else 1)
    assert disk.run()[1] == ran
    remount(disk, "rw")
    disk.well()


def test_another_user_reads_what_it_may_not_write(server):
    if os.geteuid() != 0:
        pytest.skip("only root can become somebody else")
    with tempfile.TemporaryDirectory() as place:
        os.chmod(place, 0o755)
        ward = Ward(Path(place), server)
        ward.run()
        ward.log.chmod(0o666)
        assert ward.run(first=NOBODY) == ([], Counter())
        ward.log.touch()
        ward.log.chmod(0o666)
        found = server.run(**ward.job(level=5.0, first=NOBODY))
        ward.right(found, 5.0)
        assert len(found["warnings"]) == 1
        assert ward.ran() == ALL
        ward.well(level=5.0)


# crowds


def test_of_four_processes_one_computes_and_all_have_its_value(ward):
    crowd = [ward.server.start(**ward.whose(pause=0.3)) for _ in range(4)]
    found = [child.result() for child in crowd]
    assert [each.get("error") for each in found] == [None] * 4
    assert len(ward.lines()) == 1
    assert len({each["values"]["whose"] for each in found}) == 1
    assert all(each["warnings"] == [] for each in found)


def test_four_processes_share_a_row_of_steps(ward):
    crowd = [ward.server.start(**ward.job(pause=0.05)) for _ in range(4)]
    for child in crowd:
        ward.right(child.result())
    assert ward.ran() == ALL
    ward.well()


def test_a_failed_step_lets_the_next_one_try(ward):
    found = ward.server.run(**ward.job(first="os.environ['FAULT_FAILS'] = '1'"))
    assert "it was told to fail" in found["error"]
    assert ward.run() == ([], ALL)


def waiting(ward: Ward, gate: Path) -> Any:
    """A process in the midst of computing, which it does until somebody removes the file
    ``gate``.
    """
    gate.touch()
    child = ward.server.start(**ward.whose(gate=gate))
    end = time.monotonic() + 300
    while not ward.lines():
        assert time.monotonic() < end
        time.sleep(0.005)
    return child


def test_a_killed_owner_is_followed_at_once(ward):
    child = waiting(ward, ward.folder / "gate")
    child.kill()
    child.wait()
    found = ward.server.start(**ward.whose()).result()
    assert found.get("error") is None
    assert found["warnings"] == []
    assert len(ward.lines()) == 2


def test_a_stopped_owner_is_followed_and_does_no_harm_when_it_wakes(ward):
    gate = ward.folder / "gate"
    child = waiting(ward, gate)
    child.kill(signal.SIGSTOP)
    found = ward.server.start(**ward.whose()).result()
    assert found.get("error") is None
    assert len(ward.lines()) == 2
    gate.unlink()
    child.kill(signal.SIGCONT)
    late = child.result()
    assert late.get("error") is None
    assert ward.server.run(**ward.whose())["values"] == found["values"]
    assert len(ward.lines()) == 2


@pytest.mark.slow
def test_two_who_evict_and_two_who_compute_do_no_harm(ward):
    """Each evictor leaves room for two values of nine, over and over, while others write and
    read them.
    """
    evict = "for _ in range(60):\n    type(store)(store.root).gc(budget=200_000)"
    crowd = [(ward.server.start(**ward.job(level=9.0, first=evict)), 9.0) for _ in range(2)]
    for i in range(12):
        crowd += [
            (ward.server.start(**ward.job(level=level)), level)
            for level in (float(i % 3), float(i % 2))
        ]
        for child, level in crowd[-2:]:
            ward.right(child.result(), level)
    for child, level in crowd:
        found = child.result()
        ward.right(found, level)
        assert found["warnings"] == []
    for level in (0.0, 1.0, 2.0, 9.0):
        ward.well(level=level)
    assert ward.leftovers() == []


def test_another_user_may_evict_what_it_may_write(server):
    """In a folder that is open to all, two users' evictors do not stumble over each other."""
    if os.geteuid() != 0:
        pytest.skip("only root can become somebody else")
    with tempfile.TemporaryDirectory() as place:
        os.chmod(place, 0o755)
        ward = Ward(Path(place), server)
        ward.store.mkdir()
        ward.store.chmod(0o777)
        ward.log.touch()
        ward.log.chmod(0o666)
        evict = "for _ in range(20):\n    type(store)(store.root).gc(budget=100_000)"
        for i in range(4):
            crowd = [
                ward.server.start(**ward.job(level=float(i), first=f"{who}\n{evict}"))
                for who in ("", NOBODY)
            ]
            for child in crowd:
                found = child.result()
                ward.right(found, float(i))
                assert found["warnings"] == []
        ward.well()


# clocks

DAY = 86400.0
CLOCKS = {
    "ten years ahead": f"later = lambda: {3650 * DAY}",
    "ten years behind": f"later = lambda: {-3650 * DAY}",
    "at the beginning of time": "later = lambda: -real()",
    "back and forth": (
        f"from itertools import cycle; turn = cycle([0, {DAY}, {-DAY}]); later = lambda: next(turn)"
    ),
}


def clock(name: str) -> str:
    """A clock that is wrong by what ``later`` says, and a steady one that runs on."""
    return f"import time; real = time.time; {CLOCKS[name]}\ntime.time = lambda: real() + later()"


@pytest.mark.parametrize("name", CLOCKS)
def test_a_wrong_clock_does_no_harm(ward, name):
    assert ward.run(first=clock(name)) == ([], ALL)
    assert ward.run(first=clock(name)) == ([], Counter())
    assert ward.run() == ([], Counter())
    assert ward.run(level=1.0) == ([], ALL)
    assert ward.run(level=1.0, first=clock(name)) == ([], Counter())


@pytest.mark.slow
@pytest.mark.parametrize("name", CLOCKS)
def test_processes_whose_clocks_differ_get_on_with_each_other(ward, name):
    """Who is ten years ahead holds nobody for dead, and sweeps away nothing that is being
    written.
    """
    firsts = ("", clock(name), "", clock(name))
    crowd = [ward.server.start(**ward.job(first=first, pause=0.05)) for first in firsts]
    for child in crowd:
        found = child.result()
        ward.right(found)
        assert found["warnings"] == []
    assert ward.ran() == ALL
    ward.well()


@pytest.mark.parametrize("name", CLOCKS)
def test_eviction_by_a_wrong_clock_does_no_harm(ward, name):
    ward.run()
    assert ward.run(first=f"{clock(name)}\nstore.gc(budget=200_000)")[0] == []
    ward.well()


def test_dates_of_files_from_the_future_do_no_harm(ward):
    ward.run()
    for path in ward.store.rglob("*"):
        os.utime(path, (time.time() + 3650 * DAY,) * 2)
    assert ward.run() == ([], Counter())
    assert ward.run(level=1.0) == ([], ALL)
