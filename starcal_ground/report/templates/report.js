'use strict';
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
  const draw = () => {
    const image = data.images[which.value - 1];
    const scale = 10 ** enlarge.value;
    svg.replaceChildren();
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
