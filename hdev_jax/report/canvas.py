"""Figures without pyplot: one style, no global state left changed, PNG out. Matplotlib is imported on first use."""

import io
import warnings
from collections.abc import Iterator
from contextlib import contextmanager
from typing import Any

__all__ = [
    "AFTER",
    "BEFORE",
    "GREY",
    "INK",
    "MEASURED",
    "axis_label",
    "figure",
    "plain_log",
    "png",
    "style",
    "svg",
    "tidy",
]

# Okabe and Ito (2008): distinguishable with any colour vision, and by lightness in print
MEASURED, BEFORE, AFTER = "#1a1a1a", "#D55E00", "#0072B2"
INK, GREY, LINE = "#1b1f24", "#6b7680", "#d9dee3"
DPI = 150

_RC: Any = {
    "font.family": ["DejaVu Sans"],
    "font.size": 8.5,
    "axes.titlesize": 9,
    "axes.titleweight": "bold",
    "axes.titlelocation": "left",
    "axes.labelsize": 8.5,
    "axes.labelcolor": INK,
    "axes.edgecolor": "#9aa4ad",
    "axes.linewidth": 0.7,
    "axes.spines.top": False,
    "axes.spines.right": False,
    "axes.axisbelow": True,
    "axes.unicode_minus": True,
    "xtick.color": GREY,
    "ytick.color": GREY,
    "xtick.labelcolor": INK,
    "ytick.labelcolor": INK,
    "xtick.labelsize": 8,
    "ytick.labelsize": 8,
    "text.color": INK,
    "text.parse_math": False,  # a dollar sign in a trip's name is a dollar sign
    "legend.frameon": False,
    "legend.fontsize": 8.5,
    "lines.linewidth": 1.2,
    "figure.facecolor": "white",
    "savefig.facecolor": "white",
}


@contextmanager
def style() -> Iterator[None]:
    """Our look for figures made and drawn inside; matplotlib's settings are put back, missing glyphs are no news."""
    import matplotlib as mpl

    with mpl.rc_context(_RC), warnings.catch_warnings():
        warnings.filterwarnings("ignore", message="Glyph .* missing from", category=UserWarning)
        yield


def figure(width: float, height: float) -> Any:
    """An empty figure of so many inches on an Agg canvas, its panels laid out so that nothing overlaps."""
    from matplotlib.backends.backend_agg import FigureCanvasAgg
    from matplotlib.figure import Figure

    fig = Figure(figsize=(width, height), dpi=DPI)
    FigureCanvasAgg(fig)
    fig.set_layout_engine("constrained", w_pad=0.06, h_pad=0.06, wspace=0.04, hspace=0.06)
    return fig


def png(fig: Any) -> bytes:
    """The figure as PNG."""
    buffer = io.BytesIO()
    fig.savefig(buffer, format="png", metadata={"Software": None})
    return buffer.getvalue()


def svg(fig: Any) -> bytes:
    """The figure as SVG, for time series: it stays sharp where one zooms in, and is the same bytes again."""
    import matplotlib as mpl

    buffer = io.BytesIO()
    with mpl.rc_context({"svg.hashsalt": "hdev"}):
        fig.savefig(buffer, format="svg", metadata={"Date": None, "Creator": None})
    return buffer.getvalue()


def tidy(ax: Any, *, grid: str = "y", zero: bool = False) -> None:
    """Light grid lines; `zero`: a line where the model is right."""
    ax.grid(axis=grid, color=LINE, linewidth=0.6)
    ax.tick_params(length=2.5)
    if zero:
        ax.axhline(0, color=GREY, linewidth=0.8, zorder=1)


def plain_log(axis: Any) -> None:
    """Plain numbers on a logarithmic axis: powers of ten need the mathematical text that `style` turns off."""
    from matplotlib.ticker import FuncFormatter, NullFormatter

    axis.set_major_formatter(FuncFormatter(lambda x, _: f"{x:,g}"))
    axis.set_minor_formatter(NullFormatter())


def axis_label(words: str, unit: str) -> str:
    """`speed [km/h]`."""
    return f"{words} [{unit}]" if unit else words
