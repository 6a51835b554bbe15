'use strict';
// Zoom, cursor and linked axes for the curves of a page. The drawing is complete without this program: it reads the
// curves back from their paths when somebody first points at a figure, and redraws them for the chosen range.
(function () {
  const plots = [...document.querySelectorAll('svg[data-axes]')].map(plot);
  if (!plots.length) return;
  const axes = plots.flatMap((p) => p.axes);
  const said = document.createElement('output');
  said.className = 'said';
  document.body.appendChild(said);
  const hint = document.createElement('p');
  hint.className = 'caption hint';
  hint.textContent = 'Curves: drag to zoom, double click for the whole. Keys: arrows, shift and arrows, +, \u2212, 0.';
  plots[0].svg.closest('figure').appendChild(hint);

  function plot(svg) {
    const groups = [...svg.querySelectorAll('.axes')];
    const group = svg.closest('details') || svg.closest('figure');
    const p = { svg, group };
    p.axes = JSON.parse(svg.dataset.axes).map((a, i) => ({
      ...a, svg, group, g: groups[i], view: { x: a.x, y: a.y }, curves: null, own: null,
    }));
    svg.setAttribute('tabindex', '0');
    svg.addEventListener('pointermove', (e) => point(p, e));
    svg.addEventListener('pointerleave', () => hide(group));
    svg.addEventListener('pointerdown', (e) => press(p, e));
    svg.addEventListener('dragstart', (e) => e.preventDefault());  // of marked text
    svg.addEventListener('dblclick', () => zoom(p.axes[0], p.axes[0].x));
    svg.addEventListener('keydown', (e) => key(p, e));
    svg.addEventListener('blur', () => hide(group));
    return p;
  }
  function make(parent, tag, attributes) {
    const e = document.createElementNS(parent.namespaceURI, tag);
    for (const k in attributes) e.setAttribute(k, attributes[k]);
    parent.appendChild(e);
    return e;
  }

  // ------------------------------------------------------------------------------------------------ scales

  // What is linear on the drawing: the value, or its logarithm.
  const flat = (log, v) => (log ? Math.log10(v) : v);
  const round = (log, v) => (log ? 10 ** v : v);
  const share = (log, range, v) => (flat(log, v) - flat(log, range[0])) / (flat(log, range[1]) - flat(log, range[0]));
  const at = (log, range, s) => round(log, flat(log, range[0]) + s * (flat(log, range[1]) - flat(log, range[0])));
  const toX = (a, v) => a.box[0] + (a.box[2] - a.box[0]) * share(a.logx, a.view.x, v);
  const toY = (a, v) => a.box[3] - (a.box[3] - a.box[1]) * share(a.logy, a.view.y, v);

  function ticks(log, range, wanted) {
    const out = [];
    if (log && range[1] > 3 * range[0]) {
      for (let k = Math.floor(Math.log10(range[0])); 10 ** k <= range[1]; k++) {
        [1, 2, 5].forEach((m) => out.push(Number((m * 10 ** k).toPrecision(2))));
      }
    } else {
      const raw = (range[1] - range[0]) / wanted, power = 10 ** Math.floor(Math.log10(raw));
      const step = [1, 2, 5, 10].find((m) => m * power >= raw) * power;
      for (let k = Math.ceil(range[0] / step); k * step <= range[1]; k++) out.push(k * step);
    }
    return out.filter((v) => v >= range[0] && range[1] >= v);
  }
  const text = (v, digits) => String(Number(v.toPrecision(digits))).replace('-', '\u2212');

  // ------------------------------------------------------------------------------------------------ curves

  // The curves of an axes as values, read from the first drawing; NaN breaks a line.
  function curves(a) {
    if (a.curves) return a.curves;
    a.curves = [...a.g.querySelectorAll(':scope > .curve > path')].map((path) => {
      const words = path.getAttribute('d').split(' '), x = [], y = [];
      for (let i = 0; words.length > i; i += 3) {
        if (words[i] === 'M' && x.length) { x.push(NaN); y.push(NaN); }
        x.push(at(a.logx, a.x, (Number(words[i + 1]) - a.box[0]) / (a.box[2] - a.box[0])));
        y.push(at(a.logy, a.y, (a.box[3] - Number(words[i + 2])) / (a.box[3] - a.box[1])));
      }
      return { path, drawn: path.getAttribute('d'), x, y, colour: path.style.stroke };
    });
    return a.curves;
  }
  // A curve at x, NaN where it has a gap.
  function value(a, c, x) {
    for (let i = 1; c.x.length > i; i++) {
      if (x >= c.x[i - 1] && c.x[i] >= x) {
        const s = c.x[i] === c.x[i - 1] ? 0 : share(a.logx, [c.x[i - 1], c.x[i]], x);
        return at(a.logy, [c.y[i - 1], c.y[i]], s);
      }
    }
    return NaN;
  }

  // (factor, shift) from a place on the whole drawing to one on the drawing of a range.
  function moved(log, full, range, from, to) {
    const low = share(log, full, range[0]), factor = 1 / (share(log, full, range[1]) - low);
    return [factor, from - factor * (from + low * (to - from))];
  }

  function draw(a) {
    const whole = a.view.x === a.x;
    a.g.querySelectorAll('.tx, .ty').forEach((t) => { t.style.display = whole ? '' : 'none'; });
    if (a.own) a.own.remove();
    a.own = null;
    curves(a).forEach((c) => {
      if (whole) { c.path.setAttribute('d', c.drawn); return; }
      let d = '', pen = false;
      c.x.forEach((x, i) => {
        if (!(Number.isFinite(x) && Number.isFinite(c.y[i]))) { pen = false; return; }
        d += (pen ? 'L' : 'M') + toX(a, x).toFixed(2) + ' ' + toY(a, c.y[i]).toFixed(2);
        pen = true;
      });
      c.path.setAttribute('d', d || 'M0 0');
    });
    // What is no curve moves with the drawing: a band as a whole, a marker by its place.
    const [sx, dx] = moved(a.logx, a.x, a.view.x, a.box[0], a.box[2]), [sy, dy] = moved(a.logy, a.y, a.view.y, a.box[3], a.box[1]);
    a.g.querySelectorAll(':scope > .band path').forEach((b) => {
      b.drawn = b.drawn || b.getAttribute('d');
      let i = 0;
      b.setAttribute('d', b.drawn.replace(/-?[\d.]+/g, (n) => (i++ % 2 ? sy * n + dy : sx * n + dx).toFixed(2)));
    });
    a.g.querySelectorAll(':scope > .curve > g use').forEach((u) => {
      u.first = u.first || [Number(u.getAttribute('x')), Number(u.getAttribute('y'))];
      u.setAttribute('x', sx * u.first[0] + dx);
      u.setAttribute('y', sy * u.first[1] + dy);
    });
    if (whole) return;
    a.own = make(a.g, 'g', { class: 'own' });
    a.g.insertBefore(a.own, a.g.firstChild);
    const [l, t, r, b] = a.box, named = a.g.querySelector('.tx text');
    ticks(a.logx, a.view.x, 6).forEach((v) => {
      make(a.own, 'line', { x1: toX(a, v), x2: toX(a, v), y1: t, y2: b });
      if (named) make(a.own, 'text', { x: toX(a, v), y: b + 11, 'text-anchor': 'middle' }).textContent = text(v, 6);
    });
    ticks(a.logy, a.view.y, 4).forEach((v) => {
      make(a.own, 'line', { x1: l, x2: r, y1: toY(a, v), y2: toY(a, v) });
      make(a.own, 'text', { x: l - 5, y: toY(a, v) + 3, 'text-anchor': 'end' }).textContent = text(v, 4);
    });
  }

  // ------------------------------------------------------------------------------------------------ range

  const same = (p, q) => p[0] === q[0] && p[1] === q[1];
  // Axes that show the same stretch of the same quantity move together.
  const linked = (a) => axes.filter((b) => b.svg === a.svg || (b.group === a.group && b.title === a.title && same(b.x, a.x)));

  function zoom(a, range) {
    let [low, high] = range;
    const full = flat(a.logx, a.x[1]) - flat(a.logx, a.x[0]);
    low = Math.max(a.x[0], low);
    high = Math.min(a.x[1], high);
    if (!(flat(a.logx, high) - flat(a.logx, low) > 1e-3 * full)) return;
    const whole = low === a.x[0] && high === a.x[1];
    linked(a).forEach((b) => {
      b.view = { x: whole ? b.x : [low, high], y: b.y };
      if (!whole) b.view.y = fitted(b);
      draw(b);
    });
    hide(a.group);
  }
  // The range of y that the curves need, with a margin.
  function fitted(a) {
    let low = Infinity, high = -Infinity;
    curves(a).forEach((c) => c.x.forEach((x, i) => {
      if (x >= a.view.x[0] && a.view.x[1] >= x && Number.isFinite(c.y[i])) {
        low = Math.min(low, flat(a.logy, c.y[i]));
        high = Math.max(high, flat(a.logy, c.y[i]));
      }
    }));
    if (!(high > low)) return a.y;
    const more = 0.06 * (high - low);
    return [round(a.logy, low - more), round(a.logy, high + more)];
  }
  function scaled(a, centre, factor) {
    const s = share(a.logx, a.view.x, centre);
    zoom(a, [at(a.logx, a.view.x, s - s * factor), at(a.logx, a.view.x, s + (1 - s) * factor)]);
  }

  // ------------------------------------------------------------------------------------------------ cursor

  function hide(group) {
    axes.filter((a) => a.group === group && a.cursor).forEach((a) => { a.cursor.remove(); a.cursor = null; });
  }
  function show(a, x) {
    const lines = [];
    axes.filter((b) => b.group === a.group && b.title === a.title).forEach((b) => {
      if (b.cursor) b.cursor.remove();
      b.cursor = null;
      b.now = x;
      if (b.view.x[0] > x || x > b.view.x[1] || !b.svg.checkVisibility()) return;
      b.cursor = make(b.g, 'g', { class: 'cursor' });
      const [, top, right, bottom] = b.box;
      make(b.cursor, 'line', { x1: toX(b, x), x2: toX(b, x), y1: top, y2: bottom });
      const read = make(b.cursor, 'text', { x: right, y: top - 2, 'text-anchor': 'end' });
      const values = curves(b).map((c) => [c, value(b, c, x)]).filter((v) => Number.isFinite(v[1]));
      values.forEach(([c, v], i) => {
        make(read, 'tspan', { style: 'fill: ' + c.colour, dx: i ? 5 : 0 }).textContent = text(v, 3);
      });
      if (b.svg === a.svg) lines.push(b.name + ': ' + values.map((v) => text(v[1], 3)).join(', '));
    });
    return a.title + ' ' + text(x, 5) + '; ' + lines.join('; ');
  }
  function place(p, e) {
    const m = p.svg.getScreenCTM().inverse();
    const x = m.a * e.clientX + m.e, y = m.d * e.clientY + m.f;
    const a = p.axes.find((b) => y >= b.box[1] - 6 && b.box[3] + 6 >= y);
    return a && x >= a.box[0] && a.box[2] >= x ? { a, px: x, x: at(a.logx, a.view.x, (x - a.box[0]) / (a.box[2] - a.box[0])) } : null;
  }
  function point(p, e) {
    const found = place(p, e);
    if (!found) { hide(p.group); return; }
    show(found.a, found.x);
    if (p.from) {
      const [l, r] = [p.from.px, found.px].sort((u, v) => u - v);
      p.mark.setAttribute('x', l);
      p.mark.setAttribute('width', r - l);
    }
  }
  function press(p, e) {
    const found = place(p, e);
    if (!found || e.button) return;
    p.from = found;
    const box = found.a.box;
    p.mark = make(p.svg, 'rect', { class: 'mark', x: found.px, y: box[1], width: 0, height: box[3] - box[1] });
    const done = (up) => {
      const end = place(p, up), from = p.from;
      p.mark.remove();
      p.from = null;
      removeEventListener('pointerup', done);
      removeEventListener('pointercancel', done);
      if (up.type === 'pointerup' && end && Math.abs(end.px - from.px) > 4) {
        zoom(from.a, [from.x, end.x].sort((u, v) => u - v));
      }
    };
    addEventListener('pointerup', done);
    addEventListener('pointercancel', done);
  }
  function key(p, e) {
    const a = p.axes[0], inside = a.now >= a.view.x[0] && a.view.x[1] >= a.now;
    const now = inside ? a.now : at(a.logx, a.view.x, 0.5), s = share(a.logx, a.view.x, now);
    const way = { ArrowLeft: -1, ArrowRight: 1 }[e.key];
    if (way && e.shiftKey) {
      const room = way > 0 ? share(a.logx, a.view.x, a.x[1]) - 1 : -share(a.logx, a.view.x, a.x[0]);
      const by = way * Math.min(0.1, room);
      if (room > 0) zoom(a, [at(a.logx, a.view.x, by), at(a.logx, a.view.x, 1 + by)]);
    } else if (way) {
      said.textContent = show(a, at(a.logx, a.view.x, Math.max(0, Math.min(1, s + 0.01 * way))));
    } else if (e.key === '+' || e.key === '=') {
      scaled(a, now, 0.5);
    } else if (e.key === '-') {
      scaled(a, now, 2);
    } else if (e.key === '0' || e.key === 'Escape') {
      zoom(a, a.x);
    } else {
      return;
    }
    e.preventDefault();
  }
})();
