"""While the vehicle drives: coefficients, energy and the rest of the way, row by row through the same kernel."""

from hdev_jax.online.form import Form, packed
from hdev_jax.online.state import Now, State, stacked, start
from hdev_jax.online.update import scan, update

__all__ = ["Form", "Now", "State", "packed", "scan", "stacked", "start", "update"]
