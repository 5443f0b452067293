"""Which trips are for training and which are held out for testing."""

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np

from hdev_jax.errors import InputError
from hdev_jax.logs import Log

__all__ = ["LAST_THIRD", "Split", "split_trips"]

LAST_THIRD = " (last third)"  # what the test part of a single trip is called after it


@dataclass(frozen=True)
class Split:
    """Trip ids by use; they index `log.trip_names`. `log` is the log they belong to: one trip alone has two parts."""

    log: Log
    train: tuple[int, ...]
    test: tuple[int, ...]
    unused: tuple[int, ...]

    def names(self, ids: Sequence[int]) -> list[str]:
        """Names of trips."""
        return [self.log.trip_names[i] for i in ids]


def split_trips(log: Log, train: Sequence[str] | None = None, test: Sequence[str] | None = None) -> Split:
    """Training and test trips as the contract says (§3).

    Only `train`: all others test; only `test`: all others train; both: the rest is unused; neither: every third trip
    tests (of two the second, of one its last third by time). Raises `InputError` for a trip that is not in the log or
    is in both lists, or where a side stays empty.
    """
    count = len(log.trip_names)
    if train is None and test is None and count == 1:
        log, count = _halves(log), 2
    chosen_train, chosen_test = _ids(log, train, "--train-trips"), _ids(log, test, "--test-trips")
    if both := sorted(set(chosen_train) & set(chosen_test)):
        raise InputError(f"trip {log.trip_names[both[0]]!r} is in --train-trips and in --test-trips; keep it in one")
    every = tuple(range(count))
    if train is None and test is None:
        chosen_test = (1,) if count == 2 else every[2::3]
        chosen_train = tuple(i for i in every if i not in chosen_test)
    elif test is None:
        chosen_test = tuple(i for i in every if i not in chosen_train)
    elif train is None:
        chosen_train = tuple(i for i in every if i not in chosen_test)
    for ids, side, other in ((chosen_train, "training", "--test-trips"), (chosen_test, "test", "--train-trips")):
        if not ids:
            raise InputError(
                f"no {side} trip is left: the log has {', '.join(log.trip_names)}; leave some out of {other}"
            )
    unused = tuple(i for i in every if i not in chosen_train and i not in chosen_test)
    return Split(log, chosen_train, chosen_test, unused)


def _ids(log: Log, names: Sequence[str] | None, option: str) -> tuple[int, ...]:
    out = []
    for name in names or ():
        if name not in log.trip_names:
            known = ", ".join(log.trip_names[:12]) + (", …" if len(log.trip_names) > 12 else "")
            raise InputError(f"{option}: no trip {name!r} in the log; it has {known}")
        out.append(log.trip_names.index(name))
    return tuple(dict.fromkeys(out))


def _halves(log: Log) -> Log:
    """One trip in two parts: its first two thirds and its last third by time.

    It stays one trip in the segments: what depends on the time since its start continues in the second part.
    """
    seconds = np.cumsum(log.segments.duration_s)
    late = seconds > seconds[-1] * 2.0 / 3.0
    if late.all() or not late.any():
        raise InputError(f"trip {log.trip_names[0]!r} is too short to be split into training and test; add trips")
    name = log.trip_names[0]
    return replace(log, part=late.astype(np.int32), trip_names=(f"{name} (first two thirds)", f"{name}{LAST_THIRD}"))
