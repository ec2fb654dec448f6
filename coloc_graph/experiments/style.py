"""Colours and markers of the three columns (paper, eq. (2), ours), titles, and PNG."""

import io

from matplotlib.figure import Figure

from coloc_graph.report.drawing import COLOURS, INK, styled

#: Eq. (2) and ours: a colour each (Okabe and Ito) and a marker each, so that colour is never the only difference.
EQ2 = COLOURS[1]
OURS = COLOURS[0]
PAPER = INK
EQ2_MARKER = "s"
OURS_MARKER = "o"
PAPER_MARKER = "_"
EQ2_LABEL = "eq. (2)"
OURS_LABEL = "ours"

DEPTHS = {"tracks": "marker centres with 0.3 px noise", "images": "rendered images"}


@styled
def png_bytes(figure: Figure, dpi: float = 110) -> bytes:
    """The figure as PNG; the same figure always as the same bytes."""
    out = io.BytesIO()
    figure.savefig(out, format="png", dpi=dpi, metadata={"Software": None})
    return out.getvalue()


def titled(figure: Figure, title: str, subtitle: str) -> None:
    """A bold title at the left, and what it was measured with below it. For figures without layout engine."""
    inch = 1 / figure.get_figheight()
    left = 0.14 / figure.get_figwidth()
    figure.text(left, 1 - 0.14 * inch, title, size=13, weight="bold", va="top")
    figure.text(left, 1 - 0.42 * inch, subtitle, size=9.5, color="#57606a", va="top")
