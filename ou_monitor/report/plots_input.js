// Mouse, touch and keyboard input of a plot.

function listen(plot) {
  const { view } = plot;
  const place = (event) => {
    const edge = view.getBoundingClientRect();
    return [event.clientX - edge.left, event.clientY - edge.top];
  };
  view.addEventListener('pointerdown', (event) => {
    const [px, py] = place(event);
    if (event.pointerType === 'touch') {
      plot.touches.set(event.pointerId, px);
      plot.point(px, py);
    } else if (event.button === 0) {
      view.setPointerCapture(event.pointerId);
      plot.drag = { kind: event.shiftKey ? 'pan' : 'select', x0: px, y0: py, x1: px, y1: py };
    }
  });
  view.addEventListener('pointermove', (event) => {
    const [px, py] = place(event);
    if (plot.touches.size === 1 && plot.touches.has(event.pointerId)) {
      plot.touches.set(event.pointerId, px);
    }
    if (plot.touches.size === 2 && plot.touches.has(event.pointerId)) {
      pinch(plot, event.pointerId, px);
    } else if (plot.drag && plot.drag.kind === 'pan') {
      plot.panBy(plot.drag.x1 - px);
      plot.drag.x1 = px;
    } else {
      if (plot.drag) Object.assign(plot.drag, { x1: px, y1: py });
      plot.point(px, py);
    }
  });
  const end = (event) => {
    plot.touches.delete(event.pointerId);
    if (!plot.drag) return;
    if (plot.drag.kind === 'select' && event.type === 'pointerup') plot.release();
    plot.drag = null;
    plot.paintOver();
  };
  view.addEventListener('pointerup', end);
  view.addEventListener('pointercancel', end);
  view.addEventListener('pointerleave', (event) => {
    // Values read by touch stay when the finger is lifted.
    if (!plot.drag && event.pointerType !== 'touch') plot.point(null);
  });
  view.addEventListener('dblclick', () => plot.reset());
  view.addEventListener('blur', () => plot.point(null));
  view.addEventListener('wheel', (event) => {
    // The plain wheel scrolls the page, as everywhere.
    const across = event.shiftKey ? event.deltaX || event.deltaY : event.deltaX;
    if (event.ctrlKey || event.metaKey) {
      event.preventDefault();
      plot.zoomBy(Math.exp(0.002 * Math.max(Math.min(event.deltaY, 200), -200)), place(event)[0]);
    } else if (plot.zoomed() && (event.shiftKey || Math.abs(across) > Math.abs(event.deltaY))) {
      event.preventDefault();
      plot.panBy(across);
    }
  }, { passive: false });
  view.addEventListener('keydown', (event) => press(plot, event));
}

// Zoom with two fingers: the points under both stay there.
function pinch(plot, id, px) {
  const [other] = [...plot.touches].filter(([key]) => key !== id).map(([, p]) => p);
  const before = plot.touches.get(id), span = before - other;
  plot.touches.set(id, px);
  if (Math.abs(px - other) < 10 || Math.abs(span) < 10) return;
  plot.zoomBy(span / (px - other), other);
}

function press(plot, event) {
  if (event.ctrlKey || event.metaKey || event.altKey) return;
  const width = plot.box.right - LEFT;
  const read = plot.cursor === null ? NaN : plot.x.at(plot.cursor);
  const at = read >= LEFT && read <= plot.box.right ? read : LEFT + 0.5 * width;
  const way = { ArrowLeft: -1, ArrowRight: 1 }[event.key];
  if (way && event.shiftKey) plot.panBy(0.1 * way * width);
  else if (way) {
    plot.point(Math.min(Math.max(at + 0.01 * way * width, LEFT), plot.box.right), null, true);
  } else if (event.key === '+' || event.key === '=') plot.zoomBy(0.5, at);
  else if (event.key === '-') plot.zoomBy(2, at);
  else if (event.key === '0' || event.key === 'Escape') plot.reset();
  else return;
  event.preventDefault();
}
