"""Pictures of a training batch that go through the network together, and their results one by one."""

from __future__ import annotations

from collections.abc import Iterable, Iterator

import torch

from neusee.nodes.values import FilterFacts
from neusee.workflows.training.training_pictures import Sample


def together(pictures: Iterable[tuple[int, Sample]], whole: bool) -> Iterator[tuple[list[int], Sample]]:
    """Yield the pictures of a batch with their numbers: each alone, or if ``whole`` those of one size as one sample.

    A small picture leaves most of a GPU idle, so that sixteen take little longer there than one. On a processor each
    picture goes alone, so that one picture is in memory at a time.
    """
    if not whole:
        yield from (([number], sample) for number, sample in pictures)
        return
    alike: dict[object, dict[int, Sample]] = {}
    for number, sample in pictures:
        known = sample.given[0] if sample.given else None
        free = known is None or isinstance(known, FilterFacts)
        shapes = tuple((name, x.shape) for name, x in sample.tensors.items()) if free else number
        alike.setdefault(shapes, {})[number] = sample
    for group in alike.values():
        yield list(group), joined(list(group.values()))


def joined(samples: list[Sample]) -> Sample:
    """Return pictures of one size as one sample, whose maps beside the pictures have one axis more, the first."""
    first = samples[0]
    if len(samples) == 1:
        return first
    pictures, truths = (torch.cat([getattr(s, name) for s in samples]) for name in ("picture", "truth"))
    light = torch.stack([s.light for s in samples])
    if not first.given:
        return Sample(pictures, truths, light, first.drawn)
    facts = FilterFacts._make(map(torch.stack, zip(*(s.given[0] for s in samples if s.given), strict=True)))
    return Sample(pictures, truths, light, first.drawn, (facts, torch.stack([s.given[1] for s in samples if s.given])))


def noted(pictures: Iterable[tuple[int, Sample]], seen: list[Sample]) -> Iterator[tuple[int, Sample]]:
    """Yield numbered pictures as they come, and add each to ``seen``."""
    for number, sample in pictures:
        seen.append(sample)
        yield number, sample
