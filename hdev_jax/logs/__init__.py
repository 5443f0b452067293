"""Files in: readers, adapters, checks; what was dropped and why."""

from hdev_jax.logs.adapter import Adapter, Companion, Rule
from hdev_jax.logs.columns import ColumnInfo
from hdev_jax.logs.ledger import Entry, Ledger
from hdev_jax.logs.log import MEASURED, Log
from hdev_jax.logs.read import log_from_frame, read_log
from hdev_jax.logs.skeleton import write_adapter_skeleton
from hdev_jax.logs.stretches import by_distance

__all__ = [
    "MEASURED",
    "Adapter",
    "ColumnInfo",
    "Companion",
    "Entry",
    "Ledger",
    "Log",
    "Rule",
    "by_distance",
    "log_from_frame",
    "read_log",
    "write_adapter_skeleton",
]
