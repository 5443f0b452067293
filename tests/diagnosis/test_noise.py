"""What makes the noise of a log white: its colour, levels of trips and of blocks, the scale of each trip."""

import numpy as np
import pytest
from scipy import stats

from hdev_jax.diagnosis.noise.noise import BLOCK_S, Noise, _log_likelihood, estimate_noise, whiten
from hdev_jax.segments import trip_slices

# coefficients of stationary autoregressions, with roots from mild to nearly a random walk, and an oscillation
COLOURS = {"white": (), "ar1": (0.7,), "ar1_slow": (0.95,), "ar2": (1.2, -0.4), "ar2_cycle": (0.9, -0.7)}


def coloured(rng: np.random.Generator, n: int, coefficients: tuple[float, ...]) -> np.ndarray:
    """An autoregression of unit innovations, run in for long enough to be stationary."""
    run_in = 500
    x = rng.normal(size=n + run_in)
    for t in range(len(coefficients), n + run_in):
        x[t] += sum(c * x[t - k - 1] for k, c in enumerate(coefficients))
    return x[run_in:]


def trips(rng, lengths, coefficients, dt: float = 1.0):
    """Noise, trip ids and durations of trips that know nothing of each other."""
    noise = np.concatenate([coloured(rng, n, coefficients) for n in lengths])
    trip = np.repeat(np.arange(len(lengths)), lengths)
    return noise, trip, np.full(len(noise), dt)


def white_of(residual, trip, duration, *, levels=True) -> tuple[np.ndarray, Noise]:
    noise = estimate_noise(residual, trip, duration, levels=levels)
    return whiten(residual[:, None], noise, trip, duration)[:, 0], noise


def within(white: np.ndarray, trip: np.ndarray, lag: int) -> float:
    """Autocorrelation at a lag, pairs inside trips alone."""
    same = trip[lag:] == trip[:-lag]
    return float(np.mean((white[lag:] * white[:-lag])[same]) / np.mean(white**2))


@pytest.mark.parametrize("scale", [1.0, 37.0])
@pytest.mark.parametrize("colour", COLOURS)
def test_coloured_noise_comes_out_white(colour, scale):
    """Unit variance and no correlation: 6000 rows know an autocorrelation to 0.013, a variance to 0.018."""
    rng = np.random.default_rng(3)
    residual, trip, duration = trips(rng, (600,) * 10, COLOURS[colour])
    white, noise = white_of(scale * residual, trip, duration)
    assert np.mean(white**2) == pytest.approx(1.0, abs=0.08)
    for lag in (1, 2, 3, 5, 10):
        assert abs(within(white, trip, lag)) < 0.05, lag
    assert noise.level_sd < 0.35 * scale * np.std(residual)
    first = noise.coefficients[-1]
    expected = np.zeros(max(len(first), 2))
    expected[: len(COLOURS[colour])] = COLOURS[colour]
    np.testing.assert_allclose(first[:2], expected[: len(first[:2])], atol=0.08)


@pytest.mark.parametrize("lengths", [(4, 3, 900), (1, 1, 40, 40), (60,) * 3])
def test_short_trips(lengths):
    """Trips shorter than the order are whitened with what rows they have; one row has its own variance alone."""
    rng = np.random.default_rng(5)
    residual, trip, duration = trips(rng, lengths, (0.8,))
    white, noise = white_of(residual, trip, duration)
    assert np.all(np.isfinite(white))
    assert noise.order <= max(1, max(lengths) // 4)
    for t in range(len(lengths)):
        k = int(np.flatnonzero(trip == t)[0])
        expected = residual[k] / noise.scales[0] / noise.trip_scale[min(t, len(noise.trip_scale) - 1)]
        if noise.block_sd == 0:
            assert white[k] == pytest.approx(expected)


@pytest.mark.parametrize("block", [0.0, 0.7])
def test_trips_do_not_leak(block):
    """What is in one trip changes nothing of another: each whitens as it does alone."""
    rng = np.random.default_rng(1)
    lengths = (40, 7, 90, 1, 30)
    residual, trip, _ = trips(rng, lengths, (0.9,))
    duration = np.full(len(trip), 30.0)
    noise = Noise(np.array([[0, 0], [0.8, 0], [1.1, -0.2]]), np.array([2.0, 1.2, 1.0]), 0.0, np.ones(5), 0.0, block)
    columns = np.c_[residual, rng.normal(size=len(trip))]
    together = whiten(columns, noise, trip, duration)
    for t in range(len(lengths)):
        rows = trip == t
        alone = whiten(columns[rows], noise, trip[rows], duration[rows])
        np.testing.assert_allclose(together[rows], alone, atol=1e-12)
    other = columns.copy()
    other[trip == 2] += 1e3
    changed = whiten(other, noise, trip, duration)
    np.testing.assert_allclose(changed[trip != 2], together[trip != 2], atol=1e-12)


def test_whitening_is_the_inverse_square_root_of_the_covariance():
    """A second derivation: for a stationary AR(1) with known coefficients, WᵀW is the inverse of its covariance."""
    phi, n = 0.8, 12
    sd = np.sqrt(1 / (1 - phi**2))
    noise = Noise(np.array([[0.0], [phi]]), np.array([sd, 1.0]), 0.0, np.ones(1), 0.0)
    trip = np.zeros(n, int)
    w = whiten(np.eye(n), noise, trip, np.ones(n))[:, :n]
    lag = np.abs(np.subtract.outer(np.arange(n), np.arange(n)))
    np.testing.assert_allclose(w.T @ w, np.linalg.inv(sd**2 * phi**lag), atol=1e-9)


def test_block_levels_are_taken_out_by_their_variance():
    """The same with a level on every block: WᵀW is the inverse of I + τ²·(ones in each block)."""
    n, tau = 60, 0.6
    duration = np.full(n, 2 * BLOCK_S / n)  # two blocks of half the rows
    noise = Noise(np.array([[0.0], [0.0]]), np.array([1.0, 1.0]), 0.0, np.ones(1), 0.0, block_sd=tau)
    w = whiten(np.eye(n), noise, np.zeros(n, int), duration)[:, :n]
    covariance = np.linalg.inv(w.T @ w)
    first = covariance[0] > tau**2 / 2
    assert first.sum() in (29, 30, 31)  # where a cut falls on a row's edge either side may have it
    same = np.equal.outer(first, first)
    np.testing.assert_allclose(covariance, np.eye(n) + tau**2 * same, atol=1e-9)


@pytest.mark.parametrize("sd", [0.0, 2.0])
def test_levels_of_trips(sd):
    """Found where they are, with about their size; with one or two dozen trips a size is known to a third at best."""
    rng = np.random.default_rng(11)
    residual, trip, duration = trips(rng, (200,) * 20, (0.5,))
    levels = sd * rng.normal(size=20)
    noise = estimate_noise(residual + levels[trip], trip, duration, levels=True)
    if sd == 0.0:
        assert noise.level_sd == 0.0
    else:
        assert noise.level_sd == pytest.approx(np.std(levels), rel=0.5)
        # and the colour of what is left is not mistaken for theirs
        assert noise.coefficients[1, 0] == pytest.approx(0.5, abs=0.15)


def test_levels_are_not_looked_for_in_few_trips():
    rng = np.random.default_rng(11)
    residual, trip, duration = trips(rng, (200,) * 3, (0.5,))
    assert estimate_noise(residual + 5.0 * trip, trip, duration, levels=True).level_sd == 0.0
    residual, trip, duration = trips(rng, (200,) * 20, (0.5,))
    assert estimate_noise(residual + 5.0 * (trip % 2), trip, duration, levels=False).level_sd == 0.0


@pytest.mark.parametrize("sd", [0.0, 1.5])
def test_levels_of_blocks(sd):
    """What wanders over ten minutes, in trips of two hours: seen where it is, not where it is not."""
    rng = np.random.default_rng(4)
    dt, rows = 5.0, int(12 * BLOCK_S / 5.0)
    residual, trip, duration = trips(rng, (rows,) * 4, (0.3,), dt)
    block = (np.arange(rows) * dt // BLOCK_S).astype(int)
    levels = sd * rng.normal(size=(4, 12))
    slow = np.concatenate([levels[t][block] for t in range(4)])
    noise = estimate_noise(residual + slow, trip, duration, levels=False)
    white = whiten((residual + slow)[:, None], noise, trip, duration)[:, 0]
    assert np.mean(white**2) == pytest.approx(1.0, abs=0.15)
    if sd == 0.0:
        assert noise.block_sd == 0.0
    else:
        assert noise.block_sd > 0.0
        # a level of every block stands out of the white rows no more than chance: 120 rows each
        means = np.array([white[(trip == t)][block == b].sum() / np.sqrt(120) for t in range(4) for b in range(12)])
        assert np.mean(means**2) < 1.5


def test_each_trip_has_its_scale():
    """A trip three times as noisy is scaled to the others; 50 rows of belief in one common scale are left."""
    rng = np.random.default_rng(8)
    residual, trip, duration = trips(rng, (1000,) * 6, (0.6,))
    loud = np.where(trip == 2, 3.0, 1.0)
    white, noise = white_of(loud * residual, trip, duration)
    assert noise.trip_scale[2] / np.median(noise.trip_scale) == pytest.approx(3.0, rel=0.15)
    for t in range(6):
        assert np.mean(white[trip == t] ** 2) == pytest.approx(1.0, abs=0.15)


def test_columns_are_whitened_alike_and_the_last_is_a_level():
    """Linear in the columns, whatever their number; the added one is what a level of one looks like."""
    rng = np.random.default_rng(2)
    residual, trip, duration = trips(rng, (90, 50, 70, 80), (0.7,))
    noise = estimate_noise(residual, trip, duration, levels=True)
    columns = rng.normal(size=(len(trip), 17))
    out = whiten(columns, noise, trip, duration)
    assert out.shape == (len(trip), 18)
    np.testing.assert_allclose(out[:, -1], whiten(np.ones((len(trip), 1)), noise, trip, duration)[:, 0])
    mix = rng.normal(size=17)
    np.testing.assert_allclose(out[:, :17] @ mix, whiten((columns @ mix)[:, None], noise, trip, duration)[:, 0])


@pytest.mark.parametrize("level_sd", [0.0, 0.7])
def test_the_likelihood_is_that_of_the_covariance(level_sd):
    """Dense: AR(1) inside a trip, a level of each trip integrated out, trips independent."""
    phi, lengths = 0.8, (9, 1, 14)
    rng = np.random.default_rng(3)
    residual, trip, _ = trips(rng, lengths, (phi,))
    sd = np.sqrt(1 / (1 - phi**2))
    noise = Noise(np.array([[0.0], [phi]]), np.array([sd, 1.0]), level_sd, np.ones(1), 0.0)
    slices = [s for _, s in trip_slices(trip)]
    expected = 0.0
    for s, n in zip(slices, lengths, strict=True):
        lag = np.abs(np.subtract.outer(np.arange(n), np.arange(n)))
        covariance = sd**2 * phi**lag + level_sd**2
        expected += stats.multivariate_normal(np.zeros(n), covariance).logpdf(residual[s])
    got = _log_likelihood(noise, residual, trip, slices) - 0.5 * len(trip) * np.log(2 * np.pi)
    assert got == pytest.approx(expected, rel=1e-9)


def test_long_trips_are_whitened_in_pieces(monkeypatch):
    """Rows before a piece count for its first ones."""
    rng = np.random.default_rng(0)
    trip = np.repeat([0, 1, 2], [150, 5, 45])
    noise = Noise(np.array([[0, 0], [0.8, 0], [1.1, -0.2]]), np.array([2.0, 1.2, 1.0]), 0.0, np.ones(3), 0.0)
    columns, seconds = rng.normal(size=(200, 3)), np.ones(200)
    whole = whiten(columns, noise, trip, seconds)
    monkeypatch.setattr("hdev_jax.diagnosis.noise.noise.PIECE", 37)
    np.testing.assert_allclose(whiten(columns, noise, trip, seconds), whole, rtol=1e-12, atol=1e-12)
