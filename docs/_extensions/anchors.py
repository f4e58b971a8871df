"""Anchors for the way back from listed source code.

The page of a module's source links back to all that it defines under one prefix: of a module that
defines `epigauge.load_tracks` and `epigauge.io.TrackFile`, the latter, too, is looked for as
``epigauge.TrackFile``. That anchor is added where nothing else has it.
"""

from __future__ import annotations

from docutils import nodes
from sphinx import addnodes
from sphinx.application import Sphinx


def add(app: Sphinx, doctree: nodes.document) -> None:
    """Give each documented object of a page the anchor without its module."""
    for signature in doctree.findall(addnodes.desc_signature):
        anchor = f"epigauge.{signature.get('fullname', '')}"
        if signature["ids"] and anchor not in doctree.ids:
            signature["ids"].append(anchor)
            doctree.ids[anchor] = signature


def setup(app: Sphinx) -> dict[str, object]:
    """Register the event."""
    app.connect("doctree-read", add)
    return {"version": "1", "parallel_read_safe": True}
