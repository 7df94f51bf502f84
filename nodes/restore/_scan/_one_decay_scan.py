"""The selective scan with one decay for a whole head, as products of matrices: no kernel of its own is needed."""

import torch
from torch import Tensor
from torch.nn import functional as F


def dual_scan(u: Tensor, dt: Tensor, A: Tensor, B: Tensor, C: Tensor, D: Tensor, *, chunk: int = 32) -> Tensor:
    """h = exp(dt A) h + dt B u, y = C h + D u along the length, where all channels of a head share dt and A.

    Within a chunk every place sees every earlier one by a matrix; from chunk to chunk a state is handed on. Logarithms
    of decays are added over each stretch anew: a difference of running sums loses what is small beside them.

    Shapes: u (batch, length, head * channel), dt (batch, length, head), A and D (head,), B and C (batch, length, n)
            -> as u. In single precision at least.
    """
    heads, length = len(A), u.shape[1]
    more = -length % chunk  # no light and no decay: nothing changes
    x, step, into, out = (F.pad(v, (0, 0, 0, more)).view(len(v), -1, chunk, v.shape[-1]) for v in (u, dt, B, C))
    x = x.view(*x.shape[:3], heads, -1).movedim(-2, 2)  # batch, chunk, head, place, channel
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
    """(…, place) -> (…, i, j): the sum over the places after j up to i; minus infinity where j is later than i."""
    size = logs.shape[-1]
    here = torch.ones(size, size, dtype=torch.bool, device=logs.device).tril()
    after = logs[..., None].expand(*logs.shape, size).masked_fill(~here.tril(-1), 0.0)
    return after.cumsum(-2).masked_fill(~here, -torch.inf)


def _handed_on(left: Tensor, decay: Tensor) -> Tensor:
    """What each chunk is given: what all earlier ones left."""
    state, given = torch.zeros_like(left[:, 0]), []
    for new, share in zip(left.unbind(1), decay.unbind(1), strict=True):
        given.append(state)
        state = share * state + new
    return torch.stack(given, 1)
