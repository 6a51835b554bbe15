'use strict';
(function () {
  const root = document.getElementById('flight');
  const data = JSON.parse(document.getElementById('flight-data').textContent);
  const NS = root.querySelector('svg').namespaceURI;
  const AXES = { x: 0, y: 1, z: 2 };
  const STEP = data.step;              // s between samples of a path
  const TRAIL = 1.2;                   // s of path that stays strong behind a vehicle
  const CIRCLE = Array.from({ length: 25 }, (_, i) => [Math.cos(i * Math.PI / 12), Math.sin(i * Math.PI / 12)]);
  const WIDTH95 = 2.448;               // 95 % of a plane normal distribution lies within so many deviations

  function make(parent, tag, attributes) {
    const e = document.createElementNS(NS, tag);
    for (const k in attributes) e.setAttribute(k, attributes[k]);
    parent.appendChild(e);
    return e;
  }
  const one = (id) => root.querySelector('#' + id);
  const points = (list) => list.map((p) => p[0].toFixed(4) + ',' + p[1].toFixed(4)).join(' ');
  const hidden = new Set();
  // The tube is drawn over the others.
  const order = [...data.controllers.filter((c) => c.name !== 'tube'), ...data.controllers.filter((c) => c.name === 'tube')];

  // ---------------------------------------------------------------------------------------------- geometry

  // The piece of a line n.p = o inside a box of the two shown axes, or null where the plane is not seen edge on.
  function edge(plane, axes, box) {
    const [a, b] = axes, n = plane.normal;
    const third = [0, 1, 2].find((k) => !axes.includes(k));
    if (Math.abs(n[third]) > 0.2) return null;
    const limit = axes.map((k, i) => {
      const own = plane.where['xyz'[k]] || [-1e3, 1e3];
      return [Math.max(box[i][0], own[0]), Math.min(box[i][1], own[1])];
    });
    const along = Math.abs(n[a]) > Math.abs(n[b]) ? 1 : 0;   // the line runs along this shown axis
    const [from, to] = limit[along];
    if (from >= to) return null;
    const at = (s) => {
      const other = (plane.offset - n[axes[along]] * s) / n[axes[1 - along]];
      return along === 0 ? [s, other] : [other, s];
    };
    return [at(from), at(to)];
  }

  function exists(plane, place, reach) {
    return Object.entries(plane.where).every(([k, v]) => place[AXES[k]] >= v[0] - reach && v[1] + reach >= place[AXES[k]]);
  }

  const bounds = [0, 1, 2].map((k) => {
    const v = data.course.path.map((p) => p[k]);
    return [Math.min(...v), Math.max(...v)];
  });

  // ---------------------------------------------------------------------------------------------- a view

  function view(id, axes, follow) {
    const svg = one(id), W = 440, H = axes[1] === 2 ? 210 : 330;
    svg.setAttribute('viewBox', `0 0 ${W} ${H}`);
    const span = follow
      ? [0.9, 0.9 * H / W]
      : axes.map((k) => bounds[k][1] - bounds[k][0] + (k === 2 ? 0.7 : 1.0));
    const scale = Math.min(W / span[0], H / span[1]);
    const middle = axes.map((k) => 0.5 * (bounds[k][0] + bounds[k][1]));
    const world = make(svg, 'g', {});
    const still = make(world, 'g', {}), moving = make(world, 'g', {});
    const marks = make(svg, 'g', {});
    const box = axes.map((k) => [bounds[k][0] - 9, bounds[k][1] + 9]);
    const edges = data.course.planes.map((p) => {
      const line = edge(p, axes, box);
      if (!line) return null;
      const n = [p.normal[axes[0]], p.normal[axes[1]]], deep = follow ? 0.035 : 0.1;
      const band = [...line, ...line.slice().reverse().map((q) => [q[0] + deep * n[0], q[1] + deep * n[1]])];
      const g = make(still, 'g', { class: 'plane' });
      make(g, 'polygon', { points: points(band), class: 'beyond' });
      make(g, 'polyline', { points: points(line), class: 'edge' });
      return { plane: p, g };
    });
    make(still, 'polyline', { points: points(data.course.path.map((p) => [p[axes[0]], p[axes[1]]])), class: 'wanted' });
    const faint = {}, strong = {}, dots = {};
    order.forEach((c) => {
      faint[c.name] = make(moving, 'polyline', { class: 'faint', style: `stroke: var(--${c.colour})` });
      strong[c.name] = make(moving, 'polyline', { class: 'strong ' + c.stroke, style: `stroke: var(--${c.colour})` });
    });
    const tube = make(moving, 'g', { class: 'tube' });
    const links = Array.from({ length: data.stages - 1 }, () => make(tube, 'polygon', { class: 'link' }));
    const ellipses = Array.from({ length: data.stages }, () => make(tube, 'polygon', {}));
    const plan = make(tube, 'polyline', { class: 'plan' });
    order.forEach((c) => {
      dots[c.name] = make(marks, 'circle', { r: c.name === 'tube' ? 5 : 4, class: 'dot', style: `fill: var(--${c.colour})` });
    });
    const crosses = make(marks, 'g', {});
    let bar = null;
    if (follow) {
      const length = scale * 0.1;
      bar = make(svg, 'g', { class: 'bar10' });
      make(bar, 'line', { x1: 12, x2: 12 + length, y1: H - 14, y2: H - 14 });
      make(bar, 'text', { x: 18 + length, y: H - 10 }).textContent = '10 cm';
    }
    const place = (p, centre) => [
      W / 2 + scale * (p[axes[0]] - centre[0]), H / 2 - scale * (p[axes[1]] - centre[1]),
    ];
    return function draw(flight, k, now, centre3, present) {
      const centre = follow ? axes.map((a) => centre3[a]) : middle;
      world.setAttribute('transform',
        `translate(${W / 2} ${H / 2}) scale(${scale} ${-scale}) translate(${-centre[0]} ${-centre[1]})`);
      edges.forEach((e) => {
        if (e) e.g.setAttribute('opacity', exists(e.plane, present, 0.3) ? 1 : 0.25);
      });
      data.controllers.forEach((c) => {
        const run = flight.runs[c.name];
        const show = run && !hidden.has(c.name);
        faint[c.name].style.display = strong[c.name].style.display = dots[c.name].style.display = show ? '' : 'none';
        if (!show) return;
        const end = Math.min(k, run.path.length - 1);
        const flat = (p) => [p[axes[0]], p[axes[1]]];
        faint[c.name].setAttribute('points', points(run.path.slice(0, end + 1).map(flat)));
        const from = Math.max(0, end - Math.round(TRAIL / STEP));
        strong[c.name].setAttribute('points', points(run.path.slice(from, end + 1).map(flat)));
        const at = place(run.path[end], centre);
        dots[c.name].setAttribute('cx', at[0].toFixed(1));
        dots[c.name].setAttribute('cy', at[1].toFixed(1));
      });
      const p = hidden.has('tube') ? null : planAt(flight, now);
      tube.style.display = p ? '' : 'none';
      if (p) {
        plan.setAttribute('points', points(p.place.map((q) => [q[axes[0]], q[axes[1]]])));
        const rings = p.place.map((q, i) => ellipse(q, p.spread[i], axes));
        rings.forEach((ring, i) => ellipses[i].setAttribute('points', points(ring)));
        links.forEach((link, i) => link.setAttribute('points', points(hull([...rings[i], ...rings[i + 1]]))));
      }
      while (crosses.firstChild) crosses.removeChild(crosses.firstChild);
      data.controllers.forEach((c) => {
        const run = flight.runs[c.name];
        if (!run || hidden.has(c.name)) return;
        run.crossings.forEach((x) => {
          if (x.time > now) return;
          const plane = data.course.planes.find((q) => q.name === x.plane);
          if (!edge(plane, axes, box)) return;
          const at = place(run.path[Math.min(Math.round(x.time / STEP), run.path.length - 1)], centre);
          const g = make(crosses, 'g', { class: 'cross', style: `stroke: var(--${c.colour})` });
          make(g, 'path', { d: `M${at[0] - 5} ${at[1] - 5}l10 10m0 -10l-10 10` });
          make(g, 'title', {}).textContent = `${c.text}: ${(100 * x.depth).toFixed(1)} cm beyond ${x.plane}`;
        });
      });
    };
  }

  function ellipse(centre, s, axes) {
    const at = (i, j) => s[[[0, 1, 2], [1, 3, 4], [2, 4, 5]][i][j]];
    const a = Math.sqrt(Math.max(at(axes[0], axes[0]), 1e-12)), b = at(axes[0], axes[1]) / a;
    const c = Math.sqrt(Math.max(at(axes[1], axes[1]) - b * b, 0));
    return CIRCLE.map((v) => [
      centre[axes[0]] + WIDTH95 * a * v[0], centre[axes[1]] + WIDTH95 * (b * v[0] + c * v[1]),
    ]);
  }

  // Convex hull of points, counter-clockwise (Andrew's monotone chain).
  function hull(list) {
    const sorted = list.slice().sort((p, q) => p[0] - q[0] || p[1] - q[1]);
    const half = (seq) => {
      const out = [];
      const left = (a, b, c) => (b[0] - a[0]) * (c[1] - a[1]) - (b[1] - a[1]) * (c[0] - a[0]);
      seq.forEach((p) => {
        while (out.length > 1 && 0 >= left(out[out.length - 2], out[out.length - 1], p)) out.pop();
        out.push(p);
      });
      return out.slice(0, -1);
    };
    return [...half(sorted), ...half(sorted.slice().reverse())];
  }

  function planAt(flight, now) {
    let found = null;
    for (const p of flight.plans) {
      if (p.time > now + 1e-6) break;
      found = p;
    }
    return found;
  }

  // ---------------------------------------------------------------------------------------------- distance over time

  function strip(id) {
    const svg = one(id), W = Math.max(340, Math.min(900, root.clientWidth)), H = 230, L = 46, R = 10, T = 12, B = 30;
    const PAST = 2.0, AHEAD = data.ahead * 1.1, LOW = -5, HIGH = 15;
    svg.setAttribute('viewBox', `0 0 ${W} ${H}`);
    const X = (s) => L + (W - L - R) * (s + PAST) / (PAST + AHEAD);
    const Y = (cm) => T + (H - T - B) * (HIGH - Math.max(LOW, Math.min(HIGH, cm))) / (HIGH - LOW);
    make(svg, 'rect', { x: L, y: Y(0), width: W - L - R, height: Y(LOW) - Y(0), class: 'beyond' });
    for (let cm = LOW; HIGH >= cm; cm += 5) {
      make(svg, 'line', { x1: L, x2: W - R, y1: Y(cm), y2: Y(cm), class: cm === 0 ? 'edge' : 'grid' });
      make(svg, 'text', { x: L - 6, y: Y(cm) + 4, 'text-anchor': 'end' }).textContent = String(cm).replace('-', '\u2212');
    }
    make(svg, 'line', { x1: X(0), x2: X(0), y1: T, y2: H - B, class: 'now' });
    [[-2, '2 s ago'], [-1, '1 s ago'], [0, 'now']].forEach(([s, text]) => {
      make(svg, 'text', { x: X(s), y: H - 10, 'text-anchor': s === -2 ? 'start' : 'middle' }).textContent = text;
    });
    make(svg, 'text', { x: W - R, y: H - 10, 'text-anchor': 'end' }).textContent = `planned, ${data.ahead.toFixed(1)} s`;
    make(svg, 'text', { x: L + 6, y: Y(LOW) - 6, class: 'beyond-text' }).textContent = 'beyond the limit';
    const band = make(svg, 'polygon', { class: 'band' }), plan = make(svg, 'polyline', { class: 'plan' });
    const lines = {};
    order.forEach((c) => {
      lines[c.name] = make(svg, 'path', { class: 'strong ' + c.stroke, style: `stroke: var(--${c.colour})` });
    });
    return function draw(flight, k, now) {
      data.controllers.forEach((c) => {
        const run = flight.runs[c.name];
        let d = '', pen = false;
        if (run && !hidden.has(c.name)) {
          for (let i = Math.max(0, k - Math.round(PAST / STEP)); Math.min(k, run.near.length - 1) >= i; i++) {
            const v = run.near[i];
            if (v === null || v > 0.2) { pen = false; continue; }
            d += (pen ? 'L' : 'M') + X(i * STEP - now).toFixed(1) + ' ' + Y(100 * v).toFixed(1);
            pen = true;
          }
        }
        lines[c.name].setAttribute('d', d);
      });
      const p = hidden.has('tube') ? null : planAt(flight, now), above = [], below = [], mid = [];
      if (p) {
        p.left.forEach((v, i) => {
          if (v === null || v > 0.5) return;
          const x = X(p.time + data.times[i] - now);
          above.push([x, Y(100 * (v + p.backoff[i]))]);
          below.push([x, Y(100 * (v - p.backoff[i]))]);
          mid.push([x, Y(100 * v)]);
        });
      }
      band.setAttribute('points', points([...above, ...below.reverse()]));
      plan.setAttribute('points', points(mid));
    };
  }

  // ---------------------------------------------------------------------------------------------- the clock

  const views = [
    view('above', [0, 1], false), view('above-close', [0, 1], true),
    view('side', [0, 2], false), view('side-close', [0, 2], true),
  ];
  root.hidden = false;
  const distance = strip('distance');
  const slider = one('flight-time'), button = one('flight-play'), readout = one('flight-readout');
  const choice = one('flight-choice'), pace = one('flight-pace');
  let flight = data.flights[0], now = 0, playing = false, before = 0;
  const last = () => Math.max(...Object.values(flight.runs).map((r) => r.path.length - 1)) * STEP;

  function draw() {
    const k = Math.round(now / STEP);
    const lead = flight.runs.tube || Object.values(flight.runs)[0];
    const centre = lead.path[Math.min(k, lead.path.length - 1)];
    const wanted = data.course.path[Math.min(Math.round(now / data.course.step), data.course.path.length - 1)];
    views.forEach((v) => v(flight, k, now, centre, wanted));
    distance(flight, k, now);
    const near = lead.near[Math.min(k, lead.near.length - 1)];
    const far = near === null ? 'no limit near' : near > 0.2 ? 'limits more than 20 cm away'
      : (100 * Math.abs(near)).toFixed(1) + (near > 0 ? ' cm from the nearest limit' : ' cm beyond a limit');
    readout.textContent = now.toFixed(2) + ' s: tube ' + far;
    slider.setAttribute('aria-valuetext', readout.textContent);
    data.controllers.forEach((c) => {
      const run = flight.runs[c.name], said = one('said-' + c.name);
      if (!said) return;
      if (!run) { said.textContent = 'not flown'; return; }
      const past = run.crossings.filter((x) => now >= x.time);
      const parts = past.map((x) => `${x.plane} by ${(100 * x.depth).toFixed(1)} cm`);
      const texts = parts.length ? ['beyond ' + parts.join(', ')] : [];
      if (run.crashed && now >= (run.path.length - 1) * STEP - 1e-6) texts.push('crashed');
      said.textContent = texts.join('; ');
    });
  }
  function go(t) {
    now = Math.max(0, Math.min(last(), t));
    slider.value = String(now);
    draw();
  }
  function tick(stamp) {
    if (!playing) return;
    const dt = before ? (stamp - before) / 1000 : 0;
    before = stamp;
    go(now + dt * Number(pace.value));
    if (now >= last() - 1e-6) stop(); else requestAnimationFrame(tick);
  }
  function stop() {
    playing = false;
    button.textContent = 'Play';
    button.setAttribute('aria-pressed', 'false');
  }
  function start() {
    if (now >= last() - 1e-6 || fresh) go(0);
    fresh = false;
    playing = true;
    before = 0;
    button.textContent = 'Pause';
    button.setAttribute('aria-pressed', 'true');
    requestAnimationFrame(tick);
  }
  // The still picture before the first play: where a controller is deepest beyond a limit, or the tube nearest to one.
  function telling() {
    let at = 0, least = Infinity;
    const plain = flight.runs[data.plain] || Object.values(flight.runs)[0];
    plain.near.forEach((v, i) => {
      if (v === null) return;
      if (least > v) { least = v; at = i; }
    });
    return Math.max(0, at * STEP - 0.1);
  }
  let fresh = true;
  button.addEventListener('click', () => (playing ? stop() : start()));
  slider.addEventListener('input', () => { stop(); fresh = false; go(Number(slider.value)); });
  function choose() {
    flight = data.flights[Number(choice.value)];
    slider.max = String(last());
    stop();
    fresh = true;
    go(telling());
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
    one('flight-still').hidden = false;
  }
  choose();
})();
