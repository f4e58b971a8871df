"""The default role ``name``: a name in backticks is a link wherever it is documented.

Docstrings name functions of other modules as users write them, such as `load_tracks`. What is not
documented, such as a parameter, is shown as code.
"""

from __future__ import annotations

from docutils.nodes import Element
from sphinx.application import Sphinx
from sphinx.domains.python import PyXRefRole
from sphinx.environment import BuildEnvironment


class Name(PyXRefRole):
    """A reference to any Python object of that name, the nearest first."""

    def process_link(
        self,
        env: BuildEnvironment,
        refnode: Element,
        has_explicit_title: bool,
        title: str,
        target: str,
    ) -> tuple[str, str]:
        """Ask for names that end in the target, which a leading dot says."""
        result = super().process_link(
            env, refnode, has_explicit_title, title, f".{target.removeprefix('eg.')}"
        )
        refnode["reftype"] = "obj"
        return title, result[1]


def setup(app: Sphinx) -> dict[str, object]:
    """Register the role."""
    app.add_role_to_domain("py", "name", Name())
    return {"version": "1", "parallel_read_safe": True}
