"""Objects with the attributes that a test needs alone: of the class that a type check asks for."""

from typing import Any

__all__ = ["bare"]


def bare(cls: type, **values: Any) -> Any:
    """An object of the class that has these attributes alone."""
    made = object.__new__(cls)
    for name, value in values.items():
        object.__setattr__(made, name, value)
    return made
