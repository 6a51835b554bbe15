'use strict';
(function () {
  const root = document.getElementById('rates');
  const data = JSON.parse(document.getElementById('rates-data').textContent);
  const NS = root.querySelector('svg').namespaceURI;
  const PAST = 0.6, DEVIATIONS = 1.96, TOP = 1.35 * data.limit;
  const hidden = new Set();
  const one = (id) => root.querySelector('#' + id);
  const points = (list) => list.map((p) => p[0].toFixed(1) + ',' + p[1].toFixed(1)).join(' ');

  function make(parent, tag, attributes) {
    const e = document.createElementNS(NS, tag);
    for (const k in attributes) e.setAttribute(k, attributes[k]);
    parent.appendChild(e);
    return e;
  }

  // One axis over time: what was flown until now, what the tube plans from now on, and the limits.
  function strip(name, axis) {
    const svg = one('rates-' + name), W = Math.max(340, Math.min(900, root.clientWidth - 40)), H = 190;
    const L = 46, R = 10, T = 10, B = 26, AHEAD = 1.1 * data.ahead;
    svg.setAttribute('viewBox', `0 0 ${W} ${H}`);
    const X = (s) => L + (W - L - R) * (s + PAST) / (PAST + AHEAD);
    const Y = (v) => T + (H - T - B) * (TOP - Math.max(-TOP, Math.min(TOP, v))) / (2 * TOP);
    [[data.limit, TOP], [-TOP, -data.limit]].forEach(([low, high]) => {
      make(svg, 'rect', { x: L, y: Y(high), width: W - L - R, height: Y(low) - Y(high), class: 'beyond' });
    });
    [-data.limit, 0, data.limit].forEach((v) => {
      make(svg, 'line', { x1: L, x2: W - R, y1: Y(v), y2: Y(v), class: v === 0 ? 'grid' : 'edge' });
      make(svg, 'text', { x: L - 6, y: Y(v) + 4, 'text-anchor': 'end' }).textContent = String(v).replace('-', '\u2212');
    });
    make(svg, 'line', { x1: X(0), x2: X(0), y1: T, y2: H - B, class: 'now' });
    make(svg, 'text', { x: L, y: H - 8 }).textContent = `${PAST} s ago`;
    make(svg, 'text', { x: X(0) - 4, y: H - 8, 'text-anchor': 'end' }).textContent = 'now';
    make(svg, 'text', { x: W - R, y: H - 8, 'text-anchor': 'end' }).textContent = `+${data.ahead} s`;
    const band = make(svg, 'polygon', { class: 'band' }), plan = make(svg, 'polyline', { class: 'plan' });
    const asked = make(svg, 'polyline', { class: 'wanted' });
    const lines = {};
    data.controllers.forEach((c) => {
      lines[c.name] = make(svg, 'polyline', { class: 'strong ' + c.stroke, style: `stroke: var(--${c.colour})` });
    });
    return function draw(flight, k) {
      const from = Math.max(0, k - Math.round(PAST / data.step));
      const at = (rows, end) => rows.slice(from, Math.min(k, end) + 1)
        .map((v, i) => [X((from + i - k) * data.step), Y(v[axis])]);
      data.controllers.forEach((c) => {
        const run = flight.runs[c.name], show = run && !hidden.has(c.name);
        lines[c.name].setAttribute('points', show ? points(at(run.rates, run.rates.length - 1)) : '');
      });
      const run = hidden.has('tube') ? null : flight.runs.tube, p = run && run.plans[Math.min(k, run.plans.length - 1)];
      asked.setAttribute('points', run ? points(at(run.asked, run.asked.length - 1)) : '');
      const stage = (sign) => p.y.map((y, i) => [
        X((i + 1) * data.stage), Y(y[axis] + sign * DEVIATIONS * p.sigma[i][axis]),
      ]);
      band.setAttribute('points', p ? points([...stage(1), ...stage(-1).reverse()]) : '');
      plan.setAttribute('points', p ? points(stage(0)) : '');
    };
  }

  root.hidden = false;
  const strips = data.axes.map((name, axis) => strip(name, axis));
  const slider = one('rates-time'), button = one('rates-play'), readout = one('rates-readout');
  const choice = one('rates-choice'), pace = one('rates-pace');
  let flight = data.flights[0], now = 0, playing = false, before = 0;
  const last = () => (Math.max(...Object.values(flight.runs).map((r) => r.rates.length)) - 1) * data.step;

  function draw() {
    const k = Math.round(now / data.step);
    strips.forEach((s) => s(flight, k));
    data.controllers.forEach((c) => {
      const run = flight.runs[c.name], said = one('rates-said-' + c.name);
      if (!run || !said) return;
      const most = Math.max(0, ...run.rates.slice(0, k + 1).map((v) => Math.max(...v.map(Math.abs))));
      said.textContent = most > data.limit ? `beyond by ${(most - data.limit).toFixed(2)} rad/s` : '';
    });
    readout.textContent = now.toFixed(2) + ' s of the flight';
    slider.setAttribute('aria-valuetext', readout.textContent);
  }
  function go(t) {
    now = Math.max(0, Math.min(last(), t));
    slider.value = String(now);
    draw();
  }
  function stop() {
    playing = false;
    button.textContent = 'Play';
    button.setAttribute('aria-pressed', 'false');
  }
  function tick(stamp) {
    if (!playing) return;
    const dt = before ? (stamp - before) / 1000 : 0;
    before = stamp;
    go(now + dt * Number(pace.value));
    if (now >= last() - 1e-6) stop(); else requestAnimationFrame(tick);
  }
  function start() {
    if (now >= last() - 1e-6) go(0);
    playing = true;
    before = 0;
    button.textContent = 'Pause';
    button.setAttribute('aria-pressed', 'true');
    requestAnimationFrame(tick);
  }
  button.addEventListener('click', () => (playing ? stop() : start()));
  slider.addEventListener('input', () => { stop(); go(Number(slider.value)); });
  function choose() {
    flight = data.flights[Number(choice.value)];
    slider.max = String(last());
    stop();
    // The still picture: where the tube comes nearest to a limit.
    const rows = (flight.runs.tube || Object.values(flight.runs)[0]).rates.map((v) => Math.max(...v.map(Math.abs)));
    go(rows.indexOf(Math.max(...rows)) * data.step);
  }
  choice.addEventListener('change', choose);
  root.querySelectorAll('input[type=checkbox]').forEach((box) => {
    box.addEventListener('change', () => {
      if (box.checked) hidden.delete(box.value); else hidden.add(box.value);
      draw();
    });
  });
  // Who asked for less motion steps through the flight instead of watching it.
  if (matchMedia('(prefers-reduced-motion: reduce)').matches) {
    button.hidden = true;
    one('rates-still').hidden = false;
  }
  choose();
})();
