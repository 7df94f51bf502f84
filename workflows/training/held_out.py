"""Photographs that a training never uses, and the quality of the network on them during the
training.
"""

from __future__ import annotations

import math
from collections.abc import Collection, Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass, replace
from itertools import chain, product
from pathlib import Path
from typing import Any

import numpy as np
import torch
from torch import Tensor, nn

from neusee.nodes import metrics
from neusee.nodes.scene import Photographs
from neusee.workflows.graph.recipe_graph import Recipe
from neusee.workflows.keys.cache_key import file_digest
from neusee.workflows.recipe.blocks.train_block import KEY, Training
from neusee.workflows.training.process_mesh import Mesh
from neusee.workflows.training.resumable_loop import Losses
from neusee.workflows.training.training_pictures import HELD_OUT, Sample, Samples, Shared

CONFIDENCE = 0.9  #: confidence level of the interval of a mean over photographs
_METRICS = ("PSNR", "L1", "SSIM")
_SCORE = "held_out_PSNR"  #: the value that selects the best state
#: columns of the loss table: network, input of the network, and gain in PSNR of the network over
#: its input
COLUMNS = (
    *(f"held_out_{metric}{end}" for metric, end in product(_METRICS, ("", "_low", "_high"))),
    *(f"input_{metric}" for metric in _METRICS),
    *(f"gain_{_METRICS[0]}{end}" for end in ("", "_low", "_high")),
)
#: names of the metrics of the network and of its input, for one picture
_OF_PICTURE = tuple(f"{who}_{metric}" for who, metric in product(("held_out", "input"), _METRICS))


@dataclass(frozen=True)
class Split:
    """The photographs for training, and the held-out photographs."""

    trained: Photographs
    held_out: tuple[Path, ...] = ()  #: all held-out photographs, in the order of their digests
    judged: tuple[Path, ...] = ()  #: the first of these, which the validation restores

    def __str__(self) -> str:
        if not self.held_out:
            return (
                f"trains on {len(self.trained.paths)} photographs; none is held out, so that no"
                " state is the best"
            )
        text = f"trains on {len(self.trained.paths)} photographs; {len(self.held_out)} are held out"
        return (
            text
            if len(self.judged) == len(self.held_out)
            else f"{text}, of which {len(self.judged)} are restored"
        )


def split(recipe: Recipe, settings: Training, photographs: Photographs) -> Split:
    """Hold photographs out by the digest of their content, so that every process, stage and restart
    has the same split.

    Equal files stay together, whatever their names. Without a folder of photographs nothing is held
    out.

    Raises ValueError for a folder with fewer than two different photographs, unless
    ``train.held_out`` is null.
    """
    photographs = by_content(photographs)
    if not holds_out(settings):
        return Split(photographs)
    paths_by_digest = _by_digest(photographs.paths)
    if len(paths_by_digest) < 2:
        raise ValueError(_too_few(recipe, settings, len(photographs.paths)))
    assert settings.held_out is not None
    # at least one is held out, and at least one is trained on
    held_out_count = min(
        max(1, round(settings.held_out * len(paths_by_digest))), len(paths_by_digest) - 1
    )
    # the order of digests is random but the same everywhere
    held_out_groups = [
        paths_by_digest[digest] for digest in sorted(paths_by_digest)[:held_out_count]
    ]
    held_out = tuple(chain.from_iterable(held_out_groups))
    trained = _without(photographs, set(held_out))
    first_of_each = [paths[0] for paths in held_out_groups][: settings.held_out_pictures]
    judged = tuple(path for path in first_of_each if _readable(path, trained))
    return Split(trained, held_out, judged)


def _by_digest(paths: Iterable[Path]) -> dict[str, list[Path]]:
    """Return the paths of equal files by the digest of their content."""
    alike: dict[str, list[Path]] = {}
    for path in paths:
        alike.setdefault(file_digest(path), []).append(path)
    return alike


def _without(photographs: Photographs, away: Collection[Path]) -> Photographs:
    return replace(photographs, paths=tuple(path for path in photographs.paths if path not in away))


def by_content(photographs: Photographs) -> Photographs:
    """Return the photographs sorted by digest, so that random pictures do not depend on
    file names.
    """
    return replace(
        photographs,
        paths=tuple(sorted(photographs.paths, key=lambda path: (file_digest(path), path))),
    )


def holds_out(settings: Training) -> bool:
    """Return True if a training has a folder of photographs and holds out some of them."""
    return settings.photographs is not None and bool(settings.held_out)


def _readable(path: Path, photographs: Photographs) -> bool:
    """Return True if a photograph can be decoded; else record the reason in ``photographs``."""
    try:
        # decodes the whole file, whatever the size of the crop
        Photographs((path,)).crop((1, 1), 0, 0)
    except ValueError as error:
        photographs.broken[path] = str(error)
        return False
    return True


def _too_few(recipe: Recipe, settings: Training, count: int) -> str:
    """Return the error message for a folder with fewer than two different photographs."""
    setting = recipe.config.settings.get(f"{KEY}.photographs")
    folder_content = "1 photograph" if count == 1 else f"{count} photographs, all equal"
    return (
        f"{setting.source if setting else recipe.name}   {KEY}.photographs   the folder"
        f" {settings.photographs} holds {folder_content}, and {KEY}.held_out:"
        f" {settings.held_out} sets"
        f" photographs aside for the validation: add photographs, or write {KEY}.held_out=null"
    )


# --- validation -----------------------------------------------------------------------------------


class Validation:
    """The validation of a training: held-out pictures with fixed scenes, lasers and noise."""

    def __init__(self, split: Split, mesh: Mesh, device: str) -> None:
        self.photographs, self.mesh, self.device = split.judged, mesh, device
        self._kept: dict[int, Sample] | None = None

    @torch.no_grad()
    def __call__(self, net: nn.Module, samples: Samples, shared: Shared, fixed: bool) -> Losses:
        """Return means over the held-out photographs with their intervals, by column of the loss
        table.

        Pictures behind a ``fixed`` mask are computed once and kept in main memory.
        """
        was_training = net.training
        net.eval()
        numbers: dict[str, float] = {}
        for i, sample in self._pictures(samples, shared, fixed):
            picture = sample.picture.to(self.device)
            truth = sample.truth.to(self.device)
            for source, estimate in (("held_out", net(picture, *sample.given)), ("input", picture)):
                # name format for `means_by_photograph` and `summary`: picture number, space, column
                numbers |= {
                    f"{i} {source}_{name}": x for name, x in _quality(estimate, truth).items()
                }
        net.train(was_training)
        repeats, count = samples.repeats, len(self.photographs)
        names = [f"{i} {name}" for i, name in product(range(count * repeats), _OF_PICTURE)]
        return summary(
            means_by_photograph(self.mesh.numbers(numbers, names, self.device), repeats), count
        )

    def _pictures(
        self, samples: Samples, shared: Shared, fixed: bool
    ) -> Iterator[tuple[int, Sample]]:
        """Yield number and sample of each held-out picture of this process.

        Behind a fixed mask the pictures never change, and are kept after the first time.
        """
        # empty in a process without a picture, which must not wait for others
        if fixed and self._kept is not None:
            yield from self._kept.items()
            return
        pictures: dict[int, Sample] = {}
        for i, sample in samples.batch(
            shared, HELD_OUT, 0, len(self.photographs) * samples.repeats
        ):
            if fixed:
                pictures[i] = replace(
                    sample, picture=sample.picture.cpu(), truth=sample.truth.cpu()
                )
            yield i, sample
        self._kept = pictures if fixed else None


def means_by_photograph(numbers: Mapping[str, float], repeats: int) -> dict[str, float]:
    """Return the means over the ``repeats`` pictures of each photograph; names are such as ``0
    held_out_PSNR``.
    """
    means: dict[str, float] = {}
    for name, value in numbers.items():
        number, _, column = name.partition(" ")
        photograph_column = f"{int(number) // repeats} {column}"
        means[photograph_column] = means.get(photograph_column, 0.0) + value / repeats
    return means


def _quality(estimate: Tensor, truth: Tensor) -> dict[str, float]:
    """Return PSNR, L1 and SSIM, each a mean over the pictures (n, 3, y, x) of one photograph."""
    qualities = [
        metrics.quality(estimated.float(), true.float())
        for estimated, true in zip(estimate, truth, strict=True)
    ]
    return {
        name: sum(float(getattr(quality, name.lower())) for quality in qualities) / len(qualities)
        for name in _METRICS
    }


def summary(numbers: Mapping[str, float], count: int) -> Losses:
    """Return means and intervals over ``count`` photographs; names are such as ``0
    held_out_PSNR``.
    """
    values_by_column = {
        name: [numbers[f"{i} {name}"] for i in range(count)] for name in _OF_PICTURE
    }
    restored_and_given = zip(
        values_by_column["held_out_PSNR"], values_by_column["input_PSNR"], strict=True
    )
    values_by_column["gain_PSNR"] = [
        restored - input_psnr for restored, input_psnr in restored_and_given
    ]
    result: Losses = {}
    for name, values in values_by_column.items():
        mean, interval_low, interval_high = interval(values)
        result[name] = mean
        if f"{name}_low" in COLUMNS and count > 1:
            result |= {f"{name}_low": interval_low, f"{name}_high": interval_high}
    return result


def interval(values: Sequence[float]) -> tuple[float, float, float]:
    """Return the mean of independent numbers and its 90 % interval by Student's t distribution; NaN
    for a single number.
    """
    x = np.asarray(values, dtype=np.float64)
    if len(x) < 2:
        return float(x.mean()), math.nan, math.nan
    from scipy.stats import t

    # quantile of Student's t times the standard error of the mean
    half_width = (
        float(t.ppf((1 + CONFIDENCE) / 2, len(x) - 1)) * float(x.std(ddof=1)) / math.sqrt(len(x))
    )
    return float(x.mean()), float(x.mean()) - half_width, float(x.mean()) + half_width


# --- the best state -------------------------------------------------------------------------------


@dataclass(frozen=True)
class Best:
    """The best state of a stage so far, by the mean PSNR of the held-out pictures."""

    score: float = -math.inf
    iterations: int = 0  #: number of iterations of the stage up to this state
    since: int = 0  #: number of validations after this state

    @classmethod
    def of(cls, rows: Sequence[Mapping[str, str]], stage: int) -> Best:
        """Return the best state of a stage from the rows of the loss table."""
        best = cls()
        for row in rows:
            if row["stage"] == str(stage) and row.get(_SCORE):
                # the table counts iterations from 0
                best = best.after(float(row[_SCORE]), int(row["iteration"]) + 1)
        return best

    def after(self, score: float, iterations: int) -> Best:
        """Return the best state after one more validation."""
        if score > self.score:
            return Best(score, iterations)
        return replace(self, since=self.since + 1)


def facts(parts: Split, rows: Sequence[Mapping[str, str]], patience: int | None) -> dict[str, Any]:
    """Return the entries of `training.json` on the held-out photographs, the best state and the end
    of stage 2.
    """
    held_out_facts = {
        "held_out": [str(path) for path in parts.held_out],
        "judged": len(parts.judged),
    }
    best = Best.of(rows, 2)
    if not best.iterations:
        return held_out_facts
    rows_of_stage = [row for row in rows if row["stage"] == "2"]
    row = next(row for row in rows_of_stage if int(row["iteration"]) + 1 == best.iterations)
    numbers = {name: float(row[name]) for name in COLUMNS if row.get(name)}
    stopped_early = patience is not None and best.since >= patience
    return {
        **held_out_facts,
        "best": {"iterations": best.iterations, **numbers},
        "stopped_early": stopped_early,
    }


def score_of(losses: Losses) -> float:
    """Return the value that selects the best state, rounded as in the loss table."""
    return float(f"{losses[_SCORE]:.6g}")


def validation_line(losses: Losses, better: bool) -> str:
    """Return one line of text about a validation."""

    def shown(name: str) -> str:
        interval_text = (
            f" ({losses[f'{name}_low']:.2f} to {losses[f'{name}_high']:.2f})"
            if f"{name}_low" in losses
            else ""
        )
        return f"{losses[name]:.2f} dB{interval_text}"

    text = (
        f"held-out PSNR {shown('held_out_PSNR')}, input {losses['input_PSNR']:.2f} dB, gain"
        f" {shown('gain_PSNR')}"
    )
    return f"{text}, the best so far" if better else text
