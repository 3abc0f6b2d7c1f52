// Data and drawing of the interactive plots, with the ticks and styles of svg.py and the colours
// of the page.

const LEFT = 62, RIGHT = 14, TOP = 8, BOTTOM = 42;
const FONT = '12px system-ui, -apple-system, "Segoe UI", sans-serif';
const DASH = [6, 4];

// Decode the columns of a figure: a compressed block of float32 in base64; see page.embed.
async function unpack(figure) {
  const text = atob(figure.block), bytes = new Uint8Array(text.length);
  for (let i = 0; i < text.length; i++) bytes[i] = text.charCodeAt(i);
  const plain = new Blob([bytes]).stream().pipeThrough(new DecompressionStream('deflate'));
  const buffer = await new Response(plain).arrayBuffer();
  const column = ([place, count]) => new Float32Array(buffer, place, count);
  for (const curve of figure.curves) {
    curve.x = column(curve.x);
    curve.y = column(curve.y);
    curve.high = curve.high && column(curve.high);
    curve.shown = true;
    curve.sorted = curve.x.every((x, i) => i === 0 || x >= curve.x[i - 1]);
  }
  figure.block = '';
}

// One axis: data to pixels and back, over the part in view.
class Scale {
  constructor(axis) {
    this.axis = axis;
    this.log = axis.log;
    this.set(axis.low, axis.high);
  }

  set(low, high) {
    this.low = low;
    this.high = high;
    this.a = this.even(low);
    this.b = this.even(high);
  }

  pixels(start, stop) {
    this.start = start;
    this.stop = stop;
  }

  // Even: where distances on the axis are equal.
  even(v) { return this.log ? (v > 0 ? Math.log10(v) : NaN) : v; }

  uneven(v) { return this.log ? 10 ** v : v; }

  at(v) {
    return this.start + (this.even(v) - this.a) / (this.b - this.a) * (this.stop - this.start);
  }

  value(pixel) {
    const share = (pixel - this.start) / (this.stop - this.start);
    return this.uneven(this.a + share * (this.b - this.a));
  }

  ticks(count) {
    return (this.log ? logTicks : linearTicks)(this.low, this.high, count);
  }
}

function linearTicks(low, high, count) {
  const rough = (high - low) / count, power = 10 ** Math.floor(Math.log10(rough));
  const step = [1, 2, 5, 10].map((m) => m * power).find((s) => s >= 0.999 * rough);
  const out = [];
  for (let k = Math.ceil(low / step - 1e-9); k <= Math.floor(high / step + 1e-9); k++) {
    out.push(k * step);
  }
  return out;
}

function logTicks(low, high, count) {
  const decades = Math.log10(high / low);
  if (decades < 0.7) return linearTicks(low, high, count);
  const marks = decades < 2.5 ? [1, 2, 5] : [1];
  const stride = Math.max(1, Math.ceil(decades / 8)), out = [];
  for (let p = Math.floor(Math.log10(low)); p <= Math.ceil(Math.log10(high)); p += stride) {
    for (const m of marks) {
      const v = m * 10 ** p;
      if (v >= low * (1 - 1e-9) && v <= high * (1 + 1e-9)) out.push(v);
    }
  }
  return out;
}

// A number with the decimals that a step needs, and a true minus.
function numberText(value, step) {
  if (value === 0 || Math.abs(value) < 1e-9 * step) return '0';
  const size = Math.abs(value);
  const digits = Math.max(0, -Math.floor(Math.log10(step) + 1e-9));
  const places = Math.floor(Math.log10(size) - Math.log10(step) + 1e-9);
  const text = size >= 1e5 || size < 1e-3
    ? value.toExponential(Math.min(Math.max(places, 0), 12)).replace(/(\.\d*?)0*e\+?/, '$1e')
      .replace('.e', 'e').replace('e+', 'e')
    : value.toFixed(Math.min(digits, 12));
  return text.replace(/-/g, '\u2212');
}

// A value under the cursor, with the digits that a pixel resolves.
function reading(value, scale) {
  if (scale.log) return numberText(value, Math.abs(value) / 1000);
  return numberText(value, (scale.high - scale.low) / 2000);
}

// First index with x[index] >= value.
function lowerBound(x, value) {
  let a = 0, b = x.length;
  while (a < b) {
    const middle = (a + b) >> 1;
    if (x[middle] < value) a = middle + 1; else b = middle;
  }
  return a;
}

// The part of a curve in view, with one more point on either side.
function inView(curve, x) {
  if (!curve.sorted) return [0, curve.x.length];
  return [Math.max(lowerBound(curve.x, x.low) - 1, 0),
    Math.min(lowerBound(curve.x, x.high) + 2, curve.x.length)];
}

// Runs of [x, y, high] in pixels, without gaps. If samples lie closer than pixels, each column
// of pixels keeps its first, lowest, highest and last sample: every peak stays at any zoom.
function runs(curve, x, y) {
  const [from, to] = inView(curve, x);
  const crowded = curve.sorted && to - from > 3 * Math.abs(x.stop - x.start);
  const found = [];
  let run = null, group = null;
  const hold = (v) => Math.min(Math.max(v, -1e5), 1e5);
  const push = (px, a, b) => run.push([px, a, b]);
  const flush = () => {
    if (group === null) return;
    if (curve.kind === 'band') {
      push(group.x, group.bottom, group.top);
    } else {
      push(group.x, group.first, group.first);
      if (group.top !== group.bottom) {
        push(group.x, group.bottom, group.bottom);
        push(group.x, group.top, group.top);
      }
      push(group.x, group.last, group.last);
    }
    group = null;
  };
  for (let i = from; i < to; i++) {
    const px = hold(x.at(curve.x[i])), a = hold(y.at(curve.y[i]));
    const b = curve.high ? hold(y.at(curve.high[i])) : a;
    if (!(Number.isFinite(px) && Number.isFinite(a) && Number.isFinite(b))) {
      flush();
      run = null;
      continue;
    }
    if (run === null) found.push(run = []);
    if (!crowded) {
      push(px, a, b);
      continue;
    }
    const place = Math.round(px);
    if (group !== null && group.x === place) {
      // Pixels grow downwards: the bottom edge of a band is the larger number.
      group.bottom = Math.max(group.bottom, a);
      group.top = Math.min(group.top, b);
      group.last = a;
    } else {
      flush();
      group = { x: place, first: a, bottom: a, top: b, last: a };
    }
  }
  flush();
  return found;
}

function drawCurve(pen, curve, x, y, colour) {
  pen.save();
  pen.strokeStyle = pen.fillStyle = colour;
  pen.lineJoin = 'round';
  pen.lineWidth = curve.style.includes('thick') || curve.kind === 'bars' ? 2.2 : 1.2;
  pen.globalAlpha = curve.style.includes('faint') ? 0.55 : 1;
  if (curve.style.includes('dash')) pen.setLineDash(DASH);
  pen.beginPath();
  if (curve.kind === 'markers' || curve.kind === 'bars') {
    for (const run of runs({ ...curve, sorted: false }, x, y)) {
      for (const [px, a, b] of run) {
        if (curve.kind === 'markers') {
          pen.moveTo(px + 4, a);
          pen.arc(px, a, 4, 0, 2 * Math.PI);
        } else {
          for (const [dx, to] of [[-7, a], [-7, b]]) {
            pen.moveTo(px + dx, to);
            pen.lineTo(px - dx, to);
          }
          pen.moveTo(px, a);
          pen.lineTo(px, b);
        }
      }
    }
    if (curve.kind === 'markers') pen.fill(); else pen.stroke();
  } else if (curve.kind === 'band') {
    pen.globalAlpha = 0.22;
    for (const run of runs(curve, x, y)) {
      run.forEach(([px, a], i) => (i ? pen.lineTo(px, a) : pen.moveTo(px, a)));
      run.slice().reverse().forEach(([px, , b]) => pen.lineTo(px, b));
      pen.closePath();
    }
    pen.fill();
  } else {
    for (const run of runs(curve, x, y)) {
      run.forEach(([px, a], i) => {
        if (i && curve.kind === 'steps') pen.lineTo(px, run[i - 1][1]);
        if (i) pen.lineTo(px, a); else pen.moveTo(px, a);
      });
    }
    pen.stroke();
  }
  pen.restore();
}

// Names cut to `room` pixels each; empty if that is too little, as in svg.py.
function placeNames(names, room) {
  const most = Math.floor(room / 7) - 1, longest = Math.max(0, ...names.map((n) => n.length));
  if (most < Math.min(4, longest)) return [];
  return names.map((n) => (n.length <= most ? n : `${n.slice(0, most - 1)}\u2026`));
}

// Grid, ticks and labels around the axes.
function drawAxes(pen, figure, x, y, box, ink) {
  pen.font = FONT;
  pen.lineWidth = 1;
  for (const [scale, count, across] of [[x, box.width > 500 ? 7 : 5, true], [y, 5, false]]) {
    const named = across ? placeNames(figure.names, (box.right - LEFT) / figure.names.length) : [];
    const ticks = named.length ? named.map((_, k) => k + 1) : scale.ticks(count);
    const uneven = ticks.length < 2 || Math.abs(ticks[1] - ticks[0]) === 0;
    let end = -Infinity;
    for (const value of ticks) {
      const even = !uneven && !(scale.log && scale.high / scale.low >= 10 ** 0.7);
      const text = named.length ? named[value - 1]
        : numberText(value, even ? ticks[1] - ticks[0] : Math.abs(value) || 1);
      const p = scale.at(value);
      if (across && !(p >= LEFT - 0.5 && p <= box.right + 0.5)) continue;
      pen.strokeStyle = ink.rule;
      pen.beginPath();
      pen.moveTo(across ? p : LEFT, across ? box.top : p);
      pen.lineTo(across ? p : box.right, across ? box.bottom : p);
      pen.stroke();
      pen.fillStyle = ink.soft;
      pen.textAlign = across ? 'center' : 'right';
      const half = 0.5 * pen.measureText(text).width;
      if (across && p - half < end + 6) continue;
      end = p + half;
      pen.fillText(text, across ? p : LEFT - 6, across ? box.bottom + 16 : p + 4);
    }
  }
  pen.textAlign = 'center';
  pen.fillText(x.axis.label, 0.5 * (LEFT + box.right), box.bottom + BOTTOM - 6);
  pen.save();
  pen.translate(14, 0.5 * (box.top + box.bottom));
  pen.rotate(-Math.PI / 2);
  pen.fillText(y.axis.label, 0, 0);
  pen.restore();
}

function drawFigure(pen, figure, x, y, box, ink) {
  drawAxes(pen, figure, x, y, box, ink);
  pen.save();
  pen.beginPath();
  pen.rect(LEFT, box.top, box.right - LEFT, box.bottom - box.top);
  pen.clip();
  for (const [start, stop, colour, label] of figure.shades) {
    const a = Math.max(x.at(start), LEFT), b = Math.min(x.at(stop), box.right);
    if (!(b >= a)) continue;
    pen.globalAlpha = 0.10;
    pen.fillStyle = ink.series[colour];
    pen.fillRect(a, box.top, Math.max(b - a, 0.5), box.bottom - box.top);
    pen.globalAlpha = 1;
    pen.fillStyle = ink.soft;
    pen.textAlign = 'center';
    if (label && pen.measureText(label).width < b - a - 8) {
      pen.fillText(label, 0.5 * (a + b), box.top + 13);
    }
  }
  // Bands and bars lie behind lines and dots.
  const behind = (curve) => curve.kind === 'band' || curve.kind === 'bars';
  for (const curve of [...figure.curves.filter(behind),
    ...figure.curves.filter((c) => !behind(c))]) {
    if (curve.shown) drawCurve(pen, curve, x, y, ink.series[curve.colour]);
  }
  pen.textAlign = 'left';
  const ends = [];
  for (const [where, label] of [...figure.marks].sort((a, b) => a[0] - b[0])) {
    const p = x.at(where);
    if (!(p >= LEFT && p <= box.right)) continue;
    pen.strokeStyle = ink.ink;
    pen.setLineDash([3, 3]);
    pen.beginPath();
    pen.moveTo(p, box.top);
    pen.lineTo(p, box.bottom);
    pen.stroke();
    // Places of the labels as in svg.py.
    const width = pen.measureText(label).width;
    const start = p + 4 + width <= box.right ? p + 4 : p - 4 - width;
    const free = ends.findIndex((end) => end <= start), row = free < 0 ? ends.length : free;
    ends[row] = start + width + 4;
    pen.setLineDash([]);
    pen.strokeStyle = ink.paper;
    pen.lineWidth = 4;
    pen.strokeText(label, start, box.top + 12 + 15 * row);
    pen.lineWidth = 1;
    pen.fillStyle = ink.soft;
    pen.fillText(label, start, box.top + 12 + 15 * row);
  }
  pen.restore();
}
