"""How Sphinx makes the book. ``make book`` runs it over a folder that ``build.py`` lays out."""

import os
import sys
from importlib.metadata import version as _version
from pathlib import Path

HERE = Path(__file__).resolve().parent
sys.path.insert(0, str(HERE))

project = "robotbrain"
author = "The robotbrain authors"
copyright = "The robotbrain authors, MIT licence"
release = _version("robotbrain")
language = "en"

extensions = ["myst_nb", "mathml", "anchors", "replays", "widgets", "sphinx_copybutton"]
exclude_patterns = ["**.ipynb_checkpoints"]

# Outputs come from a run of each notebook; unchanged ones are taken from the cache (see build.py).
nb_execution_mode = os.environ.get("ROBOTBRAIN_BOOK_EXECUTION", "cache")
nb_execution_cache_path = os.environ.get("ROBOTBRAIN_BOOK_CACHE", "")
nb_execution_excludepatterns = ["labs/*/*.ipynb"]  # released labs hold gaps: nothing to run yet
nb_execution_timeout = 300
nb_execution_raise_on_error = False  # go on, so that build.py can name every cell that failed; a warning still fails it
nb_merge_streams = True
nb_ipywidgets_js: dict[str, dict[str, str]] = {}  # none from a network; see widgets.py
nb_output_stderr = "remove"  # progress bars
myst_enable_extensions = ["dollarmath", "amsmath", "colon_fence"]
myst_heading_anchors = 3
robotbrain_cell_links = ("course/OUTLINE", "course/CHANGES")
templates_path = [str(HERE / "templates")]
suppress_warnings = ["mystnb.unknown_mime_type"]  # the scores that nbgrader reads, beside their HTML

html_theme = "sphinx_book_theme"
html_title = "robotbrain"
html_favicon = str(HERE / "static" / "icon.svg")
html_static_path = [str(HERE / "static")]
html_css_files = ["book.css"]
html_show_sourcelink = True
html_use_index = False  # there is nothing to put into it
html_copy_source = True  # each page offers its notebook
html_sidebars = {"**": ["brand.html", "find.html", "sbt-sidebar-nav.html"]}
html_context = {"default_mode": "auto"}  # what the reader's system prefers, until they choose
html_theme_options = {
    "show_navbar_depth": 1,
    "show_toc_level": 2,
    "home_page_in_toc": True,
    "use_download_button": True,
    "use_fullscreen_button": False,
    "navigation_with_keys": True,
    "navbar_persistent": [],  # search stands in the side bar and beside the title
    "pygments_light_style": "a11y-high-contrast-light",
    "pygments_dark_style": "a11y-high-contrast-dark",
}
copybutton_selector = "div.cell_input pre, div.highlight pre"
