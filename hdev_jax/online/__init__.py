"""While the vehicle drives: coefficients, energy and the rest of the way, row by row through the same kernel."""

from hdev_jax.online.forecast import Forecast, forecast
from hdev_jax.online.form import Form, packed
from hdev_jax.online.state import Now, State, stacked, start
from hdev_jax.online.update import scan, update
from hdev_jax.online.watch import Alarm, Watch

__all__ = [
    "Alarm",
    "Forecast",
    "Form",
    "Now",
    "State",
    "Watch",
    "forecast",
    "packed",
    "scan",
    "stacked",
    "start",
    "update",
]
