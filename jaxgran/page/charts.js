// The plane of 1 − α and ν, and the curves through the chosen point, from the data of map_data.py.
"use strict";

const element = (id) => document.getElementById(id);
const data = JSON.parse(element("data").textContent);
const { x, y, observables, choices } = data;
// Dark enough in grey, light enough for black lines.
const SHADES = [[0, "#f7fafc"], [0.35, "#bdd7ea"], [0.7, "#6ba3d0"], [1, "#2b6cab"]];
const SCATTER = { type: "scatter", mode: "markers", showlegend: false, hoverinfo: "skip" };
const SETTINGS = { displayModeBar: false, responsive: true };

const colour = (name) => getComputedStyle(document.documentElement).getPropertyValue(`--${name}`);
// Plotly takes some markup in its texts, so signs that could begin one are escaped.
const escaped = (text) => text.replace(/&/g, "&amp;").replace(/</g, "&lt;").replace(/>/g, "&gt;");
const ring = (size) => ({ symbol: "circle-open", size, color: colour("bad"), line: { width: 2 } });
const diamond = (size) => ({ symbol: "diamond-open", size, color: "#c05600", line: { width: 3 } });

// The library is compressed, as it is by far the largest part of the page.
async function loadPlotly() {
  const bytes = Uint8Array.from(atob(element("library").textContent), (c) => c.charCodeAt(0));
  const stream = new Blob([bytes]).stream().pipeThrough(new DecompressionStream("gzip"));
  const script = document.createElement("script");
  script.textContent = await new Response(stream).text();
  document.head.append(script);
}

// Draws a chart; grids and texts follow the light or dark scheme of the reader.
function draw(id, traces, xaxis, yaxis, further) {
  const axis = { gridcolor: colour("grid"), zerolinecolor: colour("grid"), automargin: true };
  Plotly.react(id, traces, {
    paper_bgcolor: "rgba(0,0,0,0)", plot_bgcolor: "rgba(0,0,0,0)",
    font: { color: colour("text"), family: "system-ui, sans-serif", size: 13 },
    margin: { l: 8, r: 16, t: 40, b: 8 }, hovermode: "closest", hoverlabel: { align: "left" },
    dragmode: matchMedia("(pointer: coarse)").matches ? false : "zoom", // a finger scrolls the page
    xaxis: { ...axis, ...xaxis }, yaxis: { ...axis, ...yaxis }, ...further,
  }, SETTINGS);
}

function hoverText(point) {
  const lines = data.columns.slice(1).map((column, k) => [column, chosenObservable().texts[k]])
    .filter(([, texts]) => texts).map(([column, texts]) => `${column}: ${texts[point]}`);
  const text = [data.headings[point], chosenObservable().label, ...lines, data.status[point]];
  return text.map(escaped).join("<br>");
}

// Plotly's contours of a quantity of the cells, given row by row.
function contoursOf(heights, further) {
  const z = y.map((_, row) => heights.slice(row * x.length, (row + 1) * x.length));
  return { type: "contour", x, y, z, hoverinfo: "skip", connectgaps: false, ...further };
}

function drawPlane() {
  const view = chosenView(), isPlane = x.length > 1 && y.length > 1;
  const cells = y.flatMap((_, row) => x.map((_, k) => row * x.length + k));
  const value = inPart(view.value), heights = chosen.log ? value.map((v) => (v > 0 ? Math.log10(v) : null)) : value;
  const colorbar = {
    title: { text: escaped(chosen.log ? `log10 of ${view.label}` : view.label), side: "top" },
    outlinewidth: 0, thickness: 14, orientation: "h", y: 1.02, yanchor: "bottom",
  };
  const excess = chosen.excess ? inPart(observables[0].views[0].value).map((v) => v && v - 1) : [];
  const fields = [
    contoursOf(heights, {
      name: "observable", colorscale: SHADES, colorbar, ncontours: 12, line: { color: "rgba(40,60,80,0.55)", width: 0.8 },
      contours: { coloring: "heatmap", showlabels: !chosen.excess, labelfont: { size: 11, color: "#345" } },
    }),
    ...data.levels.slice(0, excess.length).map((level, k) => contoursOf(excess, {
      name: `excess ${level}`, showscale: false, line: { color: "#111", width: 1 + 0.6 * k },
      contours: { start: level, end: level, size: 1, coloring: "none", showlabels: true, labelfont: { size: 12, color: "#111" } },
    })),
  ];
  const dots = isPlane ? { size: 7, color: "#223", line: { color: "white", width: 1 } }
    : { size: 16, color: heights, colorscale: SHADES, colorbar, line: { color: colour("text"), width: 1 } };
  const points = (name, chosenCells, marker) => ({
    ...SCATTER, name, x: chosenCells.map((k) => x[k % x.length]), y: chosenCells.map((k) => y[Math.floor(k / x.length)]), marker,
  });
  draw("plane", [
    ...(isPlane ? fields : []),
    { ...points("points", cells, dots), customdata: cells, text: cells.map((k) => hoverText(k + firstPoint())), hoverinfo: "text" },
    points("bad status", cells.filter((k) => data.bad[k + firstPoint()] && value[k] !== null), ring(15)),
    points("no value", cells.filter((k) => value[k] === null), { symbol: "x-thin", size: 11, line: { color: colour("text"), width: 2 } }),
    points("chosen point", [chosenCell()], diamond(20)),
  ], { title: { text: "1 − α", standoff: 36 } }, { title: { text: "packing fraction ν" } }, { showlegend: false, margin: { l: 8, r: 16, t: 8, b: 56 } });
}

// A curve of the map through the chosen point: its cells and their places along it.
function drawCurve(id, cells, places, label, title) {
  const view = chosenView(), pick = (list) => list && cells.map((k) => list[k + firstPoint()]);
  const [value, error, theory] = [view.value, view.error, view.theory].map(pick);
  const bad = cells.map((k, place) => (data.bad[k + firstPoint()] ? value[place] : null));
  const chosenPlace = cells.indexOf(chosenCell());
  const positive = [...value, ...(theory ?? [])].filter((v) => v > 0);
  const span = Math.max(...positive) / Math.min(...positive);
  const dtick = span > 100 ? 1 : span > 4 ? "D2" : undefined; // decades, 1, 2 and 5, or Plotly's own
  const traces = [{
    ...SCATTER, mode: "lines+markers", name: "measured", x: places, y: value, customdata: cells,
    text: cells.map((k) => hoverText(k + firstPoint())), hoverinfo: "text", showlegend: true,
    error_y: { type: "data", array: error, visible: Boolean(error), thickness: 1.2, width: 4 },
    line: { color: colour("curve"), width: 2 }, marker: { size: 7 },
  }, { ...SCATTER, name: "status not ok", x: places, y: bad, marker: ring(15) },
  { ...SCATTER, name: "chosen point", x: [places[chosenPlace]], y: [value[chosenPlace]], marker: diamond(16) }];
  if (theory) traces.splice(1, 0, { ...SCATTER, mode: "lines", name: "kinetic theory", x: places, y: theory, line: { color: colour("theory"), dash: "dash" }, showlegend: true });
  draw(id, traces, { title: { text: label } }, {
    title: { text: escaped(view.label).replace(" / ", "<br>/ ") }, exponentformat: "power", ...(chosen.log ? { type: "log", dtick } : {}),
  }, {
    title: { text: title, font: { size: 14 }, x: 0.02, xanchor: "left" },
    legend: { orientation: "h", y: 1.02, yanchor: "bottom", x: 1, xanchor: "right", font: { size: 12 } },
  });
}
