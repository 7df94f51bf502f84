"""Child processes and sockets of a step, and the processes that the program itself starts."""

import multiprocessing
import os
import socket
import subprocess
import threading

import pytest

from neusee.nodes import cpp_library


def kinds(found):
    return {kind for kind, _ in found}


def test_a_program_that_is_run_is_found_with_the_file_that_it_reads(tmp_path, taints, watched):
    path = tmp_path / "gain.csv"
    path.write_text("2")
    found = taints(lambda: subprocess.run(["cat", path], capture_output=True, check=True).stdout)
    assert ("file", "gain.csv") in found
    assert [what for kind, what in found if kind == "process"] == [os.path.realpath("/bin/cat")]


WAYS = {
    "run": lambda: subprocess.run(["true"], check=True),
    "shell": lambda: subprocess.run("true", shell=True, check=True),
    "system": lambda: os.system("true"),
    "popen": lambda: os.popen("true").close(),
    "spawn": lambda: os.waitpid(os.posix_spawn("/bin/true", ["true"], {}), 0),
}


@pytest.mark.parametrize("way", WAYS)
def test_a_program_is_found_however_it_is_started(way, taints, layer):
    assert "process" in kinds(taints(WAYS[way]))


def test_a_program_that_is_not_there_is_none(tmp_path, taints, watched, monkeypatch):
    monkeypatch.setenv("PATH", str(tmp_path))

    def step():
        with pytest.raises(FileNotFoundError):
            subprocess.run(["nothing"], check=True)

    assert taints(step) == []


@pytest.mark.filterwarnings("ignore:.*multi-threaded.*fork:DeprecationWarning")
def test_a_fork_is_found_and_so_is_what_it_reads(tmp_path, taints, layer):
    path = tmp_path / "gain.csv"
    path.write_text("2")

    def step():
        process = multiprocessing.get_context("fork").Process(target=path.read_text)
        process.start()
        process.join()
        assert process.exitcode == 0

    found = taints(step)
    assert "process" in kinds(found)
    assert (("file", "gain.csv") in found) == (layer == "kernel")


def test_a_connection_is_found_with_its_address(taints, layer):
    with socket.create_server(("127.0.0.1", 0)) as server:
        address = server.getsockname()
        assert ("network", f"127.0.0.1:{address[1]}") in taints(
            lambda: socket.create_connection(address).close()
        )


def test_a_message_without_a_connection_is_found(taints, layer):
    def step():
        with socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as sender:
            sender.sendto(b"x", ("127.0.0.1", 9))

    assert ("network", "127.0.0.1:9") in taints(step)


def test_a_port_that_waits_for_messages_is_found(taints, layer):
    assert "network" in kinds(taints(lambda: socket.create_server(("127.0.0.1", 0)).close()))


def test_a_local_socket_is_found_unless_the_step_made_it(tmp_path, taints, layer, monkeypatch):
    monkeypatch.chdir(tmp_path)

    def talk(name):
        with socket.socket(socket.AF_UNIX) as asking:
            asking.connect(name)

    def both():
        with socket.socket(socket.AF_UNIX) as server:
            server.bind("own")
            server.listen()
            talk("own")

    with socket.socket(socket.AF_UNIX) as server:
        server.bind("other")
        server.listen()
        assert taints(lambda: talk("other")) == [("network", "other")]
    assert taints(both) == []


def test_two_ends_of_a_pair_are_no_network(taints, layer):
    def step():
        one, other = socket.socketpair()
        with one, other:
            one.send(b"x")
            return other.recv(1)

    assert taints(step) == []


def test_the_standard_input_is_found(taints, watched):
    before, (inner, outer) = os.dup(0), os.pipe()
    try:
        os.write(outer, b"2")
        os.dup2(inner, 0)
        assert [kind for kind, _ in taints(lambda: os.read(0, 1))] == ["file"]
    finally:
        os.dup2(before, 0)
        for file in (before, inner, outer):
            os.close(file)


def test_the_program_compiles_its_own_code_without_a_taint(tmp_path, taints, layer, monkeypatch):
    monkeypatch.setenv("XDG_CACHE_HOME", str(tmp_path / "cache"))
    source = tmp_path / "sum.cpp"
    source.write_text('extern "C" int sum(int a, int b) { return a + b; }\n')
    try:
        cpp_library.load(source)
    except cpp_library.NoCompilerError:
        pytest.skip("no compiler")
    source.write_text('extern "C" int sum(int a, int b) { return a + b + 1; }\n')

    def step():
        assert cpp_library.load(source, rounding=cpp_library.UNFUSED).sum(1, 2) == 4

    assert taints(step, source) == []
    assert list((tmp_path / "cache" / "neusee" / "build").iterdir())


def test_a_thread_of_the_step_that_starts_a_program_is_found(taints, layer):
    def step():
        thread = threading.Thread(target=WAYS["run"])
        thread.start()
        thread.join()

    assert "process" in kinds(taints(step))
