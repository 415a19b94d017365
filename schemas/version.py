"""The program's version: the one place that packaging and the tables' metadata read."""

from __future__ import annotations

VERSION = "0.3.0"
SOFTWARE = f"balise {VERSION}"
