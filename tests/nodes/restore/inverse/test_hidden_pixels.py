"""The most likely picture: against the full matrix, the filter of a picture without edges, and
chance itself.
"""

from dataclasses import replace

import pytest
import torch
from torch.utils._python_dispatch import TorchDispatchMode

from neusee.nodes.restore.inverse import (
    Blurred,
    Lowest,
    _conjugate_gradients,
    _hidden_pixels,
    _masked_blur,
    descend,
    fall,
    halved,
    halvings,
    most_likely,
    torus,
    variance,
)


def problem(picture, size, channels=1, grey=0.0, seed=0, hidden=0.0):
    """A random picture behind a random smooth blur, with weights of 25 and some pixels hidden."""
    rng = torch.Generator().manual_seed(seed)
    kernel = torch.rand(channels, *size, generator=rng, dtype=torch.float64)
    y, x = (torch.minimum(torch.arange(n), n - torch.arange(n)) for n in size)
    kernel = kernel * torch.exp(-(y[:, None] ** 2 + x**2) / 4.0)
    transfer = torch.fft.rfft2(kernel / kernel.sum((-2, -1), keepdim=True))
    seen = torch.randn(channels, *picture, generator=rng, dtype=torch.float64)
    weight = 25.0 * (torch.rand(seen.shape, generator=rng) >= hidden).double()
    return Blurred(seen, weight, transfer, fall(size), size, grey)


def space(seen, spectrum):
    return torch.fft.irfft2(spectrum, s=seen.torus)


def by_matrix(seen, glare=()):
    """The same from its definition: every pixel of the torus an unknown, covariances as
    matrices.
    """
    channels, count = len(seen.picture), seen.torus[0] * seen.torus[1]
    units = torch.eye(count, dtype=torch.float64).reshape(count, 1, *seen.torus)
    spectra = torch.fft.rfft2(units)
    blurs = [torch.stack([seen.blur(u)[c].flatten() for u in spectra], 1) for c in range(channels)]
    design = torch.block_diag(*blurs)
    spread = torch.stack(
        [torch.fft.irfft2(u[0] * seen.power, s=seen.torus).flatten() for u in spectra], 1
    )
    colours = torch.full((channels, channels), seen.grey, dtype=torch.float64).fill_diagonal_(1.0)
    prior = torch.kron(colours, spread)
    known = seen.weight.flatten() > 0
    noise = torch.diag(1.0 / seen.weight.flatten()[known])
    for pattern in glare:
        noise = noise + 1e7 * torch.outer(*[pattern.flatten()[known]] * 2)
    design, values = design[known], seen.picture.flatten()[known]
    x = prior @ design.T @ torch.linalg.solve(design @ prior @ design.T + noise, values)
    return x.reshape(channels, *seen.torus)


@pytest.mark.parametrize(("channels", "grey"), [(1, 0.0), (2, 0.5), (3, 0.95)])
@pytest.mark.parametrize("hidden", [0.0, 0.3])
def test_equals_the_full_matrix(channels, grey, hidden):
    seen = problem((6, 5), (10, 9), channels, grey, hidden=hidden)
    expected = by_matrix(seen)
    torch.testing.assert_close(space(seen, most_likely(seen)), expected, rtol=0, atol=1e-9)
    start = torch.zeros_like(seen.transfer)
    torch.testing.assert_close(
        space(seen, descend(seen, start, 300, 0.0)),
        expected,
        rtol=0,
        atol=1e-5,
    )


def test_glare_of_unknown_strength_equals_the_full_matrix():
    seen = problem((6, 5), (10, 9), 2, 0.5, hidden=0.2)
    patterns = tuple(
        torch.rand(2, 2, 6, 5, dtype=torch.float64, generator=torch.Generator().manual_seed(5))
    )
    marred = replace(
        seen, picture=seen.picture + 70 * patterns[0] - 30 * patterns[1], glare=patterns
    )
    expected = by_matrix(seen, patterns)
    torch.testing.assert_close(space(seen, most_likely(marred)), expected, rtol=0, atol=1e-4)
    start = torch.zeros_like(seen.transfer)
    torch.testing.assert_close(
        space(seen, descend(marred, start, 300, 0.0)),
        expected,
        rtol=0,
        atol=1e-4,
    )


@pytest.mark.parametrize("size", [(24, 24), (96, 80)])
def test_without_edges_it_is_the_wiener_filter(size):
    seen = problem(size, size)
    signal, noise = seen.power, 1.0 / 25.0
    gain = seen.transfer.conj() * signal / (seen.transfer.abs().square() * signal + noise)
    expected = torch.fft.irfft2(gain * torch.fft.rfft2(seen.picture), s=size)
    torch.testing.assert_close(space(seen, most_likely(seen)), expected, rtol=0, atol=1e-6)


def periodic_filter(seen, weight):
    """Return the Wiener filter (channel, y, x) of a picture without edges whose channels are
    alike.
    """
    signal = (1 + (len(seen.picture) - 1) * seen.grey) * seen.power
    gain = seen.transfer.conj() * signal / (seen.transfer.abs().square() * signal + 1 / weight)
    return torch.fft.irfft2(gain * torch.fft.rfft2(seen.picture), s=seen.torus)


@pytest.mark.parametrize("channels", [1, 3])
@pytest.mark.parametrize("weight", [1e2, 1e8, 1e12, 1e15, 1e18])
def test_a_picture_without_noise_is_inverted_to_rounding(weight, channels):
    """The covariance of the pixels has the squared condition of the blur, and lost 4e-5 at a
    weight of 1e15.
    """
    model = problem((12, 10), (12, 10))
    alike = model.picture.expand(channels, -1, -1), model.transfer.expand(channels, -1, -1)
    seen = replace(
        model,
        picture=alike[0],
        transfer=alike[1],
        weight=torch.full_like(alike[0], weight),
        grey=0.9,
    )
    expected = periodic_filter(seen, weight)
    answer = space(seen, most_likely(seen))
    assert float((answer - expected).abs().max() / expected.abs().max()) < 1e-8


@pytest.mark.parametrize("weight", [1e6, 1e9, 1e12])
def test_a_gradient_is_right_to_rounding_times_the_ratio_of_scene_to_noise(weight):
    model = problem((12, 10), (12, 10))
    picture, gradients = model.picture.requires_grad_(), []
    seen = replace(model, weight=torch.full_like(picture, weight))
    towards = torch.rand(12, 10, generator=torch.Generator().manual_seed(2), dtype=torch.float64)
    for answer in (space(seen, most_likely(seen)), periodic_filter(seen, weight)):
        gradients.append(torch.autograd.grad((answer * towards).sum(), picture)[0])
    ratio = weight * float((model.transfer.abs().square() * model.power).max())
    error = float((gradients[0] - gradients[1]).abs().max() / gradients[1].abs().max())
    assert error < 1e-16 * ratio


@pytest.mark.parametrize("bounded", [0, 1])
def test_even_glare_over_a_picture_without_noise_takes_its_share_of_the_mean(bounded):
    """Even glare adds to the variance of the mean of the noise, and to nothing else."""
    model, weight, count = problem((12, 10), (12, 10)), 1e13, 120
    even = torch.full_like(model.picture, 5.0)
    seen = replace(model, weight=torch.full_like(even, weight), glare=(even,), bounded=bounded)
    noise = 1 / (weight * count)  # variance of its mean
    glare = 25.0 if bounded else 1e8 * noise
    scene = float(model.power[0, 0]) / count
    expected = periodic_filter(seen, weight)
    expected = expected - expected.mean() + seen.picture.mean() * scene / (scene + noise + glare)
    answer = space(seen, most_likely(seen))
    assert float((answer - expected).abs().max() / expected.abs().max()) < 1e-8


def test_on_average_no_other_balance_does_better():
    """Pictures drawn from the prior, blurred, noisy and cut off: the right noise level has the
    least mean error.
    """
    size, errors = (40, 40), torch.zeros(3)
    for seed in range(20):
        rng = torch.Generator().manual_seed(seed)
        model = problem((24, 24), size)
        white = torch.fft.rfft2(torch.randn(1, *size, dtype=torch.float64, generator=rng))
        truth = white * model.power.sqrt()
        noise = 0.2 * torch.randn(1, 24, 24, dtype=torch.float64, generator=rng)
        picture = model.blur(truth) + noise
        for k, factor in enumerate((1 / 9, 1.0, 9.0)):
            found = most_likely(replace(model, picture=picture, weight=factor * model.weight))
            errors[k] += (space(model, found - truth)[:, :24, :24]).square().mean()
    assert errors[1] < 0.98 * errors[0]
    assert errors[1] < 0.98 * errors[2]


def test_few_steps_from_a_coarse_start_are_near_the_exact_answer(monkeypatch):
    """Where plain conjugate gradients, from nothing, are still far off."""
    size = torus((60, 60), (20, 20))
    y, x = (torch.minimum(torch.arange(n), n - torch.arange(n)) for n in size)
    ring = ((torch.hypot(y[:, None].double(), x[None].double()) - 16).abs() < 1).double()
    model = replace(problem((60, 60), size), transfer=torch.fft.rfft2(ring / ring.sum())[None])
    model = replace(model, weight=torch.full((1, 60, 60), 1e4, dtype=torch.float64))
    rng = torch.Generator().manual_seed(1)
    truth = (
        torch.fft.rfft2(torch.randn(1, *size, dtype=torch.float64, generator=rng))
        * model.power.sqrt()
    )
    model = replace(model, picture=model.blur(truth) + 0.01 * torch.randn(1, 60, 60, generator=rng))

    def error(spectrum):
        return float(space(model, spectrum - truth)[:, :60, :60].square().mean().sqrt())

    found = most_likely(model)
    monkeypatch.setattr(_conjugate_gradients, "LOWEST", 0)
    plain = descend(model, torch.zeros_like(truth), 20, 0.0)
    monkeypatch.setattr(_masked_blur, "DENSE", 60)
    exact = most_likely(model)
    assert error(found) < 1.1 * error(exact)
    assert error(plain) > 1.5 * error(exact)


def far(seen, spectrum, answer):
    """Square distance from the answer in the posterior's own spread: the energy that is left,
    all pixels together.
    """
    slope = seen.slope(answer) - seen.slope(spectrum)
    return float((space(seen, slope) * space(seen, spectrum - answer)).sum().abs())


@pytest.fixture(scope="module", params=[1, 3])
def answered(request):
    """A problem with glare of unknown strength, and its answer."""
    seen = problem(
        (90, 70),
        torus((90, 70), (9, 9)),
        request.param,
        0.9 if request.param > 1 else 0.0,
        hidden=0.2,
    )
    pattern = torch.rand(
        seen.picture.shape, dtype=torch.float64, generator=torch.Generator().manual_seed(5)
    )
    seen = replace(seen, weight=40 * seen.weight, glare=(pattern,))
    return seen, most_likely(seen, 400, 1e-14)


@pytest.mark.slow
@pytest.mark.parametrize("single", [False, True])
def test_it_ends_near_the_answer_as_the_residual_says(answered, single):
    """The residual tells a tenth to a thirtieth of the square distance; it tells the slowest
    part too small.
    """
    seen, answer = answered
    count = float((seen.weight > 0).sum())
    steepest = float(space(seen, seen.slope(0 * answer)).abs().max())
    assert float(space(seen, seen.slope(answer)).abs().max()) < 1e-7 * steepest
    rough = Blurred(
        seen.picture.float(),
        seen.weight.float(),
        seen.transfer.to(torch.complex64),
        seen.power.float(),
        seen.torus,
        seen.grey,
        (seen.glare[0].float(),),
    )
    for enough in (1e-1, 1e-3, 1e-5):
        found = most_likely(rough if single else seen, 100, enough).to(answer)
        assert far(seen, found, answer) / count < 40 * enough


@pytest.mark.parametrize("rows", [50, 1000])
def test_the_lowest_frequencies_are_inverted_exactly(monkeypatch, rows):
    """With all frequencies but the highest among them, one step is the answer."""
    seen = problem((11, 9), (15, 13), 2, 0.5, hidden=0.3)
    pattern = torch.rand(2, 11, 9, dtype=torch.float64, generator=torch.Generator().manual_seed(5))
    seen = replace(seen, glare=(pattern,))
    monkeypatch.setattr(_conjugate_gradients, "SHARE", 0.5)
    monkeypatch.setattr(_conjugate_gradients, "_INVERSE_ROWS", rows)
    lowest = Lowest(seen, torch.ones_like(seen.transfer.real))
    assert len(lowest.fy) == (15 * 13 + 1) // 2
    slope, found = seen.slope(torch.zeros_like(seen.transfer)), torch.zeros_like(seen.transfer)
    rise = float(lowest.add(slope, found))
    torch.testing.assert_close(space(seen, found), by_matrix(seen, (pattern,)), rtol=0, atol=1e-5)
    assert rise == pytest.approx(float((space(seen, slope) * space(seen, found)).sum()), rel=1e-9)


@pytest.mark.parametrize("ratio", [1e-12, 1e12])
def test_finite_where_some_weights_are_beyond_all_others(ratio):
    seen = problem((50, 45), torus((50, 45), (9, 9)), 2, 0.95, hidden=0.2)
    seen.weight[:, 20:30, 20:30] *= ratio
    assert torch.isfinite(most_likely(seen)).all()


def through_the_matrix(seen):
    """The exact answer whose gradient autograd takes through every element of the matrix and its
    decomposition.
    """
    return _hidden_pixels._by_factor(seen, _hidden_pixels._factor(seen))


def slopes(leaves, probe, solve):
    picture, weight, transfer, power, pattern = (leaf.clone().requires_grad_() for leaf in leaves)
    model = Blurred(
        picture, weight, torch.view_as_complex(transfer), power, probe.shape[-2:], 0.5, (pattern,)
    )
    (space(model, solve(model)) * probe).sum().backward()
    return [leaf.grad for leaf in (picture, weight, transfer, power, pattern)]


def test_gradients_through_the_iteration_are_those_of_the_exact_answer(monkeypatch):
    size, rng = torus((46, 11), (8, 8)), torch.Generator().manual_seed(4)
    seen = problem((46, 11), size, 2, 0.5)
    weight = seen.weight * (0.5 + torch.rand(seen.weight.shape, generator=rng, dtype=torch.float64))
    pattern, probe = (
        torch.randn(2, *n, generator=rng, dtype=torch.float64) for n in ((46, 11), size)
    )
    leaves = [seen.picture, weight, torch.view_as_real(seen.transfer), seen.power, pattern]
    exact = slopes(leaves, probe, through_the_matrix)
    found = slopes(leaves, probe, lambda model: most_likely(model, steps=200, enough=1e-14))
    monkeypatch.setattr(_masked_blur, "DENSE", 46)
    for mine, dense, right in zip(found, slopes(leaves, probe, most_likely), exact, strict=True):
        assert float((mine - right).norm()) < 1e-3 * float(right.norm())
        assert float((dense - right).norm()) < 1e-6 * float(right.norm())


class Work(TorchDispatchMode):
    """Counts decompositions of matrices, and the results with at least `side` squared numbers."""

    def __init__(self, side):
        super().__init__()
        self.side, self.decompositions, self.matrices = side, 0, 0

    def __torch_dispatch__(self, func, types, args=(), kwargs=None):
        result = func(*args, **(kwargs or {}))
        self.decompositions += any(
            name in str(func) for name in ("cholesky_ex", "linalg_solve", "lu_factor", "eigh")
        )
        first = result[0] if isinstance(result, tuple | list) and result else result
        new = (
            isinstance(first, torch.Tensor)
            and "view" not in str(func)
            and first.numel() >= self.side**2
        )
        self.matrices += new
        return result


def test_the_gradient_of_a_picture_that_is_solved_exactly_needs_no_matrix_but_the_factor():
    """Work is counted, not timed: one decomposition forward; one solve by its factor, and no
    matrix, backward.
    """
    picture, size = (20, 16), torus((20, 16), (6, 6))
    seen = problem(picture, size, 2, 0.5, hidden=0.2)
    leaf = seen.picture.clone().requires_grad_()
    model = replace(seen, picture=leaf, transfer=seen.transfer.clone().requires_grad_())
    side = 2 * 20 * 16
    with Work(side) as forward:
        found = space(model, most_likely(model)).square().sum()
    with Work(side) as backward:
        found.backward()
    assert (forward.decompositions, backward.decompositions) == (1, 0)
    assert forward.matrices > 0
    assert backward.matrices == 0
    assert bool(leaf.grad.any())


def test_gradcheck_of_a_picture_that_is_solved_exactly():
    seen = problem((5, 4), (8, 7), 2, 0.5, hidden=0.2)

    def restored(picture, through):
        model = replace(seen, picture=picture, transfer=torch.view_as_complex(through))
        return space(seen, most_likely(model))

    leaves = [
        leaf.clone().requires_grad_() for leaf in (seen.picture, torch.view_as_real(seen.transfer))
    ]
    assert torch.autograd.gradcheck(restored, leaves)


@pytest.mark.parametrize("picture", [(41, 80), (81, 7), (200, 123)])
def test_halving_keeps_the_light_and_the_prior(picture):
    size = torus(picture, (5, 9))
    seen = problem(picture, size, hidden=0.1)
    half = halved(replace(seen, picture=torch.ones_like(seen.picture)))
    assert half.torus == (size[0] // 2, size[1] // 2)
    assert half.picture.shape[-2:] == (-(-picture[0] // 2), -(-picture[1] // 2))
    torch.testing.assert_close(
        half.picture[half.weight > 0], torch.ones_like(half.picture)[half.weight > 0]
    )
    torch.testing.assert_close(half.transfer[..., 0, 0].real, seen.transfer[..., 0, 0].real)
    assert 0.8 < float(variance(half.power, half.torus)) <= 1.0
    assert float(half.weight.sum()) <= float(seen.weight.sum())


@pytest.mark.parametrize("picture", [(1, 1), (1, 300), (39, 40), (640, 640), (2048, 1)])
def test_the_grid_has_room_and_can_be_halved(picture):
    y, x = torus(picture, (7, 30))
    times = 2 ** halvings(picture)
    assert (y % times, x % times) == (0, 0)
    assert y >= picture[0] + 14
    assert x >= picture[1] + 60
