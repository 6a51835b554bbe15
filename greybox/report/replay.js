'use strict';
// The flight in three dimensions. Solid: what was measured. Ghost: what the model said some time before, from the
// commands alone. Both at the same instant, so that what lies between them is the error of that prediction.
(function () {
  document.querySelectorAll('.replay').forEach((root) => {
    const data = JSON.parse(root.querySelector('script').textContent);
    const canvas = root.querySelector('canvas'), pen = canvas.getContext('2d');
    const [time, ahead] = root.querySelectorAll('input'), [play, wide] = root.querySelectorAll('button');
    const pace = root.querySelector('select'), readout = root.querySelector('output');
    const measured = unpacked(data.measured), predicted = unpacked(data.predicted);
    const POSE = 7, last = (measured.length / POSE - 1) * data.step, length = data.steps * data.step;
    let now = 0, turn = -0.9, lift = 0.45, close = false, playing = false, before = 0;

    // Whole numbers of 16 bit, position and quaternion by their own scales.
    function unpacked(words) {
      const bytes = Uint8Array.from(atob(words), (c) => c.charCodeAt(0)), view = new DataView(bytes.buffer);
      return Float32Array.from({ length: bytes.length / 2 }, (_, i) => {
        const k = i % 7, whole = view.getInt16(2 * i, true);
        return k > 2 ? whole / 32767 : data.middle[k] + data.size * whole / 32767;
      });
    }
    const pose = (from, i) => from.subarray(POSE * i, POSE * (i + 1));
    // A pose between two, the attitude by the shorter way.
    function between(p, q, s) {
      const sign = 0 > p[3] * q[3] + p[4] * q[4] + p[5] * q[5] + p[6] * q[6] ? -1 : 1;
      const out = Array.from(p, (v, i) => (1 - s) * v + s * (i > 2 ? sign : 1) * q[i]);
      const norm = Math.hypot(...out.slice(3)) || 1;
      return out.map((v, i) => (i > 2 ? v / norm : v));
    }
    function sampled(from, count, t, step) {
      const place = Math.max(0, Math.min(count - 1, t / step)), i = Math.min(Math.floor(place), count - 2);
      return between(pose(from, i), pose(from, i + 1), place - i);
    }
    const flown = (t) => sampled(measured, measured.length / POSE, t, data.step);
    // What was said at `start` about the `j`-th step after it, between two origins.
    function said(start, j) {
      const count = data.steps + 1, place = Math.max(0, Math.min(data.origins - 1, start / data.stride));
      const o = Math.min(Math.floor(place), data.origins - 2);
      const of = (k) => sampled(predicted.subarray(POSE * count * k, POSE * count * (k + 1)), count, j, data.step);
      return between(of(o), of(o + 1), place - o);
    }
    function axes(p) {
      const [w, x, y, z] = p.slice(3);
      return [
        [1 - 2 * (y * y + z * z), 2 * (x * y + w * z), 2 * (x * z - w * y)],
        [2 * (x * y - w * z), 1 - 2 * (x * x + z * z), 2 * (y * z + w * x)],
        [2 * (x * z + w * y), 2 * (y * z - w * x), 1 - 2 * (x * x + y * y)],
      ];
    }

    // ---------------------------------------------------------------------------------------------- the drawing

    const low = [0, 1, 2].map((k) => Math.min(...Array.from({ length: measured.length / POSE }, (_, i) => measured[POSE * i + k])));
    const high = [0, 1, 2].map((k) => Math.max(...Array.from({ length: measured.length / POSE }, (_, i) => measured[POSE * i + k])));
    const reach = Math.max(0.5, Math.hypot(...[0, 1, 2].map((k) => high[k] - low[k])));
    function camera(centre, distance) {
      const W = canvas.clientWidth, H = canvas.clientHeight, focus = 1.25 * Math.min(W, 1.6 * H);
      const [ct, st, cl, sl] = [Math.cos(turn), Math.sin(turn), Math.cos(lift), Math.sin(lift)];
      return (p) => {
        const d = [p[0] - centre[0], p[1] - centre[1], p[2] - centre[2]];
        const right = ct * d[0] + st * d[1], deep = -st * d[0] + ct * d[1];
        const far = distance + cl * deep - sl * d[2], up = sl * deep + cl * d[2];
        return far > 0.05 * distance ? [W / 2 + focus * right / far, H / 2 - focus * up / far] : null;
      };
    }
    function line(to, points, colour, width, dash) {
      pen.strokeStyle = colour;
      pen.lineWidth = width;
      pen.setLineDash(dash || []);
      pen.beginPath();
      let down = false;
      points.map(to).forEach((p) => {
        if (!p) { down = false; return; }
        if (down) pen.lineTo(p[0], p[1]); else pen.moveTo(p[0], p[1]);
        down = true;
      });
      pen.stroke();
    }
    function craft(to, p, arm, colour, dash) {
      const [x, y, z] = axes(p);
      const on = (a, b, c) => [0, 1, 2].map((k) => p[k] + a * x[k] + b * y[k] + c * z[k]);
      [[1, 1], [1, -1], [-1, -1], [-1, 1]].forEach(([a, b]) => {
        const [u, v] = [0.7 * arm * a, 0.7 * arm * b];
        line(to, [on(0, 0, 0), on(u, v, 0)], colour, 2, dash);
        const ring = Array.from({ length: 19 }, (_, i) => {
          const s = 2 * Math.PI * i / 18;
          return on(u + 0.5 * arm * Math.cos(s), v + 0.5 * arm * Math.sin(s), 0.12 * arm);
        });
        line(to, ring, colour, a > 0 ? 2.5 : 1.2, dash);
      });
    }
    function draw() {
      const style = getComputedStyle(root), colour = (name) => style.getPropertyValue('--' + name);
      const ratio = devicePixelRatio || 1;
      if (!canvas.clientWidth) return;
      canvas.width = canvas.clientWidth * ratio;
      canvas.height = canvas.clientHeight * ratio;
      pen.setTransform(ratio, 0, 0, ratio, 0, 0);
      const horizon = Math.min(Number(ahead.value), now), start = now - horizon;
      const here = flown(now), ghost = said(start, horizon);
      const centre = close ? here.slice(0, 3) : [0, 1, 2].map((k) => 0.5 * (low[k] + high[k]));
      const distance = close ? Math.max(12 * data.arm, 0.25 * reach) : 1.45 * reach;
      const to = camera(centre, distance), arm = Math.max(data.arm, 0.035 * distance);
      const cell = 10 ** Math.floor(Math.log10(reach)) / (reach > 3 * 10 ** Math.floor(Math.log10(reach)) ? 1 : 2);
      const edge = [0, 1].map((k) => [Math.floor(low[k] / cell) - 1, Math.ceil(high[k] / cell) + 1]);
      for (let i = edge[0][0]; edge[0][1] >= i; i++) {
        line(to, edge[1].map((j) => [i * cell, j * cell, low[2]]), colour('line'), 1);
      }
      for (let j = edge[1][0]; edge[1][1] >= j; j++) {
        line(to, edge[0].map((i) => [i * cell, j * cell, low[2]]), colour('line'), 1);
      }
      const path = (from, until) => {
        const count = Math.max(2, Math.ceil((until - from) / data.step));
        return Array.from({ length: count + 1 }, (_, i) => flown(from + (until - from) * i / count));
      };
      line(to, path(0, last), colour('c4'), 0.8);
      line(to, path(Math.max(0, now - 2), now), colour('ink'), 2);
      line(to, [here, [here[0], here[1], low[2]]], colour('c4'), 1, [2, 3]);
      const count = Math.max(2, Math.ceil(horizon / data.step));
      line(to, Array.from({ length: count + 1 }, (_, i) => said(start, horizon * i / count)), colour('c2'), 2);
      craft(to, here, arm, colour('ink'));
      craft(to, ghost, arm, colour('c2'), [3, 2]);
      pen.fillStyle = colour('muted');
      pen.font = '13px ' + style.getPropertyValue('--sans');
      pen.fillText('grid: ' + Number(cell.toPrecision(2)) + ' m', 10, canvas.clientHeight - 10);
      const apart = Math.hypot(...[0, 1, 2].map((k) => here[k] - ghost[k]));
      const dot = Math.abs([3, 4, 5, 6].reduce((sum, k) => sum + here[k] * ghost[k], 0));
      const angle = 2 * Math.acos(Math.min(1, dot)) * 180 / Math.PI;
      readout.textContent = `${(data.begin + now).toFixed(2)} s: said ${horizon.toFixed(2)} s before, the model is `
        + `${(100 * apart).toFixed(1)} cm and ${angle.toFixed(1)}\u00b0 off`;
      time.setAttribute('aria-valuetext', readout.textContent);
      ahead.setAttribute('aria-valuetext', `${Number(ahead.value).toFixed(2)} s ahead`);
      root.querySelector('.ahead').textContent = `${Number(ahead.value).toFixed(2)} s ahead`;
    }

    // ---------------------------------------------------------------------------------------------- the controls

    function go(t) {
      now = Math.max(0, Math.min(last, t));
      time.value = String(now);
      draw();
    }
    function tick(stamp) {
      if (!playing) return;
      const dt = before ? (stamp - before) / 1000 : 0;
      before = stamp;
      go(now + dt * Number(pace.value));
      if (now >= last) stop(); else requestAnimationFrame(tick);
    }
    function stop() {
      playing = false;
      play.textContent = 'Play';
    }
    play.addEventListener('click', () => {
      if (playing) { stop(); return; }
      if (now >= last) go(0);
      playing = true;
      before = 0;
      play.textContent = 'Pause';
      requestAnimationFrame(tick);
    });
    wide.addEventListener('click', () => {
      close = !close;
      wide.textContent = close ? 'Whole flight' : 'Close up';
      draw();
    });
    time.max = String(last);
    ahead.max = String(length);
    ahead.value = String(Math.min(0.5, length));
    time.addEventListener('input', () => { stop(); go(Number(time.value)); });
    ahead.addEventListener('input', draw);
    let from = null;
    canvas.addEventListener('pointerdown', (e) => { from = [e.clientX, e.clientY]; canvas.setPointerCapture(e.pointerId); });
    canvas.addEventListener('pointermove', (e) => {
      if (!from) return;
      turned(0.008 * (from[0] - e.clientX), 0.006 * (e.clientY - from[1]));
      from = [e.clientX, e.clientY];
    });
    canvas.addEventListener('pointerup', () => { from = null; });
    canvas.addEventListener('keydown', (e) => {
      const way = { ArrowLeft: [0.1, 0], ArrowRight: [-0.1, 0], ArrowUp: [0, 0.1], ArrowDown: [0, -0.1] }[e.key];
      if (!way) return;
      turned(...way);
      e.preventDefault();
    });
    function turned(by, up) {
      turn += by;
      lift = Math.max(0.02, Math.min(1.55, lift + up));
      draw();
    }
    // Who asked for less motion moves the slider.
    if (matchMedia('(prefers-reduced-motion: reduce)').matches) play.hidden = pace.hidden = true;
    matchMedia('(prefers-color-scheme: dark)').addEventListener('change', draw);
    root.hidden = false;
    new ResizeObserver(draw).observe(canvas);
    go(0.4 * last);
  });
})();
