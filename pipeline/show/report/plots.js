"use strict";
// Drawings in SVG. Colours are classes of the style sheet, so that both schemes and paper follow by themselves;
// no meaning depends on colour alone: every tone has its shape, its hatching or its dashes.
const Plots = (() => {
  const SPACE = "http://www.w3.org/2000/svg";
  const EDGE = { left: 78, time: 128, names: 128, right: 14, top: 10, bottom: 40 };
  const NEAR_PX = 12;
  const LETTERS_PX = 13;
  const [LETTER_PX, NAME_ROW_PX] = [7.4, 14];
  const SHAPES = {
    right: ["circle", 5], read: ["square", 4.5], lost: ["diamond", 6.5], unknown: ["ring", 5], wrong: ["cross", 6.5],
    hazard: ["cross", 6],
  };
  // What became of a passage, from harmless to bad: its tone, and what it is called.
  const OUTCOMES = [
    ["read", "balise read"], ["right", "accepted, right"], ["lost", "lost"],
    ["unknown", "accepted, could not be checked"], ["wrong", "accepted at a wrong place"],
  ];
  const ARRAYS = { f4: Float32Array, u4: Uint32Array, u1: Uint8Array };
  const data = JSON.parse(document.getElementById("data").textContent);
  const drawn = new Map();

  function unpack(packed) {
    const text = atob(packed.data);
    const bytes = new Uint8Array(text.length);
    for (let i = 0; i < text.length; i += 1) bytes[i] = text.charCodeAt(i);
    return new ARRAYS[packed.kind](bytes.buffer);
  }

  function make(name, attributes, parent) {
    const node = document.createElementNS(SPACE, name);
    for (const [key, value] of Object.entries(attributes)) node.setAttribute(key, value);
    if (parent) parent.append(node);
    return node;
  }

  function write(parent, x, y, text, extra = {}) {
    const node = make("text", { x: x.toFixed(1), y: y.toFixed(1), ...extra }, parent);
    node.textContent = text;
    return node;
  }

  const OUTLINES = {
    circle: (x, y, r) => `M${x - r} ${y}a${r} ${r} 0 1 0 ${2 * r} 0a${r} ${r} 0 1 0 ${-2 * r} 0`,
    square: (x, y, r) => `M${x - r} ${y - r}h${2 * r}v${2 * r}h${-2 * r}z`,
    diamond: (x, y, r) => `M${x} ${y - r}l${r} ${r}l${-r} ${r}l${-r} ${-r}z`,
    cross: (x, y, r) => `M${x - r} ${y - r}l${2 * r} ${2 * r}M${x - r} ${y + r}l${2 * r} ${-2 * r}`,
  };
  OUTLINES.ring = OUTLINES.circle;

  function marksPath(layer, sx, sy) {
    const [shape, size] = layer.shape ?? SHAPES[layer.tone];
    let path = "";
    for (let i = 0; i < layer.x.length; i += 1) {
      if (layer.y[i] === null) continue;
      path += OUTLINES[shape](Math.round(sx.at(layer.x[i]) * 10) / 10, Math.round(sy.at(layer.y[i]) * 10) / 10, size);
    }
    return [path, shape];
  }

  function linePath(layer, sx, sy) {
    let path = "";
    let pen = "M";
    for (let i = 0; i < layer.x.length; i += 1) {
      const y = layer.y[i];
      if (y === null || Number.isNaN(y)) { pen = "M"; continue; }
      path += `${pen}${sx.at(layer.x[i]).toFixed(1)} ${sy.at(y).toFixed(1)}`;
      pen = "L";
    }
    return path;
  }

  const barsPath = (layer, sx, sy) => layer.items.map(([x0, x1, y0, y1]) => {
    const [left, top] = [sx.at(x0), sy.at(y1)];
    return `M${left.toFixed(1)} ${top.toFixed(1)}h${Math.max(1, sx.at(x1) - left).toFixed(1)}V${sy.at(y0).toFixed(1)}H${left.toFixed(1)}z`;
  }).join("");

  function paint(layer, sx, sy, parent, id) {
    if (layer.type === "line") {
      make("path", { d: linePath(layer, sx, sy), class: `line ${layer.look}` }, parent);
    } else if (layer.type === "bars") {
      const d = barsPath(layer, sx, sy);
      make("path", { d, class: `bars tone-${layer.tone}`, "fill-opacity": layer.opacity ?? 1 }, parent);
      if (HATCHES[layer.tone]) make("path", { d, fill: `url(#${id}-${layer.tone})` }, parent);
    } else {
      const [d, shape] = marksPath(layer, sx, sy);
      make("path", { d, class: `marks ${shape} tone-${layer.tone}${layer.shape ? " small" : ""}` }, parent);
    }
  }

  const HATCHES = {
    wrong: "M0 0L6 6M6 0L0 6", unknown: "M0 3H6", lost: "M0 6L6 0", faint: "M3 0V6",
  };

  function defs(svg, id, frame) {
    const place = make("defs", {}, svg);
    make("rect", { x: frame.x0, y: frame.y0, width: frame.x1 - frame.x0, height: frame.y1 - frame.y0 },
      make("clipPath", { id: `${id}-clip` }, place));
    for (const [tone, d] of Object.entries(HATCHES)) {
      make("path", { d, class: "hatch" }, make("pattern", { id: `${id}-${tone}`, width: 6, height: 6, patternUnits: "userSpaceOnUse" }, place));
    }
  }

  // Axes of a plan: which way is north, and how long is a round number of metres.
  function compass(svg, spec, sx, frame) {
    const [x, y] = [frame.x1 - 24, frame.y0 + 26];
    const [dx, dy] = [Math.sin(spec.compass), -Math.cos(spec.compass)];
    const at = (along, aside) => `${(x + along * dx - aside * dy).toFixed(1)} ${(y + along * dy + aside * dx).toFixed(1)}`;
    make("path", { d: `M${at(-12, 0)}L${at(12, 0)}M${at(5, 4)}L${at(12, 0)}L${at(5, -4)}`, class: "line" }, svg);
    write(svg, x + 19 * dx, y + 19 * dy + 4, "N", { "text-anchor": "middle", class: "name" });
    const [length, text] = Scales.round((spec.x.hi - spec.x.lo) / 6);
    const [left, right] = [frame.x0 + 12, frame.x0 + 12 + sx.at(spec.x.lo + length) - sx.at(spec.x.lo)];
    make("path", { d: `M${left} ${frame.y1 - 16}v6H${right.toFixed(1)}v-6`, class: "line" }, svg);
    write(svg, (left + right) / 2, frame.y1 - 16, text, { "text-anchor": "middle", class: "name" });
  }

  // Names side by side have no room in one row.
  function crowded(axis, frame) {
    if (axis.kind !== "names") return false;
    return (frame.x1 - frame.x0) / axis.names.length < LETTER_PX * Math.max(...axis.names.map((name) => name.length));
  }

  function axes(svg, spec, sx, sy, frame) {
    if (spec.compass !== undefined) { compass(svg, spec, sx, frame); return; }
    const rows = crowded(spec.x, frame) ? 2 : 1;
    Scales.ticks(spec.x, frame.x1 - frame.x0).forEach(([value, text], index) => {
      const x = sx.at(value);
      if (spec.x.kind !== "names") make("path", { d: `M${x.toFixed(1)} ${frame.y0}V${frame.y1}`, class: "grid" }, svg);
      write(svg, x, frame.y1 + 15 + NAME_ROW_PX * (index % rows), text, { "text-anchor": "middle" });
    });
    let last = Infinity;
    for (const [value, text] of Scales.ticks({ ...spec.y, upright: true }, frame.y1 - frame.y0)) {
      const y = sy.at(value);
      if (Math.abs(last - y) < LETTERS_PX) continue;
      last = y;
      if (spec.y.kind !== "names") make("path", { d: `M${frame.x0} ${y.toFixed(1)}H${frame.x1}`, class: "grid" }, svg);
      write(svg, frame.x0 - 6, y + 4, text, { "text-anchor": "end" });
    }
    if (spec.x.title) write(svg, (frame.x0 + frame.x1) / 2, frame.y1 + 33, spec.x.title, { "text-anchor": "middle" });
    if (spec.y.kind === "bent") write(svg, frame.x0 + 6, frame.y1 - 6, `logarithmic beyond ±${Scales.number(spec.y.knee)}`, { class: "name" });
    const middle = (frame.y0 + frame.y1) / 2;
    if (spec.y.title) write(svg, 14, middle, spec.y.title, { "text-anchor": "middle", transform: `rotate(-90 14 ${middle})` });
  }

  // The worst names first; a name that would lie on another or on a mark is left out until there is room.
  function labels(svg, spec, sx, sy, frame) {
    const named = spec.layers.filter((layer) => layer.labels);
    const taken = named.flatMap((layer) => layer.labels.map((_, i) => [sx.at(layer.x[i]) - 5, sx.at(layer.x[i]) + 5, sy.at(layer.y[i]) - 5, sy.at(layer.y[i]) + 5]));
    const free = (box) => taken.every((one) => box[0] > one[1] || box[1] < one[0] || box[2] > one[3] || box[3] < one[2]);
    for (const layer of named.reverse()) {
      layer.labels.forEach((text, i) => {
        const [x, y] = [sx.at(layer.x[i]), sy.at(layer.y[i])];
        if (x < frame.x0 || x > frame.x1 || y < frame.y0 || y > frame.y1) return;
        const half = 3.4 * text.length + 3;
        for (const [dx, dy, anchor] of [[0, -9, "middle"], [0, 18, "middle"], [9, 4, "start"], [-9, 4, "end"]]) {
          const centre = x + dx + (anchor === "start" ? half : anchor === "end" ? -half : 0);
          const box = [centre - half, centre + half, y + dy - 11, y + dy + 3];
          if (!free(box)) continue;
          taken.push(box);
          write(svg, x + dx, y + dy, text, { "text-anchor": anchor, class: "name" });
          break;
        }
      });
    }
  }

  function legend(place, spec) {
    const shown = spec.layers.filter((layer) => layer.name);
    if (spec.legend === false || !shown.length) return;
    const list = document.createElement("ul");
    list.className = "legend";
    for (const layer of shown) {
      const item = document.createElement("li");
      const picture = make("svg", { width: 22, height: 14, viewBox: "0 0 22 14", "aria-hidden": "true" });
      const plain = { at: (value) => value };
      const sample = layer.type === "bars" ? { ...layer, items: [[1, 21, 12, 2]] }
        : layer.type === "line" ? { ...layer, x: [1, 21], y: [7, 7] } : { ...layer, x: [11], y: [7], shape: layer.shape && [layer.shape[0], Math.max(3, layer.shape[1])] };
      paint(sample, plain, plain, picture, place.id);
      item.append(picture, layer.name);
      list.append(item);
    }
    place.prepend(list);
  }

  // While a page is printed all is as wide as a sheet, whatever the window.
  const SHEET_PX = 1300;
  let printing = false;
  const widthOf = (id) => {
    const { clientWidth } = document.getElementById(id);
    return clientWidth && printing ? SHEET_PX : clientWidth;
  };

  function draw(id, spec) {
    const place = document.getElementById(id);
    drawn.set(id, spec);
    place.closest("figure").classList.remove("nothing");
    const width = widthOf(id);
    if (!width) return;
    const left = spec.compass !== undefined ? EDGE.right : spec.x.kind === "time" ? EDGE.time : spec.y.kind === "names" ? EDGE.names : EDGE.left;
    const frame = { x0: left, x1: width - EDGE.right, y0: EDGE.top, y1: spec.height - (spec.x.title ? EDGE.bottom : spec.compass !== undefined ? EDGE.right : 24) };
    if (crowded(spec.x, frame)) frame.y1 -= NAME_ROW_PX;
    let { x, y } = spec;
    if (spec.equal) [x, y] = Scales.equal(x, y, frame.x1 - frame.x0, frame.y1 - frame.y0);
    const shown = { ...spec, x, y };
    const sx = Scales.scale(x, frame.x0, frame.x1);
    const sy = Scales.scale(y, frame.y1, frame.y0);
    const svg = make("svg", { viewBox: `0 0 ${width} ${spec.height}`, "data-drawn": "yes" });
    defs(svg, id, frame);
    axes(svg, shown, sx, sy, frame);
    const inside = make("g", { "clip-path": `url(#${id}-clip)` }, svg);
    for (const layer of spec.layers) paint(layer, sx, sy, inside, id);
    for (const rule of spec.rules ?? []) {
      const d = rule.x === undefined ? `M${frame.x0} ${sy.at(rule.y).toFixed(1)}H${frame.x1}` : `M${sx.at(rule.x).toFixed(1)} ${frame.y0}V${frame.y1}`;
      make("path", { d, class: `rule ${rule.look ?? "dash"}` }, inside);
    }
    for (const [nx, ny, text] of spec.notes ?? []) write(svg, sx.at(nx), sy.at(ny), text, { "text-anchor": "middle", class: "name" });
    make("rect", { x: frame.x0, y: frame.y0, width: frame.x1 - frame.x0, height: frame.y1 - frame.y0, class: "frame" }, svg);
    labels(svg, spec, sx, sy, frame);
    place.replaceChildren(svg);
    legend(place, spec);
    Pointer.listen(place, svg, shown, sx, sy, frame);
  }

  // What lies under the pointer, in words; and zooming by dragging.
  const Pointer = (() => {
    const tip = document.createElement("div");
    tip.className = "tip";
    tip.hidden = true;
    document.body.append(tip);

    function nearest(values, wanted) {
      let low = 0;
      let high = values.length - 1;
      while (low < high) {
        const middle = (low + high) >> 1;
        if (values[middle] < wanted) low = middle + 1; else high = middle;
      }
      return low && wanted - values[low - 1] < values[low] - wanted ? low - 1 : low;
    }

    function markNear(layer, px, py, sx, sy) {
      let best = NEAR_PX;
      let found = null;
      for (let i = 0; i < layer.x.length; i += 1) {
        const away = Math.hypot(sx.at(layer.x[i]) - px, sy.at(layer.y[i]) - py);
        if (away < best) { best = away; found = i; }
      }
      return found;
    }

    function marksNear(layer, px, py, sx, sy) {
      const found = markNear(layer, px, py, sx, sy);
      return found === null ? [] : [layer.tell ? layer.tell(found) : layer.name];
    }

    // A click takes the mark under the pointer, the one on top, else the place itself.
    function pick(spec, px, py, sx, sy) {
      for (const layer of spec.layers.filter((one) => one.type === "marks").reverse()) {
        const found = markNear(layer, px, py, sx, sy);
        if (found !== null) { spec.pick(layer.x[found], layer.y[found], layer.tell?.(found)); return; }
      }
      spec.pick(sx.value(px), sy.value(py));
    }

    function told(spec, px, py, sx, sy) {
      const [x, y] = [sx.value(px), sy.value(py)];
      const lines = spec.layers.flatMap((layer) => {
        if (layer.quiet) return [];
        if (layer.type === "marks") return marksNear(layer, px, py, sx, sy);
        if (layer.type === "bars") {
          return layer.items.filter(([x0, x1, y0, y1]) => x >= x0 && x <= x1 && y >= y0 && y <= y1).slice(0, 1).map((item) => item[4] ?? layer.name);
        }
        if (spec.x.kind !== "time" || !layer.x.length) return [];
        const at = nearest(layer.x, x);
        return layer.y[at] === null || Math.abs(sx.at(layer.x[at]) - px) > NEAR_PX ? [] : [`${layer.name}: ${Scales.number(layer.y[at])} ${spec.y.unit ?? ""}`];
      });
      return spec.x.kind === "time" && lines.length ? [Scales.clock(x), ...lines] : lines;
    }

    function listen(place, svg, spec, sx, sy, frame) {
      let start = null;
      let box = null;
      const at = (event) => {
        const shape = svg.getBoundingClientRect();
        const zoom = svg.viewBox.baseVal.width / shape.width;
        return [(event.clientX - shape.left) * zoom, (event.clientY - shape.top) * zoom];
      };
      svg.addEventListener("pointermove", (event) => {
        const [px, py] = at(event);
        if (start) {
          box ??= make("rect", { class: "chosen-area" }, svg);
          const [y0, y1] = spec.zoomBox ? [Math.min(py, start[1]), Math.max(py, start[1])] : [frame.y0, frame.y1];
          const shape = { x: Math.min(px, start[0]), width: Math.abs(px - start[0]), y: y0, height: y1 - y0 };
          for (const [key, value] of Object.entries(shape)) box.setAttribute(key, value);
        }
        const lines = told(spec, px, py, sx, sy);
        tip.hidden = !lines.length;
        tip.textContent = lines.join("\n");
        tip.style.left = `${Math.min(event.clientX + 14, window.innerWidth - tip.offsetWidth - 8)}px`;
        tip.style.top = `${event.clientY + 14}px`;
      });
      svg.addEventListener("pointerleave", () => { tip.hidden = true; });
      svg.addEventListener("pointerdown", (event) => {
        if (event.button !== 0 || !(spec.zoom || spec.zoomBox)) return;
        start = at(event);
        svg.setPointerCapture(event.pointerId);
        event.preventDefault();
      });
      svg.addEventListener("pointerup", (event) => {
        if (!start) return;
        const [from, to] = [start, at(event)];
        start = null;
        if (box) box.remove();
        box = null;
        if (Math.abs(to[0] - from[0]) < 5) {
          if (spec.pick && Math.abs(to[1] - from[1]) < 5) pick(spec, ...to, sx, sy);
          return;
        }
        const xs = [sx.value(from[0]), sx.value(to[0])].sort((a, b) => a - b);
        if (spec.zoom) spec.zoom(...xs);
        else spec.zoomBox(xs, [sy.value(from[1]), sy.value(to[1])].sort((a, b) => a - b));
      });
      if (spec.whole) svg.addEventListener("dblclick", spec.whole);
    }

    return { listen };
  })();

  // One line with the reason stands for a drawing of nothing.
  function empty(id, text) {
    const place = document.getElementById(id);
    const note = document.createElement("p");
    note.className = "empty";
    note.textContent = text;
    drawn.delete(id);
    place.replaceChildren(note);
    place.closest("figure").classList.add("nothing");
  }

  const drawAll = () => { for (const [id, spec] of drawn) draw(id, spec); };
  let width = window.innerWidth;
  window.addEventListener("resize", () => {
    if (window.innerWidth === width) return;
    width = window.innerWidth;
    drawAll();
  });

  // Ranges that hold all values with a little room.
  function range(values, least = 0) {
    let lo = Infinity;
    let hi = -Infinity;
    for (const value of values) {
      if (value === null || Number.isNaN(value)) continue;
      if (value < lo) lo = value;
      if (value > hi) hi = value;
    }
    if (lo > hi) return { lo: -1, hi: 1 };
    const room = Math.max((hi - lo) * 0.05, (least - (hi - lo)) / 2, 1e-9);
    return { lo: lo - room, hi: hi + room };
  }

  // Paper shows what a click would open.
  window.addEventListener("beforeprint", () => {
    printing = true;
    for (const one of document.querySelectorAll("details")) one.open = true;
    drawAll();
  });
  window.addEventListener("afterprint", () => {
    printing = false;
    drawAll();
  });

  // A page is used without a mouse too.
  function keys(actions) {
    document.addEventListener("keydown", (event) => {
      if (event.ctrlKey || event.metaKey || event.altKey || event.target.matches?.("input, .scroll, pre")) return;
      const action = actions[event.key];
      if (!action) return;
      event.preventDefault();
      action();
    });
  }

  const follow = (go) => { document.querySelector(`a[data-go="${go}"]`)?.click(); };

  return { OUTCOMES, data, draw, empty, follow, keys, range, unpack, widthOf };
})();
