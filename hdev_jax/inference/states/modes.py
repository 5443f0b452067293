"""A state of a whole trip: which of two modes each is in, by a chain from trip to trip.

A vehicle's trips in their order are the rows of a hidden Markov chain of two states, a trip's log-likelihood with
either value of the coefficient being what its row fits. The chances of changing from one trip to the next are estimated
by expectation-maximisation.
"""

import jax.numpy as jnp
import numpy as np
from jaxtyping import Float, Int

from hdev_jax.inference.states.chain import smooth

__all__ = ["probability_of_modes"]

ROUNDS = 10  # of expectation-maximisation
COUNTED = 1.0  # changes and stays of either mode that are counted beforehand


def probability_of_modes(
    log_likelihood: Float[np.ndarray, "trip 2"], vehicle: Int[np.ndarray, " trip"]
) -> Float[np.ndarray, " trip"]:
    """The probability that each trip is in the second mode, given all trips of its vehicle.

    **Arguments:** the log-likelihood of each trip in the first and in the second mode; `vehicle`, trips of one being
    contiguous and in the order in which they were driven.
    """
    first = np.r_[True, np.diff(vehicle) != 0]
    likelihood = np.exp(log_likelihood - log_likelihood.max(axis=1, keepdims=True))
    fits = jnp.asarray(np.broadcast_to(likelihood[:, None, None, :], (len(first), 1, 2, 2)))
    change, share = np.full((2, 2), 0.5), np.full(2, 0.5)
    pairs = np.zeros((len(first), 2, 2))
    for _ in range(ROUNDS):
        moves = np.where(first[:, None, None], share, change)[:, None]
        pairs = np.asarray(smooth(jnp.asarray(moves), fits).pairs)[:, 0]
        counted = pairs[~first].sum(axis=0) + COUNTED
        change = counted / counted.sum(axis=1, keepdims=True)
        share = pairs.sum(axis=(0, 1)) + COUNTED
        share = share / share.sum()
    return pairs[:, :, 1].sum(axis=1)
