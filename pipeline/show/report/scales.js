"use strict";
// Scales and ticks of the drawings, and numbers and times as people read them.
const Scales = (() => {
  const STEPS_MS = [100, 200, 500, 1e3, 2e3, 5e3, 1e4, 15e3, 3e4, 6e4, 12e4, 3e5, 6e5, 9e5, 18e5, 36e5, 72e5, 216e5, 432e5, 864e5];

  const number = (value, digits = 4) => {
    if (value === null || value === undefined || Number.isNaN(value)) return "–";
    const text = Math.abs(value) >= 10 ** digits ? value.toFixed(0) : String(Number(value.toPrecision(digits)));
    const [whole, part] = text.split(".");
    const spaced = whole.length > 4 && !/e/.test(text) ? whole.replace(/\B(?=(\d{3})+$)/g, "\u202f") : whole;
    return part ? `${spaced}.${part}` : spaced;
  };

  const clock = (ms, digits = 3) => new Date(ms).toISOString().slice(11, digits ? 20 + digits : 19);

  function nice(lo, hi, count) {
    const raw = (hi - lo) / Math.max(1, count);
    const power = 10 ** Math.floor(Math.log10(raw));
    const step = [1, 2, 5, 10].find((one) => one * power >= raw * 0.999) * power;
    const ticks = [];
    for (let at = Math.ceil(lo / step - 1e-9); at * step <= hi + step * 1e-9; at += 1) ticks.push(at * step);
    const digits = Math.max(0, -Math.floor(Math.log10(step) + 1e-9));
    return ticks.map((value) => [value, number(Number(value.toFixed(digits)), 9)]);
  }

  function times(lo, hi, count) {
    const step = STEPS_MS.find((one) => one >= (hi - lo) / count) ?? STEPS_MS[STEPS_MS.length - 1];
    const ticks = [];
    for (let at = Math.ceil(lo / step) * step; at <= hi; at += step) {
      ticks.push([at, step < 1e3 ? clock(at, 1) : step < 6e4 ? clock(at, 0) : clock(at, 0).slice(0, 5)]);
    }
    return ticks;
  }

  function powers(lo, hi) {
    const ticks = [];
    for (let at = Math.ceil(lo - 1e-9); at <= hi; at += 1) ticks.push([at, number(Number(`1e${at}`))]);
    return ticks;
  }

  // `at` maps a value to pixels, `value` back; a logarithmic axis has its range in powers of ten.
  function scale(axis, from, to) {
    const { lo, hi } = axis;
    const inner = axis.kind === "log" ? Math.log10 : (value) => value;
    return {
      at: (value) => from + ((inner(value) - lo) / (hi - lo)) * (to - from),
      value: (px) => lo + ((px - from) / (to - from)) * (hi - lo),
    };
  }

  function ticks(axis, room) {
    if (axis.kind === "names") return axis.names.map((name, row) => [row, name]);
    if (axis.kind === "time") return times(axis.lo, axis.hi, room / 90);
    if (axis.kind === "log") return powers(axis.lo, axis.hi).map(([power, text]) => [10 ** power, text]);
    return nice(axis.lo, axis.hi, room / (axis.upright ? 45 : 90));
  }

  // One metre is as long in both directions: the range that has room to spare is widened.
  function equal(x, y, width, height) {
    const perPx = Math.max((x.hi - x.lo) / width, (y.hi - y.lo) / height);
    const widened = (axis, px) => {
      const middle = (axis.lo + axis.hi) / 2;
      return { ...axis, lo: middle - (perPx * px) / 2, hi: middle + (perPx * px) / 2 };
    };
    return [widened(x, width), widened(y, height)];
  }

  return { number, clock, scale, ticks, equal };
})();
