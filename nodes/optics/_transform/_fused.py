"""The PSF of a pupil and its gradient in C++: phase, interpolation and FFT in one pass over the data.

`_intensity` computes the same in torch where there is no compiler, from parts that each pass over all samples.
"""

import ctypes
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import torch
from torch import Tensor

from neusee.nodes import _cpp_library
from neusee.nodes.optics._transform._fused_plan import CAxis, fused_axis, pointer
from neusee.nodes.optics._transform._kaiser_bessel_transform import last_work
from neusee.nodes.optics._transform._pupil_field import Screens, View
from neusee.nodes.optics._transform._sample_axis import Axis, centred, last_type
from neusee.nodes.optics._transform._workspace import Workspace

#: what the code reads: the C++ sources decide a result; no result depends on the number of threads
__depends__ = ("_fused.cpp", "_field.h", "_fft.h", "unaffected:ctypes", "unaffected:torch.get_num_threads")
SOURCES = tuple(Path(__file__).with_name(name) for name in ("_fused.cpp", "_field.h", "_fft.h"))
#: digest of the sources: keys of cached results depend on this file, and so on the sources; a test compares both
DIGEST = "885df4bca23da036"
_NAMES = {
    (torch.float32, torch.float32): "single",
    (torch.float32, torch.float64): "mixed",
    (torch.float64, torch.float64): "double",
}
_LITTLE = 0.3  #: share of the work of the first axis, up to which all from the first FFT on is float64
_ALONE = 1 << 18  #: samples for each further thread: to wake a thread takes as long as to transform a few thousand


class _Pupil(ctypes.Structure):
    """The structure ``Pupil`` of ``_field.h``."""

    _fields_ = (
        ("wide", ctypes.c_int64),
        *((name, ctypes.c_void_p) for name in ("amplitude", "height", "path")),
        *((name, ctypes.c_double) for name in ("turns_height", "turns_path")),
        *((name, ctypes.c_void_p) for name in ("tilt_v", "tilt_u")),
    )


class _Focal(ctypes.Structure):
    """The structure ``Focal`` of ``_field.h``."""

    _fields_ = (
        ("weight", ctypes.c_double),
        *((name, ctypes.c_void_p) for name in ("envelope_y", "envelope_x", "intensity", "field")),
        ("add", ctypes.c_int64),
    )


class _Gradients(ctypes.Structure):
    """The structure ``Gradients`` of ``_field.h``."""

    _fields_ = tuple((name, ctypes.c_void_p) for name in ("amplitude", "height", "path"))


def operators() -> ctypes.CDLL:
    """Return the library of the C++, compiled if needed; raise `NoCompilerError` if it cannot be compiled."""
    return _cpp_library.load(*SOURCES, rounding=_cpp_library.UNFUSED)


def available(device: torch.device) -> bool:
    """Return True if the C++ can compute on this device; on a CPU without a compiler warn once and return False."""
    return device.type == "cpu" and _cpp_library.compiled("PSF", *SOURCES, rounding=_cpp_library.UNFUSED)


class FusedPupil:
    """The factors of the pupil as the C++ reads them, and the transforms of their field to and from a focal plane."""

    def __init__(self, screens: Screens, dtype: torch.dtype, work: Workspace) -> None:
        wide = dtype == torch.float64 or any(x.dtype == torch.float64 for x in screens[:3])
        self.kind = torch.float64 if wide else torch.float32
        factors = [x.detach().to(self.kind).contiguous() for x in screens[:3]]
        self.amplitude, self.height = factors[:2]
        self.path = factors[2] if screens.longest > 0 else None
        self.dtype, self.work = dtype, work

    def forward(self, view: View, intensity: Tensor | None, add: bool, field: Tensor | None) -> None:
        """Write or add the weighted intensity of one view, and write its focal field, planes (re, im) of (y, x)."""
        pupil, focal = self._pupil(view), _focal(view, intensity, field, add)
        self._call("forward", view.rows, view.columns, pupil.structure, focal.structure)

    def add_gradients(
        self, views: Sequence[View], weight: Tensor, fields: Sequence[Tensor | None], grads: Sequence[Tensor | None]
    ) -> None:
        """Add the gradients of ``sum(weight * intensity)`` to those of amplitude, height and path.

        A focal field that was not stored is computed again.
        """
        sums = [None if grad is None else torch.zeros_like(self.height) for grad in grads]
        gain, band = weight, -1
        for view, kept in zip(views, fields, strict=True):
            if view.band != band:
                gain, band = weight[view.band].contiguous(), view.band
            field = self.work.take("focal", 2, *gain.shape) if kept is None else kept
            if kept is None:
                self.forward(view, None, False, field)
            self._adjoint(view, field, gain, sums)
        for grad, added in zip(grads, sums, strict=True):
            if grad is not None and added is not None:
                grad.copy_(added)

    def _adjoint(self, view: View, field: Tensor, gain: Tensor, sums: Sequence[Tensor | None]) -> None:
        """Add the gradients of one view, by the adjoint transform of ``2 gain U``."""
        pupil, focal = self._pupil(view), _focal(view, None, field, False)
        axes = view.rows.adjoint(), view.columns.adjoint()
        added = _Gradients(*(pointer(x) for x in sums))
        self._call("adjoint", *axes, focal.structure, pointer(gain), pupil.structure, added)

    def _pupil(self, view: View) -> "_Held":
        v, u = (centred(n, torch.device("cpu")).mul_(t) for n, t in zip(self.height.shape, view.tilt, strict=True))
        arrays = [pointer(x) for x in (self.amplitude, self.height, self.path)]
        turns = view.turns_height, view.turns_path
        return _Held(_Pupil(self.kind == torch.float64, *arrays, *turns, pointer(v), pointer(u)), (v, u))

    def _call(self, name: str, rows: Axis, columns: Axis, *given: Any) -> None:
        kind = last_type(*last_work(rows, columns), self.dtype, _LITTLE)
        y, x = fused_axis(rows, self.dtype, self.dtype, kind), fused_axis(columns, self.dtype, kind, kind)
        operator = getattr(operators(), f"neusee_psf_{name}_{_NAMES[self.dtype, kind]}")
        tiles = [self._tiles(label, y, n, kind) for label, n in (("before", x.n_in), ("behind", x.n_out))]
        structures = [ctypes.byref(s) if isinstance(s, ctypes.Structure) else s for s in (y, x, *given)]
        samples = rows.n_in * columns.n_in + rows.n_out * columns.n_out
        threads = min(torch.get_num_threads(), 1 + samples // _ALONE)
        operator(*structures[:2], ctypes.c_int64(threads), *tiles, *structures[2:])

    def _tiles(self, label: str, y: CAxis, n: int, kind: torch.dtype) -> Any:
        """Return the address of memory for all frequencies along y of ``n`` columns, aligned to vectors."""
        vector = operators().neusee_psf_vector_bytes()
        lanes, wide = vector // kind.itemsize, vector // self.dtype.itemsize
        size = 2 * _up(y.kept, lanes) * _up(n, wide)
        flat = self.work.take(label, size + lanes, dtype=kind)
        return ctypes.c_void_p(_up(flat.data_ptr(), vector))


class _Held:
    """A structure for the C++, with the tensors that it points to."""

    def __init__(self, structure: ctypes.Structure, arrays: Sequence[Tensor | None]) -> None:
        self.structure, self.arrays = structure, arrays


def _focal(view: View, intensity: Tensor | None, field: Tensor | None, add: bool) -> _Held:
    arrays = (*(view.envelope or (None, None)), intensity, field)
    return _Held(_Focal(view.weight, *(pointer(x) for x in arrays), add), arrays)


def _up(n: int, step: int) -> int:
    return -(-n // step) * step
