"""Hidden states of what a vehicle's prediction leaves: on/off loads, what drifts, the mode of each trip.

On/off loads are a hidden Markov model. Each load is a two-state chain in continuous time, so rows may have any
length: over a row of Δt it keeps its state with the weight e^(−Δt/memory) and otherwise takes one by its share of
time on. A row in which it switches holds some share of its power. About the levels the residual is an autoregression
of first order with Student-t innovations, whose degrees of freedom are estimated and whose scale differs between
standstill and motion; where energies are measured, an error is a small power in a long row. Parameters by
expectation-maximisation (Rabiner, Proc. IEEE 77, 1989; Hamilton, Econometrica 57, 1989; Lange, Little and Taylor,
JASA 84, 1989), trips as separate sequences. What drifts is a Gauss-Markov process (`course`), the mode of a trip a
chain from trip to trip (`probability_of_modes`).
"""

from hdev_jax.inference.states.chances import contrasts, what_it_depends_on
from hdev_jax.inference.states.course import course
from hdev_jax.inference.states.decode import Decoded, decode, energy_draws
from hdev_jax.inference.states.fit import errors_alone, fit_switching, rise, shares_of
from hdev_jax.inference.states.model import Switching
from hdev_jax.inference.states.modes import probability_of_modes
from hdev_jax.inference.states.rows import StateRows, rows_of

__all__ = [
    "Decoded",
    "StateRows",
    "Switching",
    "contrasts",
    "course",
    "decode",
    "energy_draws",
    "errors_alone",
    "fit_switching",
    "probability_of_modes",
    "rise",
    "rows_of",
    "shares_of",
    "what_it_depends_on",
]
