"""The documentation as a site: `make docs` writes it to `build/docs`. It opens offline and fetches nothing."""

from __future__ import annotations

from sphinx.application import Sphinx

from schemas.version import VERSION

FIRST = ("project", "field-engineer", "analyst", "assessor", "measurements", "domain")
"""Pages with which the menu begins; the others follow in the order of their names."""
LAST = ("CONTRIBUTING", "SECURITY", "CHANGELOG")
"""Pages of the repository with which it ends."""

project = "balise"
version = release = VERSION
extensions = ["myst_parser"]
myst_heading_anchors = 4
# The sources are those that one reads in the repository, README.md first; links between them lead to the same places.
root_doc = "README"
include_patterns = ["README.md", "SECURITY.md", "CONTRIBUTING.md", "CHANGELOG.md", "examples/README.md", "docs/*.md"]
exclude_patterns = [".*", "build", "benchmarks", "datasets", "pipeline", "schemas", "tests", "*-out"]
html_theme = "furo"
html_title = f"balise {VERSION}"
html_copy_source = False
html_show_copyright = False
html_use_index = False
html_extra_path = ["index.html"]
# No lexer for CSV: shown without colours.
suppress_warnings = ["misc.highlighting_failure"]


def setup(app: Sphinx) -> None:
    """Called by Sphinx."""
    app.connect("source-read", _add_menu)


def _add_menu(app: Sphinx, page: str, source: list[str]) -> None:
    """README.md holds no menu: those who read it as a file have the folder."""
    if page == root_doc:
        entries = "\n".join(
            [*(f"docs/{name}" for name in FIRST), "docs/*", "examples/README", "CONTRIBUTING", "SECURITY", "CHANGELOG"]
        )
        source[0] += f"\n```{{toctree}}\n:hidden:\n:glob:\n\n{entries}\n```\n"
