"""Rows of all files together: gathered in trips, checked, repaired, split at gaps."""

from hdev_jax.logs.rows.checked import check_rows
from hdev_jax.logs.rows.gathered import Rows, concatenate
from hdev_jax.logs.rows.trips import split_trips

__all__ = ["Rows", "check_rows", "concatenate", "split_trips"]
