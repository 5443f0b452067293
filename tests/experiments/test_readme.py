"""The numbers of README.md are those of the pages that commands made."""

import re
from pathlib import Path

ROOT = Path(__file__).parents[2]
README = (ROOT / "README.md").read_text(encoding="utf-8")
TEXT = " ".join(README.split())
REAL, PLANTED, SIMULATORS, WRONG, PAPER_2 = (
    (ROOT / "docs" / name).read_text(encoding="utf-8")
    for name in ("real_logs.md", "planted_summary.md", "simulators_quick.md", "wrong.md", "paper2.md")
)


def row(page: str, name: str) -> list[str]:
    """Cells of the first row of a page's table with this name."""
    line = next(x for x in page.splitlines() if x.startswith(f"| {name} |"))
    return [cell.strip() for cell in line.strip("|").split("|")]


def cell(page: str, name: str, column: str) -> float:
    """The number in a column of the first table that has both the column and a row of this name."""
    head: list[str] = []
    for line in page.splitlines():
        cells = [c.strip() for c in line.strip("|").split("|")]
        head = [] if not line.startswith("|") else head or cells
        if column in head and cells[0] == name:
            return float(cells[head.index(column)])
    raise AssertionError(f"no table has a column {column} and a row {name}")


def percent(share: float) -> int:
    return round(100 * share)


def test_errors_on_measured_logs_are_those_of_the_page():
    before, after = re.search(r"\*\*ZTBus\*\*: test RMSE (\S+) → (\S+) kW", REAL).groups()  # pyright: ignore
    assert f"RMSE {after} kW" in README
    assert f"{before} kW for the calibrated sheet" in README
    pooled = next(x for x in REAL.splitlines() if x.startswith("| pooled |")).split("|")
    assert f"(RMSE {pooled[4].strip()} kW if the on and off states of two loads are decoded" in README
    assert f"mean absolute error of a mission's energy {pooled[5].strip()} (" in README
    each = [row(REAL, str(trip)) for trip in (1, 2, 3, 4)]
    mse, numbers = sorted(float(r[2]) for r in each), sorted(int(r[3]) for r in each)
    assert f"MSE {mse[0]:.3f} to {mse[-1]:.3f} kW² with {numbers[0]} to {numbers[-1]} parameters" in README
    assert "best network (NARXS, its table VIII), trained on trip 1: MSE 0.1604" in REAL
    assert f"(trained on trip 1: {float(each[0][2]):.3f})" in README
    assert "0.1604 kW² for the best network of [paper 2](docs/paper2.md) (NARXS), trained on trip 1" in README
    again = [x.split("|") for x in PAPER_2.splitlines() if x.startswith("| NARXS | test MSE, mean [kW²] | 0.1604 |")]
    fitted, median = {(f"{float(x[4]):.3f}", f"{float(x[6]):.3f}") for x in again}.pop()
    assert f"the same network fitted here: {fitted} (median of 16 random starts: {median})" in README
    assert "NARXS (16 starts)" in PAPER_2


def test_shares_of_synthetic_logs_are_those_of_the_page():
    alone = []
    for size, words in ((0.5, "is half that of the noise"), (0.25, "if it is a quarter")):
        name = f"one effect, effect/noise {size}, 12 trips, AR(1)"
        right = f"{percent(cell(PLANTED, name, 'right'))} % of {cell(PLANTED, name, 'n'):.0f} logs"
        assert re.search(rf"{right} if [^;(|]*{words.removeprefix('if ')}", TEXT)
        alone.append(percent(cell(PLANTED, name, "named alone")))
    assert f"(named alone: {alone[0]} and {alone[1]} %)" in TEXT
    quiet = "nothing planted, all together"
    n = cell(PLANTED, quiet, "n")
    assert f"an effect is named all the same | {(1 - cell(PLANTED, quiet, 'right')) * n:.0f} of {n:.0f} logs" in TEXT
    outside = [f"a {what} outside the library, effect/noise 1, 24 trips, AR(1)" for what in ("cause", "cycle")]
    wrong = sum(cell(PLANTED, name, "false name") * cell(PLANTED, name, "n") for name in outside)
    of = sum(cell(PLANTED, name, "n") for name in outside)
    assert f"a wrong effect is named | {wrong:.0f} of {of:.0f} logs" in TEXT


def test_shares_of_logs_by_other_simulators_are_those_of_the_page():
    any_change, wind = "any change", "headwind of 4 m/s"
    n, false = cell(SIMULATORS, any_change, "n"), percent(cell(SIMULATORS, any_change, "false name"))
    blamed = percent(cell(SIMULATORS, any_change, "instrument or payload falsely named"))
    right, winds = percent(cell(SIMULATORS, any_change, "right")), cell(SIMULATORS, wind, "n")
    of_winds = f"{cell(SIMULATORS, wind, 'right') * winds:.0f} of {winds:.0f}"
    assert f"{right} % of {n:.0f} logs; of headwinds {of_winds}. A false name in {false} %, beside" in TEXT
    assert f"(in {blamed} % an instrument fault or a payload error)" in TEXT
    none = cell(SIMULATORS, "nothing", "n")
    ours, lasso, stlsq = (
        [f"{100 * cell(SIMULATORS, name, column):.1f}" for column in ("false name", "named")]
        for name in ("hdev_jax", "LassoCV", "STLSQ (PySINDy)")
    )
    said = f"{ours[1]} %; a false name in {ours[0]} % of all {n + none:.0f} logs ({n:.0f} changed, {none:.0f} not)"
    assert f"{said} | LassoCV {lasso[1]} and {lasso[0]} %, STLSQ {stlsq[1]} and {stlsq[0]} % |" in TEXT
    assert f"a false name is given in {false} % of the logs in which one thing was changed" in " ".join(WRONG.split())
