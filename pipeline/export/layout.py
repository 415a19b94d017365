"""A layout for Foxglove and Lichtblick: map, states, monitors and hazards of one solution."""

from __future__ import annotations

import json
from typing import Any

from schemas.tables import AXES, OTHER_MONITORS, SCALES

Panel = dict[str, Any]


def layout_json(solution: str, with_positions: bool) -> str:
    """The layout as Foxglove imports it; the map stands where there are positions."""
    panels: dict[str, Panel] = {
        "StateTransitions!states": _states(solution),
        "RosOut!hazards": {"searchTerms": [], "minLogLevel": 1, "topicToRender": f"/{solution}/hazards"},
        "Plot!position": _plot([f"/{solution}/lds.{name}" for name in ("error_low_m", "error_high_m", "confidence_m")]),
        "Plot!speed": _plot([f"/{solution}/lds.{name}" for name in ("speed_mps", "exposure_s")]),
        **{f"Plot!{axis}": _monitors(solution, [f"{axis}_{scale}" for scale in SCALES]) for axis in AXES},
        "Plot!others": _monitors(solution, list(OTHER_MONITORS)),
    }
    left = ["StateTransitions!states", "RosOut!hazards"]
    if with_positions:
        panels["map!plan"] = {"layer": "map", "followTopic": f"/{solution}/matched", "zoomLevel": 14}
        left.insert(0, "map!plan")
    right = [name for name in panels if name.startswith("Plot!")]
    layout = {"direction": "row", "first": _stack(left), "second": _stack(right), "splitPercentage": 45}
    document = {
        "configById": panels,
        "globalVariables": {},
        "userNodes": {},
        "playbackConfig": {"speed": 1},
        "layout": layout,
    }
    return json.dumps(document, indent=2) + "\n"


def _stack(names: list[str]) -> str | dict[str, Any]:
    """Panels one over the other, each of the same height."""
    if len(names) == 1:
        return names[0]
    share = 100.0 / len(names)
    return {"direction": "column", "first": names[0], "second": _stack(names[1:]), "splitPercentage": round(share, 3)}


def _states(solution: str) -> Panel:
    names = ("lds_mode", "lds_state", "judgement", "tvb", "alarm")
    paths = [{"value": f"/{solution}/lds.{name}", "timestampMethod": "receiveTime"} for name in names]
    return {"paths": paths, "isSynced": True}


def _monitors(solution: str, names: list[str]) -> Panel:
    limits = [{"value": limit, "enabled": True, "timestampMethod": "receiveTime"} for limit in ("1", "-1")]
    panel = _plot([f"/{solution}/monitors.{name}_ratio" for name in names])
    return panel | {"paths": [*panel["paths"], *limits], "minYValue": -3, "maxYValue": 3}


def _plot(values: list[str]) -> Panel:
    paths = [{"value": value, "enabled": True, "timestampMethod": "receiveTime"} for value in values]
    return {"paths": paths, "showLegend": True, "isSynced": True, "xAxisVal": "timestamp"}
