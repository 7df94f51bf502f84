"""Design a mask without images: little laser in one place, the light in the field, and what contrast that leaves.

A relief is learnt through the recipe's own graph on the terms of the mask alone, and then judged by the same figures
as any other mask, on every band and at the full sampling of the recipe.
"""

from __future__ import annotations

import json
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import torch
from torch import Tensor

from neusee.nodes import losses, metrics
from neusee.nodes.doe import PARAMETRISATIONS, half_rings
from neusee.workflows.engine.provenance import timestamp, versions
from neusee.workflows.graph.diagnostics import RecipeError
from neusee.workflows.graph.recipe_graph import Recipe, needed
from neusee.workflows.keys.cache_key import digest, file_digest
from neusee.workflows.keys.code_digest import Code
from neusee.workflows.keys.engine_digest import engine
from neusee.workflows.recipe.blocks.mask_design_block import DesignError, MaskTraining, Weights, need_steps, state_file
from neusee.workflows.recipe.changed_recipe import changed
from neusee.workflows.report.run_folder import RunFolder, new_run
from neusee.workflows.report.study_page import page
from neusee.workflows.store.result_store import Store
from neusee.workflows.training.mask_design.design_terms import Terms
from neusee.workflows.training.mask_design.optimizers import Kept, Learnt, learn

__all__ = ["DesignError", "MaskTraining", "Weights", "design", "figures"]

Tell = Callable[[str], None]
_LEARNT_WITH = {
    used.__module__
    for used in (half_rings, PARAMETRISATIONS["doe.pixelwise"], losses.contrast, losses.suppression_loss)
}


def design(
    recipe: Recipe, how: MaskTraining, store: Store | None, out: Path, tell: Tell, *, device: str = "cpu"
) -> Path:
    """Learn a mask and write ``out/<date>_<recipe>_mask_<key>/``; gives the folder.

    ``mask.safetensors`` holds the relief as `doe.pixelwise` reads it, ``history.csv`` the terms at each iteration,
    ``mask.json`` the figures, ``provenance.json`` the settings. What is unfinished is kept beside the folder, and
    goes on where the same is asked for again.

    Raises: `DesignError` where the recipe has no such steps, or a loss that is not finite.
    """
    need_steps(recipe.steps, how)
    key = _key(recipe, how, store)
    kept = Kept(state_file(out, recipe.name, key))
    made = Made.of(recipe, how, store, kept, tell, device)
    with new_run(out, f"{recipe.name}_mask", key) as folder:
        made.write(folder)
    kept.path.unlink(missing_ok=True)
    return folder.path


@dataclass(frozen=True)
class Made:
    """A designed relief, at the sampling of its recipe, and what it does."""

    terms: Terms
    learnt: Learnt
    height: Tensor
    found: Mapping[str, Any]

    @classmethod
    def of(
        cls, recipe: Recipe, how: MaskTraining, store: Store | None, kept: Kept, tell: Tell, device: str = "cpu"
    ) -> Made:
        """Learn it, or go on from what is kept, and judge it; raises `DesignError` as `design` does."""
        learning = Terms(_at(recipe, how), how, store, device)
        full = Terms(recipe, how, store, device) if how.at else learning
        tell(f"to be made: {full.fabrication}")
        learnt = learn(learning, how, kept, tell)
        with torch.no_grad():
            height = learnt.height(full.stop).detach().to("cpu", torch.float32).contiguous()
            found = figures(full, height.to(full.device))
        tell(said(found))
        return cls(full, learnt, height, found)

    def write(self, folder: RunFolder, command: Sequence[str] = ()) -> None:
        """Write relief, curve, page and settings; ``mask.json`` at last, so that where it is all of it is."""
        from safetensors.torch import save

        learnt, recipe, how = self.learnt, self.terms.recipe, self.terms.how
        folder.write("mask.safetensors", save({"height": self.height}))
        header = list(dict.fromkeys(name for row in learnt.history for name in row))
        folder.write_rows("history.csv", header, [[row.get(name, "") for name in header] for row in learnt.history])
        self._page(folder, command)
        made = {"fabrication": self.terms.fabrication.values, "numbers": learnt.numbers}
        doc = {"recipe": recipe.name, "kind": how.kind, "loss": learnt.loss, **self.found, **made}
        folder.write("mask.json", json.dumps(doc, indent=1))

    def _page(self, folder: RunFolder, command: Sequence[str]) -> None:
        from neusee.workflows.training.mask_design.design_page import pictures, sections

        recipe, how = self.terms.recipe, self.terms.how
        provenance = {
            "stage": "mask",
            "recipe": recipe.name,
            **({"command": " ".join(command)} if command else {}),
            "date": timestamp(),
            "settings": how.model_dump(mode="json"),
            "versions": versions(),
        }
        written = provenance | {"config": recipe.config.to_yaml()}
        folder.write("provenance.json", json.dumps(written, indent=1, ensure_ascii=False))
        with torch.no_grad():
            shown = pictures(self.terms, self.height.to(self.terms.device), self.learnt)
        for name, picture in shown.items():
            folder.write(f"figures/{name}.png", picture)
        title, intro = f"{recipe.name}: a mask designed without images", f"{how.kind}: {said(self.found)}."
        body = sections(self.found, self.terms.fabrication, shown)
        folder.write("report.html", page(title, intro, body, provenance))


def _at(recipe: Recipe, how: MaskTraining) -> Recipe:
    """The recipe as it is learnt on."""
    if not how.at:
        return recipe
    try:
        return changed(recipe, [f"{name}={_word(value)}" for name, value in how.at.items()])
    except RecipeError as error:
        raise DesignError(f"at: {error.diagnostics[0].path}: {error.diagnostics[0].message}") from error


def _word(value: Any) -> str:
    return json.dumps(value) if isinstance(value, list | tuple | dict) else str(value)


def _key(recipe: Recipe, how: MaskTraining, store: Store | None) -> str:
    """What decides the bits of a mask: the recipe, the settings, and the code of nodes and design."""
    code = Code((store or Store()).code_memo)
    steps = [recipe.steps[name] for name in needed(recipe, [how.psf, how.plain])]
    nodes = sorted({step.node.fn.__module__ for step in steps} | _LEARNT_WITH)
    settings = how.model_dump(mode="json", exclude={"save_every", "start"})
    settings["start"] = how.start and file_digest(how.start)
    return digest(
        "mask",
        recipe.config.to_yaml(),
        recipe.seed,
        settings,
        [code.digest(node) for node in nodes],
        engine("training.mask_design.design_run"),
    )


def figures(terms: Terms, height: Tensor) -> dict[str, Any]:
    """LSR, BSR and contrast of a relief by band, their means, and the bounds that hold for them."""
    with torch.no_grad():
        psf, plain = terms.psf(height), terms.plain()
        lsr, bsr = metrics.lsr(psf), metrics.bsr(psf.intensity, plain.intensity)
        mtf, limits = metrics.mtf(psf), metrics.limits(psf)
    each = {
        "wavelength": terms.bands.centres, "lsr": lsr, "bsr": bsr, "median_mtf": mtf.median, "rms_mtf": mtf.rms,
        "energy_floor": limits.floor, "rms_all": limits.rms, "rms_all_bound": limits.bound,
        "rms_mtf_bound": limits.passed, "median_mtf_bound": limits.median,
    }  # fmt: skip
    plain_values = {name: [float(x) for x in value] for name, value in each.items()}
    means = {name: float(value.double().mean()) for name, value in each.items() if name != "wavelength"}
    return {"mean": means, "bands": plain_values, "depth": float(height.amax() - height.amin())}


def said(found: Mapping[str, Any]) -> str:
    """The figures in one line."""
    mean = found["mean"]
    return (
        f"mean LSR {mean['lsr']:.3g} (even light {mean['energy_floor']:.2g}), BSR {mean['bsr']:.3f}, "
        f"median MTF {mean['median_mtf']:.3g} (at most {mean['median_mtf_bound']:.2g}), "
        f"relief {found['depth'] * 1e6:.3g} um deep"
    )
