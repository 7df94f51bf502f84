"""The physics: one plain, differentiable function for each step of the camera.

Nothing here knows of recipes, caches, devices or graphs.
"""

from neusee.nodes._node import Check, ErrorBound, Node, ParameterError, TensorStats, node

__all__ = ["Check", "ErrorBound", "Node", "ParameterError", "TensorStats", "node"]
