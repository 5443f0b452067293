"""Many vehicles followed by one process behind HTTP: rows in, estimates, alarms and forecasts out."""

from hdev_jax.online.service.fleet import Fleet
from hdev_jax.online.service.given import RefusedError, sheets_in
from hdev_jax.online.service.journal import Journal, UnavailableError

__all__ = ["Fleet", "Journal", "RefusedError", "UnavailableError", "sheets_in"]
