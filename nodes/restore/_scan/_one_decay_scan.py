"""The selective scan with one decay for each head, computed by matrix products of torch."""

import torch
from torch import Tensor
from torch.nn import functional as F


def dual_scan(u: Tensor, dt: Tensor, A: Tensor, B: Tensor, C: Tensor, D: Tensor, *, chunk: int = 32) -> Tensor:
    """Compute h = exp(dt A) h + dt B u, y = C h + D u along the length, where all channels of a head share dt and A.

    Within a chunk a matrix connects every position with all earlier positions; a state passes from chunk to chunk.
    Logarithms of decays are summed over each stretch separately, because a difference of running sums loses precision.

    Shapes: u (batch, length, head * channel), dt (batch, length, head), A and D (head,), B and C (batch, length, n)
            -> as u. In single precision at least.
    """
    heads, length = len(A), u.shape[1]
    more = -length % chunk  # padding without input and decay changes nothing
    x, step, into, out = (F.pad(v, (0, 0, 0, more)).view(len(v), -1, chunk, v.shape[-1]) for v in (u, dt, B, C))
    x = x.view(*x.shape[:3], heads, -1).movedim(-2, 2)  # batch, chunk, head, position, channel
    step = step.movedim(-1, 2)
    stretch = _stretches(step * A[:, None])
    fed = step[..., None] * x
    within = ((out @ into.mT)[:, :, None] * stretch.exp()) @ fed
    left = (into[:, :, None] * stretch[..., -1, :, None].exp()).mT @ fed
    from_start = (step * A[:, None]).cumsum(-1).exp()[..., None]
    handed = _handed_on(left, from_start[..., -1:, :])
    y: Tensor = within + (out[:, :, None] * from_start) @ handed + D[:, None, None] * x
    return y.movedim(2, -2).flatten(3).flatten(1, 2)[:, :length]


def _stretches(logs: Tensor) -> Tensor:
    """Return the sums (…, i, j) of ``logs`` over the positions j + 1 to i, or minus infinity if j is after i."""
    size = logs.shape[-1]
    here = torch.ones(size, size, dtype=torch.bool, device=logs.device).tril()
    after = logs[..., None].expand(*logs.shape, size).masked_fill(~here.tril(-1), 0.0)
    return after.cumsum(-2).masked_fill(~here, -torch.inf)


def _handed_on(left: Tensor, decay: Tensor) -> Tensor:
    """Return the state of the scan at the start of each chunk, to which all earlier chunks contribute."""
    state, starts = torch.zeros_like(left[:, 0]), []
    for new, share in zip(left.unbind(1), decay.unbind(1), strict=True):
        starts.append(state)
        state = share * state + new
    return torch.stack(starts, 1)
