"""The log of a run: what was done when, added to by whoever resumes it."""

import datetime
from pathlib import Path

from hdev_jax import progress

__all__ = ["Log"]


class Log:
    """Lines with the time (UTC) in a file, and on the terminal as steps; `path` None: only there."""

    def __init__(self, path: Path | None):
        self._path = path
        if path is not None:
            path.parent.mkdir(parents=True, exist_ok=True)

    @property
    def path(self) -> Path:
        """The file. **Raises:** `ValueError` where there is none."""
        if self._path is None:
            raise ValueError("this log has no file")
        return self._path

    def say(self, text: str, *, shown: bool = True) -> None:
        """A line; `shown`: on the terminal too."""
        if shown:
            progress.step(text)
        if self._path is not None:
            now = datetime.datetime.now(datetime.UTC).isoformat(timespec="seconds")
            with open(self._path, "a", encoding="utf-8") as file:
                file.write(f"{now}  {' '.join(text.split())}\n")
