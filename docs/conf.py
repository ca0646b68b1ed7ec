"""Build the site: `scripts/docs`, or `python -m sphinx -W docs build/site`.

Nothing on a page is loaded from the network: equations become SVG while the site is built, the
theme brings its fonts and scripts along, and searching works on an index in the site itself.
"""

import importlib.metadata
import sys
from pathlib import Path
from typing import TYPE_CHECKING

import numba
from pydantic import BaseModel

if TYPE_CHECKING:
    from sphinx.application import Sphinx

sys.path.insert(0, str(Path(__file__).parent / "extensions"))


def _as_written(*_args: object, **_options: object) -> object:
    return lambda function: function


# The API reference shows the functions as they are written: a compiled one is no function to
# autodoc, and nothing is computed here. Before canwall is imported.
numba.njit = numba.cfunc = _as_written

project = "canwall"
author = "the canwall authors"
release = version = importlib.metadata.version("canwall")
html_title = f"canwall {version}"

extensions = [
    "myst_nb",
    "sphinx.ext.autodoc",
    "sphinx.ext.napoleon",
    "svg_math",
    "generated_tables",
]
exclude_patterns = ["extensions", "**/.ipynb_checkpoints"]

# Notebooks are shown as they were executed; tests/library executes them. Progress is no result.
nb_execution_mode = "off"
nb_output_stderr = "remove"

myst_enable_extensions = ["colon_fence", "deflist", "dollarmath"]
smartquotes = False
myst_heading_anchors = 3

html_theme = "pydata_sphinx_theme"
html_math_renderer = "svg"
html_static_path = ["static"]
html_css_files = ["canwall.css"]
html_sidebars = {page: [] for page in ("index", "tutorial", "laws", "results")}
html_show_sourcelink = False
html_copy_source = False
html_theme_options = {
    "logo": {"text": "canwall"},
    "navbar_end": ["theme-switcher"],
    "secondary_sidebar_items": ["page-toc"],
    "show_toc_level": 2,
    "header_links_before_dropdown": 6,
    "footer_start": ["copyright"],
    "footer_end": [],
}
html_context = {"default_mode": "auto"}
copyright = "the canwall authors, Apache-2.0"

# Docstrings are Google style; a name in single backticks is code.
default_role = "code"
napoleon_google_docstring = True
napoleon_numpy_docstring = False
napoleon_use_ivar = True
autodoc_member_order = "bysource"
autodoc_typehints = "signature"
autodoc_default_options = {"exclude-members": "model_config"}
python_use_unqualified_type_names = True
maximum_signature_line_length = 88


def _without_keys(
    _app: object, _what: str, _name: str, described: object, *_rest: object
) -> tuple[str, str] | None:
    """Leave the keys of a section of the configuration to the page about them."""
    is_section = isinstance(described, type) and issubclass(described, BaseModel)
    return ("", "") if is_section else None


def setup(app: "Sphinx") -> None:
    """Adapt what autodoc shows."""
    app.connect("autodoc-process-signature", _without_keys)
