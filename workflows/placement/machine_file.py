"""Machine files: devices with speed and memory, and the links between them, in YAML.

    devices:
      host: {kind: cpu, memory: 2 TB, speed: 10}
      a100: {kind: cuda, count: 8, memory: 80 GB, speed: {default: 50, sensor: 30}}
    links:
      cuda-cuda: {bandwidth: 300 GB/s, latency: 5 us}
    network: {bandwidth: 25 GB/s, latency: 5 us}

``speed`` is the ratio to the machine on which the costs were measured, for all nodes or by family of
nodes. ``node: [a, b]`` puts a group of devices on each machine of these names; the network links the
machines.
"""

from __future__ import annotations

import math
import pkgutil
import re
from collections import Counter
from collections.abc import Callable, Mapping
from dataclasses import dataclass, field
from importlib.resources import files
from importlib.util import find_spec
from pathlib import Path
from typing import Any

from neusee.workflows.graph.diagnostics import Diagnostic, Location, RecipeError, nearest
from neusee.workflows.placement.tasks_and_devices import BUS, Cluster, Device, Link
from neusee.workflows.recipe.text.yaml_values import Value, kind, read

_KINDS = ("cpu", "cuda", "mps")
_BYTES = {"B": 1.0, "kB": 1e3, "MB": 1e6, "GB": 1e9, "TB": 1e12, "MiB": 2.0**20, "GiB": 2.0**30, "TiB": 2.0**40}
_SECONDS = {"s": 1.0, "ms": 1e-3, "us": 1e-6, "µs": 1e-6, "μs": 1e-6, "ns": 1e-9}
_RATES = {f"{unit}/s": scale for unit, scale in _BYTES.items() if unit in ("MB", "GB", "TB")}
_QUANTITY = re.compile(r"((?:\d+\.?\d*|\.\d+)(?:[eE][-+]?\d+)?)\s*(.*)")
_MOST = 4096  #: limit on the devices of one file
_Reader = Callable[[Value, "list[Diagnostic]"], Any]


@dataclass(frozen=True)
class Machines:
    """A cluster, and the speed of each device relative to the measured machine, by family of nodes."""

    title: str
    cluster: Cluster
    speeds: Mapping[str, Mapping[str, float]] = field(repr=False)  #: by device, by family, with a ``default``

    @property
    def devices(self) -> tuple[Device, ...]:
        return self.cluster.devices

    def speed(self, device: str, node: str) -> float:
        """Return the relative speed at which ``device`` runs the node of a path such as ``optics.psf``."""
        speeds = self.speeds[device]
        return speeds.get(node.partition(".")[0], speeds["default"])


def read_machines(path: Path | str) -> Machines:
    """Return the machines of a file, or of an example by its name; raise one `RecipeError` with all mistakes."""
    document = read(_found(path), str(path))
    diagnostics: list[Diagnostic] = []
    root = _fields(document.root, {"devices": _groups, "links": _links, "network": _link}, ("devices",), diagnostics)
    groups, links = root.get("devices") or [], root.get("links") or {}
    if not diagnostics:
        diagnostics += _absent(document.root.items.get("links"), {group["kind"] for group in groups})
    if diagnostics:
        raise RecipeError(diagnostics)
    devices = _devices(groups)
    if len(devices) > _MOST:
        raise RecipeError([_problem(document.root.items["devices"], f"are {len(devices)}; the maximum is {_MOST}")])
    speeds = {device.name: group["speed"] for device, group in devices.items()}
    network = root.get("network") or Cluster.network
    return Machines(document.title, Cluster(tuple(devices), links, BUS, network), speeds)


def examples() -> dict[str, Path]:
    """Return the examples that come with the program, by name."""
    folder = Path(str(files("neusee.recipes"))) / "samples" / "clusters"
    return {path.stem: path for path in sorted(folder.glob("*.yaml"))}


def _found(path: Path | str) -> Path:
    packaged = examples()
    if str(path) in packaged and not Path(path).is_file():
        return packaged[str(path)]
    if not Path(path).is_file():
        message = f"no such file, and no example of that name; {nearest(str(path), packaged)}"
        raise RecipeError([Diagnostic(Location("--devices"), str(path), message)])
    return Path(path)


def _devices(groups: list[dict[str, Any]]) -> dict[Device, dict[str, Any]]:
    """Return every single device with its group: ``cpu``, ``cuda:0``, or ``a/cuda:0`` on a machine with a name."""
    rows = [(machine, group) for group in groups for machine in group["node"] for _ in range(group["count"])]
    total, seen = Counter((machine, group["kind"]) for machine, group in rows), Counter[tuple[str, str]]()
    found = {}
    for machine, group in rows:
        of = (machine, group["kind"])
        name = group["kind"] if of[1] == "cpu" and total[of] == 1 else f"{of[1]}:{seen[of]}"
        seen[of] += 1
        found[Device(f"{machine}/{name}" if machine else name, of[1], group["memory"])] = group
    return found


# --- values ---------------------------------------------------------------------------------------------------------


def _groups(value: Value, diagnostics: list[Diagnostic]) -> list[dict[str, Any]]:
    if not isinstance(value.data, dict) or not value.data:
        diagnostics.append(_problem(value, "must be a mapping of groups, such as `a100: {kind: cuda, memory: 80 GB}`"))
        return []
    readers = {"kind": _kind, "count": _count, "memory": _size, "speed": _speed, "node": _names}
    usual: dict[str, Any] = {"count": 1, "speed": {"default": 1.0}, "node": [""]}
    return [usual | _fields(group, readers, ("kind", "memory"), diagnostics) for group in value.data.values()]


def _links(value: Value, diagnostics: list[Diagnostic]) -> dict[tuple[str, str], Link]:
    if not isinstance(value.data, dict):
        diagnostics.append(_problem(value, "must be a mapping such as `cuda-cuda: {bandwidth: 300 GB/s}`"))
        return {}
    found = {}
    for name, link in value.data.items():
        one, dash, other = str(name).partition("-")
        if not dash:
            diagnostics.append(_problem(link, "must name two kinds, such as cuda-cuda or cpu-cuda", link.key))
        if (other, one) in found:
            diagnostics.append(_problem(link, f"is the same as {other}-{one}", link.key))
        found[one, other or one] = _link(link, diagnostics)
    return found


def _link(value: Value, diagnostics: list[Diagnostic]) -> Link:
    return Link(**_fields(value, {"bandwidth": _rate, "latency": _time}, ("bandwidth",), diagnostics))


def _fields(
    value: Value, readers: Mapping[str, _Reader], required: tuple[str, ...], diagnostics: list[Diagnostic]
) -> dict[str, Any]:
    """Return the fields of a mapping, each read by its reader; report unknown and missing fields."""
    if not isinstance(value.data, dict):
        diagnostics.append(_problem(value, f"must be a mapping of {', '.join(readers)}, not {kind(value)}"))
        return {}
    found = {}
    for name, item in value.data.items():
        if name in readers:
            found[name] = readers[name](item, diagnostics)
        else:
            diagnostics.append(_problem(item, f"unknown; {nearest(name, readers)}", item.key))
    missing = [name for name in required if name not in value.data]
    diagnostics += [_problem(value, f"needs {name}", value.key) for name in missing]
    return found


def _kind(value: Value, diagnostics: list[Diagnostic]) -> str:
    if value.data not in _KINDS:
        diagnostics.append(_problem(value, f"unknown kind of device; {nearest(str(value.data), _KINDS)}"))
    return str(value.data)


def _count(value: Value, diagnostics: list[Diagnostic]) -> int:
    if isinstance(value.data, bool) or not isinstance(value.data, int) or not 1 <= value.data <= _MOST:
        diagnostics.append(_problem(value, f"must be a whole number from 1 to {_MOST}"))
        return 1
    return value.data


def _names(value: Value, diagnostics: list[Diagnostic]) -> list[str]:
    names = value.data if isinstance(value.data, list) else [value]
    for name in names:
        if not isinstance(name.data, str) or not re.fullmatch(r"[\w.-]+", name.data):
            diagnostics.append(_problem(name, "must be the name of a machine, or a list of such names"))
    plain = [str(name.data) for name in names]
    if len(set(plain)) < len(plain) or not plain:
        diagnostics.append(_problem(value, "must name one machine or more, each once"))
    return plain


def _speed(value: Value, diagnostics: list[Diagnostic]) -> dict[str, float]:
    if not isinstance(value.data, dict):
        return {"default": _factor(value, diagnostics)}
    families = ["default", *_families()]
    return _fields(value, dict.fromkeys(families, _factor), ("default",), diagnostics)


def _factor(value: Value, diagnostics: list[Diagnostic]) -> float:
    good = isinstance(value.data, int | float) and not isinstance(value.data, bool)
    if not good or not 0 < value.data < math.inf:
        diagnostics.append(_problem(value, "must be a number above 0: the speed relative to the measured machine"))
        return 1.0
    return float(value.data)


def _size(value: Value, diagnostics: list[Diagnostic]) -> float:
    return _quantity(value, _BYTES, "80 GB", diagnostics)


def _rate(value: Value, diagnostics: list[Diagnostic]) -> float:
    return _quantity(value, _RATES, "25 GB/s", diagnostics)


def _time(value: Value, diagnostics: list[Diagnostic]) -> float:
    return _quantity(value, _SECONDS, "10 us", diagnostics)


def _quantity(value: Value, units: Mapping[str, float], such: str, diagnostics: list[Diagnostic]) -> float:
    """Return a number times its unit in SI; report a missing unit, and a zero except for a time."""
    match = _QUANTITY.fullmatch(str(value.data).strip())
    if isinstance(value.data, bool) or match is None:
        diagnostics.append(_problem(value, f"must be a number and a unit, such as {such}"))
    elif match[2] not in units:
        said = f"has the wrong unit {match[2]!r}" if match[2] else "needs a unit"
        diagnostics.append(_problem(value, f"{said}: write a number and one of {', '.join(units)}"))
    elif units is not _SECONDS and not 0 < float(match[1]) < math.inf:
        diagnostics.append(_problem(value, f"must be above 0, such as {such}"))
    else:
        return float(match[1]) * units[match[2]]
    return 1.0


def _families() -> list[str]:
    """Return the families of nodes, without importing a node."""
    spec = find_spec("neusee.nodes")
    return [m.name for m in pkgutil.iter_modules(spec.submodule_search_locations if spec else []) if m.ispkg]


def _absent(links: Value | None, kinds: set[str]) -> list[Diagnostic]:
    """Return a diagnostic for each kind in ``links`` of which no device exists."""
    items = links.items.items() if links else ()
    pairs = [(item, name) for pair, item in items for name in dict.fromkeys(pair.split("-"))]
    said = "there is no device of kind"
    return [_problem(i, f"{said} {name}; {nearest(name, kinds)}", i.key) for i, name in pairs if name not in kinds]


def _problem(value: Value, message: str, mark: Location | None = None) -> Diagnostic:
    return Diagnostic(mark or value.mark, value.name, message)
