"""The directive ``formula``: what ``make derive`` wrote in LaTeX, included and not retyped.

    ```{formula} canonical_camera
    ```

shows ``generated/latex/canonical_camera.tex`` with its formula line as a caption and its module
of ``derive/`` as the source. A kernel that does not exist is a warning, hence an error.
"""

from __future__ import annotations

import re
from pathlib import Path

from docutils import nodes
from sphinx.application import Sphinx
from sphinx.util.docutils import SphinxDirective

_GENERATED = Path(__file__).resolve().parents[2] / "generated" / "latex"
_SOURCE = re.compile(r"from (derive/\S+\.py)")
_FORMULA = re.compile(r"^% Formula: (.*?)(?=^% (?:Inputs|Outputs):|^\\)", re.MULTILINE | re.DOTALL)


class Formula(SphinxDirective):
    """Include the emitted LaTeX of a kernel."""

    required_arguments = 1

    def run(self) -> list[nodes.Node]:
        """Return the caption and the formula."""
        return formula(self, self.arguments[0])


def formula(directive: SphinxDirective, name: str) -> list[nodes.Node]:
    """Return caption and formula of a kernel."""
    file = _GENERATED / f"{name}.tex"
    if not file.is_file():
        where = file.parent
        raise directive.error(f"no kernel is named {name}: there is no {file.name} in {where}")
    directive.env.note_dependency(str(file))
    text = file.read_text()
    header, _, body = text.partition("\\begin{align*}")
    source, sentence = _SOURCE.search(header), _FORMULA.search(header)
    assert source, f"{file.name} does not name its source"
    assert sentence, f"{file.name} does not say what it is"
    caption = nodes.paragraph(classes=["formula-caption"])
    caption += nodes.strong(text=name)
    said = " ".join(sentence[1].replace("\n% ", " ").split())
    caption += nodes.Text(f": {said} Derived in ")
    caption += nodes.literal(text=source[1])
    caption += nodes.Text(".")
    latex = "\\begin{align*}" + body
    math = nodes.math_block(latex, latex, classes=["formula"])
    math["no-wrap"] = math["nowrap"] = True
    math["number"] = None
    return [caption, math]


def setup(app: Sphinx) -> dict[str, object]:
    """Register the directive."""
    app.add_directive("formula", Formula)
    return {"version": "1", "parallel_read_safe": True}
