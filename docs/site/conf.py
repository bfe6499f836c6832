"""Sphinx's settings for the pages of build.py. Nothing is fetched when a page is read."""

project = "dcam"
extensions = ["myst_parser"]
source_suffix = {".md": "markdown"}
root_doc = "index"
myst_heading_anchors = 4
html_theme = "furo"
html_title = "dcam"
html_copy_source = False
html_show_sourcelink = False
html_show_copyright = False
# Output of programs beside what was typed, and cut examples, are no whole programs.
suppress_warnings = ["misc.highlighting_failure"]
