"""Signals out of the bytes of many frames at once: what a database calls start, length, byte order, sign and scale."""

from collections.abc import Mapping
from typing import Any

import numpy as np

__all__ = ["physical", "raw_bits"]

_WINDOW = 8  # bytes that a shift works on


def raw_bits(signal: Any, data: np.ndarray) -> np.ndarray | None:
    """The bits of a signal (of cantools) as whole numbers `[frame]`, without sign and scale; None where the frames are
    too short to hold it, or it is a text of more than 64 bits. **Arguments:** `data`, bytes `[frame, byte]`."""
    first, length = signal.start // 8, signal.length
    little = signal.byte_order == "little_endian"
    skipped = signal.start % 8 if little else 7 - signal.start % 8
    needed = -(-(skipped + length) // 8)
    if length > 64 or first + needed > data.shape[1]:
        return None
    window = np.zeros((len(data), _WINDOW + 1), np.uint8)
    window[:, :needed] = data[:, first : first + needed]
    eight = np.ascontiguousarray(window[:, :_WINDOW]).view("<u8" if little else ">u8")[:, 0].astype(np.uint64)
    ninth = window[:, _WINDOW].astype(np.uint64)
    if little:
        bits = eight >> np.uint64(skipped)
        if skipped + length > 64:
            bits |= ninth << np.uint64(64 - skipped)
    else:
        bits = eight << np.uint64(skipped)
        if skipped + length > 64:
            bits |= ninth >> np.uint64(8 - skipped)
        bits >>= np.uint64(64 - length)
    return bits & np.uint64((1 << length) - 1)


def physical(signal: Any, data: np.ndarray, others: Mapping[str, Any], j1939: bool) -> np.ndarray:
    """A signal's values `[frame]` in its unit, NaN where a frame has none: too short, another multiplexed signal in its
    place, or a number that stands for "not available" or "error" (`j1939`, or the database's own words)."""
    bits = raw_bits(signal, data)
    if bits is None:
        return np.full(len(data), np.nan)
    conversion = signal.conversion
    if conversion.is_float:
        of_width = {16: (np.uint16, np.float16), 32: (np.uint32, np.float32), 64: (np.uint64, np.float64)}
        whole, real = of_width[signal.length]
        x = bits.astype(whole).view(real).astype(np.float64)
    elif signal.is_signed:
        sign = np.int64(1 << (signal.length - 1)) if signal.length < 64 else np.int64(0)
        whole = bits.astype(np.int64)
        x = ((whole ^ sign) - sign if signal.length < 64 else whole).astype(np.float64)
    else:
        x = bits.astype(np.float64)
    out = np.asarray(conversion.offset + conversion.scale * x, np.float64)
    none = _stands_for_none(signal, x)
    if not signal.is_signed and not conversion.is_float:
        if j1939:
            none |= _beyond_valid(bits, signal.length)
        if (most := signal.maximum) is not None and most > (signal.minimum or 0.0):
            # all ones, and more than the database says that there can be: the custom of most makers
            none |= (bits == np.uint64((1 << signal.length) - 1)) & (out > float(most))
    return np.where(none | ~_present(signal, data, others), np.nan, out)


def _present(signal: Any, data: np.ndarray, others: Mapping[str, Any]) -> np.ndarray:
    """Whether a multiplexed signal is in a frame, by its multiplexer, which may be multiplexed itself."""
    if signal.multiplexer_ids is None:
        return np.ones(len(data), bool)
    multiplexer = others[signal.multiplexer_signal]
    found = raw_bits(multiplexer, data)
    if found is None:
        return np.zeros(len(data), bool)
    return np.isin(found, np.array(signal.multiplexer_ids, np.uint64)) & _present(multiplexer, data, others)


_NONE = ("sna", "not available", "not_available", "notavailable", "n/a", "error", "invalid", "unavailable", "undefined")


def _stands_for_none(signal: Any, x: np.ndarray) -> np.ndarray:
    """Numbers that the database calls "SNA", "not available", "error": no values of the quantity."""
    named = signal.conversion.choices or {}
    words = [k for k, v in named.items() if any(w in str(v).lower() for w in _NONE)]
    return np.isin(x, np.array(words, np.float64))


def _beyond_valid(bits: np.ndarray, length: int) -> np.ndarray:
    """SAE J1939-71, tables 1 and 2: of whole bytes, a highest byte above 0xFA; of 2 bits 10 and 11; of 4 bits 1110 and
    1111; of other lengths all ones."""
    if length % 8 == 0:
        return bits >> np.uint64(length - 8) > np.uint64(0xFA)
    if length in (2, 4):
        return bits >= np.uint64((1 << length) - 2)
    return bits == np.uint64((1 << length) - 1) if length > 1 else np.zeros(len(bits), bool)
