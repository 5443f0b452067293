"""What an export came to: the file's bytes, and what its format cannot hold."""

from dataclasses import dataclass, field
from typing import Any

__all__ = ["Exported", "LeftOut"]


@dataclass(frozen=True)
class LeftOut:
    """One thing of the sheet that a format cannot hold: `what` it is, by its key in a sheet, and `why`.

    `share`: the energy that it stands for on the check drive, over all of it; None where that is no energy of its own.
    """

    what: str
    why: str
    share: float | None = None

    def __str__(self) -> str:
        costs = "" if self.share is None else f" ({100 * self.share:+.2g} % of the energy on the check drive)"
        return f"{self.what}: {self.why}{costs}"


@dataclass(frozen=True)
class Exported:
    """Content of the file; `about` it, plain values for the JSON file beside; `left_out`, what it does not hold."""

    content: bytes
    about: dict[str, Any]
    left_out: tuple[LeftOut, ...] = field(default=())
