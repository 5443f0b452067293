"""Raw tables to the contract's columns in SI: headers, numbers, clocks, names of trips."""

from hdev_jax.logs.columns.pieces import ColumnInfo, Piece, translate

__all__ = ["ColumnInfo", "Piece", "translate"]
