const table = document.getElementById('cameras'), body = table.tBodies[0];
document.getElementById('search').addEventListener('input', (event) => {
  const words = event.target.value.toLowerCase().split(/\s+/);
  for (const row of body.rows) {
    row.hidden = !words.every((word) => row.textContent.toLowerCase().includes(word));
  }
});
table.tHead.addEventListener('click', (event) => {
  const head = event.target.closest('th'), k = head.cellIndex;
  const sign = head.ariaSort === 'ascending' ? -1 : 1;
  const text = (row) => row.cells[k].textContent;
  const rows = [...body.rows].sort((a, b) => sign * (
    head.className === 'text' ? text(a).localeCompare(text(b), 'en', { numeric: true })
      : (parseFloat(text(a)) || 0) - (parseFloat(text(b)) || 0)));
  for (const other of head.parentNode.cells) other.removeAttribute('aria-sort');
  head.setAttribute('aria-sort', sign > 0 ? 'ascending' : 'descending');
  body.append(...rows);
});
