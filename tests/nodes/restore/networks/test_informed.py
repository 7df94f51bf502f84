"""The informed network: untrained it is the filter, it sees what the filter knows, and node and
training agree.
"""

from functools import partial

import numpy as np
import pytest
import torch
from safetensors.torch import save_file

from neusee.nodes import ParameterError
from neusee.nodes.restore import (
    Informed,
    filter_facts,
    informed,
    start_network,
    wiener,
    wiener_problem,
)
from neusee.nodes.restore.inverse import MAPS_OF_CHANNEL
from tests.nodes.restore.networks.test_unrolled import frame, random

READ = {"read_noise": 10.0}


def network(change=0.0):
    net = start_network(partial(Informed, 2), torch.Generator().manual_seed(4))
    with torch.no_grad():
        net.body.last.weight.add_(
            change * torch.randn(net.body.last.weight.shape, generator=torch.Generator())
        )
    return net


def written(net, folder):
    save_file(net.state_dict(), folder / "weights.safetensors")
    return {"weights": folder / "weights.safetensors", "width": 2, **READ}


def test_the_untrained_restorer_is_the_filter(tmp_path):
    given = frame()
    expected = wiener(*given, **READ)
    for found in (informed(*given, **READ), informed(*given, **written(network(), tmp_path))):
        assert torch.allclose(found, expected, rtol=1e-6, atol=1e-3)


@pytest.mark.parametrize("size", [(24, 24), (9, 14)])
def test_the_training_computes_the_picture_of_the_node(tmp_path, size):
    given, net = frame(*size), network(0.5)
    expected = informed(*given, **written(net, tmp_path)).double()
    known, told = filter_facts(*given, **READ), wiener(*given, **READ).double()
    with torch.no_grad():
        coarse, fine = net.pyramid(told[None], known, torch.eye(3))
    assert float((fine[0] - told).abs().max()) > 10.0
    assert torch.allclose(fine[0], expected, rtol=1e-5, atol=0.05)
    assert coarse.shape == (1, 3, -(-size[0] // 2), -(-size[1] // 2))


def test_the_maps_say_what_the_filter_knows():
    """Against the posed problem, with the information of the frame as a sum over its pixels in
    NumPy.
    """
    given = frame()
    known, posed = filter_facts(*given, **READ), wiener_problem(*given, **READ)
    each = known.maps[: 3 * MAPS_OF_CHANNEL].reshape(MAPS_OF_CHANNEL, 3, 24, 24)
    assert torch.allclose(
        known.answer * known.scale + known.mean, wiener(*given, **READ).double(), rtol=1e-6
    )
    assert torch.equal(each[0], known.answer)
    assert torch.equal(each[5] == 0, given[5])  # clipped pixels
    assert torch.allclose(
        each[3], (posed.weight.sqrt() * (posed.picture - posed.seen)).asinh(), atol=1e-6
    )
    weight, kernel = posed.weight[0].numpy(), posed.psf[0].numpy() ** 2
    far = [n // 2 for n in kernel.shape]
    wide = np.pad(weight, [(n, n) for n in far])
    told = [
        [(wide[y : y + kernel.shape[0], x : x + kernel.shape[1]] * kernel).sum() for x in range(24)]
        for y in range(24)
    ]
    told = np.array(told)
    assert np.corrcoef(told.ravel(), known.deviation[0].numpy().ravel() ** -2)[0, 1] > 0.999
    shares = known.maps[3 * MAPS_OF_CHANNEL :, 0, 0]
    assert float(shares[0]) < float(shares[-1]) < 1.0  # the frame tells the coarsest octave best


def test_a_noisier_frame_is_known_to_be_less_certain():
    given = frame()
    quiet, noisy = (filter_facts(*given, read_noise=each) for each in (10.0, 3000.0))
    assert bool((noisy.deviation.mean((1, 2)) > 1.2 * quiet.deviation.mean((1, 2))).all())


def test_a_frame_that_is_clipped_altogether_stays_finite(tmp_path):
    *others, clipped, glare = frame()
    found = informed(*others, torch.ones_like(clipped), glare, **written(network(0.5), tmp_path))
    assert bool(torch.isfinite(found).all())


def test_from_the_start_the_last_layer_has_a_gradient():
    net = network()
    known = filter_facts(*frame(), **READ)
    (net(torch.zeros(1, 3, 24, 24), known, torch.eye(3)) - 100.0).square().mean().backward()
    assert float(net.body.last.weight.grad.abs().max()) > 0


def test_other_weights_and_other_sensors_are_refused(tmp_path):
    weights = written(network(), tmp_path)["weights"]
    with pytest.raises(ParameterError, match="width 3"):
        informed.hooks.preflight(weights=weights, width=3)
    assert "is the Wiener filter" in informed.hooks.preflight()[0]
    electrons, psf, light, responses, bands, clipped, _ = frame()
    with pytest.raises(ValueError, match="the network needs 3"):
        informed(electrons[:1], psf, light, responses[:1], bands, clipped[:1], **READ)


def test_noise_of_the_glare_is_a_map_of_its_own():
    *given, glare = frame()
    nearby = [glare[0] * (1 + 0.3 * random(4, 3, 24, 24, seed=9)).float()]
    without, with_doubt = (filter_facts(*given, glare, *more, **READ) for more in ([], [nearby]))
    doubt = slice(7 * 3, 8 * 3)
    assert float(without.maps[doubt].abs().max()) == 0.0
    assert float(with_doubt.maps[doubt].max()) > 0.0
