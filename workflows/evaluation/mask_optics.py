"""What a mask does by itself: suppression at each wavelength, the contrast it leaves, and what none could do better."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import TYPE_CHECKING, Any

import numpy as np

from neusee.nodes import metrics
from neusee.nodes.metrics import least_lsr, most_unsuppressed
from neusee.workflows.engine.runner import run
from neusee.workflows.evaluation.pipelines import NONE, Composed
from neusee.workflows.store.result_store import Store

if TYPE_CHECKING:
    from numpy.typing import NDArray

    Numbers = NDArray[np.float64]


@dataclass(frozen=True)
class Mask:
    """By band."""

    wavelengths: Numbers  #: nm
    lsr: Numbers
    bsr: Numbers  #: mean over scenes
    median: Numbers  #: contrast, within the band of the clear aperture
    rms: Numbers  #: of the same
    floor: Numbers  #: least LSR of light that is kept in the field
    most: Numbers  #: most rms contrast that the peak allows
    unsuppressed: Numbers  #: the same of a mask with an LSR of 1 that keeps all light


def masks(
    each: Sequence[Composed], store: Store, device: str, points: Mapping[str, Sequence[Mapping[float, Any]]]
) -> dict[str, Mask]:
    """Every mask once, in the order of the pipelines."""
    found: dict[str, Mask] = {}
    for pipeline in each:
        if pipeline.pipeline.front not in found:
            bsr = [point["bsr"] for at in points[pipeline.name] for point in list(at.values())[:1]]
            found[pipeline.pipeline.front] = _mask(pipeline, store, device, np.mean(bsr, axis=0))
    return found


def _mask(pipeline: Composed, store: Store, device: str, bsr: Numbers) -> Mask:
    wanted = ("bands", "lsr[mask]", "mtf[mask]", "psf[mask]")
    values = run(pipeline.recipes[NONE], store, wanted, device=device).values
    bands, lsr, mtf, psf = (values[name] for name in wanted)
    each = (lsr, mtf.median, mtf.rms, least_lsr(psf), metrics.limits(psf).passed, most_unsuppressed(psf))
    suppression, *rest = (x.double().cpu().numpy() for x in each)
    return Mask(bands.centres.double().cpu().numpy() * 1e9, suppression, bsr, *rest)
