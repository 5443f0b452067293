"""Files in: readers, adapters, checks; what was dropped and why."""

from hdev_jax.logs.adapter import Adapter, Companion, Rule
from hdev_jax.logs.columns import ColumnInfo
from hdev_jax.logs.ledger import Entry, Ledger
from hdev_jax.logs.log import MEASURED, TARGETS, Log
from hdev_jax.logs.read import read_log
from hdev_jax.logs.skeleton import write_adapter_skeleton
from hdev_jax.logs.stretches import by_distance

__all__ = [
    "MEASURED",
    "TARGETS",
    "Adapter",
    "ColumnInfo",
    "Companion",
    "Entry",
    "Ledger",
    "Log",
    "Rule",
    "by_distance",
    "read_log",
    "write_adapter_skeleton",
]
