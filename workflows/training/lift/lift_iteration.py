"""A network that estimates spectra from RGB, its training data, and one iteration of its
training.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from typing import Any

import torch
from torch import Tensor, nn

from neusee.nodes import losses
from neusee.nodes.spectra import (
    lift_matrix,
    lift_pictures,
    need_mst_plus_plus_bands,
    render,
    start_mst_plus_plus,
)
from neusee.nodes.values import Bands
from neusee.workflows.engine.differentiable_function import as_function
from neusee.workflows.engine.runner import run
from neusee.workflows.graph.recipe_graph import Recipe, needed
from neusee.workflows.keys.cache_key import stream_seed
from neusee.workflows.recipe.blocks.train_block import LiftTraining
from neusee.workflows.store.result_store import Store
from neusee.workflows.training.loop.resumable_loop import Losses, averaged, require_finite
from neusee.workflows.training.training_pictures import require_steps


class Pairs:
    """Numbered training pairs, each of a picture (3, y, x) and the true spectra of its pixels
    (31, y, x).
    """

    def __init__(self, recipe: Recipe, settings: LiftTraining, store: Store, device: str) -> None:
        require_steps(recipe, "train_lift", (settings.measured, settings.picture, settings.cube))
        bands = recipe.steps[settings.measured].wires.get("bands")
        if not isinstance(bands, str):
            name = settings.measured
            raise ValueError(
                f"train_lift.measured: {name} has no input `bands`: name a spectra.reflectances"
                " step"
            )
        self._names, self._seed = (settings.picture, settings.cube), recipe.seed
        random_steps = {
            name for name in needed(recipe, self._names) if recipe.steps[name].node.random
        }
        if not random_steps:
            raise ValueError(
                f"train_lift: step {settings.picture} gives no random pictures: use a"
                " spectra.leaves step"
            )
        results = run(recipe, store, [bands, settings.measured], device=device)
        self.bands: Bands = results[bands]
        self.measured: Tensor = results[settings.measured]
        need_mst_plus_plus_bands(self.bands)
        self._draw = as_function(
            recipe, outputs=self._names, store=store, device=device, redraw=random_steps
        )

    def __call__(self, *number: object) -> tuple[Tensor, Tensor]:
        """Return the training picture with the given number and the true spectra of its pixels.

        The same number always gives the same picture.
        """
        values = self._draw({}, seed=stream_seed(self._seed, " ".join(map(str, ("lift", *number)))))
        picture, cube = (values[name] for name in self._names)
        return picture.float(), cube.float()

    def batch(self, numbers: Sequence[int]) -> tuple[Tensor, Tensor]:
        """Return a batch of training pictures and a batch of their true spectra, each as one
        tensor.
        """
        pictures, cubes = zip(*map(self, numbers), strict=True)
        return torch.stack(pictures), torch.stack(cubes)


class LiftLearner:
    """The network that estimates spectra from RGB, its optimiser and the moving average of its
    weights.
    """

    def __init__(self, settings: LiftTraining, pairs: Pairs, seed: int, device: str) -> None:
        self.settings, self.pairs = settings, pairs
        rng = torch.Generator(device).manual_seed(stream_seed(seed, "train lift network"))
        self.linear = lift_matrix(pairs.measured.cpu(), pairs.bands.centres.cpu()).to(
            device, torch.float32
        )
        self.net = start_mst_plus_plus(rng, self.linear if settings.start == "linear" else None)
        self.optimiser = torch.optim.Adam(
            self.net.parameters(), lr=settings.rate, betas=settings.betas
        )
        self.average = averaged(self.net, settings.ema_decay)
        self.best: nn.Module = self.average.module if self.average else self.net

    def parts(self) -> dict[str, Any]:
        """Return by name the objects whose state a checkpoint must contain."""
        members = {"net": self.net, "optimiser": self.optimiser, "average": self.average}
        return {name: member for name, member in members.items() if member}

    def iterate(self, iteration: int) -> Losses:
        """Train the network on one batch of pictures, and return the losses.

        Raises `NotFinite` if a loss or the gradient is NaN or infinite.
        """
        batch, rate = self.settings.batch, self.settings.rate_at(iteration)
        for group in self.optimiser.param_groups:
            group["lr"] = rate
        self.optimiser.zero_grad(set_to_none=True)
        # each iteration has new pictures, numbered on and on
        picture, cube = self.pairs.batch(range(iteration * batch, (iteration + 1) * batch))
        estimate = lift_pictures(self.net, picture)
        loss = losses.mrae(estimate, cube, floor=self.settings.floor)
        loss.backward()
        norm_limit = math.inf if self.settings.clip is None else self.settings.clip
        gradient_norm = float(nn.utils.clip_grad_norm_(self.net.parameters(), norm_limit))
        numbers = {
            "MRAE": float(loss.detach()),
            "RMSE": _rmse(estimate.detach(), cube),
            "slope": gradient_norm,
            "rate": rate,
        }
        require_finite(numbers)
        self.optimiser.step()
        if self.average:
            self.average.update_parameters(self.net)
        return numbers

    @torch.no_grad()
    def validate(self) -> dict[str, Losses]:
        """Return the mean errors of the network and of a linear estimate, for pictures that are
        not in the training.
        """
        means, picture_count = dict[str, Losses](), self.settings.validation_batches
        for number in range(picture_count):
            picture, cube = self.pairs("judge", number)
            for name, estimate in self.estimates(picture).items():
                errors = {
                    "MRAE": float(losses.mrae(estimate, cube, floor=self.settings.floor)),
                    "RMSE": _rmse(estimate, cube),
                    "colour": _rmse(render(estimate, self.pairs.bands), picture),
                }
                means[name] = {
                    key: means.get(name, {}).get(key, 0.0) + x / picture_count
                    for key, x in errors.items()
                }
        return means

    def estimates(self, picture: Tensor) -> dict[str, Tensor]:
        """Estimate the spectra of an RGB picture twice: with the network, and with a linear
        reconstruction.
        """
        linear = torch.einsum("bc,cyx->byx", self.linear, picture)
        return {
            "mst_plus_plus": lift_pictures(self.best, picture[None])[0].clamp_min(0),
            "linear": linear.clamp_min(0),
        }


def _rmse(estimate: Tensor, truth: Tensor) -> float:
    return float((estimate - truth).square().mean().sqrt())
