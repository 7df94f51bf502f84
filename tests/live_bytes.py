"""How many bytes of tensors live at once."""

import weakref

import torch
from torch.utils._python_dispatch import TorchDispatchMode
from torch.utils._pytree import tree_leaves


class LiveBytes(TorchDispatchMode):
    """Counts, while it is entered, the storage of each tensor that an operation gives, until nobody
    holds it.

    What an operation takes for itself and gives back, such as a plan of a transform, is not seen;
    what was there before counts from when it is first looked at. ``peak`` is the most at once.
    """

    def __init__(self):
        super().__init__()
        self.now = self.peak = 0
        self._known = {}

    def __torch_dispatch__(self, func, types, args=(), kwargs=None):
        result = func(*args, **(kwargs or {}))
        for x in tree_leaves(result):
            if isinstance(x, torch.Tensor) and x.device.type != "meta":
                self._see(x.untyped_storage())
        return result

    def again(self):
        """Forget the peak so far."""
        self.peak = self.now

    def _see(self, storage):
        key = storage._cdata
        if key not in self._known:
            self._known[key] = storage.nbytes()
            weakref.finalize(storage, self._gone, key)
            self.now += storage.nbytes()
            self.peak = max(self.peak, self.now)

    def _gone(self, key):
        self.now -= self._known.pop(key)
