"""The result: diagnosis.json, intervals, checkpoints, the next drive."""

__all__ = []
