"""How quickly a sensor's posterior is drawn: `python tests/benchmarks/bench_calibrate.py`.

Both modes, in one process: the recipe `calibrate` (15 levels of 2 x 256 x 256 pixels) and the
recipe `calibrate_camera` (32 levels of a real camera):

- the likelihood of 64 sensors at once, against that of one summed pixel by pixel (float64, each
  pixel's own cell);
- effective draws (ArviZ, bulk, the least of all coordinates) a second of processor time: `neusee
  calibrate` from the search on, with the density that guides its walkers, against numpyro's NUTS
  with a likelihood of its own in JAX and float64, whitened at the mode, with warm-up and without
  compilation; NUTS in mode density without the saturated level, where the likelihood has no slope,
  and neusee then too; each of the two has 10 000 effective draws or more;
- the largest difference of the means, in standard deviations, and of the standard deviations.
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

from neusee.nodes.calibrate import log_cell
from neusee.workflows.calibration import emcee_sampler
from neusee.workflows.calibration.log_posterior import SensorPosterior, search_mode
from neusee.workflows.calibration.posterior_checks import importance_samples
from neusee.workflows.engine.runner import run
from neusee.workflows.recipe.loading import load
from neusee.workflows.store.result_store import Store

jax.config.update("jax_enable_x64", True)
# NUTS has no slope where the converter cuts a level off: both then know five parameters
LIT = "~levels.full"


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
            dark, lit = (
                p["dark_current"] * step["exposure"] / 0.1,
                p["quantum_efficiency"] * step["photons"],
            )
            numbers = (
                k * (p["offset"] + dark + lit),
                k * (p["read_noise"] ** 2 + dark + lit) ** 0.5,
                k * p["full_well"],
            )
            log_cell(
                x, *(torch.tensor(n, dtype=torch.float64) for n in numbers), "nearest", 65535
            ).sum()

    return median(once), sum(len(x) for x in pixels)


def density_target(problem):
    """The log posterior of a sensor whose pixels are alike, of the coordinates of
    `calibrate.prior`.
    """
    photons, exposure, n, mean, variance, nu = (jnp.asarray(x.numpy()) for x in problem.levels[:6])
    prior = [
        jnp.asarray(x[problem.coordinates.prior.width.isfinite()].numpy())
        for x in problem.coordinates.prior[:2]
    ]

    def log(theta):
        a, b, s, d, w, q = theta
        k = jnp.exp(a)
        m, v = b + jnp.exp(d) * exposure / 0.1 + jnp.exp(q) * photons, jnp.exp(2 * s) + 1.0 / 12.0
        v = v + k * (jnp.exp(d) * exposure / 0.1 + jnp.exp(q) * photons)
        told = -0.5 * jnp.sum((nu + 1) * jnp.log(v) + nu * variance / v + n * (mean - m) ** 2 / v)
        free = jnp.array([-a, b / k, s - a, d - a, w - a, q - a])
        free = free.at[0].set(a)
        below = jnp.sum(n * jax.scipy.special.log_ndtr((jnp.exp(w) - m) / jnp.sqrt(v)))
        return told + below - 0.5 * jnp.sum(((free - prior[0]) / prior[1]) ** 2) - a

    return log


def camera_target(problem):
    """The log posterior of a real camera, of the coordinates of `calibrate.camera_prior`."""
    levels = [x.numpy() for x in problem.levels[:6]]
    signal = (
        levels[3] - levels[3][(levels[0] == 0) & (levels[1] == levels[1][levels[0] == 0].min())][0]
    )
    lit = levels[0] > 0
    used = ~lit | (signal <= 0.7 * signal[lit][levels[4][lit].argmax()])
    used &= ~np.isin(np.arange(len(lit)), problem.levels.cell_level.numpy())
    top, first = signal[used].max(), levels[1][~lit].min()
    photons, exposure, n, mean, variance, nu = (jnp.asarray(x[used]) for x in levels)
    centre, width = (jnp.asarray(x.numpy()) for x in problem.coordinates.prior[:2])

    def log(theta):
        k, q, noise, current, scatter, lamp, drift = (
            jnp.exp(theta[i]) for i in (0, 1, 3, 4, 5, 6, 7)
        )
        b, t = theta[8], theta[9]
        y = mean - theta[2]
        x = y / top
        curve = 1 + b * x + t * x**2
        e = y / (k * curve)
        slope = k * curve**2 / (curve - x * (b + 2 * t * x))
        v = slope**2 * (noise**2 + e) + 1 / 12
        light = q * photons
        wide = 2 / nu + scatter**2
        off = jnp.log(variance) - jnp.log(v) + 1 / nu
        error = variance / n + drift**2 + (lamp * light * slope) ** 2
        away = (e - light - current * (exposure - first)) * slope
        told = -0.5 * jnp.sum(off**2 / wide + jnp.log(wide) + away**2 / error + jnp.log(error))
        return told - 0.5 * jnp.sum(((theta - centre) / width) ** 2)

    return log


def nuts(problem, best, target, draws, warmup=1000, chains=4):
    """Draws (chain, draw, free) by numpyro, and the seconds of processor time with and without
    compilation.
    """
    values, vectors = np.linalg.eigh(best.covariance)
    root, middle = jnp.asarray(vectors * np.sqrt(values)), jnp.asarray(best.theta)
    at = best.theta + 0.3 * best.covariance.diagonal() ** 0.5 * np.random.default_rng(
        0
    ).standard_normal((3, len(middle)))
    ours = problem.log_posterior(at)
    theirs = np.array([float(target(jnp.asarray(x))) for x in at])
    assert np.ptp(theirs - ours) < 1e-6, f"not the same posterior: {theirs - ours}"

    def potential(z):
        return -target(middle + root @ z)

    sampler = MCMC(
        NUTS(potential_fn=potential, target_accept_prob=0.9),
        num_warmup=warmup,
        num_samples=draws,
        num_chains=chains,
        chain_method="vectorized",
        progress_bar=False,
    )
    seconds = []
    for seed in (1, 2):
        began = time.process_time()
        sampler.run(jax.random.PRNGKey(seed), init_params=jnp.zeros((chains, len(middle))))
        samples = (
            np.asarray(sampler.get_samples(group_by_chain=True)) @ np.asarray(root).T + best.theta
        )
        seconds.append(time.process_time() - began)
    return samples, *seconds


def ours(problem):
    """Draws (chain, draw, free) as `neusee calibrate` makes them, and their seconds of processor
    time.
    """
    began = time.process_time()
    best = search_mode(problem)
    law = importance_samples(problem, best, 7)
    with tempfile.TemporaryDirectory() as folder:
        chains = emcee_sampler.sample(
            problem, best, Path(folder) / "c.h5", emcee_sampler.Sampling(seed=7), guide=law.guide
        )
    seconds = time.process_time() - began
    walkers = chains.draws.transpose(0, 2, 1, 3)
    return walkers.reshape(-1, *walkers.shape[2:]), seconds, chains


def worth(samples):
    """The least effective sample size of all coordinates."""
    return min(float(arviz.ess(samples[..., i], method="bulk")) for i in range(samples.shape[-1]))


def beside_nuts(mode, problem, target, draws):
    mine, seconds, chains = ours(problem)
    theirs, first, again = nuts(problem, search_mode(problem), target, draws)
    rows = [
        ("neusee", mine, seconds),
        ("numpyro NUTS", theirs, again),
        ("numpyro NUTS, with compilation", theirs, first),
    ]
    rates = []
    for name, samples, spent in rows:
        rates.append(worth(samples) / spent)
        print(
            f"| {mode} | {name} | {worth(samples):.0f} | {spent:.2f} | {rates[-1]:.0f} |",
            flush=True,
        )
    a, b = (x.reshape(-1, x.shape[-1]) for x in (mine, theirs))
    off, ratio = np.abs(a.mean(0) - b.mean(0)) / b.std(0), a.std(0) / b.std(0)
    print(f"\nmode {mode}: processor time of an effective draw, NUTS over neusee {rates[0] / rates[1]:.1f}; tau "
          f"{chains.tau:.1f} of {chains.steps} steps; means within {off.max():.3f} sd, standard "
          "deviations within "
          f"{np.abs(ratio - 1).max():.1%}\n", flush=True)  # fmt: skip


def main():
    warnings.simplefilter("ignore")
    numpyro.set_host_device_count(1)
    torch.set_num_threads(1)
    with tempfile.TemporaryDirectory() as folder:
        store = Store(Path(folder))
        problem = SensorPosterior.of(load("calibrate"), store)
        best = search_mode(problem)
        samples = best.draw(64, np.random.default_rng(0))
        vector = median(lambda: [problem.log_posterior(samples) for _ in range(100)]) / 6400
        pixel, count = by_pixel(problem, store, problem.parameters(best.theta))
        print(
            f"likelihood of a sensor, 64 at once: {1e6 * vector:.1f} us; of {count} pixels one by"
            f" one: {pixel:.3f} s,"
        )
        print(f"ratio {pixel / vector:.0f}\n")
        head = (
            "| mode | method | effective draws | processor s | draws / s |\n|---|---|---|---|---|"
        )
        print(head)
        camera = SensorPosterior.of(load("calibrate_camera"), store)
        beside_nuts("camera", camera, camera_target(camera), draws=6500)
        print(head)
        lit = SensorPosterior.of(load("calibrate", [LIT]), store)
        beside_nuts("density", lit, density_target(lit), draws=15000)


if __name__ == "__main__":
    main()
