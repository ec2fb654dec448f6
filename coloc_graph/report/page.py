"""Parts of an HTML report with nothing to fetch or execute: document, tables, figures."""

import math
from collections.abc import Iterable, Sequence
from html import escape

from matplotlib.figure import Figure

from coloc_graph.report.plots import figure_svg

DASH = "–"

_CSS = """
:root { color-scheme: light dark; --ink: #24292f; --soft: #59636e; --line: #d8dee4; --page: #ffffff;
  --wash: #f6f8fa; --bad: #a63a00; }
@media (prefers-color-scheme: dark) { :root { --ink: #e6edf3; --soft: #9aa4af; --line: #30363d; --page: #0d1117;
  --wash: #161b22; --bad: #ff9d66; } }
body { margin: 0 auto; padding: 2.5rem 1.5rem 4rem; max-width: 60rem; background: var(--page); color: var(--ink);
  font: 16px/1.55 system-ui, -apple-system, "Segoe UI", Roboto, "DejaVu Sans", sans-serif; }
h1 { font-size: 1.75rem; line-height: 1.25; margin: 0; overflow-wrap: anywhere; }
h2 { font-size: 1.15rem; margin: 2.5rem 0 .75rem; }
p { margin: .5rem 0; }
.soft, figcaption, footer { color: var(--soft); font-size: .9rem; }
.verdict { margin: 1.5rem 0; padding: .75rem 1.1rem; background: var(--wash); border-left: 4px solid #0072b2;
  border-radius: 4px; font-size: 1.1rem; font-variant-numeric: tabular-nums; }
.wide { overflow-x: auto; }
table { border-collapse: collapse; width: 100%; font-size: .9rem; font-variant-numeric: tabular-nums; }
th, td { padding: .35rem .65rem; text-align: right; border-bottom: 1px solid var(--line); vertical-align: top; }
th { color: var(--soft); font-weight: 600; }
th.text, td.text { text-align: left; overflow-wrap: break-word; }
tfoot td { font-weight: 600; border-bottom: 0; }
.bad { color: var(--bad); }
figure { margin: 0 0 1.75rem; }
.card { background: #ffffff; border: 1px solid var(--line); border-radius: 6px; padding: .75rem; }
.card svg { display: block; width: 100%; height: auto; }
figcaption { margin-top: .4rem; }
summary { cursor: pointer; }
ul { padding-left: 1.2rem; }
li { margin: .3rem 0; overflow-wrap: anywhere; }
footer { margin-top: 3rem; border-top: 1px solid var(--line); padding-top: .75rem; }
"""


def document(title: str, sections: Iterable[str]) -> str:
    """Return a document of its sections, without empty ones."""
    return (
        '<!DOCTYPE html>\n<html lang="en">\n<head>\n<meta charset="utf-8">\n'
        '<meta name="viewport" content="width=device-width, initial-scale=1">\n'
        "<meta http-equiv=\"Content-Security-Policy\" content=\"default-src 'none'; style-src 'unsafe-inline'\">\n"
        f"<title>{escape(title)}</title>\n<style>{_CSS}</style>\n</head>\n<body>\n"
        + "\n".join(section for section in sections if section)
        + "\n</body>\n</html>\n"
    )


def figure_card(name: str, figure: Figure, caption: str) -> str:
    """Return a figure with its caption; its name is unique in the document."""
    return (
        f'<figure>\n<div class="card" role="img" aria-label="{escape(caption)}">{figure_svg(figure, name)}</div>\n'
        f"<figcaption>{escape(caption)}</figcaption>\n</figure>"
    )


def many(count: int, what: str) -> str:
    """Return a count with its noun, in the plural where needed."""
    return f"{count} {what}{'' if count == 1 else 's'}"


def number(value: float | None, digits: int) -> str:
    """Format a number; a dash where there is none."""
    return f"{value:.{digits}f}" if value is not None and math.isfinite(value) else DASH


def table(head: Sequence[str], rows: Iterable[Sequence[str]], text: Sequence[int], foot: Sequence[str] = ()) -> str:
    """Return a table of cells that are HTML; columns in `text` are left-aligned."""

    def cells(tag: str, row: Sequence[str]) -> str:
        return "".join(
            f'<{tag} class="text">{cell}</{tag}>' if column in text else f"<{tag}>{cell}</{tag}>"
            for column, cell in enumerate(row)
        )

    body = "\n".join(f"<tr>{cells('td', row)}</tr>" for row in rows)
    last = f"<tfoot><tr>{cells('td', foot)}</tr></tfoot>" if foot else ""
    head_row = f"<thead><tr>{cells('th', head)}</tr></thead>"
    return f'<div class="wide"><table>{head_row}\n<tbody>\n{body}\n</tbody>{last}</table></div>'


def warnings_section(warnings: Sequence[str]) -> str:
    """Return the list of warnings; "" where there are none."""
    if not warnings:
        return ""
    items = "\n".join(f"<li>{escape(warning)}</li>" for warning in warnings)
    return f'<h2 class="bad">Warnings</h2>\n<ul>\n{items}\n</ul>'
