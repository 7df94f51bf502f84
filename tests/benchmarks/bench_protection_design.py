"""Masks designed for a picture behind a peak limit: `bench_protection_design.py [STEPS] [STARTS]` (200 5).

One wavelength (550 nm), the lens of the paper (8.08 mm, f = 110 mm) on a pupil of 128 samples, pixels of 2.9 um, window
of 330 pixels, read noise 10.5 e-. A height for each sample of the pupil is optimised by Adam on `losses.filtered_error`
with the peak limit L, from cubic, vortex, axicon, half-ring and random phases. The gain in dB is over the best round
stop with a grey filter at the same L, in the same error; L is that of the brightest pixel. A table in Markdown.
"""

import math
import sys

import torch

from neusee.nodes import losses
from neusee.nodes.values import Bands, Psf

SAMPLES, WINDOW, READ = 128, 330, 10.5
ONE = torch.ones(1, dtype=torch.float64)
GREY = (ONE, ONE[None], Bands(550e-9 * ONE, 1e-8 * ONE, ONE))
LIMITS, LIGHTS = (3e-2, 1e-2, 1e-3), (10.0, 30.0, 100.0, 300.0, 1000.0)


def grid():
    at = (torch.arange(SAMPLES, dtype=torch.float64) - (SAMPLES - 1) / 2) / (SAMPLES / 2)
    v, u = at[:, None].expand(SAMPLES, SAMPLES), at[None].expand(SAMPLES, SAMPLES)
    return v, u, (v.square() + u.square() <= 1).double()


V, U, CLEAR = grid()
PLAIN = float(CLEAR.sum()) / WINDOW**2  # the light in the brightest pixel of the clear lens


def psf_of(turns):
    """The PSF of a phase in turns, on pixels of 2.905 um."""
    wide = torch.zeros(WINDOW, WINDOW, dtype=torch.complex128)
    wide[:SAMPLES, :SAMPLES] = CLEAR * torch.exp(2j * math.pi * turns)
    field = torch.fft.fftshift(torch.fft.fft2(wide)) / WINDOW
    return Psf((field.abs().square() / CLEAR.sum())[None], PLAIN * ONE)


def starts(count):
    """Phases in turns that spread light in several ways, steeper for a lower limit."""
    rng = torch.Generator().manual_seed(0)
    r, angle = torch.hypot(V, U), torch.atan2(V, U)
    rough = torch.nn.functional.interpolate(
        torch.randn(1, 1, 12, 12, dtype=torch.float64, generator=rng), SAMPLES, mode="bicubic"
    )[0, 0]
    shapes = [lambda a: a * 2 * (V**3 + U**3), lambda a: angle * a / math.pi, lambda a: a * r,
              lambda a: a * r * torch.sign(U), lambda a: a * 0.5 * rough]  # fmt: skip
    return shapes[:count]


def designed(limit, light, steps, count):
    """The least exact error of several starts."""
    how = {"light": light, "read_noise": READ, "limit": limit}
    found = []
    for shape in starts(count):
        turns = shape(1.0 if limit > 0.02 else 2.0 if limit > 5e-3 else 5.0).clone().requires_grad_()
        adam = torch.optim.Adam([turns], lr=0.02)
        for step in range(steps):
            for group in adam.param_groups:
                group["lr"] = 0.02 * 0.5 * (1 + math.cos(math.pi * step / steps))
            adam.zero_grad()
            losses.filtered_error(psf_of(turns), *GREY, **how, power=64).backward()
            adam.step()
        with torch.no_grad():
            found.append(float(losses.filtered_error(psf_of(turns.detach()), *GREY, **how)))
    return min(found)


def main(steps, count):
    print("| L | " + " | ".join(f"n = {light:g}" for light in LIGHTS) + " |\n|---|" + "---|" * len(LIGHTS))
    for limit in LIMITS:
        row = []
        for light in LIGHTS:
            plain = psf_of(torch.zeros(SAMPLES, SAMPLES, dtype=torch.float64))
            rival, _, _ = losses.best_stop(plain, *GREY, light=light, read_noise=READ, limit=limit)
            row.append(10 / math.log(10) * (rival - designed(limit, light, steps, count)))
        print(f"| {limit:g} | " + " | ".join(f"{gain:+.2f}" for gain in row) + " |", flush=True)


if __name__ == "__main__":
    main(*(int(x) for x in sys.argv[1:]), *(200, 5)[len(sys.argv) - 1 :])
