"""Progress on standard error: silent in the library, shown by the commands.

```python
with progress.shown():
    progress.step("calibrating")
    for trip in progress.track(trips, "resampling"):
        …
```
"""

import contextlib
import contextvars
import time
from collections.abc import Iterable, Iterator, Sized
from typing import TYPE_CHECKING, TypeVar

if TYPE_CHECKING:
    from rich.console import Console

__all__ = ["busy", "shown", "step", "track"]

T = TypeVar("T")
EVERY_S = 60.0  # between the lines of a long loop, where there is no terminal

_console: contextvars.ContextVar["tuple[Console, float] | None"] = contextvars.ContextVar("progress", default=None)


@contextlib.contextmanager
def shown() -> Iterator[None]:
    """Show steps and bars inside the block; without it, as in a library call, nothing is written."""
    from rich.console import Console

    token = _console.set((Console(stderr=True, highlight=False, soft_wrap=True), time.monotonic()))
    try:
        yield
    finally:
        _console.reset(token)


def step(message: str) -> None:
    """One line: the seconds since the start, and what begins now."""
    if (state := _console.get()) is not None:
        console, start = state
        console.print(f"{time.monotonic() - start:6.1f} s  {message}", markup=False)


@contextlib.contextmanager
def busy(message: str) -> Iterator[None]:
    """A sign of life on a terminal that goes when the block ends; elsewhere nothing.

    For what may still refuse the input: a refusal is one line and no other.
    """
    state = _console.get()
    if state is not None and state[0].is_terminal:
        with state[0].status(message):
            yield
    else:
        yield


def track(items: Iterable[T], message: str, total: int | None = None) -> Iterator[T]:
    """The items, with a bar on a terminal that goes when they end; elsewhere a line, and one more a minute at most.

    **Arguments:** `total` is the number of items where `len(items)` does not give it.
    """
    state = _console.get()
    if state is None:
        yield from items
    elif state[0].is_terminal:
        from rich.progress import track as bar

        yield from bar(items, message, total=total, console=state[0], transient=True)
    else:
        step(message)
        said = time.monotonic()
        of = total if total is not None else len(items) if isinstance(items, Sized) else None
        for done, item in enumerate(items, 1):
            yield item
            if time.monotonic() - said > EVERY_S and done != of:
                said = time.monotonic()
                step(f"{message}: {done}" + (f" of {of}" if of is not None else ""))
