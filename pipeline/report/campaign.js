"use strict";
// The page of a campaign: distributions, and where on the network positions could be had.
(() => {
  const { COLOUR, PASSAGE, LINES, axis, data, draw, empty, layout } = Plots;
  const OUTCOMES = [
    ["within the budget", COLOUR.blue, ""], ["beyond it", COLOUR.vermilion, "x"], ["not known", COLOUR.grey, "."],
  ];
  const LEAST_S = 0.05;

  // What nobody could have seen was not found either.
  const noHazard = (own) => `No hazard was found; ${own.runs_with_truth} of ${own.runs} runs had a truth to find one by.`;

  function classesPlot(id, own) {
    if (!own.hazards) { empty(id, noHazard(own)); return; }
    const traces = OUTCOMES.map(([name, color, pattern], index) => ({
      type: "bar", name, x: own.classes.map((row) => row[0]), y: own.classes.map((row) => row[1 + index]),
      marker: { color, pattern: Plots.pattern(color, pattern) },
    }));
    draw(id, traces, layout(300, { barmode: "stack", yaxis: axis("hazards", { tickformat: "d", rangemode: "tozero" }), xaxis: axis("") }));
  }

  // Share that had happened by then; what happened within one epoch stands at the left edge of the logarithmic axis.
  function shareCurve(times, total, name, look) {
    if (!total || !times.length) return null;
    const x = [LEAST_S / 2];
    const y = [0];
    times.forEach((time, index) => { x.push(Math.max(time, LEAST_S)); y.push((index + 1) / total); });
    x.push(Math.max(1000, 10 * x[x.length - 1]));
    y.push(times.length / total);
    return { type: "scatter", mode: "lines", name: `${name}: ${times.length} of ${total}`, x, y,
      line: { color: look[0], dash: look[1], shape: "hv", width: 2 } };
  }

  function detectionPlot(id, own) {
    const traces = [
      shareCurve(own.time_to_detect_s, own.hazards, "detected, T_D", LINES[0]),
      shareCurve(own.hazardous_s, own.failures, "in use no longer, hazardous time with what is unknown", LINES[5]),
    ].filter(Boolean);
    if (!traces.length) { empty(id, own.hazards ? `None of ${own.hazards} hazards was detected.` : noHazard(own)); return; }
    const shapes = data.levels.map(([, allowed]) => ({ type: "line", x0: allowed, x1: allowed, yref: "paper", y0: 0, y1: 1,
      line: { color: COLOUR.grey, dash: "dash", width: 1.2 } }));
    const annotations = data.levels.map(([name, allowed], index) => ({ x: Math.log10(allowed), yref: "paper",
      y: 0.05 + 0.09 * (index % 4), xanchor: "left", showarrow: false, text: ` ${name} ${allowed.toPrecision(4)} s` }));
    draw(id, traces, layout(360, {
      xaxis: axis(`time [s], at most ${LEAST_S} s at the left edge`, { type: "log", range: [Math.log10(LEAST_S / 2), 3] }),
      yaxis: axis("share", { range: [0, 1.05], tickformat: ".0%" }), shapes, annotations, showlegend: true,
    }));
  }

  function locationPlot(id, own) {
    if (!own.location.length) { empty(id, "No location error is known."); return; }
    const traces = Object.entries(PASSAGE).map(([status, [color]]) => {
      const rows = own.location.filter((row) => row[0] === status);
      return { type: "bar", name: status.replace("_", " "), x: rows.map((row) => row[1] + 0.5), y: rows.map((row) => row[2]),
        width: 1, marker: { color }, hovertemplate: "%{x:.1f} m: %{y}<extra>%{fullData.name}</extra>" };
    }).filter((trace) => trace.x.length);
    const limit = data.limits.failure_limit_m;
    const reach = Math.max(...own.location.map((row) => Math.abs(row[1]))) + 2;
    draw(id, traces, layout(300, {
      barmode: "stack", showlegend: true, yaxis: axis("offers"),
      xaxis: axis("location error [m], beyond 50 m in the last bins", { range: [-reach, reach] }),
      shapes: [-limit, limit].filter((x) => Math.abs(x) < reach).map((x) => ({ type: "line", x0: x, x1: x, yref: "paper",
        y0: 0, y1: 1, line: { color: COLOUR.vermilion, dash: "dash", width: 1.2 } })),
    }));
  }

  const CLASSES = [
    [0.999, "all epochs", COLOUR.blue, "solid"], [0.95, "95 % and more", COLOUR.sky, "solid"],
    [0.5, "50 % and more", COLOUR.orange, "solid"], [0, "less than half", COLOUR.vermilion, "solid"],
  ];

  function mapPlot(id, own) {
    const map = own.map;
    if (!map.pieces.length) { empty(id, "No position of a moving train was matched to the track."); return; }
    const lines = map.track.map((one, index) => ({ type: "scatter", mode: "lines", name: "track", legendgroup: "track",
      showlegend: index === 0, x: one.x, y: one.y, line: { color: COLOUR.grey, width: 1.5 }, hoverinfo: "skip" }));
    const groups = CLASSES.map(([least, name, color], index) => {
      const most = index ? CLASSES[index - 1][0] : Infinity;
      const trace = { type: "scatter", mode: "lines", name, x: [], y: [], text: [], line: { color, width: 4 + 2 * index },
        hovertemplate: "%{text}<extra></extra>" };
      for (const piece of map.pieces) {
        if (piece.share < least || piece.share >= most) continue;
        const text = `${piece.name}, ${piece.from_m} to ${piece.to_m} m: ${(100 * piece.share).toFixed(1)} % of ${piece.epochs} epochs`;
        trace.x.push(...piece.x, null);
        trace.y.push(...piece.y, null);
        trace.text.push(...piece.x.map(() => text), null);
      }
      return trace;
    }).filter((trace) => trace.x.length);
    const hazards = { type: "scatter", mode: "markers", name: "hazard", x: map.hazards.map((one) => one[0]),
      y: map.hazards.map((one) => one[1]), text: map.hazards.map((one) => one[2]), hovertemplate: "%{text}<extra></extra>",
      marker: { symbol: "x", size: 11, color: COLOUR.purple, line: { width: 1, color: "#000000" } } };
    if (map.hazards.length) groups.push(hazards);
    const axes = map.geographic
      ? { xaxis: axis("east [m]"), yaxis: axis("north [m]", { scaleanchor: "x", scaleratio: 1 }) }
      : { xaxis: axis("measure on the net element [m]"),
        yaxis: axis("", { tickvals: map.elements.map((_, i) => i), ticktext: map.elements, range: [-0.7, map.elements.length - 0.3] }) };
    const height = map.geographic ? 420 : Math.min(900, 120 + 34 * map.elements.length);
    draw(id, [...lines, ...groups], layout(height, { ...axes, showlegend: true }));
  }

  data.order.forEach((name, index) => {
    const own = data.solutions[name];
    classesPlot(`plot-s${index}-classes`, own);
    detectionPlot(`plot-s${index}-detection`, own);
    locationPlot(`plot-s${index}-location`, own);
    mapPlot(`plot-s${index}-map`, own);
  });
  document.body.dataset.ready = "yes";
})();
