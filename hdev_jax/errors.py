"""The exception for every fault that the user can put right: `hdev` prints it as one line and exits with status 2."""

__all__ = ["InputError", "MissingColumnError"]


class InputError(Exception):
    """The input is at fault. The message is one line: which file, row, column; what was expected; what to do."""

    def __init__(self, message: str):
        line = " ".join(str(message).split())
        # what a damaged file holds must not reach the terminal as control characters
        super().__init__("".join(c if c.isprintable() else "\N{REPLACEMENT CHARACTER}" for c in line))


class MissingColumnError(InputError):
    """A column that every log needs is missing, or has another name."""
