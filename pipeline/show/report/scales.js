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

  // Even up to the knee on both sides of zero, logarithmic beyond: 20 m can be read beside 500 m.
  const STRETCH = 1.5;
  const bent = (knee) => (value) => {
    const size = Math.abs(value) / knee;
    return Math.sign(value) * (size <= 1 ? size : 1 + STRETCH * Math.log10(size));
  };
  const unbent = (knee) => (inner) => {
    const size = Math.abs(inner);
    return Math.sign(inner) * knee * (size <= 1 ? size : 10 ** ((size - 1) / STRETCH));
  };

  // Such an axis where values go far beyond the knee, else an even one.
  const wide = (axis, knee) => (Math.max(-axis.lo, axis.hi) > 4 * knee ? { ...axis, kind: "bent", knee } : axis);

  function bends({ lo, hi, knee }) {
    const values = [0, knee / 2, knee];
    for (let power = 10 ** Math.floor(Math.log10(knee)); power <= Math.max(-lo, hi); power *= 10) {
      values.push(...[1, 2, 5].map((digit) => digit * power).filter((value) => value > knee * 1.2));
    }
    const both = values.flatMap((value) => (value ? [-value, value] : [0])).filter((value) => value >= lo && value <= hi);
    return both.sort((a, b) => a - b).map((value) => [value, number(value)]);
  }

  // `at` maps a value to pixels, `value` back; a logarithmic axis has its range in powers of ten.
  function scale(axis, from, to) {
    const same = (value) => value;
    const [inner, outer] = axis.kind === "log" ? [Math.log10, same] : axis.kind === "bent" ? [bent(axis.knee), unbent(axis.knee)] : [same, same];
    const [lo, hi] = axis.kind === "bent" ? [inner(axis.lo), inner(axis.hi)] : [axis.lo, axis.hi];
    return {
      at: (value) => from + ((inner(value) - lo) / (hi - lo)) * (to - from),
      value: (px) => outer(lo + ((px - from) / (to - from)) * (hi - lo)),
    };
  }

  function ticks(axis, room) {
    if (axis.kind === "names") return axis.names.map((name, row) => [row, name]);
    if (axis.kind === "bent") return bends(axis);
    if (axis.kind === "time") return times(axis.lo, axis.hi, room / 90);
    if (axis.kind === "log") return powers(axis.lo, axis.hi).map(([power, text]) => [10 ** power, text]);
    return nice(axis.lo, axis.hi, room / (axis.upright ? 45 : 90));
  }

  // A round length of at most so many metres, and its text.
  function round(most) {
    const power = 10 ** Math.floor(Math.log10(most));
    const length = [5, 2, 1].find((one) => one * power <= most) * power;
    return [length, length < 1000 ? `${number(length)} m` : `${number(length / 1000)} km`];
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

  return { number, clock, scale, ticks, equal, round, wide };
})();
