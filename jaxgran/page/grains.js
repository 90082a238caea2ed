// Grains and forces as jg.flow_figure draws them; grain_data.py has written what is in the window.
"use strict";

// The columns of a table of whole numbers of 16 bits.
function unpacked(text, count) {
  const numbers = new Int16Array(Uint8Array.from(atob(text), (c) => c.charCodeAt(0)).buffer);
  const size = numbers.length / count;
  return Array.from({ length: count }, (_, k) => numbers.subarray(k * size, (k + 1) * size));
}

function drawGrains(canvas, instant) {
  const { parts, ramp, edge, bars } = data.encoding;
  const pixels = canvas.clientWidth * (window.devicePixelRatio || 1);
  canvas.width = canvas.height = pixels;
  const pen = canvas.getContext("2d");
  pen.fillStyle = "white";
  pen.fillRect(0, 0, pixels, pixels);
  pen.translate(pixels / 2, pixels / 2);
  pen.scale(pixels / parts, -pixels / parts);
  pen.strokeStyle = edge;
  pen.lineWidth = parts / 1000;
  const [x, y, radius, colour] = unpacked(instant.grains, 4);
  for (let k = 0; k < x.length; k++) {
    pen.fillStyle = ramp[colour[k]];
    pen.beginPath();
    pen.arc(x[k], y[k], radius[k], 0, 2 * Math.PI);
    pen.fill();
    pen.stroke();
  }
  const [middleX, middleY, alongX, alongY, width, clustered] = unpacked(instant.bars, 6);
  pen.lineCap = "round";
  for (const kind of [1, 0]) {
    pen.strokeStyle = bars[kind];
    for (let k = 0; k < width.length; k++) {
      if (clustered[k] !== kind) continue;
      pen.lineWidth = width[k];
      pen.beginPath();
      pen.moveTo(middleX[k] - alongX[k], middleY[k] - alongY[k]);
      pen.lineTo(middleX[k] + alongX[k], middleY[k] + alongY[k]);
      pen.stroke();
    }
  }
}
