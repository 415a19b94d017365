"use strict";
// The page of a campaign: distributions, and where on the network positions could be had.
(() => {
  const { OUTCOMES, data, draw, empty } = Plots;
  const TIMING = [["in time", "right"], ["too late", "wrong"], ["could not be checked", "unknown"]];
  const LEAST_S = 0.05;

  // What nobody could have seen was not found either.
  const noHazard = (own) => `No hazard was found; ${own.runs_with_truth} of ${own.runs} runs had a truth to find one by.`;

  // Bars on bars: `rows` of [x0, x1, [count per series]].
  function stacked(series, rows) {
    const layers = series.map(([name, tone]) => ({ type: "bars", name, tone, items: [] }));
    let most = 1;
    for (const [x0, x1, counts] of rows) {
      let base = 0;
      counts.forEach((count, index) => {
        if (count) layers[index].items.push([x0, x1, base, base + count, `${series[index][0]}: ${count}`]);
        base += count;
      });
      most = Math.max(most, base);
    }
    return [layers.filter((layer) => layer.items.length), most * 1.05];
  }

  function classesPlot(id, own) {
    if (!own.hazards) { empty(id, noHazard(own)); return; }
    const [layers, most] = stacked(TIMING, own.classes.map(([, ...counts], at) => [at - 0.3, at + 0.3, counts]));
    draw(id, { height: 240, layers, x: { kind: "names", names: own.classes.map((row) => row[0]), lo: -0.6, hi: own.classes.length - 0.4 },
      y: { lo: 0, hi: most, title: "hazards" } });
  }

  // Share that had happened by then; what happened within one epoch stands at the left edge of the logarithmic axis.
  function shareCurve(times, total, name, look) {
    if (!total || !times.length) return null;
    const x = [LEAST_S / 2];
    const y = [0];
    times.forEach((time, index) => {
      const at = Math.max(time, LEAST_S);
      x.push(at, at);
      y.push(index / total, (index + 1) / total);
    });
    x.push(1e6);
    y.push(times.length / total);
    return { type: "line", name: `${name}: ${times.length} of ${total}`, x, y, look };
  }

  function detectionPlot(id, own) {
    const layers = [
      shareCurve(own.time_to_detect_s, own.hazards, "detected, T_D", "a"),
      shareCurve(own.hazardous_s, own.failures, "in use no longer, unknown time included", "b"),
    ].filter(Boolean);
    if (!layers.length) { empty(id, own.hazards ? `None of ${own.hazards} hazards was detected.` : noHazard(own)); return; }
    const notes = data.levels.map(([name, allowed], index) => [allowed, 0.06 + 0.08 * (index % 4), `${name} ${Scales.number(allowed)} s`]);
    draw(id, { height: 320, layers, notes, rules: data.levels.map(([, allowed]) => ({ x: allowed })),
      x: { kind: "log", lo: Math.log10(LEAST_S / 2), hi: 3, title: `time [s], at most ${LEAST_S} s at the left edge` },
      y: { lo: 0, hi: 1.05, title: "share" } });
  }

  function locationPlot(id, own) {
    if (!own.location.length) { empty(id, "No location error is known."); return; }
    const bins = new Map();
    for (const [outcome, at, count] of own.location) {
      if (!bins.has(at)) bins.set(at, OUTCOMES.map(() => 0));
      bins.get(at)[OUTCOMES.findIndex(([key]) => key === outcome)] += count;
    }
    const [layers, most] = stacked(OUTCOMES.map(([tone, name]) => [name, tone]), [...bins].map(([at, counts]) => [at, at + 1, counts]));
    const limit = data.limits.failure_limit_m;
    const reach = Math.max(...[...bins.keys()].map(Math.abs)) + 3;
    draw(id, { height: 280, layers, y: { lo: 0, hi: most, title: "offers" },
      x: { lo: -reach, hi: reach, title: "location error [m], beyond 50 m in the last bins" },
      rules: [-limit, limit].filter((x) => Math.abs(x) < reach).map((x) => ({ x })) });
  }

  const CLASSES = [[0.999, "all epochs", "m1"], [0.95, "95 % and more", "m2"], [0.5, "50 % and more", "m3"], [0, "less than half", "m4"],
    [null, "not known", "m0"]];

  function mapLayers(map) {
    const lines = map.track.map((one, index) => ({ type: "line", look: "track", name: index ? "" : "track", x: one.x, y: one.y }));
    const groups = CLASSES.map(([least, name, look], index) => {
      const most = index ? CLASSES[index - 1][0] : Infinity;
      const layer = { type: "line", name, look, x: [], y: [] };
      for (const piece of map.pieces) {
        if (least === null ? piece.share !== null : piece.share === null || piece.share < least || piece.share >= most) continue;
        layer.x.push(...piece.x, null);
        layer.y.push(...piece.y, null);
      }
      return layer;
    }).filter((layer) => layer.x.length);
    const places = map.pieces.filter((piece) => piece.x.length);
    const middles = { type: "marks", tone: "none", shape: ["circle", 0], x: places.map((piece) => piece.x[piece.x.length >> 1]),
      y: places.map((piece) => piece.y[piece.y.length >> 1]),
      tell: (i) => `${places[i].name}, ${places[i].from_m} to ${places[i].to_m} m: ${places[i].share === null ? "not known" : `${(100 * places[i].share).toFixed(1)} % of ${places[i].epochs} epochs`}` };
    const hazards = { type: "marks", tone: "hazard", name: "hazard", x: map.hazards.map((one) => one[0]),
      y: map.hazards.map((one) => one[1]), tell: (i) => map.hazards[i][2] };
    return [...lines, ...groups, middles, ...(map.hazards.length ? [hazards] : [])];
  }

  function mapPlot(id, own) {
    const map = own.map;
    if (!map.pieces.length) { empty(id, "No position of a moving train was matched to the track."); return; }
    const [xs, ys] = ["x", "y"].map((key) => map.pieces.flatMap((piece) => piece[key]));
    Plans.show(id, { layers: mapLayers(map), xs, ys, geographic: map.geographic, height: Math.min(900, 90 + 34 * map.elements.length),
      x: { ...Plots.range(xs, 100), title: "measure on the net element [m]" },
      y: { kind: "names", names: map.elements, lo: -0.7, hi: map.elements.length - 0.3 } });
  }

  data.order.forEach((name, index) => {
    const own = data.solutions[name];
    classesPlot(`plot-s${index}-classes`, own);
    detectionPlot(`plot-s${index}-detection`, own);
    locationPlot(`plot-s${index}-location`, own);
    mapPlot(`plot-s${index}-map`, own);
  });

  // Keys go from link to link: hazards, and runs.
  function step(selector, by) {
    const links = [...document.querySelectorAll(selector)].filter((link) => !link.closest("tr").hidden);
    if (!links.length) return;
    const at = links.indexOf(document.activeElement);
    links[at < 0 ? (by > 0 ? 0 : links.length - 1) : (at + by + links.length) % links.length].focus();
  }
  Plots.keys({ n: () => step("a[data-hazard]", 1), p: () => step("a[data-hazard]", -1),
    "]": () => step("a[data-run]", 1), "[": () => step("a[data-run]", -1) });
  document.body.dataset.ready = "yes";
})();
