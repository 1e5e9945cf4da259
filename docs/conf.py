"""The documentation site: `make docs` builds it into out/docs, without a network and
without a GPU.
"""

import os
import sys
import tempfile
import warnings
from importlib.metadata import version as installed
from pathlib import Path

HERE = Path(__file__).parent
sys.path[:0] = [
    str(HERE.parent),
    str(HERE / "sphinx_extensions"),
    str(HERE / "figures"),
]

# The modules of the project are imported for their docstrings. Mitsuba loads its Python
# integrators at import.
warnings.filterwarnings(
    "ignore", category=RuntimeWarning, message="The AST-transforming decorator"
)

project = "mi-splat"
author = "The mi-splat authors"
copyright = "The mi-splat authors, Apache 2.0"
version = release = installed("mi-splat")

extensions = [
    *("myst_nb", "sphinx.ext.autodoc", "sphinx.ext.napoleon", "sphinx_copybutton"),
    *(
        "command_pages",
        "example_pages",
        "forge_links",
        "layer_diagram",
        "narrow_windows",
        "plain_types",
        "plugin_sections",
        "public_names",
        "result_tables",
    ),
]
source_suffix = {".md": "myst-nb", ".rst": "restructuredtext"}
root_doc = "index"
# README.md is what a forge shows for this folder; the site has index.md.
# A link to a table is a download.
exclude_patterns = ["README.md", "artifacts/*/*", "bench/*/*", "tables"]
# Several modules have a class `Step`; a link to it leads to one of them.
suppress_warnings = ["ref.python"]

myst_enable_extensions = ["attrs_inline", "colon_fence", "deflist"]
myst_heading_anchors = 3
myst_fence_as_directive = ["mermaid"]

# Every build runs the notebooks. A cell that fails is a warning with its traceback, and
# an error with -W, which all our builds have. `make NOTEBOOKS=off docs` shows them
# without outputs. torch and Dr.Jit each start a thread a core
os.environ.setdefault("OMP_NUM_THREADS", "1")
# Kernels have a profile of their own: nothing of the user's runs in them, and they do
# not warn of their local sockets.
_profiles = tempfile.TemporaryDirectory(prefix="mi-splat-docs-")
os.environ["IPYTHONDIR"] = _profiles.name
(Path(_profiles.name) / "profile_default").mkdir()
(Path(_profiles.name) / "profile_default" / "ipython_kernel_config.py").write_text(
    'c.IPKernelApp.log_level = "ERROR"'
)
nb_execution_mode = "force"
nb_execution_show_tb = True
nb_execution_timeout = 900
if os.environ.get("NOTEBOOKS") == "off":
    nb_execution_mode = "off"
    # no kernel has said that the cells are Python
    suppress_warnings += ["myst-nb.lexer"]
nb_merge_streams = True
nb_output_stderr = "remove"  # progress bars

# `name` in a docstring is a link where there is such a name, and code elsewhere
default_role = "py:obj"
autodoc_member_order = "bysource"
autodoc_typehints = "signature"
autodoc_typehints_format = "short"
autodoc_preserve_defaults = True
autodoc_default_options = {"members": True}
napoleon_numpy_docstring = False
napoleon_use_ivar = True
napoleon_use_rtype = False
python_use_unqualified_type_names = True
python_maximum_signature_line_length = 90
toc_object_entries_show_parents = "hide"
add_module_names = False

smartquotes = False  # two hyphens are an option, not a dash

html_theme = "sphinx_book_theme"
html_title = f"mi-splat {version}"
html_logo = html_favicon = "static/logo.svg"
html_static_path = ["static"]
html_css_files = ["site.css"]
html_js_files = ["site.js"]
html_search_scorer = str(HERE / "static" / "search-scorer.js")
html_copy_source = False
html_show_sourcelink = False
html_show_sphinx = False
html_theme_options = {
    "logo": {"text": html_title},
    "navbar_persistent": [],  # one search field is enough
    # the parts of the site can be folded; that of the page is open
    "show_navbar_depth": 0,
    "collapse_navbar": True,
    "show_toc_level": 2,
    "use_download_button": False,
    "use_fullscreen_button": False,
    "home_page_in_toc": False,
    "navigation_with_keys": False,
}
