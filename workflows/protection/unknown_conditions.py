"""What nobody knows of an attack before it comes, as probability distributions, and one sampler of
all of them.

Studies and trainings draw the same conditions for the same seed: the wavelength and the direction
of the laser, the defocus of the lens, the grease on the window, and the light that the lens
scatters. A study draws a list, and a training draws by the same `draw_laws` how the camera of one
picture differs from what its restorer is told.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import asdict, dataclass

from neusee.nodes.flare import surface_of
from neusee.workflows.recipe.distributions.law_text import read_law
from neusee.workflows.recipe.distributions.shapes import draw_laws

_MOST_SCATTER = 0.99  #: share of the light; a lens that scatters all light has no picture


@dataclass(frozen=True)
class UnknownLaws:
    """The distributions of the unknown conditions, each as text such as ``normal(0 waves, 0.25
    waves)``.
    """

    wavelength: str = "uniform(400 nm, 700 nm)"  #: of the laser
    direction_y: str = "uniform(-0.25, 0.25)"  #: of the laser, in fields from the middle
    direction_x: str = "uniform(-0.25, 0.25)"
    defocus: str = "normal(0 waves, 0.25 waves)"  #: of the lens, peak to valley at 550 nm
    #: on the window, root mean square at 550 nm
    grease: str = "loguniform(0.005 waves, 0.05 waves)"
    scatter: str = "lognormal(0.005, 2)"  #: share of the light that the lens scatters


@dataclass(frozen=True)
class Condition:
    """One draw of the unknown conditions, in SI units."""

    wavelength: float  #: m
    direction: tuple[float, float]  #: fields from the middle, (y, x)
    defocus: float  #: waves at 550 nm
    grease: float  #: waves at 550 nm
    scatter: float  #: share of the light
    seed: int  #: of the pattern of the grease

    @property
    def surfaces(self) -> dict[str, dict[str, float]]:
        """Return the parameter ``surfaces`` of `flare.stray_light` for a lens that scatters this
        share of the light.
        """
        return {"lens": surface_of(self.scatter)}

    @property
    def plain(self) -> dict[str, float | list[float]]:
        """Return the condition as a JSON value."""
        return {**asdict(self), "direction": list(self.direction)}


def draw_conditions(
    count: int, seed: int, laws: UnknownLaws | None = None, first: int = 0
) -> list[Condition]:
    """Return ``count`` independent draws of the conditions, from the number ``first`` on.

    The draw of a number depends only on the seed and the laws, so that a larger ``count`` begins
    with the same draws.
    """
    texts: Mapping[str, str] = asdict(laws or UnknownLaws())
    columns = draw_laws(
        {name: read_law(text) for name, text in texts.items()}, count, [seed, 4], first
    )
    return [
        Condition(
            wavelength=columns["wavelength"][draw],
            direction=(columns["direction_y"][draw], columns["direction_x"][draw]),
            defocus=columns["defocus"][draw],
            grease=columns["grease"][draw],
            scatter=min(columns["scatter"][draw], _MOST_SCATTER),
            seed=seed + first + draw,
        )
        for draw in range(count)
    ]


def usual_condition(laws: UnknownLaws | None = None) -> Condition:
    """Return the condition with every value at its median, and a clean window."""
    texts: Mapping[str, str] = asdict(laws or UnknownLaws())
    medians = {name: read_law(text).median for name, text in texts.items()}
    return Condition(medians["wavelength"], (0.0, 0.0), 0.0, 0.0, medians["scatter"], 0)
