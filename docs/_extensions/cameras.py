"""The directive ``cameras``: a section for every camera model that was derived.

Names, units and constants come from the generated table, formulas from the emitted LaTeX, so that
a new model is listed without a word here.
"""

from __future__ import annotations

from docutils import nodes
from epigauge_generated.signatures import MODELS, Model
from formulas import formula
from sphinx.application import Sphinx
from sphinx.util.docutils import SphinxDirective


class Cameras(SphinxDirective):
    """List all camera models."""

    def run(self) -> list[nodes.Node]:
        """Return the sections, by name."""
        names: dict[str, list[str]] = {}
        for name, model in MODELS.items():
            names.setdefault(model.prefix, []).append(name)
        return [self._section(MODELS[own[0]], own) for own in names.values()]

    def _section(self, model: Model, names: list[str]) -> nodes.section:
        section = nodes.section(ids=[f"camera-{nodes.make_id(model.prefix)}"])
        section += nodes.title(text=", ".join(names))
        about = nodes.paragraph(text=f"{model.title[0].upper()}{model.title[1:]}. ")
        if model.params:
            about += nodes.Text("Parameters: ")
        for position, (name, unit) in enumerate(zip(model.params, model.units, strict=True)):
            about += nodes.Text(", " if position else "")
            about += nodes.literal(text=name)
            kind = "constant, " if name in model.constants else ""
            about += nodes.Text(f" ({kind}{unit if unit != '1' else 'no unit'})")
        numbers = (
            f"{'. ' if model.params else ''}An update has {model.tangent_size} entries, a point "
            f"{model.point_size}; the gauge has dimension {model.gauge_dimension}."
        )
        about += nodes.Text(numbers)
        section += about
        # An image that is found by iterations is no formula; what it solves is one.
        shown = "residual" if model.corrects else "project"
        section += formula(self, f"{model.prefix}_{shown}")
        return section


def setup(app: Sphinx) -> dict[str, object]:
    """Register the directive."""
    app.add_directive("cameras", Cameras)
    return {"version": "1", "parallel_read_safe": True}
