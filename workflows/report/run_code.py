"""The file ``code.json`` in the folder of a run: digests of the code of each node, and of all that the code uses."""

from __future__ import annotations

import json
from typing import TYPE_CHECKING

if TYPE_CHECKING:
    from neusee.workflows.engine.runner import Result

CODE = "code.json"


def code_text(result: Result) -> str:
    """Return the digests of code of a run as JSON text with one line for each node and each module.

    ``nodes`` has the digest of each node with all that it uses; ``parts`` has, for each module, the digest of every
    function, class and constant, and for each package its version.
    """
    origins = [result.origins[key] for key in result.keys.values() if key in result.origins]
    nodes = {origin["node"]: origin["code"] for origin in origins}
    parts = {name: part for code in dict.fromkeys(nodes.values()) for name, part in result.code.get(code, {}).items()}
    return f'{{"nodes": {_lines(nodes)},\n"parts": {_lines(parts)}}}\n'


def _lines(values: object) -> str:
    assert isinstance(values, dict)
    return "{\n" + ",\n".join(f"{json.dumps(k)}: {json.dumps(v)}" for k, v in sorted(values.items())) + "\n}"
