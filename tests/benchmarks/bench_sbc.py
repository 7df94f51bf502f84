"""Simulation-based calibration: `python tests/benchmarks/bench_sbc.py [SIMULATIONS] [MOVE] [OVERRIDES]`.

A table in Markdown of SIMULATIONS (1000) of the recipe `calibrate`: p of the ranks, coverage and z of each parameter,
with its bar, and the seconds of a simulation. MOVE is de, stretch, or snooker, which must fail. One thread; what was
stopped goes on where it is called again.
"""

import sys
from functools import partial
from statistics import median

import emcee
import torch

from neusee.workflows.calibration import emcee_sampler
from neusee.workflows.recipe.loading import load
from neusee.workflows.store.remote_store import open_store
from neusee.workflows.studies.calibration.independent_draws import walk_draws
from neusee.workflows.studies.calibration.rank_uniformity import rank_tests
from neusee.workflows.studies.calibration.simulated_sensors import SensorSimulator


def main(count=1000, move="de", *overrides):
    torch.set_num_threads(1)
    if move == "snooker":  # a planted fault, which `move` refuses
        emcee_sampler._MOVES[move] = emcee.moves.DESnookerMove
    simulator = SensorSimulator(load("calibrate", overrides), open_store(), 128, partial(walk_draws, how=move), move)
    found = [simulator.simulation(number) for number in range(int(count))]
    print("| parameter | p | at least | coverage | bar | z mean | z sd | |\n|---|---|---|---|---|---|---|---|")
    for v in rank_tests(found):
        held = "fails" if v.failed else "holds"
        print(
            f"| {v.name} | {v.p:.3f} | {v.least_p:.4f} | {v.coverage:.3f} | {v.bar[0]:.3f} to {v.bar[1]:.3f} "
            f"| {v.z_mean:+.2f} | {v.z_sd:.2f} | {held} |"
        )
    refused, short = sum(bool(s.refused) for s in found), sum(not s.refused and not s.independent for s in found)
    lost, taus = sum(s.stranded > 0 for s in found), [s.tau for s in found if not s.refused]
    print(
        f"\n{count} simulations, median {median(s.seconds for s in found):.2f} s each: {refused} refused, {short} too"
    )
    print(f"short, {lost} with lost walkers; tau {median(taus):.0f} steps, at most {max(taus):.0f}.")


if __name__ == "__main__":
    main(*sys.argv[1:])
