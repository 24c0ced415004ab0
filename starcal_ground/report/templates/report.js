'use strict';
// Paper has no folds.
addEventListener('beforeprint', () => {
  for (const fold of document.querySelectorAll('details')) fold.open = true;
});
// Draws the stars of one image and their enlarged residuals.
(() => {
  const box = document.getElementById('one-image');
  if (!box) return;
  const data = JSON.parse(document.getElementById('images-data').textContent);
  const svg = box.querySelector('svg');
  const [which, enlarge] = box.querySelectorAll('input');
  const output = box.querySelector('output');
  const NS = 'http://www.w3.org/2000/svg';
  const unit = data.width / 1000;
  const add = (name, attributes, parent) => {
    const node = document.createElementNS(NS, name);
    for (const [key, value] of Object.entries(attributes)) node.setAttribute(key, value);
    parent.appendChild(node);
    return node;
  };
  const write = (x, y, text, anchor) => {
    add('text', { x, y, 'text-anchor': anchor, 'font-size': 18 * unit, fill: 'var(--muted)' }, svg).textContent = text;
  };
  const step = [50, 100, 200, 500, 1000, 2000].find((size) => data.width <= 8 * size) || 5000;
  const frame = () => {
    add('rect', {
      x: -0.5, y: -0.5, width: data.width, height: data.height, fill: 'none',
      stroke: 'var(--muted)', 'stroke-width': unit,
    }, svg);
    for (let u = 0; u < data.width; u += step) write(u, data.height + 20 * unit, u, 'middle');
    for (let v = 0; v < data.height; v += step) write(-8 * unit, v + 6 * unit, v, 'end');
    write(data.width / 2, data.height + 42 * unit, 'column u (px)', 'middle');
    write(-8 * unit, -12 * unit, 'row v (px)', 'start');
  };
  const left = 60 * unit, top = 34 * unit;
  svg.setAttribute('viewBox', [-left, -top, data.width + left + 20 * unit, data.height + top + 52 * unit].join(' '));
  const draw = () => {
    const image = data.images[which.value - 1];
    const scale = 10 ** enlarge.value;
    svg.replaceChildren();
    frame();
    // A round length that is a tenth of the width or less, as enlarged.
    const most = 0.1 * data.width / scale, power = 10 ** Math.floor(Math.log10(most));
    const key = [5, 2, 1].find((step) => step * power <= most) * power;
    const x = data.width - scale * key, y = -14 * unit;
    add('line', { x1: x, y1: y, x2: data.width, y2: y, stroke: 'var(--series-1)', 'stroke-width': 3 * unit }, svg);
    write(x - 8 * unit, y + 6 * unit, `residual of ${Number(key.toPrecision(1))} px`, 'end');
    let used = 0;
    const count = image.stars.length / 5;
    for (let k = 0; k < count; k++) {
      const [u, v, du, dv, isUsed] = image.stars.slice(5 * k, 5 * k + 5);
      used += isUsed;
      const group = add('g', {}, svg);
      add('line', {
        x1: u, y1: v, x2: u + scale * du / 1000, y2: v + scale * dv / 1000,
        stroke: isUsed ? 'var(--series-1)' : 'var(--series-2)', 'stroke-width': 1.6 * unit,
      }, group);
      add('circle', {
        cx: u, cy: v, r: 3 * unit, fill: isUsed ? 'var(--ink)' : 'var(--series-2)',
      }, group);
      add('title', {}, group).textContent =
        `(${u}, ${v}) px, residual ${(du / 1000).toFixed(3)}, ${(dv / 1000).toFixed(3)} px` +
        (isUsed ? '' : ', left out');
    }
    const tracker = !image.tracker.length ? '' :
      image.tracker[0] === null ? ', too few stars for the star tracker error' :
      `, star tracker error ${image.tracker.map((a) => a.toFixed(1) + '″').join(', ')} about x, y, z`;
    output.textContent = `Image ${image.number} of ${data.count}, ${image.time}: ` +
      `${used} stars used, ${count - used} left out` +
      (image.rms === null ? '' : `, ${image.rms.toFixed(3)} px rms`) + tracker +
      (image.misfit ? '; attitude misfit' : '') +
      `. Residuals enlarged ${Math.round(scale)} times.`;
    which.setAttribute('aria-valuetext', `image ${image.number}`);
  };
  which.max = data.images.length;
  which.addEventListener('input', draw);
  enlarge.addEventListener('input', draw);
  draw();
})();
