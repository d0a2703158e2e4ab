"""How Sphinx builds the site: `make docs`."""

import sys
from pathlib import Path

sys.path.insert(0, str(Path(__file__).parent))

from symbid_ros.package_paths import package_version

project = "symbid_ros"
author = "symbid_ros maintainers"
version = release = package_version()

extensions = [
    "myst_parser",
    "sphinx.ext.autodoc",
    "sphinx.ext.mathjax",
    "sphinx.ext.napoleon",
    "generated_pages",
]
html_theme = "furo"
html_title = f"symbid_ros {version}"
html_copy_source = False
exclude_patterns = ["_build"]

myst_enable_extensions = ["dollarmath", "colon_fence"]
myst_heading_anchors = 3
smartquotes = False  # they turn the dashes of options into one
napoleon_google_docstring = False
autodoc_typehints = "description"
autodoc_member_order = "bysource"
