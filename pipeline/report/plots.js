"use strict";
// What all drawings share. Colours are those of Okabe and Ito; no meaning hangs on colour alone.
const Plots = (() => {
  const scheme = window.matchMedia("(prefers-color-scheme: dark)");
  scheme.addEventListener("change", () => location.reload());
  const COLOUR = {
    orange: "#e69f00", sky: "#56b4e9", green: "#009e73", yellow: "#c9b400",
    blue: scheme.matches ? "#3b9ae1" : "#0072b2", vermilion: "#d55e00", purple: "#cc79a7", grey: "#999999", pale: "rgba(140,140,140,0.28)",
  };
  const STATE = {
    P0: [COLOUR.blue, "circle", ""], P1: [COLOUR.vermilion, "x", "x"], P2: [COLOUR.orange, "diamond", "/"],
    P3: [COLOUR.purple, "triangle-up", "."], "not known": [COLOUR.grey, "circle-open", "-"],
    linked: [COLOUR.blue, "", ""], initialising: [COLOUR.sky, "", "."], odometry: [COLOUR.orange, "", "/"],
    fail_safe: [COLOUR.vermilion, "", "x"],
    TVB: [COLOUR.blue, "", ""], "no TVB": [COLOUR.orange, "", "/"],
    right: [COLOUR.blue, "", ""], unknown: [COLOUR.grey, "", "-"], wrong: [COLOUR.vermilion, "", "x"],
    "no alarm": [COLOUR.pale, "", ""], alarm: [COLOUR.vermilion, "", "x"],
    pass: [COLOUR.blue, "", ""], not_evaluated: [COLOUR.pale, "", "-"], fail: [COLOUR.vermilion, "", "x"],
  };
  const PASSAGE = {
    accepted: [COLOUR.green, "circle"], rejected_window: [COLOUR.orange, "square"],
    rejected_unlinked: [COLOUR.yellow, "square-open"], rejected_monitor: [COLOUR.vermilion, "diamond"],
    rejected_confidence: [COLOUR.purple, "triangle-up"], rejected_ambiguous: [COLOUR.sky, "triangle-down"],
    missed: [COLOUR.vermilion, "x"], not_available: [COLOUR.grey, "circle-open"],
  };
  const LINES = [
    [COLOUR.blue, "solid"], [COLOUR.orange, "solid"], [COLOUR.green, "solid"], [COLOUR.purple, "solid"],
    [COLOUR.sky, "dash"], [COLOUR.vermilion, "dot"],
  ];
  const ARRAYS = { f4: Float32Array, u4: Uint32Array, u1: Uint8Array };

  function unpack(packed) {
    const text = atob(packed.data);
    const bytes = new Uint8Array(text.length);
    for (let i = 0; i < text.length; i += 1) bytes[i] = text.charCodeAt(i);
    return new ARRAYS[packed.kind](bytes.buffer);
  }

  const data = JSON.parse(document.getElementById("data").textContent);

  const axis = (title, extra = {}) => ({
    title: { text: title, standoff: 6 }, gridcolor: "rgba(128,128,128,0.25)", linecolor: "rgba(128,128,128,0.6)",
    zerolinecolor: "rgba(128,128,128,0.6)", automargin: true, ...extra,
  });

  const layout = (height, extra = {}) => ({
    height, margin: { l: 70, r: 20, t: 12, b: 40 }, paper_bgcolor: "rgba(0,0,0,0)", plot_bgcolor: "rgba(0,0,0,0)",
    font: { family: 'system-ui, "Segoe UI", "DejaVu Sans", sans-serif', size: 12 }, hovermode: "closest",
    modebar: { bgcolor: "rgba(0,0,0,0)", color: "#888888", activecolor: "#0072b2" },
    legend: { orientation: "h", y: 1.02, yanchor: "bottom", x: 0 }, ...extra,
  });

  const pattern = (color, shape) => ({ shape, size: 6, solidity: 0.3, bgcolor: color, fgcolor: "#ffffff" });

  // The library offers to upload a drawing to its maker; a report never leaves the place where it lies.
  const config = { responsive: true, displaylogo: false, scrollZoom: false, showSendToCloud: false, plotlyServerURL: "",
    modeBarButtonsToRemove: ["select2d", "lasso2d", "autoScale2d"] };

  function draw(id, traces, shape) {
    return Plotly.react(id, traces, shape, config);
  }

  function empty(id, text) {
    const place = document.getElementById(id);
    const note = document.createElement("p");
    note.className = "empty";
    note.textContent = text;
    place.replaceChildren(note);
  }

  // On paper a drawing has the width of the page (A4 across), whatever the window's.
  const PAPER_PX = 960;
  const drawn = () => document.querySelectorAll(".js-plotly-plot");
  window.addEventListener("beforeprint", () => {
    for (const place of drawn()) Plotly.relayout(place, { autosize: false, width: Math.min(PAPER_PX, place.clientWidth || PAPER_PX) });
  });
  window.addEventListener("afterprint", () => {
    for (const place of drawn()) Plotly.relayout(place, { autosize: true, width: null });
  });

  return { COLOUR, STATE, PASSAGE, LINES, axis, config, data, draw, empty, layout, pattern, unpack };
})();
