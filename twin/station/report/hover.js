for (const plot of document.querySelectorAll('.plot')) {
  const axes = JSON.parse(plot.querySelector('script').textContent), svg = plot.querySelector('svg'),
    out = plot.querySelector('output'), ns = 'http://www.w3.org/2000/svg';
  if (!axes.length) continue;
  const line = svg.appendChild(document.createElementNS(ns, 'line')), dots = svg.appendChild(document.createElementNS(ns, 'g'));
  line.setAttribute('stroke', '#455a64'); line.setAttribute('stroke-width', '.8');
  let active = axes[0], index = -1;
  const pass = v => v, place = (v, [a, b], log) => { const f = log ? Math.log : pass; return (f(v) - f(a)) / (f(b) - f(a)); };
  const nearest = (xs, x) => { let k = 0; xs.forEach((v, i) => { if (Math.abs(v - x) < Math.abs(xs[k] - x)) k = i; }); return k; };
  const hide = () => { line.style.display = dots.style.display = 'none'; out.textContent = ''; };
  const show = (a, x) => {
    const [left, top, w, h] = a.at, reach = .03 * Math.abs(a.x[1] - a.x[0]), rows = [];
    const px = left + w * place(x, a.x, a.log[0]);
    line.style.display = dots.style.display = ''; dots.replaceChildren();
    for (const [k, v] of Object.entries({x1: px, x2: px, y1: top, y2: top + h})) line.setAttribute(k, v);
    for (const s of a.series) {
      const k = nearest(s.x, x);
      if (Math.abs(s.x[k] - x) > reach) continue;
      rows.push(s.label + ': ' + s.y[k]);
      const y = top + h * (1 - place(s.y[k], a.y, a.log[1]));
      if (y < top - 1 || y > top + h + 1) continue;
      const dot = dots.appendChild(document.createElementNS(ns, 'circle'));
      for (const [n, v] of Object.entries({cx: left + w * place(s.x[k], a.x, a.log[0]), cy: y, r: 2.6, fill: '#1c2529'})) dot.setAttribute(n, v);
    }
    out.textContent = rows.length ? a.name + ' ' + Number(x.toPrecision(5)) + '\n' + rows.join('\n') : '';
    const drawn = svg.getBoundingClientRect(), around = plot.getBoundingClientRect();
    const scale = drawn.width / svg.viewBox.baseVal.width, right = px > left + w / 2;
    const at = drawn.left - around.left + px * scale;
    out.style.top = (drawn.top - around.top + top * scale + 6) + 'px';
    out.style.left = right ? 'auto' : (at + 12) + 'px';
    out.style.right = right ? (around.width - at + 12) + 'px' : 'auto';
  };
  svg.addEventListener('pointermove', e => {
    const r = svg.getBoundingClientRect(), v = svg.viewBox.baseVal;
    const x = (e.clientX - r.left) * v.width / r.width, y = (e.clientY - r.top) * v.height / r.height;
    const a = axes.find(({at: [l, t, w, h]}) => x >= l && x <= l + w && y >= t && y <= t + h);
    if (!a) return hide();
    const share = (x - a.at[0]) / a.at[2];
    const at = a.log[0] ? a.x[0] * (a.x[1] / a.x[0]) ** share : a.x[0] + share * (a.x[1] - a.x[0]);
    active = a; index = nearest(a.series[0].x, at); show(a, a.series[0].x[index]);
  });
  svg.addEventListener('pointerleave', hide);
  plot.addEventListener('blur', hide);
  plot.addEventListener('keydown', e => {
    const step = {ArrowRight: 1, ArrowLeft: -1}[e.key], turn = {ArrowDown: 1, ArrowUp: -1}[e.key];
    if (e.key === 'Escape') return hide();
    if (!step && (!turn || axes.length < 2)) return;
    e.preventDefault();
    if (turn) { active = axes[(axes.indexOf(active) + turn + axes.length) % axes.length]; index = 0; }
    const xs = active.series[0].x;
    index = Math.min(xs.length - 1, Math.max(0, index + (step || 0)));
    show(active, xs[index]);
  });
}
