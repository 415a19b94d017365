"use strict";
// The page of a site: its plan, with ids.
(() => {
  const { data, unpack } = Plots;
  const KINDS = { virtual: ["right", "virtual balise"], physical: ["read", "physical balise"] };
  const lines = data.elements.map((one) => ({ name: one.name, x: unpack(one.x), y: unpack(one.y) }));
  const middle = (values) => values[Math.floor(values.length / 2)];

  function plan() {
    const track = lines.map((one, index) => ({ type: "line", look: "track", name: index ? "" : "net element", x: one.x, y: one.y }));
    const ids = { type: "marks", shape: ["circle", 1.5], tone: "unknown", name: "", labels: lines.map((one) => one.name),
      x: lines.map((one) => middle(one.x)), y: lines.map((one) => middle(one.y)), tell: (i) => `net element ${lines[i].name}` };
    const marks = Object.entries(KINDS).map(([kind, [tone, name]]) => {
      const shown = data.balises.filter((one) => one.kind === kind);
      return { type: "marks", tone, name, labels: shown.map((one) => one.id), x: shown.map((one) => one.x), y: shown.map((one) => one.y),
        tell: (i) => `${shown[i].id}: ${shown[i].place}` };
    }).filter((layer) => layer.x.length);
    const [xs, ys] = ["x", "y"].map((axis) => lines.flatMap((one) => Array.from(one[axis])));
    Plans.show("plot-site", { layers: [...track, ids, ...marks], xs, ys, geographic: true });
  }

  plan();
  document.body.dataset.ready = "yes";
})();
