"""What survives a kill: acknowledged rows and states, in SQLite or in PostgreSQL."""

from hdev_jax.online.service.journal.database import UnavailableError
from hdev_jax.online.service.journal.journal import Journal, Kept, Sent

__all__ = ["Journal", "Kept", "Sent", "UnavailableError"]
