"""The page of a fleet of measured vehicles."""

from hdev_jax.report.many.page import fleet_page, fleet_pieces, fleet_text

__all__ = ["fleet_page", "fleet_pieces", "fleet_text"]
