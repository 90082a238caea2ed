// What is chosen, the controls that choose it, and the address that keeps it.
"use strict";

const SWITCHES = { quotient: "over kinetic theory", log: "logarithmic", excess: "excess lines" };
const listOf = Object.fromEntries(choices.map((choice) => [choice.name, choice.texts]));
const chosen = {
  observable: 0, packing_fraction: y.length >> 1, restitution: x.length >> 1,
  grains: listOf.grains.length - 1, timestep: 0,
  quotient: false, log: true, excess: true,
};

// A cell is a place in the plane; a point also has a number of grains and a time step.
const firstPoint = () => (chosen.grains * listOf.timestep.length + chosen.timestep) * x.length * y.length;
const inPart = (list) => list.slice(firstPoint(), firstPoint() + x.length * y.length);
const chosenCell = () => chosen.packing_fraction * x.length + chosen.restitution;
const chosenObservable = () => observables[chosen.observable];

const chosenView = () => chosenObservable().views[Number(chosen.quotient)] ?? chosenObservable().views[0];

function show() {
  const cell = chosenCell(), point = cell + firstPoint();
  const column = y.map((_, row) => row * x.length + chosen.restitution);
  const row = x.map((_, k) => chosen.packing_fraction * x.length + k);
  drawPlane();
  drawCurve("against-nu", column, y, "packing fraction ν", `α = ${listOf.restitution[chosen.restitution]}`);
  drawCurve("against-alpha", row, x, "1 − α", `ν = ${listOf.packing_fraction[chosen.packing_fraction]}`);
  const flow = data.reference.flows[cell], instant = data.instants?.[point];
  const texts = {
    which: data.headings[point], status: data.status[point],
    verdict: flow ? flow.verdict : data.reference.outside,
    "grains-caption": instant ? instant.caption : "This point has no picture.",
  };
  for (const [id, text] of Object.entries(texts)) element(id).textContent = text;
  element("status").classList.toggle("bad", data.bad[point]);
  fillTable("numbers", tableRows(point), observables.map((one) => one.meaning));
  fillTable("verdict-numbers", flow ? [data.reference.columns, ...flow.rows] : []);
  element("grains-part").hidden = !data.instants;
  element("grains").hidden = !instant;
  if (instant) drawGrains(element("grains"), instant);
  for (const name of Object.keys(chosen)) element(`choose-${name}`)[name in SWITCHES ? "checked" : "value"] = chosen[name];
  element("choose-quotient").disabled = chosenObservable().views.length < 2;
  keepAddress();
}

const tableRows = (point) => [data.columns, ...observables.map((one) => [one.label, ...one.texts.map((texts) => texts?.[point] ?? "")])];

function fillTable(id, rows, meanings = []) {
  const table = element(id);
  table.replaceChildren();
  table.parentElement.hidden = !rows.length;
  rows.forEach((cells, k) => {
    const line = (k ? table.tBodies[0] ?? table.createTBody() : table.createTHead()).insertRow();
    line.title = meanings[k - 1] ?? "";
    cells.forEach((text, place) => {
      const cell = document.createElement(k && place ? "td" : "th");
      cell.textContent = text;
      line.append(cell);
    });
  });
}

function fillControls() {
  const add = (name, control, text, before) => {
    const label = document.createElement("label");
    control.id = `choose-${name}`;
    label.append(...(before ? [text, control] : [control, ` ${text}`]));
    element("controls").append(label);
    control.addEventListener("change", () => {
      chosen[name] = name in SWITCHES ? control.checked : Number(control.value);
      show();
    });
    return label;
  };
  for (const { name, label, texts } of choices) {
    const select = document.createElement("select");
    select.append(...texts.map((text, k) => new Option(text, k)));
    add(name, select, label, true).hidden = texts.length < 2;
  }
  for (const [name, text] of Object.entries(SWITCHES)) {
    const box = document.createElement("input");
    box.type = "checkbox";
    add(name, box, text, false);
  }
}

// Arrow keys move the chosen point over the plane: to the right is a smaller α, upwards a larger ν.
function moveByKey(event) {
  const step = { ArrowUp: [1, 0], ArrowDown: [-1, 0], ArrowLeft: [0, 1], ArrowRight: [0, -1] }[event.key];
  if (!step) return;
  event.preventDefault();
  ["packing_fraction", "restitution"].forEach((name, k) => {
    chosen[name] = Math.min(Math.max(chosen[name] + step[k], 0), listOf[name].length - 1);
  });
  show();
}

function keepAddress() {
  const kept = Object.entries(chosen).map(([name, value]) => [name, listOf[name]?.[value] ?? value]);
  try {
    history.replaceState(null, "", `#${new URLSearchParams(kept)}`);
  } catch { /* a page inside a notebook has no address of its own */ }
}

function readAddress() {
  for (const [name, text] of new URLSearchParams(location.hash.slice(1))) {
    if (name in SWITCHES) chosen[name] = text === "true";
    else if (listOf[name]?.includes(text)) chosen[name] = listOf[name].indexOf(text);
  }
}

async function copyTable({ target }) {
  const rows = tableRows(chosenCell() + firstPoint()), label = target.textContent;
  await navigator.clipboard.writeText(rows.map((cells) => cells.join("\t")).join("\n"));
  target.textContent = "Copied";
  setTimeout(() => (target.textContent = label), 1500);
}

async function start() {
  for (const id of ["title", "about", "notes"]) element(id).textContent = data[id];
  element("verdict-about").textContent = data.reference.about;
  fillControls();
  readAddress();
  await loadPlotly();
  show();
  for (const id of ["plane", "against-nu", "against-alpha"]) {
    element(id).on("plotly_click", ({ points }) => {
      const cell = points.find((point) => point.customdata !== undefined)?.customdata;
      if (cell === undefined) return;
      [chosen.packing_fraction, chosen.restitution] = [Math.floor(cell / x.length), cell % x.length];
      show();
    });
  }
  element("plane").addEventListener("keydown", moveByKey);
  element("copy-numbers").addEventListener("click", copyTable);
  addEventListener("hashchange", () => { readAddress(); show(); });
  addEventListener("resize", show);
  matchMedia("(prefers-color-scheme: dark)").addEventListener("change", show);
  document.body.dataset.ready = "yes";
}

start().catch((error) => {
  element("about").textContent = `The page could not be shown (it needs a browser of 2023 or later). ${error.message}`;
  throw error;
});
