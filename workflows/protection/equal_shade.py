"""The grey filter and the stop with which a lens, with or without a mask, lowers the peak of a laser to a wanted share.

A filter of transmittance t lowers the peak to t at every wavelength; a stop lowers it more per light that it takes.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from typing import NamedTuple

from neusee.nodes import metrics
from neusee.workflows.protection.camera_parts import ProtectionCamera
from neusee.workflows.protection.equal_rivals import Candidate, best
from neusee.workflows.protection.front_optics import Front, FrontBench, FrontSettings
from neusee.workflows.protection.unknown_conditions import usual_condition
from neusee.workflows.store.result_store import Store

WAYS = ("best", "filter", "stop")  #: what is added to a lens: stop and filter, a filter alone, or a stop alone
_LEAST_SAMPLES = 16  #: of the pupil, along the diameter of the smallest stop
_HALVINGS = 12  #: of the interval in which the diameter of a stop is looked for
_OPEN = 0.995  #: transmittance from which a filter is not named
_RATIO = 0.85  #: between two diameters of stops


class EqualProtection(NamedTuple):
    """The peak of a laser that is wanted, as a share of that behind the plain lens, and what is added to reach it."""

    level: float  #: at the worst wavelength
    way: str = WAYS[0]  #: one of `WAYS`


@dataclass(frozen=True)
class EqualShade:
    """A stop and a grey filter, which together with a mask lower the peak to the wanted share."""

    alone: float  #: peak with the mask alone, relative to the clear lens, at the worst wavelength
    diameter: float = 1.0  #: of the stop, relative to the lens
    transmittance: float = 1.0  #: of the filter

    @property
    def said(self) -> str:
        """Return stop and filter as text, such as `` + stop 0.56 + filter 0.1``; parts without effect are left out."""
        stop = f" + stop {self.diameter:.3g}" if self.diameter < 1 else ""
        return stop + (f" + filter {self.transmittance:.2g}" if self.transmittance < _OPEN else "")

    @property
    def brightness(self) -> float:
        """Return the factor that gives a picture behind stop and filter the exposure of one without them."""
        return 1.0 / (self.transmittance * self.diameter**2)

    @property
    def words(self) -> list[str]:
        """Return the arguments that add stop and filter to the arm ``mask`` of a recipe.

        The developed picture behind them has an exposure of its own: it is as bright as without them.
        """
        values = f"transmittance: {self.transmittance!r}, diameter: {self.diameter!r}"
        return [
            "+arms.plain.shade=null",
            "+arms.mask.shade=shade",
            f"+steps.shade={{node: doe.shade, from: stop, with: {{{values}}}}}",
            "+steps.pupil.from.shade=${item.shade}",
            "+steps.laser_pupil.from.shade=${each.arms.shade}",
            "+arms.plain.brightness=1",
            f"+arms.mask.brightness={self.brightness!r}",
            "+steps.developed.with={brightness: '${item.brightness}'}",
        ]


def stop_diameter(camera: ProtectionCamera, wanted: float) -> float:
    """Return the diameter of the smallest stop whose peak, with the mask if there is one, is not below ``wanted``.

    Raises: ValueError if the samples of the pupil carry no stop that is small enough.
    """

    def peak(diameter: float) -> float:
        return float(metrics.lsr(camera.psf(True, diameter, camera.bands)).max())

    low, high = _LEAST_SAMPLES / int(camera.stop.samples), 1.0
    if (least := peak(low)) > wanted:
        raise ValueError(
            f"needs a smaller stop than the samples of the pupil carry: ask for {least:.2g} or more, or take filters "
            "with --by filter"
        )
    for _ in range(_HALVINGS):
        middle = (low + high) / 2
        low, high = (low, middle) if peak(middle) >= wanted else (middle, high)
    return high


def best_diameter(camera: ProtectionCamera, store: Store, wanted: float, electrons: float) -> float:
    """Return the diameter of the stop whose filtered picture has the least error, with the filter that it then needs.

    ``electrons`` is the mean light of the scene in e- a pixel behind the plain lens.
    """
    side = min(int(n) for n in camera.lens["shape"])
    bench = FrontBench(camera, store, FrontSettings(0.1, 0.12, min(14.0, side / 4), (side,), None))
    usual, least = usual_condition(), stop_diameter(camera, wanted)
    diameters = [_RATIO**k for k in range(40) if _RATIO**k > least]
    fronts = [Front(True, diameter) for diameter in (*diameters, least)]
    found = [bench.measure(front, usual) for front in fronts]
    each = [Candidate(front, one, one.peak) for front, one in zip(fronts, found, strict=True)]
    return best(each, wanted, electrons, camera.pixel(0.0, 0.0))["error"][1].front.diameter


def shade_equally(
    camera: ProtectionCamera,
    store: Store,
    wanted: float,
    way: str,
    electrons: Callable[[], float],
    peak_of: Callable[[EqualShade], float],
) -> EqualShade:
    """Return the stop and the filter of one of the `WAYS` with which the peak is ``wanted``.

    ``electrons`` returns the mean light of the scene, in e- a pixel behind the plain lens. ``peak_of`` returns the peak
    behind a shade at the worst of all wavelengths, relative to the clear lens.
    """
    alone = peak_of(EqualShade(1.0))
    if wanted > alone * (1 + 1e-6):
        raise ValueError(f"lowers the peak to {alone:.4g} already: ask for at most that, or leave this mask out")
    diameter = 1.0
    if way == "stop":
        diameter = stop_diameter(camera, wanted)
    elif way == "best":
        diameter = best_diameter(camera, store, wanted, electrons())
    reached = alone if diameter == 1 else peak_of(EqualShade(alone, diameter))
    return EqualShade(alone, diameter, min(1.0, wanted / reached))
