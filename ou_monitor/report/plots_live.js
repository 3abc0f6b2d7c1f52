// Interaction with a plot: point, zoom, pan, hide. Every figure keeps its static drawing for print
// and as a fallback.

const NEAR = 12; // maximum distance, pixels, at which the cursor snaps to a sample

function element(kind, name, parent, text) {
  const made = document.createElement(kind);
  made.className = name;
  if (text !== undefined) made.textContent = text; // Never as HTML: names come from recordings.
  parent.append(made);
  return made;
}

// The colours of the page in its current theme.
function inks() {
  const style = getComputedStyle(document.documentElement);
  const read = (name) => style.getPropertyValue(`--${name}`).trim();
  return { ink: read('ink'), soft: read('soft'), rule: read('rule'), paper: read('paper'),
    series: Array.from({ length: 8 }, (_, k) => read(`c${k}`)) };
}

class LivePlot {
  constructor(host, figure) {
    this.figure = figure;
    this.x = new Scale(figure.x);
    this.y = new Scale(figure.y);
    this.group = [this];
    this.cursor = null; // of the x axis, data units
    this.height = null; // height of the pointer, pixels
    this.drag = null;
    this.touches = new Map();
    this.root = element('div', 'live', host);
    host.prepend(this.root);
    const head = element('div', 'live-head', this.root);
    element('strong', 'live-title', head, figure.title);
    this.legend(head);
    const body = element('div', 'live-body', this.root);
    this.view = element('div', 'live-view', body);
    this.back = element('button', 'live-reset', body, 'Show all');
    this.back.type = 'button';
    this.back.hidden = true;
    this.back.addEventListener('click', () => this.reset());
    this.view.style.height = `${figure.height - 22}px`;
    this.view.tabIndex = 0;
    this.view.setAttribute('role', 'application');
    this.view.setAttribute('aria-roledescription', 'plot');
    this.view.setAttribute('aria-label', `${figure.title}. Left and right read values, plus and `
      + 'minus zoom, with shift the arrows move, 0 shows all.');
    this.curves = element('canvas', 'live-curves', this.view);
    this.over = element('canvas', 'live-over', this.view);
    for (const canvas of [this.curves, this.over]) canvas.setAttribute('aria-hidden', 'true');
    this.tip = element('div', 'live-tip', this.view);
    this.tip.setAttribute('role', 'status');
    this.tip.hidden = true;
    const thinned = Math.max(...figure.curves.map((c) => c.every), 1);
    if (thinned > 1) {
      element('div', 'live-note', this.root,
        `An envelope: its points are the lowest and highest of each ${thinned} samples.`);
    }
    listen(this);
    new ResizeObserver(() => this.paint()).observe(this.view);
    host.classList.add('is-live');
  }

  // A button for each name; a curve without a name belongs to the named curve of its colour.
  legend(head) {
    const { curves } = this.figure;
    for (const curve of curves) {
      curve.owner = curve.label ? curve : curves.find((c) => c.label && c.colour === curve.colour);
    }
    for (const curve of curves.filter((c) => c.label)) {
      const button = element('button', 'live-name', head);
      button.type = 'button';
      button.setAttribute('aria-pressed', 'true');
      this.swatch(button, curve);
      element('span', '', button, curve.label);
      button.addEventListener('click', () => {
        const shown = !curve.shown;
        for (const c of curves) if (c.owner === curve) c.shown = shown;
        button.setAttribute('aria-pressed', String(shown));
        this.paint();
      });
    }
  }

  swatch(parent, curve) {
    const made = element('span', `live-swatch ${curve.kind} ${curve.style.join(' ')}`, parent);
    made.style.color = `var(--c${curve.colour})`;
  }

  size(canvas) {
    const ratio = window.devicePixelRatio || 1;
    canvas.width = Math.round(this.box.width * ratio);
    canvas.height = Math.round(this.box.height * ratio);
    const pen = canvas.getContext('2d');
    pen.scale(ratio, ratio);
    return pen;
  }

  paint() {
    const width = this.view.clientWidth, height = this.view.clientHeight;
    if (width < LEFT + RIGHT + 20) return;
    this.box = { width, height, top: TOP, right: width - RIGHT, bottom: height - BOTTOM };
    this.x.pixels(LEFT, this.box.right);
    this.y.pixels(this.box.bottom, TOP);
    drawFigure(this.size(this.curves), this.figure, this.x, this.y, this.box, inks());
    this.back.hidden = !this.zoomed();
    this.view.dataset.x = `${this.x.low} ${this.x.high}`;
    this.view.dataset.y = `${this.y.low} ${this.y.high}`;
    this.paintOver();
  }

  zoomed() {
    return [this.x, this.y].some((s) => s.low !== s.axis.low || s.high !== s.axis.high);
  }

  // Draw the cursor, dots at its values, and the rectangle being dragged.
  paintOver(spoken = false) {
    if (!this.box) return;
    const pen = this.size(this.over), ink = inks(), { top, bottom, right } = this.box;
    if (this.drag && this.drag.kind === 'select') {
      const { left, width, up, height } = this.selected();
      pen.fillStyle = ink.soft;
      pen.globalAlpha = 0.18;
      pen.fillRect(left, up, width, height);
      pen.globalAlpha = 1;
    }
    const at = this.cursor === null ? NaN : this.x.at(this.cursor);
    this.tip.hidden = !(at >= LEFT - 0.5 && at <= right + 0.5);
    if (this.tip.hidden) return;
    const rows = this.figure.curves.filter((c) => c.shown)
      .map((curve) => ({ curve, found: this.look(curve, at) })).filter((row) => row.found);
    const line = rows.length ? rows[0].found.px : at;
    pen.strokeStyle = ink.soft;
    pen.setLineDash([2, 3]);
    pen.beginPath();
    pen.moveTo(line, top);
    pen.lineTo(line, bottom);
    pen.stroke();
    for (const { curve, found } of rows) {
      for (const value of found.values) {
        const py = this.y.at(value);
        if (!(py >= top && py <= bottom)) continue;
        pen.fillStyle = ink.series[curve.colour];
        pen.beginPath();
        pen.arc(found.px, py, 3.5, 0, 2 * Math.PI);
        pen.fill();
      }
    }
    this.fillTip(rows, line, spoken);
  }

  fillTip(rows, line, spoken) {
    const { x, y } = this.figure;
    this.tip.setAttribute('aria-live', spoken ? 'polite' : 'off');
    this.tip.replaceChildren();
    const where = rows.length ? rows[0].found.x : this.cursor;
    const named = this.figure.names[Math.round(where) - 1];
    element('div', 'live-where', this.tip,
      named || `${x.name || 'x'} ${reading(where, this.x)} ${x.unit}`.trim());
    for (const { curve, found } of rows.slice(0, 10)) {
      const row = element('div', '', this.tip);
      this.swatch(row, curve);
      const name = curve.owner && curve.owner !== curve
        ? `${curve.owner.label}${curve.style.includes('dash') ? ', dashed' : ''}`
        : curve.label || y.name;
      const text = found.values.map((v) => reading(v, this.y)).join(' to ');
      const many = found.count > 1 ? ` (${found.count} samples)` : '';
      element('span', '', row, `${name ? `${name}: ` : ''}${text} ${y.unit}`.trim() + many);
    }
    if (rows.length > 10) element('div', 'live-where', this.tip, `and ${rows.length - 10} more`);
    // Beside the cursor, on the side with room.
    const wide = this.tip.offsetWidth, right = line + 12;
    const left = right + wide <= this.box.width ? right : Math.max(line - 12 - wide, 0);
    this.tip.style.left = `${left}px`;
  }

  // The values of a curve at a pixel: all samples in that column, the nearest sample, or the line
  // between two; null beyond its ends and in gaps.
  look(curve, at) {
    if (!curve.sorted || !curve.x.length) return null;
    const n = curve.x.length, value = this.x.value(at);
    const known = (i) => i >= 0 && i < n && Number.isFinite(curve.y[i])
      && (!curve.high || Number.isFinite(curve.high[i])) && Number.isFinite(this.x.at(curve.x[i]));
    const both = (i) => (curve.high ? [curve.y[i], curve.high[i]] : [curve.y[i]]);
    if (curve.kind === 'markers' || curve.kind === 'bars') {
      const i = this.nearest(curve, at, known);
      if (i < 0) return null;
      return { px: this.x.at(curve.x[i]), x: curve.x[i], values: both(i), count: 1 };
    }
    const from = lowerBound(curve.x, this.x.value(at - 0.5));
    const to = lowerBound(curve.x, this.x.value(at + 0.5));
    if (to - from > 3) {
      let low = Infinity, high = -Infinity, count = 0;
      for (let i = from; i < to; i++) {
        if (!known(i)) continue;
        low = Math.min(low, curve.y[i]);
        high = Math.max(high, curve.high ? curve.high[i] : curve.y[i]);
        count += 1;
      }
      if (!count) return null;
      const flat = low === high;
      // The note below the plot tells how many samples a point of an envelope stands for.
      const counted = !flat && curve.kind !== 'steps' && curve.every === 1;
      return { px: at, x: value, values: flat ? [low] : [low, high], count: counted ? count : 1 };
    }
    const k = lowerBound(curve.x, value);
    if (curve.kind === 'steps') {
      const i = k < n && curve.x[k] === value ? k : k - 1;
      return known(i) && (k < n) ? { px: at, x: value, values: both(i), count: 1 } : null;
    }
    const near = [k - 1, k].filter(known)
      .map((i) => ({ i, px: this.x.at(curve.x[i]) }))
      .sort((a, b) => Math.abs(a.px - at) - Math.abs(b.px - at))[0];
    if (near && Math.abs(near.px - at) <= NEAR) {
      return { px: near.px, x: curve.x[near.i], values: both(near.i), count: 1 };
    }
    if (!(known(k - 1) && known(k))) return null;
    const left = this.x.at(curve.x[k - 1]), right = this.x.at(curve.x[k]);
    const share = (at - left) / (right - left || 1), low = both(k - 1), high = both(k);
    const between = low.map((a, i) => this.y.uneven(
      this.y.even(a) + share * (this.y.even(high[i]) - this.y.even(a))));
    return { px: at, x: value, values: between, count: 1 };
  }

  // Index of the marker or bar nearest to the pointer, in height too if that is known.
  nearest(curve, at, known) {
    let best = -1, least = Infinity;
    const end = lowerBound(curve.x, this.x.value(at + NEAR));
    for (let i = lowerBound(curve.x, this.x.value(at - NEAR)); i < end; i++) {
      if (!known(i)) continue;
      const a = this.y.at(curve.y[i]), b = curve.high ? this.y.at(curve.high[i]) : a;
      const up = this.height === null ? 0 : Math.max(b - this.height, this.height - a, 0);
      const far = Math.hypot(this.x.at(curve.x[i]) - at, up);
      if (far < least) [best, least] = [i, far];
    }
    return best;
  }

  // Show the cursor at a pixel in all linked plots; `height` is the height of the pointer, if any.
  point(at, height = null, spoken = false) {
    const inside = at !== null && at >= LEFT - 4 && at <= this.box.right + 4;
    const value = inside ? this.x.value(Math.min(Math.max(at, LEFT), this.box.right)) : null;
    for (const plot of this.group) {
      plot.cursor = value;
      plot.height = plot === this ? height : null;
      plot.paintOver(spoken && plot === this);
    }
  }

  // Show a part of the x axis in all linked plots, at most the whole axis.
  showX(a, b) {
    const whole = new Scale(this.figure.x), full = whole.b - whole.a;
    const width = Math.min(Math.max(b - a, 1e-9 * full), full);
    const start = Math.min(Math.max(0.5 * (a + b - width), whole.a), whole.b - width);
    for (const plot of this.group) {
      if (width >= full) plot.x.set(whole.axis.low, whole.axis.high);
      else plot.x.set(whole.uneven(start), whole.uneven(start + width));
      plot.paint();
    }
  }

  zoomBy(factor, at) {
    const share = (at - LEFT) / (this.box.right - LEFT);
    const middle = this.x.a + share * (this.x.b - this.x.a);
    this.showX(middle - factor * (middle - this.x.a), middle + factor * (this.x.b - middle));
  }

  panBy(pixels) {
    const shift = pixels * (this.x.b - this.x.a) / (this.box.right - LEFT);
    this.showX(this.x.a + shift, this.x.b + shift);
  }

  reset() {
    for (const plot of this.group) plot.y.set(plot.y.axis.low, plot.y.axis.high);
    this.showX(-Infinity, Infinity);
  }

  // The dragged rectangle; along one axis only while the pointer hardly moves along the other.
  selected() {
    const { x0, y0, x1, y1 } = this.drag, { top, bottom, right } = this.box;
    const hold = (v, low, high) => Math.min(Math.max(v, low), high);
    const [a, b] = [hold(x0, LEFT, right), hold(x1, LEFT, right)].sort((p, q) => p - q);
    const [c, d] = [hold(y0, top, bottom), hold(y1, top, bottom)].sort((p, q) => p - q);
    const wide = b - a > 20 || b - a >= d - c, tall = d - c > 20 || d - c > b - a;
    return { left: wide ? a : LEFT, width: wide ? b - a : right - LEFT, up: tall ? c : top,
      height: tall ? d - c : bottom - top, wide, tall, moved: Math.max(b - a, d - c) };
  }

  release() {
    const { left, width, up, height, wide, tall, moved } = this.selected();
    this.drag = null;
    if (moved < 8) {
      this.paintOver();
      return;
    }
    if (tall) this.y.set(this.y.value(up + height), this.y.value(up));
    if (wide) this.showX(this.x.even(this.x.value(left)), this.x.even(this.x.value(left + width)));
    else this.paint();
  }
}

// Link plots with the same x axis (label, kind, and ends within 1 %): they move together.
function link(plots) {
  const groups = [];
  for (const plot of plots) {
    const { x } = plot.figure, slack = 0.01 * (x.high - x.low);
    const group = groups.find(([{ figure }]) => figure.x.label === x.label
      && figure.x.log === x.log && Math.abs(figure.x.low - x.low) <= slack
      && Math.abs(figure.x.high - x.high) <= slack);
    if (group) group.push(plot); else groups.push([plot]);
  }
  for (const group of groups) for (const plot of group) plot.group = group;
}

// Give plots side by side axes of equal size, whatever space their legends need.
function level(pair) {
  const heads = [...pair.querySelectorAll('.live-head')];
  for (const head of heads) head.style.minHeight = '';
  const tallest = Math.max(...heads.map((head) => head.offsetHeight));
  for (const head of heads) head.style.minHeight = `${tallest}px`;
}

async function start() {
  if (!('DecompressionStream' in window && 'ResizeObserver' in window)) return;
  const plots = [];
  for (const data of document.querySelectorAll('script.plot-data')) {
    try {
      const figure = JSON.parse(data.textContent);
      await unpack(figure);
      plots.push(new LivePlot(data.parentElement, figure));
    } catch (error) {
      console.error('A plot stays static:', error);
    }
  }
  if (!plots.length) return;
  link(plots);
  const hint = document.createElement('p');
  hint.className = 'soft live-hint';
  hint.textContent = 'Plots: point to read values, drag to zoom, double click to show all. With '
    + 'Ctrl the wheel zooms, with Shift it moves; two fingers do both. Click a name to hide it. '
    + 'Plots with the same x axis move together.';
  const first = plots[0].root.closest('figure');
  (first.closest('.pair') || first).after(hint);
  for (const pair of document.querySelectorAll('.pair')) {
    new ResizeObserver(() => level(pair)).observe(pair);
  }
  const repaint = () => plots.forEach((plot) => plot.paint());
  window.matchMedia('(prefers-color-scheme: dark)').addEventListener('change', repaint);
  repaint();
  document.documentElement.dataset.plots = String(plots.length);
}

start();
