"""The physics: one plain, differentiable function for each step of the camera.

No node depends on a recipe, a cache, a device or a graph.
"""

from neusee.nodes._node import Check, ErrorBound, Node, ParameterError, TensorStats, node

__all__ = ["Check", "ErrorBound", "Node", "ParameterError", "TensorStats", "node"]
