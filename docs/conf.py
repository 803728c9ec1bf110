"""How Sphinx builds the site: `make docs`, warnings are errors."""

from __future__ import annotations

import seaopt

project = "seaopt"
author = "The seaopt developers"
version = release = seaopt.__version__
extensions = ["myst_nb", "sphinx.ext.autodoc", "sphinx.ext.autosummary", "numpydoc"]
exclude_patterns = ["_build", "**.ipynb_checkpoints"]
suppress_warnings = ["toc.empty_glob"]
nitpicky = True
default_role = "code"

# Pages are MyST; the notebooks (a link to those of the repository) are executed here, and their outputs shown.
myst_heading_anchors = 4
nb_execution_mode = "cache"
nb_execution_timeout = 300
nb_execution_raise_on_error = True
nb_merge_streams = True

# One page per public name: docs/reference/api.md lists them. Types and shapes stand in the docstrings.
autosummary_generate = True
autodoc_typehints = "none"
autodoc_preserve_defaults = True
autodoc_member_order = "bysource"
numpydoc_show_class_members = False

html_theme = "furo"
html_title = "seaopt"
html_static_path = ["_static"]
html_css_files = ["site.css"]
html_copy_source = False
pygments_style = "friendly"
pygments_dark_style = "github-dark"
templates_path = ["_templates"]
