"""Machines from YAML: the examples, every device by name, and every mistake at once with its
place.
"""

from __future__ import annotations

import pytest

from neusee.workflows.graph.errors import RecipeError
from neusee.workflows.placement.heft_schedule import Device, Link
from neusee.workflows.placement.machine_file import examples, read_machines
from neusee.workflows.recipe.loading import groups

GOOD = """\
# Two kinds of machine.
devices:
  host: {kind: cpu, memory: 64 GiB, node: [a, b]}
  a100: {kind: cuda, count: 2, memory: 80 GB, speed: {default: 30, optics: 60}, node: [a, b]}
  h200: {kind: cuda, memory: 141 GB, speed: 90, node: b}
links:
  cuda-cpu: {bandwidth: 25 GB/s, latency: 10 us}
  cuda-cuda: {bandwidth: 300 GB/s}
network: {bandwidth: 12.5 GB/s, latency: 0.1 ms}
"""
BAD = """\
devices:
  a100: {knd: cuda, cuont: 8, memory: 80, speed: {optcs: 3}}
  b: {kind: cuad, memory: 80 GBB, count: 0, node: [a, a]}
  c: 3
links:
  cuda-cpu: {bandwith: 3 GB/s, latency: 3}
  cuda: {bandwidth: 0 GB/s}
networks: {}
"""


@pytest.fixture
def read(tmp_path):
    def read(text):
        path = tmp_path / "c.yaml"
        path.write_text(text)
        return read_machines(path)

    return read


@pytest.fixture
def refused(read, tmp_path):
    def refused(text):
        with pytest.raises(RecipeError) as caught:
            read(text)
        start = len(str(tmp_path / "c.yaml:"))
        return [f"{str(p.mark)[start:]} {p.path}: {p.message}" for p in caught.value.diagnostics]

    return refused


def test_every_device_has_a_name_a_memory_and_a_speed(read):
    machines = read(GOOD)
    assert machines.title == "Two kinds of machine."
    assert machines.devices == (
        Device("a/cpu", "cpu", 64 * 2**30),
        Device("b/cpu", "cpu", 64 * 2**30),
        Device("a/cuda:0", "cuda", 80e9),
        Device("a/cuda:1", "cuda", 80e9),
        Device("b/cuda:0", "cuda", 80e9),
        Device("b/cuda:1", "cuda", 80e9),
        Device("b/cuda:2", "cuda", 141e9),
    )
    assert machines.speed("a/cuda:1", "optics.psf") == 60
    assert machines.speed("a/cuda:1", "sensor.read") == 30
    assert machines.speed("b/cuda:2", "sensor.read") == 90
    assert machines.speed("a/cpu", "sensor.read") == 1


def test_links_lie_within_a_machine_and_the_network_between(read):
    cluster = read(GOOD).cluster
    assert cluster.link("a/cpu", "a/cuda:0") == Link(25e9, pytest.approx(1e-5))
    assert cluster.link("b/cuda:2", "b/cuda:0") == Link(300e9, 0.0)
    assert cluster.link("a/cuda:0", "b/cuda:0") == Link(12.5e9, pytest.approx(1e-4))
    assert cluster.link("a/cuda:0", "a/cuda:1").seconds(600e9) == 2


def test_a_machine_without_a_name_is_this_one(read):
    names = [d.name for d in read("devices: {a: {kind: cpu, count: 2, memory: 1 GB}}").devices]
    assert names == ["cpu:0", "cpu:1"]
    assert [d.name for d in read("devices: {a: {kind: cuda, memory: 1 GB}}").devices] == ["cuda:0"]


def test_every_mistake_is_told_at_once_with_its_place(refused):
    assert refused(BAD) == [
        "2:3 devices.a100: needs kind",
        "2:10 devices.a100.knd: unknown; did you mean kind?",
        "2:21 devices.a100.cuont: unknown; did you mean count?",
        (
            "2:39 devices.a100.memory: needs a unit: write a number and one of B, kB, MB, GB, TB,"
            " MiB, GiB, TiB"
        ),
        "2:43 devices.a100.speed: needs default",
        "2:51 devices.a100.speed.optcs: unknown; did you mean optics?",
        "3:13 devices.b.kind: unknown kind of device; did you mean cuda?",
        (
            "3:27 devices.b.memory: has the wrong unit 'GBB': write a number and one of B, kB, MB,"
            " GB, TB, MiB, GiB, TiB"
        ),
        "3:42 devices.b.count: must be a whole number of devices from 1 to 4096",
        "3:51 devices.b.node: must name at least one machine, and no machine twice",
        "4:6 devices.c: must be a mapping with kind, count, memory, speed, node, not a number",
        "6:3 links.cuda-cpu: needs bandwidth",
        "6:14 links.cuda-cpu.bandwith: unknown; did you mean bandwidth?",
        (
            "6:41 links.cuda-cpu.latency: needs a unit: write a number and one of s, ms, us, µs,"
            " μs, ns"
        ),
        "7:3 links.cuda: must name two kinds, such as cuda-cuda or cpu-cuda",
        "7:21 links.cuda.bandwidth: must be above 0, such as 25 GB/s",
        "8:1 networks: unknown; did you mean network?",
    ]


ONE = "devices: {a: {kind: cpu, memory: 1 GB}}\n"


@pytest.mark.parametrize(
    ("text", "message"),
    [
        ("links: {}", "1:1 : needs devices"),
        (
            "devices: {}",
            (
                "1:10 devices: must be a mapping of device groups, such as `a100: {kind: cuda,"
                " memory: 80 GB}`"
            ),
        ),
        (
            ONE + "links: 3",
            "2:8 links: must be a mapping of links, such as `cuda-cuda: {bandwidth: 300 GB/s}`",
        ),
        (
            ONE + "links: {cpu-cuda: {bandwidth: 1 GB/s}}",
            "2:9 links.cpu-cuda: there is no device of kind cuda; there are: cpu",
        ),
        (
            ONE + "links: {cpu-cpu: {bandwidth: 1 GB/s}, cpu-cpu: {bandwidth: 1 GB/s}}",
            "2:39 links.cpu-cpu: given twice, first in line 2",
        ),
        (
            (
                "devices: {a: {kind: cpu, memory: 1 GB}, b: {kind: cuda, memory: 1 GB}}\n"
                "links: {cpu-cuda: {bandwidth: 1 GB/s}, cuda-cpu: {bandwidth: 1 GB/s}}"
            ),
            "2:40 links.cuda-cpu: is the same as cpu-cuda",
        ),
        (
            "devices: {a: {kind: cpu, memory: 1 GB, count: 4000, node: [x, y]}}",
            "1:10 devices: must be 4096 devices or fewer, not 8000",
        ),
        (
            "devices: {a: {kind: cpu, memory: true}}",
            "1:34 devices.a.memory: must be a number and a unit, such as 80 GB",
        ),
        (
            "devices: {a: {kind: cpu, memory: 1 GB, speed: 0}}",
            "1:47 devices.a.speed: must be a number above 0: the ratio to the measured speed",
        ),
        (
            "devices: {a: {kind: cpu, memory: 1 GB, node: 3}}",
            "1:46 devices.a.node: must be the name of a machine, or a list of such names",
        ),
    ],
)
def test_a_mistake_is_one_line(refused, text, message):
    assert refused(text) == [message]


def test_three_examples_come_along_and_are_no_group_of_recipes():
    found = {name: read_machines(name) for name in examples()}
    assert list(found) == ["eight_a100", "node_of_64_cores", "one_h200"]
    assert all(machines.title for machines in found.values())
    assert [d.memory for d in found["eight_a100"].devices if d.kind == "cuda"] == [80e9] * 8
    assert [d.memory for d in found["one_h200"].devices if d.kind == "cuda"] == [141e9]
    assert len(found["node_of_64_cores"].devices) == 8
    assert not {"clusters", "samples"} & groups().keys()


def test_a_name_that_is_no_file_gets_the_nearest_example():
    with pytest.raises(
        RecipeError, match=r"no such file, and no example of that name; did you mean eight_a100\?"
    ):
        read_machines("eight_a10")
