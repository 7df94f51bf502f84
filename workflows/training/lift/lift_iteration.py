"""Pictures with known spectra, drawn through a recipe by their number, and the network that learns from them."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import torch
from torch import Tensor, nn
from torch.optim.swa_utils import AveragedModel, get_ema_multi_avg_fn

from neusee.nodes import losses
from neusee.nodes.spectra import lift_matrix, lift_pictures, need_mst_plus_plus_bands, render, start_mst_plus_plus
from neusee.nodes.values import Bands
from neusee.workflows.engine.differentiable_function import as_function
from neusee.workflows.graph.diagnostics import nearest
from neusee.workflows.graph.recipe_graph import Recipe, needed
from neusee.workflows.keys.cache_key import stream_seed
from neusee.workflows.recipe.blocks.train_lift_block import LiftTraining
from neusee.workflows.store.result_store import Store
from neusee.workflows.training.training_iteration import NotFinite

_STEEPEST = 10.0  #: norm of a gradient, above which it is shortened
Losses = dict[str, float]


class Pairs:
    """Pictures (3, y, x) with their spectra (31, y, x): the same for the same number, in whatever order."""

    def __init__(self, recipe: Recipe, how: LiftTraining, store: Store, device: str) -> None:
        for name in (how.measured, how.picture, how.cube):
            if name not in recipe.steps:
                raise ValueError(f"train_lift: the recipe has no step {name}; {nearest(name, recipe.steps)}")
        wires = recipe.steps[how.measured].wires
        if not isinstance(wires.get("bands"), str):
            raise ValueError(f"train_lift.measured: {how.measured} takes no bands: name a spectra.reflectances step")
        self._names, self._seed = (how.picture, how.cube), recipe.seed
        bands = str(wires["bands"])
        random = {name for name in needed(recipe, self._names) if recipe.steps[name].node.random}
        if not random:
            raise ValueError(f"train_lift: {how.picture} is always the same: draw it by spectra.leaves")
        known = recipe.run(store, [bands, how.measured], device=device)
        self.bands: Bands = known[bands]
        self.measured: Tensor = known[how.measured]
        need_mst_plus_plus_bands(self.bands)
        self._draw = as_function(recipe, outputs=self._names, store=store, device=device, redraw=random)

    def __call__(self, *number: object) -> tuple[Tensor, Tensor]:
        """The picture of this number, and its spectra."""
        found = self._draw({}, seed=stream_seed(self._seed, " ".join(map(str, ("lift", *number)))))
        picture, cube = (found[name] for name in self._names)
        return picture.float(), cube.float()

    def batch(self, numbers: Sequence[int]) -> tuple[Tensor, Tensor]:
        """Several, one over another."""
        pictures, cubes = zip(*map(self, numbers), strict=True)
        return torch.stack(pictures), torch.stack(cubes)


class LiftLearner:
    """The network, its optimiser and its average."""

    def __init__(self, how: LiftTraining, pairs: Pairs, seed: int, device: str) -> None:
        self.how, self.pairs = how, pairs
        rng = torch.Generator(device).manual_seed(stream_seed(seed, "train lift network"))
        self.linear = lift_matrix(pairs.measured.cpu(), pairs.bands.centres.cpu()).to(device, torch.float32)
        self.net = start_mst_plus_plus(rng, self.linear if how.start == "linear" else None)
        self.optimiser = torch.optim.Adam(self.net.parameters(), lr=how.rate, betas=how.betas)
        self.average = _averaged(self.net, how.average) if how.average else None

    def parts(self) -> dict[str, Any]:
        """All that a later iteration depends on."""
        found = {"net": self.net, "optimiser": self.optimiser}
        return {**found, **({"average": self.average} if self.average else {})}

    def iterate(self, iteration: int) -> Losses:
        """Look at a batch and move a step; raises `NotFinite` before a bad one."""
        batch, rate = self.how.batch, self.how.rate_at(iteration)
        for group in self.optimiser.param_groups:
            group["lr"] = rate
        self.optimiser.zero_grad(set_to_none=True)
        picture, cube = self.pairs.batch(range(iteration * batch, (iteration + 1) * batch))
        estimate = lift_pictures(self.net, picture)
        loss = losses.mrae(estimate, cube, floor=self.how.floor)
        loss.backward()
        slope = float(nn.utils.clip_grad_norm_(self.net.parameters(), _STEEPEST))
        found = {"MRAE": float(loss.detach()), **_rmse(estimate.detach(), cube), "slope": slope, "rate": rate}
        wrong = [name for name, x in found.items() if not abs(x) < float("inf")]
        if wrong:
            raise NotFinite(f"not finite: {', '.join(wrong)}")
        self.optimiser.step()
        if self.average:
            self.average.update_parameters(self.net)
        return found

    def best(self) -> nn.Module:
        """The network to use: the average, where there is one."""
        return self.average.module if self.average else self.net

    @torch.no_grad()
    def judged(self) -> dict[str, Losses]:
        """The network and the linear estimate of the same reflectances, on pictures that nobody learnt from."""
        sums: dict[str, Losses] = {}
        for number in range(self.how.judge):
            picture, cube = self.pairs("judge", number)
            for name, estimate in self.estimates(picture).items():
                found = {"MRAE": float(losses.mrae(estimate, cube, floor=self.how.floor)), **_rmse(estimate, cube),
                         "colour": _rmse(render(estimate, self.pairs.bands), picture)["RMSE"]}  # fmt: skip
                sums[name] = {key: sums.get(name, {}).get(key, 0.0) + x / self.how.judge for key, x in found.items()}
        return sums

    def estimates(self, picture: Tensor) -> dict[str, Tensor]:
        """Spectra of a picture by the network, and linearly."""
        linear = torch.einsum("bc,cyx->byx", self.linear, picture)
        return {
            "mst_plus_plus": lift_pictures(self.best(), picture[None])[0].clamp_min(0),
            "linear": linear.clamp_min(0),
        }


def _averaged(net: nn.Module, decay: float) -> AveragedModel:
    mean = get_ema_multi_avg_fn(decay)  # type: ignore[no-untyped-call]
    return AveragedModel(net, multi_avg_fn=mean)


def _rmse(estimate: Tensor, truth: Tensor) -> Losses:
    return {"RMSE": float((estimate - truth).square().mean().sqrt())}
