"""One iteration of a training (mask, network and critics), and the initial weights."""

from __future__ import annotations

import hashlib
import math
from collections.abc import Iterable, Iterator, Mapping, Sequence
from contextlib import contextmanager
from dataclasses import dataclass
from pathlib import Path
from typing import Any, NamedTuple

import torch
from torch import Tensor, nn

from neusee.nodes import ParameterError, losses, metrics
from neusee.nodes.doe import PARAMETRISATIONS
from neusee.nodes.file_headers import safetensors_need
from neusee.nodes.input_files import bytes_of
from neusee.nodes.network_weights import fits
from neusee.nodes.resampling import resize
from neusee.nodes.restore import (
    FFTMamba,
    Informed,
    NAFNet,
    OwnNetwork,
    Restorer,
    UNet,
    Unrolled,
    critic_slopes,
    critics,
    own_network,
    parameter_groups,
    skip_critic_draws,
    start_network,
    try_network,
)
from neusee.nodes.values import FilterFacts, Psf, Stop
from neusee.workflows.engine.node_call import call
from neusee.workflows.graph.errors import nearest
from neusee.workflows.graph.recipe_graph import Recipe
from neusee.workflows.keys.cache_key import device_kind, stream_seed
from neusee.workflows.recipe.blocks.train_block import KEY, Network, Stage, Training
from neusee.workflows.training.process_mesh import ALONE, Mesh
from neusee.workflows.training.resumable_loop import Losses, averaged, require_finite
from neusee.workflows.training.training_pictures import Sample, Samples, Shared

# --- picture batches ------------------------------------------------------------------------------

# Pictures of a training batch that pass the network together, and their separate results.


def together(
    pictures: Iterable[tuple[int, Sample]], by_shape: bool
) -> Iterator[tuple[list[int], Sample]]:
    """Yield the pictures of a batch with their numbers: each alone or, with ``by_shape``, those of
    equal size as one sample.

    A small picture uses little of a GPU, so that sixteen take hardly longer than one. On a CPU each
    picture is processed alone, so that only one is in memory.
    """
    if not by_shape:
        yield from (([number], sample) for number, sample in pictures)
        return
    groups: dict[object, dict[int, Sample]] = {}
    for number, sample in pictures:
        filter_facts = sample.given[0] if sample.given else None
        has_free_size = filter_facts is None or isinstance(filter_facts, FilterFacts)
        # a Wiener problem belongs to one picture: its number keeps it alone
        group_key = (
            tuple((name, x.shape) for name, x in sample.tensors.items())
            if has_free_size
            else number
        )
        groups.setdefault(group_key, {})[number] = sample
    for group in groups.values():
        yield list(group), joined(list(group.values()))


def joined(samples: list[Sample]) -> Sample:
    """Return pictures of equal size as one sample; further maps get a leading batch axis."""
    first_sample = samples[0]
    if len(samples) == 1:
        return first_sample
    pictures, truths = (
        torch.cat([getattr(s, name) for s in samples]) for name in ("picture", "truth")
    )
    light = torch.stack([s.light for s in samples])
    if not first_sample.given:
        return Sample(pictures, truths, light, first_sample.drawn)
    filter_facts = FilterFacts._make(
        map(torch.stack, zip(*(s.given[0] for s in samples if s.given), strict=True))
    )
    return Sample(
        pictures,
        truths,
        light,
        first_sample.drawn,
        (filter_facts, torch.stack([s.given[1] for s in samples if s.given])),
    )


def noted(
    pictures: Iterable[tuple[int, Sample]], record: list[Sample]
) -> Iterator[tuple[int, Sample]]:
    """Yield numbered pictures unchanged, and append each to ``record``."""
    for number, sample in pictures:
        record.append(sample)
        yield number, sample


# --- warm start -----------------------------------------------------------------------------------

# The initial weights of the network: those of an earlier training in place of random ones.


#: weight files in a result folder; the first that exists is used
_FILES = ("best.safetensors", "network.safetensors")


@dataclass(frozen=True)
class WarmStart:
    """A file of weights, and the digest of its content."""

    file: Path
    digest: str
    source: str  #: place in the recipe of the file's name

    @classmethod
    def of(cls, recipe: Recipe, settings: Training) -> WarmStart | None:
        """Return the weight file in ``train.start``, or None if not set; raise ValueError if there
        is no such file.
        """
        if settings.start is None:
            return None
        setting = recipe.config.settings.get(f"{KEY}.start")
        source = setting.source if setting else recipe.name
        file = settings.start
        if file.is_dir():
            file = next(
                (file / name for name in _FILES if (file / name).is_file()), file / _FILES[-1]
            )
        if file.suffix != ".safetensors" or not file.is_file():
            text = (
                f"{file} is no file of weights: give a .safetensors file, or the folder of a"
                " training that ended"
            )
            raise ValueError(f"{source}   {KEY}.start   {text}")
        return cls(
            file, hashlib.sha256(bytes_of(file, parameter="train.start")).hexdigest(), source
        )

    def load_into(self, net: Restorer) -> None:
        """Load the weights into a network; raise ValueError with the name of the first layer that
        does not fit.
        """
        from safetensors.torch import load_file

        safetensors_need(self.file, 2.0, "train.start")
        options: Any = getattr(net, "options", {})
        try:
            fits(net.stored, self.file, "the network of this training", options)
        except ParameterError as error:
            raise ValueError(f"{self.source}   {KEY}.start   {error}") from error
        net.stored.load_state_dict(load_file(self.file))

    @property
    def facts(self) -> dict[str, str]:
        """Return the entries on the initial weights for `training.json`."""
        return {"file": str(self.file), "sha256": self.digest}


# --- training iteration ---------------------------------------------------------------------------

# The trainable parts of a training (mask, restoration network, critics), and one training
# iteration.


class Scales(NamedTuple):
    """A batch of pictures at half resolution and at full resolution."""

    coarse: Tensor
    fine: Tensor


class Learner:
    """The mask, networks and optimisers of a training, with equal values in all processes."""

    def __init__(
        self,
        recipe: Recipe,
        settings: Training,
        device: str,
        designed: bool = False,
        mesh: Mesh = ALONE,
        start: WarmStart | None = None,
    ) -> None:
        self.settings, self.seed, self.device, self.mesh = settings, recipe.seed, device, mesh
        self.stop: Stop | None = None
        self._moment = 0, 0  # stage and iteration
        self.mask = (
            nn.Module() if designed or not settings.learn else self._start(recipe, settings.learn)
        )
        self.net: Restorer = self._network(settings.network)
        if start is not None:
            start.load_into(self.net)
        self.critics = nn.ModuleList(critics(self._rng("critics"), settings.critics.width)).to(
            settings.dtype
        )
        self.average = averaged(self.net, settings.average)
        self.begin(Stage(iterations=0), learns=True)

    def _network(self, network: Network) -> Restorer:
        """Return the network with its initial weights; a user's class is first tested with one call
        on this device.
        """
        if network.architecture is None:
            return start_network(lambda: network_of(network), self._rng("network")).to(
                self.settings.dtype
            )
        user_network = own_network(
            network.architecture,
            network.parameters,
            network.multiple,
            stream_seed(self.seed, "train network"),
        )
        try_network(user_network, self.settings.dtype, self.device)
        return user_network.train()

    def _start(self, recipe: Recipe, learn: str) -> nn.Module:
        """Return the mask of recipe step ``learn`` as a PyTorch module with trainable
        parameters.
        """
        step = recipe.steps[learn]
        path = step.node.path
        if path not in PARAMETRISATIONS:
            text = (
                f"{learn} is {path}, which has no trainable parameters;"
                f" {nearest(path, PARAMETRISATIONS)}"
            )
            raise ValueError(f"train: {text}; or design a mask without images: --stage mask")
        stop = recipe.steps[str(step.wires["stop"])]
        self.stop = call(stop, [], stop.params, recipe.seed, "cpu")
        return PARAMETRISATIONS[path](self.stop, step.params, self._rng("element")).to(
            self.settings.dtype
        )

    def height(self) -> Tensor:
        """Return the height map (v, u) of the mask in m; raise ValueError if no mask is trained."""
        if self.stop is None:
            raise ValueError("train.learn: this training has no trainable mask")
        height: Tensor = self.mask(self.stop)
        return height

    def _rng(self, *names: object) -> torch.Generator:
        """Return a generator on this device, seeded by the seed of the recipe and the names."""
        return torch.Generator(self.device).manual_seed(
            stream_seed(self.seed, " ".join(map(str, ("train", *names))))
        )

    def begin(self, stage: Stage, learns: bool) -> None:
        """Start a stage with new optimisers and the initial learning rates.

        With ``learns``, the mask is trained together with the network.
        """
        rates, self.stage, self.learns = self.settings.rates, stage, learns
        groups = parameter_groups(self.net, rates.weights, rates.biases)
        if learns:
            groups += [{"params": list(self.mask.parameters()), "lr": rates.mask}]
        self.generator_optimizer = torch.optim.Adam(groups, betas=self.settings.betas)
        self.critic_optimizer = torch.optim.Adam(
            parameter_groups(self.critics, rates.weights, rates.biases),
            betas=self.settings.critics.betas,
        )
        self._first = [
            [group["lr"] for group in optimiser.param_groups]
            for optimiser in (self.generator_optimizer, self.critic_optimizer)
        ]

    def set_rates(self, iteration: int) -> float:
        """Set the learning rates of an iteration, and return their factor relative to the initial
        rates.
        """
        factor = self.settings.rates.share(iteration)
        for optimiser, first_rates in zip(
            (self.generator_optimizer, self.critic_optimizer), self._first, strict=True
        ):
            for group, rate in zip(optimiser.param_groups, first_rates, strict=True):
                # not below the least rate; a rate that starts below it is not raised
                group["lr"] = max(rate * factor, min(rate, self.settings.rates.least))
        return factor

    def parts(self) -> dict[str, Any]:
        """Return the objects whose state a checkpoint must contain, by name."""
        members = {
            "mask": self.mask,
            "net": self.net,
            "critics": self.critics,
            "makers": self.generator_optimizer,
        }
        return {
            **members,
            "judges": self.critic_optimizer,
            **({"average": self.average} if self.average else {}),
        }

    # --- one iteration ----------------------------------------------------------------------------

    def iterate(self, samples: Samples, stage: int, iteration: int) -> tuple[Losses, list[Sample]]:
        """Train on one batch of pictures; raise `NotFinite` if a loss or gradient is NaN or
        infinite.

        Returns the losses of the batch, and the pictures of this process. Each of several processes
        has its own pictures, and all processes apply the sum of the gradients.
        """
        self.generator_optimizer.zero_grad(set_to_none=True)
        self._moment = stage, iteration
        shared = samples.begin(self.height()) if samples.shared else Shared.of({})
        loss_sums = self._mask_suppression(shared, samples) if self.learns else {}
        batch_size, batch_samples, truth_and_estimate = (
            self.stage.batch,
            list[Sample](),
            dict[int, tuple[Scales, Scales]](),
        )
        pictures = noted(
            samples.batch(shared, stage, iteration * batch_size, batch_size), batch_samples
        )
        # forward and backward pass for each picture, or on a GPU for all pictures of one size at
        # once
        for numbers, sample in together(pictures, self._batch_goes_whole):
            terms, truth, estimate = self._restoration_terms(sample)
            truth_and_estimate |= pictures_by_number(numbers, truth, estimate)
            batch_share = len(numbers) / batch_size
            _backward([weight * term * batch_share for weight, term in terms.values() if weight])
            _add_terms(loss_sums, terms, batch_share)
        # propagate the summed gradients of all pictures through the steps that depend only on the
        # mask
        shared.back()
        # sum over all processes
        loss_sums = self.mesh.numbers(loss_sums, self._names(), self.device)
        loss_sums["slope"] = self._move(
            self.generator_optimizer,
            loss_sums,
            (self.net, self.mask) if self.learns else (self.net,),
        )
        if isinstance(self.net, OwnNetwork):
            self.mesh.share_buffers(self.net)
        if self.average:
            self.average.update_parameters(self.net)
        if self.stage.adversarial:
            loss_sums |= self._train_critics(
                truth_and_estimate, self._rng("between", stage, iteration)
            )
        return loss_sums, batch_samples

    @property
    def _batch_goes_whole(self) -> bool:
        """Return True if pictures of a batch pass the network together: on a GPU, behind a fixed
        mask.

        Not with a user's class, which has its own random numbers for each picture, and not with
        losses summed over pixels, which are per picture.
        """
        can_batch = device_kind(self.device) != "cpu" and not self.learns and not self.stage.bsr
        return (
            can_batch and self.settings.reduction == "mean" and not isinstance(self.net, OwnNetwork)
        )

    @torch.no_grad()
    def shared(self, samples: Samples) -> Shared:
        """Return the results that depend on the present mask but on no picture, without
        gradients.
        """
        return samples.begin(self.height()) if samples.shared else Shared.of({})

    def _names(self) -> list[str]:
        """Return the names of the losses in the present stage, in the same order in every
        process.
        """
        weights = {
            "BSR": self.stage.bsr,
            "reconstruction": self.stage.reconstruction,
            "decibels": self.stage.decibels,
            "adversarial": self.stage.adversarial,
        }
        return [
            *(["LSR"] if self.learns else []),
            "L1",
            *(name for name, weight in weights.items() if weight),
        ]

    def _mask_suppression(self, shared: Shared, samples: Samples) -> Losses:
        """Backpropagate the laser suppression loss band by band to save memory, and return the mean
        suppression ratio.

        Every process computes all bands with a weight of 1 / number of processes, so that the sum
        counts each band once.
        """
        psf: Psf = shared.values[samples.psf]
        process_count = self.mesh.size
        with torch.no_grad():
            peaks: Tensor = metrics.lsr(psf)
        if self.stage.lsr:
            for band in range(len(psf.clear_peak)):
                self._add_suppression_gradient(psf, slice(band, band + 1))
        return {"LSR": float(peaks.mean()) / process_count}

    def _add_suppression_gradient(self, psf: Psf, band: slice) -> None:
        """Add the gradient of the laser suppression loss of one band to that of the PSF.

        The band is a leaf of its own: the gradient of a slice of the PSF would have the size of all
        bands.
        """
        read = (psf.intensity, psf.clear_peak)
        leaves = [x[band].detach().requires_grad_(x.requires_grad) for x in read]
        loss = losses.suppression_loss(Psf(*leaves), log=self.settings.logarithm)
        (self.stage.lsr / self.mesh.size * loss).backward()
        for x, leaf in zip(read, leaves, strict=True):
            if leaf.grad is not None:
                x.grad = torch.zeros_like(x) if x.grad is None else x.grad
                x.grad[band] += leaf.grad

    def _restoration_terms(
        self, sample: Sample
    ) -> tuple[dict[str, tuple[float, Tensor]], Scales, Scales]:
        """Restore a training picture; return its weighted loss terms, the true picture and the
        detached restored picture.
        """
        lower_precision = torch.autocast(
            device_kind(self.device), torch.bfloat16, self.settings.precision == "bfloat16"
        )
        picture = sample.picture if self.learns else sample.picture.detach()
        with lower_precision, self._seeded(sample):
            coarse, fine = self.net.pyramid(picture, *sample.given)
        estimate = Scales(coarse.to(self.settings.dtype), fine.to(self.settings.dtype))
        y, x = sample.truth.shape[-2:]
        # half the size, rounded up, as in the network
        truth = Scales(resize(sample.truth.detach(), -(-y // 2), -(-x // 2)), sample.truth.detach())
        zero = torch.zeros((), device=fine.device)
        # L1 has weight 0: it is only written to the table
        terms = {"L1": (0.0, (estimate.fine - truth.fine).abs().mean())}
        if self.stage.bsr:
            # BSR loss: inverse of the share of the scene's light that the mask keeps
            terms["BSR"] = (self.stage.bsr, (1.0 / sample.light.clamp_min(1e-30)).sum())
        if self.stage.reconstruction:
            terms["reconstruction"] = (
                self.stage.reconstruction,
                sum(self._errors(estimate, truth), zero),
            )
        if self.stage.decibels:
            terms["decibels"] = (self.stage.decibels, losses.log_error(estimate.fine, truth.fine))
        if self.stage.adversarial:
            scores = (
                -critic(estimate_scale).mean()
                for critic, estimate_scale in zip(self.critics, estimate, strict=True)
            )
            terms["adversarial"] = (self.stage.adversarial, sum(scores, zero))
        return terms, truth, Scales(estimate.coarse.detach(), estimate.fine.detach())

    @contextmanager
    def _seeded(self, sample: Sample) -> Iterator[None]:
        """Seed the random numbers of a user's network, such as dropout, by picture and
        iteration.
        """
        if not isinstance(self.net, OwnNetwork):
            yield
            return
        with torch.random.fork_rng([self.device] if self.device.startswith("cuda") else []):
            torch.manual_seed(
                stream_seed(self.seed, f"train layers {self._moment} {sample.drawn['noise']}")
            )
            yield

    def _errors(self, estimate: Scales, truth: Scales) -> Iterator[Tensor]:
        """Yield the reconstruction error at half and at full resolution, each the sum of an error
        of pixels and one of frequencies.
        """
        options = (
            {} if self.settings.reduction == "mean" else {"reduction": self.settings.reduction}
        )
        for estimate_scale, truth_scale in zip(estimate, truth, strict=True):
            yield losses.charbonnier(estimate_scale, truth_scale, **options) + losses.fft_l1(
                estimate_scale, truth_scale, **options
            )

    def _train_critics(
        self, pairs: Mapping[int, tuple[Scales, Scales]], rng: torch.Generator
    ) -> Losses:
        """Train the critics to distinguish true from restored pictures, with equal random numbers
        in all processes.
        """
        self.critic_optimizer.zero_grad(set_to_none=True)
        critic_losses, batch = {"critics": 0.0, "penalty": 0.0}, self.stage.batch
        for i in range(batch):
            if i not in pairs:
                for _ in self.critics:
                    # skip the random numbers that another process uses for its picture
                    skip_critic_draws(rng, self.settings.patches if self.settings.patch else 1)
                continue
            for critic, truth_scale, estimate_scale in zip(self.critics, *pairs[i], strict=True):
                score_difference = (critic(estimate_scale) - critic(truth_scale)).mean()
                penalty = losses.gradient_penalty(
                    critic_slopes(critic, truth_scale, estimate_scale, rng)
                )
                # Wasserstein distance with a gradient penalty
                _backward(
                    [
                        (self.stage.adversarial * score_difference + self.stage.penalty * penalty)
                        / batch
                    ]
                )
                critic_losses["critics"] += float(score_difference.detach()) / batch
                critic_losses["penalty"] += float(penalty.detach()) / batch
        critic_losses = self.mesh.numbers(critic_losses, tuple(critic_losses), self.device)
        self._move(self.critic_optimizer, critic_losses, list(self.critics))
        return critic_losses

    def _move(
        self,
        optimiser: torch.optim.Optimizer,
        losses: Mapping[str, float],
        parts: Sequence[nn.Module],
    ) -> float:
        """Apply one optimiser step, and return the largest gradient norm of the modules ``parts``
        before clipping.

        The gradient of each module is clipped to ``train.clip`` separately, because the laser
        suppression loss has a thousand times as large a gradient for the mask as for a network.
        Raises `NotFinite` before the step.
        """
        self.mesh.add_gradients(parts)
        norm_limit = math.inf if self.settings.clip is None else self.settings.clip
        norm = max(
            float(nn.utils.clip_grad_norm_(module.parameters(), norm_limit)) for module in parts
        )
        require_finite({**losses, "norm of the gradient": norm})
        optimiser.step()
        return norm


def _add_terms(
    sums: dict[str, float], terms: Mapping[str, tuple[float, Tensor]], share: float
) -> None:
    """Add ``share`` times each loss term to the sum of the same name."""
    for name, (_, term) in terms.items():
        sums[name] = sums.get(name, 0.0) + float(term.detach()) * share


def pictures_by_number(
    numbers: Sequence[int], truth: Scales, estimate: Scales
) -> dict[int, tuple[Scales, Scales]]:
    """Return the true and the restored picture of each number, split from a batch."""
    chunks = [[x.chunk(len(numbers)) for x in scales] for scales in (truth, estimate)]
    return {
        number: (Scales(*(x[i] for x in chunks[0])), Scales(*(x[i] for x in chunks[1])))
        for i, number in enumerate(numbers)
    }


def _backward(terms: Sequence[Tensor]) -> None:
    """Backpropagate the sum of terms; nothing if there is none."""
    if terms:
        sum(terms[1:], terms[0]).backward()  # type: ignore[no-untyped-call]


def network_of(network: Network) -> Restorer:
    """Return the built-in network of the settings, with random weights."""
    if network.kind == "fft_mamba":
        return FFTMamba(network.width, **network.options)
    if network.kind == "unrolled":
        return Unrolled(network.width, network.steps)
    if network.kind == "informed":
        return Informed(network.width)
    return UNet(network.width) if network.kind == "unet" else NAFNet(network.width)
