"""The FFT-Mamba network: its size, the order of its scans, and what each part owes by itself."""

import itertools
import json
from fractions import Fraction

import pytest
import torch
from safetensors.torch import save_file
from torch.nn.functional import softplus
from torch.testing import assert_close

from neusee.nodes import ParameterError
from neusee.nodes.network_weights import OPTIONS, file_metadata
from neusee.nodes.restore import FFTMamba, fft_mamba, start_network
from neusee.nodes.restore.networks import (
    Block,
    BothWays,
    Frequency,
    Scan,
    Spatial,
    _fft_mamba,
    radial_order,
)

CPU = torch.device("cpu")


def seeded(seed=0):
    return torch.Generator().manual_seed(seed)


def drawn(*shape, seed=5):
    return torch.randn(*shape, generator=seeded(seed))


def begun(make):
    return start_network(make, seeded()).requires_grad_(False)


def parameters(width, blocks, states, shuffle):
    """Written out part by part, biases last in each."""
    rank = -(-width // 16)

    def both_ways(d):
        return 2 * (d * (rank + 2 * states) + rank * d + d + d * states + d)

    inner = 2 * width
    spatial = (width * 2 * inner + 2 * inner) + (9 * inner + inner) + both_ways(inner) + 2 * inner
    spatial += inner * width + width
    spectral = (
        2 * inner
        + (inner * inner + inner)
        + both_ways(width)
        + 2 * width
        + (width * inner + inner)
        + 1
    )
    weigh = inner * width + width
    feed = (width * 4 * width + 4 * width) + (9 * 4 * width + 4 * width) + (inner * width + width)
    block = 2 * 2 * width + spatial + spectral + weigh + feed + 2 * width
    inside = 3 * shuffle**2
    ends = (
        (9 * 2 * inside * width + width)
        + (9 * width * width + width)
        + (9 * width * inside + inside)
    )
    return blocks * block + ends


@pytest.mark.parametrize(
    "sizes",
    [
        (64, 8, 16, 2),
        (64, 8, 16, 4),
        (48, 8, 16, 4),
        (20, 3, 5, 1),
    ],
)
def test_has_as_many_parameters_as_its_parts(sizes):
    with torch.device("meta"):
        assert sum(p.numel() for p in FFTMamba(*sizes).parameters()) == parameters(*sizes)


def test_the_usual_network_has_938_thousand_parameters_in_eight_blocks():
    with torch.device("meta"):
        net = FFTMamba()
    assert sum(p.numel() for p in net.parameters()) == 937_876
    assert [block.spatial.by_columns for block in net.blocks] == [False, True] * 4


# --- the line of frequencies ----------------------------------------------------------------------


@pytest.mark.parametrize("size", [(1, 1), (1, 6), (8, 8), (7, 5), (6, 9), (18, 26)])
def test_the_order_is_a_permutation_and_the_places_undo_it(size):
    order, place = radial_order(size, CPU)
    every = torch.arange(size[0] * (size[1] // 2 + 1))
    assert torch.equal(order.sort().values, every)
    assert torch.equal(order[place], every)
    assert torch.equal(place[order], every)


@pytest.mark.parametrize("size", [(8, 8), (7, 5), (6, 9), (4, 12)])
def test_frequencies_rise_and_those_of_one_radius_turn(size):
    y, x = size
    order, _ = radial_order(size, CPU)
    known = []
    for row, column in itertools.product(range(y), range(x // 2 + 1)):
        up, right = Fraction(row - y if 2 * row >= y else row, y), Fraction(column, x)
        angle = float(torch.atan2(torch.tensor(float(up)), torch.tensor(float(right))))
        known.append((up * up + right * right, angle, row * (x // 2 + 1) + column))
    assert order.tolist() == [at for *_, at in sorted(known)]
    assert order[0] == 0


def test_the_order_made_where_nobody_learns_serves_those_who_learn():
    radial_order.cache_clear()
    with torch.inference_mode():
        radial_order((6, 10), CPU)
    net = start_network(lambda: Frequency(4, 2), seeded())
    net(drawn(1, 4, 6, 10)).square().sum().backward()
    assert bool(net.strength.grad)


# --- scans ----------------------------------------------------------------------------------------


def test_steps_at_the_start_remember_ten_to_a_thousand_places():
    scan = begun(lambda: Scan(400, 16, 4))
    steps = softplus(scan.dt_bias.double())
    assert 1e-3 * (1 - 1e-4) <= float(steps.min()) < 1.5e-3
    assert 0.098 < float(steps.max()) <= 0.1 * (1 + 1e-4)
    assert float(steps.log().median().exp()) == pytest.approx(1e-2, rel=0.25)  # log-uniform
    assert_close(scan.A_log.exp(), torch.arange(1.0, 17.0).expand(400, 16))
    assert torch.equal(scan.D, torch.ones(400))


def test_a_scan_remembers_and_does_not_foresee():
    scan, before = begun(lambda: Scan(6, 4, 2)), drawn(1, 40, 6)
    after = before.clone()
    after[:, 12] += 1
    change = (scan(after) - scan(before)).abs().amax((0, 2))
    assert not change[:12].any()
    assert float(change[12:].min()) > 0


def test_a_scan_is_its_recurrence():
    scan, u = begun(lambda: Scan(3, 2, 2)), drawn(2, 9, 3)
    read = u.double() @ scan.read.weight.double().T
    rate, into, out = read.split([2, 2, 2], -1)
    step = softplus(rate @ scan.rate.weight.double().T + scan.dt_bias.double())
    wanted = torch.zeros(2, 9, 3, dtype=torch.float64)
    for b, d in itertools.product(range(2), range(3)):
        state = torch.zeros(2, dtype=torch.float64)
        for t in range(9):
            for n in range(2):
                decay = torch.exp(-step[b, t, d] * (n + 1))
                state[n] = decay * state[n] + step[b, t, d] * into[b, t, n] * u[b, t, d]
            wanted[b, t, d] = (state * out[b, t]).sum() + u[b, t, d]
    assert_close(scan(u).double(), wanted, rtol=1e-5, atol=1e-6)


def test_decays_and_steps_stay_within_bounds_whatever_is_learnt():
    scan, u = start_network(lambda: Scan(6, 4, 2), seeded()), 100 * drawn(1, 40, 6)
    with torch.no_grad():
        scan.A_log.copy_(torch.linspace(-200, 200, scan.A_log.numel()).view_as(scan.A_log))
        scan.dt_bias.copy_(torch.linspace(-300, 300, scan.dt_bias.numel()))
    steps = _fft_mamba._step(100 * drawn(9, scan.dt_bias.numel()), scan.dt_bias).detach()
    assert (float(steps.min()), float(steps.max())) == (pytest.approx(1e-5), 8)
    decays = _fft_mamba._decay(scan.A_log).detach()
    assert -404 < float(decays.min()) < float(decays.max()) < 0
    result = scan(u)
    result.square().mean().backward()
    assert bool(result.isfinite().all())
    assert all(bool(p.grad.isfinite().all()) for p in scan.parameters())


def test_both_ways_turned_round_are_the_other_ways():
    both, u = begun(lambda: BothWays(4, 3, 1)), drawn(2, 17, 4)
    turned = both(u.flip(1))
    both.there, both.back = both.back, both.there
    assert_close(both(u).flip(1), turned, rtol=0, atol=1e-6)
    both.back = both.there
    assert_close(both(u).flip(1), both(u.flip(1)), rtol=0, atol=1e-6)


def test_columns_of_a_picture_are_rows_of_the_picture_laid_on_its_side():
    rows, columns = (begun(lambda by=by: Spatial(4, 3, by)) for by in (False, True))
    state = rows.state_dict()
    columns.load_state_dict(state | {"mix.weight": state["mix.weight"].mT})
    x = drawn(1, 4, 6, 9)
    assert_close(columns(x.mT), rows(x).mT, rtol=0, atol=1e-5)
    assert not torch.allclose(columns(x), rows(x), rtol=0, atol=1e-3)


def test_a_scan_by_rows_goes_along_rows():
    """Without the way back and the filter, a pixel changes what comes after it, row by row."""
    part = begun(lambda: Spatial(4, 3, False))
    part.scan.back = torch.nn.Identity()
    part.mix = torch.nn.Identity()
    before = drawn(1, 4, 5, 6)
    after = before.clone()
    after[..., 2, 3] += 1
    change = (part(after) - part(before)).abs().amax((0, 1)).flatten()
    assert not change[: 2 * 6 + 3].any()
    assert float(change[2 * 6 + 3 :].min()) > 0


# --- the spectrum ---------------------------------------------------------------------------------


@pytest.mark.parametrize("size", [(8, 8), (7, 5), (1, 6), (9, 1)])
def test_a_gate_that_is_constant_multiplies_the_picture(size):
    part, x = begun(lambda: Frequency(4, 3)), drawn(2, 4, *size)
    part.leave.weight.zero_()
    part.leave.bias[:4] = 3.0
    assert_close(part(x), 1.3 * x, rtol=1e-5, atol=1e-6)


def test_the_gate_of_a_frequency_is_drawn_from_the_lower_ones():
    part = begun(lambda: Frequency(4, 3))
    part.scan.back = torch.nn.Identity()
    drawn_gates = []
    part.leave.register_forward_hook(lambda *call: drawn_gates.append(call[-1]))
    before = drawn(1, 4, 12, 16)
    wave = torch.cos(
        2 * torch.pi * (3 / 12 * torch.arange(12.0)[:, None] + 4 / 16 * torch.arange(16.0))
    )
    part(before)
    part(before + wave)
    change = (drawn_gates[1] - drawn_gates[0]).abs().amax((0, 2))
    place = int(radial_order((12, 16), CPU)[1][3 * 9 + 4])
    assert float(change[:place].max()) < 3e-6  # rounding
    assert float(change[place]) > 0.1
    assert float(change[place:].median()) > 1e-5


@pytest.mark.parametrize("size", [(8, 6), (7, 9)])
def test_a_gate_acts_on_the_frequency_that_it_was_drawn_for(size):
    part, x = begun(lambda: Frequency(4, 3)), drawn(1, 4, *size)
    order, _ = radial_order(size, CPU)
    columns = order % (size[1] // 2 + 1)
    # whose mirror image is not here
    for rank in torch.nonzero((columns > 0) & (2 * columns < size[1]))[:, 0].tolist():
        gates = torch.zeros(1, len(order), 8)
        gates[:, rank] = 1
        part.leave.register_forward_hook(lambda *call, gates=gates: gates)
        change = torch.fft.rfft2(part(x) - x).abs().amax((0, 1)).flatten()
        assert int(change.argmax()) == int(order[rank])
        assert float(change.sort().values[-2]) < 1e-4 * float(change.max())


def test_the_spectrum_is_in_single_precision_under_autocast():
    part, x = begun(lambda: Frequency(4, 3)), drawn(1, 4, 6, 10)
    with torch.autocast("cpu", torch.bfloat16):
        result = part(x)
    assert result.dtype == torch.float32
    gate = part(x) - x
    assert float((result - part(x)).abs().max()) < 0.05 * float(gate.abs().max())


def test_a_small_spectrum_has_a_bounded_slope():
    """Amplitude and phase would have slopes of 1 / amplitude."""
    part = begun(lambda: Frequency(4, 3))
    for size in (1.0, 1e-6, 0.0):
        x = (size * drawn(1, 4, 8, 8)).requires_grad_()
        part(x).sum().backward()
        assert float(x.grad.abs().max()) < 10


# --- blocks and passes ----------------------------------------------------------------------------


def test_a_block_weighs_both_and_adds_little_at_the_start():
    block, x = begun(lambda: Block(4, 3, False)), drawn(1, 4, 6, 6)
    assert float((block(x) - x).abs().max()) < 1
    block.second_scale.factor.zero_()
    for bias, part in ((60.0, block.spatial), (-60.0, block.frequency)):
        block.weigh.weight.zero_()
        block.weigh.bias.fill_(bias)
        assert_close(block(x), x + 0.1 * part(block.norm(x)), rtol=0, atol=1e-6)


def test_the_fine_pass_sees_the_coarse_one_and_both_have_the_same_weights():
    net, picture = begun(lambda: FFTMamba(4, 1, 2)), torch.rand(1, 3, 16, 16, generator=seeded())
    coarse, fine = net.pyramid(picture)
    assert_close(
        coarse,
        net.improved(
            *2
            * [
                torch.nn.functional.interpolate(
                    picture, size=(8, 8), mode="bicubic", antialias=True
                )
            ]
        ),
        rtol=0,
        atol=1e-5,
    )
    up = torch.nn.functional.interpolate(coarse, size=(16, 16), mode="bicubic", antialias=True)
    assert_close(fine, net.improved(picture, up), rtol=0, atol=1e-5)
    assert not torch.allclose(fine, net.improved(picture, picture), rtol=0, atol=1e-4)


def test_the_network_gives_two_scales_of_any_size_and_slopes():
    net = start_network(lambda: FFTMamba(4, 2, 2, 2), seeded())
    picture = torch.rand(1, 3, 9, 14, generator=seeded())
    coarse, fine = net.pyramid(picture)
    assert (coarse.shape, fine.shape) == ((1, 3, 5, 7), (1, 3, 9, 14))
    assert float((fine - picture).detach().abs().mean()) < 0.5
    (coarse.square().sum() + fine.square().sum()).backward()
    assert all(p.grad is not None and bool(p.grad.isfinite().all()) for p in net.parameters())


@pytest.mark.parametrize(
    ("option", "learnt", "said"),
    [
        (
            "pyramid",
            True,
            (
                "was trained with pyramid: true, and this network has pyramid: false; train the"
                " network again"
            ),
        ),
        ("frequency", "amp_phase", "frequency: amp_phase, and this network has frequency: complex"),
        ("directions", 4, "directions: 4, and this network has directions: 2"),
    ],
)
def test_a_file_of_weights_tells_what_its_tensors_do_not(tmp_path, option, learnt, said):
    """Options of earlier versions, whose tensors have the same shapes."""
    sizes = {"width": 4, "blocks": 1, "states": 2, "shuffle": 2}
    usual = {"directions": 2, "pyramid": False, "frequency": "complex"}
    net = begun(lambda: FFTMamba(**sizes))
    assert json.loads(file_metadata(net)[OPTIONS]) == usual
    file = tmp_path / "net.safetensors"
    save_file(net.state_dict(), file, {OPTIONS: json.dumps(usual | {option: learnt})})
    with pytest.raises(ParameterError, match=f"net.safetensors.*{said}") as caught:
        fft_mamba.hooks.preflight(**sizes, weights=file)
    assert caught.value.parameter == "weights"
    save_file(net.state_dict(), file, file_metadata(net))
    assert fft_mamba.hooks.preflight(**sizes, weights=file) == []
    picture = torch.rand(3, 12, 16, generator=seeded())
    assert torch.equal(fft_mamba(picture, **sizes, weights=file), net(picture[None])[0])
