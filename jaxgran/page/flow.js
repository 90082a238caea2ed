// A page of a flow that plays: frames, the averages up to them, pause, step and speed.
"use strict";

const FRAMES_PER_SECOND = 12;
const MARKED = 3; // of so many frames one is marked in the charts while the flow plays, as that takes longest
const { frames, averages } = pageData;
const strains = pageData.strain;
let now = 0;
let playing = false;
let shownAt = 0; // milliseconds, of the frame that is shown

const narrow = matchMedia("(max-width: 40rem)");

function drawAverages() {
  const columns = narrow.matches ? 1 : 2;
  const rows = Math.ceil(averages.length / columns);
  const further = {
    grid: { rows, columns, pattern: "independent", xgap: 0.15, ygap: 0.4 }, showlegend: false, annotations: [],
    margin: { l: 8, r: 8, t: 32, b: 8 },
  };
  element("averages").style.height = `${200 * rows}px`;
  const lines = [], marks = [];
  averages.forEach((one, k) => {
    const at = k ? String(k + 1) : "";
    const onAxes = { type: "scatter", xaxis: `x${at}`, yaxis: `y${at}` };
    lines.push({ ...onAxes, mode: "lines", x: strains, y: one.values, line: { color: colour("curve"), width: 2 }, name: one.name });
    marks.push({ ...onAxes, mode: "markers", x: [strains[now]], y: [one.values[now]], marker: { size: 11, symbol: "diamond", color: "#c05600" }, hoverinfo: "skip" });
    further[`xaxis${at}`] = k >= averages.length - columns ? { title: { text: "strain" } } : {};
    further[`yaxis${at}`] = {};
    further.annotations.push({
      text: escaped(withUnit(one.name, one.unit)), xref: `x${at} domain`, yref: `y${at} domain`, x: 0, y: 1,
      xanchor: "left", yanchor: "bottom", showarrow: false,
    });
  });
  Plotly.react("averages", [...lines, ...marks], chartLayout(further), chartOptions);
}

function showFrame(k) {
  now = Math.min(Math.max(k, 0), frames.length - 1);
  drawGrains(element("grains"), frames[now], pageData.encoding);
  element("frame").value = now;
  element("strain").textContent = `strain ${strains[now].toFixed(3)}, frame ${now + 1} of ${frames.length}`;
  if (playing && now % MARKED) return;
  const marked = averages.map((_, one) => averages.length + one);
  Plotly.restyle("averages", { x: averages.map(() => [strains[now]]), y: averages.map((one) => [one.values[now]]) }, marked);
}

function setPlaying(wanted) {
  playing = wanted;
  element("play").textContent = playing ? "Pause" : "Play";
  if (playing) requestAnimationFrame(tick);
}

function tick(time) {
  if (!playing) return;
  const wait = 1000 / (FRAMES_PER_SECOND * Number(element("speed").value));
  if (time - shownAt >= wait) {
    shownAt = time;
    showFrame((now + 1) % frames.length);
  }
  requestAnimationFrame(tick);
}

function step(by) {
  setPlaying(false);
  showFrame(now + by);
}

function startFlow() {
  element("title").textContent = pageData.title;
  element("about").textContent = pageData.about;
  element("grains-caption").textContent = grainCaption(frames[0]);
  element("frame").max = frames.length - 1;
  drawAverages();
  showFrame(0);
  element("play").addEventListener("click", () => setPlaying(!playing));
  element("back").addEventListener("click", () => step(-1));
  element("forward").addEventListener("click", () => step(1));
  element("frame").addEventListener("input", (event) => { setPlaying(false); showFrame(Number(event.target.value)); });
  addEventListener("resize", () => showFrame(now));
  narrow.addEventListener("change", drawAverages);
  whenSchemeChanges(drawAverages);
  setPlaying(!matchMedia("(prefers-reduced-motion: reduce)").matches);
}

startPage(startFlow);
