"""The result of an evaluation: what was measured of every pipeline, scene by scene, and the tables over them."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

from neusee.workflows.evaluation.comparison_pictures import Panel
from neusee.workflows.evaluation.confidence_intervals import Interval, Table
from neusee.workflows.evaluation.evaluation_points import Point
from neusee.workflows.evaluation.evaluation_scenes import Scene
from neusee.workflows.evaluation.mask_optics import Mask
from neusee.workflows.evaluation.pipelines import Pipeline
from neusee.workflows.graph.recipe_graph import Recipe


@dataclass(frozen=True)
class Evaluated:
    """All that was measured."""

    recipe: Recipe
    scenes: Sequence[Scene]
    broken: Sequence[tuple[Path, str]]
    strengths: tuple[float, ...]
    small: int  #: pixels of the shorter side of the small pictures
    reference: str  #: the pipeline that others are compared with
    points: dict[str, list[dict[float, Point]]]  #: by pipeline, and scene by scene
    tables: dict[str, Table]  #: by pipeline
    against: dict[str, dict[str, Interval]]  #: by pipeline, what the reference's L1 is more
    masks: dict[str, Mask]  #: by mask
    panels: Sequence[Panel]
    pipelines: Sequence[Pipeline]
