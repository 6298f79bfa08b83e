"""Figures of the twin: roofline, timeline, modules against one another, heat.

Each function returns a matplotlib ``Figure`` of its own (pyplot is not involved, nothing is kept anywhere), coloured
with the palette of :mod:`robotbrain.figures`, shapes differing with the colours. :func:`alt_text` says in words what a
figure shows; :func:`to_html` makes an image with that text for a notebook or a page, :func:`save` writes a file.
"""

from robotbrain.figures import FORMATS, alt_text, check_format, save, to_html
from robotbrain.jetson.plot_fusion import plot_fusion
from robotbrain.jetson.plot_modules import plot_devices, plot_heat
from robotbrain.jetson.plot_network import plot_prediction, plot_roofline, plot_timeline

__all__ = [
    "FORMATS",
    "alt_text",
    "check_format",
    "plot_devices",
    "plot_fusion",
    "plot_heat",
    "plot_prediction",
    "plot_roofline",
    "plot_timeline",
    "save",
    "to_html",
]
