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
    "sphinx.ext.napoleon",
    "generated_pages",
]
html_math_renderer = "mathml"
html_theme = "furo"
html_title = f"symbid_ros {version}"
html_copy_source = False
html_show_copyright = False
html_static_path = ["static"]
html_extra_path = ["../symbid_ros/schemas"]
html_css_files = ["site.css"]
exclude_patterns = ["_build"]

myst_enable_extensions = ["dollarmath", "colon_fence"]
myst_heading_anchors = 3
smartquotes = False  # they turn the dashes of options into one
napoleon_google_docstring = False
autodoc_typehints = "none"  # docstrings state types, shapes and units
autodoc_class_signature = "separated"
autodoc_member_order = "bysource"
