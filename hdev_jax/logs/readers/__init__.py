"""Files in: bytes to raw tables, one module for each kind of file."""

from hdev_jax.logs.readers.files import find_files, read_raw
from hdev_jax.logs.readers.raw import Raw, place

__all__ = ["Raw", "find_files", "place", "read_raw"]
