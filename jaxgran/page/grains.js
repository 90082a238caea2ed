// Grains in their sheared cell and the forces between them, drawn as by jg.flow_figure.
"use strict";

const unpackedInstants = new WeakMap();

// Numbers of an instant, see grain_data.py: parts of 65536 of the cell, of the largest radius and of the scale.
function unpacked(instant) {
  if (unpackedInstants.has(instant)) return unpackedInstants.get(instant);
  const bytes = Uint8Array.from(atob(instant.data), (c) => c.charCodeAt(0));
  const view = new DataView(bytes.buffer);
  let at = 0;
  const wide = (count) => Array.from({ length: count }, () => view.getUint16((at += 2) - 2, true));
  const narrow = (count) => bytes.subarray(at, (at += count));
  const { grains, pairs } = instant;
  const found = {
    x: wide(grains), y: wide(grains), i: wide(pairs), j: wide(pairs),
    radius: narrow(grains), speed: narrow(grains), force: narrow(pairs), clustered: narrow(pairs),
  };
  unpackedInstants.set(instant, found);
  return found;
}

function rampColour(ramp, share) {
  const at = Math.min(share, 1) * (ramp.length - 1);
  const k = Math.min(Math.floor(at), ramp.length - 2);
  const part = (text, c) => parseInt(text.slice(1 + 2 * c, 3 + 2 * c), 16);
  const mixed = [0, 1, 2].map((c) => Math.round(part(ramp[k], c) + (at - k) * (part(ramp[k + 1], c) - part(ramp[k], c))));
  return `rgb(${mixed.join(",")})`;
}

// Draws an instant on a canvas. Parts that reach over an edge of the cell are drawn at the opposite edge.
function drawGrains(canvas, instant, encoding) {
  const { side, tilt } = instant;
  const grains = unpacked(instant);
  const pixels = canvas.clientWidth * (window.devicePixelRatio || 1);
  const half = 0.5 * side;
  const scale = pixels / (1.5 * side * 1.02); // room for any tilt, so that a cell that is sheared does not jump
  canvas.width = pixels;
  canvas.height = Math.round(scale * side * 1.14);
  const pen = canvas.getContext("2d");
  const point = pixels / 420; // a typographic point of flow_figure, whose cell is as wide on paper
  pen.fillStyle = "white";
  pen.fillRect(0, 0, canvas.width, canvas.height);
  pen.translate(pixels / 2, scale * half * 1.04);
  pen.scale(scale, -scale);
  const corners = [[-1, -1], [1, -1], [1, 1], [-1, 1]].map(([a, b]) => [half * (a + tilt * b), half * b]);
  const outline = () => {
    pen.beginPath();
    corners.forEach(([x, y], k) => (k ? pen.lineTo(x, y) : pen.moveTo(x, y)));
    pen.closePath();
  };
  pen.save();
  outline();
  pen.clip();
  const place = (k) => {
    const [x, y] = [grains.x[k] / 65536, grains.y[k] / 65536]; // of the cell, from its lower left corner
    const up = (y < 0.5 ? y : y - 1) * side; // the cell is drawn around its centre, where positions are zero
    return [((x < 0.5 ? x : x - 1) * side) + tilt * up, up];
  };
  const shifts = [-1, 0, 1].flatMap((b) => [-1, 0, 1].map((a) => [side * (a + tilt * b), side * b]));
  pen.lineWidth = (0.4 * point) / scale;
  pen.strokeStyle = encoding.edge;
  for (let k = 0; k < instant.grains; k++) {
    const [x, y] = place(k);
    const radius = (grains.radius[k] / 255) * instant.radius;
    pen.fillStyle = rampColour(encoding.ramp, grains.speed[k] / 255);
    for (const [dx, dy] of shifts) {
      const [px, py] = [x + dx, y + dy];
      if (Math.abs(py) > half + radius || Math.abs(px - tilt * py) > half + 1.2 * radius) continue;
      pen.beginPath();
      pen.arc(px, py, radius, 0, 2 * Math.PI);
      pen.fill();
      pen.stroke();
    }
  }
  pen.lineCap = "round";
  for (const clustered of [1, 0]) {
    pen.strokeStyle = clustered ? encoding.cluster : encoding.binary;
    for (let pair = 0; pair < instant.pairs; pair++) {
      if (grains.clustered[pair] !== clustered) continue;
      const [[xi, yi], [xj, yj]] = [place(grains.i[pair]), place(grains.j[pair])];
      const rows = Math.round((yi - yj) / side);
      const across = xi - xj - rows * tilt * side;
      const branch = [across - side * Math.round(across / side), yi - yj - rows * side];
      const width = Math.max((grains.force[pair] / 255) * encoding.widest, encoding.thinnest);
      pen.lineWidth = (width * point) / scale;
      for (const [dx, dy] of shifts) {
        pen.beginPath();
        pen.moveTo(xj + dx, yj + dy);
        pen.lineTo(xj + dx + branch[0], yj + dy + branch[1]);
        pen.stroke();
      }
    }
  }
  pen.restore();
  outline();
  pen.strokeStyle = "#404040";
  pen.lineWidth = (0.9 * point) / scale;
  pen.stroke();
  drawScaleBar(pen, side, scale, point);
}

function drawScaleBar(pen, side, scale, point) {
  const length = [1, 2, 5, 10, 20, 50, 100].filter((n) => n <= 0.3 * side).pop() || 1;
  const [x, y] = [-0.7 * side, -0.565 * side];
  pen.beginPath();
  pen.moveTo(x, y);
  pen.lineTo(x + length, y);
  pen.lineCap = "butt";
  pen.strokeStyle = "black";
  pen.lineWidth = (1.6 * point) / scale;
  pen.stroke();
  pen.setTransform(1, 0, 0, 1, 0, 0);
  pen.fillStyle = "black";
  pen.font = `${Math.round(9 * point)}px system-ui, sans-serif`;
  pen.textBaseline = "middle";
  pen.fillText(`${length} σ`, pen.canvas.width / 2 + scale * (x + length) + 5 * point, scale * (0.52 * side - y));
}

// What the lines and colours of a picture mean, in words.
function grainCaption(instant) {
  return [
    "Black: forces within clusters of three or more grains. Red: binary collisions.",
    `The widest line is a force of ${numberText(instant.force, 2)} mσγ̇² or more; all are those of one time step.`,
    `Blue: peculiar speed, deepest from ${numberText(instant.speed, 2)} σγ̇.`,
  ].join(" ");
}
