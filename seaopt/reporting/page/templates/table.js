// Tables whose heads are buttons that sort, and a field above that leaves the rows with all of its words.
for (const table of document.querySelectorAll("table.sortable")) {
  const body = table.tBodies[0], heads = [...table.tHead.rows[0].cells], rows = [...body.rows];
  const field = document.getElementById(table.dataset.filter), count = document.getElementById(table.dataset.count);
  const key = (row, column) => row.cells[column].dataset.v ?? row.cells[column].textContent.trim();
  const compare = (a, b) => {
    if (a === "" || b === "") return (a === "") - (b === "");
    const [x, y] = [Number(a), Number(b)];
    return Number.isNaN(x) || Number.isNaN(y) ? a.localeCompare(b, undefined, { numeric: true }) : x - y;
  };
  heads.forEach((head, column) => {
    const button = document.createElement("button");
    button.type = "button"; button.append(...head.childNodes); head.append(button);
    button.addEventListener("click", () => {
      const falling = head.getAttribute("aria-sort") === "descending";
      for (const other of heads) other.removeAttribute("aria-sort");
      head.setAttribute("aria-sort", falling ? "ascending" : "descending");
      const sign = falling ? 1 : -1;
      rows.sort((p, q) => {
        const [a, b] = [key(p, column), key(q, column)];
        return a === "" || b === "" ? compare(a, b) : sign * compare(a, b); // what is missing is last either way
      });
      body.replaceChildren(...rows);
    });
  });
  field.parentElement.hidden = false;
  field.addEventListener("input", () => {
    const words = field.value.toLowerCase().split(/\s+/).filter(Boolean);
    let shown = 0;
    for (const row of rows) {
      const text = row.textContent.toLowerCase(), fits = words.every((word) => text.includes(word));
      row.hidden = !fits; shown += fits;
    }
    count.textContent = words.length ? `${shown} of ${rows.length}` : "";
  });
}
