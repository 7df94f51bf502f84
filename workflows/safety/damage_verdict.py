"""The verdict of damage behind each protection: one state, one sentence, and a row for each part of the light."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from typing import TYPE_CHECKING

from neusee.nodes.laser import DamagePart, State, state_of, worst_state
from neusee.workflows.recipe.blocks.safety_block import Safety
from neusee.workflows.safety.exposures import Exposures, Option
from neusee.workflows.safety.sensor_limits import limit_parts
from neusee.workflows.safety.uncertain_values import SettingDraws

if TYPE_CHECKING:
    from neusee.workflows.safety.safety_estimate import Finding

_ALIKE = 0.98  #: share of the largest ratio from which a simpler part is named in its place
_CONTINUOUS = ("pulse", "mean", "accumulation")


@dataclass(frozen=True)
class DamageRow:
    """What is said of one part of the light: where it is beside its threshold, or why no law judges it."""

    part: str  #: pulse, mean, accumulation or incubation
    kind: str  #: of damage
    state: State
    reason: str  #: why the part is not judged; empty for a part that is
    finding: Finding | None  #: of the limit of this part; None: not judged

    @property
    def ratio(self) -> float:
        """Return the exposure over the threshold; 0 for a part without a threshold."""
        return 0.0 if self.finding is None else self.finding.ratio


@dataclass(frozen=True)
class DamageVerdict:
    """Whether a laser damages the sensor behind one protection, at the distance of the recipe."""

    option: str
    state: State
    rows: tuple[DamageRow, ...]

    @property
    def nearest(self) -> DamageRow | None:
        """Return the row that the verdict names: of its state, the largest ratio; None if no law judges any row.

        A verdict that is not judged names the largest ratio of what is judged. Incubation is an assumption: it is
        named only where no other part has the state of the verdict.
        """
        candidates = self._candidates()
        largest = max((row.ratio for row in candidates), default=0.0)
        return next((row for row in candidates if row.ratio >= _ALIKE * largest), None)

    def _candidates(self) -> list[DamageRow]:
        """Return the rows of which the verdict names one."""
        rows = [row for row in self.with_limit if row.state == self.state]
        if self.state == "not judged":
            rows = [row for row in self.with_limit if row not in self.unjudged] or rows
        return rows if self.state == "below" else _measured(rows) or rows

    @property
    def with_limit(self) -> tuple[DamageRow, ...]:
        """Return the rows that have a limit."""
        return tuple(row for row in self.rows if row.finding is not None)

    @property
    def unjudged(self) -> tuple[DamageRow, ...]:
        """Return the rows that are not judged."""
        return tuple(row for row in self.rows if row.state == "not judged")


def _measured(rows: Sequence[DamageRow]) -> list[DamageRow]:
    """Return the rows without those of the incubation, which is an assumption."""
    return [row for row in rows if row.part != "incubation"]


def damage_verdicts(
    safety: Safety,
    options: Sequence[Option],
    exposures: Exposures,
    draws: SettingDraws,
    findings: Sequence[Finding],
) -> Iterator[DamageVerdict]:
    """Yield the verdict of damage behind each option; none if damage is not asked for."""
    for option in options:
        parts = limit_parts(safety, option, exposures, draws)
        judged = [each for each in findings if each.option == option.name and each.limit.effect == "damage"]
        rows = tuple(_rows(parts, judged, continuous=not exposures.beams[0].is_pulsed))
        if rows:
            yield DamageVerdict(option.name, worst_state(row.state for row in rows), rows)


def _rows(parts: Sequence[DamagePart], findings: Sequence[Finding], continuous: bool) -> Iterator[DamageRow]:
    """Yield the row of each part; the findings are those of the parts with a threshold, in their order."""
    waiting = iter(findings)
    for part in parts:
        finding = next(waiting) if part.threshold is not None else None
        state: State = "not judged" if finding is None else state_of_finding(finding)
        reason = part.reason if state == "not judged" else ""
        for name in _CONTINUOUS if continuous else (part.part,):
            yield DamageRow(name, part.kind, state, reason, finding)


def state_of_finding(finding: Finding) -> State:
    """Return where the exposure at the distance of the recipe is beside a limit of damage, with what is uncertain."""
    assert finding.ratios is not None
    return state_of(finding.ratios.low, finding.ratios.high, finding.limit.open_below)
