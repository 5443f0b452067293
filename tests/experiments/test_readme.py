"""The numbers of README.md are those of the pages that commands made."""

import re
from pathlib import Path

ROOT = Path(__file__).parents[2]
README = (ROOT / "README.md").read_text(encoding="utf-8")
TEXT = " ".join(README.split())
REAL, PLANTED, SIMULATORS = (
    (ROOT / "docs" / name).read_text(encoding="utf-8")
    for name in ("real_logs.md", "planted_summary.md", "simulators_quick.md")
)


def row(page: str, name: str) -> list[str]:
    """Cells of the first row of a page's table with this name."""
    line = next(x for x in page.splitlines() if x.startswith(f"| {name} |"))
    return [cell.strip() for cell in line.strip("|").split("|")]


def test_errors_on_measured_logs_are_those_of_the_page():
    before, after = re.search(r"\*\*ZTBus\*\*: test RMSE (\S+) → (\S+) kW", REAL).groups()  # pyright: ignore
    assert f"RMSE {after} kW" in README
    assert f"{before} kW for the calibrated sheet" in README
    pooled = next(x for x in REAL.splitlines() if x.startswith("| pooled |")).split("|")
    assert f"({pooled[4].strip()} kW if the on and off states of two loads are read" in README
    each = [row(REAL, str(trip)) for trip in (1, 2, 3, 4)]
    mse, numbers = sorted(float(r[2]) for r in each), sorted(int(r[3]) for r in each)
    assert f"MSE {mse[0]:.3f} to {mse[-1]:.3f} kW² with {numbers[0]} to {numbers[-1]} parameters" in README
    assert "paper's best network (NARXS), trained on trip 1 (its table VIII): 0.1604" in REAL
    assert "0.1604 kW² for the best network of the paper (NARXS)" in README


def test_shares_of_synthetic_logs_are_those_of_the_page():
    for size, words in (
        (0.5, "half as large as the noise (RMS of what it adds to a row), is named exactly in"),
        (0.25, "a quarter as large in"),
    ):
        _, n, share, *_ = row(PLANTED, f"one effect, size {size}, 12 trips, ar1")
        assert f"{words} {round(100 * float(share))} % of {n}" in TEXT
    _, n, share, *_ = row(PLANTED, "nothing planted, all together")
    assert f"an effect is named in {round((1 - float(share)) * int(n))} of {n} logs" in TEXT
    outside = [row(PLANTED, f"a {what} outside the library, size 1, 24 trips, ar1") for what in ("cause", "cycle")]
    at = row(PLANTED, "name").index("false name")
    wrong, logs = sum(float(r[at]) * int(r[1]) for r in outside), sum(int(r[1]) for r in outside)
    assert f"a wrong one is named in {round(wrong)} of {logs}." in TEXT


def test_shares_of_logs_by_other_simulators_are_those_of_the_page():
    _, n, right, false, blamed, *_ = row(SIMULATORS, "any change")
    assert f"The change is named in {round(100 * float(right))} % of {n} logs" in TEXT
    assert f"a false name is given in {round(100 * float(false))} %; in {round(100 * float(blamed))} % it is" in TEXT
    _, _, _, lasso, *_ = row(SIMULATORS, "LassoCV")
    assert f"LassoCV gives a false name in {round(100 * float(lasso))} %" in TEXT
