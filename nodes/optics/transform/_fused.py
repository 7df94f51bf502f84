"""The PSF of a pupil and its gradient in C++, and the grids in the layout of the C++ code."""

import ctypes
import functools
import math
from collections.abc import Callable, Sequence
from pathlib import Path
from typing import Any, NamedTuple

import torch
from torch import Tensor

from neusee.nodes import cpp_library
from neusee.nodes.optics.transform._fft_transforms import (
    DOUBLE,
    SINGLE,
    Kernel,
    alternating_sign,
    fft_length,
    next_odd,
    work_by_axis,
)
from neusee.nodes.optics.transform._pupil_field import Screens, View
from neusee.nodes.optics.transform._sample_axis import (
    Axis,
    Workspace,
    centred,
    last_type,
    unit_phasor,
)

# --- fused plan -----------------------------------------------------------------------------------

# The grids and weights of one axis of the fused transform, in the layout of the C++ code.
#
# As in `_fft_transforms`, but each row has its own band of weights, in place of dense blocks for
# several rows: the C++ code needs a third of the multiplications.


#: smallest number of grid intervals across the input, even if the window needs fewer
_LEAST_PARTS = 8
_SHORTEST_FFT = 32  #: length of the shortest FFT
_PASS_FACTORS = (8, 5, 3, 4, 2)  #: factors of the FFT length for the passes, in order of preference


class CAxis(ctypes.Structure):
    """The structure ``Axis`` of ``_fft.h``; ``held`` has references to the arrays that it points
    to.
    """

    _fields_ = (
        *(
            (name, ctypes.c_int64)
            for name in ("n_in", "n_out", "points", "length", "padded", "cropped", "kept")
        ),
        *((name, ctypes.c_int64) for name in ("gather_width", "spread_width", "passes")),
        *(
            (name, ctypes.c_void_p)
            for name in ("factors", "gather_first", "spread_first", "gather", "spread", "turns")
        ),
    )
    held: tuple[Tensor, ...]


@functools.lru_cache(maxsize=64)
def fused_axis(axis: Axis, dtype: torch.dtype, gathered: torch.dtype, kind: torch.dtype) -> CAxis:
    """Return the plan of one axis with the accuracy of ``dtype``; it is cached.

    The weights before the FFT have the type ``gathered``, all other numbers the type ``kind``.
    """
    kernel = SINGLE if dtype == torch.float32 else DOUBLE
    point_pitch, point_count, length, frequencies_per_output, frequency_count = _axis_grids(
        axis, kernel
    )
    middle_sample, middle_output, middle_point, middle_frequency = (
        (axis.n_in - 1) / 2,
        (axis.n_out - 1) / 2,
        (point_count - 1) // 2,
        (frequency_count - 1) // 2,
    )

    def gather(row: Tensor, column: Tensor) -> Tensor:
        distance_from_middle = row - middle_point
        scale = alternating_sign(distance_from_middle + length // 2) * (
            kernel.peak / kernel.transform(distance_from_middle / length)
        )
        return (
            kernel((column - middle_sample) / point_pitch - distance_from_middle)
            / kernel.peak
            * scale
        )

    def spread(row: Tensor, column: Tensor) -> Tensor:
        distance_from_middle, frequency_from_middle = row - middle_output, column - middle_frequency
        return (
            alternating_sign(frequency_from_middle)
            * kernel(frequencies_per_output * distance_from_middle - frequency_from_middle)
            / kernel.transform(axis.alpha * point_pitch * distance_from_middle)
        )

    gather_first, gather_weights = _band_of_rows(
        point_count,
        axis.n_in,
        middle_sample - point_pitch * middle_point,
        point_pitch,
        point_pitch * kernel.width / 2,
        gather,
    )
    spread_first, spread_weights = _band_of_rows(
        axis.n_out,
        frequency_count,
        middle_frequency - frequencies_per_output * middle_output,
        frequencies_per_output,
        kernel.width / 2,
        spread,
    )
    turns = torch.view_as_real(
        unit_phasor(torch.arange(length, dtype=torch.float64) / -length, kind)
    )
    arrays = (torch.tensor(_factors(length)), gather_first, spread_first)
    held = (*arrays, gather_weights.to(gathered), spread_weights.to(kind), turns.contiguous())
    # in the order of the fields of `CAxis`
    sizes = (
        axis.n_in,
        axis.n_out,
        point_count,
        length,
        length // 2 - middle_point,
        length // 2 - middle_frequency,
        frequency_count,
    )
    widths = (gather_weights.shape[1], spread_weights.shape[1], len(held[0]))
    plan = CAxis(*sizes, *widths, *(x.data_ptr() for x in held))
    plan.held = held
    return plan


def expected_seconds(rows: Axis, columns: Axis) -> float:
    """Return the expected time in seconds of one PSF in single precision on one thread.

    It agrees with measurements for 128 to 2160 samples and 96 to 2048 pixels a side within 20 %.
    The terms are for the pupil samples and their phase, for the FFTs along both axes, and for the
    interpolation after the FFTs.
    """
    transforms = columns.n_in * _fft_steps(rows) + rows.n_out * _fft_steps(columns)
    last_products = rows.n_out * (columns.n_in + columns.n_out)
    # measured seconds per sample: phase and first interpolation, FFTs, last interpolation
    return (
        0.11e-3
        + 2.3e-9 * rows.n_in * columns.n_in
        + 0.108e-9 * transforms
        + 0.41e-9 * last_products
    )


def _fft_steps(axis: Axis) -> float:
    """Return the number of operations of one FFT along an axis, up to a constant factor."""
    length = _axis_grids(axis, SINGLE)[2]
    return length * math.log2(length)


def _axis_grids(axis: Axis, kernel: Kernel) -> tuple[float, int, int, float, int]:
    """Return pitch and number of the points before the FFT, the length of the FFT, its number of
    frequencies per output sample, and the number of frequencies that are kept.
    """
    pitch = min(
        1 / (axis.alpha * axis.n_out * kernel.oversampling),
        max(axis.n_in, _LEAST_PARTS) / _LEAST_PARTS,
    )
    points = next_odd(math.ceil((axis.n_in - 1) / pitch) + kernel.width)
    return pitch, points, *_length(axis, kernel, pitch, math.ceil(points * kernel.oversampling))


def _length(axis: Axis, kernel: Kernel, pitch: float, shortest: int) -> tuple[int, float, int]:
    """Return the FFT length, its number of frequencies per output sample, and the number of
    frequencies that are kept.
    """
    length = fft_length(max(shortest, _SHORTEST_FFT), even=True)
    while True:
        frequencies_per_output = axis.alpha * pitch * length
        frequency_count = next_odd(
            math.ceil((axis.n_out - 1) * frequencies_per_output) + kernel.width
        )
        if frequency_count <= length:
            return length, frequencies_per_output, frequency_count
        length = fft_length(length + length // 4, even=True)


def _band_of_rows(
    n_rows: int,
    n_columns: int,
    origin: float,
    step: float,
    reach: float,
    weigh: Callable[[Tensor, Tensor], Tensor],
) -> tuple[Tensor, Tensor]:
    """Return the first column and the weights of each row; the band of a row are the columns within
    ``reach`` of ``origin + step row``.
    """
    width = min(math.floor(2 * reach) + 1, n_columns)
    rows = torch.arange(n_rows, dtype=torch.float64)[:, None]
    middle = origin + step * rows
    first = (middle - reach).ceil_().clamp_(0, n_columns - width)
    columns = first + torch.arange(width)
    weights = torch.where((columns - middle).abs() <= reach, weigh(rows, columns), 0.0)
    return first.int().flatten(), weights


def _factors(length: int) -> list[int]:
    """Return the factors of an FFT length, in the order of the passes."""
    factors = []
    for factor in _PASS_FACTORS:
        while length % factor == 0:
            factors.append(factor)
            length //= factor
    return factors


def address_of(x: Tensor | None) -> Any:
    """Return the address of the first number of a contiguous tensor, or a null pointer."""
    return ctypes.c_void_p(None if x is None else x.data_ptr())


# --- fused ----------------------------------------------------------------------------------------

# The PSF of a pupil and its gradient in C++: phase, interpolation and FFT in one pass over the
# data.
#
# Without a compiler, `_intensity` computes the same in torch, with a pass over all samples for each
# part.


#: a result depends on the C++ sources, and not on the number of threads
__depends__ = (
    "_fused.cpp",
    "_field.h",
    "_fft.h",
    "unaffected:ctypes",
    "unaffected:torch.get_num_threads",
)
SOURCES = tuple(Path(__file__).with_name(name) for name in ("_fused.cpp", "_field.h", "_fft.h"))
#: digest of the C++ sources. The keys of cached results depend on this file, and through the digest
#: on the C++ sources; a test compares both
DIGEST = "885df4bca23da036"
_NAMES = {
    (torch.float32, torch.float32): "single",
    (torch.float32, torch.float64): "mixed",
    (torch.float64, torch.float64): "double",
}
#: if the last axis takes less than this share of the time of the first, all steps from the first
#: FFT on are float64
_FLOAT64_WORK_SHARE = 0.3
#: samples per further thread: starting a thread takes as long as the transform of a few thousand
_SAMPLES_PER_THREAD = 1 << 18


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
    """Return the C++ library, compiled if needed; raise `NoCompilerError` if it cannot be
    compiled.
    """
    return cpp_library.load(*SOURCES, rounding=cpp_library.UNFUSED)


def available(device: torch.device) -> bool:
    """Return True if the C++ code can run on this device; on a CPU without a compiler, warn once
    and return False.
    """
    return device.type == "cpu" and cpp_library.compiled(
        "PSF", *SOURCES, rounding=cpp_library.UNFUSED
    )


class _Plan(NamedTuple):
    """Both axes in the layout of the C++ code, and what follows from them for each call."""

    rows: CAxis
    columns: CAxis
    samples: int  #: number of samples of the field and of its transform
    type_name: str  #: name of the types in the C++ functions
    type_between: torch.dtype  #: type of all steps from the first FFT on
    #: numbers of memory for the frequencies along y of all columns, before and behind sweep 2
    numbers_between: tuple[int, int]


@functools.lru_cache(maxsize=64)
def _plan(rows: Axis, columns: Axis, dtype: torch.dtype, vector_bytes: int) -> _Plan:
    """Return the plan of the transform along two axes for vectors of ``vector_bytes``; it is
    cached.
    """
    kind = last_type(*work_by_axis(rows, columns), dtype, _FLOAT64_WORK_SHARE)
    row_axis, column_axis = (
        fused_axis(rows, dtype, dtype, kind),
        fused_axis(columns, dtype, kind, kind),
    )
    # whole vectors along both axes, and one more, so that the start can be aligned
    numbers_per_vector, columns_per_vector = (
        vector_bytes // kind.itemsize,
        vector_bytes // dtype.itemsize,
    )
    before, behind = (
        2 * _rounded_up(row_axis.kept, numbers_per_vector) * _rounded_up(n, columns_per_vector)
        + numbers_per_vector
        for n in (columns.n_in, columns.n_out)
    )
    samples = rows.n_in * columns.n_in + rows.n_out * columns.n_out
    return _Plan(row_axis, column_axis, samples, _NAMES[dtype, kind], kind, (before, behind))


@functools.lru_cache(maxsize=64)
def _distances(samples: int) -> Tensor:
    """Return the distances of samples from their middle, in samples, float64; it is cached."""
    return centred(samples, torch.device("cpu"))


class FusedPupil:
    """The factors of the pupil in the layout of the C++ code, with the transforms of the field to
    and from a focal plane.
    """

    def __init__(self, screens: Screens, dtype: torch.dtype, work: Workspace) -> None:
        """Convert the factors of the pupil to one type; ``dtype`` is the type of the intensity."""
        double = dtype == torch.float64 or any(x.dtype == torch.float64 for x in screens[:3])
        self.kind = torch.float64 if double else torch.float32
        screens_of_kind = [x.detach().to(self.kind).contiguous() for x in screens[:3]]
        self.amplitude, self.height = screens_of_kind[:2]
        # a null pointer if the path is 0: the C++ code then skips it
        self.path = screens_of_kind[2] if screens.longest > 0 else None
        self.dtype, self.work = dtype, work
        self.operators = operators()
        self.vector_bytes = self.operators.neusee_psf_vector_bytes()

    def forward(
        self, view: View, intensity: Tensor | None, add: bool, field: Tensor | None
    ) -> None:
        """Write or add the weighted intensity of one view, and write its focal field, planes
        (re, im) of (y, x).
        """
        pupil, focal = self._pupil(view), _focal_structure(view, intensity, field, add)
        self._call("forward", view.rows, view.columns, pupil.structure, focal.structure)

    def add_gradients(
        self,
        views: Sequence[View],
        weight: Tensor,
        fields: Sequence[Tensor | None],
        grads: Sequence[Tensor | None],
    ) -> None:
        """Add the gradients of ``sum(weight * intensity)`` to those of amplitude, height and path.

        A focal field that was not stored is computed again.
        """
        sums = [None if grad is None else torch.zeros_like(self.height) for grad in grads]
        band_weight, band = weight, -1
        for view, stored_field in zip(views, fields, strict=True):
            if view.band != band:
                band_weight, band = weight[view.band].contiguous(), view.band
            field = (
                self.work.take("focal", 2, *band_weight.shape)
                if stored_field is None
                else stored_field
            )
            if stored_field is None:
                self.forward(view, None, False, field)
            self._adjoint(view, field, band_weight, sums)
        for grad, added in zip(grads, sums, strict=True):
            if grad is not None and added is not None:
                grad.copy_(added)

    def _adjoint(
        self, view: View, field: Tensor, gain: Tensor, sums: Sequence[Tensor | None]
    ) -> None:
        """Add the gradients of one view, by the adjoint transform of ``2 gain U``."""
        pupil, focal = self._pupil(view), _focal_structure(view, None, field, False)
        axes = view.rows.adjoint(), view.columns.adjoint()
        added = _Gradients(*(address_of(x) for x in sums))
        self._call("adjoint", *axes, focal.structure, address_of(gain), pupil.structure, added)

    def _pupil(self, view: View) -> "_StructureWithArrays":
        """Return the structure of the pupil in one view, with the tilts that it points to."""
        v, u = (_distances(n) * tilt for n, tilt in zip(self.height.shape, view.tilt, strict=True))
        pointers = [address_of(x) for x in (self.amplitude, self.height, self.path)]
        turns_per_metre = view.turns_height, view.turns_path
        return _StructureWithArrays(
            _Pupil(
                self.kind == torch.float64,
                *pointers,
                *turns_per_metre,
                address_of(v),
                address_of(u),
            ),
            (v, u),
        )

    def _call(self, name: str, rows: Axis, columns: Axis, *arguments: Any) -> None:
        """Call the C++ function ``name`` for the types of this pupil, with axes, threads, memory
        and arguments.
        """
        plan = _plan(rows, columns, self.dtype, self.vector_bytes)
        operator = getattr(self.operators, f"neusee_psf_{name}_{plan.type_name}")
        between = [
            self._memory(label, size, plan.type_between)
            for label, size in zip(("before", "behind"), plan.numbers_between, strict=True)
        ]
        structures = [
            ctypes.byref(s) if isinstance(s, ctypes.Structure) else s
            for s in (plan.rows, plan.columns, *arguments)
        ]
        # a single thread for few samples
        threads = min(torch.get_num_threads(), 1 + plan.samples // _SAMPLES_PER_THREAD)
        operator(*structures[:2], ctypes.c_int64(threads), *between, *structures[2:])

    def _memory(self, label: str, size: int, kind: torch.dtype) -> Any:
        """Return the address of memory for ``size`` numbers, aligned to the vector registers."""
        address = self.work.take(label, size, dtype=kind).data_ptr()
        return ctypes.c_void_p(_rounded_up(address, self.vector_bytes))


class _StructureWithArrays:
    """A structure for the C++, with the tensors that it points to."""

    def __init__(self, structure: ctypes.Structure, arrays: Sequence[Tensor | None]) -> None:
        self.structure, self.arrays = structure, arrays


def _focal_structure(
    view: View, intensity: Tensor | None, field: Tensor | None, add: bool
) -> _StructureWithArrays:
    """Return the structure of the focal plane of a view, with the tensors that it points to."""
    arrays = (*(view.envelope or (None, None)), intensity, field)
    return _StructureWithArrays(_Focal(view.weight, *(address_of(x) for x in arrays), add), arrays)


def _rounded_up(n: int, step: int) -> int:
    """Return ``n``, rounded up to a multiple of ``step``."""
    return -(-n // step) * step
