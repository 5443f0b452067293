"""The page of a run: what was found first, a short table open, the rest on a click; words left, numbers right."""

import json
from pathlib import Path

import pytest

from experiments.runner.pages.html import MOST_COLUMNS, MOST_ROWS, of_run, write_html
from experiments.runner.tables import markdown

METRICS = {
    "artefact": "toy", "data": "none", "synthetic": False, "better_than_paper": 1, "of": 2, "seconds": 3.0,
    "tasks_left_out": 0, "findings": ["Three of four are found"], "missed": ["share 0.75, target 0.9"], "notes": [],
    "rows": [
        {"name": "bias", "paper": {"PE": 2.0, "RMSE": 4.0}, "ours": {"PE": -1.0, "RMSE": None}, "reason": "left out"},
    ],
}  # fmt: skip


def run_of(folder: Path, rows: int) -> Path:
    table = [["name", "what", "size [kW]"], *([f"log {k}", "a bus, cold", "−1.5 ± 0.2"] for k in range(rows))]
    (folder / "tables").mkdir(parents=True)
    (folder / "figures").mkdir()
    (folder / "tables" / "table.md").write_text(markdown(table, "All logs"), encoding="utf-8")
    (folder / "tables" / "a_more.md").write_text(markdown(table[:2], "More"), encoding="utf-8")
    (folder / "figures" / "all.png").write_bytes(b"not drawn")
    (folder / "metrics.json").write_text(json.dumps(METRICS))
    return folder


@pytest.mark.parametrize(("rows", "is_open"), [(MOST_ROWS, True), (MOST_ROWS + 1, False)])
def test_a_page_begins_with_what_was_found_and_folds_a_long_table(tmp_path, rows, is_open):
    part = of_run(run_of(tmp_path / "run", rows), METRICS)
    write_html(tmp_path / "page.html", "Toy", [part])
    page = (tmp_path / "page.html").read_text(encoding="utf-8")
    head, *folded = page.split("<details>")
    assert "At least as good as the paper in 1 of 2 comparisons. Three of four are found." in head
    assert ("<caption>All logs" in head) is is_open
    assert f"Table of {rows} rows" in "".join(folded) or is_open
    assert any("Targets missed" in x and "share 0.75, target 0.9" in x for x in folded)
    assert not any("<summary>Notes" in x for x in folded), "there are none"
    assert any("<caption>More" in x and "<caption>Paper against ours" in x for x in folded)


def test_words_begin_at_the_left_and_numbers_end_at_the_right(tmp_path):
    write_html(tmp_path / "page.html", "Toy", [of_run(run_of(tmp_path / "run", 2), METRICS)])
    page = (tmp_path / "page.html").read_text(encoding="utf-8")
    assert '<td class="l">a bus, cold</td>' in page
    assert "<td>−1.5 ± 0.2</td>" in page
    assert '<th class="l">what</th>' in page
    assert "<th>size [kW]</th>" in page


def test_an_error_with_a_sign_is_compared_by_its_size(tmp_path):
    part = of_run(run_of(tmp_path / "run", 2), METRICS)
    (lines,) = [t[1] for f in part.folded for t in f.tables if t[0] == "Paper against ours"]
    assert lines[1][:5] == ["bias", "PE", "2", "-1", "0.5"]
    assert lines[2][-1] == "left out"


@pytest.mark.parametrize("rows", [1, MOST_ROWS + 1])
def test_a_wide_table_shows_its_first_columns_and_is_whole_on_a_click(tmp_path, rows):
    folder = run_of(tmp_path / "run", 2)
    wide = [[f"column {k}" for k in range(MOST_COLUMNS + 3)], *[["1"] * (MOST_COLUMNS + 3)] * rows]
    (folder / "tables" / "table.md").write_text(markdown(wide, "Wide"), encoding="utf-8")
    part = of_run(folder, METRICS, changed=["by = 2.0 (not there)"])
    folded = {f.title: f for f in part.folded}
    if rows > MOST_ROWS:
        assert part.tables == []
        assert [len(row) for row in folded[f"Table of {rows} rows"].tables[0][1]] == [MOST_COLUMNS + 3] * (rows + 1)
        return
    assert [len(row) for row in part.tables[0][1]] == [MOST_COLUMNS, MOST_COLUMNS]
    assert [len(row) for row in folded["All columns"].tables[0][1]] == [MOST_COLUMNS + 3] * 2
    assert folded["Changes in the config that it extends"].said == ["by = 2.0 (not there)"]
