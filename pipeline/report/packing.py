"""Numbers and tables as they stand in a page: compact, and the same bytes for the same content."""

from __future__ import annotations

import base64
import json
from typing import Any

import numpy as np
import numpy.typing as npt

Json = Any


def packed(values: npt.ArrayLike, kind: str) -> dict[str, str]:
    """Little-endian numbers as base64; `kind` is `f4`, `u4` or `u1`. NaN stands for not known."""
    array = np.asarray(values).astype(f"<{kind}")
    return {"kind": kind, "data": base64.b64encode(array.tobytes()).decode("ascii")}


def script_json(value: Json) -> str:
    """JSON that may stand inside a script element."""
    text = json.dumps(value, separators=(",", ":"), ensure_ascii=False, allow_nan=False, sort_keys=True)
    # Neither an end tag nor a comment of HTML may arise from data.
    return text.replace("<", "\\u003c").replace(">", "\\u003e").replace("&", "\\u0026")
