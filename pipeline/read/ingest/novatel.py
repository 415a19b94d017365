"""Position types of NovAtel's receivers, as binary logs and ROS messages number them and texts name them."""

from __future__ import annotations

import csv
from importlib.resources import files

from schemas.enums import Fix

_LINES = (files("pipeline.read.ingest") / "novatel.csv").read_text(encoding="utf-8").splitlines()
_TYPES = [*csv.DictReader(line for line in _LINES if not line.startswith("#"))]
FIX_BY_CODE = {int(row["number"]): Fix(row["fix"]) for row in _TYPES if row["fix"] != Fix.NONE}
# "Inertial solution status": high variance, good, free, alignment complete. The others are no solution.
SOLVED = (2, 3, 6, 7)
FIX_BY_WORD = {word: Fix(row["fix"]) for row in _TYPES for word in row["words"].split()}
