"""A vehicle sheet in the formats of other programs: compiled functions, a table, files of simulators."""

from hdev_jax.export.exported import Exported, LeftOut
from hdev_jax.export.kernel import Kernel, kernel_of

__all__ = ["Exported", "Kernel", "LeftOut", "kernel_of"]
