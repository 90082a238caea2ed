// What every page needs: its data, Plotly, and numbers as text. All text from a file goes into the page by textContent.
"use strict";

const element = (id) => document.getElementById(id);
const pageData = JSON.parse(element("data").textContent);

// The library is compressed, as it is by far the largest part of the page.
async function loadPlotly() {
  const compressed = Uint8Array.from(atob(element("library").textContent), (c) => c.charCodeAt(0));
  const stream = new Blob([compressed]).stream().pipeThrough(new DecompressionStream("gzip"));
  const script = document.createElement("script");
  script.textContent = await new Response(stream).text();
  document.head.append(script);
}

// Plotly takes some markup in its texts, so signs that could begin one are escaped.
const escaped = (text) => text.replace(/&/g, "&amp;").replace(/</g, "&lt;").replace(/>/g, "&gt;");

// A number as it is written by hand: 0.76, 1e-5.
function plain(value) {
  return value !== 0 && Math.abs(value) < 1e-3 ? value.toExponential().replace("+", "") : String(value);
}

function numberText(value, digits = 6) {
  return value === null || value === undefined ? "–" : plain(Number(value.toPrecision(digits)));
}

function withUnit(text, unit) {
  return unit ? `${text} (${unit})` : text;
}

function colour(name) {
  return getComputedStyle(document.documentElement).getPropertyValue(`--${name}`).trim();
}

// What all charts share; grids and texts follow the light or dark scheme of the reader.
function chartLayout(further) {
  const axis = { gridcolor: colour("grid"), zerolinecolor: colour("grid"), automargin: true };
  const layout = {
    paper_bgcolor: "rgba(0,0,0,0)",
    plot_bgcolor: colour("plot"),
    font: { color: colour("text"), family: "system-ui, sans-serif", size: 13 },
    margin: { l: 8, r: 8, t: 12, b: 8 },
    hovermode: "closest",
    dragmode: matchMedia("(pointer: coarse)").matches ? false : "zoom", // a finger scrolls the page
    hoverlabel: { align: "left" },
    ...further,
  };
  for (const name of Object.keys(further).filter((key) => /^[xy]axis/.test(key))) {
    layout[name] = { ...axis, ...further[name] };
  }
  return layout;
}

const chartOptions = { displayModeBar: false, responsive: true };

// Runs the page: loads the library, starts, and says in the page what went wrong.
async function startPage(start) {
  try {
    if (typeof DecompressionStream === "undefined") {
      throw new Error("This page needs a browser of 2023 or later.");
    }
    await loadPlotly();
    start();
    document.body.dataset.ready = "yes";
  } catch (error) {
    element("about").textContent = `The page could not be shown. ${error.message}`;
    throw error;
  }
}

function whenSchemeChanges(redraw) {
  matchMedia("(prefers-color-scheme: dark)").addEventListener("change", redraw);
}
