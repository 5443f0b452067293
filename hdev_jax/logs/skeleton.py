"""The start of an adapter for a log whose columns have other names."""

import re
from pathlib import Path

from hdev_jax.errors import InputError
from hdev_jax.logs.adapter import Adapter
from hdev_jax.logs.readers import read_raw
from hdev_jax.logs.readers.files import read_bytes
from hdev_jax.logs.readers.matlab import numeric_variables
from hdev_jax.logs.readers.names import stem
from hdev_jax.units import COLUMNS, NEEDED_STEMS, accepted, parse_column

__all__ = ["write_adapter_skeleton"]

# what other people call the contract's columns, tried in this order
_GUESSES = (
    (r"motor.*torque|^m_torque", "motor_torque_nm", "N*m"),
    (r"rpm|motor.*speed", "motor_speed_radps", "rpm"),
    (r"wheel.*speed|wind", "", ""),
    (r"speed|velocity|^v$", "speed_mps", "m/s"),
    (r"^t$|time|clock", "time_s", "s"),
    (r"dist", "distance_m", "m"),
    (r"power|^kw$|_kw$", "battery_power_w", "kW"),
    (r"energy|kwh", "energy_wh", "kW*h"),
    (r"soc", "soc", "%"),
    (r"alt|elev|height", "altitude_m", "m"),
    (r"grade|slope|incl", "grade_rad", "tan"),
    (r"mass|weight", "mass_kg", "kg"),
    (r"amb.*temp|temp.*amb|outside", "ambient_temp_c", "degC"),
    (r"gear", "gear", ""),
    (r"force", "traction_force_n", "N"),
    (r"passenger", "passengers", ""),
)


def write_adapter_skeleton(path_of_log: str | Path) -> str:
    """TOML text to fill in: a line for each column of the file, guesses commented out.

    Raises `InputError` if the file cannot be read at all.
    """
    path = Path(path_of_log)
    if not path.is_file():
        raise InputError(f"{path}: no such file")
    layout, trip_id, variable, headers, kind = "table", "(.+)", "", [], "csv"
    if path.name.lower().endswith(".mat"):
        kind = "mat"
        raws = _mat(path)
        if raws is not None:
            layout, trip_id, variable, headers = raws
    if not headers:
        table = read_raw(path, Adapter(format=None))[0].table
        headers = [str(c) for c in table.columns]
    if path.name.lower().endswith((".parquet", ".pq")):
        kind = "parquet"
    pairs = layout != "table"
    lines = [
        f"# Adapter for files such as {path.name}: fill in units, uncomment what fits, delete the rest.",
        f'format = "{kind}"',
        f'layout = "{layout}"' if pairs else '# layout = "time_value"   # variables that are [time, value]',
        f"trip_id = '{trip_id}'"
        if pairs
        else f"# trip_id = '^({re.escape(stem(path.name))})'   # else the file's name",
        *([f"variable = '{variable}'"] if variable else []),
        '# companion = { suffix = ".grade.csv", on = "time_s" }',
        "# edge_trim_s = 0.0",
        "",
        "[columns]",
        f"# needed: {', '.join(c for c, s in COLUMNS.items() if s in NEEDED_STEMS)}",
        f"# others: {', '.join(c for c, s in COLUMNS.items() if s not in NEEDED_STEMS)}",
    ]
    used: set[str] = set()
    for header in headers:
        lines.append(_line(header, used))
    return "\n".join(lines) + "\n"


def _quoted(text: str) -> str:
    return '"' + text.replace("\\", "\\\\").replace('"', '\\"') + '"'


def _line(header: str, used: set[str]) -> str:
    try:
        parsed = parse_column(header)
    except InputError:
        parsed = None
    if parsed is not None and parsed.known:
        return f"# {header}: read as it is ({parsed.name})"
    if header in ("trip_id", "vehicle_id"):
        return f"# {header}: read as it is"
    for pattern, name, unit in _GUESSES:
        if re.search(pattern, header.lower()):
            if not name or name in used:
                break
            used.add(name)
            choices = ", ".join(accepted(COLUMNS[name])[:4])
            given = f', unit = "{unit}"' if unit else ""
            return f"# {name} = {{ source = {_quoted(header)}{given} }}   # a guess: check it ({choices})"
    return f"# … = {{ source = {_quoted(header)} }}"


def _mat(path: Path) -> tuple[str, str, str, list[str]] | None:
    """Layout `time_value` where the variables look like it, with expressions for trip and channel."""
    content = numeric_variables(path, read_bytes(path, "mat"))
    pairs = [n for n, a in content.items() if a.ndim == 2 and a.shape[1] == 2 and len(a) > 2 and a.dtype.kind == "f"]
    if not pairs:
        return None
    found = re.match(r"(.*?)(\d+)(_?)", pairs[0])
    if found is None:
        return "time_value", "(.+)", "", pairs
    head = re.escape(found.group(1)).replace("\\_", "_")
    trip = rf"{head}(\d+){found.group(3)}"
    rest = [re.sub(rf"^{head}\d+{found.group(3)}", "", n) for n in pairs]
    tail = _common_tail(rest)
    channel = rf"^{head}\d+{found.group(3)}(.+){re.escape(tail)}$"
    names = [r[: len(r) - len(tail)] for r in rest]
    return "time_value", trip, channel, list(dict.fromkeys(names))


def _common_tail(names: list[str]) -> str:
    """The end that all names share, from an underscore on (`_final`)."""
    tails = {n[n.rfind("_") :] if "_" in n else "" for n in names}
    return tails.pop() if len(names) > 1 and len(tails) == 1 else ""
