"""The frame of the report, and the small pieces that its sections are made of."""

from __future__ import annotations

import html
from collections.abc import Collection, Iterable, Sequence
from typing import TYPE_CHECKING

from robotbrain.figures import to_html

if TYPE_CHECKING:
    from matplotlib.figure import Figure

WORDS = {
    "timeline": (
        "<p>The making of the command whose input was the oldest. Each row is a node; a bar is a callback from its"
        " start to its end, the thin line below it the time that a callback was ready and had to wait. The rows at the"
        " bottom are the device: what ran on its cores, GPU and DLAs, in the colour of the node that wanted it.</p>"
    ),
    "end to end": (
        "<p>The age of the sensor reading behind each command, when the command leaves: what the robot knows of the"
        " world is that old. It holds the computing, the waiting, and up to one period of the sensor, hence the"
        " saw-tooth. A reading is followed through its header stamp, and through what each node keeps between"
        " callbacks.</p>"
    ),
    "latency": (
        "<p>From when a callback could have started to its end, and its deadline. In wall-clock time nobody knows when"
        " a callback became ready: there it is from its start.</p>"
    ),
    "rhythm": (
        "<p>By how much the intervals of messages and timers deviate from their period. Topics that are published only"
        " now and then are not periodic and belong here only to be told from those that should be.</p>"
    ),
    "queues": (
        "<p>Messages that waited for their callback. A queue that is always full adds its length to the latency; one"
        " that drops messages loses data, which for old sensor readings can be just what is wanted.</p>"
    ),
    "device": "<p>How busy the simulated device was. Waiting for the GPU holds no core.</p>",
    "history": "<p>Snapshots that the monitor took while the brain ran, each about the last few seconds before it.</p>",
}
"""What stands before each section's figures and tables; HTML."""

_PAGE = """<!DOCTYPE html>
<html lang="en"><head><meta charset="utf-8"><title>@TITLE@</title>
<meta name="viewport" content="width=device-width, initial-scale=1">
<style>
body { font: 16px/1.5 system-ui, sans-serif; color: #1b1b1b; background: #fff; margin: 2rem auto; max-width: 76rem;
  padding: 0 1.2rem; }
h1, h2 { line-height: 1.2; } h1 { margin-bottom: .2rem; }
h2 { margin-top: 2.6rem; border-top: 1px solid #ddd; padding-top: 1rem; }
p, ul { max-width: 46rem; } .quiet { color: #555; margin-top: 0; }
nav ol { columns: 3 14rem; column-gap: 2rem; padding-left: 1.4rem; font-size: .95rem; }
.cards { display: grid; grid-template-columns: repeat(auto-fit, minmax(9.6rem, 1fr)); gap: .8rem; margin: 1.4rem 0;
  padding: 0; list-style: none; max-width: none; }
.cards li { border: 1px solid #d8d8d8; border-left: 6px solid #0072B2; border-radius: 6px; padding: .6rem .9rem; }
.cards li.bad { border-left-color: #D55E00; background: #fdf5f0; }
.cards .value { display: block; font-size: 1.5rem; font-weight: 600; font-variant-numeric: tabular-nums; }
.cards .what { display: block; color: #444; font-size: .88rem; line-height: 1.35; }
figure { margin: 1.2rem 0; } figure img { max-width: 100%; height: auto; }
figcaption, caption { color: #555; font-size: .9rem; text-align: left; padding: .3rem 0; }
caption { font-weight: 600; color: #1b1b1b; }
.wide { overflow-x: auto; margin: 1rem 0; }
table { border-collapse: collapse; font-size: .86rem; font-variant-numeric: tabular-nums; }
th, td { padding: .25rem .6rem; border-bottom: 1px solid #ddd; text-align: right; vertical-align: top; }
thead th { background: #f2f2f2; vertical-align: bottom; } tbody th { font-weight: 500; }
td:not(.words) { white-space: nowrap; } .words { text-align: left; overflow-wrap: break-word; }
pre { white-space: pre-wrap; background: #f6f6f6; padding: .8rem 1rem; border-radius: 6px; font-size: .86rem; }
.notes li { margin: .25rem 0; } a { color: #0b5394; }
@media print { nav { display: none; } body { max-width: none; } section { break-inside: avoid-page; } }
</style></head><body><main>
<h1>@TITLE@</h1>
@BODY@
</main></body></html>
"""


def page(title: str, lead: str, sections: Sequence[tuple[str, str]]) -> str:
    """Return a page that needs nothing else.

    Args:
        title: text.
        lead: HTML that stands before the contents.
        sections: heading (text) and content (HTML) of each.
    """
    contents = "".join(f'<li><a href="#s{i}">{html.escape(name)}</a></li>' for i, (name, _) in enumerate(sections, 1))
    body = [lead, f"<nav aria-label='Contents'><ol>{contents}</ol></nav>"]
    body += [f'<section id="s{i}"><h2>{html.escape(n)}</h2>{text}</section>' for i, (n, text) in enumerate(sections, 1)]
    return _PAGE.replace("@TITLE@", html.escape(title)).replace("@BODY@", "\n".join(body))


def cards(entries: Iterable[tuple[str, str, bool]]) -> str:
    """Return figures at a glance: (value, what it is, whether it is bad) of each."""
    items = "".join(
        f'<li{" class=bad" if bad else ""}><span class="value">{html.escape(value)}</span>'
        f'<span class="what">{html.escape(what)}</span></li>'
        for value, what, bad in entries
    )
    return f'<ul class="cards">{items}</ul>'


def table(head: Sequence[str], rows: Iterable[Sequence[object]], caption: str, words: Collection[int] = (0,)) -> str:
    """Return a table; the first cell of a row is its heading; the columns in ``words`` are set flush left."""

    def cell(index: int, value: object) -> str:
        kind = ' class="words"' if index in words else ""
        text = html.escape(str(value))
        return f'<th scope="row"{kind}>{text}</th>' if index == 0 else f"<td{kind}>{text}</td>"

    top = "".join(
        f'<th scope="col"{" class=words" if i in words else ""}>{html.escape(name)}</th>' for i, name in enumerate(head)
    )
    body = "".join(f"<tr>{''.join(cell(i, value) for i, value in enumerate(row))}</tr>" for row in rows)
    return (
        f'<div class="wide"><table><caption>{html.escape(caption)}</caption>'
        f"<thead><tr>{top}</tr></thead><tbody>{body}</tbody></table></div>"
    )


def figure(drawn: Figure) -> str:
    """Return a figure with its alternative text, in the page itself."""
    return f"<figure>{to_html(drawn, dpi=150)}</figure>"
