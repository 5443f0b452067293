"""The figure that leads a page of many runs."""

from experiments.runner.figures import against_paper


def row(name, ours, **other):
    return {"part": "table8", "name": name, "quantity": "test_mean", "paper": 0.16, "ours": ours, **other}


def test_the_figure_needs_three_models_that_have_an_error_and_the_papers():
    few = [row("NARXS", 0.149, **{"range over starts": [0.146, 0.566]}), row("LSTM", 0.170), row("GRU", None)]
    assert against_paper(few) is None, "two models"
    assert against_paper([*few, {**row("LSTM", 0.170), "part": "table7"}]) is None, "the same numbers in two tables"
    assert against_paper([*few, {**row("trees", 0.9), "quantity": "accuracy_unseen_routes"}]) is None, "no error"
    image = against_paper([*few, row("NNP", 0.159)])
    assert image is not None
    assert image.startswith(b"\x89PNG")
