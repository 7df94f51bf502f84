"""Figures of merit of a mask by wavelength: laser suppression and image contrast, with their physical bounds."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np

from neusee.nodes import metrics
from neusee.nodes.metrics import least_lsr, most_unsuppressed
from neusee.workflows.engine.runner import run
from neusee.workflows.evaluation.confidence_intervals import Numbers
from neusee.workflows.evaluation.pipelines import NONE, PipelineRecipes
from neusee.workflows.store.result_store import Store


@dataclass(frozen=True)
class MaskOptics:
    """The laser suppression and the image contrast of a mask, by spectral band."""

    wavelengths: Numbers  #: nm
    lsr: Numbers
    bsr: Numbers  #: mean over scenes
    median: Numbers  #: median contrast over the frequencies that the clear aperture passes
    rms: Numbers  #: rms contrast over the same frequencies
    floor: Numbers  #: smallest LSR of a mask that keeps all light in the field
    most: Numbers  #: largest rms contrast that the peak allows
    unsuppressed: Numbers  #: largest rms contrast of a mask with an LSR of 1 that keeps all light


def masks(
    each: Sequence[PipelineRecipes], store: Store, device: str, points: Mapping[str, Sequence[Mapping[float, Any]]]
) -> dict[str, MaskOptics]:
    """Return the laser suppression and the image contrast of each mask, by name of the mask."""
    optics: dict[str, MaskOptics] = {}
    for pipeline in each:
        if pipeline.pipeline.front not in optics:
            bsr = [next(iter(point.values()))["bsr"] for point in points[pipeline.name]]
            optics[pipeline.pipeline.front] = _mask(pipeline, store, device, np.mean(bsr, axis=0))
    return optics


def _mask(pipeline: PipelineRecipes, store: Store, device: str, bsr: Numbers) -> MaskOptics:
    wanted = ("bands", "lsr[mask]", "mtf[mask]", "psf[mask]")
    values = run(pipeline.recipe(NONE), store, wanted, device=device).values
    bands, lsr, mtf, psf = (values[name] for name in wanted)
    each = (lsr, mtf.median, mtf.rms, least_lsr(psf), metrics.limits(psf).passed, most_unsuppressed(psf))
    suppression, *rest = (x.double().cpu().numpy() for x in each)
    return MaskOptics(bands.centres.double().cpu().numpy() * 1e9, suppression, bsr, *rest)
