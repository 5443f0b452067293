"""Figures of a run: the project's look, and each as PNG and PDF."""

import functools
from collections.abc import Callable
from typing import Any

from hdev_jax.report.canvas import png, style
from hdev_jax.rundir import Run

__all__ = ["save_figure", "styled"]


def styled(draw: Callable[..., None]) -> Callable[..., None]:
    """The project's look while a figure is drawn and saved."""

    @functools.wraps(draw)
    def inside(*args: Any, **kwargs: Any) -> None:
        with style():
            draw(*args, **kwargs)

    return inside


def save_figure(run: Run, fig: Any, name: str) -> None:
    """`figures/NAME.png` and `figures/NAME.pdf`, the same bytes each time."""
    run.path("figures", f"{name}.png").write_bytes(png(fig))
    fig.savefig(run.path("figures", f"{name}.pdf"), metadata={"CreationDate": None, "Creator": None, "Producer": None})
