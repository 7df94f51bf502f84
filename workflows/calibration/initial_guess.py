"""Where the search for the highest posterior begins: at what the levels say by themselves."""

from __future__ import annotations

from typing import TYPE_CHECKING

import numpy as np
import torch

from neusee.nodes.calibrate import guess, guess_camera
from neusee.nodes.values import Levels
from neusee.workflows.calibration.log_posterior import SensorPosterior

if TYPE_CHECKING:
    from neusee.workflows.calibration.log_posterior import Places

_NARROWER = 0.5 ** np.arange(1, 12)


def begin(problem: SensorPosterior) -> Places:
    """A place where the posterior is not none: the guess, or on the way from it to the middle of the prior.

    Raises ValueError where there is none on that way.
    """
    coordinates = problem.coordinates
    middle = coordinates.from_whitened(torch.zeros(len(problem.names), dtype=torch.float64))
    believed = {**coordinates.held, **{name: float(x) for name, x in middle.items()}}
    params = problem.recipe.steps[problem.step].params
    levels = problem.levels
    guessed = guess_camera(levels, believed, params) if isinstance(levels, Levels) else guess(levels, believed, params)
    first, last = (problem.place({name: x[name] for name in problem.names}) for x in (guessed, believed))
    places = np.stack([first, *(last + (first - last) * share for share in _NARROWER), last])
    alive = np.isfinite(problem.log_posterior(places))
    if not alive.any():
        raise ValueError(
            "no sensor that was believed possible gives these numbers: compare rounding, bits and the priors with the "
            "camera, and see what least_squares says"
        )
    found: Places = places[int(alive.argmax())]
    return found
