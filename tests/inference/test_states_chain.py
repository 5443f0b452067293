"""Filter, smoother and draws of hidden chains against the sum over every sequence of states."""

import itertools

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from hdev_jax.inference.states.chain import draw, smooth

ROWS, CHAINS = 6, 2


@pytest.fixture(params=[2, 3])
def chains(request):
    states = request.param
    rng = np.random.default_rng(states)
    moves = rng.uniform(0.05, 1.0, (ROWS, CHAINS, states, states))
    moves /= moves.sum(axis=-1, keepdims=True)
    moves[0] = moves[0, :, :1]  # nothing goes before a first row
    moves[3] = moves[3, :, :1]  # nor before a new trip
    return moves, np.exp(rng.normal(0.0, 2.0, moves.shape))


def every_path(moves, fits, chain):
    """Each sequence of states, that before the first row included, and its probability."""
    states = moves.shape[-1]
    paths = np.array(list(itertools.product(range(states), repeat=ROWS + 1)))
    p = np.full(len(paths), 1.0 / states)
    for t in range(ROWS):
        i, j = paths[:, t], paths[:, t + 1]
        p = p * moves[t, chain, i, j] * fits[t, chain, i, j]
    return paths, p


def test_smoother_is_the_sum_over_all_sequences(chains):
    moves, fits = chains
    found = smooth(jnp.asarray(moves), jnp.asarray(fits))
    states = moves.shape[-1]
    for c in range(CHAINS):
        paths, p = every_path(moves, fits, c)
        np.testing.assert_allclose(found.log_likelihood[c], np.log(p.sum()), rtol=1e-10)
        for t in range(ROWS):
            pairs = np.zeros((states, states))
            np.add.at(pairs, (paths[:, t], paths[:, t + 1]), p / p.sum())
            np.testing.assert_allclose(found.pairs[t, c], pairs, atol=1e-10)


def test_filter_knows_the_rows_before_alone(chains):
    moves, fits = chains
    found = smooth(jnp.asarray(moves), jnp.asarray(fits))
    later = fits.copy()
    later[4:] = 7.0
    again = smooth(jnp.asarray(moves), jnp.asarray(later))
    np.testing.assert_allclose(again.ahead[:5], found.ahead[:5], atol=1e-12)
    np.testing.assert_allclose(again.filtered[:4], found.filtered[:4], atol=1e-12)
    assert np.max(np.abs(again.filtered[4] - found.filtered[4])) > 1e-3


def test_draws_have_the_smoothers_frequencies(chains):
    moves, fits = (jnp.asarray(x) for x in chains)
    found = smooth(moves, fits)
    n = 4000
    drawn = jax.vmap(lambda k: draw(found.filtered, moves, fits, key=k))(jax.random.split(jax.random.key(1), n))
    after = np.asarray(found.pairs).sum(axis=2)
    for state in range(moves.shape[-1]):
        share = np.mean(np.asarray(drawn) == state, axis=0)
        error = np.sqrt(after[..., state] * (1 - after[..., state]) / n)
        assert np.all(np.abs(share - after[..., state]) < 5 * error + 1e-3)


def test_a_row_that_no_state_fits_gives_no_nan():
    moves = jnp.full((4, 1, 2, 2), 0.5)
    fits = jnp.zeros((4, 1, 2, 2))
    found = smooth(moves, fits)
    assert all(np.all(np.isfinite(x)) for x in found)
