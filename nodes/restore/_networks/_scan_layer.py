"""Trainable layers for selective scans, with the initial values of their time steps and decay rates."""

import math
from typing import Literal

import torch
from torch import Tensor, nn
from torch.nn import functional as F

from neusee.nodes._half_precision import single
from neusee.nodes.restore._scan._one_decay_scan import dual_scan
from neusee.nodes.restore._scan._selective_scan import selective_scan

Kind = Literal["s6", "ssd"]  #: s6: a decay for each channel and state; ssd: a decay for each head
HEAD = 16  #: channels that share a decay
STEPS = (1e-3, 0.1)  #: range of the first steps of a scan, log-uniform: a memory of ten to a thousand positions


class Scan(nn.Module):
    """A selective scan along a sequence (n, length, channel), with step, input and output weights from the sequence."""

    def __init__(self, channels: int, states: int, rank: int) -> None:
        super().__init__()
        self.sizes = [rank, states, states]
        self.read = nn.Linear(channels, sum(self.sizes), bias=False)
        self.rate = nn.Linear(rank, channels, bias=False)
        self.dt_bias = nn.Parameter(torch.empty(channels))
        self.A_log = nn.Parameter(torch.empty(channels, states))
        self.D = nn.Parameter(torch.empty(channels))

    def start(self, rng: torch.Generator) -> None:
        """Set random time steps and fixed decay rates for the start of training.

        Zero biases would give a memory of one position.
        """
        self.dt_bias.copy_(_first_steps(len(self.D), rng))
        self.A_log.copy_(torch.arange(1.0, 1.0 + self.A_log.shape[1], device=rng.device).log().expand_as(self.A_log))
        self.D.fill_(1.0)

    def forward(self, u: Tensor) -> Tensor:
        rate, into, out = self.read(u).split(self.sizes, -1)
        rate = single(self.rate(rate))
        with torch.autocast(u.device.type, enabled=False):
            u, step, decay = single(u), _step(rate, self.dt_bias), _decay(self.A_log)
            return selective_scan(u, step, decay, single(into), single(out), self.D).to(u.dtype)


class DualScan(nn.Module):
    """A selective scan with one step and one decay rate for each head of channels, computed by matrix products."""

    def __init__(self, channels: int, states: int, rank: int) -> None:
        super().__init__()
        heads = channels // math.gcd(channels, HEAD)
        self.sizes = [heads, states, states]
        self.read = nn.Linear(channels, sum(self.sizes), bias=False)
        self.dt_bias, self.A_log, self.D = (nn.Parameter(torch.empty(heads)) for _ in range(3))

    def start(self, rng: torch.Generator) -> None:
        """Set random time steps for the start of training, and random decay rates from 1 to 16, the range of `Scan`."""
        self.dt_bias.copy_(_first_steps(len(self.D), rng))
        self.A_log.uniform_(1.0, 16.0, generator=rng).log_()
        self.D.fill_(1.0)

    def forward(self, u: Tensor) -> Tensor:
        rate, into, out = (single(part) for part in self.read(u).split(self.sizes, -1))
        with torch.autocast(u.device.type, enabled=False):
            return dual_scan(single(u), _step(rate, self.dt_bias), _decay(self.A_log), into, out, self.D)


class BothWays(nn.Module):
    """The sum of a forward and a backward selective scan, each with its own weights."""

    def __init__(self, channels: int, states: int, rank: int, kind: Kind = "s6") -> None:
        super().__init__()
        make = Scan if kind == "s6" else DualScan
        self.there, self.back = (make(channels, states, rank) for _ in range(2))

    def forward(self, u: Tensor) -> Tensor:
        result: Tensor = self.there(u) + self.back(u.flip(1)).flip(1)
        return result


def _first_steps(count: int, rng: torch.Generator) -> Tensor:
    """Return random biases that softplus turns into time steps, log-uniform within the range `STEPS`."""
    low, high = map(math.log, STEPS)
    steps = torch.rand(count, generator=rng, device=rng.device).mul_(high - low).add_(low).exp_()
    return steps + torch.log(-torch.expm1(-steps))


def _step(rate: Tensor, bias: Tensor) -> Tensor:
    return F.softplus(rate + bias).clamp(1e-5, 8.0)


def _decay(A_log: Tensor) -> Tensor:
    return -torch.exp(A_log.clamp(-12.0, 6.0))
