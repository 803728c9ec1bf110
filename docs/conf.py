"""How Sphinx builds the site: `make docs`, warnings are errors."""

from __future__ import annotations

import re
from pathlib import Path
from typing import Any

from docutils import nodes
from docutils.utils.math.latex2mathml import tex2mathml
from sphinx.addnodes import pending_xref

import seaopt

project = "seaopt"
author = "The seaopt developers"
version = release = seaopt.__version__
extensions = ["myst_nb", "sphinx.ext.autodoc", "sphinx.ext.autosummary", "numpydoc", "sphinx_copybutton"]
exclude_patterns = ["_build", "**.ipynb_checkpoints"]
nitpicky = True
default_role = "code"

# Pages are MyST; the notebooks (a link to those of the repository) show what is stored in them (`make notebooks`).
myst_heading_anchors = 4
nb_execution_mode = "off"
nb_merge_streams = True

# One page per public name: docs/reference/api.md lists them. Types and shapes stand in the docstrings.
autosummary_generate = True
autodoc_typehints = "none"
autodoc_preserve_defaults = True
autodoc_member_order = "bysource"
numpydoc_show_class_members = False

# The button copies what is typed, without prompts and without what is printed.
copybutton_prompt_text = r">>> |\.\.\. |\$ "
copybutton_prompt_is_regexp = True
copybutton_only_copy_prompt_lines = True

html_math_renderer = "mathml"
html_theme = "furo"
html_title = "seaopt"
html_static_path = ["_static"]
html_css_files = ["site.css"]
html_copy_source = False
html_show_copyright = False
pygments_style = "friendly"
pygments_dark_style = "github-dark"
templates_path = ["_templates"]


def find_notebooks(_app: Any, page: nodes.document) -> None:
    """Point a page's links to notebooks at the pages made of them: MyST follows docs/notebooks out of the sources."""
    outside = str(Path(__file__).resolve().parents[1] / "notebooks")
    for link in page.findall(pending_xref):
        if link["reftarget"].startswith(outside):
            link["reftarget"] = "notebooks" + link["reftarget"].removeprefix(outside)


# What docutils' MathML does not know, and what says the same; 12 is two arguments of a fraction.
SYNONYMS = (
    (r"\\([td]?frac)\s*(\d)(\d)", r"\\\1{\2}{\3}"),
    (r"\\[bB]igg?(?![A-Za-z])", ""),
    (r"\\dots", r"\\ldots"),
    (r"\\iff", r"\\Leftrightarrow"),
    ("°", r"{}^\\circ "),
)
# It sets the subscript of a letter with an accent right below the letter.
BELOW = re.compile(
    r"<munderover>\s*(<mi>[^<]*</mi>)\s*(.*?)\s*(<mo[^>]*>[˙¨ˆ¯˜]</mo>)\s*</munderover>", flags=re.DOTALL
)
BESIDE = r"<msub><mover>\1\3</mover>\2</msub>"


def write_math(writer: Any, node: nodes.Element) -> None:
    """Write a formula as MathML, which browsers draw by themselves: the site needs no script from elsewhere."""
    formula = node.astext()
    for pattern, known in SYNONYMS:
        formula = re.sub(pattern, known, formula)
    if "&" in formula and "\\begin" not in formula:
        formula = f"\\begin{{aligned}}{formula}\\end{{aligned}}"
    mathml = tex2mathml(formula, as_block=isinstance(node, nodes.math_block))
    # Without a mathematical font, browsers set what is called an accent into the letter.
    writer.body.append(BELOW.sub(BESIDE, mathml).replace(' accent="true"', ""))
    raise nodes.SkipNode


def setup(app: Any) -> None:
    """Connect to Sphinx."""
    app.add_html_math_renderer("mathml", (write_math, None), (write_math, None))
    app.connect("doctree-read", find_notebooks)
