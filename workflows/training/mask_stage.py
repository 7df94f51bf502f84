"""The element without images, in place of stage 1: designed in the folder of a training, which goes on from there."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from pathlib import Path

from neusee.workflows.graph.recipe_graph import Recipe
from neusee.workflows.recipe.blocks.train_block import Training
from neusee.workflows.report.run_folder import RunFolder
from neusee.workflows.store.result_store import Store
from neusee.workflows.training.mask_design.design_run import Made
from neusee.workflows.training.mask_design.optimizers import Kept

MASK = 0  #: the stage's number: it comes before the first


def designed(folder: Path) -> bool:
    """Whether the element of a training was designed without images; its file is written last."""
    return (folder / "mask.json").is_file()


def design_in(
    folder: Path,
    recipe: Recipe,
    how: Training,
    store: Store,
    command: Sequence[str],
    tell: Callable[[str], None],
    device: str,
) -> None:
    """Design the element, or go on where that was stopped.

    Raises `DesignError` as `design` does; ValueError where stage 1 has begun to learn another, or no element learns.
    """
    if how.learn is None:
        raise ValueError("train.learn: name the step of the element that is designed")
    if designed(folder):
        tell("the mask is designed")
        return
    if (folder / "state.pt").exists():
        raise ValueError(f"stage 1 has begun in {folder}: remove that folder, or change a value of train.mask")
    kept = Kept(folder / "mask.state")
    Made.of(recipe, how.design, store, kept, tell, device).write(RunFolder(folder), command)
    kept.path.unlink(missing_ok=True)
