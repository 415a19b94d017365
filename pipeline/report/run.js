"use strict";
// The page of a run: every drawing over time shows the same stretch of it.
(() => {
  const { COLOUR, STATE, PASSAGE, LINES, axis, data, draw, empty, layout, unpack } = Plots;
  const POINTS = 1200;
  const PIECES = 400;
  const PLAN_POINTS = 2000;
  const LEAST_MS = 500;
  const RATIO_REACH = 5;
  const state = { solution: null, index: 0, lo: 0, hi: 0, hazard: null, drawing: false };
  const prepared = new Map();

  function prepare(name) {
    if (prepared.has(name)) return prepared.get(name);
    const raw = data.solutions[name];
    const series = {};
    for (const [key, packed] of Object.entries(raw.time.series)) {
      series[key] = { x: unpack(packed.x), y: unpack(packed.y) };
    }
    const bands = raw.time.bands.map((band) => ({ ...band, starts: unpack(band.starts), codes: unpack(band.codes) }));
    const plan = { ...raw.plan, x: unpack(raw.plan.x), y: unpack(raw.plan.y), t: unpack(raw.plan.t),
      codes: unpack(raw.plan.codes) };
    const result = { raw, series, bands, plan, t0: raw.time.t0_ms };
    prepared.set(name, result);
    return result;
  }

  function below(values, wanted) {
    let low = 0;
    let high = values.length;
    while (low < high) {
      const middle = (low + high) >> 1;
      if (values[middle] < wanted) low = middle + 1; else high = middle;
    }
    return low;
  }

  // The visible part of a series with no more points than there is room for: extremes and gaps stay.
  function visible(series, t0) {
    const first = Math.max(0, below(series.x, state.lo - t0) - 1);
    const last = Math.min(series.x.length, below(series.x, state.hi - t0) + 2);
    const x = [];
    const y = [];
    const put = (row) => { x.push(series.x[row] + t0); y.push(Number.isNaN(series.y[row]) ? null : series.y[row]); };
    const step = Math.ceil((last - first) / (POINTS / 2));
    if (step <= 2) {
      for (let row = first; row < last; row += 1) put(row);
      return { x, y };
    }
    for (let start = first; start < last; start += step) {
      const end = Math.min(last, start + step);
      let least = -1;
      let most = -1;
      let gap = -1;
      for (let row = start; row < end; row += 1) {
        if (Number.isNaN(series.y[row])) { if (gap < 0) gap = row; continue; }
        if (least < 0 || series.y[row] < series.y[least]) least = row;
        if (most < 0 || series.y[row] > series.y[most]) most = row;
      }
      [...new Set([least, most, gap].filter((row) => row >= 0))].sort((a, b) => a - b).forEach(put);
    }
    return { x, y };
  }

  function line(now, key, name, look, extra = {}) {
    const series = now.series[key];
    if (!series) return null;
    const [color, dash] = look;
    return { ...visible(series, now.t0), type: "scatter", mode: "lines", name, line: { color, dash, width: 1.4 },
      connectgaps: false, ...extra };
  }

  // Hazards on the time axis: shaded from onset to end, lines where the chosen one began, failed and was detected.
  function hazardShapes(now) {
    const shapes = [];
    for (const hazard of now.raw.hazards) {
      const begin = hazard.t_onset ?? hazard.t_hazard;
      if (begin > state.hi || (hazard.t_end ?? Infinity) < state.lo) continue;
      shapes.push({ type: "rect", xref: "x", yref: "paper", x0: begin, x1: hazard.t_end ?? now.raw.time.t1_ms, y0: 0,
        y1: 1, line: { width: 0 }, fillcolor: COLOUR.orange, opacity: hazard.id === state.hazard ? 0.22 : 0.1,
        layer: "below" });
      if (hazard.id !== state.hazard) continue;
      for (const [key, dash] of [["t_onset", "dot"], ["t_failure", "dash"], ["t_detected", "solid"]]) {
        if (hazard[key] === null) continue;
        shapes.push({ type: "line", xref: "x", yref: "paper", x0: hazard[key], x1: hazard[key], y0: 0, y1: 1,
          line: { color: COLOUR.vermilion, dash, width: 1.5 } });
      }
    }
    return shapes;
  }

  function level(y, dash = "dash") {
    return { type: "line", xref: "paper", x0: 0, x1: 1, y0: y, y1: y, line: { color: COLOUR.vermilion, dash, width: 1 } };
  }

  const timeAxis = () => axis("", { type: "date", range: [state.lo, state.hi], hoverformat: "%H:%M:%S.%L" });

  function timePlot(now, name, title, traces, height, levels = [], extra = {}) {
    const id = `plot-s${state.index}-${name}`;
    const known = traces.filter(Boolean);
    if (!known.length) { empty(id, "Nothing is known to draw here."); return; }
    draw(id, known, layout(height, {
      margin: { l: 125, r: 20, t: 12, b: 40 }, xaxis: timeAxis(), yaxis: axis(title, { automargin: false }), shapes: [...hazardShapes(now), ...levels.map((y) => level(y))],
      showlegend: known.length > 1, ...extra,
    }));
    listen(id);
  }

  // The visible pieces of a band as [start, end, code]; where they are too many the worst in a bin stands for it.
  function visiblePieces(band, t0) {
    const lo = state.lo - t0;
    const hi = state.hi - t0;
    const first = Math.max(0, below(band.starts, lo) - 1);
    const last = Math.min(band.starts.length, below(band.starts, hi) + 1);
    const end = (piece) => (piece + 1 < band.starts.length ? band.starts[piece + 1] : band.end_ms);
    const pieces = [];
    const put = (from, to, code) => {
      const before = pieces[pieces.length - 1];
      if (before && before[2] === code && before[1] >= from) before[1] = to; else pieces.push([from, to, code]);
    };
    if (last - first <= PIECES) {
      for (let piece = first; piece < last; piece += 1) put(band.starts[piece], end(piece), band.codes[piece]);
      return pieces;
    }
    const from = Math.max(lo, band.starts[first]);
    const step = (Math.min(hi, end(last - 1)) - from) / PIECES;
    let piece = first;
    for (let bin = 0; bin < PIECES; bin += 1) {
      const limit = from + (bin + 1) * step;
      let worst = band.codes[piece];
      while (piece + 1 < last && band.starts[piece + 1] < limit) {
        piece += 1;
        worst = Math.max(worst, band.codes[piece]);
      }
      put(limit - step, limit, worst);
    }
    return pieces;
  }

  function bandPlot(now, name, group) {
    const id = `plot-s${state.index}-${name}`;
    const bands = now.bands.filter((band) => band.group === group).reverse();
    const traces = new Map();
    for (const band of bands) {
      for (const [from, to, code] of visiblePieces(band, now.t0)) {
        if (code === 0) continue;
        const label = band.states[code];
        if (!traces.has(label)) {
          const [color, , pattern] = STATE[label];
          traces.set(label, { type: "bar", orientation: "h", name: label.replace("_", " "), base: [], x: [], y: [],
            marker: { color, line: { width: 0 }, pattern: Plots.pattern(color, pattern) },
            width: 0.8, hovertemplate: `%{y}: ${label.replace("_", " ")}<extra></extra>` });
        }
        const trace = traces.get(label);
        trace.base.push(from + now.t0);
        trace.x.push(to - from);
        trace.y.push(band.name);
      }
    }
    const names = bands.map((band) => band.name);
    timePlot(now, name, "", [...traces.values()], 70 + 26 * bands.length, [], {
      barmode: "overlay", showlegend: true, bargap: 0.1,
      yaxis: axis("", { automargin: false, type: "category", categoryorder: "array", categoryarray: names, fixedrange: true,
        range: [-0.5, names.length - 0.5] }),
    });
  }

  function linkingPlot(now) {
    const traces = [line(now, "distance_from_lrvb_m", "distance since the LRVB", LINES[0])];
    const offered = now.raw.passages.filter((one) => one.t_ms !== null && one.odometer_m !== null);
    const windows = { type: "scatter", mode: "lines", name: "window", x: [], y: [],
      line: { color: COLOUR.green, width: 4 }, hoverinfo: "skip" };
    for (const one of offered) {
      windows.x.push(one.t_ms, one.t_ms, null);
      windows.y.push(one.open_m, one.close_m, null);
    }
    if (offered.length) traces.push(windows);
    for (const [status, [color, symbol]] of Object.entries(PASSAGE)) {
      const some = offered.filter((one) => one.status === status);
      if (!some.length) continue;
      traces.push({ type: "scatter", mode: "markers", name: status.replace("_", " "), x: some.map((one) => one.t_ms),
        y: some.map((one) => one.odometer_m), text: some.map((one) => one.id), marker: { color, symbol, size: 9 },
        hovertemplate: "%{text}<br>%{y:.1f} m<extra>%{fullData.name}</extra>" });
    }
    timePlot(now, "linking", "m", traces, 260);
  }

  const AXES = [["raw", "raw"], ["ewma_0p1", "EWMA 0.1"], ["ewma_0p01", "EWMA 0.01"], ["ewma_0p001", "EWMA 0.001"]];
  const OTHERS = ["link_order", "link_distance", "along_doppler", "pseudorange", "channel"];

  // A monitor far beyond its threshold must not flatten those that are near theirs.
  function ratioPlot(now, name, traces) {
    const sizes = traces.filter(Boolean).map((trace) => trace.y.reduce((most, y) => Math.max(most, Math.abs(y ?? 0)), 0));
    const reach = Math.min(RATIO_REACH, Math.max(1.3, 1.1 * Math.max(0, ...sizes)));
    const yaxis = axis("value / threshold", { automargin: false, range: [-reach, reach] });
    timePlot(now, name, "", traces, 230, [-1, 1], { yaxis });
  }

  function monitorPlots(now) {
    for (const along of ["along", "cross", "up"]) {
      const traces = AXES.map(([key, name], i) => line(now, `ratio_${along}_${key}`, name, LINES[i]));
      ratioPlot(now, `monitors-${along}`, traces);
    }
    const traces = OTHERS.map((name, i) => line(now, `ratio_${name}`, name.replace("_", " "), LINES[i]));
    ratioPlot(now, "monitors-other", traces);
  }

  function mirrored(now, key, name) {
    const upper = line(now, key, name, [COLOUR.grey, "dash"]);
    if (!upper) return [];
    const lower = { ...upper, y: upper.y.map((value) => (value === null ? null : -value)), showlegend: false };
    return [upper, lower];
  }

  function timePlots(now) {
    const limit = data.limits.failure_limit_m;
    bandPlot(now, "bands", "lds");
    timePlot(now, "speed", "m/s", [line(now, "speed_mps", "speed", LINES[0])], 200);
    const along = line(now, "error_along_m", "error", LINES[0]) ?? line(now, "residual_m", "GNSS minus odometer", LINES[0]);
    timePlot(now, "along", "m", [along, ...mirrored(now, "confidence_m", "confidence")], 260, along ? [-limit, limit] : []);
    timePlot(now, "across", "m", [
      line(now, "error_cross_m", "across", LINES[0]) ?? line(now, "cross_track_m", "across, residual", LINES[0]),
      line(now, "error_up_m", "height", LINES[1]) ?? line(now, "vertical_m", "height, residual", LINES[1]),
    ], 230);
    linkingPlot(now);
    timePlot(now, "exposure", "s", [line(now, "exposure_s", "exposure", LINES[0])], 200);
    monitorPlots(now);
    bandPlot(now, "states", "monitors");
  }

  function trackTraces(plan) {
    return plan.track.map((element, index) => ({ type: "scatter", mode: "lines", name: "track", legendgroup: "track",
      showlegend: index === 0, x: [...unpack(element.x)], y: [...unpack(element.y)], text: element.name,
      line: { color: COLOUR.grey, width: 2 }, hovertemplate: `${element.name}<extra></extra>` }));
  }

  function windowTrace(plan) {
    const trace = { type: "scatter", mode: "lines", name: "expectation window", x: [], y: [], opacity: 0.5,
      line: { color: COLOUR.green, width: 9 }, hoverinfo: "skip" };
    for (const one of plan.windows) {
      trace.x.push(...unpack(one.x), null);
      trace.y.push(...unpack(one.y), null);
    }
    return plan.windows.length ? [trace] : [];
  }

  // Positions of the stretch in view, and where the state changes in any case.
  function shownRows(plan, t0) {
    const within = [...plan.codes.keys()].filter((row) => inView(plan.t[row] + t0));
    const stride = Math.ceil(within.length / PLAN_POINTS);
    return within.filter((row, at) => at % stride === 0 || plan.codes[row] !== plan.codes[row - 1]);
  }

  function gnssTraces(plan, t0) {
    const shown = shownRows(plan, t0);
    return plan.states.map((name, code) => {
      const [color, symbol] = STATE[name];
      const rows = shown.filter((row) => plan.codes[row] === code);
      return { type: "scatter", mode: "markers", name: `GNSS, ${name}`, x: rows.map((row) => plan.x[row]),
        y: rows.map((row) => plan.y[row]), customdata: rows.map((row) => clock(plan.t[row] + t0)),
        marker: { color, symbol, line: { width: 0 }, size: 5 },
        hovertemplate: "%{customdata}<extra>%{fullData.name}</extra>" };
    }).filter((trace) => trace.x.length);
  }

  function baliseTraces(plan) {
    return Object.entries(PASSAGE).map(([status, [color, symbol]]) => {
      const some = plan.balises.filter((one) => one.status === status && one.x !== null);
      return { type: "scatter", mode: "markers+text", name: `balise ${status.replace("_", " ")}`, x: some.map((one) => one.x),
        y: some.map((one) => one.y), text: some.map((one) => one.id), textposition: "top center",
        customdata: some.map((one) => `${one.place}, ${one.kind}, ${one.count}×`),
        marker: { color, symbol, size: 12, line: { width: 1.5, color } },
        hovertemplate: "%{text}<br>%{customdata}<extra>%{fullData.name}</extra>" };
    }).filter((trace) => trace.x.length);
  }

  const inView = (t) => t >= state.lo && t <= state.hi;
  const clock = (ms) => new Date(ms).toISOString().slice(11, 23);
  const whole = (now) => state.lo <= now.raw.time.t0_ms && state.hi >= now.raw.time.t1_ms;

  // The plan follows the time axis: it shows where the train was in that stretch.
  function planRanges(now) {
    const { plan, t0 } = now;
    let [x0, x1, y0, y1] = [Infinity, -Infinity, Infinity, -Infinity];
    for (let row = 0; row < plan.t.length; row += 1) {
      if (!inView(plan.t[row] + t0) || Number.isNaN(plan.x[row]) || Number.isNaN(plan.y[row])) continue;
      x0 = Math.min(x0, plan.x[row]); x1 = Math.max(x1, plan.x[row]);
      y0 = Math.min(y0, plan.y[row]); y1 = Math.max(y1, plan.y[row]);
    }
    if (x0 > x1) return null;
    const margin = 0.08 * Math.max(x1 - x0, plan.geographic ? y1 - y0 : 0) + 20;
    const beside = plan.geographic ? margin : 0.1 * (y1 - y0) + 1;
    return { x: [x0 - margin, x1 + margin], y: [y0 - beside, y1 + beside] };
  }

  function planPlot(now) {
    const id = `plot-s${state.index}-plan`;
    const { plan, t0 } = now;
    if (!plan.x.length) { empty(id, "No position was matched to the track."); return; }
    const titles = plan.geographic ? ["east [m]", "north [m]"] : ["path position [m]", "across, left positive [m]"];
    const ranges = whole(now) ? null : planRanges(now);
    const shape = layout(460, {
      xaxis: axis(titles[0], ranges ? { range: ranges.x } : { autorange: true }),
      yaxis: axis(titles[1], { ...(ranges ? { range: ranges.y } : { autorange: true }),
        ...(plan.geographic ? { scaleanchor: "x", scaleratio: 1 } : {}) }),
      showlegend: true,
    });
    draw(id, [...trackTraces(plan), ...windowTrace(plan), ...gnssTraces(plan, t0), ...baliseTraces(plan)], shape);
  }

  function stanfordPlot(now) {
    const id = `plot-s${state.index}-stanford`;
    const { cells, bins, width_m: width, limit_m: limit, epochs } = now.raw.stanford;
    if (!epochs) { empty(id, "No error along the track is known: there was no truth."); return; }
    const middle = (bin) => (bin + 0.5) * width;
    const counts = cells.map((one) => one[2]);
    const edge = bins * width;
    const trace = { type: "heatmap", x: Array.from({ length: bins }, (_, i) => middle(i)),
      y: Array.from({ length: bins }, (_, i) => middle(i)),
      z: Array.from({ length: bins }, () => new Array(bins).fill(null)),
      customdata: Array.from({ length: bins }, () => new Array(bins).fill(0)), colorscale: "Cividis", reversescale: true,
      zmin: 0, zmax: Math.log10(Math.max(10, ...counts)),
      colorbar: { title: { text: "epochs" }, tickvals: [0, 1, 2, 3, 4, 5, 6], ticktext: ["1", "10", "100", "1e3", "1e4", "1e5", "1e6"] },
      hovertemplate: "error %{x:.1f} m, confidence %{y:.1f} m<br>%{customdata} epochs<extra></extra>" };
    for (const [x, y, count] of cells) { trace.z[y][x] = Math.log10(count); trace.customdata[y][x] = count; }
    const rule = (x0, y0, x1, y1) => ({ type: "line", x0, y0, x1, y1, line: { color: COLOUR.vermilion, width: 1.2, dash: "dash" } });
    const note = (x, y, text) => ({ x, y, text, showarrow: false, font: { size: 12 } });
    draw(id, [trace], layout(480, {
      xaxis: axis("error along the track [m], last bin: beyond", { range: [0, edge], constrain: "domain" }),
      yaxis: axis("confidence [m]", { range: [0, edge], scaleanchor: "x", constrain: "domain" }),
      shapes: [rule(0, 0, limit, limit), rule(0, limit, edge, limit), rule(limit, 0, limit, limit)],
      annotations: [note(limit * 0.3, limit * 0.75, "nominal"), note(limit * 0.7, limit * 0.25, "misleading"),
        note(limit * 1.5, limit * 0.5, "hazardous"), note(limit, limit * 1.5, "unavailable")],
      dragmode: "zoom",
    }));
  }

  function say(now) {
    const span = (state.hi - state.lo) / 1000;
    const hazard = now.raw.hazards.find((one) => one.id === state.hazard);
    const what = hazard ? `hazard ${hazard.id} ${hazard.class}: ` : "";
    document.getElementById("window").textContent = `${what}${clock(state.lo)} to ${clock(state.hi)} UTC (${span.toFixed(1)} s)`;
    document.body.dataset.lo = String(state.lo);
    document.body.dataset.hi = String(state.hi);
    for (const link of document.querySelectorAll("a[data-hazard]")) {
      const own = link.closest(".solution").dataset.solution === state.solution;
      link.closest("tr").classList.toggle("chosen", own && Number(link.dataset.hazard) === state.hazard);
    }
  }

  function show(lo, hi) {
    const now = prepare(state.solution);
    const { t0_ms: first, t1_ms: last } = now.raw.time;
    const room = 0.01 * (last - first) + 100;
    const span = Math.max(LEAST_MS, Math.min(hi - lo, last - first + 2 * room));
    state.lo = Math.max(first - room, Math.min(lo, last + room - span));
    state.hi = state.lo + span;
    state.drawing = true;
    timePlots(now);
    planPlot(now);
    say(now);
    state.drawing = false;
  }

  function showAll() {
    const time = prepare(state.solution).raw.time;
    state.hazard = null;
    show(time.t0_ms - 1e9, time.t1_ms + 1e9);
  }

  function listen(id) {
    const place = document.getElementById(id);
    if (place.dataset.listening) return;
    place.dataset.listening = "yes";
    place.on("plotly_relayout", (event) => {
      if (state.drawing) return;
      if (event["xaxis.autorange"]) showAll();
      if (event["xaxis.range[0]"] === undefined) return;
      const at = (value) => (typeof value === "number" ? value : Date.parse(`${value.replace(" ", "T")}Z`));
      show(at(event["xaxis.range[0]"]), at(event["xaxis.range[1]"]));
    });
  }

  function zoomTo(id) {
    const now = prepare(state.solution);
    const hazard = now.raw.hazards.find((one) => one.id === id);
    if (!hazard) return false;
    state.hazard = id;
    const moments = ["t_onset", "t_hazard", "t_failure", "t_detected", "t_negated"].map((key) => hazard[key]).filter((t) => t !== null);
    const begin = Math.min(...moments);
    const end = Math.max(...moments);
    const margin = Math.max(10_000, 0.25 * (end - begin));
    show(begin - margin, end + margin);
    return true;
  }

  function choose(name) {
    if (!(name in data.solutions)) return;
    state.solution = name;
    state.index = data.order.indexOf(name);
    for (const part of document.querySelectorAll(".solution")) part.hidden = part.dataset.solution !== name;
    for (const button of document.querySelectorAll("button[data-solution]")) {
      button.setAttribute("aria-pressed", String(button.dataset.solution === name));
    }
    stanfordPlot(prepare(name));
  }

  function follow() {
    const wanted = new URLSearchParams(location.hash.slice(1));
    const name = wanted.get("s") ?? state.solution ?? Object.keys(data.solutions)[0];
    const other = name !== state.solution;
    if (other) choose(name);
    const known = wanted.has("h") && zoomTo(Number(wanted.get("h")));
    if (other && !known) showAll();
    if (known) {
      document.getElementById(`drawings-s${state.index}`).scrollIntoView();
    }
  }

  function step(by) {
    const hazards = prepare(state.solution).raw.hazards;
    if (!hazards.length) return;
    const at = hazards.findIndex((one) => one.id === state.hazard);
    const next = at < 0 ? (by > 0 ? 0 : hazards.length - 1) : (at + by + hazards.length) % hazards.length;
    zoomTo(hazards[next].id);
  }

  const MOVES = {
    back: (span) => show(state.lo - span / 3, state.hi - span / 3),
    forward: (span) => show(state.lo + span / 3, state.hi + span / 3),
    in: (span) => show(state.lo + span / 4, state.hi - span / 4),
    out: (span) => show(state.lo - span / 2, state.hi + span / 2),
    all: () => showAll(),
    previous: () => step(-1),
    next: () => step(1),
  };

  if (Object.keys(data.solutions).length) {
    for (const button of document.querySelectorAll("button[data-move]")) {
      button.addEventListener("click", () => MOVES[button.dataset.move](state.hi - state.lo));
    }
    for (const button of document.querySelectorAll("button[data-solution]")) {
      button.addEventListener("click", () => { choose(button.dataset.solution); showAll(); });
    }
    window.addEventListener("hashchange", follow);
    // The same link clicked again changes no address.
    document.addEventListener("click", (event) => {
      const link = event.target.closest?.("a[data-hazard]");
      if (link && link.hash === location.hash) follow();
    });
    follow();
  }
  document.body.dataset.ready = "yes";
})();
