"use strict";
// Plans of the ground: turned so that the track lies across the page, with coordinates to take away.
const Plans = (() => {
  const { data, draw, range } = Plots;
  const HEIGHT = { least: 260, most: 620 };
  const EDGES_PX = 28;
  const ROOM_M = 60;
  const DEG = Math.PI / 180;
  // WGS 84.
  const A_M = 6378137;
  const E2 = 0.00669437999014133;
  const MEAN_M = 6371000;

  // Latitude and longitude of a place east and north of the origin, in its tangent plane [m].
  function geodetic([lat, lon], east, north) {
    const [sinLat, cosLat, sinLon, cosLon] = [Math.sin(lat * DEG), Math.cos(lat * DEG), Math.sin(lon * DEG), Math.cos(lon * DEG)];
    const radius = A_M / Math.sqrt(1 - E2 * sinLat * sinLat);
    // The ground falls away from the plane.
    const up = -(east * east + north * north) / (2 * MEAN_M);
    const out = radius * cosLat - north * sinLat + up * cosLat;
    const x = out * cosLon - east * sinLon;
    const y = out * sinLon + east * cosLon;
    const z = radius * (1 - E2) * sinLat + north * cosLat + up * sinLat;
    const axis = Math.hypot(x, y);
    let found = Math.atan2(z, axis * (1 - E2));
    for (let turn = 0; turn < 3; turn += 1) {
      const sine = Math.sin(found);
      found = Math.atan2(z + (E2 * A_M * sine) / Math.sqrt(1 - E2 * sine * sine), axis);
    }
    return [found / DEG, Math.atan2(y, x) / DEG];
  }

  // The direction in which the points stretch most [rad from east to north], 0 where there is none.
  function direction(xs, ys) {
    let [count, x, y] = [0, 0, 0];
    const known = (i) => Number.isFinite(xs[i]) && Number.isFinite(ys[i]);
    for (let i = 0; i < xs.length; i += 1) if (known(i)) { count += 1; x += xs[i]; y += ys[i]; }
    if (count < 2) return 0;
    let [xx, xy, yy] = [0, 0, 0];
    for (let i = 0; i < xs.length; i += 1) {
      if (!known(i)) continue;
      const [dx, dy] = [xs[i] - x / count, ys[i] - y / count];
      xx += dx * dx;
      xy += dx * dy;
      yy += dy * dy;
    }
    return Math.abs(xx - yy) + Math.abs(xy) < 1e-6 ? 0 : Math.atan2(2 * xy, xx - yy) / 2;
  }

  const turn = (angle, x, y) => [x * Math.cos(angle) + y * Math.sin(angle), y * Math.cos(angle) - x * Math.sin(angle)];

  function turned(layer, angle) {
    const x = new Array(layer.x.length);
    const y = new Array(layer.x.length);
    for (let i = 0; i < layer.x.length; i += 1) {
      [x[i], y[i]] = layer.x[i] === null ? [null, null] : turn(angle, layer.x[i], layer.y[i]);
    }
    return { ...layer, x, y };
  }

  // The place that was clicked, or the middle of what is shown: to select, to copy, to open on a map.
  function tellPlace(id, east, north, words) {
    const [lat, lon] = geodetic(data.origin, east, north).map((angle) => angle.toFixed(7));
    const figure = document.getElementById(id).closest("figure");
    let line = figure.querySelector(".place");
    if (!line) {
      line = document.createElement("p");
      line.className = "place";
      figure.append(line);
    }
    const place = document.createElement("output");
    place.textContent = `${lat}, ${lon}`;
    const copy = document.createElement("button");
    copy.type = "button";
    copy.textContent = "copy";
    copy.addEventListener("click", () => navigator.clipboard.writeText(place.textContent).then(() => { copy.textContent = "copied"; }));
    const map = document.createElement("a");
    map.href = `https://www.openstreetmap.org/?mlat=${lat}&mlon=${lon}#map=17/${lat}/${lon}`;
    map.target = "_blank";
    map.rel = "noopener noreferrer";
    map.textContent = "open in OpenStreetMap";
    const hint = document.createElement("small");
    hint.textContent = "Click the plan for another place. Nothing leaves this page until you open the map.";
    line.replaceChildren(`${words}: `, place, " ", copy, " ", map, " ", hint);
  }

  // `spec`: layers, the points that matter (`xs`, `ys`), `geographic`, and axes (`x`, `y`) for what is no plan.
  function show(id, spec) {
    if (!spec.geographic) { showFlat(id, spec); return; }
    const angle = direction(spec.xs, spec.ys);
    const points = turned({ x: Array.from(spec.xs), y: Array.from(spec.ys) }, angle);
    const [x, y] = spec.box ?? [range(points.x, ROOM_M), range(points.y, ROOM_M)];
    const width = Plots.widthOf(id) - EDGES_PX;
    const wanted = (width * (y.hi - y.lo)) / (x.hi - x.lo) + EDGES_PX;
    const height = Math.round(Math.min(HEIGHT.most, Math.max(HEIGHT.least, wanted)));
    const back = (px, py) => turn(-angle, px, py);
    draw(id, {
      height, layers: spec.layers.map((layer) => turned(layer, angle)), equal: true, compass: angle,
      x: { ...x, kind: "plan" }, y: { ...y, kind: "plan" },
      zoomBox: (wx, wy) => show(id, { ...spec, box: [{ lo: wx[0], hi: wx[1] }, { lo: wy[0], hi: wy[1] }] }),
      whole: () => show(id, { ...spec, box: null }),
      pick: (px, py, words) => tellPlace(id, ...back(px, py), words || "Place"),
    });
    if (!spec.box && spec.xs.length) {
      const middle = spec.xs.length >> 1;
      tellPlace(id, spec.xs[middle], spec.ys[middle], "Middle of what is shown");
    }
  }

  function showFlat(id, spec) {
    const [x, y] = spec.box ?? [spec.x, spec.y];
    draw(id, { height: spec.height, layers: spec.layers, x: { ...spec.x, ...x }, y: spec.y.kind ? spec.y : { ...spec.y, ...y },
      zoomBox: (wx, wy) => show(id, { ...spec, box: [{ lo: wx[0], hi: wx[1] }, { lo: wy[0], hi: wy[1] }] }),
      whole: () => show(id, { ...spec, box: null }) });
  }

  return { geodetic, show };
})();
