"""Costs of training a network with one picture: processor time and saved activations.

    python tests/benchmarks/fit_training_costs.py    # prints the entry "training" of node_costs.json

For each kind of network, one forward and backward pass is measured at two widths and two sizes of
the picture, with one thread; the least of three turns counts. Both are ``a + b pixels + c width
pixels + d width² pixels``, fitted as in `fit_costs`.
"""

import json
import sys
import time
from itertools import product

import torch
from fit_costs import fitted, short

from neusee.nodes.restore import critics
from neusee.nodes.spectra import start_mst_plus_plus
from neusee.workflows.recipe.blocks.train_block import Network
from neusee.workflows.training.training_iteration import network_of

KINDS = "fft_mamba", "unet", "nafnet", "critic", "mst_plus_plus"
WIDTHS, SIDES, TURNS = (8, 16, 32), (32, 64), 3
TIME_FLOOR, BYTES_FLOOR = 5e-3, 1e6


def passed(net, side):
    """Return the processor time of one pass forward and back, and the bytes that autograd saves."""
    saved, picture = {}, torch.rand(1, 3, side, side)

    def pack(x):
        saved[x.untyped_storage().data_ptr()] = x.untyped_storage().nbytes()
        return x

    with torch.autograd.graph.saved_tensors_hooks(pack, lambda x: x):
        began = time.thread_time()
        outputs = net.pyramid(picture) if hasattr(net, "pyramid") else [net(picture)]
        sum(output.mean() for output in outputs).backward()
    return time.thread_time() - began, sum(saved.values())


def network(kind, width):
    """Return a network, or the critic of the full size."""
    if kind == "critic":
        return critics(torch.Generator().manual_seed(0), width)[1]
    if kind == "mst_plus_plus":  # of one width only
        return start_mst_plus_plus(torch.Generator().manual_seed(0))
    return network_of(Network(kind=kind, width=width))


def law(kind):
    """Return the coefficients of seconds and of bytes of one kind of network."""
    columns, seconds, sizes = [], [], []
    for width, side in product((1,) if kind == "mst_plus_plus" else WIDTHS, SIDES):
        net = network(kind, width)
        turns = [passed(net, side) for _ in range(TURNS)]
        columns.append((1.0, side**2, *(x * side**2 * (width > 1) for x in (width, width**2))))
        seconds.append(min(taken for taken, _ in turns))
        sizes.append(turns[-1][1] - sum(p.nbytes for p in net.parameters()))
        print(kind, width, side, f"{seconds[-1]:.3g} s, {sizes[-1]:.3g} B", file=sys.stderr)
    columns = torch.tensor(columns, dtype=torch.float64).numpy()
    times = fitted(columns, torch.tensor(seconds).double().numpy(), TIME_FLOOR)
    saved = fitted(columns, torch.tensor(sizes).double().numpy(), BYTES_FLOOR)
    return {"seconds": [short(x) for x in times], "bytes": [short(x) for x in saved]}


if __name__ == "__main__":
    torch.set_num_threads(1)
    print(json.dumps({kind: law(kind) for kind in sys.argv[1:] or KINDS}))
