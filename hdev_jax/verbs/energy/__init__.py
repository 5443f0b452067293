"""The verbs that answer about energy: ledger, roadload, whatif, saved, compare."""

__all__ = []
