"""Sphinx extension: the directive `example-scripts`, scripts with their pictures.

The title and the text are the script's docstring. An example without a picture is a warning, which
ends the build; `make site-pictures` makes what is missing.
"""

from __future__ import annotations

import ast
from pathlib import Path
from typing import Any

from docutils import nodes
from sphinx.util import logging
from sphinx.util.docutils import SphinxDirective

SCRIPTS = Path(__file__).resolve().parents[2] / "examples"
_LOG = logging.getLogger(__name__)


class ExampleScripts(SphinxDirective):
    """Each script that is named: its docstring, its picture and its code."""

    has_content = True

    def run(self) -> list[nodes.Node]:
        docs = Path(self.get_source_info()[0]).parent
        found: list[nodes.Node] = []
        scripts = [SCRIPTS / f"{name}.py" for name in self.content]
        for script in set(SCRIPTS.glob("*.py")) - set(scripts):
            _LOG.warning("%s is not named by the page of examples", script.name)
        for script in scripts:
            self.env.note_dependency(str(script))
            source = script.read_text(encoding="utf-8")
            summary, _, text = (ast.get_docstring(ast.parse(source)) or "").partition("\n")
            section = nodes.section(ids=[script.stem.replace("_", "-")])
            section += nodes.title(text=summary.removesuffix("."))
            pictures = sorted((docs / "images" / "examples").glob(f"{script.stem}.*"))
            if not pictures:
                _LOG.warning("no picture of %s: run make site-pictures", script.name)
            shown = "".join(f"![{summary}](images/examples/{one.name})\n\n" for one in pictures)
            code = source.split('"""', 2)[2].strip()
            section += self.parse_text_to_nodes(
                f"{text}\n\n{shown}`python examples/{script.name} out`\n\n"
                f"````python\n{code}\n````\n"
            )
            found.append(section)
        return found


def setup(app: Any) -> dict[str, bool]:
    app.add_directive("example-scripts", ExampleScripts)
    return {"parallel_read_safe": True}
