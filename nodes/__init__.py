"""Physical models of the camera: one differentiable function for each step.

No node depends on a recipe, a cache, a device or a graph.
"""

from neusee.nodes import import_times as import_times
from neusee.nodes._node import (
    Check,
    ErrorBound,
    Node,
    ParameterError,
    TensorStats,
    node,
    registered_nodes,
)

__all__ = [
    "Check",
    "ErrorBound",
    "Node",
    "ParameterError",
    "TensorStats",
    "node",
    "registered_nodes",
]
