"""The result of an evaluation: the metrics of every mask and restorer in every scene, and statistics over scenes."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from pathlib import Path

from neusee.workflows.evaluation.comparison_pictures import Panel
from neusee.workflows.evaluation.confidence_intervals import Interval, MetricTable
from neusee.workflows.evaluation.evaluation_points import PointNumbers
from neusee.workflows.evaluation.evaluation_scenes import Scene
from neusee.workflows.evaluation.mask_optics import MaskOptics
from neusee.workflows.evaluation.pipelines import Pipeline
from neusee.workflows.graph.recipe_graph import Recipe
from neusee.workflows.protection.equal_shade import EqualProtection


@dataclass(frozen=True)
class MistoldPoint:
    """The metrics of one scene whose restorer was told the truth, and told optics or laser with one error."""

    pipeline: str
    error: str
    scene: Scene
    strength: float
    true: PointNumbers
    wrong: PointNumbers


@dataclass(frozen=True)
class EvaluationResult:
    """The result of an evaluation: scenes, metrics by scene, statistics over scenes, masks and pictures."""

    recipe: Recipe
    scenes: Sequence[Scene]
    broken: Sequence[tuple[Path, str]]
    strengths: tuple[float, ...]
    small: int  #: pixels of the shorter side of the reduced pictures
    references: Mapping[str, str]  #: by pipeline, the pipeline with which it is compared
    points: dict[str, list[dict[float, PointNumbers]]]  #: by pipeline and scene
    tables: dict[str, MetricTable]  #: by pipeline
    against: dict[str, dict[str, Interval]]  #: by pipeline, decrease of L1 against the reference
    masks: dict[str, MaskOptics]  #: by mask
    panels: Sequence[Panel]
    pipelines: Sequence[Pipeline]
    mistold: Sequence[MistoldPoint] = ()
    protection: EqualProtection | None = None  #: if pipelines were brought to one peak
    wavelengths: Sequence[float | None] = ()  #: of the laser of each scene, in m
    commands: Mapping[str, Sequence[Mapping[float, str]]] = field(default_factory=dict)  #: as `points`, one each

    @property
    def reference(self) -> str:
        """Return the pipeline with which the first pipeline and those like it are compared."""
        return next(iter(self.references.values()))
