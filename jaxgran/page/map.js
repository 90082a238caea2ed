// A page of a map: what is chosen, the controls that choose it, and the address that keeps it.
"use strict";

const [sizes, timesteps, fractions, restitutions] = pageData.axes.map((axis) => axis.values);
const observables = pageData.observables;
const names = observables.map((one) => one.name);
const ratio = observables[names.indexOf("force_ratio")];
const first = Math.max(names.indexOf("excess"), 0);
const chosen = {
  observable: first, grains: sizes.length - 1, timestep: 0, row: fractions.length >> 1, column: restitutions.length >> 1,
  quotient: false, log: names[first] === "excess" && observables[first].value.some((v) => v > 0), excess: true, levels: 10,
};

// Numbers of points: grains, time step, row of ν, column of α; a map without several sizes or time steps has one.
const pointAt = (row, column) => {
  const part = Math.max(chosen.grains, 0) * Math.max(timesteps.length, 1) + chosen.timestep;
  return (part * fractions.length + row) * restitutions.length + column;
};
const timestepAt = (point) => plain(timesteps[chosen.timestep]);
const grainsAt = (point) => pageData.grains?.[point] ?? sizes[Math.max(chosen.grains, 0)];
const overPlane = (what) => fractions.map((_, row) => restitutions.map((_, column) => what(pointAt(row, column), row, column)));
const words = (status) => status.replace(/_/g, " ") + (pageData.meanings[status] ? `: ${pageData.meanings[status]}` : "");

// ------------------------------------------------------------------------------------------------------- view

function currentView() {
  const one = observables[chosen.observable];
  const quotient = chosen.quotient && one.theory;
  const divided = (part) => (point) => {
    const number = one[part][point];
    return quotient ? (shown(number) && one.theory[point] ? number / one.theory[point] : null) : number;
  };
  return {
    x: restitutions.map((a) => Number((1 - a).toFixed(12))), y: fractions,
    value: overPlane(divided("value")),
    error: one.error ? overPlane(divided("error")) : null,
    theory: one.theory ? overPlane(divided("theory")) : null,
    status: overPlane((point) => pageData.status[point]),
    excess: ratio ? overPlane((point) => (shown(ratio.value[point]) ? ratio.value[point] - 1 : null)) : null,
    hover: (row, column) => hoverText(one, row, column),
    label: withUnit(one.name.replace(/_/g, " "), quotient ? "" : one.unit) + (quotient ? " / kinetic theory" : ""),
    row: chosen.row, column: chosen.column, log: chosen.log,
  };
}

function hoverText(one, row, column) {
  const point = pointAt(row, column);
  const lines = [
    `α = ${plain(restitutions[column])}, ν = ${plain(fractions[row])}`,
    `${one.name.replace(/_/g, " ")} = ${one.text[point]} ${one.unit}`,
  ];
  if (one.theory) lines.push(`kinetic theory ${numberText(one.theory[point])}`);
  if (sizes.length) lines.push(`N = ${grainsAt(point)}${timesteps.length ? `, dt = ${timestepAt(point)}/γ̇` : ""}`);
  if (one.samples) lines.push(`${numberText(one.samples[point], 3)} effective samples`);
  lines.push(`status ${pageData.status[point].replace(/_/g, " ")}`);
  return lines.map(escaped).join("<br>");
}

// ----------------------------------------------------------------------------------------------------- drawing

function draw() {
  const view = currentView();
  const excess = chosen.excess && view.excess && pageData.excessLevels.length ? pageData.excessLevels : null;
  Plotly.react("plane", planeTraces(view, chosen.levels, excess), planeLayout(view), chartOptions);
  const alpha = restitutions[chosen.column], nu = fractions[chosen.row];
  const column = fractions.map((_, row) => [row, chosen.column]), row = restitutions.map((_, k) => [chosen.row, k]);
  Plotly.react("against-nu", curveTraces(view, fractions, column, chosen.row), curveLayout(view, `α = ${alpha}`, "packing fraction ν"), chartOptions);
  Plotly.react("against-alpha", curveTraces(view, view.x, row, chosen.column), curveLayout(view, `ν = ${nu}`, "1 − α"), chartOptions);
  drawPoint(alpha, nu);
  showControls();
  keepAddress();
}

function drawPoint(alpha, nu) {
  const point = pointAt(chosen.row, chosen.column);
  const which = [`α = ${alpha}`, `ν = ${nu}`];
  if (sizes.length) which.push(`N = ${grainsAt(point)}`);
  if (timesteps.length) which.push(`dt = ${timestepAt(point)}/γ̇`);
  element("which").textContent = which.join(", ");
  element("status").textContent = `Status ${words(pageData.status[point])}.`;
  element("status").classList.toggle("bad", pageData.status[point] !== "ok");
  fillTable(element("numbers"), COLUMNS, tableRows(observables, point), observables.map((one) => one.meaning));
  const { flows, columns, outside } = pageData.reference, flow = flows[chosen.row * restitutions.length + chosen.column];
  element("verdict").textContent = flow ? flow.verdict : outside;
  element("verdict-part").hidden = !flow;
  fillTable(element("verdict-numbers"), columns, flow?.rows ?? []);
  const command = commandAgain(point, alpha, nu);
  element("again").hidden = !command;
  element("command").textContent = command;
  const instant = pageData.instants?.[point];
  element("grains-part").hidden = !pageData.instants;
  element("grains").hidden = !instant;
  element("grains-caption").textContent = instant ? grainCaption(instant) : "This point has no instant.";
  if (instant) drawGrains(element("grains"), instant, pageData.encoding);
}

// Four times the strain halves the standard error.
function commandAgain(point, alpha, nu) {
  const again = pageData.again;
  if (!again || !sizes.length || !timesteps.length || !again.strain[point]) return "";
  const strain = Number((4 * again.strain[point]).toPrecision(3));
  return `jaxgran map --restitution ${alpha} --packing-fraction ${nu} --grains ${grainsAt(point)} --seeds ${again.seeds}` +
    ` --timestep ${timestepAt(point)} --strain ${strain} ${again.options} --output point.nc`;
}

// ---------------------------------------------------------------------------------------------------- controls

const CHOICES = { observable: names, grains: sizes, timestep: timesteps, row: fractions, column: restitutions };
const SWITCHES = ["quotient", "log", "excess"];

function fillControls() {
  const texts = { observable: observables.map((one) => withUnit(one.name.replace(/_/g, " "), one.unit)) };
  for (const [name, values] of Object.entries(CHOICES)) {
    const select = element(`choose-${name}`);
    values.forEach((value, k) => {
      const option = document.createElement("option");
      option.value = k;
      option.textContent = texts[name] ? texts[name][k] : plain(value);
      select.append(option);
    });
    select.parentElement.hidden = values.length < 2 && ["grains", "timestep"].includes(name);
    select.addEventListener("change", () => { chosen[name] = Number(select.value); draw(); });
  }
  for (const name of SWITCHES) {
    element(`choose-${name}`).addEventListener("change", (event) => { chosen[name] = event.target.checked; draw(); });
  }
  element("choose-levels").addEventListener("input", (event) => { chosen.levels = Number(event.target.value); draw(); });
}

function showControls() {
  for (const name of Object.keys(CHOICES)) element(`choose-${name}`).value = chosen[name];
  for (const name of SWITCHES) element(`choose-${name}`).checked = chosen[name];
  element("choose-levels").value = chosen.levels;
  element("choose-quotient").disabled = !observables[chosen.observable].theory;
  element("choose-excess").parentElement.hidden = !ratio;
}

function chooseCell(cell) {
  [chosen.row, chosen.column] = cell;
  draw();
}

// Arrow keys move the chosen point over the plane: to the right is a smaller α, upwards a larger ν.
function moveByKey(event) {
  const step = { ArrowUp: [1, 0], ArrowDown: [-1, 0], ArrowLeft: [0, 1], ArrowRight: [0, -1] }[event.key];
  if (!step) return;
  event.preventDefault();
  const within = (k, list) => Math.min(Math.max(k, 0), list.length - 1);
  chooseCell([within(chosen.row + step[0], fractions), within(chosen.column + step[1], restitutions)]);
}

// ----------------------------------------------------------------------------------------------------- address

const inAddress = (value) => (typeof value === "number" ? plain(value) : value);

function keepAddress() {
  const kept = new URLSearchParams();
  for (const [name, values] of Object.entries(CHOICES)) if (values.length) kept.set(name, inAddress(values[chosen[name]]));
  for (const name of SWITCHES) kept.set(name, chosen[name] ? "yes" : "no");
  kept.set("levels", chosen.levels);
  if (location.hash.slice(1) === kept.toString()) return;
  try {
    history.replaceState(null, "", `#${kept}`);
  } catch { /* a page inside a notebook has no address of its own */ }
}

function readAddress() {
  const kept = new URLSearchParams(location.hash.slice(1));
  for (const [name, values] of Object.entries(CHOICES)) {
    const place = values.map(inAddress).indexOf(kept.get(name));
    if (place >= 0) chosen[name] = place;
  }
  for (const name of SWITCHES) if (kept.has(name)) chosen[name] = kept.get(name) === "yes";
  const levels = Number(kept.get("levels"));
  if (levels >= 2 && levels <= 30) chosen.levels = Math.round(levels);
}

// ------------------------------------------------------------------------------------------------------- start

function startMap() {
  element("title").textContent = pageData.title;
  const belongs = [];
  if (sizes.length) belongs.push(pageData.grains ? `N chosen by point, up to ${sizes[0]}` : `N = ${sizes.join(", ")}`);
  if (timesteps.length) belongs.push(`dt = ${timesteps.map(plain).join(", ")}/γ̇`);
  if (pageData.about) belongs.push(pageData.about);
  element("about").textContent = `${belongs.join(", ")}. Error bars are one standard error of sampling. ` +
    `${ratio ? "The excess is the force ratio − 1. " : ""}Choose a point by a click, or with the arrow keys.`;
  element("verdict-about").textContent = pageData.reference.about;
  element("notes").replaceChildren(...pageData.notes.map((note) => {
    const line = document.createElement("p");
    line.textContent = note;
    return line;
  }));
  fillControls();
  readAddress();
  draw();
  for (const id of ["plane", "against-nu", "against-alpha"]) {
    element(id).on("plotly_click", (event) => {
      const hit = event.points.find((point) => point.customdata);
      if (hit) chooseCell(hit.customdata);
    });
  }
  element("plane").addEventListener("keydown", moveByKey);
  element("copy-numbers").addEventListener("click", (event) => {
    const rows = tableRows(observables, pointAt(chosen.row, chosen.column));
    copyText([COLUMNS, ...rows].map((cells) => cells.join("\t")).join("\n"), event.target);
  });
  element("copy-command").addEventListener("click", (event) => copyText(element("command").textContent, event.target));
  addEventListener("hashchange", () => { readAddress(); draw(); });
  addEventListener("resize", () => drawPoint(restitutions[chosen.column], fractions[chosen.row]));
  whenSchemeChanges(draw);
}

startPage(startMap);
