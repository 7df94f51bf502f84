"""Masks designed at equal peak of the laser, against the best stop with a filter:
`bench_mask_design.py FILE`.

    nice -n 10 python tests/benchmarks/bench_mask_design.py front.json 200 40    # steps, and minutes at most

Designs for each peak limit L, light of the scene and start: the shipped masks (each as free pixels,
from that of twelve strengths of the shape with the least loss), five random maps, a sum of Legendre
products, and a polynomial along one line. Each is designed with a grey filter, with a learnt stop
and a filter, and alone (its own peak is held at L by a penalty). Adam on `losses.filtered_error`;
defocus, wavelength and direction are drawn at each step. Each finished mask is judged by
`judged_masks.py`, which shares nothing with the loss, in 16 states that no step has seen. FILE
keeps each finished design, so that a stopped run goes on; tables in Markdown are printed from what
it holds.
"""

import json
import math
import sys
import time
from pathlib import Path

import judged_masks as judge
import torch
from mask_design_tables import points, summary
from torch import nn

from neusee.nodes import losses
from neusee.nodes.doe import LearntStop, Polynomials, Streak, wave_height
from neusee.nodes.values import Bands, Psf, Stop

LIMITS, LIGHTS = (3e-2, 1e-2, 1e-3), (10.0, 30.0, 100.0, 300.0, 1000.0)
WAYS = ("filter", "stop", "alone")
STRENGTHS = (0.15, 0.25, 0.4, 0.6, 0.8, 1.0, 1.3, 1.6, 2.0, 2.5, 3.2, 4.0)
DIAMETERS = (0.95, 0.7, 0.5, 0.35)
DECIBELS = 10 / math.log(10)
ONE = torch.ones(1, dtype=torch.float64)
STOP = Stop(
    torch.tensor(judge.SAMPLES),
    torch.tensor(judge.DIAMETER / judge.SAMPLES, dtype=torch.float64),
    torch.tensor(judge.DIAMETER, dtype=torch.float64),
)
CLEAR = torch.from_numpy(judge.CLEAR).float()
AT = (torch.arange(judge.SAMPLES) - (judge.SAMPLES - 1) / 2) / (judge.SAMPLES / 2)
V, U = AT[:, None].expand(judge.SAMPLES, -1), AT[None].expand(judge.SAMPLES, -1)
R, ANGLE = torch.hypot(V, U), torch.atan2(V, U)
FIFTHS = (5 * R.square()).floor().clamp(max=4)
SHIPPED = {
    "cubic": 4 * (V**3 + U**3),
    "axicon": 5 * R,
    "vortex": 4 * ANGLE / (2 * math.pi),
    "half-rings": (6 + 3 * FIFTHS) * (1 - 2 * (FIFTHS % 2)) * R * torch.sign(U),
}
CHANCE = tuple(f"chance {seed}" for seed in range(5))
FAMILIES = ("polynomial", "streak")
STARTS = (*SHIPPED, *CHANCE, *FAMILIES)
TELLING = ("chance 0", "cubic", "axicon", "half-rings", "polynomial", "streak", "chance 1")
TELLING_LIGHTS = (10.0, 100.0)


class Free(nn.Module):
    """A phase in turns for each sample of the pupil."""

    rate = 0.03

    def __init__(self, turns):
        super().__init__()
        self.turns = nn.Parameter(turns.clone())

    def forward(self):
        return self.turns


class Family(nn.Module):
    """A trainable height map of few numbers, as a phase in turns."""

    rate = 0.02

    def __init__(self, shape):
        super().__init__()
        self.shape = shape

    def forward(self):
        return self.shape(STOP) / wave_height("fused silica", judge.CENTRE)


def strongest(name, strength):
    """The trainable mask of a start at one strength."""
    if name in SHIPPED:
        return Free(strength * SHIPPED[name])
    kind, _, seed = name.partition(" ")
    rng = torch.Generator().manual_seed(int(seed or 0))
    if kind == "chance":
        rough = torch.randn(1, 1, 14, 14, generator=rng)
        return Free(
            strength * nn.functional.interpolate(rough, judge.SAMPLES, mode="bicubic")[0, 0]
        )
    how = (strength, judge.CENTRE, "fused silica", rng)
    return Family(Polynomials(8, *how) if kind == "polynomial" else Streak(12, *how))


def psf_of(turns, amplitude, state):
    """The PSF in a state, and its band, with a gradient: two products of matrices."""
    defocus, wavelength, *shift = state
    path = turns * (judge.index(wavelength) / judge.index(judge.CENTRE)) + defocus * R.square()
    field = torch.polar(amplitude, path * (2 * math.pi * judge.CENTRE / wavelength))
    scale = judge.DIAMETER / judge.SAMPLES * judge.PIXEL / (wavelength * judge.FOCAL)
    pixels = torch.arange(judge.WINDOW) - judge.WINDOW // 2
    each = [torch.outer(pixels - s, AT) * (-2 * math.pi * scale * judge.SAMPLES / 2) for s in shift]
    left, right = (torch.polar(torch.ones_like(angle), angle) for angle in each)
    wave = left @ field @ right.T
    light = (wave.real.square() + wave.imag.square()) * (scale**2 / CLEAR.square().sum())
    clear = scale**2 * float(CLEAR.sum() ** 2 / CLEAR.square().sum())
    return Psf(light[None], clear * ONE), Bands(wavelength * ONE, 1e-9 * ONE, ONE)


def drawn(seed, step):
    """Defocus, wavelength and direction of a step."""
    rng = torch.Generator().manual_seed(1_000_003 * seed + step)
    defocus = judge.DEFOCUS * float(torch.randn((), generator=rng))
    wavelength, *shift = (2 * torch.rand(3, generator=rng) - 1).tolist()
    return defocus, judge.CENTRE + judge.SPAN * wavelength, *(0.5 * s for s in shift)


def loss_of(turns, amplitude, state, limit, light, way):
    """The loss of a mask in a state; a mask that is alone pays for a peak above the limit."""
    psf, bands = psf_of(turns, amplitude, state)
    passed = (amplitude.double() * CLEAR).sum() / CLEAR.square().sum()
    how = {"light": light, "read_noise": judge.READ, "transmittance": passed}
    if way != "alone":
        return losses.filtered_error(psf, ONE, ONE[None], bands, **how, limit=limit, power=64)
    peak = losses.suppression_loss(psf, power=64.0, log=True)
    return losses.filtered_error(psf, ONE, ONE[None], bands, **how) + 3 * (
        peak - math.log(0.9 * limit)
    ).clamp_min(0)


def designed(limit, light, name, way, steps):
    """The phase in turns, the diameter of the stop and the loss in the nominal state."""
    nominal = (0.0, judge.CENTRE, 0.0, 0.0)
    with torch.no_grad():
        masks, rounds = [strongest(name, strength) for strength in STRENGTHS], [None]
        if way == "stop":
            rounds = [LearntStop(width) for width in DIAMETERS]
        choices = [
            (mask, one, CLEAR if one is None else CLEAR * one(STOP))
            for mask in masks
            for one in rounds
        ]
        mask, round_one, _ = min(
            choices, key=lambda c: float(loss_of(c[0](), c[2], nominal, limit, light, way))
        )
    groups = [{"params": mask.parameters(), "lr": mask.rate}]
    groups += [{"params": round_one.parameters(), "lr": 0.1}] if round_one else []
    adam = torch.optim.Adam(groups)
    fall = torch.optim.lr_scheduler.CosineAnnealingLR(adam, steps)
    for step in range(steps):
        adam.zero_grad()
        amplitude = CLEAR if round_one is None else CLEAR * round_one(STOP)
        loss_of(mask(), amplitude, drawn(STARTS.index(name), step), limit, light, way).backward()
        adam.step()
        fall.step()
    with torch.no_grad():
        amplitude = CLEAR if round_one is None else CLEAR * round_one(STOP)
        loss = float(loss_of(mask(), amplitude, nominal, limit, light, way))
        return (
            mask().double().numpy(),
            1.0 if round_one is None else float(round_one.diameter()),
            loss,
        )


def point(limit, light, name, way, steps, known):
    """A design and its judgement; ``known`` are the rivals that were found before."""
    begun = time.process_time()
    turns, width, loss = designed(limit, light, name, way, steps)
    spent = time.process_time() - begun
    front = judge.Judged(judge.opening(width), turns)
    error, filtered = front.behind(limit, light)
    if (limit, light) not in known:
        known[limit, light] = judge.rival(limit, light)
    best, stop, passed = known[limit, light]
    return {
        "gain": DECIBELS * math.log(best / error),
        "error": error,
        "rival": best,
        "rival stop": stop,
        "rival filter": passed,
        "lsr": front.lsr,
        "filter": filtered,
        "stop": width,
        "loss": loss,
        "loss as judged": loss_as_judged(turns, width, limit, light, front.lsr),
        "seconds": spent,
    }


def loss_as_judged(turns, width, limit, light, worst):
    """The loss in the states of the judge, behind the filter of the judge: where both disagree."""
    amplitude, each = torch.from_numpy(judge.opening(width)).float(), []
    for state in judge.draws():
        psf, bands = psf_of(torch.from_numpy(turns).float(), amplitude, tuple(state))
        own = float(psf.intensity.max() / psf.clear_peak[0])
        how = {"read_noise": judge.READ, "limit": min(1.0, min(1.0, limit / worst) * own)}
        passed = float(amplitude.square().sum() / CLEAR.square().sum())
        each.append(
            math.exp(
                losses.filtered_error(
                    psf, ONE, ONE[None], bands, light=light, transmittance=passed, **how
                )
            )
        )
    return sum(each) / len(each)


def order():
    """The designs, the more telling ones first: those with a filter, then some of the other
    ways, then the rest.
    """
    each = [
        (way, name, limit, light)
        for way in WAYS
        for name in STARTS
        for limit in LIMITS
        for light in LIGHTS
    ]
    first = [
        key
        for key in each
        if key[0] == "filter" and (key[1] not in CHANCE[2:] or key[3] in TELLING_LIGHTS)
    ]
    telling = [
        (way, name, limit, light)
        for limit in (1e-2, 3e-2, 1e-3)
        for name in TELLING
        for way in WAYS[1:]
        for light in TELLING_LIGHTS
    ]
    return list(dict.fromkeys([*first, *telling, *each]))


def main(file, steps, minutes):
    found, begun = json.loads(file.read_text()) if file.exists() else {}, time.time()
    known = {
        key[2:]: (one["rival"], one["rival stop"], one["rival filter"])
        for key, one in points(found).items()
    }
    for way, name, limit, light in order():
        key = f"{way}, {name}, {limit:g}, {light:g}, {steps}"
        if key in found:
            continue
        if time.time() > begun + 60 * minutes:
            break
        found[key] = point(limit, light, name, way, steps, known)
        file.with_suffix(".part").write_text(json.dumps(found, indent=0))
        file.with_suffix(".part").replace(file)
    print(summary(found))


if __name__ == "__main__":
    given = [int(x) for x in sys.argv[2:]]
    main(Path(sys.argv[1]), *given, *(200, 1440)[len(given) :])
