"""Settings of the documentation site, which `make site` builds by Sphinx.

The sources are the repository's own pages, read where they lie, so that their links hold on the
site as well as where the repository is read. The home page is README.md; its table of contents is
added here, because it would be noise there.
"""

from __future__ import annotations

import logging
import os
import re
import shutil
import sys
from pathlib import Path
from typing import Any

HERE = Path(__file__).resolve().parent
ROOT = HERE.parent.parent
sys.path[:0] = [str(HERE), str(HERE.parent)]
# A kernel that does not warn of what every notebook on one machine does.
os.environ["JUPYTER_PATH"] = str(HERE / "jupyter")
logging.getLogger("traitlets").setLevel(logging.WARNING)

from commit_date import source_date  # noqa: E402

import harnack  # noqa: E402

project = "harnack"
author = copyright = "The harnack authors"
version = release = harnack.__version__

extensions = [
    "sphinx.ext.autodoc",
    "sphinx.ext.viewcode",
    "myst_nb",
    "sphinx_copybutton",
    "docstrings",
    "gallery",
    "examples",
]
root_doc = "README"
include_patterns = ["README.md", "CHANGELOG.md", "CONTRIBUTING.md", "docs/**"]
# Folders that need not be searched for pages.
exclude_patterns = [
    *(".*", "benchmarks", "build", "dist", "examples", "figures", "out", "scripts", "site", "src"),
    *("tests", "typings"),
]

myst_heading_anchors = 3
myst_enable_extensions = ["colon_fence"]
nb_execution_mode = "force"
nb_execution_raise_on_error = True
nb_execution_timeout = 300
nb_merge_streams = True
nb_output_stderr = "remove"  # progress, on slow machines

autodoc_typehints = "signature"
autodoc_type_aliases = {name: name for name in ("BoolArray", "FloatArray", "IntArray", "Point")}
autodoc_member_order = "bysource"
# A method without a docstring of its own is explained once, where it is declared.
autodoc_inherit_docstrings = False
python_maximum_signature_line_length = 88
add_module_names = False
toc_object_entries_show_parents = "hide"

html_theme = "furo"
html_title = f"harnack {version}"
html_copy_source = False
html_static_path = ["static"]
html_css_files = ["site.css"]
templates_path = ["templates"]
# For the end of every page. `versions.py` puts the list of versions elsewhere for tags.
html_context = {
    "source_date": f"{source_date(ROOT):%Y-%m-%d}",
    "version_list": "versions.html",
}
copybutton_exclude = ".linenos, .gp, .go"

CONTENTS = {
    "First steps": ["docs/notebooks/*", "docs/examples", "docs/gallery", "docs/platforms"],
    "Guide": [
        "docs/surfaces",
        "docs/pictures",
        "docs/own-field",
        "docs/meshes",
        "docs/implicit",
        "docs/many-parts",
        "docs/printing",
        "docs/live",
        "docs/frameworks",
        "docs/fitting",
        "docs/precision",
        "docs/distances",
        "docs/cluster",
        "docs/cookbook",
    ],
    "With other tools": [
        f"docs/interoperability/{page}"
        for page in (
            *("index", "arrays", "trimesh", "pyvista", "polyscope"),
            *("open3d", "meshio", "viser", "blender"),
        )
    ],
    "More surfaces": ["docs/circles", "docs/polygon-meshes", "docs/plane", "docs/morph"],
    "Reference": [
        "docs/options",
        *(
            f"docs/reference/{page}"
            for page in (
                *("tracing", "pictures", "meshing", "distances", "fields-of-curves"),
                *("fields-of-meshes", "harmonic-fields", "solids", "blobs", "volumes"),
                *("bounds", "own-fields", "files-and-shapes", "backend"),
            )
        ),
    ],
    "Research": [
        "docs/proofs",
        "docs/benchmarks",
        "docs/figures",
        "docs/misprints",
        "docs/glossary",
        "docs/architecture",
    ],
    "Project": ["CONTRIBUTING", "CHANGELOG"],
}


def add_contents(app: Any, name: str, source: list[str]) -> None:
    """Add the table of contents to the home page."""
    if name != root_doc:
        return
    for caption, pages in CONTENTS.items():
        lines = [f":caption: {caption}", ":hidden:", ":glob:", "", *pages]
        source[0] += "\n```{toctree}\n" + "\n".join(lines) + "\n```\n"


def add_index(app: Any, error: Exception | None) -> None:
    """Make the home page what a web server shows for the folder."""
    if error is None and app.builder.name == "html":
        shutil.copyfile(Path(app.outdir, f"{root_doc}.html"), Path(app.outdir, "index.html"))


def name_aliases(
    app: Any, what: str, name: str, thing: Any, options: Any, signature: str, returned: str
) -> tuple[str, str]:
    """Write names of types as they are: Sphinx writes how it keeps those that are joined by |."""
    plain = (
        re.sub(r"TypeAliasForwardRef\('(\w+)'\)", r"\1", text or "") or text
        for text in (signature, returned)
    )
    return next(plain), next(plain)


def skip_derived_methods(
    app: Any, what: str, name: str, thing: Any, skip: bool, options: Any
) -> bool | None:
    """Leave out what `Field` has made for a class that defines only one of `evaluate` and
    `evaluator`: the other of the two. The entry of `Field` also lists what it inherits."""
    is_derived = getattr(thing, "is_derived", False) or thing is harnack.Field.evaluator
    return True if is_derived and not options.inherited_members else None


def setup(app: Any) -> None:
    app.connect("autodoc-skip-member", skip_derived_methods)
    app.connect("autodoc-process-signature", name_aliases)
    app.connect("source-read", add_contents)
    app.connect("build-finished", add_index)
