"use strict";
// Tables: heads sort, a field searches. Without script they are whole and in a useful order already.
(() => {
  const SEARCH_FROM = 5;

  const keyOf = (row, column) => {
    const cell = row.cells[column];
    const key = cell.dataset.order;
    if (key === undefined) return null;
    return cell.classList.contains("number") ? Number(key) : key;
  };

  const compare = (a, b) => (typeof a === "number" && typeof b === "number" ? a - b
    : String(a).localeCompare(String(b), "en", { numeric: true }));

  function sort(table, column, descending) {
    const body = table.tBodies[0];
    const rows = [...body.rows].map((row, index) => ({ row, index, key: keyOf(row, column) }));
    rows.sort((a, b) => {
      // What is not known comes last whichever way is sorted.
      if (a.key === null || b.key === null) return (a.key === null) - (b.key === null) || a.index - b.index;
      return (descending ? -1 : 1) * compare(a.key, b.key) || a.index - b.index;
    });
    body.append(...rows.map((item) => item.row));
    [...table.tHead.rows[0].cells].forEach((head, index) => {
      if (index === column) head.setAttribute("aria-sort", descending ? "descending" : "ascending");
      else head.removeAttribute("aria-sort");
    });
  }

  function makeSortable(table) {
    [...table.tHead.rows[0].cells].forEach((head, column) => {
      const button = document.createElement("button");
      button.type = "button";
      button.textContent = head.textContent;
      button.addEventListener("click", () => sort(table, column, head.getAttribute("aria-sort") === "ascending"));
      // Browsers do not repeat buttons at the top of each sheet of paper; text they do.
      const printed = document.createElement("span");
      printed.textContent = head.textContent;
      printed.className = "printed";
      printed.ariaHidden = "true";
      head.replaceChildren(button, printed);
    });
  }

  function makeSearchable(table) {
    const rows = [...table.tBodies[0].rows];
    if (rows.length < SEARCH_FROM) return;
    const field = document.createElement("input");
    field.type = "search";
    field.id = `search-${table.id}`;
    const label = document.createElement("label");
    label.htmlFor = field.id;
    label.textContent = "Search";
    const count = document.createElement("span");
    count.setAttribute("aria-live", "polite");
    const texts = new Map(rows.map((row) => [row, row.textContent.toLowerCase()]));
    const show = () => {
      const words = field.value.toLowerCase().split(/\s+/).filter(Boolean);
      let shown = 0;
      for (const row of rows) {
        row.hidden = !words.every((word) => texts.get(row).includes(word));
        shown += !row.hidden;
      }
      count.textContent = `${shown} of ${rows.length} rows`;
    };
    field.addEventListener("input", show);
    const bar = document.createElement("div");
    bar.className = "search";
    bar.append(label, field, count);
    table.closest(".scroll").before(bar);
    show();
  }

  for (const table of document.querySelectorAll("table.data")) {
    makeSortable(table);
    makeSearchable(table);
  }
})();
