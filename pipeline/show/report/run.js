"use strict";
// The page of a run: every drawing over time shows the same stretch of it.
(() => {
  const { OUTCOMES, data, draw, empty, range, unpack } = Plots;
  const { clock, number } = Scales;
  const POINTS = 1200;
  const PIECES = 400;
  const PLAN_POINTS = 2500;
  const LEAST_MS = 500;
  const RATIO_REACH = 5;
  const FEW = 20;
  const KMH = 3.6;
  // Which look a state has, and what it is called.
  const STATES = {
    P0: ["right", "P0: in order"], P1: ["wrong", "P1: wrong and in use"], P2: ["lost", "P2: position blocked"],
    P3: ["unknown", "P3: diagnosis faulty"], "not known": ["faint", "not known"],
    linked: ["right"], initialising: ["faint"], odometry: ["lost"], fail_safe: ["wrong", "fail-safe"],
    TVB: ["right"], "no TVB": ["lost"], right: ["right"], unknown: ["unknown", "could not be checked"], wrong: ["wrong"],
    "no alarm": ["calm"], alarm: ["wrong"], pass: ["right", "passed"], not_evaluated: ["faint", "not evaluated"], fail: ["wrong", "failed"],
  };
  const state = { solution: null, index: 0, lo: 0, hi: 0, hazard: null };
  const prepared = new Map();

  function prepare(name) {
    if (prepared.has(name)) return prepared.get(name);
    const raw = data.solutions[name];
    const shared = raw.time.t && unpack(raw.time.t);
    const series = {};
    for (const [key, packed] of Object.entries(raw.time.series)) {
      series[key] = { x: packed.x ? unpack(packed.x) : shared, y: unpack(packed.y) };
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

  function line(now, key, name, look, factor = 1) {
    const series = now.series[key];
    if (!series) return null;
    const part = visible(series, now.t0);
    const y = factor === 1 ? part.y : part.y.map((value) => (value === null ? null : value * factor));
    return { type: "line", name, look, x: part.x, y };
  }

  // Hazards on the time axis: shaded from onset to end, lines where the chosen one began, failed and was detected.
  function hazardMarks(now, y) {
    const items = { shade: [], "shade chosen": [] };
    const rules = [];
    for (const hazard of now.raw.hazards) {
      const begin = hazard.t_onset ?? hazard.t_hazard;
      const chosen = hazard.id === state.hazard;
      items[chosen ? "shade chosen" : "shade"].push([begin, hazard.t_end ?? now.raw.time.t1_ms, y.lo, y.hi, `hazard ${hazard.id} ${hazard.class}`]);
      if (!chosen) continue;
      for (const [key, look] of [["t_onset", "dots"], ["t_failure", "dash"], ["t_detected", "solid"]]) {
        if (hazard[key] !== null) rules.push({ x: hazard[key], look });
      }
    }
    const layers = Object.entries(items).filter(([, some]) => some.length).map(([tone, some]) => ({ type: "bars", tone, items: some }));
    return [layers, rules];
  }

  function timePlot(now, name, unit, layers, height, { levels = [], y = null, least = 0, knee = 0, none = "There was no epoch." } = {}) {
    const id = `plot-s${state.index}-${name}`;
    const known = layers.filter(Boolean);
    if (!known.length) { empty(id, none); return; }
    const even = y ?? { ...range([...known.flatMap((layer) => layer.y), ...levels], least), title: unit, unit };
    const upright = knee ? Scales.wide(even, knee) : even;
    const [shades, rules] = hazardMarks(now, upright);
    draw(id, { height, layers: [...shades, ...known], rules: [...rules, ...levels.map((level) => ({ y: level }))],
      x: { kind: "time", lo: state.lo, hi: state.hi }, y: upright, zoom: show, whole: showAll });
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
    const bands = now.bands.filter((band) => band.group === group).reverse();
    const layers = new Map();
    bands.forEach((band, row) => {
      for (const [from, to, code] of visiblePieces(band, now.t0)) {
        if (code === 0) continue;
        const [tone, word] = STATES[band.states[code]];
        const called = word ?? band.states[code];
        if (!layers.has(called)) layers.set(called, { type: "bars", tone, name: called, items: [] });
        layers.get(called).items.push([from + now.t0, to + now.t0, row - 0.4, row + 0.4, `${band.name}: ${called}`]);
      }
    });
    const names = bands.map((band) => band.name);
    timePlot(now, name, "", [...layers.values()], 40 + 24 * bands.length, { y: { kind: "names", names, lo: -0.6, hi: names.length - 0.4 } });
  }

  const marksOf = (some, xOf, yOf, tell) => OUTCOMES.map(([tone, name]) => {
    const own = some.filter((one) => one.outcome === tone);
    return { type: "marks", tone, name, x: own.map(xOf), y: own.map(yOf), tell: (i) => tell(own[i]) };
  }).filter((layer) => layer.x.length);

  function linkingPlot(now) {
    const offered = now.raw.passages.filter((one) => one.t_ms !== null && one.odometer_m !== null);
    const windows = { type: "line", name: "expectation window", look: "window", x: [], y: [] };
    for (const one of offered) {
      windows.x.push(one.t_ms, one.t_ms, one.t_ms);
      windows.y.push(one.open_m, one.close_m, null);
    }
    timePlot(now, "linking", "m", [
      line(now, "distance_from_lrvb_m", "distance since the LRVB", "a"), offered.length ? windows : null,
      ...marksOf(offered, (one) => one.t_ms, (one) => one.odometer_m, (one) => `${one.id} ${one.status}, ${number(one.odometer_m)} m`),
    ], 250, { none: "No balise was offered, and nothing was known to measure a distance from." });
  }

  // What became of each balise, in the order of the line: readable with hundreds of them.
  function balisesPlot(now) {
    const id = `plot-s${state.index}-balises`;
    const some = now.raw.passages.filter((one) => one.path_m !== null);
    if (!some.length) { empty(id, "No balise was met."); return; }
    const limit = data.limits.failure_limit_m;
    const errors = some.map((one) => one.error_m).filter((error) => error !== null);
    const most = Math.max(1.3 * limit, ...errors.map(Math.abs));
    // A logarithmic axis needs more than an even one to have room.
    const [above, under, least] = most > 4 * limit ? [2, -2.5, -4] : [1.12, -1.12, -1.25];
    const floor = under * most;
    const layers = marksOf(some, (one) => one.path_m / 1000, (one) => one.error_m ?? floor,
      (one) => `${one.id}: ${one.status}, ${one.error_m === null ? "error not known" : `${number(one.error_m)} m`}`);
    for (const layer of layers) {
      const own = some.filter((one) => one.outcome === layer.tone);
      if (["wrong", "unknown"].includes(layer.tone) || own.length <= FEW) layer.labels = own.map((one) => one.id);
    }
    draw(id, { height: 280, layers, rules: [{ y: limit }, { y: -limit }, { y: 0, look: "solid faint" }],
      x: { ...range(some.map((one) => one.path_m / 1000), 0.1), title: "path position [km]" },
      y: Scales.wide({ lo: least * most, hi: above * most, title: "location error [m]" }, limit) });
  }

  const LOOKS = ["a", "b", "c", "d", "e"];

  // A monitor far beyond its threshold must not flatten those that are near theirs.
  function ratioPlot(now, name, layers, none) {
    const sizes = layers.filter(Boolean).map((layer) => layer.y.reduce((most, y) => Math.max(most, Math.abs(y ?? 0)), 0));
    const reach = Math.min(RATIO_REACH, Math.max(1.3, 1.1 * Math.max(0, ...sizes)));
    timePlot(now, name, "", layers, 210, { none, levels: [-1, 1], y: { lo: -reach, hi: reach, title: "value / threshold" } });
  }

  function monitorPlots(now) {
    for (const [drawing, monitors] of Object.entries(data.monitors)) {
      const lines = monitors.map(([name, label], i) => line(now, `ratio_${name}`, label, LOOKS[i % LOOKS.length]));
      const reason = now.raw.time.silent[drawing];
      ratioPlot(now, `monitors-${drawing}`, lines, `Never evaluated${reason ? `: ${reason}` : ""}.`);
    }
  }

  function confidence(now) {
    const upper = line(now, "confidence_m", "confidence", "soft");
    if (!upper) return [];
    return [upper, { ...upper, name: "", y: upper.y.map((value) => (value === null ? null : -value)) }];
  }

  // How far the position may have been carried ahead and behind without an alarm.
  function unnoticed(now) {
    const ahead = line(now, "undetected_ahead_m", "unnoticed", "c");
    const behind = line(now, "undetected_behind_m", "", "c");
    return behind ? [ahead, { ...behind, y: behind.y.map((value) => (value === null ? null : -value)) }] : [];
  }

  function timePlots(now) {
    const limit = data.limits.failure_limit_m;
    bandPlot(now, "bands", "lds");
    timePlot(now, "speed", "km/h", [line(now, "speed_mps", "speed", "a", KMH)], 180, { least: 5, none: "No speed is known." });
    const along = line(now, "error_along_m", "error", "a") ?? line(now, "residual_m", "GNSS minus odometer", "a");
    timePlot(now, "along", "m", [...confidence(now), ...unnoticed(now), along], 250, { knee: limit, levels: along ? [-limit, limit] : [], none: "No truth and no odometer to hold positions against." });
    timePlot(now, "across", "m", [
      line(now, "error_cross_m", "across", "a") ?? line(now, "cross_track_m", "across, residual", "a"),
      line(now, "error_up_m", "height", "b") ?? line(now, "vertical_m", "height, residual", "b"),
    ], 220, { least: 1, knee: limit, none: "No position was matched to the track." });
    linkingPlot(now);
    timePlot(now, "exposure", "s", [line(now, "exposure_s", "exposure", "a")], 180, { least: 1, none: "No balise was accepted and no position validated." });
    monitorPlots(now);
    bandPlot(now, "states", "monitors");
  }

  const inView = (t) => t >= state.lo && t <= state.hi;
  const whole = (now) => state.lo <= now.raw.time.t0_ms && state.hi >= now.raw.time.t1_ms;
  const GNSS = { right: ["circle", 1.4], unknown: ["square", 1.6], wrong: ["cross", 3] };

  // Positions of the stretch in view, and what is not right in any case.
  function gnssLayers(plan, t0) {
    const within = [...plan.codes.keys()].filter((row) => inView(plan.t[row] + t0));
    const stride = Math.ceil(within.length / PLAN_POINTS);
    const shown = within.filter((row, at) => at % stride === 0 || (plan.codes[row] !== 0 && plan.codes[row] !== plan.codes[row - 1]));
    return plan.states.map((name, code) => {
      const rows = shown.filter((row) => plan.codes[row] === code);
      return { type: "marks", tone: name, shape: GNSS[name], name: `GNSS ${STATES[name][1] ?? name}`, x: rows.map((row) => plan.x[row]),
        y: rows.map((row) => plan.y[row]), tell: (i) => `GNSS ${name}, ${clock(plan.t[rows[i]] + t0)}` };
    }).filter((layer) => layer.x.length);
  }

  // The plan follows the time axis: it shows where the train was in that stretch.
  function planPlot(now) {
    const id = `plot-s${state.index}-plan`;
    const { plan, t0 } = now;
    if (!plan.x.length) { empty(id, "No position was matched to the track."); return; }
    const track = plan.track.map((element, index) => ({ type: "line", look: "track", name: index ? "" : "track",
      x: unpack(element.x), y: unpack(element.y) }));
    const places = plan.balises.filter((one) => one.x !== null);
    const balises = marksOf(places, (one) => one.x, (one) => one.y, (one) => `${one.id}: ${one.outcomes} (${one.place})`);
    for (const layer of balises) layer.labels = places.filter((one) => one.outcome === layer.tone).map((one) => one.id);
    for (const layer of balises) layer.name = `balise: ${layer.name}`;
    const rows = [...plan.t.keys()].filter((row) => inView(plan.t[row] + t0));
    const [xs, ys] = [plan.x, plan.y].map((axis) => rows.map((row) => axis[row]));
    Plans.show(id, { layers: [...track, ...gnssLayers(plan, t0), ...balises], xs, ys, geographic: plan.geographic, height: 260,
      x: { ...range(xs, 60), title: "path position [m]" }, y: { ...range(ys, 4), title: "across, left positive [m]" } });
  }

  function stanfordPlot(now) {
    const id = `plot-s${state.index}-stanford`;
    const { cells, bins, width_m: width, limit_m: limit, epochs } = now.raw.stanford;
    if (!epochs) { empty(id, "No error along the track is known: there was no truth."); return; }
    const edge = bins * width;
    const steps = [1, 10, 100, 1e3, 1e4, 1e5];
    const layers = steps.map((least, step) => ({ type: "bars", tone: "heat", opacity: (step + 1) / steps.length, name: `${number(least, 6)} epochs and more`,
      items: cells.filter(([, , count]) => count >= least && count < (steps[step + 1] ?? Infinity)).map(([x, y, count]) => [x * width, (x + 1) * width, y * width, (y + 1) * width,
        `error ${number(x * width)} to ${number((x + 1) * width)} m, confidence ${number(y * width)} to ${number((y + 1) * width)} m: ${count} epochs`]),
    })).filter((layer) => layer.items.length);
    const rule = (x, y) => ({ type: "line", look: "limit", x, y });
    draw(id, { height: 460, layers: [...layers, rule([0, limit], [0, limit]), rule([0, edge], [limit, limit]), rule([limit, limit], [0, limit])],
      x: { lo: 0, hi: edge, title: "error along the track [m], last bin: beyond" }, y: { lo: 0, hi: edge, title: "confidence [m]" },
      notes: [[limit * 0.3, limit * 0.75, "nominal"], [limit * 0.7, limit * 0.25, "misleading"],
        [limit * 1.5, limit * 0.5, "hazardous"], [limit, limit * 1.5, "unavailable"]] });
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
    timePlots(now);
    planPlot(now);
    say(now);
  }

  function showAll() {
    const time = prepare(state.solution).raw.time;
    state.hazard = null;
    show(time.t0_ms - 1e9, time.t1_ms + 1e9);
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
    balisesPlot(prepare(name));
  }

  function follow() {
    const wanted = new URLSearchParams(location.hash.slice(1));
    const name = wanted.get("s") ?? state.solution ?? Object.keys(data.solutions)[0];
    const other = name !== state.solution;
    if (other) choose(name);
    const known = wanted.has("h") && zoomTo(Number(wanted.get("h")));
    if (other && !known) showAll();
    if (known) document.getElementById(`drawings-s${state.index}`).scrollIntoView();
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
  const move = (name) => () => MOVES[name](state.hi - state.lo);
  const RUNS = { "[": () => Plots.follow("previous"), "]": () => Plots.follow("next"), c: () => Plots.follow("campaign") };

  // Paper has no buttons: every solution is printed, whole.
  function printAll(begin) {
    const [shown, lo, hi, hazard] = [state.solution, state.lo, state.hi, state.hazard];
    if (begin && data.order.length > 1) {
      for (const name of Object.keys(data.solutions)) { choose(name); showAll(); }
      for (const part of document.querySelectorAll(".solution")) part.hidden = false;
      state.solution = shown;
    } else if (!begin) {
      choose(shown);
      state.hazard = hazard;
      show(lo, hi);
    }
  }

  if (Object.keys(data.solutions).length) {
    for (const button of document.querySelectorAll("button[data-move]")) button.addEventListener("click", move(button.dataset.move));
    for (const button of document.querySelectorAll("button[data-solution]")) {
      button.addEventListener("click", () => { choose(button.dataset.solution); showAll(); });
    }
    window.addEventListener("hashchange", follow);
    // The same link clicked again changes no address.
    document.addEventListener("click", (event) => {
      const link = event.target.closest?.("a[data-hazard]");
      if (link && link.hash === location.hash) follow();
    });
    Plots.keys({ n: move("next"), p: move("previous"), "+": move("in"), "=": move("in"), "-": move("out"), 0: move("all"),
      ArrowLeft: move("back"), ArrowRight: move("forward"), ...RUNS });
    window.addEventListener("beforeprint", () => printAll(true));
    window.addEventListener("afterprint", () => printAll(false));
    follow();
  } else {
    Plots.keys(RUNS);
  }
  document.body.dataset.ready = "yes";
})();
