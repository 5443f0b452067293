"""The start of an adapter for a log whose columns have other names, or that cannot be read without one."""

import re
from collections.abc import Mapping
from pathlib import Path

from hdev_jax.errors import InputError
from hdev_jax.logs.adapter import Adapter
from hdev_jax.logs.columns.headers import Header, parse_header
from hdev_jax.logs.guesses import guess
from hdev_jax.logs.presets import recognised
from hdev_jax.logs.readers import read_raw
from hdev_jax.logs.readers.files import format_of, read_bytes
from hdev_jax.logs.readers.layout import layout_of
from hdev_jax.logs.readers.matlab import numeric_variables
from hdev_jax.logs.readers.names import stem
from hdev_jax.units import COLUMNS, NEEDED_STEMS, accepted

__all__ = ["write_adapter_skeleton"]


def write_adapter_skeleton(path_of_log: str | Path, adapter: Adapter | None = None) -> str:
    """TOML text to fill in: a line for each column of the file, guesses commented out, units as the file says them.

    Of an `adapter` only the databases count, by which frames have names. A file that the reader refuses gets one too,
    with what it was refused for. Raises `InputError` where not even its header can be read.
    """
    path = Path(path_of_log)
    if not path.is_file():
        raise InputError(f"{path}: no such file")
    databases = adapter.dbc if adapter is not None else ()
    kind = format_of(path, Adapter())
    layout, trip_id, variable, headers, units = "table", "(.+)", "", list[str](), dict[str, str]()
    refused = ""
    if kind == "mat" and (pairs := _mat(path)) is not None:
        layout, trip_id, variable, headers = pairs
    if not headers:
        try:
            raw = read_raw(path, Adapter(dbc=databases))[0]
            headers, units = [str(c) for c in raw.table.columns], dict(raw.units)
            if raw.channels:
                headers, units = list(raw.channels), {n: c.unit for n, c in raw.channels.items() if c.unit}
        except InputError as e:
            if kind != "csv":
                raise
            headers, units = _header(path)
            refused = str(e)
    pairs_of = layout != "table"
    preset = recognised(headers)
    lines = [
        f"# Adapter for files such as {path.name}: fill in units, uncomment what fits, delete the rest.",
        *([f"# As it is the file is refused: {refused}"] if refused else []),
        f'format = "{kind}"',
        f'layout = "{layout}"' if pairs_of else '# layout = "time_value"   # variables that are [time, value]',
        f"trip_id = '{trip_id}'"
        if pairs_of
        else f"# trip_id = '^({re.escape(stem(path.name))})'   # else the file's name",
        *([f"variable = '{variable}'"] if variable else []),
        *([f"dbc = [{', '.join(_quoted(str(Path(d).resolve())) for d in databases)}]"] if databases else []),
        *([f'preset = "{preset.preset}"   # its header is known; what stands below goes before it'] if preset else []),
        '# companion = { suffix = ".grade.csv", on = "time_s" }',
        "# edge_trim_s = 0.0",
        *(_MENDS if refused else []),
        "",
        "[columns]",
        f"# needed: {', '.join(c for c, s in COLUMNS.items() if s in NEEDED_STEMS)}",
        f"# others: {', '.join(c for c, s in COLUMNS.items() if s not in NEEDED_STEMS)}",
    ]
    used: set[str] = set()
    lines += [_line(header, units, used) for header in headers]
    if {"voltage_v", "current_a"} <= used and not {"battery_power_w", "energy_wh"} & used:
        lines.append(
            "# battery_power_w is voltage_v times current_a, unless a column has it; positive out of the battery"
        )
    return "\n".join(lines) + "\n"


_MENDS = (
    "# header_line = 1            # the line that names the columns, counted from 1",
    '# decimal = ","              # or "."',
    """# thousands = "."            # or ",", "'", " ": what stands between thousands""",
    '# repeated_stamps = "spread" # several rows with one time stamp, at an even rate',
    '# time_zone = "Europe/Zurich"',
)


def _header(path: Path) -> tuple[list[str], dict[str, str]]:
    """The names of a text file that cannot be read to its end, and the units under them."""
    data = read_bytes(path, "csv")
    try:
        layout = layout_of(path, data.decode("utf-8-sig"))
    except UnicodeDecodeError:
        layout = layout_of(path, data.decode("cp1252", errors="replace"))
    names = [n or f"unnamed column {i + 1}" for i, n in enumerate(layout.names)]
    return names, {n: u for n, u in zip(names, layout.units or (), strict=False) if u not in ("", "-")}


def _quoted(text: str) -> str:
    return '"' + text.replace("\\", "\\\\").replace('"', '\\"') + '"'


def _line(header: str, units: Mapping[str, str], used: set[str]) -> str:
    if header in ("trip_id", "vehicle_id"):
        return f"# {header}: read as it is"
    try:
        parsed = parse_header(Header.of(header, units.get(header)))
    except InputError:
        parsed = None
    if parsed is not None and parsed.known:
        used.add(parsed.name)
        return f"# {header}: read as it is ({parsed.name})"
    found = guess(header, units.get(header))
    if found is None or found.name in used:
        return f"# … = {{ source = {_quoted(header)} }}"
    used.add(found.name)
    if found.name in ("trip_id", "vehicle_id"):
        return f"# {found.name} = {{ source = {_quoted(header)} }}   # a guess: of several columns [ … ]"
    given = f', unit = "{found.unit}"' if found.unit else ""
    choices = ", ".join(accepted(COLUMNS[found.name])[:4])
    why = "the unit as its header says" if found.sure else f"check the unit ({choices})"
    return f"# {found.name} = {{ source = {_quoted(header)}{given} }}   # a guess: {why}"


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
