"""Why a step ran: what differs from the nearest earlier result of the same step."""

from __future__ import annotations

from collections import defaultdict
from collections.abc import Callable, Mapping
from dataclasses import replace
from typing import Any

from neusee.workflows._graph import Recipe, Step
from neusee.workflows._run import Event
from neusee.workflows._store import Store

Origin = Mapping[str, Any]  #: what went into a key: node, code, params, inputs, stream


class History:
    """The results that were there before this run, read when the first step starts."""

    def __init__(self, store: Store) -> None:
        self.store = store
        self._origins: dict[str, list[Origin]] | None = None

    def read(self) -> dict[str, list[Origin]]:
        """Origins of the stored results by step."""
        if self._origins is None:
            self._origins = defaultdict(list)
            for _, about in self.store.entries():
                if about.get("origin"):
                    self._origins[about["step"]].append(about["origin"])
        return self._origins

    def why(self, step: Step, key: str) -> str:
        """One line; empty where this step has no earlier result."""
        origin = (self.store.about(key) or {}).get("origin")
        earlier = [o for o in self.read().get(step.name, ()) if o != origin]
        if not origin or not earlier:
            return ""
        return min((differences(step, o, origin) for o in reversed(earlier)), key=lambda found: (len(found), found))[0]


def differences(step: Step, old: Origin, new: Origin) -> list[str]:
    """What differs between two origins of a step, the first cause first."""
    found = []
    if old["node"] != new["node"]:
        found.append(f"{old['node']} → {new['node']}")
    params = (old["params"], new["params"])
    for name in dict.fromkeys([*params[0], *params[1]]):
        before, after = (p.get(name) for p in params)
        if before != after:
            found.append(f"{name} {_said(before)} → {_said(after)}")
    if old["code"] != new["code"] and old["node"] == new["node"]:
        found.append(f"the code of {new['node']} changed")
    if old.get("stream") != new.get("stream"):
        found.append("the random stream changed")
    return [*found, *_inputs(step, old, new)] or ["nothing changed"]


def _inputs(step: Step, old: Origin, new: Origin) -> list[str]:
    """Sources that are not what they were."""
    if len(old["inputs"]) != len(new["inputs"]):
        return ["other inputs"]
    names = []
    for name, before, after in zip(step.node.inputs, old["inputs"], new["inputs"], strict=True):
        wire = step.wires.get(name)
        if before != after:
            names.append(wire if isinstance(wire, str) else name)
    return [f"after {name}" for name in names]


def _said(value: Any) -> str:
    if isinstance(value, float):
        return f"{value:.6g}"
    if isinstance(value, dict):
        return "a file" if "file" in value else "other values"
    return "none" if value is None else str(value)


def explained(recipe: Recipe, store: Store, watch: Callable[[Event], None]) -> Callable[[Event], None]:
    """``watch``, told also why each step that ran did so."""
    history = History(store)

    def tell(event: Event) -> None:
        done = event.done
        if done is None:
            history.read()
        elif done.state == "run":
            event = Event(event.step, replace(done, why=history.why(recipe.steps[done.step], done.key)))
        watch(event)

    return tell
