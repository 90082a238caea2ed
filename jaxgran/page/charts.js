// The plane of 1 − α and ν, and the curves through the chosen point. A "view" is what charts need of the map:
// x, y: values of 1 − α and ν; value, error, theory, status: by row of ν and column of α; label; log.
"use strict";

const RING = { symbol: "circle-open", size: 15, color: "#b2182b", line: { width: 2 } };
const SCALE = [[0, "#f7fafc"], [0.35, "#bdd7ea"], [0.7, "#6ba3d0"], [1, "#2b6cab"]]; // dark enough in grey, light enough for black lines
const EXCESS_LINEAR_BELOW = 0.01; // as in the contours of Figure 2
const EXCESS_STEPS = 6; // of the interpolation between two points

const flat = (rows) => rows.flat();
const shown = (value) => value !== null && Number.isFinite(value);

// Round levels between the smallest and the largest value, about as many as asked for.
function roundLevels(values, count) {
  const low = Math.min(...values), high = Math.max(...values);
  if (!(high > low)) return { start: low, end: low, size: 1, levels: [low] };
  const rough = (high - low) / count;
  const unit = 10 ** Math.floor(Math.log10(rough));
  const size = unit * [1, 2, 5, 10].find((step) => step * unit >= rough * 0.999);
  const noise = 0.02 * (high - low); // the lowest level is above what may be scatter around a constant
  const start = Math.ceil((low + noise) / size) * size;
  const levels = [];
  for (let level = start; level <= high * (1 + 1e-9) + 1e-300; level = start + levels.length * size) levels.push(level);
  return { start, end: levels.at(-1) ?? start, size, levels };
}

// The logarithms of levels that can be read off: of 1, 2 and 5 in each decade, of 1 alone if these are more than asked
// for, or of round levels if these are too few.
function logLevels(logarithms, count) {
  const low = Math.min(...logarithms), high = Math.max(...logarithms);
  const decades = Array.from({ length: Math.ceil(high) - Math.floor(low) + 1 }, (_, k) => Math.floor(low) + k);
  const within = (digits) => decades.flatMap((decade) => digits.map((digit) => decade + Math.log10(digit)))
    .filter((level) => level >= low - 1e-9 && level <= high + 1e-9);
  const [every, powers] = [within([1, 2, 5]), within([1])];
  if (every.length > 2 && every.length <= count) return every;
  if (powers.length > 1) return powers;
  return roundLevels([10 ** low, 10 ** high], count).levels.filter((level) => level > 0).map(Math.log10);
}

// A field between the points of the map, bilinearly; null where a point without a value would count.
function interpolated(field, steps) {
  const axis = (count) => Array.from({ length: (count - 1) * steps + 1 }, (_, k) => k / steps);
  const between = (low, high, share) => (share ? (low === null || high === null ? null : low + share * (high - low)) : low);
  const along = (row, at) => between(row[Math.floor(at)], row[Math.ceil(at)], at % 1);
  return axis(field.length).map((at) => {
    const [low, high] = [field[Math.floor(at)], field[Math.ceil(at)]];
    return axis(field[0].length).map((column) => between(along(low, column), along(high, column), at % 1));
  });
}

// The contours of the excess of the force ratio over one, each wider than the one before. Their labels stand at the
// right edge, where the lines are far from each other.
function excessTraces(excess, x, y, levels) {
  const bent = excess.map((row) => row.map((e) => (e === null ? null : Math.asinh(e / EXCESS_LINEAR_BELOW))));
  const z = interpolated(bent, EXCESS_STEPS).map((row) => row.map((b) => (b === null ? null : EXCESS_LINEAR_BELOW * Math.sinh(b))));
  const [fineX, fineY] = [x, y].map((axis) => interpolated([axis], EXCESS_STEPS)[0]);
  const lines = levels.map((level, k) => ({
    type: "contour", x: fineX, y: fineY, z, name: `excess ${level}`, showscale: false, hoverinfo: "skip", showlegend: false,
    contours: { start: level, end: level, size: 1, coloring: "none" }, line: { color: "#111", width: 1 + 0.6 * k },
  }));
  const edge = fineX.indexOf(Math.max(...fineX));
  const crossings = levels.map((level) => z.findIndex((row, k) => k > 0 && shown(row[edge]) && shown(z[k - 1][edge]) && row[edge] >= level && z[k - 1][edge] < level));
  const labels = levels.map((level, k) => ({ level, at: crossings[k] })).filter(({ at }) => at > 0);
  return [...lines, {
    type: "scatter", mode: "text", name: "levels of the excess", hoverinfo: "skip", showlegend: false, cliponaxis: false,
    x: labels.map(() => fineX[edge]), y: labels.map(({ at }) => fineY[at]), text: labels.map(({ level }) => `  ${level.toFixed(2)}`),
    textposition: "middle right", textfont: { size: 12, color: colour("text") },
  }];
}

function planeTraces(view, levelCount, excessLevels) {
  const { x, y, value, log } = view;
  const z = value.map((row) => row.map((v) => (!shown(v) || (log && v <= 0) ? null : log ? Math.log10(v) : v)));
  const known = flat(z).filter((v) => v !== null);
  const levels = roundLevels(known, levelCount);
  const ticks = log && known.length ? logLevels(known, levelCount) : levels.levels;
  const bar = {
    title: { text: escaped(view.label), side: "right" }, tickvals: ticks, ticktext: ticks.map((tick) => numberText(log ? 10 ** tick : tick, 3)),
    thickness: 14, outlinewidth: 0, len: 1, xpad: excessLevels ? 36 : 10, // the levels of the excess stand before it
  };
  const colours = { colorscale: SCALE, colorbar: bar, zmin: Math.min(...known), zmax: Math.max(...known) };
  const isPlane = x.length > 1 && y.length > 1;
  const points = { x: [], y: [], text: [], customdata: [], colour: [] };
  const bad = { x: [], y: [] }, missing = { x: [], y: [] };
  y.forEach((nu, row) => x.forEach((a, column) => {
    const group = shown(value[row][column]) ? points : missing;
    for (const list of [points, ...(group === missing ? [missing] : [])]) { list.x.push(a); list.y.push(nu); }
    points.text.push(view.hover(row, column));
    points.customdata.push([row, column]);
    points.colour.push(z[row][column]);
    if (group === points && view.status[row][column] !== "ok") { bad.x.push(a); bad.y.push(nu); }
  }));
  const traces = [];
  if (isPlane && known.length) {
    const field = { type: "contour", x, y, z, hoverinfo: "skip", connectgaps: false, line: { color: "rgba(40,60,80,0.55)", width: 0.8 } };
    const filled = { start: levels.start, end: levels.end, size: levels.size, coloring: "fill", showlabels: true, labelfont: { size: 11, color: "#345" } };
    traces.push({ ...field, ...colours, name: "observable", contours: log ? { coloring: "heatmap", showlines: false } : filled });
    // Levels of one contour trace have equal steps, and these have not.
    if (log) traces.push(...ticks.map((tick) => ({ ...field, showscale: false, name: "level", contours: { start: tick, end: tick, size: 1, coloring: "none" } })));
    if (excessLevels) traces.push(...excessTraces(view.excess, x, y, excessLevels));
  }
  const dots = isPlane ? { size: 7, color: "#223", line: { color: "white", width: 1 } }
    : { size: 16, color: points.colour, colorscale: SCALE, colorbar: bar, cmin: colours.zmin, cmax: colours.zmax, line: { color: colour("text"), width: 1 } };
  const scatter = { type: "scatter", mode: "markers", showlegend: false };
  traces.push({ ...scatter, x: points.x, y: points.y, marker: dots, text: points.text, customdata: points.customdata, hovertemplate: "%{text}<extra></extra>", name: "points" });
  traces.push({ ...scatter, ...bad, marker: RING, hoverinfo: "skip", name: "bad status" });
  traces.push({ ...scatter, ...missing, marker: { symbol: "x-thin", size: 11, line: { color: colour("text"), width: 2 } }, hoverinfo: "skip", name: "no value" });
  traces.push({ ...scatter, x: [x[view.column]], y: [y[view.row]], marker: { symbol: "diamond-open", size: 20, color: "#c05600", line: { width: 3 } }, hoverinfo: "skip", name: "chosen point" });
  return traces;
}

function planeLayout(view) {
  return chartLayout({
    xaxis: { title: { text: "1 − α" } },
    yaxis: { title: { text: "packing fraction ν" } },
    showlegend: false,
  });
}

// A curve of the map through the chosen point: positions along it, the cells (row, column), and the chosen place.
function curveTraces(view, positions, cells, chosen) {
  const pick = (field) => cells.map(([row, column]) => (field ? field[row][column] : null));
  const value = pick(view.value), error = pick(view.error), theory = pick(view.theory);
  const bad = cells.map(([row, column], k) => (shown(value[k]) && view.status[row][column] !== "ok" ? value[k] : null));
  const traces = [{
    type: "scatter", mode: "lines+markers", name: "measured", x: positions, y: value, customdata: cells,
    text: cells.map(([row, column]) => view.hover(row, column)), hovertemplate: "%{text}<extra></extra>",
    error_y: { type: "data", array: error, visible: error.some(shown), color: colour("curve"), thickness: 1.2, width: 4 },
    line: { color: colour("curve"), width: 2 }, marker: { size: 7, color: colour("curve") },
  }];
  if (theory.some(shown)) {
    traces.push({ type: "scatter", mode: "lines", name: "kinetic theory", x: positions, y: theory, line: { color: colour("theory"), dash: "dash", width: 2 }, hovertemplate: "kinetic theory %{y:.6g}<extra></extra>" });
  }
  traces.push({ type: "scatter", mode: "markers", name: "status not ok", x: positions, y: bad, marker: RING, hoverinfo: "skip", showlegend: bad.some(shown) });
  traces.push({ type: "scatter", mode: "markers", name: "chosen point", x: [positions[chosen]], y: [value[chosen]], marker: { symbol: "diamond-open", size: 16, color: "#c05600", line: { width: 3 } }, hoverinfo: "skip", showlegend: false });
  return traces;
}

function curveLayout(view, title, label) {
  const positive = flat(view.value).filter((v) => v > 0);
  const dtick = Math.max(...positive) > 1e3 * Math.min(...positive) ? 1 : "D2"; // a tick a decade, or also at 2 and 5
  return chartLayout({
    xaxis: { title: { text: label } },
    yaxis: { title: { text: escaped(view.label) }, type: view.log ? "log" : "linear", exponentformat: "power", ...(view.log ? { dtick } : {}) },
    title: { text: escaped(title), font: { size: 14 }, x: 0.02, xanchor: "left" },
    showlegend: true,
    legend: { orientation: "h", y: 1.02, yanchor: "bottom", x: 1, xanchor: "right", font: { size: 12 } },
    margin: { l: 8, r: 8, t: 40, b: 8 },
  });
}
