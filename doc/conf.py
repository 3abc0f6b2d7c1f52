"""
Sphinx: the pages of this folder, and a reference of the public names from their docstrings.

``sphinx-build -W doc out/doc`` builds it.  ``rosdoc2 build -p .`` finds this file by its place,
runs it inside a file of its own, and adds the modules that sphinx-apidoc finds.
"""

from pathlib import Path
import re
import sys

# Under rosdoc2 this is run from a folder below the package, and the package is not installed.
for _folder in (Path(__file__).resolve(), *Path(__file__).resolve().parents):
    if (_folder / 'ou_monitor' / '__init__.py').is_file():
        sys.path.insert(0, str(_folder))
        break

import ou_monitor  # noqa: E402

project = 'ou_monitor'
author = 'ou_monitor maintainers'
project_copyright = author
version = release = ou_monitor.__version__

extensions = ['sphinx.ext.autodoc', 'sphinx.ext.napoleon', 'myst_parser']
source_suffix = {'.rst': 'restructuredtext', '.md': 'markdown'}
exclude_patterns = ['_build']
html_theme = 'alabaster'
# Names of the core stand for themselves in a signature: `SlidingEstimator(window=2.0)`.
add_module_names = False
autodoc_typehints = 'none'
autodoc_member_order = 'bysource'
napoleon_google_docstring = False
# Attributes as one list, as NumPy shows them, rather than an entry each.
napoleon_use_ivar = True
# Types are words for people: 'shape (n,)' is no reference to a name `n`.
napoleon_use_param = False
# Single backticks in the docstrings are names, mostly of the same class.
default_role = 'code'
# Links to headings of Markdown, as GitHub makes their anchors.
myst_heading_anchors = 3


def _keep_inside(app, docname, source):
    """Turn links of Markdown out of this folder into plain text: Sphinx has no such pages."""
    source[0] = re.sub(r'\[([^]]+)\]\(\.\./[^)]*\)', r'\1', source[0])


def setup(app):
    """Register the hook; Sphinx calls this."""
    app.connect('source-read', _keep_inside)
