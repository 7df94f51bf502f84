"""How quickly a sensor's posterior is drawn: `python tests/benchmarks/bench_calibrate.py`.

The recipe `calibrate` (15 levels of 2 x 256 x 256 pixels, the paper's sensor) and its posterior, in one process:

- the likelihood of 64 sensors at once, against that of one summed pixel by pixel (float64, each pixel's own cell);
- draws that are as good as independent, by the longest autocorrelation time, a second of sampling: emcee as `neusee
  calibrate` runs it (its first round, four ensembles), against numpyro's NUTS on the same levels without the saturated
  one and the same coordinates, whitened at the peak, in JAX and float64, with and without its compilation.

Seconds are medians of three; those of NUTS are of one run.
"""

import os
import statistics
import tempfile
import time
import warnings
from pathlib import Path

os.environ.setdefault("JAX_PLATFORMS", "cpu")

import arviz
import jax
import jax.numpy as jnp
import numpy as np
import numpyro
import torch
from numpyro.infer import MCMC, NUTS

from neusee.nodes.calibrate._likelihood._quantised_gaussian import log_cell
from neusee.workflows.calibration import emcee_sampler
from neusee.workflows.calibration.log_posterior import SensorPosterior
from neusee.workflows.calibration.posterior_mode import find_mode, initial_theta
from neusee.workflows.engine.runner import run
from neusee.workflows.recipe.loading import load
from neusee.workflows.store.result_store import Store

jax.config.update("jax_enable_x64", True)
LIT = "~levels.full"  # NUTS has no slope where the converter cuts a level off: both then know five parameters


def median(function, times=3):
    found = []
    for _ in range(times):
        began = time.perf_counter()
        function()
        found.append(time.perf_counter() - began)
    return statistics.median(found)


def by_pixel(problem, store, parameters):
    """Seconds for one sensor, every pixel by its own cell."""
    recipe, p = problem.recipe, {name: float(x) for name, x in parameters.items()}
    names = [name for name in recipe.steps if name.startswith("exposed[")]
    frames = run(recipe, store, names)
    light = [recipe.steps[name].params for name in names]
    pixels = [frames[name].double().flatten() for name in names]
    k = p["gain"]

    def once():
        for x, step in zip(pixels, light, strict=True):
            dark, lit = p["dark_current"] * step["exposure"] / 0.1, p["quantum_efficiency"] * step["photons"]
            numbers = (
                k * (p["offset"] + dark + lit),
                k * (p["read_noise"] ** 2 + dark + lit) ** 0.5,
                k * p["full_well"],
            )
            log_cell(x, *(torch.tensor(n, dtype=torch.float64) for n in numbers), "nearest", 65535).sum()

    return median(once), sum(len(x) for x in pixels)


def nuts(problem, best, draws=1000, warmup=500, chains=4):
    """Independent draws, seconds with and without compilation."""
    levels = problem.levels
    photons, exposure, n, mean, variance, nu = (jnp.asarray(x.numpy()) for x in levels[:6])
    prior = [jnp.asarray(x[problem.coordinates.prior.width.isfinite()].numpy()) for x in problem.coordinates.prior[:2]]
    values, vectors = np.linalg.eigh(best.covariance)
    root, middle = jnp.asarray(vectors * np.sqrt(values)), jnp.asarray(best.theta)

    def log(z):
        a, b, s, d, w, q = middle + root @ z
        k = jnp.exp(a)
        m, v = b + jnp.exp(d) * exposure / 0.1 + jnp.exp(q) * photons, jnp.exp(2 * s) + 1.0 / 12.0
        v = v + k * (jnp.exp(d) * exposure / 0.1 + jnp.exp(q) * photons)
        told = -0.5 * jnp.sum((nu + 1) * jnp.log(v) + nu * variance / v + n * (mean - m) ** 2 / v)
        theta = jnp.array([-a, b / k, s - a, d - a, w - a, q - a])
        below = jnp.sum(n * jax.scipy.special.log_ndtr((jnp.exp(w) - m) / jnp.sqrt(v)))
        return told + below - 0.5 * jnp.sum(((theta - prior[0]) / prior[1]) ** 2) - a

    at = jnp.zeros(len(best.theta))
    ours = problem.log_posterior(np.stack([best.theta, best.theta + 0.01 * best.covariance.diagonal() ** 0.5]))
    step = jnp.linalg.solve(root, jnp.asarray(0.01 * best.covariance.diagonal() ** 0.5))
    assert abs(float(log(step) - log(at)) - (ours[1] - ours[0])) < 1e-6, "not the same posterior"

    def potential(z):
        return -log(z)

    def drawn():
        sampler = MCMC(
            NUTS(potential_fn=potential), num_warmup=warmup, num_samples=draws, num_chains=chains,
            chain_method="vectorized", progress_bar=False,
        )  # fmt: skip
        began = time.perf_counter()
        sampler.run(jax.random.PRNGKey(1), init_params=jnp.zeros((chains, len(best.theta))))
        samples = np.asarray(sampler.get_samples(group_by_chain=True)) @ np.asarray(root).T + best.theta
        return sampler, samples, time.perf_counter() - began

    sampler, samples, first = drawn()
    began = time.perf_counter()
    sampler.run(jax.random.PRNGKey(2), init_params=jnp.zeros((chains, len(best.theta))))
    np.asarray(sampler.get_samples())
    again = time.perf_counter() - began
    worth = min(float(arviz.ess(samples[..., i])) for i in range(samples.shape[-1]))
    return worth, first, again, samples


def ours(problem, best, how):
    """Draws of the first round of four ensembles of 64, and their seconds."""
    emcee_sampler._LONGEST, found = emcee_sampler._FIRST, []
    for _ in range(3):
        with tempfile.TemporaryDirectory() as folder:
            began = time.perf_counter()
            chains = emcee_sampler.sample(problem, best, Path(folder) / "c.h5", seed=7, how=how)
            found.append(time.perf_counter() - began)
    by_tau = chains.flat.shape[0] / chains.tau
    walkers = chains.draws.transpose(3, 0, 2, 1).reshape(chains.draws.shape[-1], -1, chains.draws.shape[1])
    by_arviz = min(float(arviz.ess(x)) for x in walkers)
    return min(by_tau, by_arviz), statistics.median(found), chains


def main():
    warnings.simplefilter("ignore")
    numpyro.set_host_device_count(1)
    with tempfile.TemporaryDirectory() as folder:
        store = Store(Path(folder))
        problem = SensorPosterior.of(load("calibrate"), store)
        best = find_mode(problem, initial_theta(problem))
        samples = best.draw(64, np.random.default_rng(0))
        vector = median(lambda: [problem.log_posterior(samples) for _ in range(100)]) / 6400
        pixel, count = by_pixel(problem, store, problem.parameters(best.theta))
        print(
            f"likelihood of a sensor, 64 at once: {1e6 * vector:.1f} us; of {count} pixels one by one: {pixel:.3f} s,"
        )
        print(f"ratio {pixel / vector:.0f}")
        print("| levels | method | independent draws | s | draws / s |\n|---|---|---|---|---|")
        for name in ("de", "stretch"):
            worth, seconds, _ = ours(problem, best, name)
            print(f"| 15 | emcee, {name} | {worth:.0f} | {seconds:.2f} | {worth / seconds:.0f} |", flush=True)
        lit = SensorPosterior.of(load("calibrate", [LIT]), store)
        best = find_mode(lit, initial_theta(lit))
        worth, seconds, chains = ours(lit, best, "de")
        print(f"| 14 | emcee, de | {worth:.0f} | {seconds:.2f} | {worth / seconds:.0f} |", flush=True)
        worth, first, again, other = nuts(lit, best)
        print(f"| 14 | numpyro NUTS, compiled before | {worth:.0f} | {again:.2f} | {worth / again:.0f} |")
        print(f"| 14 | numpyro NUTS, with compilation | {worth:.0f} | {first:.2f} | {worth / first:.0f} |")
        width = chains.flat.std(0) / other.reshape(-1, other.shape[-1]).std(0)
        print("standard deviations, emcee over NUTS:", " ".join(f"{x:.2f}" for x in width))


if __name__ == "__main__":
    main()
