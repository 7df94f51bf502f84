"""Reader of machine files, which describe devices, their speed and memory, and their links in YAML.

    devices:
      host: {kind: cpu, memory: 2 TB, speed: 10}
      a100: {kind: cuda, count: 8, memory: 80 GB, speed: {default: 50, sensor: 30}}
    links:
      cuda-cuda: {bandwidth: 300 GB/s, latency: 5 us}
    network: {bandwidth: 25 GB/s, latency: 5 us}

``speed`` is relative to the machine on which the costs were measured, for all nodes or by family
of nodes. ``node: [a, b]`` puts a group of devices on each of the machines ``a`` and ``b``; the
network links the machines.
"""

from __future__ import annotations

import math
import pkgutil
import re
from collections import Counter
from collections.abc import Callable, Mapping
from dataclasses import dataclass, field
from functools import partial
from importlib.resources import files
from importlib.util import find_spec
from pathlib import Path
from typing import Any

from neusee.workflows.graph.errors import Diagnostic, Location, RecipeError, nearest
from neusee.workflows.placement.tasks_and_devices import BUS, Cluster, Device, Link
from neusee.workflows.recipe.text.yaml_values import Value, kind, read
from neusee.workflows.store.cache_settings import UNITS

_KINDS = ("cpu", "cuda", "mps")
_SECONDS = {"s": 1.0, "ms": 1e-3, "us": 1e-6, "µs": 1e-6, "μs": 1e-6, "ns": 1e-9}
_RATES = {f"{unit}/s": scale for unit, scale in UNITS.items() if unit in ("MB", "GB", "TB")}
_QUANTITY = re.compile(r"((?:\d+\.?\d*|\.\d+)(?:[eE][-+]?\d+)?)\s*(.*)")
_MOST_DEVICES = 4096  #: largest number of devices in one file
_Reader = Callable[[Value, "list[Diagnostic]"], Any]


@dataclass(frozen=True)
class Machines:
    """Cluster of devices, with the speed of each device relative to the machine on which run
    times were measured.
    """

    title: str
    cluster: Cluster
    #: relative speed, by device and then by family of nodes or ``default``
    speeds: Mapping[str, Mapping[str, float]] = field(repr=False)

    @property
    def devices(self) -> tuple[Device, ...]:
        return self.cluster.devices

    def speed(self, device: str, node: str) -> float:
        """Return the relative speed at which ``device`` runs a node such as ``optics.psf``."""
        speeds = self.speeds[device]
        return speeds.get(node.partition(".")[0], speeds["default"])


def read_machines(path: Path | str) -> Machines:
    """Read a machine file or a packaged example; raise one `RecipeError` that lists all mistakes
    in the file.
    """
    document = read(_path(path), str(path))
    diagnostics: list[Diagnostic] = []
    # all mistakes are collected and raised together
    root = _fields(
        document.root,
        {"devices": _groups, "links": _links, "network": _link},
        ("devices",),
        diagnostics,
    )
    groups, links = root.get("devices") or [], root.get("links") or {}
    if not diagnostics:
        diagnostics += _absent(
            document.root.items.get("links"), {group["kind"] for group in groups}
        )
    if diagnostics:
        raise RecipeError(diagnostics)
    devices = _devices(groups)
    if len(devices) > _MOST_DEVICES:
        message = f"must be {_MOST_DEVICES} devices or fewer, not {len(devices)}"
        raise RecipeError([_problem(document.root.items["devices"], message)])
    speeds = {device.name: group["speed"] for device, group in devices.items()}
    # the default is that of `Cluster`
    network = root.get("network") or Cluster.network
    return Machines(document.title, Cluster(tuple(devices), links, BUS, network), speeds)


def examples() -> dict[str, Path]:
    """Return the path of each packaged example of a machine file, by the name of the example."""
    folder = Path(str(files("neusee.recipes"))) / "samples" / "clusters"
    return {path.stem: path for path in sorted(folder.glob("*.yaml"))}


def _path(path: Path | str) -> Path:
    """Return the path of a machine file, or of the packaged example with that name."""
    if Path(path).is_file():
        return Path(path)
    example_paths = examples()
    if str(path) not in example_paths:
        message = f"no such file, and no example of that name; {nearest(str(path), example_paths)}"
        raise RecipeError([Diagnostic(Location("--devices"), str(path), message)])
    return example_paths[str(path)]


def _devices(groups: list[dict[str, Any]]) -> dict[Device, dict[str, Any]]:
    """Return each device of a machine file with the group of settings that describes the device.

    A device has a name such as ``cpu``, or ``a/cuda:0`` for GPU 0 of the machine ``a``.
    """
    rows = list[tuple[str, dict[str, Any]]]()
    for group in groups:
        for machine in group["node"]:
            rows += [(machine, group)] * group["count"]
    group_sizes, numbers_used = (
        Counter((machine, group["kind"]) for machine, group in rows),
        Counter[tuple[str, str]](),
    )
    devices = {}
    for machine, group in rows:
        machine_and_kind = (machine, group["kind"])
        # the name of a machine's only CPU has no number
        name = (
            "cpu"
            if machine_and_kind[1] == "cpu" and group_sizes[machine_and_kind] == 1
            else f"{machine_and_kind[1]}:{numbers_used[machine_and_kind]}"
        )
        numbers_used[machine_and_kind] += 1
        devices[
            Device(f"{machine}/{name}" if machine else name, machine_and_kind[1], group["memory"])
        ] = group
    return devices


# --- values ---------------------------------------------------------------------------------------


def _groups(value: Value, diagnostics: list[Diagnostic]) -> list[dict[str, Any]]:
    """Return the groups of devices in a machine file, with defaults in place of missing fields."""
    if not isinstance(value.data, dict) or not value.data:
        diagnostics.append(
            _problem(
                value,
                "must be a mapping of device groups, such as `a100: {kind: cuda, memory: 80 GB}`",
            )
        )
        return []
    readers: dict[str, _Reader] = {
        "kind": _kind,
        "count": _count,
        "memory": _size,
        "speed": _speed,
        "node": _names,
    }
    # defaults: one device with the speed of the measured one, on a machine without a name
    defaults: dict[str, Any] = {"count": 1, "speed": {"default": 1.0}, "node": [""]}
    return [
        defaults | _fields(group, readers, ("kind", "memory"), diagnostics)
        for group in value.data.values()
    ]


def _links(value: Value, diagnostics: list[Diagnostic]) -> dict[tuple[str, str], Link]:
    """Return the links between kinds of devices, by the two kinds."""
    if not isinstance(value.data, dict):
        diagnostics.append(
            _problem(
                value, "must be a mapping of links, such as `cuda-cuda: {bandwidth: 300 GB/s}`"
            )
        )
        return {}
    links = {}
    for name, link in value.data.items():
        first_kind, hyphen, other_kind = str(name).partition("-")
        if not hyphen:
            diagnostics.append(
                _problem(link, "must name two kinds, such as cuda-cuda or cpu-cuda", link.key)
            )
        if (other_kind, first_kind) in links:
            diagnostics.append(
                _problem(link, f"is the same as {other_kind}-{first_kind}", link.key)
            )
        # without a second kind, so that further mistakes are found
        links[first_kind, other_kind or first_kind] = _link(link, diagnostics)
    return links


def _link(value: Value, diagnostics: list[Diagnostic]) -> Link:
    """Return the bandwidth (bytes/s) and the latency (s) of a link."""
    return Link(
        **_fields(value, {"bandwidth": _rate, "latency": _time}, ("bandwidth",), diagnostics)
    )


def _fields(
    value: Value,
    readers: Mapping[str, _Reader],
    required: tuple[str, ...],
    diagnostics: list[Diagnostic],
) -> dict[str, Any]:
    """Convert the fields of a YAML mapping and return the values; report unknown and missing
    fields.

    ``readers`` holds a conversion function for each allowed field.
    """
    if not isinstance(value.data, dict):
        diagnostics.append(
            _problem(value, f"must be a mapping with {', '.join(readers)}, not {kind(value)}")
        )
        return {}
    fields = {}
    for name, item in value.data.items():
        if name in readers:
            fields[name] = readers[name](item, diagnostics)
        else:
            diagnostics.append(_problem(item, f"unknown; {nearest(name, readers)}", item.key))
    diagnostics += [
        _problem(value, f"needs {name}", value.key) for name in required if name not in value.data
    ]
    return fields


def _kind(value: Value, diagnostics: list[Diagnostic]) -> str:
    """Return the kind of a group of devices; report an unknown kind."""
    if value.data not in _KINDS:
        diagnostics.append(
            _problem(value, f"unknown kind of device; {nearest(str(value.data), _KINDS)}")
        )
    return str(value.data)


def _count(value: Value, diagnostics: list[Diagnostic]) -> int:
    """Return the number of devices of a group; report an invalid number."""
    if (
        isinstance(value.data, bool)
        or not isinstance(value.data, int)
        or not 1 <= value.data <= _MOST_DEVICES
    ):
        diagnostics.append(
            _problem(value, f"must be a whole number of devices from 1 to {_MOST_DEVICES}")
        )
        return 1
    return value.data


def _names(value: Value, diagnostics: list[Diagnostic]) -> list[str]:
    """Return the names of the machines of a group of devices as a list; report invalid names."""
    names = value.data if isinstance(value.data, list) else [value]
    for name in names:
        if not isinstance(name.data, str) or not re.fullmatch(r"[\w.-]+", name.data):
            diagnostics.append(
                _problem(name, "must be the name of a machine, or a list of such names")
            )
    machine_names = [str(name.data) for name in names]
    if len(set(machine_names)) < len(machine_names) or not machine_names:
        diagnostics.append(_problem(value, "must name at least one machine, and no machine twice"))
    return machine_names


def _speed(value: Value, diagnostics: list[Diagnostic]) -> dict[str, float]:
    """Return the relative speed of a group of devices by family of nodes, or a single one for all
    families.
    """
    if not isinstance(value.data, dict):
        return {"default": _factor(value, diagnostics)}
    spec = find_spec("neusee.nodes")  # lists the families of nodes without importing a node
    packages = pkgutil.iter_modules(spec.submodule_search_locations if spec else [])
    families = ["default", *(package.name for package in packages if package.ispkg)]
    return _fields(value, dict.fromkeys(families, _factor), ("default",), diagnostics)


def _factor(value: Value, diagnostics: list[Diagnostic]) -> float:
    """Return a speed relative to the measured one; report a value that is not a positive number."""
    is_number = isinstance(value.data, int | float) and not isinstance(value.data, bool)
    if not is_number or not 0 < value.data < math.inf:
        diagnostics.append(
            _problem(value, "must be a number above 0: the ratio to the measured speed")
        )
        return 1.0
    return float(value.data)


def _quantity(
    value: Value, diagnostics: list[Diagnostic], units: Mapping[str, float], such: str
) -> float:
    """Convert a quantity such as ``80 GB`` to SI units; report a wrong unit or a value out of
    range.
    """
    match = _QUANTITY.fullmatch(str(value.data).strip())
    if isinstance(value.data, bool) or match is None:
        diagnostics.append(_problem(value, f"must be a number and a unit, such as {such}"))
    elif match[2] not in units:
        mistake = f"has the wrong unit {match[2]!r}" if match[2] else "needs a unit"
        diagnostics.append(
            _problem(value, f"{mistake}: write a number and one of {', '.join(units)}")
        )
    # a latency may be 0
    elif units is not _SECONDS and not 0 < float(match[1]) < math.inf:
        diagnostics.append(_problem(value, f"must be above 0, such as {such}"))
    else:
        return float(match[1]) * units[match[2]]
    return 1.0


_size = partial(_quantity, units=UNITS, such="80 GB")
_rate = partial(_quantity, units=_RATES, such="25 GB/s")
_time = partial(_quantity, units=_SECONDS, such="10 us")


def _absent(links: Value | None, kinds: set[str]) -> list[Diagnostic]:
    """Return a diagnostic for each kind of device, such as ``cuda``, that has a link but is not
    in the cluster.
    """
    diagnostics = []
    for pair, link in links.items.items() if links else ():
        for name in dict.fromkeys(pair.split("-")):
            if name not in kinds:
                message = f"there is no device of kind {name}; {nearest(name, kinds)}"
                diagnostics.append(_problem(link, message, link.key))
    return diagnostics


def _problem(value: Value, message: str, mark: Location | None = None) -> Diagnostic:
    """Return the diagnostic for a value, with its location in the file."""
    return Diagnostic(mark or value.mark, value.name, message)
