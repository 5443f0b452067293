"""The figure that leads a page of many runs, and how comparisons that stand in several tables are counted."""

from experiments.runner.compare import as_good, findings, headlines, merged, tally
from experiments.runner.figures import against_paper


def row(name, ours, **other):
    ratio = None if ours is None else ours / 0.16
    head = {"part": "Table 8", "name": name, "quantity": "test_mean", "paper": 0.16, "ours": ours, "ratio": ratio}
    return {**head, **other}


def test_the_figure_needs_three_models_that_have_an_error_and_the_papers():
    few = [row("NARXS", 0.149, **{"range over starts": [0.146, 0.566]}), row("LSTM", 0.170), row("GRU", None)]
    assert against_paper(few) is None, "two models"
    again = merged([*few, {**row("LSTM", 0.170), "part": "Table 7"}])
    assert against_paper(again) is None, "the same numbers in two tables"
    assert [x["part"] for x in again] == ["Table 8", "Tables 8, 7", "Table 8"]
    assert against_paper([*few, {**row("trees", 0.9), "ratio": None}]) is None, "of synthetic data"
    image = against_paper([*few, row("NNP", 0.159)])
    assert image is not None
    assert image.startswith(b"\x89PNG")


def metrics(rows, *, synthetic=False, more_is_better=False):
    rows = [{"name": n, "paper": None if p is None else {"e": p}, "ours": {"e": o}} for n, p, o in rows]
    return {"synthetic": synthetic, "rows": rows, **tally(rows, "e", more_is_better=more_is_better)}


def test_a_number_that_stands_in_two_tables_is_compared_once_and_synthetic_data_never():
    one = metrics([("NARXS", 0.16, 0.15), ("LSTM", 0.23, 0.24), ("ours", None, 0.14)])
    assert (one["better_than_paper"], one["of"]) == (1, 2)
    two = metrics([("NARXS", 0.16, 0.15), ("bias", -2.0, 1.5)])
    fleet = metrics([("trees", 0.9, 0.95)], synthetic=True, more_is_better=True)
    assert (fleet["better_than_paper"], fleet["of"]) == (1, 1)
    assert as_good([one, two, fleet]) == ["At least as good as the paper in 2 of 3 comparisons."]
    assert as_good([fleet]) == []
    fits = metrics([("trees", 0.9, 0.95), ("forest", 0.3, -0.5), ("none", 0.0, 0.1)], more_is_better=True)
    assert (fits["better_than_paper"], fits["of"]) == (2, 3)
    assert as_good([fits]) == ["At least as good as the paper in 2 of 3 comparisons."], "as the run says itself"
    assert [x["ratio"] for x in headlines(fits)] == [None] * 3, "no errors"
    said = findings({**fleet, "tasks_left_out": 0, "findings": ["trees are small"]})
    assert said == [
        "At least as good, on synthetic data, as the paper on its own data in 1 of 1 comparisons.", "Trees are small.",
    ]  # fmt: skip
