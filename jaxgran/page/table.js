// The numbers of the chosen point as a table, and as text to copy.
"use strict";

const COLUMNS = ["observable", "value ± error", "unit", "theory", "samples", "large system ± 95 %"];

function tableRows(observables, point) {
  return observables.map((one) => {
    const at = (part, digits) => (one[part] ? numberText(one[part][point], digits) : "");
    return [one.name.replace(/_/g, " "), one.text[point], one.unit, at("theory"), at("samples", 3), one.large?.[point] ?? ""];
  });
}

function fillTable(table, columns, rows, meanings = []) {
  const row = (cells, tag) => {
    const line = document.createElement("tr");
    cells.forEach((text, k) => {
      const cell = document.createElement(k === 0 ? "th" : tag);
      cell.scope = tag === "th" ? "col" : k === 0 ? "row" : "";
      cell.textContent = text;
      line.append(cell);
    });
    return line;
  };
  const lines = rows.map((cells) => row(cells, "td"));
  lines.forEach((line, k) => (line.title = meanings[k] ?? ""));
  table.tHead.replaceChildren(row(columns, "th"));
  table.tBodies[0].replaceChildren(...lines);
}

// Copies a text and says so on the button; a page from a disc may not have a clipboard of its own.
async function copyText(text, button) {
  const word = button.dataset.word ?? button.textContent;
  button.dataset.word = word;
  try {
    await navigator.clipboard.writeText(text);
  } catch {
    const area = document.createElement("textarea");
    area.value = text;
    document.body.append(area);
    area.select();
    document.execCommand("copy");
    area.remove();
  }
  button.textContent = "Copied";
  setTimeout(() => (button.textContent = word), 1500);
}
