"""Options of the command line: those that verbs share, and the parsers of the verbs about energy."""

__all__ = []
