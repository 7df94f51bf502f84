"""The table of system calls and the filter that is made of it, on the calls that only native
code makes.
"""

import ctypes
import mmap
import os
import platform
import re
import struct
from pathlib import Path

import pytest

from neusee.workflows.observation import system_calls
from neusee.workflows.observation import system_calls as seccomp_filter
from neusee.workflows.observation.system_calls import CALLS, Condition, machine, numbers

libc = ctypes.CDLL(None, use_errno=True)
HEADERS = {
    "x86_64": Path("/usr/include/x86_64-linux-gnu/asm/unistd_64.h"),
    "aarch64": Path("/usr/include/asm-generic/unistd.h"),
}
#: in the header of aarch64
OTHER_NAMES = {"newfstatat": "__NR3264_fstatat", "truncate": "__NR3264_truncate"}


@pytest.mark.parametrize("name", HEADERS)
def test_the_numbers_are_those_of_the_headers_of_the_kernel(name):
    if not HEADERS[name].is_file():
        pytest.skip("no headers of the kernel")
    defined = dict(re.findall(r"#define (__NR\w+)\s+(\d+)", HEADERS[name].read_text()))
    for call in CALLS:
        wanted = defined.get(f"__NR_{call.name}", defined.get(OTHER_NAMES.get(call.name, ""), "-1"))
        assert getattr(call, name) == int(wanted), call.name


def run(program, number, arguments=(), arch=0xC000003E):
    """What a filter says of a call: the instructions of BPF, carried out."""
    data = struct.pack("<iIQ6Q", number, arch, 0, *(*arguments, *[0] * (6 - len(arguments))))
    place = held = 0
    while True:
        code, then, otherwise, operand = program[place]
        place += 1
        if code == seccomp_filter.BPF_RET:
            return {
                seccomp_filter.SECCOMP_RET_USER_NOTIF: "stop",
                seccomp_filter.SECCOMP_RET_ALLOW: "pass",
            }[operand]
        if code == seccomp_filter.BPF_LD_W_ABS:
            held = struct.unpack_from("<I", data, operand)[0]
            continue
        tests = {
            seccomp_filter.BPF_JEQ: held == operand,
            seccomp_filter.BPF_JGE: held >= operand,
            seccomp_filter.BPF_JSET: bool(held & operand),
        }
        place += then if tests[code] else otherwise


@pytest.mark.parametrize("name", ["x86_64", "aarch64"])
def test_the_filter_stops_at_the_calls_of_the_table_alone(name):
    program, arch = seccomp_filter.program(name), system_calls.audit_arch(name)
    by_number = numbers(name)
    for number in range(500):
        call = by_number.get(number)
        for value in (0, 1, 0x1000, 0x4000, 0x10000, 1 << 40):
            stops = call is not None and (call.when is None or holds(call.when, value))
            assert run(program, number, [value] * 6, arch) == ("stop" if stops else "pass"), (
                number,
                value,
            )


def holds(when: Condition, value):
    return {
        "without": not value & when.mask,
        "zero": not value & 0xFFFFFFFF,
        "nonzero": value != 0,
    }[when.test]


def test_calls_of_other_conventions_stop_where_they_open_or_start_something():
    program = seccomp_filter.program("x86_64")
    assert run(program, 5, arch=system_calls.AUDIT_ARCH_I386) == "stop"
    assert run(program, 3, arch=system_calls.AUDIT_ARCH_I386) == "pass"
    assert run(program, 0x40000000 | 2) == "stop"
    assert run(program, 5, arch=1) == "pass"


def opened_by_openat2(path):
    how = struct.pack("QQQ", os.O_RDONLY, 0, 0)
    file = libc.syscall(437, -100, os.fsencode(path), how, len(how))
    assert file >= 0
    os.close(file)


def test_openat2_is_found(tmp_path, taints, watched):
    (tmp_path / "gain.csv").write_text("2")
    assert taints(lambda: opened_by_openat2(tmp_path / "gain.csv")) == [("file", "gain.csv")]


def test_statx_and_the_state_of_an_open_file_differ(tmp_path, taints, watched):
    (tmp_path / "gain.csv").write_text("2")
    number, room = (332 if machine() == "x86_64" else 291), ctypes.create_string_buffer(256)
    path = os.fsencode(tmp_path / "gain.csv")
    assert taints(lambda: libc.syscall(number, -100, path, 0, 0xFFF, room)) == [
        ("file", "gain.csv")
    ]
    with open(path) as file:
        assert (
            taints(
                lambda: [
                    libc.syscall(number, file.fileno(), b"", 0x1000, 0xFFF, room),
                    os.fstat(file.fileno()),
                ]
            )
            == []
        )


def test_a_ring_that_could_open_files_is_unknown(taints, watched):
    def step():
        ring = libc.syscall(425, 1, ctypes.create_string_buffer(120))
        if ring >= 0:
            os.close(ring)

    assert taints(step) == [("unknown", "io_uring_setup")]


def test_shared_memory_with_a_name_is_unknown_and_without_one_is_none(taints, watched):
    def step(key):
        segment = libc.shmget(key, 4096, 0o1600)
        libc.shmctl(segment, 0, None)

    assert taints(lambda: step(0x6E65)) == [("unknown", "shmget")]
    assert taints(lambda: step(0)) == []


def test_a_handle_of_a_file_and_the_memory_of_a_process_are_unknown(taints, watched):
    number = 304 if machine() == "x86_64" else 265
    assert taints(lambda: libc.syscall(number, -100, 0, 0)) == [("unknown", "open_by_handle_at")]
    assert taints(lambda: libc.process_vm_readv(os.getpid(), 0, 0, 0, 0, 0)) == [
        ("unknown", "process_vm_readv")
    ]


def test_a_path_that_cannot_be_read_is_unknown(taints, watched):
    number = 257 if machine() == "x86_64" else 56
    (found,) = taints(lambda: libc.syscall(number, -100, ctypes.c_void_p(8), 0))
    assert found[0] == "unknown"
    assert found[1].startswith("openat")


@pytest.mark.skipif(
    platform.machine() != "x86_64", reason="only a processor of this kind has calls of 32 bits"
)
def test_a_call_of_32_bits_is_unknown(tmp_path, taints, watched):
    (tmp_path / "gain.csv").write_text("2")
    code = mmap.mmap(
        -1,
        4096,
        mmap.MAP_PRIVATE | mmap.MAP_ANONYMOUS | 0x40,
        mmap.PROT_READ | mmap.PROT_WRITE | mmap.PROT_EXEC,
    )
    address = ctypes.addressof(ctypes.c_char.from_buffer(code))
    assert address < 1 << 32  # MAP_32BIT, so that a call of 32 bits can name the path
    path = os.fsencode(tmp_path / "gain.csv") + b"\0"
    code[1024 : 1024 + len(path)] = path
    # push rbx; mov ebx, path; xor ecx, ecx; xor edx, edx; mov eax, 5 (open); int 0x80; pop rbx; ret
    code[:21] = (
        b"\x53\xbb"
        + struct.pack("<I", address + 1024)
        + b"\x31\xc9\x31\xd2\xb8\x05\0\0\0\xcd\x80\x5b\xc3\x90\x90"
    )
    opened = []
    found = taints(lambda: opened.append(ctypes.CFUNCTYPE(ctypes.c_int)(address)()))
    if opened[0] < 0:
        pytest.skip("this kernel takes no calls of 32 bits")
    os.close(opened[0])
    assert found == [("unknown", "a call of 32 bits")]


def test_a_path_below_the_own_entry_of_proc_is_that_of_the_step(tmp_path, taints, watched):
    (tmp_path / "gain.csv").write_text("2")
    path = f"/proc/self/root{tmp_path}/gain.csv"
    assert taints(lambda: Path(path).read_text()) == [("file", "gain.csv")]
    assert taints(lambda: Path("/proc/self/status").read_text()) == []
