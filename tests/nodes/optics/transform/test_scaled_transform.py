import math
import threading

import pytest
import torch
from hypothesis import given, settings
from hypothesis import strategies as st

from neusee.nodes.optics.transform import (
    Axis,
    Banded,
    Grids,
    _sample_axis,
    borrowed,
    centred,
    cheapest,
    fft_length,
    radians,
    transform,
    unit_phasor,
)

METHODS = ["direct", "folded", "bluestein", "kaiser_bessel", "auto"]
CPU = torch.device("cpu")


@pytest.fixture(autouse=True)
def _one_thread():
    """Small problems: threads that wait for each other would cost more than the work."""
    before = torch.get_num_threads()
    torch.set_num_threads(1)
    yield
    torch.set_num_threads(before)


def exact(field, shape, alpha, centre_in, centre_out, sign=-1):
    """The double sum itself, complex128."""
    kernels = []
    for n, k, a, c_in, c_out in zip(field.shape, shape, alpha, centre_in, centre_out, strict=True):
        j = torch.arange(n, dtype=torch.float64) - c_in
        kernels.append(
            torch.exp(
                2j
                * math.pi
                * sign
                * a
                * torch.outer(torch.arange(k, dtype=torch.float64) - c_out, j)
            )
        )
    return kernels[0] @ field.to(torch.complex128) @ kernels[1].T


def noise(*shape, seed=0):
    return torch.randn(
        *shape, dtype=torch.complex128, generator=torch.Generator().manual_seed(seed)
    )


sizes = st.tuples(st.integers(1, 60), st.integers(1, 60))
places = st.tuples(st.floats(-80, 80), st.floats(-80, 80))


@pytest.mark.parametrize("method", METHODS)
@settings(max_examples=25, deadline=None)
@given(n=sizes, k=sizes, a=st.tuples(st.floats(1e-6, 0.02), st.floats(1e-4, 0.02)), c_in=places, c_out=places,
       sign=st.sampled_from([-1, 1]))  # fmt: skip
def test_every_method_is_the_double_sum(method, n, k, a, c_in, c_out, sign):
    field = noise(*n)
    truth = exact(field, k, a, c_in, c_out, sign)
    scale = float(field.abs().square().sum().sqrt()) * math.sqrt(n[0] * n[1]) ** 0.5
    double = transform(field, k, Grids(a, c_in, c_out, sign), method)
    single = transform(field.to(torch.complex64), k, Grids(a, c_in, c_out, sign), method)
    assert double.shape == single.shape == k
    assert float((double - truth).abs().max()) < 2e-12 * scale
    assert float((single - truth).abs().max()) < 3e-6 * scale


@pytest.mark.parametrize("method", METHODS)
@pytest.mark.parametrize(
    ("n", "k"), [((1, 1), (1, 1)), ((7, 1), (1, 13)), ((127, 64), (101, 33)), ((97, 89), (90, 90))]
)
def test_primes_ones_and_rectangles(method, n, k):
    field, where = (
        noise(*n),
        dict(alpha=(1 / 150, 1 / 97), centre_in=(3.25, -2.0), centre_out=(0.5, 40.0)),
    )
    truth = exact(field, k, **where)
    assert float((transform(field, k, Grids(**where), method) - truth).abs().max()) < 1e-12 * float(
        truth.abs().max() + 1
    )


@pytest.mark.parametrize("method", METHODS[:4])
def test_a_window_wider_than_one_period_repeats(method):
    field = noise(16, 16)
    out = transform(field, (40, 40), Grids((1 / 20, 1 / 20), (7.5, 7.5), (0.0, 0.0)), method)
    phase = torch.exp(
        1j * math.pi * torch.ones(1, dtype=torch.float64)
    )  # half-sample origin: one period turns the sign
    torch.testing.assert_close(out[20:, :20], out[:20, :20] * phase, rtol=0, atol=1e-11)


@pytest.mark.parametrize("method", METHODS[:4])
def test_the_adjoint_axis_is_the_conjugate_transpose(method):
    field, other = noise(23, 40), noise(31, 19, seed=1)
    there = Grids((0.011, 0.013), (11, 19.5), (15, 9))
    forward = transform(field, (31, 19), there, method)
    back = transform(
        other,
        (23, 40),
        Grids(there.alpha, there.centre_out, there.centre_in, 1),
        method,
    )
    torch.testing.assert_close(
        torch.vdot(other.flatten(), forward.flatten()),
        torch.vdot(back.flatten(), field.flatten()),
        rtol=1e-12,
        atol=1e-9,
    )


def test_phases_stay_exact_far_out():
    """A float32 chirp of 570 turns is off by 4e-5 rad; reduced in float64 and then cast, by
    4e-7.
    """
    turns = centred(2161, CPU).square() * (3.74e-6 * 2.9e-6 / (400e-9 * 0.11) / 2)
    truth = torch.exp(2j * math.pi * turns)
    assert float((unit_phasor(turns, torch.float32) - truth).abs().max()) < 4e-7
    angle = turns.float() * (2 * math.pi)
    assert float((torch.complex(angle.cos(), angle.sin()) - truth).abs().max()) > 1e-5
    assert float(radians(turns).abs().max()) <= math.pi


def test_zero_stays_zero_and_huge_and_tiny_scale():
    where = dict(alpha=(0.01, 0.01), centre_in=(9, 9), centre_out=(9, 9))
    for method in METHODS:
        for scale in (0.0, 1e-25, 1e25):
            field = (scale * noise(20, 20)).to(torch.complex64)
            out = transform(field, (20, 20), Grids(**where), method)
            truth = exact(field, (20, 20), **where)
            assert float((out - truth).abs().max()) <= 1e-5 * scale * 20


def test_smooth_numbers():
    assert [fft_length(n) for n in (1, 7, 11, 4207, 2160)] == [1, 8, 12, 4320, 2160]
    assert fft_length(15, even=True) == 16
    assert fft_length(75, even=True) % 2 == 0


@given(
    rows=st.integers(1, 90),
    columns=st.integers(1, 70),
    step=st.floats(0.05, 3.0),
    origin=st.floats(-5, 5),
)
@settings(max_examples=60, deadline=None)
def test_banded_is_the_dense_matrix(rows, columns, step, origin):
    def weigh(i, j):
        return (16 - (j - origin - step * i).square()).clamp(min=0) * torch.cos(i + 2 * j)

    band = Banded(rows, columns, origin, step, 4.0, 16).fill(weigh).to(torch.float64, CPU)
    dense = weigh(torch.arange(band.n_rows).double()[:, None], torch.arange(columns).double())
    x = torch.randn(columns, 6, dtype=torch.float64)
    padded = torch.nn.functional.pad(x, (0, 0, band.margin, band.margin))
    left, right = (
        torch.empty(band.n_rows, 6).double(),
        torch.empty(band.count, 6, band.block).double(),
    )
    band.left(padded, left)
    band.right(padded.T.contiguous(), right)
    torch.testing.assert_close(left, dense @ x)
    torch.testing.assert_close(right.transpose(0, 1).flatten(1), (dense @ x).T)


def test_large_windows_go_by_grids_and_small_ones_by_matrices():
    def chosen(n, k):
        axis = Axis(n, k, 1 / 5578)
        return cheapest(axis, axis, CPU)

    assert chosen(2160, 2048) == chosen(2048, 2160) == "kaiser_bessel"
    assert chosen(2160, 16) in ("direct", "folded")
    assert chosen(8, 8) in ("direct", "bluestein")
    assert (
        cheapest(
            Axis(2160, 2048, 1e-4),
            Axis(2160, 2048, 1e-4),
            torch.device("cuda"),
        )
        == "folded"
    )


def test_threads_never_share_a_workspace():
    field, where = (
        noise(64, 64),
        dict(alpha=(0.01, 0.01), centre_in=(31.5, 31.5), centre_out=(20, 20)),
    )
    truth, wrong = exact(field, (48, 48), **where), []

    def work():
        for _ in range(10):
            out = transform(field, (48, 48), Grids(**where), "kaiser_bessel")
            wrong.append(float((out - truth).abs().max()) > 1e-9)

    threads = [threading.Thread(target=work) for _ in range(4)]
    for thread in threads:
        thread.start()
    for thread in threads:
        thread.join()
    assert len(wrong) == 40
    assert not any(wrong)


def test_workspaces_are_kept_but_not_collected():

    with borrowed(torch.float32, CPU) as first:
        memory = first.take("x", 100).data_ptr()
        with (
            borrowed(torch.float32, CPU) as second,
            borrowed(torch.float32, CPU) as third,
        ):
            assert len({first, second, third}) == 3
    with borrowed(torch.float32, CPU) as again:
        assert again is first
        assert again.take("x", 50).data_ptr() == memory
    assert len(_sample_axis._idle) <= 2
